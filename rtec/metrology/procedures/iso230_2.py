"""Positioning of a linear axis after ISO 230-2: accuracy, repeatability and reversal, coverage factor 2.

x_ij: actual minus target position at target i (m of them) in cycle j (n of them); ↑ approached in the positive
direction, ↓ in the negative one. All in µm. Figures that need both directions are None where only one was measured.

The standard counts all scatter at a target as repeatability. When the axis warms up during the test, whole cycles move,
which is not scatter: one cycle has the same deviation at every target. A two-way layout separates them:
`x_ij - x̄_i = zero of cycle j + stretch of cycle j × position + rest`.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import MeasurementError
from rtec.metrology.measurement import Measurement
from rtec.result import Result
from rtec.wording import percent

SURE = 0.01
"""Accepted false-positive rate for a drift from scatter alone."""


@dataclass(frozen=True)
class CycleDrift:
    """Movement of whole cycles.

    Attributes:
        cycle_um: mean of x_ij - x̄_i over all targets and directions, one a cycle, (n,).
        stretch_um_per_m: slope of x_ij - x̄_i over position, one a cycle, (n,); zeros for one target.
        range_um: largest minus smallest cycle mean.
        stretch_range_um_per_m: the same for the slopes.
        p: probability that scatter alone gives cycle means this far apart (F test of the two-way layout).
        p_stretch: the same for the slopes; 1 where they cannot be tested.
        R_um: largest 4 s_i of any one direction.
        R_without_um: the same without the cycle means.
        R_without_stretch_um: the same without cycle means and slopes.
        share: share of the squared scatter that significant movements of whole cycles explain.
        words: the result, in one or two sentences.
    """

    cycle_um: Floats
    stretch_um_per_m: Floats
    range_um: float
    stretch_range_um_per_m: float
    p: float
    p_stretch: float
    R_um: float
    R_without_um: float
    R_without_stretch_um: float
    share: float
    words: str

    @property
    def is_drift(self) -> bool:
        """Whether the cycles move significantly more than scatter explains."""
        return min(self.p, self.p_stretch) < SURE


def cycle_drift(target_mm: Floats, directions: Sequence[Floats]) -> CycleDrift | None:
    """Separate drift from repeatability.

    Args:
        target_mm: (m,).
        directions: deviations µm, (m, n) each.

    Returns:
        The drift; None where readings are missing or there are fewer than two cycles or targets.
    """
    x = np.concatenate(list(directions)) if directions else np.zeros((0, 0))
    if x.size == 0 or np.isnan(x).any() or x.shape[1] < 2 or len(x) < 3:
        return None
    rows, cycles = x.shape
    place = np.tile(target_mm - target_mm.mean(), len(directions))
    off = x - x.mean(axis=1, keepdims=True)
    means = off.mean(axis=0)
    size = float(place @ place)
    slopes = place @ off / size if size > 0 else np.zeros(cycles)
    level = off - means
    flat = level - np.outer(place, slopes)
    free = (cycles - 1, (rows - 1) * (cycles - 1), (rows - 2) * (cycles - 1))
    p = _chance(rows * float(means @ means), free[0], float((level**2).sum()), free[1])
    p_stretch = _chance(size * float(slopes @ slopes), free[0], float((flat**2).sum()), free[2]) if size > 0 else 1.0
    total = float((off**2).sum())
    parts = (rows * float(means @ means), size * float(slopes @ slopes))
    return _drift_of(
        means,
        slopes * 1e3,
        float(np.ptp(target_mm)),
        (p, p_stretch),
        (_largest(off, cycles - 1), _largest(level, free[1] / rows), _largest(flat, free[2] / rows)),
        (parts[0] / total, parts[1] / total) if total > 0 else (0.0, 0.0),
    )


def _largest(residual: Floats, free: float) -> float:
    """Largest 4 s_i; `free`: degrees of freedom of one target."""
    return float(4 * np.sqrt((residual**2).sum(axis=1) / free).max()) if free > 0 else float("nan")


def _chance(between: float, free_between: int, within: float, free_within: int) -> float:
    """Probability of an F value at least this large from scatter alone."""
    from scipy.special import fdtrc

    if between <= 0.0 or free_within <= 0:
        return 1.0
    if within <= 0.0:
        return 0.0
    return float(fdtrc(free_between, free_within, between / free_between / (within / free_within)))


def _drift_of(
    means: Floats,
    slopes: Floats,
    travel_mm: float,
    chances: tuple[float, float],
    repeat: tuple[float, float, float],
    shares: tuple[float, float],
) -> CycleDrift:
    spread, stretch = float(np.ptp(means)), float(np.ptp(slopes))
    p, p_stretch = chances
    share = sum(s for s, chance in zip(shares, chances, strict=True) if chance < SURE)
    moves = []
    if p < SURE:
        moves.append(f"zero moves by {spread:.2f} µm ({_trend(means)})")
    if p_stretch < SURE:
        moves.append(f"scale by {stretch * travel_mm * 1e-3:.2f} µm over the {travel_mm:g} mm ({_trend(slopes)})")
    if moves:
        left = repeat[2] if p_stretch < SURE else repeat[1]
        words = (
            f"The cycles move as a whole: {' and '.join(moves)}. That is {percent(share)} of the squared scatter at "
            f"the targets. Unidirectional repeatability is {repeat[0]:.2f} µm as the standard counts it, and "
            f"{left:.2f} µm with the drift taken out."
        )
        if not any("every" in m for m in moves):
            words += " It goes both ways: the machine warmed and cooled, or a mount is loose, or a reference is lost."
    else:
        words = (
            f"The cycles do not drift beyond their scatter (cycle means within {spread:.2f} µm, p = {p:.2f}), so the "
            "repeatability contains no drift."
        )
    return CycleDrift(means, slopes, spread, stretch, p, p_stretch, *repeat, share, words)


def _trend(values: Floats) -> str:
    steps = np.diff(values)
    if (steps > 0).all():
        return "rising in every cycle"
    if (steps < 0).all():
        return "falling in every cycle"
    return "not all one way"


SAME_PHASE = 0.02
"""Targets have the same periodic error if their phases within the pitch differ by less than this share of it."""


@dataclass(frozen=True)
class Visits:
    """Deviations at the targets of one axis.

    Attributes:
        name: name of the file or measurement.
        target_mm: (m,), rising.
        up_um, down_um: deviations by direction of approach, (m, n); NaN where a reading is missing; a direction that
            was not measured is all NaN.
        notes: dropped readings and unusual properties, in words.
    """

    name: str
    target_mm: Floats
    up_um: Floats
    down_um: Floats
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class OneDirection:
    """Figures of one direction of approach, µm.

    Attributes:
        mean_um: x̄_i = Σ_j x_ij / n, (m,).
        s_um: s_i = sqrt( Σ_j (x_ij - x̄_i)² / (n - 1) ), (m,).
        R_i_um: R_i = 4 s_i, (m,).
        E_um: systematic deviation, max x̄_i - min x̄_i.
        R_um: repeatability, max R_i.
        A_um: accuracy, max(x̄_i + 2 s_i) - min(x̄_i - 2 s_i).
    """

    mean_um: Floats
    s_um: Floats
    R_i_um: Floats
    E_um: float
    R_um: float
    A_um: float


@dataclass(frozen=True)
class TwoWay:
    """Figures of both directions together, µm.

    Attributes:
        mean_um: x̄_i = (x̄_i↑ + x̄_i↓) / 2, (m,).
        B_i_um: reversal at a target, x̄_i↑ - x̄_i↓, (m,).
        B_um: reversal of the axis, max |B_i|.
        B_mean_um: Σ B_i / m, with its sign.
        M_um: mean systematic deviation, max x̄_i - min x̄_i.
        E_um: systematic deviation, max(x̄_i↑, x̄_i↓) - min(x̄_i↑, x̄_i↓) over all targets and both directions.
        R_i_um: max(2 s_i↑ + 2 s_i↓ + |B_i|, R_i↑, R_i↓), (m,).
        R_um: max R_i.
        A_um: max(x̄_i↑ + 2 s_i↑, x̄_i↓ + 2 s_i↓) - min(x̄_i↑ - 2 s_i↑, x̄_i↓ - 2 s_i↓).
    """

    mean_um: Floats
    B_i_um: Floats
    B_um: float
    B_mean_um: float
    M_um: float
    E_um: float
    R_i_um: Floats
    R_um: float
    A_um: float


@dataclass(frozen=True)
class Positioning:
    """The result for one axis; `warnings` are sentences for the user."""

    visits: Visits
    up: OneDirection | None
    down: OneDirection | None
    both: TwoWay | None
    drift: CycleDrift | None
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class PositioningTests(Result):
    """Positioning of one or more axes after ISO 230-2.

    Attributes:
        tests: in the order of the files.
        notes: notes of the measurements, by name: what is missing in them, and what was accepted.
    """

    page_maker: ClassVar[str] = "rtec.report.procedures:iso230_page"

    tests: tuple[Positioning, ...]
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return self.own()

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """One row a target of each test."""
        return [
            {"test": r.visits.name, "target_mm": target, **_at_target(r, i)}
            for r in self.tests
            for i, target in enumerate(r.visits.target_mm)
        ]


def _at_target(r: Positioning, i: int) -> dict[str, float]:
    """The figures of one target, µm."""
    out: dict[str, float] = {}
    for name, way in (("up", r.up), ("down", r.down)):
        if way:
            out |= {f"mean_{name}_um": float(way.mean_um[i]), f"s_{name}_um": float(way.s_um[i])}
    return out | ({"B_um": float(r.both.B_i_um[i]), "R_um": float(r.both.R_i_um[i])} if r.both else {})


def positioning(visits: Visits, pitch_mm: float | None = None) -> Positioning:
    """The figures of ISO 230-2, the drift between cycles, and warnings.

    Args:
        visits: deviations; every target needs at least two readings in each measured direction.
        pitch_mm: pitch of the screw or scale; None where there is none or it is unknown.

    Raises:
        MeasurementError: there are no readings, or a target has fewer than two in one direction.
    """
    up, down = (one_way(visits, x) for x in (visits.up_um, visits.down_um))
    if up is None and down is None:
        raise MeasurementError(f"{visits.name}: no readings")
    both = two_way(up, down) if up and down else None
    drift = cycle_drift(visits.target_mm, [x for x in (visits.up_um, visits.down_um) if not np.isnan(x).all()])
    warnings = [*visits.notes, *_few(visits), *hidden_period(visits.target_mm, pitch_mm)]
    if both is None:
        warnings.append("Only one direction of approach was measured: no reversal value and no bidirectional figures.")
    if drift is None:
        warnings.append("Cycles are not all complete: drift between them is not separated from repeatability.")
    return Positioning(visits, up, down, both, drift, tuple(warnings))


def one_way(visits: Visits, x_um: Floats) -> OneDirection | None:
    """Figures of one direction from deviations (m, n); None where it was not measured."""
    known = ~np.isnan(x_um)
    if not known.any():
        return None
    count = known.sum(axis=1)
    if (count < 2).any():
        target = visits.target_mm[int(np.argmin(count))]
        raise MeasurementError(
            f"{visits.name}: target {target:g} mm has {int(count.min())} reading(s) in one direction; "
            "a standard deviation needs two, ISO 230-2 asks for five"
        )
    mean = np.nanmean(x_um, axis=1)
    s = np.nanstd(x_um, axis=1, ddof=1)
    high, low = mean + 2 * s, mean - 2 * s
    return OneDirection(
        mean, s, 4 * s, float(mean.max() - mean.min()), float(4 * s.max()), float(high.max() - low.min())
    )  # fmt: skip


def two_way(up: OneDirection, down: OneDirection) -> TwoWay:
    """Figures of both directions together."""
    mean, reversal = (up.mean_um + down.mean_um) / 2, up.mean_um - down.mean_um
    means = np.stack([up.mean_um, down.mean_um])
    s = np.stack([up.s_um, down.s_um])
    repeat = np.max([2 * s.sum(axis=0) + np.abs(reversal), up.R_i_um, down.R_i_um], axis=0)
    return TwoWay(
        mean_um=mean,
        B_i_um=reversal,
        B_um=float(np.abs(reversal).max()),
        B_mean_um=float(reversal.mean()),
        M_um=float(mean.max() - mean.min()),
        E_um=float(means.max() - means.min()),
        R_i_um=repeat,
        R_um=float(repeat.max()),
        A_um=float((means + 2 * s).max() - (means - 2 * s).min()),
    )


SEEN_ALL_ROUND = 0.4
"""The periodic error shows if no gap between the targets' phases is larger (two phases: a half, three: a third)."""


