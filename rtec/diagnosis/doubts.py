"""Doubts about the record: what to correct, or to measure differently, before an effect is blamed.

Each doubt has a next step. Those that are `fatal` precede every answer, and no effect is named beside a
contradiction.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, State
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.candidates import REAL, library
from rtec.estimation.columns import base_of, ordered
from rtec.estimation.contradiction import contradiction
from rtec.estimation.end_targets import NEXT
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.estimation.moved_zero import STEP, moved_zeros
from rtec.estimation.one_pass import one_pass
from rtec.estimation.readings import Readings, Series, looked_at
from rtec.estimation.two_levels import STEP as STATES
from rtec.estimation.two_levels import two_levels
from rtec.estimation.wrong_scale import odd_scales, unit_of
from rtec.machine import Axis
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.model.history import steps_of
from rtec.wording import ERROR_UNITS, significant, sizes

Floats = NDArray[np.float64]

Kind = Literal[
    "wrong_scale", "wrong_gain", "wrong_channel", "swapped_sensors", "moved_origin", "wrong_pitch", "contradiction",
    "corrected", "moved_zero", "end_targets", "other_machine", "one_pass", "few_runs", "no_temperature", "other_sensor",
    "instrument_warm_up", "between_files", "dead_sensor", "turned_axis", "late_temperatures", "lost_sensor",
    "unexplained", "two_levels", "few_targets",
]  # fmt: skip
BLAMES_NO_EFFECT: frozenset[Kind] = frozenset(
    {
        "wrong_scale",
        "wrong_gain",
        "wrong_channel",
        "swapped_sensors",
        "moved_origin",
        "turned_axis",
        "late_temperatures",
        "lost_sensor",
        "contradiction",
        "corrected",
        "instrument_warm_up",
        "moved_zero",
        "two_levels",
        "between_files",
        "dead_sensor",
    }
)
"""Doubts beside which no effect of the machine is named."""
DECIDES_NOTHING: frozenset[Kind] = BLAMES_NO_EFFECT | {"no_temperature", "end_targets", "few_targets", "unexplained"}
"""Doubts beside which it is undetermined whether an effect is missing."""

BETTER = 0.5
"""An edit of the record is proposed where its residual is below this share of the current one,"""
NEAR_FLOOR, ABOVE = 1.25, 1.5
"""and at most this many times the noise; edits are tried only where the residual exceeds this many times that."""
NEAR_REFIT = 1.15
"""Or, for a factor, at most this many times the residual with the model's own numbers refitted."""
BY_FAR = 0.1
"""Or, for a factor, at most this share of the residual: out-of-date numbers may cause the rest."""
AGAIN, NEAR_FIT, LIKE_REFIT = 0.85, 1.15, 1.05
"""Or below this share of the current residual, and at most this many times what the fit left, if that was of other
readings; or, for an origin, this many times the residual with all numbers of the model refitted."""
SHIFT, SHIFTS = 0.25, 101
"""How far an origin may have moved, as a share of the travel, and number of places in the grid."""
AS_GOOD = 1.1
"""An explanation whose residual is within this factor of another's is equally good."""
REACHED, HALF = 1.05, 0.5
"""An edit reaches the noise within this factor; where it does not, an effect that leaves this share above it, in
squares, is clearly better."""
ALIKE = 1.5
"""Temperatures by another clock, and a factor that no unit has, are asked about where an effect leaves more than this
many times what they leave."""
MOSTLY = 0.75
"""Share, in squares, of what a refit of all numbers explains that a fault smaller than half of the residual must."""
MANY_TIMES = 3.0
"""A number of the machine is hardly more than this many times what it was, or less than the inverse."""
FEWEST_RUNS, BY_CHANCE = 3, 0.01
"""With fewer runs nothing tells what differs between them from a drift. Share of the records of which only the zeros,
or slopes, of the runs wander whose runs one number follows as well by chance."""
GROWS = "something that grows shifts the readings as much"
SENSORS_LATE = "the sensors warm up that much later than their parts"
FAR_LESS = 0.75
"""Or, with the model's own numbers refitted, below this share of what the edit leaves."""
THIN = 200
"""Fewest readings for the first search of the place."""
LATE, LATES = 1 / 3, 41
"""How far the clock of the temperatures may be off, as a share of the record, and number of instants in the grid."""
CHANNEL_FACTORS = (60.0, 1 / 60.0, 1000.0, 1e-3, 25.4, 1 / 25.4, 10.0, 0.1, 5.0, 0.2, 2.0, 0.5, -1.0)
NO_UNIT = (5.0, 0.2, 2.0, 0.5)
"""Factors that no unit of length has: of a position the model's own numbers, out of date, look so."""
BEYOND = 0.05
"""Share of the travel by which a position may exceed it."""
FLAT, MUCH = 1.5, 5.0
"""Readings below this many times the noise are flat; a prediction above this many times it is large."""
DISAGREES, INSIDE = 3.0, 0.2
"""A model disagrees with a file where its residual is this many times that of its fit, on readings in the range of the
fit: at least this share of the file."""
UNEXPLAINED = 2.0
"""A residual of this many times noise and slow drift together is neither; none of 84 quiet records had 1.7 times."""
FEW_RUNS = 4
HELD = 2
"""A sensor may be called lost only where the model met at least this many runs before."""
ALONE = "If the machine changed between them, diagnose the newer file alone."


