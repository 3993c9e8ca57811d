"""What a start takes over: from the actuator what it says that it has, from the kept state what nobody else knows.

Ledger: the actuator's own word counts. One that cannot tell has what it was told last, and the kept state knows that.
After a run that did not end in order the mode comes from the kept state too (a hold that was ordered stays one), and
so does the step's memory: directions of the axes, lags of temperatures. What may have changed meanwhile is forgotten:
the direction of an axis that moved, every instant after the computer was started anew.

An actuator that lost its ledger meanwhile started anew itself: nobody can say whether its counts mean what they meant.
The loop then waits for the order to resume.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON
from rtec.loop.output import HOLDS, lost
from rtec.loop.state import Saved, structure_of, units_of
from rtec.loop.step import Step

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Found:
    """What is there at the start.

    Attributes:
        saved: the state of the run before; None where there is none.
        new_boot: the computer was started anew since: instants of then mean nothing.
        slack_s: the kept state may be so much older than what the actuator was told last.
        output: what the actuator says that it has; None where it cannot tell.
        counts: raw counts now; None where they cannot be read yet.
        start_mode: the run file's mode.
        damaged: a state was kept and cannot be read any more: where it is and what that means; "" where it can.
        one_way: the actuator cannot tell what it has, and what it was told last stands in the kept state alone.
    """

    saved: Saved | None
    new_boot: bool
    slack_s: float
    output: IntArray | None
    counts: IntArray | None
    start_mode: int
    damaged: str = ""
    one_way: bool = False


@dataclass(frozen=True)
class Start:
    """How to begin.

    Attributes:
        output: the ledger to begin with.
        expected: what the actuator should have, where it has not told yet and the run before did not end in order.
        mode: the mode to begin with.
        waits: why the order to resume is needed first; "" where it is not.
        notes: what was taken over, in words; nothing after a run that ended in order.
        sequence: of the kept state, to go on counting from.
    """

    output: IntArray
    mode: int
    waits: str = ""
    notes: list[str] = field(default_factory=list)
    sequence: int = 0
    expected: IntArray | None = None


def recover(step: Step, found: Found) -> Start:
    """Bring a fresh step to where the run before ended; say how to begin. Nothing moves by it."""
    saved = found.saved
    if saved is None or saved.units != units_of(step):
        return _anew(step, found)
    if saved.structure == structure_of(step) and not found.new_boot:
        step.restore(saved.state)
        step.recompute_slow_part()  # its coefficients may be others than they were
        step.forget_directions(_moved(step, saved, found.counts), found.counts)
    output = saved.output if found.output is None else found.output
    if not np.array_equal(step.output_of(step.state), output):
        step.resume(output)
    else:
        step.rest()
    if saved.clean:
        return Start(output, found.start_mode, sequence=saved.sequence)
    mode = saved.mode if saved.mode in (MODE_OFF, MODE_ON, MODE_HOLD) else found.start_mode
    if saved.start_mode != found.start_mode:  # somebody changed the run file meanwhile
        mode = found.start_mode
    waits = _why_wait(step, found, saved, output)
    expected = saved.output if found.output is None and not waits else None
    return Start(output, mode, waits, [_told(saved, output, mode)], saved.sequence, expected)


def _anew(step: Step, found: Found) -> Start:
    """Nothing of the run before can be used; say so where something was lost by it."""
    saved = found.saved
    output = np.zeros(len(step.layout.axes), np.int64) if found.output is None else found.output
    step.resume(output)
    why = found.damaged if saved is None else ""
    if saved is not None and (saved.output.any() if found.one_way else not saved.clean):
        why = "the run before had other axes, counts_per_mm or output units"
    waits = (
        f"{why}; nobody knows what the actuator has: check a known position; {HOLDS}" if why and found.one_way else ""
    )
    notes = [f"{why}; the ledger is taken from the actuator, the mode from the run file"] if why and not waits else []
    return Start(output, found.start_mode, waits, notes, 0 if saved is None else saved.sequence)


def _moved(step: Step, saved: Saved, counts: IntArray | None) -> NDArray[np.bool_]:
    """Axes that are not where they were: which way they came is not known."""
    if counts is None:
        return np.ones(len(step.layout.axes), np.bool_)
    mm = np.abs(counts - saved.counts) / step.constants("counts_per_mm")
    return np.asarray(mm > step.constants("dead_band"), np.bool_)


def _why_wait(step: Step, found: Found, saved: Saved, output: IntArray) -> str:
    """Why an order is needed; "" where it is not."""
    if saved.waits:
        return f"the run before was stopped while it waited for an order to resume; {HOLDS}"
    return lost(saved.output, output, allowed(step, found.slack_s))


def allowed(step: Step, slack_s: float) -> IntArray:
    """How far, by axis, a ledger may be off one that is so much older."""
    return np.asarray(step.units_in(slack_s) + step.constants("quantum"), np.int64)


def _told(saved: Saved, output: IntArray, mode: int) -> str:
    names = {MODE_OFF: "off", MODE_ON: "on", MODE_HOLD: "hold"}
    return (
        f"the run before did not end in order: its ledger {output.tolist()} and mode {names[mode]!r} were taken over "
        f"(it had told {saved.output.tolist()})"
    )