def hidden_period(target_mm: Floats, pitch_mm: float | None) -> list[str]:
    """A warning where the targets have only one or two phases within the pitch."""
    if pitch_mm is None or len(target_mm) < 2:
        return []
    phase = np.sort(np.mod((target_mm - target_mm[0]) / pitch_mm, 1.0))
    gaps = np.diff(np.append(phase, phase[0] + 1.0))
    places = max(1, int((gaps > SAME_PHASE).sum()))
    # Dense targets have no gap: they cover the whole pitch.
    if places > 2 or gaps.max() < SEEN_ALL_ROUND:
        return []
    where = "multiples of the pitch" if places == 1 else "multiples of half the pitch"
    return [
        f"Targets are {where} ({pitch_mm:g} mm) apart: error that repeats with each pitch is hidden, whatever its "
        "size. Add a dense run over one or two pitches, or targets that are no multiples."
    ]


def _few(visits: Visits) -> list[str]:
    cycles, targets = visits.up_um.shape[1], len(visits.target_mm)
    out = []
    if cycles < 5:
        out.append(f"{cycles} cycles: ISO 230-2 asks for five; s and all that contains it are less certain.")
    if targets < 5:
        out.append(f"{targets} targets: ISO 230-2 asks for five at least on an axis up to 2 m.")
    missing = sum(int(np.isnan(x).sum()) for x in (visits.up_um, visits.down_um) if not np.isnan(x).all())
    if missing:
        out.append(f"{missing} readings are missing; their targets' figures come from fewer cycles.")
    return out