@dataclass(frozen=True)
class Doubt:
    """A reason to doubt the record.

    Attributes:
        kind: kind of the doubt.
        message: in words.
        next_step: what the user should do.
        fatal: whether it precedes every answer.
    """

    kind: Kind
    message: str
    next_step: str
    fatal: bool = False

    @property
    def words(self) -> str:
        """Message and next step."""
        return f"{self.message} {self.next_step}".strip()

    @property
    def blames_no_effect(self) -> bool:
        """Whether no effect of the machine is named beside it."""
        return self.fatal and self.kind in BLAMES_NO_EFFECT


def doubts(judged: Judgement) -> tuple[Doubt, ...]:
    """All doubts about the readings of a model, fatal ones first."""
    readings = judged.readings
    measured, predicted = (floor.cleaned(readings, v) for v in (readings.values, judged.base.predicted))
    edited = _edited_records(judged, measured, predicted)
    found = [
        Doubt("wrong_scale", fault, "Correct the file first.", fatal=True)
        for fault in odd_scales(readings, measured, predicted)
    ]
    if edited is not None and edited.residual < BETTER * _left_by_scale(judged, measured, predicted):
        found = []  # a channel is wrong, and so is the prediction
    one_factor = edited is not None and edited.kind == "wrong_gain"  # explains why files differ, too
    if not found and not one_factor and (odd := contradiction(judged)) is not None:
        step = f"{odd.check[0].upper()}{odd.check[1:]}; {odd.again}.{'' if odd.turned else f' {ALONE}'}"
        found = [Doubt("contradiction", f"{odd.message}.", step, fatal=True)]
    found += _corrected(judged, measured, predicted)
    if not found and edited is not None:
        found.append(edited.doubt(judged.residual, ERROR_UNITS[judged.unit]))
    step, levels = f"{STEP[0].upper()}{STEP[1:]}.", [] if found else _levels(judged)
    found += levels or [Doubt("moved_zero", moved.message, step, fatal=True) for moved in moved_zeros(readings)]
    step = f"{NEXT[0].upper()}{NEXT[1:]}."
    found += [Doubt("end_targets", f"{ends.message}.", step, fatal=True) for ends in judged.given.ends]
    if not found:
        found += _disagree(judged)
    found += [Doubt("one_pass", p.message, p.next_step, fatal=p.one_way) for p in one_pass(readings)]
    found += _few_runs(readings)
    return tuple(found)


def _levels(judged: Judgement) -> list[Doubt]:
    """Series whose runs are at one of two levels; no effect is named where that is most of the residual."""
    left, out = floor.cleaned(judged.readings, judged.left), []
    for levels in two_levels(judged.readings, left):
        rest = judged.pooled(floor.cleaned(judged.readings, left - levels.readings))
        out.append(Doubt("two_levels", levels.message, STATES, fatal=rest**2 < BETTER * judged.residual**2))
    return out


def _disagree(judged: Judgement) -> list[Doubt]:
    """Files whose residual is far larger than that of the model's fit, in the same range."""
    model, readings = judged.model, judged.readings
    steps = [s for s in steps_of(model) if s["unit"] == judged.unit != "noise"]
    if not steps or not model.measurements:
        return []
    unit, fitted = ERROR_UNITS[judged.unit], float(steps[-1]["error"])
    predicted_rms = floor.rms_by_series(readings, judged.base.predicted)
    out = []
    for i, m in enumerate(readings.measurements):
        mine = [k for k, s in enumerate(readings.series) if s.source == i and predicted_rms[k] > 0.0]
        inside = _in_range(model, readings.states[i])
        if m.fingerprint in model.measurements.values() or not mine or float(inside.mean()) < INSIDE:
            continue
        usual = max(fitted, *(judged.floors[k].value for k in mine))
        left = [judged.left[readings.series[k].part][inside[readings.series[k].row]] for k in mine]
        off = max(float(np.sqrt(np.mean((v - v.mean()) ** 2))) for v in left)
        if off < DISAGREES * usual:
            continue
        here, there = sizes(off, fitted)
        message = (
            f"The model leaves {here} {unit} of {m.name}, and left {there} {unit} of the readings that it was "
            "fitted to. Check whether it is of this machine."
        )
        step = (
            "An effect may act that did not act then, the machine may have changed since, or the file is of another "
            "machine or set-up. With a file of the fit beside it, rtec diagnose tells whether both contradict each "
            "other."
        )
        out.append(Doubt("other_machine", message, step))
    return out


def targets_apart(channels: Sequence[str], at_mm: Sequence[Sequence[float]]) -> Doubt:
    """Doubt about what only one or two targets show, at their places along axes."""
    places = [", ".join(f"{c.upper()} = {significant(v)}" for c, v in zip(channels, at, strict=True)) for at in at_mm]
    one = len(places) == 1
    which = f"The target{'' if one else 's'} at {' mm and '.join(places)} mm stand{'s' if one else ''} out"
    message = f"{which} from all others in most readings there: that is no shape."
    step = f"Measure once more, with further targets close beside {'it' if one else 'them'}."
    return Doubt("few_targets", message, step, fatal=True)


