"""The loop's output: the last command, the output that the actuator reports, and whether the next command may go out.

A command is absolute, so the next command makes good for a lost one, as long as it is close to the actuator's output.
So there is no new command before the actuator has confirmed the one before: the loop repeats that one, and the
correction does not move (OUTPUT_UNCONFIRMED). Whatever becomes of a command, the machine never sees a larger change
than that of one cycle.

Where the actuator fails, or does not confirm a command for a quarter of a second, the output is in trouble
(OUTPUT_TROUBLE): the correction holds, whatever is ordered, and the row has the flag. The loop takes over the ledger of
an actuator that fails. To an actuator that accepts commands without effect, it repeats the command, which differs from
the actuator's output by one cycle's change at most. The loop goes on from there, from rest, when the command was
accepted and confirmed. An actuator whose output matches no command has restarted, or something else wrote to it, or it
reads in another unit than it is commanded in: its counts may have another meaning now. The loop takes over its ledger,
commands nothing more, not even that, and waits for the order to resume. So it does at a start where the actuator has
more than the stop limit allows; after the order the correction goes back to the limit, at its slew limit.
"""

from typing import Final

import numpy as np

from rtec.arrays import Ints
from rtec.correction.flags import MODE_OFF, MODE_TAKEN_OVER, OUTPUT_TROUBLE, OUTPUT_UNCONFIRMED
from rtec.errors import DriverError
from rtec.loop.ports import HOLDS, Actuator, NoActuator, Resumable
from rtec.loop.stats import Trouble
from rtec.loop.step import Step

PATIENCE_NS: Final = 250_000_000
"""A command that the driver accepted may be unconfirmed for this long; after that the output is in trouble."""


def in_words(step: Step, output: Ints) -> str:
    """An output for people: each axis that is corrected, in µm."""
    per_um = step.constants("per_um")
    axes = zip(step.layout.axes, output.tolist(), per_um.tolist(), strict=True)
    return ", ".join(f"{axis} {units / scale + 0.0:+.2f} µm" for axis, units, scale in axes if scale)


def lost(
    step: Step,
    expected: Ints,
    has: Ints,
    allowed: Ints,
    source: str = "the run before left",
    or_zero: bool = False,
) -> str:
    """Message on an actuator whose ledger differs from the expected one by more than allowed; else "".

    `or_zero`: an axis may have nothing instead.
    """
    if ((np.abs(has - expected) <= allowed) | (or_zero & (has == 0))).all():
        return ""
    return (
        f"the actuator has {in_words(step, has)}, {source} {in_words(step, expected)}: it restarted, something else "
        f"wrote to it, or it reads in another unit, and its output may mean something else now; {HOLDS}"
    )


def beyond_stop(units: float, per_um: float, quantum: float, stop_um: float) -> bool:
    """Whether an axis' output is beyond its stop limit.

    The ledger holds whole quanta, so it may be one beyond the limit that the correction itself keeps.
    """
    return per_um != 0.0 and abs(units) - abs(per_um) * stop_um > quantum


def beyond(step: Step, output: Ints) -> str:
    """Message on an output beyond the stop limit, which is no correction within these limits; else ""."""
    stop_um = step.constants("stop")
    parts = zip(output.tolist(), step.constants("per_um"), step.constants("quantum"), stop_um, strict=True)
    over = [beyond_stop(*of_axis) for of_axis in parts]
    if not any(over):
        return ""
    limits = ", ".join(
        f"stop_um of {name} is {most:g}"
        for name, most, is_over in zip(step.layout.axes, stop_um, over, strict=True)
        if is_over
    )
    return (
        f"the actuator has {in_words(step, output)}, and {limits}: no correction within these limits. Set it back by "
        f"hand, or order it back to the limit slowly by resuming; {HOLDS}"
    )


