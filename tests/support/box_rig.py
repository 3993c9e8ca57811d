"""Encoder boxes for tests: on a real pseudo terminal with the real clock, or in memory on a virtual one."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.loop.clock import Clock, RealClock, VirtualClock
from rtec.machine import Machine
from rtec.tomlfile import validated
from rtec_drivers.box import driver as serial_box
from rtec_drivers.box.driver import BoxOptions, SerialBoxDriver
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.pty_peer import PtyPeer, WireFaults
from tests.support.box_peer import StillPlant
from tests.support.conformance import MACHINE
from tests.support.gateware import GatewareBox, gateware_on_a_port, missing

MS = 1_000_000
SPEED = {"X": 400.0, "Z": 400.0}
START_NS = 10**12


@pytest.fixture(
    params=["software", pytest.param("gateware", marks=pytest.mark.skipif(bool(missing()), reason=missing()))],
    autouse=True,
)
def each_box(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module that takes this in runs its tests twice: on the box in software, and on the simulated gateware."""
    if request.param == "gateware":
        monkeypatch.setattr(f"{__name__}.BoxSimulator", GatewareBox)
        monkeypatch.setattr(f"{__name__}.on_a_port", gateware_on_a_port)


def on_a_port(plant: StillPlant, link: Path, **box_options: Any) -> PtyPeer:
    """The box in software behind a pseudo terminal."""
    return PtyPeer(BoxSimulator(plant, 2, **box_options), RealClock(), link)


class MemoryLine:
    """The line to a box in memory: nothing is random, and the virtual clock passes only while somebody waits.

    A question takes `WIRE_NS` to the box, and so does the answer.
    """

    WIRE_NS = 50_000
    device = "memory"

    def __init__(self, box: BoxSimulator, clock: VirtualClock, faults: WireFaults) -> None:
        self.box, self.clock, self.faults, self.closed, self.deaf = box, clock, faults, False, False

    def write(self, data: bytes) -> None:
        now_ns = self.clock.now_ns()
        if not self.deaf:
            self.faults.put(self.box.receive(data, now_ns + self.WIRE_NS), now_ns + 2 * self.WIRE_NS)

    def read(self) -> bytes:
        return self.faults.take(self.clock.now_ns())

    def wait(self, timeout_s: float) -> bool:
        end_ns, next_ns = self.clock.now_ns() + round(timeout_s * 1e9), self.faults.next_ns()
        came = next_ns is not None and next_ns <= end_ns
        self.clock.sleep_until_ns(next_ns if came and next_ns is not None else end_ns)
        return came

    def close(self) -> None:
        self.closed = True


class Bench:
    """A box, its driver, and a loop that reads and commands every millisecond."""

    def __init__(self, driver: SerialBoxDriver, box: BoxSimulator, plant: StillPlant, clock: Clock) -> None:
        self.driver, self.box, self.plant, self.clock = driver, box, plant, clock
        self.counts: NDArray[np.int64] = np.zeros(box.axes, np.int64)
        self.output: NDArray[np.int64] = np.zeros(box.axes, np.int64)
        self.longest_ns = 0

    def read(self) -> int:
        """Read the counts; note how long it took at most."""
        start_ns = self.clock.now_ns()
        try:
            return self.driver.read_counts(self.counts)
        finally:
            self.longest_ns = max(self.longest_ns, self.clock.now_ns() - start_ns)

    def next_cycle(self) -> None:
        """Wait for the next millisecond."""
        self.clock.sleep_until_ns((self.clock.now_ns() // MS + 1) * MS)

    def cycle(self, *output: int) -> list[int]:
        """One cycle that succeeds; give the counts."""
        self.next_cycle()
        self.read()
        if output:
            self.output[:] = output
        self.driver.apply(self.output)
        return [int(n) for n in self.counts]

    def ledger(self) -> list[int]:
        """What the driver says the box has."""
        out = np.zeros(self.box.axes, np.int64)
        self.driver.read_output(out)
        return [int(n) for n in out]


def options(**more: Any) -> BoxOptions:
    """Options that work, and more."""
    return validated(BoxOptions, {"port": "/dev/none", "max_speed_mm_s": SPEED, **more}, "run.toml")


@contextmanager
def in_memory(
    monkeypatch: Any, box_options: Any = None, machine: Machine = MACHINE, **more: Any
) -> "Iterator[MemoryBench]":
    """A bench on a virtual clock; the line is `bench.line`, its faults `bench.faults`."""
    clock, plant = VirtualClock(START_NS), StillPlant(len(machine.axes))
    box, faults = BoxSimulator(plant, len(machine.axes), **(box_options or {})), WireFaults()
    lines: list[MemoryLine] = []

    def line(*_: object) -> MemoryLine:
        lines.append(MemoryLine(box, clock, faults))
        return lines[-1]

    monkeypatch.setattr(serial_box, "SerialLine", line)
    with SerialBoxDriver(options(**more), machine, clock, ports=list) as driver:
        yield MemoryBench(driver, box, plant, clock, faults, lines)


class MemoryBench(Bench):
    """A bench in memory."""

    def __init__(
        self,
        driver: SerialBoxDriver,
        box: BoxSimulator,
        plant: StillPlant,
        clock: VirtualClock,
        faults: WireFaults,
        lines: list[MemoryLine],
    ) -> None:
        super().__init__(driver, box, plant, clock)
        self.faults, self.lines = faults, lines

    @property
    def line(self) -> MemoryLine:
        """The line that is open now."""
        return self.lines[-1]


@contextmanager
def box_on_pty(folder: Path, **box_options: Any) -> Iterator[tuple[PtyPeer, BoxSimulator | GatewareBox, StillPlant]]:
    """A box on a pseudo terminal whose name is `folder / "box"`."""
    plant = StillPlant(2)
    with on_a_port(plant, folder / "box", **box_options) as peer:
        yield peer, cast("BoxSimulator | GatewareBox", peer.peer), plant