def unexplained(judged: Judgement) -> Doubt | None:
    """Doubt that nothing is missing where the residual is far above noise and slow drift; None where it is not."""
    left = min(judged.residual, judged.refitted if math.isfinite(judged.refitted) else math.inf)
    usual = math.hypot(judged.noise_floor, judged.drift)
    if not left > UNEXPLAINED * usual:
        return None
    size, noise = sizes(left, usual)
    unit, several = ERROR_UNITS[judged.unit], len(judged.readings.measurements) > 1
    message = (
        f"The residual is {size} {unit}, noise and slow drift together are {noise} {unit}, and neither an effect of "
        "the catalogue nor a shape without a name describes it."
    )
    step = "`rtec compare --report` draws it over each variable."
    return Doubt("unexplained", message, f"Diagnose each file alone. {step}" if several else step, fatal=True)


def _in_range(model: Model, state: State) -> NDArray[np.bool_]:
    """Which instants are in the range of the model's fit, (n,)."""
    out = np.ones(len(state), dtype=np.bool_)
    for name, (low, high) in model.valid_range.items():
        if name in state.channels:
            out &= (state.channels[name] >= low) & (state.channels[name] <= high)
    return out


def _name(readings: Readings, s: Series) -> str:
    return f"{readings.measurements[s.source].name} {s.column}"


def _moves(readings: Readings, s: Series) -> bool:
    """Whether the display of a series moved at all."""
    return float(np.ptp(readings.values[s.part])) > 0.0


def _corrected(judged: Judgement, measured: Floats, predicted: Floats) -> list[Doubt]:
    """Series that are flat where the model predicts much: the loop was on while they were read.

    A display that never changed is not one of them.
    """
    out = []
    for s, noise in zip(judged.readings.series, judged.floors, strict=True):
        read, modelled = (float(np.sqrt(np.mean(v[s.part] ** 2))) for v in (measured, predicted))
        if _moves(judged.readings, s) and read < FLAT * noise.value and modelled > MUCH * max(noise.value, read):
            flat, due = sizes(read, modelled)
            message = (
                f"{_name(judged.readings, s)} is flat ({flat} µm) where the model says {due} µm: was the correction on "
                "while it was measured?"
            )
            step = "Put the inserted corrections back into the readings, or measure with the correction held at zero."
            out.append(Doubt("corrected", message, step, fatal=True))
    return out


def _edited_records(judged: Judgement, measured: Floats, predicted: Floats) -> "_Edit | None":
    """The likeliest fault of the recorded channels: the edit of the record with which the model fits far better."""
    moves = any(_moves(judged.readings, s) for s in judged.readings.series)
    if judged.residual < ABOVE * judged.noise_floor or not moves:
        return None
    few = judged.readings.without(~looked_at(judged.readings))
    usual = _error_of_fit(judged.model, judged.unit, judged.readings.measurements)
    met = usual is not None and usual < NEAR_FLOOR * judged.noise_floor
    edits = _Edits(judged.model, few, judged.scale)
    lost = [e for e in edits.lost(max(judged.noise_floor, usual or 0.0)) if e.residual < BETTER * judged.residual]
    lost = [e for e in lost if not _as_well(judged, e.residual)]
    factors = _factors(judged, measured, predicted, usual)
    found = min([*edits.possible(), *factors, *lost], key=lambda e: e.residual, default=None)
    if found is None:
        return None
    near = NEAR_FLOOR * _whole_noise(judged)
    if found.kind in ("wrong_gain", "lost_sensor"):
        return found
    if found.kind in ("wrong_channel", "swapped_sensors") and _new_number_does(judged, found):
        return None
    if not _runs_decide(judged, found):
        return None
    if found.kind == "late_temperatures" and not met:
        return _by_another_clock(judged, found, usual)
    if found.kind == "wrong_channel":
        # A refit of the numbers compensates a factor.
        near = max(near, NEAR_REFIT * judged.refitted, BY_FAR * judged.residual)
    if found.residual <= min(BETTER * judged.residual, near):
        drifts = found.residual > NEAR_FLOOR * judged.noise_floor
        return None if drifts and found.kind == "swapped_sensors" and _effect_does(judged, found) else found
    return found if found.fatal and _as_in_the_fit(judged, found) else None


def _by_another_clock(judged: Judgement, found: "_Edit", usual: float | None) -> "_Edit | None":
    """Late temperatures where the model never met other readings: a delay that it lacks moves them as well.

    A model that was fitted to others need not reach the noise: between the runs nobody may have read the temperatures.
    """
    fitted = any(m.fingerprint in judged.model.measurements.values() for m in judged.readings.measurements)
    near = NEAR_FLOOR * judged.noise_floor if usual is None else math.inf
    if fitted or found.residual > min(BETTER * judged.residual, near):
        return None
    if not _delay_does(judged, found):
        return found
    return replace(found, unless=found.rival) if found.rival else None


def _as_in_the_fit(judged: Judgement, found: "_Edit") -> bool:
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
    fixed = [_columns(judged, e) for e in _simple(judged) if set(e.channels(machine)) <= places]
    own = floor.cleaned(readings, judged.base.columns)
    return not any(_left_by(judged, np.hstack([own, c])) < FAR_LESS * found.residual for c in fixed)


def _like_refit(judged: Judgement, found: "_Edit") -> bool:
    """Whether an edit explains most of what new numbers of the whole model do."""
    before = judged.residual**2
    return before - found.residual**2 > MOSTLY * (before - judged.refitted**2)


def _as_well(judged: Judgement, residual: float) -> bool:
    """Whether new numbers of one effect leave about as little as an edit, or a missing one of one number less."""
    own = (_left_by(judged, _columns(judged, f.effect, f.theta)) for f in judged.model.effects)
    if any(left < AS_GOOD * residual for left in own):
        return True
    new = (_left_by(judged, _columns(judged, e)) for e in _simple(judged))
    return any(_clearly_less(left, residual, judged.noise_floor) for left in new)