SAME_TARGET_MM = 0.001
OFTEN = 0.95
"""Share of the places that come again, below which positions are taken for logged ones."""
LARGEST_MM = 0.5
"""Largest scatter of logged positions about their target, mm."""
APART = 3.0
"""Targets whose positions scatter are farther apart than the widest of them by this factor."""


def visits_of(measurement: Measurement) -> Visits:
    """Visits of the targets of a laser_linear measurement; its readings are actual minus nominal along the axis.

    Raises:
        MeasurementError: the instrument has no axis, or the measurement lacks that axis or `reading_um`.
    """
    name, axis = measurement.name, measurement.instrument.axis
    if axis is None or axis not in measurement.machine.axis_names:
        raise MeasurementError(f"{name}: ISO 230-2 needs one axis of the machine; the measurement names {axis!r}")
    channel = measurement.machine.axis(axis)
    if channel.channel not in measurement.channels or "reading_um" not in measurement.readings:
        raise MeasurementError(f"{name}: needs the columns {channel.channel}_mm and reading_um")
    direction = measurement.state().value(channel.direction_channel)
    reading = measurement.readings["reading_um"]
    return stops(name, measurement.channels[channel.channel], direction, measurement.run, reading)


def stops(name: str, position_mm: Floats, direction: Floats, run: Ints, reading_um: Floats) -> Visits:
    """Group rows, in order of time, into visits.

    Consecutive rows at one target, in one direction and run, are one stop; their mean counts. The k-th visit of a
    target in one direction belongs to cycle k. Positions that were logged rather than commanded scatter about their
    target: where few come again, those that clearly lie together are one target.

    Args:
        name: for messages.
        position_mm: commanded position, (n,).
        direction: direction of approach, -1, 0, +1, (n,).
        run: (n,).
        reading_um: (n,); NaN where there is none.

    Raises:
        MeasurementError: there is no usable visit.
    """
    target = _targets(position_mm, SAME_TARGET_MM)
    notes: tuple[str, ...] = ()
    first = _stops(target, direction, run)
    # A chain of logged positions, each within 1 µm of the next, is longer than a target of commanded ones.
    scatters = float(np.abs(position_mm - target).max(initial=0.0)) > SAME_TARGET_MM
    odd = scatters or _come_again(target[first], direction[first]) < OFTEN
    if odd and (wider := _scatter_mm(position_mm)):
        target = _targets(position_mm, wider)
        first = _stops(target, direction, run)
        notes = (f"Positions of one target differ by up to {1000 * wider:.3g} µm; they count as one target.",)
    means = [_mean(part) for part in np.split(reading_um, first[1:])]
    found: dict[tuple[float, int], list[float]] = {}
    for i, value in zip(first, means, strict=True):
        found.setdefault((float(target[i]), int(direction[i])), []).append(value)
    return _table(name, found, notes)


