"""The likeliest fault of the recorded channels, where it explains the readings better than the machine does."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.doubts.edits import ABOVE, FAR_LESS, HALF, NEAR_FIT, Edit, Edits, with_channels
from rtec.estimation import floor
from rtec.estimation.candidates import library, simple_effects
from rtec.estimation.changed_delay import AS_GOOD
from rtec.estimation.columns import base_of, ordered
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Readings, Series, looked_at
from rtec.estimation.warmth import WARMER_K, of_the_fit
from rtec.estimation.wrong_scale import unit_of
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.model.history import steps_of
from rtec.wording import listed

BETTER = 0.5
"""An edit of the record is proposed where its residual is below this share of the current one,"""
NEAR_FLOOR = 1.25
"""and at most this many times the noise; edits are tried only where the residual is above `ABOVE` times that."""
NEAR_REFIT = 1.15
"""Or, for a factor, at most this many times the residual with the model's own numbers refitted."""
BY_FAR = 0.1
"""Or, for a factor, at most this share of the residual: out-of-date numbers may cause the rest."""
AGAIN, LIKE_REFIT = 0.85, 1.05
"""Or below this share of the current residual, and at most `NEAR_FIT` times what the fit left, if that was of other
readings; or, for an origin, this many times the residual with all numbers of the model refitted."""
REACHED = 1.05
"""An edit reaches the noise within this factor; where it does not, an effect that leaves `HALF` as much above it, in
squares, is clearly better."""
ALIKE = 1.5
"""Temperatures by another clock, and a factor that no unit has, are asked about where an effect leaves more than this
many times what they leave."""
MOSTLY = 0.75
"""Share, in squares, of what a refit of all numbers explains that a fault smaller than half of the residual must."""
MANY_TIMES = 3.0
"""A number of the machine is hardly more than this many times what it was, or less than the inverse."""
CHANGED = "a number of the model has changed, or the beam of a laser leans, which does as much"
AT_ONCE = 0.8
"""Share of the readings of two columns that are of the same instants, at least, where their probes may be exchanged."""
FEWEST_RUNS, BY_CHANCE = 3, 0.01
"""With fewer runs nothing tells what differs between them from a drift. Share of the records of which only the zeros,
or slopes, of the runs wander whose runs one number follows as well by chance."""


def edited_record(judged: Judgement, measured: Floats, predicted: Floats) -> Edit | None:
    """The likeliest fault of the recorded channels: the edit of the record with which the model fits far better."""
    alive = any(moves(judged.readings, s) for s in judged.readings.series)
    if judged.residual < ABOVE * judged.noise_floor or not alive:
        return None
    few = judged.readings.without(~looked_at(judged.readings))
    usual = _error_of_fit(judged.model, judged.unit, judged.readings.measurements)
    met = usual is not None and usual < NEAR_FLOOR * judged.noise_floor
    edits = Edits(judged.model, few, judged.scale)
    lost = [e for e in edits.lost(max(judged.noise_floor, usual or 0.0)) if e.residual < BETTER * judged.residual]
    lost = [e for e in lost if not _as_well(judged, e.residual)]
    factors = _factors(judged, measured, predicted, usual)
    swapped = _exchanged_readings(judged, measured, predicted, usual)
    found = min([*edits.possible(), *factors, *lost, *swapped], key=lambda e: e.residual, default=None)
    if found is None:
        return None
    near = NEAR_FLOOR * _whole_noise(judged)
    if found.kind in ("wrong_gain", "lost_sensor", "swapped_readings"):
        return found
    if found.kind in ("wrong_channel", "swapped_sensors", "moved_origin") and _new_number_does(judged, found):
        return None
    if found.kind == "swapped_sensors" and _other_sensor_does(judged, found):
        return None
    if not _runs_decide(judged, found):
        return None
    if found.kind in ("swapped_axes", "wrong_rate"):
        return found if _by_far(judged, found, usual) else None
    if found.kind == "late_temperatures" and not met:
        return _by_another_clock(judged, found, usual)
    if found.kind == "wrong_channel":
        # A refit of the numbers compensates a factor.
        near = max(near, NEAR_REFIT * judged.refitted, BY_FAR * judged.residual)
    if found.residual <= min(BETTER * judged.residual, near):
        if found.kind == "moved_origin" and found.fatal and _own_number_does(judged, found.residual):
            return replace(found, unless=CHANGED)
        drifts = found.residual > NEAR_FLOOR * judged.noise_floor
        by_effect = drifts and found.kind == "swapped_sensors" and _effect_does(judged, found)
        return None if by_effect and not _exchanged_as_in_the_fit(judged, found) else found
    return found if found.fatal and (as_in_the_fit(judged, found) or _exchanged_as_in_the_fit(judged, found)) else None