def _runs_decide(judged: Judgement, found: "_Edit") -> bool:
    """Whether an edit describes more than what may differ from run to run, or differs between enough runs.

    A temperature is nearly one value in each run, and another origin changes an expansion by one zero in each. With few
    runs an edit of one number follows any drift of theirs. So the runs are counted then, not the readings.
    """
    readings, sensors = judged.readings, set(judged.model.machine.sensor_names)
    warm = set(found.channels) <= sensors
    after = _Edits(judged.model, readings, judged.scale).left(found.channels)
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
    from scipy.stats import f

    before, behind = squares(judged.left) - inside, max(squares(after) - within, 1e-300)
    return bool((before / behind - 1.0) * (runs - 2) > f.isf(BY_CHANCE, 1, runs - 2))


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


def _new_number_does(judged: Judgement, found: "_Edit") -> bool:
    """Whether new numbers of one effect leave clearly less than an edit of a channel: they are plainer.

    That a number is many times what it was, or has the other sign, is less plain than that a unit is wrong.
    """
    for fitted in judged.model.effects:
        columns = _columns(judged, fitted.effect, fitted.theta)
        if AS_GOOD * _left_by(judged, columns) >= found.residual:
            continue
        old = ordered(fitted, judged.readings)
        times = 1.0 + solve(columns, judged.left) / np.where(old == 0.0, math.inf, old)
        if not found.of_unit or np.all((times < MANY_TIMES) & (times > 1.0 / MANY_TIMES)):
            return True
    return False


def _factors(judged: Judgement, measured: Floats, predicted: Floats, usual: float | None) -> Iterator["_Edit"]:
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
        left, none = (judged.pooled(measured - np.where(mine, f, 1.0) * predicted) for f in (factor, 0.0))
        met = BY_FAR * judged.residual if unit else NEAR_FIT * abs(factor) * (usual or 0.0)
        near = max(NEAR_FLOOR * judged.noise_floor, NEAR_REFIT * judged.refitted, met)
        close = left <= min(BETTER * judged.residual, BETTER * none, near)
        if not close or _as_well(judged, left if unit else ALIKE * left):
            continue
        suspect = f"its readings may be in {unit}" if unit else "the unit or the gain of its readings may be wrong"
        sign = ", with the other sign" if unit and factor < 0.0 else ""
        edit, by = f"the readings of {name} times {1.0 / factor:.3g}", abs(1.0 / factor)
        yield _Edit(left, "wrong_gain", edit, f"{suspect}{sign}", "the unit and the instrument", times=by)


def _effect_does(judged: Judgement, found: "_Edit") -> bool:
    """Whether one effect does what an exchange of sensors does, or a missing one clearly more.

    The numbers of the model are refitted beside both then: what they make up for is evidence of neither.
    """
    if _as_well(judged, found.residual):
        return True
    readings, noise = judged.readings, judged.noise_floor
    changed = readings.with_states([_with(s, found.channels) for s in readings.states])
    there = base_of(judged.model, changed)
    own, left = (floor.cleaned(changed, v) for v in (there.columns, readings.values - there.predicted))
    exchanged = judged.pooled(left - own @ solve(own, left))
    own = floor.cleaned(readings, judged.base.columns)
    beside = (np.hstack([own, _columns(judged, e)]) for e in _simple(judged))
    return any(_less_above(_left_by(judged, b), exchanged, noise) for b in beside)


def _delay_does(judged: Judgement, found: "_Edit") -> bool:
    """Whether an effect of a temperature leaves about as little as temperatures by another clock.

    A delay that the model lacks moves the temperatures as well. One between two delays of the grid is nearly a sum of
    both.
    """
    readings, machine = judged.readings, judged.model.machine
    own, sensors = floor.cleaned(readings, judged.base.columns), set(machine.sensor_names)
    for effect in (c.effect for c in library(readings)[0]):
        delays = effect.nonlinear(machine)
        if not sensors & set(effect.channels(machine)) or len(delays) > 1:
            continue
        thetas = [{p.name: v} for p in delays for v in p.grid] or [{}]
        columns = [_columns(judged, effect, t) for t in thetas]
        beside = [np.hstack([own, *pair]) for pair in itertools.pairwise(columns)] or [np.hstack([own, *columns])]
        if any(_left_by(judged, b) < ALIKE * found.residual for b in beside):
            return True
    return False


def _columns(judged: Judgement, effect: Effect, theta: Mapping[str, float] | None = None) -> Floats:
    """Columns of an effect, less what the instruments cannot know, (m, k)."""
    return floor.cleaned(judged.readings, judged.readings.columns(effect, theta or {}))


def _left_by(judged: Judgement, columns: Floats) -> float:
    """Residual with columns fitted to it."""
    return judged.pooled(judged.left - columns @ solve(columns, judged.left))


def _clearly_less(one: float, other: float, noise: float) -> bool:
    """Whether one residual is clearly less than another: as it is, or above a noise that the other does not reach."""
    return AS_GOOD * one < other or _less_above(one, other, noise)


def _less_above(one: float, other: float, noise: float) -> bool:
    """Whether one residual is clearly less than another above a noise that the other does not reach."""
    return other > REACHED * noise and max(one**2 - noise**2, 0.0) < HALF * (other**2 - noise**2)


