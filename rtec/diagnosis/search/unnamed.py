"""The best shapes without a name: preselected by a screen, then fitted with the model and a re-estimated noise."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.search.screen import Projected, orthonormal
from rtec.diagnosis.search.shapes import DETAIL, FINE, LINE, Ground, Shape, Weighed, all_shapes
from rtec.estimation import floor
from rtec.estimation.display import display_errors, within_display
from rtec.estimation.gls import Fit, HeldOutGain, along_runs, bic_cost, solve
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings, looked_at
from rtec.machine import Machine
from rtec.parallel import each

RICH, LEAN, PLAIN = 10**6, 8, 3
"""Largest number of coefficients of any, simple and plain shapes."""
LEVEL = 0.25
"""Steps leave less than this share of the variance of the places."""
FEW_PLACES, LEANS, SECOND = 5, 0.05, 0.1
"""Of more places than these, all but the two that a shape explains most of show more than this share of it. The second
of these two is one of them only if it shows this share of what the first does."""
SHAPES = 4
"""Shapes without a name that are refitted from each of the two screens; half as many simple and plain ones."""


@dataclass(frozen=True)
class Shaped:
    """A shape without a name, fitted with the current model and a re-estimated noise."""

    shape: Shape
    columns: Floats
    fit: Fit
    log_evidence: float
    drop: float
    gain: float
    within: float = 0.0
    few: "FewTargets | None" = None
    """The places that carry it, where no more than two do."""

    @property
    def holds(self) -> bool:
        """Whether held-out runs are predicted better."""
        return self.gain > 0.0 and max(self.drop, self.within) > 0.0


def best_shapes(
    readings: Readings,
    base: Floats,
    noises: Sequence[Whitener],
    fit: Callable[[Floats], Fit],
    current: Fit,
    held_out_gain: Callable[[Whitener, Floats], HeldOutGain],
) -> list[Shaped]:
    """Fit the most promising shapes without a name.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        noises: each gives a screen.
        fit: fits columns and the noise together.
        current: the fit of the base alone.
        held_out_gain: what columns beside the base improve on held-out runs.

    Returns:
        Shapes that predict held-out runs better and are larger than the error of the instrument's display.
    """
    keep = looked_at(readings)
    subset = readings if keep.all() else readings.without(~keep)
    whole = Ground(readings)
    ground = whole if subset is readings else Ground(subset)

    def weighed(whitener: Whitener) -> list[Weighed]:
        thin = Whitener(subset, whitener.noises, whitener.run_variances, whitener.least)
        return all_shapes(ground, Projected.of(thin, base[keep], subset.values))

    screens = each(weighed, noises, len(readings))
    searched = math.log(max(len(screens[0]), 2))

    def shaped(w: Weighed) -> Shaped:
        columns = whole.columns(w.shape)
        found = fit(np.concatenate([base, columns], axis=1))
        evidence = found.log_likelihood - current.log_likelihood
        local = w.shape.searched if w.shape.place is not None else 0
        evidence -= bic_cost(w.count + local, len(readings)) + searched
        return Shaped(w.shape, columns, found, evidence, *held_out_gain(found.whitener, columns))

    errors = display_errors(readings, base)

    def shows(s: Shaped) -> bool:
        part = s.columns @ s.fit.values[base.shape[1] :][: s.columns.shape[1]]
        return not within_display(readings, base, part, errors) and (not s.shape.more or _in_steps(whole, base, s))

    axes = [a.channel for a in readings.machine.axes]

    def with_few(s: Shaped) -> Shaped:
        along = [c for c in s.shape.variables if c in axes]
        return replace(s, few=few_targets(readings, base, s.columns, s.fit.whitener, along))

    return [with_few(s) for s in each(shaped, _picked(screens), len(readings)) if s.holds and shows(s)]


def _in_steps(ground: Ground, base: Floats, s: Shaped) -> bool:
    """Whether sharp steps leave little of what differs from place to place.

    Every run reads the same places. The best few steps fit a part of any numbers there, and come again in every run.
    """
    readings, mask = ground.readings, ground.groups[s.shape.group]
    place = np.unique(np.round(ground.known[s.shape.over[0]][mask], 3), return_inverse=True)[1]
    count = np.bincount(place)

    def spread(columns: Floats) -> float:
        clean, values = floor.cleaned(readings, columns), floor.cleaned(readings, readings.values)
        left = (values - clean @ solve(clean, values))[mask]
        return float(np.sum((np.bincount(place, left) / count) ** 2))

    free = len(count) - 1 - len(s.shape.places) - s.shape.searched
    with_it, without = spread(np.concatenate([base, s.columns], axis=1)), spread(base)
    return free > 0 and with_it / free < LEVEL * without / (len(count) - 1)


@dataclass(frozen=True)
class FewTargets:
    """One or two places that carry all of what an error along axes explains.

    Attributes:
        channels: the axes.
        at_mm: the places, the one that carries more first, (1 or 2, axes).
        recur: whether most readings there show it, not only one.
    """

    channels: tuple[str, ...]
    at_mm: Floats
    recur: bool


def few_targets(
    readings: Readings, base: Floats, columns: Floats, whitener: Whitener, channels: Sequence[str]
) -> FewTargets | None:
    """The one or two places that carry what columns explain; None where other places show it as well.

    What one or two places carry is theirs alone, and often a single wrong reading's.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        columns: of the error, (m, k).
        whitener: the noise.
        channels: the axes that it depends on.
    """
    if not channels:
        return None
    pose = np.round(np.stack([readings.channel(c) for c in channels], axis=1), 3)
    at, place = np.unique(pose, axis=0, return_inverse=True)
    place = place.reshape(-1)
    white, values = whitener(np.concatenate([base, columns], axis=1)), whitener(readings.values)
    without, with_it = (values - c @ solve(c, values) for c in (white[:, : base.shape[1]], white))
    explained = np.bincount(place, without**2 - with_it**2)
    two = np.argsort(-explained)[:2]
    total, rest = float(explained.sum()), float(explained.sum() - explained[two].sum())
    if len(explained) <= FEW_PLACES or total <= 0.0 or rest > LEANS * total:
        return None
    two = two[explained[two] > SECOND * explained[two[0]]]
    means, middles = (np.array([f(without[place == p]) for p in two]) for f in (np.mean, np.median))
    return FewTargets(tuple(channels), at[two], bool(np.all(middles * np.sign(means) > 0.5 * np.abs(means))))


def _picked(screens: Sequence[Sequence[Weighed]]) -> list[Weighed]:
    """The best shapes of each screen that are likelier than nothing.

    Complex shapes win where the drift is assumed small, and lose again with the re-estimated noise. So some simple
    shapes are always kept.
    """
    picked: dict[tuple[str, tuple[str, ...], str, int], Weighed] = {}
    for weighed in screens:
        likely = [w for w in weighed if w.log_evidence > 0.0]
        for most, few in ((RICH, SHAPES), (LEAN, SHAPES // 2), (PLAIN, SHAPES // 2)):
            fresh = 0
            for w in (w for w in likely if w.count <= most):
                form = w.shape.place.form if w.shape.place is not None and not w.shape.more else w.shape.kind
                key = (w.shape.group, w.shape.variables, form, _richness(w))
                if fresh == few:
                    break
                if key not in picked:
                    picked[key] = w
                    fresh += 1
    return list(picked.values())


def _richness(w: Weighed) -> int:
    return PLAIN if w.count <= PLAIN else LEAN if w.count <= LEAN else RICH


def curves_of(
    top: Shaped,
    readings: Readings,
    base: Floats,
    fit: Callable[[Floats], Fit],
    current: Fit,
    held_out_gain: Callable[[Whitener, Floats], HeldOutGain],
) -> list[Shaped]:
    """The best curve over each variable of a shape; over a position also one that is opposite in both directions.

    A surface over two variables may be such a curve and an effect with a name.

    Args:
        top: the best shape.
        readings: the readings.
        base: columns of the current model, (m, p).
        fit, current, held_out_gain: as for `best_shapes`.
    """
    if top.shape.place is not None or top.shape.period is not None:
        return []
    ground, directions = Ground(readings), {a.channel: a.direction_channel for a in readings.machine.axes}
    mask, out = ground.groups[top.shape.group][:, None], list[Shaped]()

    def best(name: str, own: int, way: str | None) -> Shaped:
        made = []
        for fine in sorted({own, COARSE, LINE, DETAIL, FINE}):
            shape = Shape(top.shape.group, (name,), (fine,))
            columns = ground.columns(shape)
            if way is not None:
                columns = ground.known[way][:, None] * np.concatenate([columns, mask], axis=1)
                shape = replace(shape, over=(name, way), fine=(fine, 1))
            found = fit(np.concatenate([base, columns], axis=1))
            evidence = found.log_likelihood - current.log_likelihood
            evidence -= bic_cost(columns.shape[1], len(readings))
            made.append(Shaped(shape, columns, found, evidence, 0.0, 0.0))
        likely = max(made, key=lambda t: t.log_evidence)
        return replace(likely, **held_out_gain(likely.fit.whitener, likely.columns)._asdict())

    for name, own in zip(top.shape.over, top.shape.fine, strict=True):
        if name == "time_s" or name in directions.values():
            continue
        way = directions.get(name)
        out += [best(name, own, None), *([best(name, own, way)] if way in ground.known else [])]
    return out


def over_time(top: Shaped, readings: Readings) -> list[Floats]:
    """Columns of curves over the time, coarse and fine, where a shape reads it; empty where it does not."""
    if "time_s" not in top.shape.over:
        return []
    ground = Ground(readings)
    return [ground.columns(Shape(top.shape.group, ("time_s",), (fine,))) for fine in (COARSE, LINE, DETAIL, FINE)]


LOSES = 0.05
"""A variable is named only where a held-out mean square without it is larger by more than this share."""
COARSE = 3
"""Number of basis functions of the coarsest curve that takes the place of a surface."""


def without_idle(
    top: Shaped,
    others: Sequence[Shaped],
    readings: Readings,
    base: Floats,
    fit: Callable[[Floats], Fit],
    held_out_gain: Callable[[Whitener, Floats], HeldOutGain],
) -> Shaped:
    """The best shape, or one of only one of its variables where the other does not improve held-out runs.

    Args:
        top: the best shape.
        others: the other refitted shapes.
        readings: the readings.
        base: columns of the current model, (m, p).
        fit, held_out_gain: as for `best_shapes`.
    """
    ground = Ground(readings)
    if len(top.shape.variables) < 2:
        return _instead_of_time(top, ground, base, fit, held_out_gain)
    alone = [t for t in others if t.shape.group == top.shape.group and len(t.shape.variables) == 1]
    found = [t for t in alone if t.shape.variables[0] in top.shape.variables]
    # A fine curve over what differs mostly from run to run predicts no other run: coarser ones are tried as well.
    for name, own in zip(top.shape.over, top.shape.fine, strict=True):
        for fine in sorted({COARSE, own, LINE, FINE} - {0}):
            shape = Shape(top.shape.group, (name,), (fine,))
            columns = ground.columns(shape)
            made = fit(np.concatenate([base, columns], axis=1))
            found.append(Shaped(shape, columns, made, top.log_evidence, *held_out_gain(made.whitener, columns)))
    best = max((t for t in found if not _loses(t, top, readings.machine)), key=lambda t: t.drop, default=None)
    if best is None:
        return top
    return _instead_of_time(best, ground, base, fit, held_out_gain)


def _loses(one: Shaped, other: Shaped, machine: Machine) -> bool:
    """Whether one shape predicts held-out runs worse than another along an axis, or readings about the mean of each."""
    if not set(machine.moving_channels) & set(other.shape.variables):
        return 1.0 - one.drop > (1.0 + LOSES) * (1.0 - other.drop)
    return any(1.0 - a > (1.0 + LOSES) * (1.0 - b) for a, b in ((one.drop, other.drop), (one.within, other.within)))


NEARLY = 0.9
"""Share of the log evidence from which a shape over sensors of the axis itself is as good, if it predicts as well."""


def by_own_sensors(top: Shaped, others: Sequence[Shaped], machine: Machine) -> Shaped:
    """The best shape, or the same one over temperatures of the axis along which it acts, where that is nearly as good.

    Nuts and motors of all axes warm alike. A sensor whose name says that it is at another axis only follows them.

    Args:
        top: the best shape.
        others: the other refitted shapes.
        machine: names the sensors.
    """

    def form(t: Shaped) -> tuple[object, ...]:
        return t.shape.group, t.shape.kind, {v for v in t.shape.variables if v not in machine.sensor_names}

    def elsewhere(t: Shaped) -> int:
        axes = [a.name for a in machine.axes if a.channel in t.shape.variables]
        return sum(machine.of_another_axis(v, a) for a in axes for v in t.shape.variables if v in machine.sensor_names)

    near = [
        t
        for t in others
        if form(t) == form(top) and elsewhere(t) < elsewhere(top)
        if len(t.shape.variables) == len(top.shape.variables)
        if t.log_evidence > NEARLY * top.log_evidence and not _loses(t, top, machine)
    ]
    return max(near, key=lambda t: t.log_evidence, default=top)


RISES, AS_GOOD = 0.9, 0.6
"""From this rank correlation with time on, a temperature rises with it; it must bring this share of the gain in log
likelihood to be named in place of time."""


def _instead_of_time(
    top: Shaped,
    ground: Ground,
    base: Floats,
    fit: Callable[[Floats], Fit],
    held_out_gain: Callable[[Whitener, Floats], HeldOutGain],
) -> Shaped:
    """A temperature that rises with time in place of time where it explains about as much: time itself is no cause.

    A record that only warms up cannot distinguish the two.
    """
    if top.shape.variables != ("time_s",) or top.shape.period is not None:
        return top
    from scipy.stats import spearmanr

    without = fit(base).log_likelihood
    found = [top]
    for name in ground.readings.machine.sensor_names:
        if name not in ground.known:
            continue
        if abs(float(spearmanr(ground.known[name], ground.known["time_s"])[0])) < RISES:
            continue
        shape = Shape(top.shape.group, (name,), top.shape.fine)
        columns = ground.columns(shape)
        made = fit(np.concatenate([base, columns], axis=1))
        if made.log_likelihood - without > AS_GOOD * (top.fit.log_likelihood - without):
            found.append(Shaped(shape, columns, made, top.log_evidence, *held_out_gain(made.whitener, columns)))
    return max(found[1:], key=lambda t: t.fit.log_likelihood, default=top)


def adequacy(columns: Floats, tops: Sequence[Shaped], base: Floats, readings: Readings) -> float:
    """Part that columns explain, as a share of what the best shape explains, under the noise of each shape.

    Beside an effect along the runs a shape that reads no axis is a drift: it is nothing that could be explained.

    Args:
        columns: of the effect, (m, k).
        tops: the best shapes.
        base: columns of the current model, (m, p).
        readings: the readings.
    """
    out, moving = 1.0, set(readings.machine.moving_channels)
    if along_runs(readings, columns):
        tops = [t for t in tops if moving & set(t.shape.variables)]
    for t in tops:
        if t.log_evidence <= 0.0:
            continue
        known = Projected.of(t.fit.whitener, base, readings.values)
        mine, its = _explained(known, columns), _explained(known, t.columns)
        if its > 0.0:
            out = min(out, mine / its)
    return out


def _explained(known: Projected, columns: Floats) -> float:
    """Squares that columns explain, (m, k), less those that as many numbers explain of the noise, each of size one."""
    whole = orthonormal(known.take_out(known.whitener(columns)))
    return max(float(np.sum((whole.T @ known.left) ** 2) - whole.shape[1]), 0.0)
