"""Runs whose zero moved: they differ from the runs before and after, equally at all places, for no recorded reason.

The display was zeroed again, or the reflector was touched, and corrected afterwards. No effect of a machine appears and
disappears like that; an effect that is fitted to it is an artefact.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Bools, Floats, Ints, robust_sigma
from rtec.estimation.candidates import real
from rtec.estimation.contradiction import PER_MM
from rtec.estimation.readings import Readings, Series, row_codes
from rtec.metrology.instruments.base import laid
from rtec.wording import ERROR_UNITS, significant

FEW_RUNS, FEW_PLACES = 3, 5
"""Fewest runs, and fewest places that a run shares with the run before it and after it."""
MOVED, MANY_RUNS, LONGER = 0.4, 300, 1.2
"""Largest share of the runs whose zero moved; of more runs than this many, only single ones are looked at. More runs in
a row must explain this many times as much as fewer."""
LEAST, EVEN = 10.0, 0.7
"""The jump is this percentile of the changes at all places, and at least this share of their median: heat moves the
places by different amounts, a zero moves all equally."""
NOISE, USUAL, OTHERS = 10.0, 5.0, 4.0
"""A jump is at least `NOISE` times the scatter of a change at one place, and `USUAL` times the usual step of the other
runs. It makes the run `OTHERS` times farther from both neighbouring runs than any other run is from its own."""
QUIET, CHANCE = 4.0, 1e-5
"""Or a jump is `QUIET` times that scatter, if steps like those of the other runs are so large with the probability
`CHANCE`. Few steps say less about the others."""
SURE = 1.253
"""Standard error of the median of normal values, over that of their mean."""
VISIBLE = 0.75
"""The search ends at a jump below this share of `QUIET` times the scatter: none stands out then."""
RUNS_EACH, WAYS = 3, 4
"""Runs beyond the first two for each principal component of the temperatures; most of these components."""
SEEN = 1e-6
"""Columns of heat within this relative difference are one."""
STAYED = 0.5
"""The residual with a zero of its own is at most this share of that with a zero that moved once and stayed."""
FOLLOWS = 0.25
"""A channel is no reason for a jump if its other steps explain less than this share of what they would by the jump, of
either sign: the law may bend."""
OWN = 0.1
"""Least share of a zero of its own that heat cannot explain."""


@dataclass(frozen=True)
class MovedZero:
    """Consecutive runs whose zero moved, and moved back after them.

    Attributes:
        series: number of their series.
        run: number of the first of them in the file.
        last: number of the last.
        by: the jump, with sign, in the unit of the readings.
        readings: which readings they have, (m,).
        message: in words, without a full stop.
    """

    series: int
    run: int
    last: int
    by: float
    readings: Bools
    message: str


STEP = 'leave that run out, or write zero = "run" in the [setup] of the file, so that each run has a zero of its own'


def moved_zeros(readings: Readings) -> list[MovedZero]:
    """Runs that differ from the runs before and after them, equally at all places, while no recorded channel does.

    Runs with a zero of their own are excluded, and so are the first and the last: a change there may have persisted.
    """
    out = []
    for i, s in enumerate(readings.series):
        if s.nuisance.shape[1] and not np.ptp(s.nuisance, axis=0).all():
            continue  # each run has a zero of its own
        for jump in _jumps(readings, s):
            mine = np.zeros(len(readings), dtype=np.bool_)
            inside = jump.holds(s.run)
            mine[s.part] = inside
            m = readings.measurements[s.source]
            numbers = m.run[s.row[inside]]
            first, last = int(numbers[0]), int(numbers[-1])
            unit = ERROR_UNITS[s.unit]
            which, them = (f"run {first} is", "it") if first == last else (f"runs {first} to {last} are", "them")
            message = (
                f"{m.name} {s.column}: {which} {significant(abs(jump.by), 2)} {unit} apart from the runs before and "
                f"after {them}, at all places alike: was the instrument zeroed again?"
            )
            out.append(MovedZero(i, first, last, jump.by, mine, message))
    return out


@dataclass(frozen=True)
class _Jump:
    """A zero of its own of consecutive runs.

    Attributes:
        first, last: the runs, counted from zero.
        by: the zero, in the unit of the readings.
    """

    first: int
    last: int
    by: float

    def holds(self, run: Ints) -> Bools:
        """Which runs are among them."""
        return np.asarray((run >= self.first) & (run <= self.last))


@dataclass(frozen=True)
class _Changes:
    """Changes from each reading to the next one of another run at the same place.

    Attributes:
        before, after: both runs, (pairs,).
        change: change of the reading, (pairs,).
        heat: orthonormal columns of what goes with the temperatures, (pairs, columns).
        runs: number of runs.
    """

    before: Ints
    after: Ints
    change: Floats
    heat: Floats
    runs: int

    def of(self, jumps: Sequence[_Jump]) -> Floats:
        """Change that jumps make together, (pairs,)."""
        zero = np.zeros(self.runs)
        for j in jumps:
            zero[j.first : j.last + 1] += j.by
        return zero[self.after] - zero[self.before]

    def without(self, jumps: Sequence[_Jump]) -> "_Changes":
        """The same without some jumps."""
        return replace(self, change=self.change - self.of(jumps))

    @property
    def scatter(self) -> float:
        """Usual scatter of the changes into one run about their median."""
        values = self.cold(self.change)
        order = np.argsort(self.after, kind="stable")
        runs = np.split(values[order], np.flatnonzero(np.diff(self.after[order])) + 1)
        apart = [v - np.median(v) for v in runs if len(v) >= FEW_PLACES]
        return robust_sigma(np.concatenate(apart)) if apart else 0.0

    def cold(self, values: Floats) -> Floats:
        """Values without what goes with the temperatures, (pairs,)."""
        return np.asarray(values - self.heat @ (self.heat.T @ values))


def _jumps(readings: Readings, s: Series) -> list[_Jump]:
    """The jumps of a series: as few as leave none that is as large."""
    runs = int(s.run[-1]) + 1
    if runs < FEW_RUNS:
        return []
    changes = _changes(readings, s)
    found: list[_Jump] = []
    least = VISIBLE * QUIET * changes.scatter if len(changes.change) else 0.0
    while len(changes.change) and sum(j.last - j.first + 1 for j in found) < max(1.0, MOVED * runs):
        largest = _largest(changes.without(found), found)
        if largest is None or abs(largest.by) < least:
            return []
        found.append(largest)
        if all(_stands_out(changes.without([j for j in found if j is not one]), one) for one in found):
            reasons = [_has_reason(readings, s, one, changes) for one in found]
            return [] if any(reasons) else sorted(found, key=lambda j: j.first)
    return []


def _largest(changes: _Changes, known: Sequence[_Jump]) -> _Jump | None:
    """The runs whose own zero explains most of the changes, apart from known ones; None where there are none."""
    into, out_of = (_running(_sums(changes, run)) for run in (changes.after, changes.before))
    inside: Floats | None = None
    if changes.runs <= MANY_RUNS:
        inside = np.zeros((changes.runs, changes.runs))
        np.add.at(inside, (changes.before, changes.after), 1.0)
        inside = _running(_running(inside).T).T
    best, most = None, 0.0
    longest = max(1, int(MOVED * changes.runs)) if inside is not None else 1
    for extra in range(min(longest, changes.runs - 2)):
        first = np.arange(1, changes.runs - 1 - extra)
        end = first + extra + 1
        gone, come = into[end] - into[first], out_of[end] - out_of[first]
        own = np.concatenate([gone[:, :1] + come[:, :1], gone[:, 1:] - come[:, 1:]], axis=1)
        if inside is not None:
            kept = inside[end, end] - inside[first, end] - inside[end, first] + inside[first, first]
            own[:, 0] -= 2.0 * kept
        explains, by = _explained(own)
        for k in known:
            explains[(first <= k.last + 1) & (end >= k.first)] = 0.0
        at = int(np.argmax(explains))
        # Two runs that moved alike make the same first and last change as all from one to the other.
        if explains[at] > most * (LONGER if best is not None else 1.0):
            best, most = _Jump(int(first[at]), int(end[at]) - 1, float(by[at])), float(explains[at])
    return best


def _running(values: Floats) -> Floats:
    """Running sums along the first axis, from zero."""
    return np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])


def _sums(changes: _Changes, run: Ints) -> Floats:
    """Number of changes of each run, their sum, and its columns of heat, (runs, 2 + columns)."""
    values = (np.ones(len(run)), changes.cold(changes.change), *changes.heat.T)
    return np.stack([np.bincount(run, v, minlength=changes.runs) for v in values], axis=1)


def _explained(sums: Floats) -> tuple[Floats, Floats]:
    """Sum of squares that each step beside heat explains, and the step's size, (steps,) each; sums as of `_sums`."""
    left = sums[:, 0] - np.sum(sums[:, 2:] ** 2, axis=1)
    size = np.where(left > OWN * sums[:, 0], sums[:, 1] / np.maximum(left, 1e-12), 0.0)
    return size**2 * left, size


