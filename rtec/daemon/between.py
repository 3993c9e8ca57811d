"""What the loop does between two cycles: hands the row on, looks at the orders, takes over what was loaded anew.

A reload with the same structure (other limits, other coefficients) is some numbers: they are copied between two
cycles. Another structure is another compiled step: a thread of ordinary priority makes it while the loop goes on, and
it is taken between two cycles.
"""

import os
import threading
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtec.daemon.ring import Ring
from rtec.daemon.signals import starter
from rtec.errors import RtecError
from rtec.loop.loop import Loop, Row, bind_rows
from rtec.loop.state import StateWriter
from rtec.loop.step import Step, StepSettings

PARENT_CHECK_CYCLES: Final = 256
NOTES_PER_S: Final = 10


class Between:
    """Called with each row when its command is out; says whether to go on.

    Args:
        loop: whose cycles these are; its keeper is set.
        ring: shared with the supervisor.
        pipe: brings what is to be loaded, before the ring orders it.
        image: memory of the kept state.
        rate_hz: cycles per second.
    """

    def __init__(self, loop: Loop, ring: Ring, pipe: Connection, image: NDArray[np.uint8], rate_hz: float) -> None:
        self._loop, self._ring, self._pipe, self._image = loop, ring, pipe, image
        self._parent = starter()
        self._note_cycles = max(1, round(rate_hz / NOTES_PER_S))
        self._resumes, self._reloads = ring.orders.resumes, ring.orders.reloads
        self._making: _Making | None = None
        self._row: Row | None = None

    def __call__(self, row: Row) -> bool:
        """Do it."""
        loop, ring, orders, stats = self._loop, self._ring, self._ring.orders, self._loop.stats
        self._row = row
        if orders.reloads != self._reloads:
            self._reload(row, orders.reloads)
        if self._making is not None:
            self._take_made(row, self._making)
        ring.publish()
        ring.deadline_misses = stats.misses
        loop.mode = orders.mode
        if orders.resumes != self._resumes:
            self._resumes = orders.resumes
            loop.order_resume()
        if stats.cycles % self._note_cycles == 0:
            self._tell()
        alive = stats.cycles % PARENT_CHECK_CYCLES != 0 or os.getppid() == self._parent
        return alive and not ring.stop_requested

    def finish(self, in_order: bool) -> None:
        """The last word to the kept state; without order it stays as after a kill."""
        loop, row = self._loop, self._row
        if row is not None and loop.keeper is not None and in_order and not loop.waits:
            loop.keeper.finish(row.samples, row.output, loop.stats.cycles - 1)

    def _tell(self) -> None:
        loop, ring = self._loop, self._ring
        ring.takeovers = loop.stats.takeovers
        if loop.keeper is not None:
            loop.keeper.waits = loop.waits
        if ring.note is not None:
            ring.note.write(loop.stats.reasons())

    def _reload(self, row: Row, generation: int) -> None:
        self._reloads = generation
        content = self._pipe.recv()  # the supervisor put it there before it gave the order: nothing is waited for
        if isinstance(content, StepSettings):
            self._making = _Making(content, self._ring, generation)
        else:
            self._loop.step.take_numbers(*content)
            self._taken(row, generation)

    def _take_made(self, row: Row, making: "_Making") -> None:
        if making.thread.is_alive():
            return
        self._making = None
        keeper, old = self._loop.keeper, self._loop.step
        if not making.rows:
            self._ring.reloads = -making.generation
        elif making.step is not None and keeper is not None:
            making.step.adopt(old, row.samples)
            _let_go(self._loop.go_on_with(making.step, making.rows))
            self._loop.keeper = StateWriter(self._image, making.step, keeper.start_mode, keeper.sequence)
            self._taken(row, making.generation)

    def _taken(self, row: Row, generation: int) -> None:
        if self._loop.keeper is not None:
            self._loop.keeper.snapshot(row.samples, row.output, self._loop.stats.cycles - 1)
        self._ring.reloads = generation


def _below_the_loop() -> None:
    """Less urgent than the loop, more than everything else: the loop waits for whoever has the interpreter's lock."""
    with suppress(OSError):
        priority = os.sched_getparam(0).sched_priority
        if priority > 1:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority - 1))


def _let_go(rows: list[Row]) -> None:
    """Forget thousands of rows one by one, in a thread: all at once would keep the interpreter for milliseconds."""

    def work() -> None:
        _below_the_loop()
        while rows:
            rows.pop()

    threading.Thread(target=work, name="rtec-let-go", daemon=True).start()


class _Making:
    """A step in the making, in a thread of its own."""

    def __init__(self, settings: StepSettings, ring: Ring, generation: int) -> None:
        self.generation = generation
        self.step: Step | None = None
        self.rows: list[Row] = []
        self.thread = threading.Thread(target=self._make, args=(settings, ring), name="rtec-reload", daemon=True)
        self.thread.start()

    def _make(self, settings: StepSettings, ring: Ring) -> None:
        _below_the_loop()
        with suppress(RtecError):  # the supervisor made the same step before it sent it
            self.step = Step(settings)
            self.step.warm_up()
            self.rows = bind_rows(self.step, ring.slots)
