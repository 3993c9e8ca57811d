"""A sensor that jumps within its range. Oracle: the reading that was handed in, and the largest change that is allowed.

The machine of these tests: one reading a second of three sensors, of which the model reads two.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rtec.arrays import Floats, Ints
from rtec.correction.flags import Flag, GuardSettings
from rtec.errors import DriverError, DriverFault, DriverTimeout
from rtec.loop.believed import RATE_DEGC_PER_S, STEP_DEGC, BelievedTemperatures
from rtec.loop.clock import VirtualClock
from rtec.loop.devices import Ports
from rtec.loop.run_file import Setup
from rtec.machine import load_machine
from tests.loop.test_loop import run
from tests.support.setups import CONFIGS, setup

S = 10**9
MACHINE = load_machine(CONFIGS / "machines" / "turning-centre.toml")
A, B, UNUSED = (MACHINE.sensor_names.index(name) for name in ("T_spindle_front", "T_bed", "T_air"))
USED = ("T_spindle_front", "T_bed")


class Board:
    """A device with three of the machine's sensors, and the arrays of the loop."""

    def __init__(self) -> None:
        self.values, self.now_ns, self.error = {A: 24.0, B: 21.0, UNUSED: 20.0}, 0, ""
        self.believed = BelievedTemperatures(self, MACHINE)
        self.degc, self.time_ns = np.full(len(MACHINE.sensors), np.nan), np.zeros(len(MACHINE.sensors), np.int64)

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        for i, value in self.values.items():
            degc[i], time_ns[i] = value, self.now_ns
        if self.error:
            raise DriverTimeout(self.error)

    def read(self, after_s: float = 1.0, **values: float) -> str:
        """One reading so much later; give what is wrong."""
        self.now_ns += round(after_s * S)
        self.values.update({{"a": A, "b": B, "unused": UNUSED}[name]: value for name, value in values.items()})
        try:
            self.believed.read(self.degc, self.time_ns, USED, self.now_ns)
        except DriverError as e:
            return str(e)
        return ""


def test_a_jump_is_not_used_and_the_other_sensors_are() -> None:
    """24 -> 31 °C in a second; the value and the instant of the reading before stay, so that it ages."""
    board = Board()
    assert board.read() == ""
    why = board.read(a=31.0, b=21.1)
    assert why.startswith("T_spindle_front: jumped from 24.00 to 31.00 °C within 1 s")
    assert "rtec ctl resume" in why
    assert (board.degc[A], board.time_ns[A]) == (24.0, S)
    assert (board.degc[B], board.time_ns[B]) == (21.1, 2 * S)
    assert board.believed.must_resume


def test_the_largest_change_is_that_of_the_constants() -> None:
    """STEP_DEGC and RATE_DEGC_PER_S for each second, both ways; whole time of silence counts."""
    for after_s in (0.01, 1.0, 10.0, 3600.0):
        most = STEP_DEGC + RATE_DEGC_PER_S * after_s
        for sign in (1.0, -1.0):
            for share, believed in ((0.999, True), (1.001, False)):
                board = Board()
                board.read(a=30.0)
                new = 30.0 + sign * share * most
                why = board.read(after_s, a=new)
                if MACHINE.sensors[A].range_degc[0] <= new <= MACHINE.sensors[A].range_degc[1]:
                    assert (why == "", board.degc[A] == new) == (believed, believed), (after_s, new)


def test_it_is_believed_again_when_it_is_back() -> None:
    """By itself, and without an order; until then however long it lasts: a sensor that stays away is not followed."""
    board = Board()
    board.read()
    for k in range(500):
        assert "jumped" in board.read(a=31.0 + 0.001 * k)
        assert board.degc[A] == 24.0
    assert board.read(a=24.0 + 0.9 * STEP_DEGC) == ""
    assert board.degc[A] == 24.0 + 0.9 * STEP_DEGC
    assert not board.believed.must_resume


def test_the_order_to_resume_accepts_what_it_reads() -> None:
    """At once, with the reading that is there, and without another one."""
    board = Board()
    board.read()
    board.read(a=31.0)
    board.believed.resume()
    assert board.read(0.0) == ""
    assert (board.degc[A], board.time_ns[A]) == (31.0, 2 * S)


def test_what_the_model_does_not_read_and_what_is_no_temperature_passes() -> None:
    """The guard holds for a number outside the sensor's range; its return is compared with the last good one."""
    board = Board()
    board.read()
    assert board.read(unused=29.0) == ""
    assert board.degc[UNUSED] == 29.0
    for odd in (1372.0, np.nan):
        assert board.read(a=odd) == ""
        np.testing.assert_equal(board.degc[A], odd)
    assert "jumped from 24.00 to 31.00" in board.read(a=31.0)
    assert board.read(a=24.1) == ""


def test_the_devices_own_error_is_told_beside_it() -> None:
    """The good readings of a device in trouble are used."""
    board = Board()
    board.read()
    board.error = "T_air: no answer"
    assert board.read(b=21.2) == "T_air: no answer"
    assert board.degc[B] == 21.2
    assert board.read(a=31.0).startswith("T_air: no answer; T_spindle_front: jumped")


@pytest.fixture(name="made")
def _made(tmp_path: Path) -> Setup:
    made = setup(tmp_path)
    return replace(made, file=made.file.model_copy(update={"guard": GuardSettings(temperature_max_age_s=2.0)}))


def test_the_correction_does_not_follow_a_sensor_that_jumps(made: Setup) -> None:
    """Against the same run without the fault: the same to a micrometre, then held; following would be 8.4 µm.

    The difference of a micrometre is the drift of the sensor since its last good reading.
    """
    from_ns, cycles = 2 * S, 6000

    def wrapped(ports: Ports) -> Ports:
        class Loose:
            def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
                read, at_ns = np.full_like(degc, np.nan), np.zeros_like(time_ns)
                device.read_temperatures(read, at_ns)
                degc[:], time_ns[:] = read, at_ns
                degc[A] += 7.0 * (at_ns[A] > from_ns)

        device = ports.temperatures[0]
        return replace(ports, temperatures=(Loose(),))

    _, well, _, _ = run(made, VirtualClock(S), cycles)
    samples, commands, loop, _ = run(made, VirtualClock(S), cycles, wrapped)
    age_s = (samples.time_ns - samples.degc_time_ns[:, A]) * 1e-9
    stale = (commands.flags & int(Flag.STALE_TEMPERATURE)) != 0
    np.testing.assert_array_equal(stale, age_s > 2.0)
    assert stale[-1]
    assert np.ptp(samples.degc[:, A]) < 1.0, "the rows have the temperature that was believed"
    assert np.abs(commands.applied_um - well.applied_um)[~stale].max() < 1.0
    assert np.ptp(commands.applied_um[stale], axis=0).max() < 0.7, "braking from 50 µm/s with 2000 µm/s² takes 0.63 µm"
    assert loop.waits
    assert any("jumped" in text for texts in loop.stats.reasons().values() for text in texts)
    loop.order_resume()
    assert not any(source.must_resume for source, _ in loop._temperatures)


def test_the_error_is_a_fault_of_the_sensor() -> None:
    """As `docs/write-a-driver.md` calls a wrong answer."""
    board = Board()
    board.read()
    board.values[A] = 40.0
    board.now_ns += S
    with pytest.raises(DriverFault):
        board.believed.read(board.degc, board.time_ns, USED, board.now_ns)