def _stands_out(changes: _Changes, jump: _Jump) -> bool:
    """Whether a jump is far larger than all that is between the other runs, and no zero that moved once and stayed."""
    before, after = changes.before, changes.after
    (once, _), whole = _explained(_sums(changes, after)), changes.cold(changes.change)
    step = changes.of([jump])
    made = changes.cold(step)
    if float(np.sum((whole - made) ** 2)) > STAYED * (float(whole @ whole) - float(once.max())):
        return False
    change = whole - made + step
    outside = ~(jump.holds(before) & jump.holds(after))
    moved = [change[(after == k) & outside] for k in range(changes.runs)]
    left = [-change[(before == k) & outside] for k in range(changes.runs)]
    steps = {k: float(np.median(d)) for k, d in enumerate(moved) if len(d) >= FEW_PLACES}
    if not steps:
        return False
    scatter = robust_sigma(np.concatenate([moved[k] - m for k, m in steps.items()]))
    into, back = jump.holds(after) & outside, jump.holds(before) & outside
    own = _apart(_all_alike(change[into]), _all_alike(-change[back]))
    mine = set(range(jump.first, jump.last + 1))
    most = max(abs(_apart(_all_alike(moved[k]), _all_alike(left[k]))) for k in range(changes.runs) if k not in mine)
    beside = {*mine, *after[back].tolist()}
    usual = [abs(m) for k, m in steps.items() if k not in beside]
    if not usual and changes.runs == FEW_RUNS:  # the runs before and after are all that there is
        usual = [abs(float(np.median(change[into])) + float(np.median(change[back])))]
    places = float(np.median([len(moved[k]) for k in steps]))
    least = min(NOISE * scatter, max(QUIET * scatter, _by_chance(usual, SURE * scatter / np.sqrt(places))))
    return bool(usual) and abs(own) > max(least, USUAL * float(np.median(usual)), OTHERS * most)


