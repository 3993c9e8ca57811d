"""What happened in one record: a zero that moved, lost counts, a drift with its time.

The clock of a record starts with it, so no model for other days can hold such a term. It is taken as an unknown of its
record, like the zero of an instrument, and reported with what to do.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.result import Finding
from rtec.effects import Effect
from rtec.estimation import floor
from rtec.estimation.gls import solve
from rtec.estimation.readings import Readings
from rtec.machine import Machine
from rtec.wording import ERROR_UNITS, significant

SHARE = 0.5
"""A file has an event if its own is at least this share of the largest of all files."""
BEFORE_S = 1.0
"""An instant is at most this long before the reading that a step to it has reached: the step takes a second."""
WHAT = (
    "was the display zeroed again, the set-up touched, or were counts lost? If the zero moved, give the two parts as "
    "two files; if counts were lost, move home and measure again"
)


@dataclass(frozen=True)
class RecordEvent:
    """A term of one record.

    Attributes:
        label: of the effect that describes it.
        measurement: name of the record.
        time_s: instant since the start of the record; None for a change that goes on.
        size: of the jump, with sign, or root mean square of the change, in the unit of the readings, µm or µrad.
        message: in words, without a full stop.
    """

    label: str
    measurement: str
    time_s: float | None
    size: float
    message: str


def of_record(effect: Effect, machine: Machine) -> bool:
    """Whether an effect reads the time of a record."""
    return "time_s" in effect.channels(machine)


def has_instant(finding: Finding) -> bool:
    """Whether an effect of the time is a step at an instant."""
    return any(n.startswith("t0") for n in finding.theta)


def note_of(effect: Effect) -> str:
    """Warning for a user who adds an effect of the time, in words."""
    return (
        f"{effect.label} belongs to this record: it reads its time, which starts at zero in the next one. On "
        "another day the model is wrong by as much, and no loop runs with it"
    )


def taken_out(readings: Readings, left: Floats, finding: Finding) -> tuple[Readings, tuple[RecordEvent, ...]]:
    """The readings with an effect of the time as an unknown of each file that shows it, and what it is there.

    Args:
        readings: the readings.
        left: residual of the model, (m,).
        finding: the effect, with its parameters.
    """
    columns = readings.columns(finding.effect, finding.theta)
    if not has_instant(finding):  # about its mean in the record: the numbers of the model then mean the same, too
        still = [replace(s, time_s=np.full(len(s), s.time_s.mean()), _cache={}) for s in readings.states]
        columns = columns - readings.with_states(still).columns(finding.effect, finding.theta)
    parts = [_of_source(readings, columns, i) for i in range(len(readings.measurements))]
    here = [(i, c, _fitted(readings, left, c)) for i, c in enumerate(parts) if c.shape[1]]
    most = max((_rms(readings, c @ v) for _, c, v in here), default=0.0)
    kept = [(i, c, v) for i, c, v in here if _rms(readings, c @ v) >= SHARE * most > 0.0]
    if not kept:
        return readings, ()
    setup = np.concatenate([readings.setup, *(c for _, c, _ in kept)], axis=1)
    names = tuple(f"{finding.label} of {readings.measurements[i].name}" for i, c, _ in kept for _ in range(c.shape[1]))
    events = tuple(e for i, c, v in kept for e in _events(readings, finding, i, c @ v))
    return replace(readings, setup=setup, setup_names=(*readings.setup_names, *names)), events


def _of_source(readings: Readings, columns: Floats, source: int) -> Floats:
    """The columns that a file shows beside its unknowns, zero in all other files, (m, k)."""
    mine = np.zeros(len(readings))
    for s in readings.series:
        mine[s.part] = s.source == source
    out = columns * mine[:, None]
    size = np.linalg.norm(out, axis=0)
    shown = np.linalg.norm(floor.cleaned(readings, out), axis=0) > 1e-6 * np.maximum(size, 1e-300)
    return np.asarray(out[:, shown])


def _fitted(readings: Readings, left: Floats, columns: Floats) -> Floats:
    """Coefficients of columns by least squares, (k,)."""
    return np.asarray(solve(floor.cleaned(readings, columns), floor.cleaned(readings, left)))


def _rms(readings: Readings, part: Floats) -> float:
    return float(np.sqrt(np.mean(floor.cleaned(readings, part) ** 2)))


def _events(readings: Readings, finding: Finding, source: int, part: Floats) -> Iterator[RecordEvent]:
    """The event of the series of a file that shows it most, in words."""
    name = readings.measurements[source].name
    series = [s for s in readings.series if s.source == source]
    s = max(series, key=lambda one: float(np.ptp(part[one.part])))
    unit, change = ERROR_UNITS[s.unit], part[s.part]
    if not has_instant(finding):
        size = float(np.std(change))
        message = (
            f"{name}: the readings change with the time of the record by {significant(size, 2)} {unit} "
            f"({finding.label}); its clock starts at zero on another day"
        )
        yield RecordEvent(finding.label, name, None, size, message)
        return
    at = next(t for n, t in finding.theta.items() if n.startswith("t0"))
    later = s.time_s >= at - BEFORE_S
    size = float(change[later].mean() - change[~later].mean())
    run = readings.measurements[source].run[s.row]
    last, first = int(run[~later][-1]), int(run[later][0])
    where = f"in run {first}" if last == first else f"between run {last} and run {first}"
    message = (
        f"{name}: at {at:.0f} s, {where}, the readings jump by {'+' if size > 0 else '-'}{significant(abs(size), 2)} "
        f"{unit} and stay there ({finding.label}); {WHAT}"
    )
    yield RecordEvent(finding.label, name, at, size, message)


def words(events: Sequence[RecordEvent]) -> str:
    """Sentences on the events of the records; empty where there are none."""
    if not events:
        return ""
    told = " ".join(f"{e.message}." for e in events)
    which = "It is" if len(events) == 1 else "These are"
    return f"{told} {which} taken as an unknown of the record and not written into the model."
