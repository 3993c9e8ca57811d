"""A run whose zero moved: it differs from the runs before and after it, equally at all places, for no recorded reason.

The display was zeroed again, or the reflector was touched, and corrected afterwards. No effect of a machine appears and
disappears like that; an effect that is fitted to it is an artefact.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.candidates import real
from rtec.estimation.contradiction import PER_MM
from rtec.estimation.readings import Readings, Series, row_codes
from rtec.wording import significant

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

FEW_RUNS, FEW_PLACES = 4, 5
"""Fewest runs, and fewest places that a run shares with the run before it and after it."""
LEAST, EVEN = 10.0, 0.7
"""The jump is this percentile of the changes at all places, and at least this share of their median: heat moves the
places by different amounts, a zero moves all equally."""
NOISE, USUAL, OTHERS = 10.0, 5.0, 4.0
"""A jump is at least this many times the scatter between runs, this many times the usual step of the other runs, and
makes the run this many times farther from both neighbouring runs than any other run is from its own."""
RUNS_EACH, WAYS = 3, 4
"""Runs beyond the first two for each principal component of the temperatures; most of these components."""
SEEN = 1e-6
"""Columns of heat within this relative difference are one."""
STAYED = 0.5
"""The residual with a zero of its own is at most this share of that with a zero that moved once and stayed."""
OWN = 0.1
"""Least share of a zero of its own that heat cannot explain."""


@dataclass(frozen=True)
class MovedZero:
    """A run whose zero moved.

    Attributes:
        series: number of its series.
        run: its number in the file.
        by: the jump, with sign, in the unit of the readings.
        readings: which readings it has, (m,).
        message: in words, without a full stop.
    """

    series: int
    run: int
    by: float
    readings: NDArray[np.bool_]
    message: str


STEP = 'leave that run out, or write zero = "run" in the [setup] of the file, so that each run has a zero of its own'


def moved_zeros(readings: Readings) -> list[MovedZero]:
    """Runs that differ from both neighbouring runs, equally at all places, while no recorded channel does.

    Runs with a zero of their own are excluded, and so are the first and the last: a change there may have persisted.
    """
    out = []
    for i, s in enumerate(readings.series):
        if s.nuisance.shape[1] and not np.ptp(s.nuisance, axis=0).all():
            continue  # each run has a zero of its own
        found = _jump(readings, s)
        if found is not None:
            run, by = found
            mine = np.zeros(len(readings), dtype=np.bool_)
            mine[s.part] = s.run == run
            m = readings.measurements[s.source]
            number = int(m.run[s.row[np.argmax(s.run == run)]])
            unit = "µm" if s.unit == "um" else "µrad"
            message = (
                f"{m.name} {s.column}: run {number} is {significant(abs(by), 2)} {unit} apart from the runs before and "
                "after it, at all places alike: was the instrument zeroed again?"
            )
            out.append(MovedZero(i, number, by, mine, message))
    return out


def _jump(readings: Readings, s: Series) -> tuple[int, float] | None:
    """The run of a series whose zero moved, and the jump."""
    runs = int(s.run[-1]) + 1
    if runs < FEW_RUNS:
        return None
    before, after, measured, heat = _changes(readings, s)
    best = _best(before, after, measured, heat, runs) if len(measured) else None
    if best is None:
        return None
    r, by, change = best
    moved = [change[after == k] for k in range(runs)]
    left = [-change[before == k] for k in range(runs)]
    steps = {k: float(np.median(d)) for k, d in enumerate(moved) if len(d) >= FEW_PLACES}
    if not steps:
        return None
    scatter = 1.4826 * float(np.median(np.abs(np.concatenate([moved[k] - m for k, m in steps.items()]))))
    apart = [_apart(_all_alike(moved[k]), _all_alike(left[k])) for k in range(runs)]
    beside = {r, *after[before == r].tolist()}
    usual = [abs(m) for k, m in steps.items() if k not in beside]
    most = max(abs(a) for k, a in enumerate(apart) if k != r)
    if not usual or abs(apart[r]) <= max(NOISE * scatter, USUAL * float(np.median(usual)), OTHERS * most):
        return None
    return None if _has_reason(readings, s, r, before[after == r], after[before == r]) else (r, by)


def _best(before: Ints, after: Ints, change: Floats, heat: Floats, runs: int) -> tuple[int, float, Floats] | None:
    """The run whose own zero explains most of the changes, that zero, and the changes less the part that heat explains.

    None where no run can have one, or where a zero that moved once and stayed explains as much.
    """
    u, size, _ = np.linalg.svd(heat, full_matrices=False)
    q = u[:, size > SEEN * size.max(initial=0.0)]
    plain = change - q @ (q.T @ change)

    def sums(run: Ints) -> Floats:
        """Number of changes of each run, their sum, and its columns of heat, (runs, 2 + columns)."""
        return np.stack([np.bincount(run, c, minlength=runs) for c in (np.ones(len(run)), plain, *q.T)], axis=1)

    into, out_of = sums(after), sums(before)
    own = np.concatenate([into[:, :1] + out_of[:, :1], into[:, 1:] - out_of[:, 1:]], axis=1)[1:-1]
    (most, by), (once, _) = _explained(own), _explained(into)
    r, rest = int(np.argmax(most)), float(plain @ plain)
    if rest - most[r] > STAYED * (rest - once.max()):
        return None
    r, zero = r + 1, float(by[r])
    return r, zero, change - q @ (q.T @ (change - zero * (1.0 * (after == r) - 1.0 * (before == r))))


def _explained(sums: Floats) -> tuple[Floats, Floats]:
    """Sum of squares that each step beside heat explains, and the step's size, (steps,) each; sums as of `_best`."""
    left = sums[:, 0] - np.sum(sums[:, 2:] ** 2, axis=1)
    size = np.where(left > OWN * sums[:, 0], sums[:, 1] / np.maximum(left, 1e-12), 0.0)
    return size**2 * left, size