def _simple(judged: Judgement) -> list[Effect]:
    """Effects of the catalogue that have one number, as an edit has."""
    machine = judged.model.machine
    effects = [c.effect for c in library(judged.readings)[0]]
    return [e for e in effects if len(e.coefficients(machine)) == 1 and not e.nonlinear(machine)]


def _error_of_fit(model: Model, unit: str, measurements: Sequence[Measurement]) -> float | None:
    """What a model left of the readings of its fit; None where that is unknown, or some of these are among them."""
    steps = [s for s in steps_of(model) if s["unit"] == unit != "noise"]
    if not steps or any(m.fingerprint in model.measurements.values() for m in measurements):
        return None
    return float(steps[-1]["error"]) if model.measurements else None


def _left_by_scale(judged: Judgement, measured: Floats, predicted: Floats) -> float:
    """Least residual of the model if the readings were in another unit, in the unit that they have."""
    by_series = []
    for s in judged.readings.series:
        mine, modelled = measured[s.part], predicted[s.part]
        factor = float(mine @ modelled) / max(float(modelled @ modelled), 1e-300)
        by_series.append(float(np.sqrt(np.mean((mine - factor * modelled) ** 2))))
    return floor.pooled(judged.readings, np.array(by_series), judged.scale)


def _whole_noise(judged: Judgement) -> float:
    """Root mean square of the noise together with the slow drift that no channel explains."""
    whole = np.array([math.hypot(f.value, f.drift) for f in judged.floors])
    return floor.pooled(judged.readings, whole, judged.scale)


Replaced = Mapping[str, Callable[[State], Floats]]
"""Channels replaced: of each, what it becomes from the state of a measurement."""


def _with(state: State, channels: Replaced) -> State:
    """A state with some channels replaced."""
    changed = {**state.channels, **{c: make(state) for c, make in channels.items()}}
    return State(state.machine, state.time_s, changed, state.reference_degc)


@dataclass(frozen=True)
class _Edit:
    """An edit of the recorded channels, and the residual of the model with it.

    Attributes:
        residual: of the model with the edit.
        kind, edit, suspect, check: what it is, in words.
        channels: what it replaces.
        times: what it multiplies the readings by.
        unless: what else does the same, in words; empty for nothing.
        rival: what else does the same if an effect describes the readings as well; empty for that effect alone.
        of_unit: whether it multiplies a channel by a factor that a unit has.
    """

    residual: float
    kind: Kind
    edit: str
    suspect: str
    check: str
    channels: Replaced = field(default_factory=dict)
    times: float = 1.0
    unless: str = ""
    rival: str = ""
    of_unit: bool = False

    @property
    def fatal(self) -> bool:
        """Whether nothing else does the same."""
        return not self.unless

    def doubt(self, before: float, unit: str) -> Doubt:
        """The doubt in words; `before` is the residual without the edit."""
        here, there = sizes(self.times * self.residual, before)
        message = f"with {self.edit} the model leaves {here} instead of {there} {unit}: {self.suspect}."
        if not self.fatal:
            message = f"{message[:-1]}, unless {self.unless}."
        return Doubt(self.kind, message, f"Check {self.check} before a new effect is blamed.", fatal=self.fatal)