def _by_far(judged: Judgement, found: Edit, usual: float | None) -> bool:
    """Whether an edit of readings that the model was not fitted to leaves a tenth, or what the fit left, and no single
    effect does.
    """
    if any(m.fingerprint in judged.model.measurements.values() for m in judged.readings.measurements):
        return False
    near = max(BY_FAR * judged.residual, NEAR_FIT * max(usual or 0.0, judged.noise_floor))
    return found.residual <= min(BETTER * judged.residual, near) and not _as_well(judged, found.residual)


def moves(readings: Readings, s: Series) -> bool:
    """Whether the display of a series moved at all."""
    return float(np.ptp(readings.values[s.part])) > 0.0


def _by_another_clock(judged: Judgement, found: Edit, usual: float | None) -> Edit | None:
    """Late temperatures where the model never met other readings: a delay that it lacks moves them as well.

    A model that was fitted to others need not reach the noise: between the runs nobody may have read the temperatures.
    """
    fitted = any(m.fingerprint in judged.model.measurements.values() for m in judged.readings.measurements)
    near = NEAR_FLOOR * judged.noise_floor if usual is None else math.inf
    if fitted or found.residual > min(BETTER * judged.residual, near):
        return None
    # Hardly any sensor is late by whole hours.
    if (found.whole_hours and found.rival) or not _delay_does(judged, found):
        return found
    return replace(found, unless=found.rival) if found.rival else None


def as_in_the_fit(judged: Judgement, found: Edit) -> bool:
    """Whether an edit of a record leaves what the fit left, or as another place of the axis what the refitted model
    leaves; and new numbers of no single effect do, and no missing effect of one number leaves clearly less.

    An edit has one number. Several effects that all changed by just as much are less likely than a fault of the record.
    A model that was fitted to this record as it is shows no place of an axis but that of the record.
    """
    readings = judged.readings
    if any(m.fingerprint in judged.model.measurements.values() for m in readings.measurements):
        return False
    usual = _error_of_fit(judged.model, judged.unit, readings.measurements)
    met = usual is None or judged.residual < NEAR_FIT * usual or not _like_refit(judged, found)
    by_fit = 0.0 if usual is None or met else NEAR_FIT * max(usual, judged.noise_floor)
    by_refit = LIKE_REFIT * judged.refitted if found.kind in ("moved_origin", "turned_axis") else 0.0
    if found.residual > min(AGAIN * judged.residual, max(by_fit, by_refit)):
        return False

    if _as_well(judged, found.residual):
        return False
    # One that changes with time would follow a drift.
    machine = judged.model.machine
    places = {c for a in machine.axes for c in a.moving_channels}
    fixed = [judged.columns_of(e) for e in simple_effects(judged.readings) if set(e.channels(machine)) <= places]
    return not any(judged.left_beside(c) < FAR_LESS * found.residual for c in fixed)


def _like_refit(judged: Judgement, found: Edit) -> bool:
    """Whether an edit explains most of what new numbers of the whole model do."""
    before = judged.residual**2
    return before - found.residual**2 > MOSTLY * (before - judged.refitted**2)


def _own_number_does(judged: Judgement, residual: float) -> bool:
    """Whether new numbers of one effect of the model leave about as little as an edit."""
    own = (judged.left_by(judged.columns_of(f.effect, f.theta)) for f in judged.model.effects)
    return any(left < AS_GOOD * residual for left in own)


def _as_well(judged: Judgement, residual: float) -> bool:
    """Whether new numbers of one effect leave about as little as an edit, or a missing one of one number less."""
    if _own_number_does(judged, residual):
        return True
    new = (judged.left_by(judged.columns_of(e)) for e in simple_effects(judged.readings))
    return any(_clearly_less(left, residual, judged.noise_floor) for left in new)


