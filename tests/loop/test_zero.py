"""The zero of incremental encoders. Oracles: a loop that reads absolute counts at the same places; counts by hand."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.flags import MODE_HOLD, MODE_ON
from rtec.daemon.homing import Homing
from rtec.errors import ConfigError
from rtec.loop.clock import VirtualClock
from rtec.loop.devices import Ports, make_devices
from rtec.loop.loop import Loop, bind_rows
from rtec.loop.orders import OrderRefused
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import load_setup
from rtec.loop.state import IMAGE_BYTES, StateWriter, newest
from rtec.loop.step import Step
from rtec.loop.zero import Home, Zero, home_of, read_positions
from tests.daemon.test_take_over import LateBox
from tests.support import setups

Ints = NDArray[np.int64]
MS = 1_000_000
HOME_MM = {"X": 40.0, "Z": 250.5}


class Absolute(LateBox):
    """Counts from the machine's zero, at the place of `HOME_MM` and later somewhere else; takes every command."""

    begins: tuple[int, int] = (0, 0)

    def __init__(self, clock: VirtualClock, places: list[Ints]) -> None:
        super().__init__(clock, (0, 0), 0)
        self.places = places

    def read_counts(self, counts: Ints) -> int:
        counts[:] = self.places[min(self.reads, len(self.places) - 1)] - self.begins
        self.reads += 1
        return self.clock.now_ns()


class Box(Absolute):
    """Counts from where the axes stood at its supply."""

    supply = 7


def places(step: Step, moves: int) -> list[Ints]:
    """Counts at `HOME_MM` for 40 cycles, then a motion, both axes."""
    machine = step.settings.model.machine
    begin = np.array([round(HOME_MM[a.name] * a.counts_per_mm) for a in machine.axes])
    return [begin] * 40 + [begin + 5 * np.array([k, -k], np.int64) for k in range(moves)]


def loop_of(
    folder: Path, kind: type[Absolute], by_order: bool, cycles: int
) -> tuple[Loop, Absolute, Samples, Commands]:
    clock, step = VirtualClock(10**12), Step(setups.setup(folder).step_settings())
    box = kind(clock, places(step, 400))
    samples, commands = Samples.empty(step.layout, cycles), Commands.empty(step.layout, cycles)
    rows = bind_rows(step, list(zip(samples.singles(), commands.singles(), strict=True)))
    zero = Zero(box, step.layout.axes, by_order)
    loop = Loop(step, Ports(box, (box,), box, box, {"counts": ("box",)}), clock, MS, rows, MODE_ON, zero)
    loop.take_over(None)
    return loop, box, samples, commands


def test_holds_until_it_is_ordered_then_corrects_as_with_absolute_counts(tmp_path: Path) -> None:
    """Up to the order it holds; from the next cycle on every number is that of absolute counts."""
    loop, box, samples, commands = loop_of(tmp_path, Box, True, 300)
    machine = loop.step.settings.model.machine
    box.begins = (123_456, -7_890)
    loop.run(20, lambda _: True)
    assert (samples.mode[1:20] == MODE_HOLD).all()
    assert not commands.applied_um[:20].any()
    (reason,) = loop.stats.reasons()["box"]
    assert "nobody has ordered them since this device got its supply" in reason
    assert "`rtec ctl home X=… Z=…`" in reason
    assert not loop.waits  # an order to resume would not help
    assert loop.home(home_of(HOME_MM, machine, samples.counts[19], Box.supply))
    loop.run(280, lambda _: True)
    assert loop.stats.reasons() == {}

    exact, _, truth, wanted = loop_of(tmp_path, Absolute, False, 280)
    exact._ports.counts.reads = 20  # type: ignore[attr-defined]
    exact._clock.sleep_until_ns(exact._clock.now_ns() + 20 * MS)
    exact.run(280, lambda _: True)
    assert np.array_equal(samples.counts[20:], truth.counts)
    assert samples.counts[20].tolist() == [
        round(mm * a.counts_per_mm) for mm, a in zip(HOME_MM.values(), machine.axes, strict=True)
    ]
    assert np.array_equal(commands.requested_um[20:], wanted.requested_um)
    assert np.abs(commands.applied_um[-1] - wanted.applied_um[-1]).max() < 0.6
    assert np.abs(np.diff(commands.applied_um[20:], axis=0)).max() <= 50.0 * 1e-3 * (1 + 1e-9)


def test_an_axis_may_move_before_the_loop_has_the_order(tmp_path: Path) -> None:
    """The order is of the instant at which it was looked at. Oracle: absolute counts, 60 cycles later."""
    loop, box, samples, _ = loop_of(tmp_path, Box, True, 300)
    box.begins = (123_456, -7_890)
    loop.run(10, lambda _: True)
    home = home_of(HOME_MM, loop.step.settings.model.machine, samples.counts[9], Box.supply)
    loop.run(50, lambda _: True)
    assert (samples.counts[59] != samples.counts[9]).all()
    loop.home(home)
    loop.run(10, lambda _: True)
    assert np.array_equal(samples.counts[60:70], box.places[60:70])


