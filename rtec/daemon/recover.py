"""What a start takes over: the output from the actuator, everything else from the kept state.

Ledger: the actuator's own report counts. An actuator that cannot report has its last command, which the kept state has.
The step's memory comes from the kept state, too: directions of the axes and lags of temperatures go on. Whatever may
have changed meanwhile is forgotten: the direction of an axis that moved, and every instant after a restart of the
computer. An ordered hold or fade stays, however the run ended; after one that did not end in order, any ordered mode.

An actuator that lost its ledger meanwhile has restarted: its counts may have another meaning now. The loop then waits
for the order to resume. After a run that ended in order an offset register may also begin the day at zero: no count
depends on what it was. A ledger beyond the stop limit waits for the order in any case (`rtec.loop.output.beyond`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rtec.arrays import Bools, Ints
from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON
from rtec.loop.output import in_words, lost
from rtec.loop.ports import HOLDS
from rtec.loop.state import Saved, structure_of, units_of
from rtec.loop.step import Step
from rtec.text import joined
from rtec.wording import TO_RESUME

WAITED: Final = "the run before was stopped while it waited for an order to resume"


@dataclass(frozen=True)
class AtStart:
    """The state of devices and files at the start.

    Attributes:
        saved: the state of the run before; None where there is none.
        new_boot: the computer has restarted since: the instants in the kept state are void.
        slack_s: the kept state may be older than the actuator's last command by this much.
        output: the output that the actuator reports; None where it cannot report.
        counts: raw counts now; None where they cannot be read yet.
        start_mode: the run file's mode.
        damaged: a state was kept that cannot be read any more: where it is and what that means; "" where it can.
        one_way: the actuator cannot report its output, so only the kept state has its last command.
        inserts: the actuator inserts counts, and takes the order to resume: with its ledger it loses what they mean.
    """

    saved: Saved | None
    new_boot: bool
    slack_s: float
    output: Ints | None
    counts: Ints | None
    start_mode: int
    damaged: str = ""
    one_way: bool = False
    inserts: bool = False


@dataclass(frozen=True)
class Start:
    """The beginning of a run.

    Attributes:
        output: the ledger at the beginning.
        expected: output that the actuator should have, where it has not reported yet; None: any.
        or_zero: it may have nothing, too.
        mode: the mode at the beginning.
        waits: why the order to resume is needed first; "" where it is not.
        notes: what was taken over, in words.
        sequence: the kept state's, from which numbering goes on.
    """

    output: Ints
    mode: int
    waits: str = ""
    notes: list[str] = field(default_factory=list)
    sequence: int = 0
    expected: Ints | None = None
    or_zero: bool = False


def recover(step: Step, at_start: AtStart) -> Start:
    """Restore the end of the run before in a fresh step, and give the beginning of the next run. Nothing moves."""
    saved = at_start.saved
    if saved is None or saved.units != units_of(step):
        return _without_run_before(step, at_start)
    if saved.structure == structure_of(step) and not at_start.new_boot:
        step.restore(saved.state)
        step.recompute_slow_part()  # its coefficients may have changed
        step.forget_directions(_moved(step, saved, at_start.counts), at_start.counts)
    output = saved.output if at_start.output is None else at_start.output
    if not np.array_equal(step.output_of(step.state), output):
        step.resume(output)
    else:
        step.rest()
    trusts = saved.clean and not at_start.inserts
    waits = _why_wait(step, at_start, saved, output, or_zero=trusts)
    expected = saved.output if at_start.output is None and not waits else None
    mode = _mode(saved, at_start.start_mode)
    if saved.clean:
        stays = saved.structure == structure_of(step) and mode != at_start.start_mode  # not that of a sign check
        mode, notes = (mode, [ORDER_STAYS.format(NAMES[mode])]) if stays else (at_start.start_mode, [])
    else:
        notes = [_note(step, saved, output, mode)]
    return Start(output, mode, waits, notes, saved.sequence, expected, or_zero=trusts)


NAMES = {MODE_OFF: "off", MODE_ON: "on", MODE_HOLD: "hold"}
ORDER_STAYS = "mode {!r} was ordered before the run ended, and stays; `rtec ctl enable` ends it"


def _mode(saved: Saved, start_mode: int) -> int:
    """The ordered mode; that of the run file where it was changed meanwhile, or "on" was ordered and the run ended."""
    if saved.start_mode != start_mode or saved.mode not in NAMES:
        return start_mode
    return start_mode if saved.clean and saved.mode == MODE_ON else saved.mode


def _without_run_before(step: Step, at_start: AtStart) -> Start:
    """Beginning without the run before, which cannot be used; with a note where something was lost by that."""
    saved = at_start.saved
    output = np.zeros(len(step.layout.axes), np.int64) if at_start.output is None else at_start.output
    step.resume(output)
    why = at_start.damaged if saved is None else ""
    if saved is not None and (saved.output.any() if at_start.one_way else not saved.clean):
        why = "the run before had other axes, counts_per_mm or output units"
    waits = (
        f"{why}; nobody knows what the actuator has: check a known position; {HOLDS}"
        if why and at_start.one_way
        else ""
    )
    notes = [f"{why}; the ledger is taken from the actuator, the mode from the run file"] if why and not waits else []
    return Start(output, at_start.start_mode, waits, notes, 0 if saved is None else saved.sequence)


def _moved(step: Step, saved: Saved, counts: Ints | None) -> Bools:
    """Axes that have moved since; their direction is unknown."""
    if counts is None:
        return np.ones(len(step.layout.axes), np.bool_)
    mm = np.abs(counts - saved.counts) / step.constants("counts_per_mm")
    return np.asarray(mm > step.constants("dead_band"), np.bool_)


def _why_wait(step: Step, at_start: AtStart, saved: Saved, output: Ints, or_zero: bool) -> str:
    """Why an order is needed; "" where it is not."""
    if saved.waits and not or_zero:
        return f"{WAITED}{f': {saved.why}' if saved.why else ''}; {HOLDS}"
    return lost(step, saved.output, output, allowed(step, at_start.slack_s), or_zero=or_zero)


def why_waits(reasons: Mapping[str, Sequence[str]]) -> str:
    """What a loop waits for an order to resume about, from the present failures by device; as the next start says it.

    A wait that an earlier run began is about what it was about then.
    """
    out = []
    for device, texts in reasons.items():
        for text in (t for t in texts if TO_RESUME in t):
            said = "; ".join(clause for clause in text.split("; ") if TO_RESUME not in clause)
            if said != WAITED:
                out.append(said.partition(f"{WAITED}: ")[2] or f"device {device}: {said}")
    return joined(out)


def allowed(step: Step, slack_s: float) -> Ints:
    """Largest difference, by axis, between two ledgers that are `slack_s` apart in time."""
    return np.asarray(step.units_in(slack_s) + step.constants("quantum"), np.int64)


def _note(step: Step, saved: Saved, output: Ints, mode: int) -> str:
    how = "waited for an order to resume" if saved.waits else "did not end in order"
    return (
        f"the run before {how}: its ledger ({in_words(step, output)}) and mode {NAMES[mode]!r} were taken over (its "
        f"last command was {in_words(step, saved.output)})"
    )