class _Edits:
    """Edits that only a file can need: a channel in another unit, two labels exchanged, an axis homed elsewhere."""

    def __init__(self, model: Model, readings: Readings, scale: Floats) -> None:
        self.model, self.readings, self.scale = model, readings, scale
        machine = model.machine
        self.read = {c for f in model.effects for c in f.effect.channels(machine)}
        self.parts = [self._part(f, readings) for f in model.effects]

    @cached_property
    def _thin(self) -> "_Edits":
        """The same with fewer readings, for a first search on a grid."""
        keep = np.arange(len(self.readings)) % max(len(self.readings) // THIN, 1) == 0
        return self if keep.all() else _Edits(self.model, self.readings.without(~keep), self.scale)

    def possible(self) -> list[_Edit]:
        """Every edit that is possible here."""
        return [*self._factors(), *self._exchanged(), *self._moved(), *self._turned(), *self._late()]

    def residuals(self, edits: Sequence[Replaced]) -> Floats:
        """Root mean square of the residual with some channels replaced, (edits,); infinite where that is impossible.

        Args:
            edits: of each, the replacement of a channel, from the state of a measurement.
        """
        out, kept = np.full(len(edits), np.inf), [self.left(e) for e in edits]
        there = [i for i, left in enumerate(kept) if left is not None]
        if not there:
            return out
        whole = floor.cleaned(self.readings, np.stack([left for left in kept if left is not None], axis=1))
        for i, left in zip(there, whole.T, strict=True):
            out[i] = floor.pooled(self.readings, floor.rms_by_series(self.readings, left), self.scale)
        return out

    def left(self, channels: Replaced) -> Floats | None:
        """Residual of the model with some channels replaced, (m,); None where that is impossible."""
        states = []
        for state in self.readings.states:
            if any(c not in state.channels for c in channels):
                return None
            states.append(_with(state, channels))
        changed_readings = self.readings.with_states(states)
        left = self.readings.values.copy()
        try:
            for fitted, part in zip(self.model.effects, self.parts, strict=True):
                touched = set(fitted.effect.channels(self.model.machine)) & set(channels)
                left -= self._part(fitted, changed_readings) if touched else part
        except ModelError:
            return None
        return left if np.isfinite(left).all() else None

    def _part(self, fitted: FittedEffect, readings: Readings) -> Floats:
        with np.errstate(all="ignore"):
            columns = readings.columns(fitted.effect, fitted.theta)
        return np.asarray(columns @ ordered(fitted, readings))

    def _factors(self) -> Iterator[_Edit]:
        for channel in sorted(self.read - {"time_s"}):
            if channel.startswith("d_"):
                continue
            suspect, check = "its unit or its scale in the file may be wrong", "that column"
            factors = [f for f in CHANNEL_FACTORS if self._within_travel(channel, f)]
            times = [{channel: lambda s, c=channel, f=f: f * s.channels[c]} for f in factors]
            still = min(self._without_change(channel), self._without_effects(channel))
            for factor, residual, made in zip(factors, self.residuals(times), times, strict=True):
                if AS_GOOD * float(residual) > still:
                    continue  # it only takes away what the model has by that channel
                by = f"{factor:g}" if abs(factor) >= 1.0 else f"1/{1.0 / factor:g}"
                edit, of_unit = f"{channel} times {by}", factor not in NO_UNIT
                yield _Edit(float(residual), "wrong_channel", edit, suspect, check, made, of_unit=of_unit)
            if channel in self.model.machine.sensor_names:
                celsius: Replaced = {channel: lambda s, c=channel: (s.channels[c] - 32.0) / 1.8}  # type: ignore[misc]
                residual, edit = self.residuals([celsius])[0], f"{channel} read as °F"
                if AS_GOOD * float(residual) > still:
                    continue
                yield _Edit(float(residual), "wrong_channel", edit, suspect, check, celsius, of_unit=True)

    def _without_change(self, channel: str) -> float:
        """Root mean square of the residual if a channel had its median throughout."""
        values = np.concatenate(
            [s.channels[channel] for s in self.readings.states if channel in s.channels] or [np.zeros(1)]
        )
        median = float(np.nanmedian(values))
        return float(self.residuals([{channel: lambda s: np.full(len(s), median)}])[0])

    def _without_effects(self, channel: str) -> float:
        """Least root mean square of the residual without effects of the model that read a channel."""
        reads = [channel in f.effect.channels(self.model.machine) for f in self.model.effects]
        some = [p for p, r in zip(self.parts, reads, strict=True) if r]
        whole = self.left({})
        if whole is None or not some:
            return math.inf
        left = floor.cleaned(self.readings, np.stack([whole + p for p in (*some, np.sum(some, axis=0))], axis=1))
        return min(floor.pooled(self.readings, floor.rms_by_series(self.readings, v), self.scale) for v in left.T)

    def _within_travel(self, channel: str, factor: float) -> bool:
        """Whether a position times a factor that a unit has is within the travel; true of all other channels.

        Targets cover most of the travel: positions that are within it as they are recorded are not too large.
        """
        axis = next((a for a in self.model.machine.axes if a.channel == channel), None)
        if axis is None:
            return True
        places = [s.channels[channel] for s in self.readings.states if channel in s.channels]
        if factor in NO_UNIT or (abs(factor) < 1.0 and self._in_travel(axis, places)):
            return False
        return self._in_travel(axis, [factor * p for p in places])

    def _in_travel(self, axis: Axis, places: Sequence[Floats]) -> bool:
        """Whether positions are within the travel of an axis, or hardly beyond it."""
        low, high = axis.travel_mm
        beyond = BEYOND * (high - low)
        return all(low - beyond <= float(np.nanmin(p)) and float(np.nanmax(p)) <= high + beyond for p in places)

    def _exchanged(self) -> Iterator[_Edit]:
        sensors = [n for n in self.model.machine.sensor_names if all(n in s.channels for s in self.readings.states)]
        suspect = "the two sensors, or their columns, may be exchanged"
        for one, two in itertools.combinations(sensors, 2):
            if {one, two} & self.read:
                swap = {one: lambda s, c=two: s.channels[c], two: lambda s, c=one: s.channels[c]}
                left, edit = float(self.residuals([swap])[0]), f"{one} and {two} exchanged"
                if AS_GOOD * left > min(self._without_effects(one), self._without_effects(two)):
                    continue
                yield _Edit(left, "swapped_sensors", edit, suspect, "their labels", swap)

    def _moved(self) -> Iterator[_Edit]:
        for axis in self.model.machine.axes:
            if axis.channel not in self.read:
                continue

            def moved(by_mm: float, channel: str = axis.channel) -> Replaced:
                return {channel: lambda s: s.channels[channel] + by_mm}

            def left(by_mm: float, at: Callable[[float], Replaced] = moved) -> float:
                return float(self.residuals([at(by_mm)])[0])

            low, high = self._room(axis)
            if high - low < REAL["mm"]:
                continue
            by = self._place(moved, low, high)
            edit = f"{axis.channel} moved by {significant(by, sign=True)} mm"
            suspect = f"{axis.name} may have been homed elsewhere than when the model was made"
            found = left(by)
            apart = self._shifted(axis) > AS_GOOD * found
            where = f"the origin of {axis.name}"
            yield _Edit(found, "moved_origin", edit, suspect, where, moved(by), unless="" if apart else GROWS)

    def _place(self, at: "Callable[[float], Replaced]", low: float, high: float) -> float:
        """The value between two bounds at which an edit leaves least: on a grid with few readings, then with all."""
        from scipy.optimize import minimize_scalar

        grid = np.linspace(low, high, SHIFTS)
        best = float(grid[np.argmin(self._thin.residuals([at(v) for v in grid]))])
        step = float(grid[1] - grid[0])
        bounds = max(best - step, low), min(best + step, high)
        return float(minimize_scalar(lambda v: self.residuals([at(v)])[0], bounds=bounds, method="bounded").x)

    def _turned(self) -> Iterator[_Edit]:
        """An axis whose positions were counted from the other end: x is c - x, and its direction the other one."""
        for axis in self.model.machine.axes:
            if axis.channel not in self.read:
                continue

            def turned(about_mm: float, axis: Axis = axis) -> Replaced:
                out = {axis.channel: lambda s: about_mm - s.channels[axis.channel]}
                for name in (axis.direction_channel, axis.velocity_channel):
                    if all(name in s.channels for s in self.readings.states):
                        out[name] = lambda s, c=name: -s.channels[c]  # type: ignore[misc]
                return out

            (low, high), (first, last) = axis.travel_mm, self._reached(axis)
            beyond = BEYOND * (high - low)
            if last - first < REAL["mm"] or low - beyond + last > high + beyond + first:
                continue
            about = self._place(turned, low - beyond + last, high + beyond + first)
            middle, found = self.residuals([turned(low + high), turned(about)])
            about = low + high if middle < AS_GOOD * found else about
            yield _Edit(
                float(self.residuals([turned(about)])[0]),
                "turned_axis",
                f"{axis.name} turned round ({axis.channel} read as {about:.4g} mm - {axis.channel})",
                f"{axis.name} may have been counted from its other end",
                f"the direction of {axis.name} in that file",
            )

    def _reached(self, axis: Axis) -> tuple[float, float]:
        """Smallest and largest position of an axis in the readings, mm."""
        places = np.concatenate([s.channels[axis.channel] for s in self.readings.states])
        return float(np.nanmin(places)), float(np.nanmax(places))

    def _late(self) -> Iterator[_Edit]:
        """Temperatures by another clock than the readings; where their record has ended, readings are left out."""
        from scipy.optimize import minimize_scalar

        names = sorted(self.read & set(self.model.machine.sensor_names))
        span = max((float(np.ptp(s.time_s)) for s in self.readings.states if len(s)), default=0.0)
        if not names or span <= 0.0:
            return

        def moved(by_s: float) -> Replaced:
            return {n: lambda s, c=n: np.interp(s.time_s + by_s, s.time_s, s.channels[c]) for n in names}  # type: ignore[misc]

        def left(by_s: float, few: "_Edits" = self) -> float:
            """Residual with the temperatures moved, no less of the current one than where these are known."""
            there = few._within(by_s)
            now, current = there.residuals([moved(by_s), {}])
            return float(max(now, few._current * now / max(current, 1e-300)))

        grid = np.linspace(-LATE * span, LATE * span, LATES)
        best = float(grid[np.argmin([left(by, self._thin) for by in grid])])
        step = float(grid[1] - grid[0])
        by = float(minimize_scalar(left, bounds=(best - step, best + step), method="bounded").x)
        way = "earlier" if by > 0.0 else "later"
        yield _Edit(
            left(by),
            "late_temperatures",
            f"all temperatures moved {abs(by) / 60.0:.0f} min {way}",
            "their clock may not be that of the readings",
            "the time of both",
            moved(by),
            rival=SENSORS_LATE if by > 0.0 else "",
        )

    def lost(self, usual: float) -> Iterator[_Edit]:
        """A sensor that shows something else than its part from a run on: an error of its own in each run explains all.

        The model met the runs before, in which the sensor changed about as much. It jumps into the run by a larger
        share of that than any other; the machine does not, and no change of it since then, alike in all runs, explains
        that.

        Args:
            usual: residual of the model where nothing is wrong.
        """
        whole = self.left({})
        names = sorted(self.read & set(self.model.machine.sensor_names))
        if whole is None or not names:
            return
        for i, m in enumerate(self.readings.measurements):
            run = np.concatenate(
                [m.run[s.row] if s.source == i else np.zeros(len(s)) - 1 for s in self.readings.series]
            )
            runs = np.unique(run[run >= 0])
            beyond = self._first_beyond(run, runs, whole, ABOVE * usual)
            for first, name in itertools.product((beyond, beyond - 1), names):  # a delay hides the first run
                if first < HELD:
                    continue
                jump, share = self._jump(i, name, runs[first - 1], runs[first])
                others = (
                    self._jump(i, n, runs[first - 1], runs[first])[1]
                    for n in self.readings.machine.sensor_names
                    if n != name
                )
                most = all(o * np.sign(share) < abs(share) for o in others)
                if abs(jump) < REAL["degc"] or abs(share) > 1.0 / HALF or not most:
                    continue
                left, alike, off = self._off(i, name, run >= runs[first], runs[first:], whole)
                unmoved = -off / jump
                shows = HALF < unmoved[0] < 1.0 / HALF and float(np.median(unmoved)) > HALF
                if shows and left < min(NEAR_FIT * usual, FAR_LESS * alike):
                    yield _Edit(
                        left,
                        "lost_sensor",
                        f"{name} of {m.name} unknown from run {int(runs[first])} on",
                        f"it jumps by {significant(jump, 2, sign=True)} K there, which the machine does not show, and "
                        "may have come loose",
                        "that sensor and its cable",
                    )

    def _jump(self, source: int, name: str, last: float, first: float) -> tuple[float, float]:
        """Jump of a sensor of a file from a run to another, K, and over its range before; zero where it is not read."""
        m, shown = self.readings.measurements[source], self.readings.states[source].channels.get(name)
        if shown is None:
            return 0.0, 0.0
        jump = float(np.median(shown[m.run == first]) - np.median(shown[m.run == last]))
        return jump, jump / max(float(np.ptp(shown[m.run < first])), REAL["degc"])

    def _first_beyond(self, run: Floats, runs: Floats, whole: Floats, holds: float) -> int:
        """Which of some runs is the first with which the model no longer holds; 0 for none.

        Args:
            run: run of each reading, negative in other files, (m,).
            runs: the runs of a file, in order.
            whole: residual, (m,).
            holds: up to which the model holds.
        """
        readings = self.readings
        for last in range(1, len(runs)):
            drop = (run > runs[last]) | (run < 0)
            few = readings.without(drop)
            there = np.array([not drop[s.part].all() for s in readings.series])
            left = floor.rms_by_series(few, floor.cleaned(few, whole[~drop]))
            if floor.pooled(few, left, self.scale[there]) > holds:
                return last
        return 0

    def _off(
        self, source: int, name: str, since: NDArray[np.bool_], runs: Floats, whole: Floats
    ) -> tuple[float, float, Floats]:
        """Residual if a sensor was off by an amount of its own in each of some runs, and these amounts, K.

        Between them: the residual if the machine changed then, by as much as one amount makes without a delay.

        Args:
            source: number of the file.
            name: the sensor.
            since: readings of these runs, (m,).
            runs: the last runs of the file.
            whole: residual, (m,).
        """
        m, state = self.readings.measurements[source], self.readings.states[source]

        def by(off: NDArray[np.bool_]) -> Floats:
            changed = self.left({name: lambda s: s.channels[name] + (off if s is state else 0.0)})
            return np.zeros(len(since)) if changed is None else whole - changed

        def left(columns: Floats) -> tuple[float, Floats]:
            errors = solve(columns, read)
            rms = floor.rms_by_series(self.readings, read - columns @ errors)
            return floor.pooled(self.readings, rms, self.scale), errors

        ends = [float(m.time_s[m.run <= r].max()) for r in (float(runs[0]) - 1.0, *runs)]
        own = [by((m.time_s > begin) & (m.time_s <= end)) for begin, end in itertools.pairwise(ends)]
        alike = np.where(since, by(np.ones(len(m), dtype=np.bool_)), 0.0)
        flat = floor.cleaned(self.readings, np.stack([*own, alike, whole], axis=1))
        read = flat[:, -1]
        (one, off), (other, _) = left(flat[:, :-2]), left(flat[:, -2:-1])
        return one, other, off

    def _within(self, by_s: float) -> "_Edits":
        """The same with the readings at which moved channels are known."""
        times = [s.time_s for s in self.readings.states]
        out = [
            (t < times[s.source][0] - by_s) | (t > times[s.source][-1] - by_s)
            for s in self.readings.series
            for t in [s.time_s]
        ]
        drop = np.concatenate(out)
        if not drop.any() or drop.all():
            return self
        there = np.array([not drop[s.part].all() for s in self.readings.series])
        return _Edits(self.model, self.readings.without(drop), self.scale[there])

    @cached_property
    def _current(self) -> float:
        """Root mean square of the residual without an edit."""
        return float(self.residuals([{}])[0])

    def _room(self, axis: Axis) -> tuple[float, float]:
        """Smallest and largest shift of an origin, mm: positions stay within the travel."""
        low, high = axis.travel_mm
        reach, beyond = SHIFT * (high - low), BEYOND * (high - low)
        first, last = self._reached(axis)
        return max(-reach, low - beyond - first), min(reach, high + beyond - last)

    def _reads(self, series: Series, axis: Axis) -> bool:
        """Whether the model's prediction of a series depends on the position of an axis."""
        reads = [axis.channel in f.effect.channels(self.model.machine) for f in self.model.effects]
        return any(r and bool(np.any(p[series.part])) for r, p in zip(reads, self.parts, strict=True))

    def _shifted(self, axis: Axis) -> float:
        """Root mean square of the residual beside shifts proportional to the model's prediction along an axis.

        Growth of a part at the mount of the axis shifts the readings of that axis as another origin does.
        """
        here = [f.effect.channels(self.model.machine) for f in self.model.effects]
        names = sorted(
            {c for read in here if axis.channel in read for c in read} & set(self.model.machine.sensor_names)
        )
        left = self.left({})
        if left is None or not names:
            return math.inf
        mine = np.isin(self.readings.series_of, [i for i, s in enumerate(self.readings.series) if self._reads(s, axis)])
        values = [np.where(mine, self.readings.channel(n), 0.0) for n in names]
        columns = floor.cleaned(self.readings, np.stack([*values, left], axis=1))
        shifts = columns[:, :-1]
        rest = columns[:, -1] - shifts @ solve(shifts, columns[:, -1])
        return floor.pooled(self.readings, floor.rms_by_series(self.readings, rest), self.scale)


def _few_runs(readings: Readings) -> list[Doubt]:
    """Files with runs, too few to hold any out."""
    out = []
    for s in readings.series:
        runs = int(s.run[-1]) + 1
        if 1 < runs < FEW_RUNS and s.nuisance.shape[1]:
            message = f"{_name(readings, s)} has {runs} runs, each with a zero of its own: too few to separate them."
            out.append(Doubt("few_runs", message, f"Measure at least {FEW_RUNS} runs."))
    return out