def test_an_order_is_for_the_counts_of_one_start_of_the_box(tmp_path: Path) -> None:
    """The box loses its supply after the look. The order was for the counts of before, so the loop refuses it."""
    loop, box, samples, _ = loop_of(tmp_path, Box, True, 300)
    assert isinstance(box, Box)
    loop.run(10, lambda _: True)
    home = home_of(HOME_MM, loop.step.settings.model.machine, samples.counts[9], Box.supply)
    box.supply, box.begins = 8, (123_456, -7_890)
    loop.run(5, lambda _: True)
    assert not loop.home(home)
    loop.run(5, lambda _: True)
    assert (samples.mode[16:20] == MODE_HOLD).all()


@pytest.mark.parametrize(("fails_ms", "refusal"), [(0, ""), (60, ""), (400, ""), (10_000, "cannot be read")])
def test_a_reading_that_failed_is_no_reason_to_refuse(tmp_path: Path, fails_ms: int, refusal: str) -> None:
    """An order is looked at until a reading has come, for a second. Oracle: the counts that were read."""
    loop, _, samples, _ = loop_of(tmp_path, Box, True, 20)
    image = np.zeros(IMAGE_BYTES, np.uint8)
    loop.keeper = StateWriter(image, loop.step, MODE_ON, zero=loop.zero)
    loop.run(20, lambda _: True)
    looks = Homing(setups.setup(tmp_path), lambda: newest(image.tobytes()))
    looks.begin("X=40 Z=250.5")
    found, began, step_ms = None, int(samples.time_ns[19]), 10
    row = samples.rows(19, 20).copy()
    for ms in range(0, 2000, step_ms):
        row.time_ns[:] = began + ms * MS
        if ms >= fails_ms:
            row.counts_time_ns[:] = row.time_ns
        found = looks.look(row)
        if found is not None:
            break
    if refusal:
        assert isinstance(found, str)
        assert refusal in found
    else:
        assert isinstance(found, Home)
        assert found.by.tolist() == (places(loop.step, 0)[0] - samples.counts[19]).tolist()
    assert not looks.busy


def test_without_supply_meanwhile_the_positions_are_lost(tmp_path: Path) -> None:
    loop, box, samples, _ = loop_of(tmp_path, Box, True, 300)
    assert isinstance(box, Box)
    loop.run(5, lambda _: True)
    loop.home(home_of(HOME_MM, loop.step.settings.model.machine, samples.counts[4], Box.supply))
    loop.run(5, lambda _: True)
    assert samples.mode[9] == MODE_ON
    box.supply = 8
    loop.run(5, lambda _: True)
    assert (samples.mode[10:15] == MODE_HOLD).all()
    loop.order_resume()  # a person who resumes does not tell positions
    loop.run(5, lambda _: True)
    assert (samples.mode[16:20] == MODE_HOLD).all()
    assert "this device was without supply (start 8, before 7)" in loop.stats.reasons()["box"][0]


@pytest.mark.parametrize("by_order", [True, False])
def test_over_runs_the_zero_goes_on_with_the_supply_alone(tmp_path: Path, by_order: bool) -> None:
    loop, box, samples, _ = loop_of(tmp_path, Box, by_order, 300)
    assert isinstance(box, Box)
    image = np.zeros(IMAGE_BYTES, np.uint8)
    loop.keeper = StateWriter(image, loop.step, MODE_ON, zero=loop.zero)
    loop.run(5, lambda _: True)
    if by_order:
        loop.home(home_of(HOME_MM, loop.step.settings.model.machine, samples.counts[4], Box.supply))
    loop.run(5, lambda _: True)
    saved = newest(image.tobytes())
    assert saved is not None
    assert (saved.supply, saved.homed) == (7, by_order)
    assert np.array_equal(saved.zero, loop.zero.offset)

    for supply in (7, 8):
        again, box, samples, _ = loop_of(tmp_path, Box, by_order, 300)
        assert isinstance(box, Box)
        box.supply = supply
        again.zero.go_on(saved.zero, saved.supply, saved.homed)
        again.run(10, lambda _: True)
        held = supply == 8
        assert (samples.mode[1:10] == (MODE_HOLD if held else MODE_ON)).all()
        assert again.waits is (held and not by_order)
        if held and not by_order:
            assert "its count 0 is where the axes stood then" in again.stats.reasons()["output"][0]
            again.order_resume()
            again.run(5, lambda _: True)
            assert samples.mode[14] == MODE_ON
        elif not held:
            assert np.array_equal(samples.counts[9], box.places[9] - np.array(box.begins) + saved.zero)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"name where the axes stand: X=… Z=… \(mm\)"),
        ("X", "'X' is not AXIS=POSITION in mm, such as X=0"),
        ("X=zero", "'X=zero' is not AXIS=POSITION"),
        ("X=nan Z=0", "'X=nan' is not AXIS=POSITION"),
        ("x=0", "no axis 'x'; its axes are X, Z"),
        ("X=0 X=1", "axis X is named twice"),
        ("X=0 Z=9000", "Z = 9000 mm is outside its travel, "),
    ],
)
def test_a_wrong_text_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(OrderRefused, match=message):
        read_positions(text, setups.setup(tmp_path).machine)


def test_a_device_that_does_not_tell_its_starts_cannot_be_homed(tmp_path: Path) -> None:
    content = setups.tables(tmp_path)
    content["run"]["zero"] = "ordered"
    setup = load_setup(setups.write(tmp_path, content))
    with pytest.raises(ConfigError, match=r'\[run\] zero = "ordered": \[device.box\] has a zero of its own'):
        make_devices(setup, VirtualClock(10**12))
