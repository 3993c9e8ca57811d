"""The loop on a virtual clock. Oracles: arithmetic on deadlines; the step run over the same samples; the ledger."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np

from rtec.arrays import Ints
from rtec.correction.flags import MODE_ON
from rtec.correction.sinks import Sink
from rtec.errors import DriverTimeout
from rtec.loop.clock import VirtualClock
from rtec.loop.devices import Ports, make_devices, open_ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.run_file import Setup
from rtec.loop.step import Step
from rtec_drivers.sim import SimDriver
from tests.support.setups import setup


class SlowClock(VirtualClock):
    """Every sleep ends late by what `late` says, and every look at the clock takes `look_ns`."""

    def __init__(self, late_ns: list[int]) -> None:
        super().__init__(10**9)
        self.late_ns = late_ns

    def sleep_until_ns(self, instant_ns: int) -> None:
        super().sleep_until_ns(instant_ns)
        if self.late_ns:
            super().sleep_until_ns(instant_ns + self.late_ns.pop(0))


def run(
    made: Setup, clock: VirtualClock, cycles: int, wrap: object = None, mode: int = MODE_ON
) -> tuple[Samples, Commands, Loop, Ports]:
    """Run so many cycles into memory."""
    step = Step(made.step_settings())
    layout: Layout = step.layout
    samples, commands = Samples.empty(layout, cycles), Commands.empty(layout, cycles)
    rows = bind_rows(step, list(zip(samples.singles(), commands.singles(), strict=True)))
    with ExitStack() as stack:
        devices = make_devices(made, clock)
        ports = open_ports(made, devices, stack)
        if callable(wrap):
            ports = wrap(ports)
        loop = Loop(step, ports, clock, made.period_ns, rows, mode)
        loop.run(cycles, lambda _: True)
    return samples, commands, loop, ports


def test_deadlines_are_absolute(tmp_path: Path) -> None:
    """Lateness within a period does not add up: the k-th cycle begins k periods after the start, plus its own delay."""
    late = [0, 300_000, 0, 700_000, 0, 0]
    samples, _, loop, _ = run(setup(tmp_path), SlowClock(list(late)), 6)
    expected = 10**9 + (1 + np.arange(6)) * 1_000_000 + np.array(late)
    np.testing.assert_array_equal(samples.time_ns, expected)
    assert loop.stats.misses == 0
    assert loop.stats.wake_up.largest_ns == 700_000


def test_a_missed_deadline_is_counted_and_skipped(tmp_path: Path) -> None:
    """A cycle that ends 2.5 periods late costs the two deadlines that passed; the rhythm stays."""
    samples, _, loop, _ = run(setup(tmp_path), SlowClock([0, 2_500_000, 0, 0]), 4)
    begun = (samples.time_ns - 10**9) / 1e6
    np.testing.assert_allclose(begun, [1, 2 + 2.5, 5, 6])
    assert loop.stats.misses == 2


def test_a_run_is_the_step_over_its_samples(tmp_path: Path) -> None:
    """What the loop sent, the pure step gives for what the loop read."""
    made = setup(tmp_path)
    samples, commands, _, _ = run(made, VirtualClock(10**9), 3000)
    step = Step(made.step_settings())
    _, again = step.advance(step.fresh_state(), samples)
    for name, array in commands.arrays().items():
        assert array.tobytes() == getattr(again, name).tobytes(), name
    assert np.abs(commands.applied_um).max() > 5.0


def test_raw_plus_inserted_is_what_the_controller_closes_its_loop_on(tmp_path: Path) -> None:
    """At every cycle; oracle: the simulated machine's own account."""
    made = setup(tmp_path)
    account: list[tuple[int, ...]] = []

    def watched(ports: Ports) -> Ports:
        box = ports.actuator
        assert isinstance(box, SimDriver)
        machine = box.machine

        class Watch:
            def refuses(self, sink: Sink) -> str:
                return box.refuses(sink)

            def apply(self, output: Ints) -> None:
                box.apply(output)
                account.append(tuple((machine.inserted_counts - output).tolist()))

            def read_output(self, output: Ints) -> None:
                box.read_output(output)

            def hold(self) -> None:
                box.hold()

        return Ports(ports.counts, ports.temperatures, ports.spindle, Watch())

    _, commands, _, _ = run(made, VirtualClock(10**9), 2500, watched)
    assert set(account) == {(0, 0)}
    assert np.abs(np.diff(commands.output, axis=0)).max() == 1


def test_a_silent_encoder_box_holds_the_correction_and_costs_no_cycle(tmp_path: Path) -> None:
    made = setup(tmp_path)
    silent_from, silent_to = 2400, 2500

    def wrapped(ports: Ports) -> Ports:
        class Silent:
            reads = 0

            def read_counts(self, counts: Ints) -> int:
                self.reads += 1
                if silent_from < self.reads <= silent_to:
                    raise DriverTimeout("encoder box: no answer")
                return ports.counts.read_counts(counts)

        return Ports(Silent(), ports.temperatures, ports.spindle, ports.actuator)

    samples, commands, loop, _ = run(made, VirtualClock(10**9), 2600, wrapped)
    assert loop.stats.cycles == 2600
    assert loop.stats.driver_errors == silent_to - silent_from
    assert loop.stats.last_error == "encoder box: no answer"
    stale = (commands.flags & 1) != 0
    # Old after 5 ms; the first reading that comes back is fresh at once.
    np.testing.assert_array_equal(np.flatnonzero(stale), np.arange(silent_from + 5, silent_to))
    age = samples.time_ns - samples.counts_time_ns
    assert age[silent_to - 1] == (silent_to - silent_from) * 1_000_000
    held = commands.applied_um[silent_from + 60 : silent_to]
    np.testing.assert_array_equal(held, np.broadcast_to(held[0], held.shape))


def test_a_silent_spindle_is_not_taken_for_its_last_speed(tmp_path: Path) -> None:
    """A speed has no instant that the guard could judge: where it is not read it is not a number."""

    def wrapped(ports: Ports) -> Ports:
        class Silent:
            reads = 0

            def read_spindle(self) -> float:
                self.reads += 1
                if 30 < self.reads <= 50:
                    raise DriverTimeout("spindle: no answer")
                return 2000.0

        return Ports(ports.counts, ports.temperatures, Silent(), ports.actuator)

    samples, _, loop, _ = run(setup(tmp_path), VirtualClock(10**9), 60, wrapped)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(samples.spindle_rpm)), np.arange(30, 50))
    assert loop.stats.driver_errors == 20


def test_rows_are_used_in_a_circle(tmp_path: Path) -> None:
    made = setup(tmp_path)
    step = Step(made.step_settings())
    samples, commands = Samples.empty(step.layout, 4), Commands.empty(step.layout, 4)
    rows = bind_rows(step, list(zip(samples.singles(), commands.singles(), strict=True)))
    seen: list[int] = []

    def after(row: Row) -> bool:
        seen.append(int(row.samples.time_ns[0]))
        return len(seen) < 10

    with ExitStack() as stack:
        clock = VirtualClock(10**9)
        ports = open_ports(made, make_devices(made, clock), stack)
        Loop(step, ports, clock, made.period_ns, rows, MODE_ON).run(None, after)
    assert seen == [10**9 + k * 1_000_000 for k in range(1, 11)]
    assert sorted(samples.time_ns.tolist()) == seen[-4:]