def _runs_decide(judged: Judgement, found: Edit) -> bool:
    """Whether an edit describes more than what may differ from run to run, or differs between enough runs.

    A temperature is nearly one value in each run, and another origin changes an expansion by one zero in each. With few
    runs an edit of one number follows any drift of theirs. So the runs are counted then, not the readings.
    """
    readings, sensors = judged.readings, set(judged.model.machine.sensor_names)
    warm = set(found.channels) <= sensors
    after = Edits(judged.model, readings, judged.scale).left(found.channels)
    if not found.channels or not (warm or found.kind == "moved_origin") or after is None:
        return True
    after = floor.cleaned(readings, after)
    changed = [s for s in readings.series if np.any(after[s.part] != judged.left[s.part])]
    columns = np.concatenate(
        [_run_columns(readings, s, sloped=warm) for s in changed] or [np.zeros((len(after), 0))], axis=1
    )
    free = floor.cleaned(readings, columns)

    def squares(left: Floats) -> float:
        return judged.pooled(left) ** 2

    inside, within = (squares(left - free @ solve(free, left)) for left in (judged.left, after))
    if AS_GOOD**2 * within < inside:
        return True
    runs = sum(int(s.run[-1]) + 1 for s in changed)
    if runs < FEWEST_RUNS:
        return False
    from scipy.special import fdtri

    before, behind = squares(judged.left) - inside, max(squares(after) - within, 1e-300)
    return bool((before / behind - 1.0) * (runs - 2) > fdtri(1, runs - 2, 1.0 - BY_CHANCE))


def _run_columns(readings: Readings, series: Series, *, sloped: bool) -> Floats:
    """What may differ between the runs of a series: a zero; and slopes over the time and along each axis, (m, k)."""
    state, m = readings.states[series.source], len(readings)
    places = [state.channels[a.channel][series.row] for a in readings.machine.axes if a.channel in state.channels]
    over = [np.ones(len(series)), *([series.time_s, *places] if sloped else [])]
    out = []
    for run, v in itertools.product(range(int(series.run[-1]) + 1), over):
        mine = series.run == run
        if v is over[0] or np.ptp(v[mine]) > 0.0:
            column = np.zeros(m)
            column[series.part] = np.where(mine, v - (0.0 if v is over[0] else v[mine].mean()), 0.0)
            out.append(column / max(float(np.abs(column).max()), 1e-300))
    return np.stack(out, axis=1)


def _new_number_does(judged: Judgement, found: Edit) -> bool:
    """Whether new numbers of one effect leave clearly less than an edit of a channel: they are plainer.

    That a number is many times what it was, or has the other sign, is less plain than that a unit is wrong.
    """
    for fitted in judged.model.effects:
        columns = judged.columns_of(fitted.effect, fitted.theta)
        if AS_GOOD * judged.left_by(columns) >= found.residual:
            continue
        old = ordered(fitted, judged.readings)
        times = 1.0 + solve(columns, judged.left) / np.where(old == 0.0, math.inf, old)
        if not found.of_unit or np.all((times < MANY_TIMES) & (times > 1.0 / MANY_TIMES)):
            return True
    return False


def _other_sensor_does(judged: Judgement, found: Edit) -> bool:
    """Whether an effect of the model by a third sensor leaves clearly less than with two sensors exchanged; or about as
    little, where that does not reach the noise; or whether both were as warm on the day of the fit.

    A model may follow a sensor that was near the right one on the day of its fit: the exchange only brings it nearer.
    """
    then = [of_the_fit(judged.model).get(name) for name in found.channels]
    known = [t for t in then if t is not None]
    if len(known) == len(then) and float(np.ptp(known, axis=0).max()) < WARMER_K:
        return True
    reached = found.residual <= NEAR_FLOOR * judged.noise_floor
    enough = found.residual * (1.0 / AS_GOOD if reached else AS_GOOD)
    readings, machine = judged.readings, judged.model.machine
    others = [n for n in machine.sensor_names if n not in found.channels]
    others = [n for n in others if all(n in s.channels for s in readings.states)]
    for fitted in judged.model.effects:
        effect = fitted.effect
        if getattr(effect, "sensor", None) not in found.channels:
            continue
        own = floor.cleaned(readings, readings.columns(effect, fitted.theta) @ ordered(fitted, readings))
        without = judged.left + own
        for name in others:
            by = effect.model_copy(update={"sensor": name})
            late = [judged.columns_of(by, {**fitted.theta, p.name: v}) for p in by.nonlinear(machine) for v in p.grid]
            at_once = by.model_copy(update={"lag": False}) if getattr(by, "lag", False) else by
            for columns in [judged.columns_of(at_once, fitted.theta), *late]:
                if judged.pooled(without - columns @ solve(columns, without)) < enough:
                    return True
    return False