def _by_chance(usual: Sequence[float], noise: float) -> float:
    """Size that steps between runs exceed with the probability `CHANCE`.

    Args:
        usual: sizes of steps that were read.
        noise: standard error of one by the scatter of its places; a few steps may be smaller by chance.
    """
    from scipy.special import stdtrit

    if not usual:
        return np.inf
    size = max(noise, float(np.sqrt(np.mean(np.square(usual)))))
    return -size * float(stdtrit(len(usual), 0.5 * CHANCE))


def _changes(readings: Readings, s: Series) -> _Changes:
    """Changes from each reading to the next one of another run at the same place, reached from the same side.

    An artefact that was turned over between two readings lies otherwise, so there is no pair of them.
    """
    pose, state = readings.poses_mm[s.source][s.row], readings.states[s.source]
    ways = [np.sign(state.value(a.direction_channel)[s.row]) for a in readings.machine.axes]
    m = readings.measurements[s.source]
    lies = laid(m.instrument.turned(m.run))[s.row]
    place = row_codes(np.stack([*np.round(PER_MM * pose).T, *ways, lies]))
    order = np.lexsort((s.time_s, s.run, place))
    warm = _warm(readings, s)
    heat = np.concatenate([warm * at[:, None] for at in (np.ones(len(s)), *pose.T)], axis=1)[order]
    place, run, value = place[order], s.run[order], readings.values[s.part][order]
    pair = (place[1:] == place[:-1]) & (run[1:] != run[:-1])
    u, size, _ = np.linalg.svd(np.diff(heat, axis=0)[pair], full_matrices=False)
    columns = u[:, size > SEEN * size.max(initial=0.0)]
    return _Changes(run[:-1][pair], run[1:][pair], np.diff(value)[pair], columns, int(s.run[-1]) + 1)


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


def _has_reason(readings: Readings, s: Series, jump: _Jump, changes: _Changes) -> bool:
    """Whether a recorded channel differs from the runs before and after, too.

    A channel that changed as much between other runs, while the readings did not follow, is no reason.
    """
    state, before, after = readings.states[s.source], changes.before, changes.after
    mine, was_mine = jump.holds(after), jump.holds(before)
    inside = np.arange(jump.first, jump.last + 1)
    rows = [s.row[np.isin(s.run, which)] for which in (inside, before[mine & ~was_mine], after[was_mine & ~mine])]
    velocities = [a.velocity_channel for a in readings.machine.axes]
    for name in (*readings.machine.sensor_names, "spindle_rpm", "load_kg", "force_n", "feed_mm_min", *velocities):
        if name in state.channels:
            channel = np.abs(state.channels[name]) if name in velocities else state.channels[name]
            here, was, will = (float(np.nanmedian(channel[r])) for r in rows)
            by = min(here - was, here - will, key=abs)
            if (here - was) * (here - will) <= 0.0 or abs(by) <= real(readings.machine, name):
                continue
            middle = np.array([np.nanmedian(channel[s.row[s.run == k]]) for k in range(changes.runs)])
            steps = (jump.by / by) * (middle[after] - middle[before])
            if not _refuted(
                steps[~mine & ~was_mine], changes.change[~mine & ~was_mine], after[~mine & ~was_mine], jump
            ):
                return True
    return False


def _refuted(expected: Floats, change: Floats, after: Ints, jump: _Jump) -> bool:
    """Whether other steps of a channel should have moved the readings as far as the jump, and did not."""
    runs = np.unique(after)
    would, did = (np.array([np.median(v[after == k]) for k in runs]) for v in (expected, change))
    return bool(would @ would >= jump.by**2 and abs(would @ did) < FOLLOWS * (would @ would))
