"""A driver for tests: the simulated machine with things that happen to it at a given cycle.

It is installed as other people's drivers are, as a package with an entry point; `install` makes that package.
"""

import os
import select
import signal
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.errors import DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.machine import Machine
from rtec_drivers.sim import SimDriver, SimOptions

DRIVERS = {"faulty": ("tests.support.faulty", "FaultyDriver")}


class FaultyOptions(SimOptions):
    """As the simulated machine.

    Attributes:
        at_cycle: reading of counts, from the loop's first real one on, at which it happens.
        happens: what: Ctrl-C in the terminal, the death of everything or of the supervisor, silence for 200 cycles,
            a port that is not there, readings that take 50 ms each, or one whose opening, or whose reading, never ends,
            which notes its process in the file `told` before.
        told: a file that notes what the actuator was told.
        has: output that the actuator holds already when it is opened.
    """

    at_cycle: int = 0
    happens: Literal[
        "nothing", "ctrl_c", "kill_all", "kill_supervisor", "silence", "no_port", "hangs", "hangs_later", "slow"
    ] = "nothing"
    told: Path | None = None
    has: tuple[int, ...] = ()


class FaultyDriver(SimDriver):
    """The simulated machine, and what happens to it."""

    options_model = FaultyOptions

    def __init__(self, options: FaultyOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        super().__init__(options, machine, clock, base)
        self.faults = options
        self._reads = 0

    def __enter__(self) -> "FaultyDriver":
        if self.faults.happens == "no_port":
            raise DriverUnavailable("/dev/ttyUSB7: no such port; plug it in, or name another")
        if self.faults.happens == "hangs":
            self._hang()
        super().__enter__()
        if self.faults.has:
            super().apply(np.array(self.faults.has, np.int64))
        return self

    def read_counts(self, counts: NDArray[np.int64]) -> int:
        self._reads += 1
        at = self._reads - REHEARSAL
        match self.faults.happens:
            case "ctrl_c" if at == self.faults.at_cycle:
                os.killpg(0, signal.SIGINT)
            case "kill_all" if at == self.faults.at_cycle:
                os.killpg(0, signal.SIGKILL)
            case "kill_supervisor" if at == self.faults.at_cycle:
                os.kill(os.getppid(), signal.SIGKILL)
            case "hangs_later" if at == self.faults.at_cycle:
                self._hang()
            case "slow" if at >= self.faults.at_cycle:
                select.select((), (), (), SLOW_S)
            case "silence" if self.faults.at_cycle <= at < self.faults.at_cycle + 200:
                raise DriverTimeout("encoder box: no answer within 1 ms")
        return super().read_counts(counts)

    def apply(self, output: NDArray[np.int64]) -> None:
        self._note(f"apply {output.tolist()}")
        super().apply(output)

    def hold(self) -> None:
        self._note("held")
        super().hold()

    def __exit__(self, *rest: object) -> None:
        self._note("closed")
        super().__exit__(*rest)

    def _hang(self) -> None:
        assert self.faults.told is not None
        self.faults.told.write_text(str(os.getpid()))
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        while True:
            signal.pause()

    def _note(self, text: str) -> None:
        if self.faults.told is not None and not self.faults.happens.startswith("hangs"):
            with self.faults.told.open("a", encoding="utf-8") as file:
                file.write(text + "\n")


REHEARSAL = 100
SLOW_S = 0.05


CTRL_C_AT_ONCE = """
import os, signal
os.register_at_fork(after_in_child=lambda: os.killpg(0, signal.SIGINT))
"""


def interrupt_at_once(folder: Path, env: dict[str, str]) -> dict[str, str]:
    """Somebody presses Ctrl-C in the first instant of the loop's process, before any code of rtec runs in it."""
    (folder / "sitecustomize.py").write_text(CTRL_C_AT_ONCE, encoding="utf-8")
    return env


def install(folder: Path) -> dict[str, str]:
    """Make an installed package with the entry point; give the environment that finds it."""
    info = folder / "rtec_faulty-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rtec-faulty\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rtec.drivers]\nfaulty = tests.support.faulty:DRIVERS\n")
    root = Path(__file__).parents[2]
    return {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{root}"}