def _factors(judged: Judgement, measured: Floats, predicted: Floats, usual: float | None) -> Iterator[Edit]:
    """Files whose readings are the prediction times one factor, where it explains what a refit of all numbers does.

    A factor that a unit has may leave more, up to `BY_FAR` of the residual; for any other, one effect must leave more,
    and the model must have been fitted before: of one by hand all numbers may be too large.
    """
    readings = judged.readings
    source, weight = (np.asarray(v)[readings.series_of] for v in ([s.source for s in readings.series], judged.scale))
    files = [(m.name, source == i) for i, m in enumerate(readings.measurements)]
    for name, mine in files if len(files) == 1 else [*files, ("all files", source >= 0)]:
        made = np.where(mine, weight**2 * predicted, 0.0)
        factor = float(made @ measured) / max(float(made @ predicted), 1e-300)
        known, unit = unit_of(1.0 / factor, judged.unit) if factor else (1.0, "")
        if not unit and usual is None:
            continue
        factor = 1.0 / known
        after = measured - np.where(mine, factor, 1.0) * predicted
        left, follows = judged.pooled(after), _size(after, weight * mine) < BETTER * _size(measured, weight * mine)
        met = BY_FAR * judged.residual if unit else NEAR_FIT * abs(factor) * (usual or 0.0)
        near = max(NEAR_FLOOR * judged.noise_floor, NEAR_REFIT * judged.refitted, met)
        if (
            left > min(BETTER * judged.residual, near)
            or not follows
            or _as_well(judged, left if unit else ALIKE * left)
        ):
            continue
        suspect = f"its readings may be in {unit}" if unit else "the unit or the gain of its readings may be wrong"
        sign = ", with the other sign" if unit and factor < 0.0 else ""
        edit, by = f"the readings of {name} times {1.0 / factor:.3g}", abs(1.0 / factor)
        yield Edit(left, "wrong_gain", edit, f"{suspect}{sign}", "the unit and the instrument", times=by)


def _exchanged_readings(judged: Judgement, measured: Floats, predicted: Floats, usual: float | None) -> Iterator[Edit]:
    """Two reading columns exchanged in one file or in all, as of two probes on one arbor."""
    readings = judged.readings
    near = max(NEAR_FLOOR * judged.noise_floor, NEAR_FIT * (usual or 0.0))
    alike: dict[tuple[str, str], list[tuple[Series, Series]]] = {}
    for one, two in itertools.combinations(readings.series, 2):
        at_once = len(np.intersect1d(one.row, two.row)) > AT_ONCE * max(len(one), len(two))
        if one.source == two.source and one.unit == two.unit and at_once:
            alike.setdefault((one.column, two.column), []).append((one, two))
    for (first, second), pairs in alike.items():
        for exchanged in [[p] for p in pairs] + ([pairs] if len(pairs) > 1 else []):
            other = measured.copy()
            for one, two in exchanged:
                for own, its in ((one, two), (two, one)):
                    # Where the other reading does not count, nothing is known.
                    other[own.part] = predicted[own.part]
                    _, there, here = np.intersect1d(own.row, its.row, return_indices=True)
                    other[own.start + there] = measured[its.start + here]
            left = judged.pooled(floor.cleaned(readings, other - predicted))
            if left > min(BETTER * judged.residual, near) or _as_well(judged, left):
                continue
            names = listed([readings.measurements[one.source].name for one, _ in exchanged])
            edit = f"{first} and {second} of {names} exchanged"
            yield Edit(left, "swapped_readings", edit, "the two probes may be exchanged", "their plugs and columns")


def _size(readings: Floats, weight: Floats) -> float:
    return float(np.linalg.norm(weight * readings))


