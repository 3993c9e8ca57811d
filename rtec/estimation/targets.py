"""Whether a wave along an axis predicts held-out targets, not only held-out runs over the same targets.

Every run reads the same few targets, so the error at each of them recurs in every held-out run. Among hundreds of
periods one wave fits any few numbers: it removes half of the mean square of 18 random ones. So targets are held out,
and the period is searched without them: a wave predicts them, a pattern does not.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import Effect
from rtec.effects.cyclic import CouplingMisalignment, CyclicPole, CyclicScrew, InterpolationError
from rtec.estimation.display import display_errors
from rtec.estimation.gls import solve, without_nuisance
from rtec.estimation.readings import Readings
from rtec.estimation.visible import same_place_mm
from rtec.machine import Axis

WAVES = (CyclicScrew, CouplingMisalignment, InterpolationError, CyclicPole)
FEW, MOST = 60, 400
"""Targets up to which `LEAST` holds, beyond it falls with their number; most targets that are held out in turn: a wave
that fits more of them is no pattern."""
BEND = 3
"""Degree of the curve along the axis that is fitted beside the wave."""
FOLDS = 8
LEAST = 0.2
"""Share by which a wave lowers the mean square at held-out targets; 18 random numbers exceed it once in 30."""
RIDGE = 1e-9


def targets_along(readings: Readings, axis: Axis, component: str) -> int:
    """Number of different positions along an axis at which readings see a component error."""
    return len(np.unique(_targets(readings, axis)[np.flatnonzero(readings.arms(component))]))


def _targets(readings: Readings, axis: Axis) -> Floats:
    """Number of the target of each reading along an axis, (m,)."""
    i = readings.machine.axes.index(axis)
    step_mm = min(float(same_place_mm(m)[i]) for m in readings.measurements)
    return np.concatenate([np.round(readings.poses_mm[s.source][s.row, i] / step_mm) for s in readings.series])


def _finest(readings: Readings, targets: Floats, seen: Ints) -> Ints:
    """Those of some readings that instruments of one kind took, the kind with the most targets.

    The diameters of parts have another zero than a laser along the same axis, and show the error of a radius twice.
    """
    made = [(readings.measurements[s.source].instrument, s.column) for s in readings.series]
    of = np.array([made.index(m) for m in made])[readings.series_of[seen]]
    return max((seen[of == k] for k in np.unique(of)), key=lambda rows: len(np.unique(targets[rows])), default=seen)


def predicts_targets(readings: Readings, base: Floats, effect: Effect, thetas: Sequence[Mapping[str, float]]) -> bool:
    """Whether a wave predicts held-out targets; also true for any other effect, and with more than `MOST` targets.

    A wave of known period is tested as well: several of them fit any few numbers. Where the targets differ by no more
    than the display rounds, no effect of the position alone predicts them.

    Args:
        readings: the readings.
        base: columns of the known effects, (m, p).
        effect: the candidate.
        thetas: the periods to search; one where it is known.
    """
    machine = readings.machine
    axis = next((a for a in machine.axes if (a.channel,) == effect.channels(machine)), None)
    if axis is None:
        return True
    position = np.concatenate([readings.states[s.source].value(axis.channel)[s.row] for s in readings.series])
    seen = _finest(readings, _targets(readings, axis), np.flatnonzero(readings.arms(effect.component)))
    target = np.unique(_targets(readings, axis)[seen], return_inverse=True)[1]
    count = np.bincount(target)
    left = without_nuisance(readings, readings.values - base @ solve(base, readings.values))
    mean = np.bincount(target, left[seen]) / count
    rounded = display_errors(readings, base)[np.unique(readings.series_of[seen])]
    if float(np.std(mean)) <= float(rounded.min()):
        return False
    searched = bool(effect.nonlinear(machine)) and len(thetas) > 1
    if len(count) > MOST or not (searched or isinstance(effect, WAVES)):
        return True
    if len(count) <= 2 * BEND:
        return False
    # One reading of each target represents the wave there.
    first = np.unique(target, return_index=True)[1]
    order = np.argsort(first)
    away = np.ones(len(readings.values), dtype=bool)
    away[seen[first]] = False
    once = readings.without(away)
    waves = np.stack([once.columns(effect, theta) for theta in thetas])
    return _fall(position[seen[first]][order], mean[order], waves) > LEAST * min(FEW / len(count), 1.0)


def _fall(place: Floats, mean: Floats, waves: Floats) -> float:
    """Relative fall of the squares of the means of n held-out targets by waves, (periods, n, k)."""
    around = np.polynomial.legendre.legvander(2.0 * (place - place.min()) / np.ptp(place) - 1.0, BEND)
    beside = np.broadcast_to(around, (len(waves), *around.shape))
    whole = np.concatenate(
        [beside, waves / np.maximum(np.sqrt(np.mean(waves**2, axis=1, keepdims=True)), 1e-12)], axis=2
    )
    with_it = without = 0.0
    fold = np.argsort(np.argsort(place)) % FOLDS
    for f in np.unique(fold):
        given, held = fold != f, fold == f
        gram = whole[:, given].transpose(0, 2, 1) @ whole[:, given] + RIDGE * np.eye(whole.shape[2])
        values = np.linalg.solve(gram, (whole[:, given].transpose(0, 2, 1) @ mean[given])[..., None])
        errors = mean - (whole @ values)[..., 0]
        best = int(np.argmin(np.sum(errors[:, given] ** 2, axis=1)))
        with_it += float(np.sum(errors[best, held] ** 2))
        curve = mean - around @ np.linalg.lstsq(around[given], mean[given], rcond=None)[0]
        without += float(np.sum(curve[held] ** 2))
    return 1.0 - with_it / max(without, 1e-300)
