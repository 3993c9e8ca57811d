"""rtec's loop in a thread of the test, with the device, the model and the limits of a run file of configs/linuxcnc."""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rtec.correction.flags import MODE_ON
from rtec.loop.clock import RealClock
from rtec.loop.devices import make_devices, open_ports
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import load_setup
from rtec.loop.step import Step
from tests.support.conformance import soon
from tests.support.linuxcnc_session import CONFIGS, Session

Floats = NDArray[np.float64]


class LoopThread:
    """`rtec run` without its processes: it corrects while the test drives LinuxCNC.

    Attributes:
        loop: what runs.
        output: the last command, units.

    Args:
        session: the LinuxCNC.
        edits: text to replace in the run file, as (old, new) pairs.
    """

    def __init__(self, session: Session, edits: tuple[tuple[str, str], ...] = ()) -> None:
        self._path = run_files(session, edits)
        self._stack, self._ends, self._resume = ExitStack(), threading.Event(), threading.Event()
        self.output: NDArray[np.int64] = np.zeros(0, np.int64)

    def __enter__(self) -> Self:
        setup, clock = load_setup(self._path), RealClock()
        step = Step(setup.step_settings())
        step.warm_up()
        rows = bind_rows(step, [(Samples.empty(step.layout, 1), Commands.empty(step.layout, 1))])
        ports = open_ports(setup, make_devices(setup, clock), self._stack)
        self.loop = Loop(step, ports, clock, setup.period_ns, rows, MODE_ON)
        self.loop.take_over(None)
        self._thread = threading.Thread(target=self.loop.run, args=(None, self._goes_on))
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ends.set()
        self._thread.join()
        self._stack.close()

    def order_resume(self) -> None:
        """Order it in the loop's own thread, and wait until that is done."""
        self._resume.set()
        soon(RealClock(), lambda: not self._resume.is_set())

    def _goes_on(self, row: Row) -> bool:
        self.output = row.output.copy()
        if self._resume.is_set():
            self.loop.order_resume()
            self._resume.clear()
        return not self._ends.is_set()


def run_files(session: Session, edits: tuple[tuple[str, str], ...] = ()) -> Path:
    """Put the shipped run, machine and model file into the session's folder; give the run file.

    Args:
        session: whose configuration.
        edits: text to replace in the run file, as (old, new) pairs.
    """
    for file in CONFIGS.glob(f"{session.name}*.toml"):
        shutil.copy(file, session.folder)
    path = session.folder / f"{session.name}.toml"
    text = path.read_text()
    for old, new in edits:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)
    return path


def start_daemon(session: Session, run_file: Path, log: Path | None = None) -> "subprocess.Popen[bytes]":
    """`rtec run`, as a user starts it, in a process group of its own; its state and socket are the session's."""
    env = {**os.environ, "RUNTIME_DIRECTORY": str(session.folder)}
    with (log or session.folder / "rtec.log").open("ab") as said:
        words = [sys.executable, "-m", "rtec.cli.main", "run", str(run_file)]
        return subprocess.Popen(words, stdout=said, stderr=said, env=env, start_new_session=True)


def dwell_means(rows: Floats, still: int) -> list[Floats]:
    """Give the mean row of the second half of each dwell that lasted so many servo periods, of a plant's recording."""
    commanded = rows[:, 1:4]
    begins = np.flatnonzero(np.r_[True, np.any(np.diff(commanded, axis=0) != 0.0, axis=1)])
    ends = np.r_[begins[1:], len(rows)]
    return [rows[(a + b) // 2 : b].mean(axis=0) for a, b in zip(begins, ends, strict=True) if b - a >= still]


def until_pins(session: Session, pins: Sequence[str], met: Callable[[list[float]], bool]) -> None:
    """Wait, a minute at most, until the values of some pins are as they should be."""
    session.until(lambda: met([session.gets(p) for p in pins]))