def _table(name: str, found: dict[tuple[float, int], list[float]], known: tuple[str, ...]) -> Visits:
    """Visits of all targets that were approached often enough; the others are in the notes."""
    ways = [d for d in (1, -1) if any(len(v) > 1 for (_, way), v in found.items() if way == d)]
    targets = sorted({t for t, _ in found})
    kept = [t for t in targets if ways and all(np.isfinite(found.get((t, d), [])).sum() > 1 for d in ways)]
    if not kept:
        raise MeasurementError(
            f"{name}: no target was approached twice from the same side; ISO 230-2 needs repeated cycles"
        )
    notes = list(known)
    left = sorted(set(targets).difference(kept))
    if left:
        some = ", ".join(f"{round(t, 3):g}" for t in left[:6]) + (", …" if len(left) > 6 else "")
        notes.append(
            f"{len(left)} places were not approached twice from {'both sides' if len(ways) == 2 else 'one side'} "
            f"and are left out: {some} mm."
        )
    if any(d == 0 for _, d in found):
        notes.append("The first place has no direction of approach and its first reading is left out.")
    cycles = max(len(found[t, d]) for t in kept for d in ways)
    grid = {d: np.full((len(kept), cycles), np.nan) for d in (1, -1)}
    for d in ways:
        for i, t in enumerate(kept):
            grid[d][i, : len(found[t, d])] = found[t, d]
    return Visits(name, np.array(kept), grid[1], grid[-1], tuple(notes))