class CommandGate:
    """The actuator as the loop sees it: reads its output, and decides whether a command may go out.

    Attributes:
        has: the output that the actuator last reported, in the sink's units, by axis.
        takes_over: its ledger must be taken over before anything is commanded.

    Args:
        actuator: the run's actuator.
        axes: number of axes.
        trouble: records what is wrong with the actuator.
        waiting: records why an order to resume is needed.
        period_ns: length of a cycle.
    """

    def __init__(self, actuator: Actuator, axes: int, trouble: Trouble, waiting: Trouble, period_ns: int) -> None:
        self.has: Ints = np.zeros(axes, dtype=np.int64)
        self.takes_over = False
        self._actuator, self._trouble, self._waiting = actuator, trouble, waiting
        self._resumable = actuator if isinstance(actuator, Resumable) else None
        self._present = not isinstance(actuator, NoActuator)
        self._period_s = period_ns * 1e-9
        self._expected: Ints | None = None
        self._allowed: Ints | None = None
        self._step: Step | None = None
        self._last = self.has
        self._known = self._failed = self._in_trouble = self._far = self._foreign = self._beyond = False
        self._or_zero = False
        self._unconfirmed_ns: int | None = None

    @property
    def waits(self) -> bool:
        """Does it wait for its ledger, or for an order to resume?"""
        return self.takes_over or self._waiting.now or bool(self._resumable and self._resumable.must_resume)

    def take_over(self, expected: Ints | None, allowed: Ints | None, or_zero: bool = False) -> None:
        """Hold and command nothing until the actuator reports its ledger; go on from that ledger.

        Args:
            expected: ledger it should have; where it differs by more than `allowed`, the loop waits for an order. None:
                any within the stop limit.
            allowed: by axis; None: it was ordered, and any ledger is accepted.
            or_zero: nothing is accepted, too, by axis.
        """
        self.takes_over, self._expected, self._allowed = self._present, expected, allowed
        self._foreign, self._or_zero = False, or_zero

    def look(self, step: Step, order: int, now_ns: int) -> int:
        """Read the actuator's output before a cycle; give the cycle's mode.

        Args:
            step: its ledger is the last command; the actuator's output replaces it where that is needed.
            order: the ordered mode: MODE_OFF, MODE_ON or MODE_HOLD.
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
            self._step, self._last = step, step.output_of(step.state)
        last = self._last
        confirmed = last.tobytes() == self.has.tobytes()
        if confirmed and not self._failed:
            self._well()
            return order | OUTPUT_TROUBLE if self._foreign and self._beyond else order
        if self._unconfirmed_ns is None:
            self._unconfirmed_ns = now_ns
        for_ns = now_ns - self._unconfirmed_ns
        changed = lost(step, last, self.has, step.units_in(self._period_s), "the last command was")
        self._far = bool(changed)
        if not self._failed and not self._in_trouble and for_ns <= PATIENCE_NS:
            return order | OUTPUT_UNCONFIRMED
        if not self._failed:
            self._trouble.failed(
                f"has {in_words(step, self.has)}, {for_ns * 1e-9:.1f} s after the command {in_words(step, last)}"
            )
        begins, self._in_trouble = not self._in_trouble, True
        if changed:
            self._foreign = True
            self._waiting.failed(changed)
        if self._foreign or (begins and self._failed and not confirmed):
            step.resume(self.has)
            self._far, self._beyond = False, bool(beyond(step, self.has))
            return MODE_TAKEN_OVER | OUTPUT_TROUBLE
        return order | OUTPUT_TROUBLE

    def send(self, output: Ints) -> None:
        """Command the cycle's output, unless it is too far from the actuator's output, or that is nobody's command."""
        if self.takes_over or self._far or self._foreign or not self._known:
            return
        try:
            self._actuator.apply(output)
            self._failed = False
        except DriverError as e:
            self._failed = True
            self._trouble.failed(str(e))

    def _taken_over(self, step: Step) -> int:
        """Go on from the actuator's output; wait for an order where another output was expected."""
        step.resume(self.has)
        self.takes_over = self._failed = False
        self._well()
        if self._allowed is not None:
            why = beyond(step, self.has)
            self._beyond = bool(why)
            if not why and self._expected is not None:
                why = lost(step, self._expected, self.has, self._allowed, or_zero=self._or_zero)
            if why:
                self._foreign = True
                self._waiting.failed(why)
        return MODE_TAKEN_OVER | OUTPUT_TROUBLE if self._foreign and self._beyond else MODE_TAKEN_OVER

    def _well(self) -> None:
        self._in_trouble = self._far = self._trouble.now = False
        self._unconfirmed_ns = None
