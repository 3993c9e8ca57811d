"""The loop's output: what the actuator was told, what it says that it has, and whether it may be told more.

A command is absolute, so one that is lost is made good by the next; but only as long as it is not far from what the
machine has. So there is no new command before the actuator has said that it has the one before: the one before is
repeated, and nothing moves (OUTPUT_UNCONFIRMED). Whatever becomes of a command, the machine never sees a change that is
larger than one cycle's.

Where the actuator fails, or does not do as it is told for a quarter of a second, the output is in trouble
(OUTPUT_TROUBLE): the correction stands, whatever is ordered, and the row says so. Of an actuator that fails the ledger
is taken over; one that just does nothing is told the same again, one cycle's change at most off what it has. It goes
on from there, from rest, when the command was taken and confirmed. An actuator that by itself has something else than
any command started anew, or somebody else wrote to it: nobody can say what its counts mean now, so its ledger is taken
over and the order to resume is waited for.
"""

from typing import Final

import numpy as np

from rtec.correction.flags import MODE_OFF, MODE_TAKEN_OVER, OUTPUT_TROUBLE, OUTPUT_UNCONFIRMED
from rtec.errors import DriverError
from rtec.loop.ports import Actuator, IntArray, NoActuator, Resumable
from rtec.loop.stats import Trouble
from rtec.loop.step import Step

PATIENCE_NS: Final = 250_000_000
"""So long may an actuator leave a command unconfirmed that its driver accepts, before that is trouble."""
HOLDS: Final = "the correction holds until it is ordered to resume (`rtec ctl resume`)"


def lost(expected: IntArray, found: IntArray, allowed: IntArray, source: str = "the run before left") -> str:
    """Say that an actuator's ledger is not the one that it should have; "" where it is near enough."""
    if (np.abs(found - expected) <= allowed).all():
        return ""
    return (
        f"the actuator has {found.tolist()}, {source} {expected.tolist()}: it restarted, and its counts "
        f"may mean something else now; {HOLDS}"
    )


class CommandGate:
    """The actuator as the loop sees it.

    Attributes:
        has: what the actuator said last that it has, in the sink's units, by axis.
        takes_over: its ledger is to be taken over before anything is commanded.

    Args:
        actuator: of the run.
        axes: how many.
        trouble: is told what is wrong with it.
        waiting: is told why an order to resume is needed.
        period_ns: length of a cycle.
    """

    def __init__(self, actuator: Actuator, axes: int, trouble: Trouble, waiting: Trouble, period_ns: int) -> None:
        self.has: IntArray = np.zeros(axes, dtype=np.int64)
        self.takes_over = False
        self._actuator, self._trouble, self._waiting = actuator, trouble, waiting
        self._resumable = actuator if isinstance(actuator, Resumable) else None
        self._present = not isinstance(actuator, NoActuator)
        self._period_s = period_ns * 1e-9
        self._expected: IntArray | None = None
        self._allowed: IntArray | None = None
        self._step: Step | None = None
        self._told = self.has
        self._known = self._failed = self._in_trouble = self._far = False
        self._unconfirmed_ns: int | None = None

    @property
    def waits(self) -> bool:
        """Does it wait for its ledger, or for an order to resume?"""
        return self.takes_over or self._waiting.now or bool(self._resumable and self._resumable.must_resume)

    def take_over(self, expected: IntArray | None, allowed: IntArray | None) -> None:
        """Stand, and command nothing, until the actuator tells its ledger; go on from that one.

        Args:
            expected: what it should have; where it is further off than `allowed`, the order to resume is waited for.
            allowed: by axis; both None: whatever it has is right.
        """
        self.takes_over, self._expected, self._allowed = self._present, expected, allowed

    def look(self, step: Step, order: int, now_ns: int) -> int:
        """Look at what the actuator has, before a cycle; give the cycle's mode.

        Args:
            step: its ledger is what the actuator was told last; it becomes the actuator's own where that is needed.
            order: what is ordered, of MODE_OFF, MODE_ON and MODE_HOLD.
            now_ns: instant of the cycle.
        """
        if not self._present:
            return MODE_OFF
        try:
            self._actuator.read_output(self.has)
            self._known = True
        except DriverError as e:
            if self.takes_over or not self._known:
                self._trouble.failed(str(e))
                return order | OUTPUT_TROUBLE
        if self.takes_over:
            return self._taken_over(step)
        if self._resumable is not None and (stopped := self._resumable.must_resume):
            self._failed = True
            self._trouble.failed(stopped)
        if step is not self._step:
            self._step, self._told = step, step.output_of(step.state)
        told = self._told
        confirmed = told.tobytes() == self.has.tobytes()
        if confirmed and not self._failed:
            self._well()
            return order
        if self._unconfirmed_ns is None:
            self._unconfirmed_ns = now_ns
        for_ns = now_ns - self._unconfirmed_ns
        changed = lost(told, self.has, step.units_in(self._period_s), "the last command was")
        self._far = bool(changed)
        if not self._failed and not self._in_trouble and for_ns <= PATIENCE_NS:
            return order | OUTPUT_UNCONFIRMED
        if not self._failed:
            self._trouble.failed(f"has {self.has.tolist()}, {for_ns * 1e-9:.1f} s after the command {told.tolist()}")
        begins, self._in_trouble = not self._in_trouble, True
        if changed:
            self._waiting.failed(changed)
        if changed or (begins and self._failed and not confirmed):
            step.resume(self.has)
            self._far = False
            return MODE_TAKEN_OVER | OUTPUT_TROUBLE
        return order | OUTPUT_TROUBLE

    def send(self, output: IntArray) -> None:
        """Command the cycle's output, where that is not too far from what the actuator has."""
        if self.takes_over or self._far or not self._known:
            return
        try:
            self._actuator.apply(output)
            self._failed = False
        except DriverError as e:
            self._failed = True
            self._trouble.failed(str(e))

    def _taken_over(self, step: Step) -> int:
        """Go on from what the actuator has; wait for an order where it should have had something else."""
        step.resume(self.has)
        self.takes_over = self._failed = False
        self._well()
        if self._expected is not None and self._allowed is not None:
            why = lost(self._expected, self.has, self._allowed)
            if why:
                self._waiting.failed(why)
        return MODE_TAKEN_OVER

    def _well(self) -> None:
        self._in_trouble = self._far = self._trouble.now = False
        self._unconfirmed_ns = None