def _scatter_mm(position_mm: Floats) -> float | None:
    """The widest scatter of positions about a target, mm; None where the targets do not show clearly."""
    rising = np.sort(position_mm)
    gaps = np.sort(np.diff(rising))
    clear = (gaps[:-1] > SAME_TARGET_MM) & (gaps[1:] > APART * gaps[:-1])
    for gap in gaps[:-1][clear]:
        parts = np.split(rising, np.flatnonzero(np.diff(rising) > gap) + 1)
        widest = max(float(np.ptp(part)) for part in parts)
        apart = min(float(b[0] - a[-1]) for a, b in itertools.pairwise(parts))
        if widest > LARGEST_MM:
            return None
        if apart > APART * widest:
            return widest
    return None


def _stops(target: Floats, direction: Floats, run: Ints) -> Ints:
    """The first row of each stop."""
    change = np.ones(len(target), bool)
    change[1:] = (np.diff(target) != 0) | (np.diff(direction) != 0) | (np.diff(run) != 0)
    return np.flatnonzero(change)


def _come_again(target: Floats, direction: Floats) -> float:
    """Share of the places that are visited twice or more from one side; one row a stop."""
    places, often = np.unique(np.stack([target, direction]), axis=1, return_counts=True)
    return len(np.unique(places[0, often > 1])) / len(np.unique(places[0]))


def _targets(position_mm: Floats, same_mm: float) -> Floats:
    """Target of each position, (n,): positions of the same target get the same value."""
    order = np.argsort(position_mm, kind="stable")
    rising = position_mm[order]
    group = np.concatenate([[0], np.cumsum(np.diff(rising) > same_mm)])
    ends = np.searchsorted(group, np.arange(group[-1] + 2))
    middle = rising[(ends[:-1] + ends[1:] - 1) // 2]
    out = np.empty_like(position_mm)
    out[order] = middle[group]
    return out


def _mean(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