def _effect_does(judged: Judgement, found: Edit) -> bool:
    """Whether one effect does what an exchange of sensors does, or a missing one clearly more.

    The numbers of the model are refitted beside both then: what they make up for is evidence of neither.
    """
    if _as_well(judged, found.residual):
        return True
    exchanged = _refitted(judged, found)
    beside = (judged.left_beside(judged.columns_of(e)) for e in simple_effects(judged.readings))
    return any(_less_above(left, exchanged, judged.noise_floor) for left in beside)


def _refitted(judged: Judgement, found: Edit) -> float:
    """Residual with some channels replaced and all numbers of the model refitted."""
    readings = judged.readings
    changed = readings.with_states([with_channels(s, found.channels) for s in readings.states])
    there = base_of(judged.model, changed, judged.given.delays)
    own, left = (floor.cleaned(changed, v) for v in (there.columns, readings.values))
    return judged.pooled(left - own @ solve(own, left))


def _exchanged_as_in_the_fit(judged: Judgement, found: Edit) -> bool:
    """Whether with two sensors exchanged and its numbers refitted the model leaves what its fit left, and without the
    exchange no missing effect of one number beside it leaves clearly less.

    The numbers that a model got on one day are never quite those of another. A new number of the effect that reads the
    sensor leaves as little as the exchange then, where all others stay as they are.
    """
    usual = _error_of_fit(judged.model, judged.unit, judged.readings.measurements)
    if found.kind != "swapped_sensors" or usual is None or found.residual > BETTER * judged.residual:
        return False
    exchanged = _refitted(judged, found)
    if exchanged > NEAR_FIT * max(usual, judged.noise_floor):
        return False
    machine = judged.model.machine
    sensors = set(machine.sensor_names)
    for one in library(judged.readings)[0]:
        effect = one.effect
        warm = bool(sensors & set(effect.channels(machine)))
        if len(effect.coefficients(machine)) > 1 or (effect.nonlinear(machine) and not warm):
            continue
        beside = (judged.left_beside(judged.columns_of(effect, theta)) for theta in one.thetas)
        if any(AS_GOOD * left < exchanged for left in beside):
            return False
    return True


def _delay_does(judged: Judgement, found: Edit) -> bool:
    """Whether an effect of a temperature leaves about as little as temperatures by another clock.

    A delay that the model lacks moves the temperatures as well. One between two delays of the grid is nearly a sum of
    both.
    """
    readings, machine = judged.readings, judged.model.machine
    sensors = set(machine.sensor_names)
    for effect in (c.effect for c in library(readings)[0]):
        delays = effect.nonlinear(machine)
        if not sensors & set(effect.channels(machine)) or len(delays) > 1 or any(p.unit != "s" for p in delays):
            continue
        thetas = [{p.name: v} for p in delays for v in p.grid] or [{}]
        columns = [judged.columns_of(effect, t) for t in thetas]
        beside = [np.hstack(pair) for pair in itertools.pairwise(columns)] or columns
        if any(judged.left_beside(b) < ALIKE * found.residual for b in beside):
            return True
    return False


def _clearly_less(one: float, other: float, noise: float) -> bool:
    """Whether one residual is clearly less than another: as it is, or above a noise that the other does not reach."""
    return AS_GOOD * one < other or _less_above(one, other, noise)


def _less_above(one: float, other: float, noise: float) -> bool:
    """Whether one residual is clearly less than another above a noise that the other does not reach."""
    return other > REACHED * noise and max(one**2 - noise**2, 0.0) < HALF * (other**2 - noise**2)


def _error_of_fit(model: Model, unit: str, measurements: Sequence[Measurement]) -> float | None:
    """What a model left of the readings of its fit; None where that is unknown, or some of these are among them."""
    steps = [s for s in steps_of(model) if s["unit"] == unit != "noise"]
    if not steps or any(m.fingerprint in model.measurements.values() for m in measurements):
        return None
    return float(steps[-1]["error"]) if model.measurements else None


def _whole_noise(judged: Judgement) -> float:
    """Root mean square of the noise together with the slow drift that no channel explains."""
    whole = np.array([math.hypot(f.value, f.drift) for f in judged.floors])
    return floor.pooled(judged.readings, whole, judged.scale)