def _changes(readings: Readings, s: Series) -> tuple[Ints, Ints, Floats, Floats]:
    """From each reading to the next one of another run at the same place, reached from the same side: both runs, the
    change, and the columns of heat, (pairs, columns).
    """
    pose, state = readings.poses_mm[s.source][s.row], readings.states[s.source]
    ways = [np.sign(state.value(a.direction_channel)[s.row]) for a in readings.machine.axes]
    place = row_codes(np.stack([*np.round(PER_MM * pose).T, *ways]))
    order = np.lexsort((s.time_s, s.run, place))
    warm = _warm(readings, s)
    heat = np.concatenate([warm * at[:, None] for at in (np.ones(len(s)), *pose.T)], axis=1)[order]
    place, run, value = place[order], s.run[order], readings.values[s.part][order]
    pair = (place[1:] == place[:-1]) & (run[1:] != run[:-1])
    return run[:-1][pair], run[1:][pair], np.diff(value)[pair], np.diff(heat, axis=0)[pair]


def _warm(readings: Readings, s: Series) -> Floats:
    """The largest principal components of the temperatures, one for each few runs, K, (n, k)."""
    state = readings.states[s.source]
    known = [state.channels[n][s.row] for n in readings.machine.sensor_names if n in state.channels]
    table = np.array([t - t.mean() for t in known if np.isfinite(t).all()]).reshape(-1, len(s))
    ways = min((int(s.run[-1]) - 1) // RUNS_EACH, WAYS)
    strongest = np.linalg.eigh(table @ table.T)[1][:, ::-1][:, :ways]
    return np.asarray(table.T @ strongest)


def _all_alike(change: Floats) -> float:
    """Smallest common change of all places, with sign; zero where they did not all move alike."""
    if len(change) < FEW_PLACES:
        return 0.0
    middle = float(np.median(change))
    least = float(np.percentile(change * np.sign(middle), LEAST))
    return float(np.sign(middle)) * least if least > EVEN * abs(middle) else 0.0


def _apart(before: float, after: float) -> float:
    """Distance of a run from the nearer of its neighbouring runs; zero where it is between them."""
    return min(before, after, key=abs) if before * after > 0.0 else 0.0


def _has_reason(readings: Readings, s: Series, run: int, before: Ints, after: Ints) -> bool:
    """Whether a recorded channel differs from both neighbouring runs, too."""
    state = readings.states[s.source]
    rows = [s.row[np.isin(s.run, which)] for which in (run, before, after)]
    for name in (*readings.machine.sensor_names, "spindle_rpm", "load_kg", "force_n", "feed_mm_min"):
        if name in state.channels:
            here, was, will = (float(np.nanmedian(state.channels[name][r])) for r in rows)
            if (here - was) * (here - will) > 0.0 and min(abs(here - was), abs(here - will)) > real(
                readings.machine, name
            ):
                return True
    return False
