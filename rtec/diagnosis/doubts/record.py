"""All doubts about a record, each with a next step.

Those that are `fatal` precede every answer, and no effect is named beside a contradiction.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.diagnosis.doubts.bar_length import length_of_circles
from rtec.diagnosis.doubts.doubt import ALONE, Doubt, Kind
from rtec.diagnosis.doubts.edited import BETTER, edited_record, moves
from rtec.diagnosis.doubts.edits import Edit
from rtec.diagnosis.doubts.implausible import implausible
from rtec.diagnosis.doubts.not_read import follows
from rtec.diagnosis.doubts.own_scale import own_scale_of
from rtec.effects import State
from rtec.estimation import floor
from rtec.estimation.contradiction import contradiction
from rtec.estimation.cycles import cycles
from rtec.estimation.end_targets import NEXT
from rtec.estimation.judge import Judgement
from rtec.estimation.moved_zero import STEP, moved_zeros
from rtec.estimation.one_pass import one_pass
from rtec.estimation.readings import Readings, Series
from rtec.estimation.rotary import STEP as ONE_ANGLE
from rtec.estimation.rotary import turned_with
from rtec.estimation.slipped import STEP as APART
from rtec.estimation.slipped import slipped
from rtec.estimation.two_levels import STEP as STATES
from rtec.estimation.two_levels import two_levels
from rtec.estimation.warm_start import STEP as BEGIN
from rtec.estimation.wrong_scale import odd_scales
from rtec.model import Model
from rtec.model.history import steps_of
from rtec.wording import ERROR_UNITS, duration, listed, percent, significant, sizes, two_numbers

FLAT, MUCH = 1.5, 5.0
"""Readings below this many times the noise are flat; a prediction above this many times it is large."""
DISAGREES, INSIDE = 3.0, 0.2
"""A model disagrees with a file where its residual is this many times that of its fit, on readings in the range of the
fit: at least this share of the file."""
UNEXPLAINED = 2.0
"""A residual of this many times noise and slow drift together is neither; none of 84 quiet records had 1.7 times."""
SCATTERS = 4.0
"""Neighbouring readings that scatter by this many times the noise of the model's fit are asked about."""
FEW_RUNS = 4
WHY: Mapping[Kind, tuple[Kind, ...]] = {
    "wrong_direction": ("wrong_channel",),
    "wrong_rate": ("wrong_rate",),
    "far_temperatures": ("wrong_channel",),
    "outside_travel": ("moved_origin", "turned_axis", "wrong_channel", "swapped_axes"),
}
"""Faults of a channel that explain what no machine can have recorded."""


def doubts(judged: Judgement) -> tuple[Doubt, ...]:
    """All doubts about the readings of a model, fatal ones first."""
    readings = judged.readings
    measured, predicted = (floor.cleaned(readings, v) for v in (readings.values, judged.base.predicted))
    edited = edited_record(judged, measured, predicted)
    found = [
        Doubt("wrong_scale", fault, "Correct the file first.", fatal=True)
        for fault in odd_scales(readings, measured, predicted)
    ]
    if edited is not None and edited.residual < BETTER * _left_by_scale(judged, measured, predicted):
        found = []  # a channel is wrong, and so is the prediction
    one_factor = edited is not None and edited.kind == "wrong_gain"  # explains why files differ, too
    impossible = [d for d in implausible(judged) if edited is None or not _why(edited, d)]
    found += [d for d in impossible if d.fatal]
    turned = [] if found else _turned(judged) or follows(judged)
    if not found and not turned and not one_factor and (odd := contradiction(judged)) is not None:
        step = f"{odd.check[0].upper()}{odd.check[1:]}; {odd.again}.{'' if odd.turned else f' {ALONE}'}"
        found = [Doubt("contradiction", f"{odd.message}.", step, fatal=True)]
    if not found and not turned and not one_factor and (own := own_scale_of(judged)) is not None:
        found = [own]
    found += turned
    if edited is None or edited.kind != "swapped_readings":  # of two exchanged columns one may be flat
        found += _corrected(judged, measured, predicted)
    if not found and edited is not None:
        found.append(edited.doubt(judged.residual, ERROR_UNITS[judged.unit]))
    if not found and (bar := length_of_circles(judged)) is not None:
        found.append(bar)
    step, levels = f"{STEP[0].upper()}{STEP[1:]}.", [] if found else _levels(judged)
    found += levels or [Doubt("moved_zero", moved.message, step, fatal=True) for moved in moved_zeros(readings)]
    found += _slipped(judged)
    step = f"{NEXT[0].upper()}{NEXT[1:]}."
    found += [Doubt("end_targets", f"{ends.message}.", step, fatal=True) for ends in judged.given.ends]
    if not found and not judged.given.delays:
        found += _disagree(judged)
    found += [d for d in impossible if not d.fatal]
    found += [Doubt("one_pass", p.message, p.next_step, fatal=p.one_way) for p in one_pass(readings)]
    found += [Doubt("warm_start", judged.given.starts, BEGIN)] if judged.given.starts else []
    found += _changed_delays(judged)
    found += _few_runs(readings)
    return tuple(found)


def _changed_delays(judged: Judgement) -> list[Doubt]:
    """A doubt about delays of the model that are others in these readings."""
    changed = [(judged.model.effects[i], delay_s) for i, delay_s in judged.given.delays.items()]
    if not changed:
        return []
    each = [f"{f.label} lags by {duration(s)} here, and by {duration(f.theta['tau'])} in the model" for f, s in changed]
    here, refitted = two_numbers(judged.residual, judged.refitted)
    it = "that" if len(changed) == 1 else "these"
    message = (
        f"{'; '.join(each)}. Refitted with {it}, the model leaves {refitted} in place of {here} "
        f"{ERROR_UNITS[judged.unit]}."
    )
    sensors = listed(list(dict.fromkeys(str(getattr(f.effect, "sensor", "the sensor")) for f, _ in changed)))
    is_ = "is where it was" if " and " not in sensors else "are where they were"
    step = f"`rtec improve` refits it. Check first that {sensors} {is_}: a moved sensor has another delay."
    return [Doubt("changed_delay", message, step)]


def _turned(judged: Judgement) -> list[Doubt]:
    """A doubt where the residual depends on the angle of a rotary axis."""
    said = turned_with(judged)
    return [Doubt("not_read", said, ONE_ANGLE, fatal=True)] if said else []


def _why(edited: Edit, impossible: Doubt) -> bool:
    """Whether a fault of a channel is why something is in the record that no machine can have done."""
    return edited.fatal and edited.kind in WHY.get(impossible.kind, ())


def _levels(judged: Judgement) -> list[Doubt]:
    """Series whose runs are at one of two levels; no effect is named where that is most of the residual."""
    left, out = floor.cleaned(judged.readings, judged.left), []
    for levels in two_levels(judged.readings, left):
        rest = judged.pooled(floor.cleaned(judged.readings, left - levels.readings))
        out.append(Doubt("two_levels", levels.message, STATES, fatal=rest**2 < BETTER * judged.residual**2))
    return out


def _slipped(judged: Judgement) -> list[Doubt]:
    """Series at rest that jump; no effect is named where the jump is most of the residual."""
    left, out = floor.cleaned(judged.readings, judged.left), []
    for moved in slipped(judged.readings):
        rest = judged.pooled(floor.cleaned(judged.readings, left - moved.by * moved.readings))
        fatal = rest**2 < BETTER * judged.residual**2
        out.append(Doubt("moved_zero", moved.message, f"{APART[0].upper()}{APART[1:]}.", fatal=fatal))
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
        # Of a part of the file, the instrument's zero is not known as of the whole.
        off = max(float(np.sqrt(np.mean((v if inside.all() else v - v.mean()) ** 2))) for v in left)
        if off < DISAGREES * usual:
            continue
        here, there = sizes(off, fitted)
        where = "" if inside.all() else " in the range of its fit"
        message = (
            f"The model leaves {here} {unit} of {m.name}{where}, and left {there} {unit} of the readings that it was "
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


def few_runs(readings: Readings) -> int:
    """How many runs there are in all, where these are two or three; else zero."""
    runs = sum(len(np.unique(m.run)) for m in readings.measurements)
    return runs if 1 < runs < FEW_RUNS else 0


def runs_too_few(judged: Judgement, likeliest: str) -> Doubt | None:
    """Doubt that nothing is missing where two or three runs leave far more than noise: any drift joins so few.

    Args:
        judged: the model.
        likeliest: effect that may explain the difference, in words; empty for none.
    """
    runs = few_runs(judged.readings)
    fresh = math.isfinite(judged.refitted) and judged.refitted < judged.residual
    left = judged.refitted if fresh else judged.residual
    if not runs or left <= UNEXPLAINED * judged.noise_floor:
        return None
    residual, smallest = sizes(left, judged.noise_floor)
    unit, also = ERROR_UNITS[judged.unit], "with refitted numbers " if fresh else ""
    message = (
        f"The residual {also}is {residual} {unit}, the noise floor {smallest} {unit}, and {runs} runs are too few to "
        f"say what changed between them{f'; {likeliest} may explain it' if likeliest else ''}."
    )
    step = f"Measure there and back at least {FEW_RUNS} times, cold and warm, with the temperatures."
    return Doubt("unexplained", message, step, fatal=True)


def scatters(judged: Judgement) -> Doubt | None:
    """Doubt where neighbouring readings scatter far more than at the model's fit, and than the display's steps."""
    model, readings = judged.model, judged.readings
    again = any(m.fingerprint in model.measurements.values() for m in readings.measurements)
    if again or judged.unit != "um" or not model.noise_um or judged.noise_floor < SCATTERS * model.noise_um:
        return None
    steps = [np.diff(np.unique(readings.values[s.part])).min(initial=math.inf) for s in readings.series]
    if any(f.value < step for f, step in zip(judged.floors, steps, strict=True) if math.isfinite(step)):
        return None
    here, there = sizes(judged.noise_floor, model.noise_um)
    message = (
        f"Neighbouring readings scatter by {here} µm, and by {there} µm at the model's fit: what changes from one "
        "reading to the next hides what is missing."
    )
    step = (
        "Look at the dwell before each reading, the feed to it, the mount, and the air in the beam; if another "
        "instrument took them, its noise is all that there is to see."
    )
    return Doubt("scatter", message, step, fatal=True)


def swings(judged: Judgement) -> Doubt | None:
    """Doubt where readings swing with a period that no recorded channel has; None where none do."""
    found = cycles(judged.readings, judged.left, np.array([f.value for f in judged.floors]))
    if not found:
        return None
    step = (
        "Find what switches so often (a chiller, coolant, hydraulics, air conditioning), and record its temperature or "
        "state beside the readings."
    )
    return Doubt("cycle", found[0].message, step, fatal=True)


def too_few(judged: Judgement, effect: str, size: float, drop: float) -> Doubt:
    """Doubt that readings are too few to name the effect that explains most of them.

    Args:
        judged: the model.
        effect: what explains them, in words.
        size: of what it explains, in the unit of the readings.
        drop: relative fall of the mean square on held-out runs.
    """
    explains, residual = sizes(size, judged.residual)
    unit = ERROR_UNITS[judged.unit]
    message = (
        f"{effect} explains {explains} of the {residual} {unit} of the residual, and adding it removes {percent(drop)} "
        "of the held-out mean square error; but so few readings do not separate it from a jump or a drift."
    )
    step = "Measure there and back at least four times; until then `rtec add` adds it on trial."
    return Doubt("too_few", message, step, fatal=True)


def _in_range(model: Model, state: State) -> Bools:
    """Which instants are in the range of the model's fit, (n,)."""
    out = np.ones(len(state), dtype=np.bool_)
    for name, (low, high) in model.valid_range.items():
        if name in state.channels:
            out &= (state.channels[name] >= low) & (state.channels[name] <= high)
    return out


def _name(readings: Readings, s: Series) -> str:
    return f"{readings.measurements[s.source].name} {s.column}"


def _corrected(judged: Judgement, measured: Floats, predicted: Floats) -> list[Doubt]:
    """Series that are flat where the model predicts much: the loop was on while they were read.

    A display that never changed is not one of them.
    """
    out = []
    for s, noise in zip(judged.readings.series, judged.floors, strict=True):
        read, modelled = (float(np.sqrt(np.mean(v[s.part] ** 2))) for v in (measured, predicted))
        if moves(judged.readings, s) and read < FLAT * noise.value and modelled > MUCH * max(noise.value, read):
            flat, due = sizes(read, modelled)
            message = (
                f"{_name(judged.readings, s)} is flat ({flat} µm) where the model says {due} µm: was the correction on "
                "while it was measured?"
            )
            step = "Put the inserted corrections back into the readings, or measure with the correction held at zero."
            out.append(Doubt("corrected", message, step, fatal=True))
    return out


def _left_by_scale(judged: Judgement, measured: Floats, predicted: Floats) -> float:
    """Least residual of the model if the readings were in another unit, in the unit that they have."""
    by_series = []
    for s in judged.readings.series:
        mine, modelled = measured[s.part], predicted[s.part]
        factor = float(mine @ modelled) / max(float(modelled @ modelled), 1e-300)
        by_series.append(float(np.sqrt(np.mean((mine - factor * modelled) ** 2))))
    return floor.pooled(judged.readings, np.array(by_series), judged.scale)


def _few_runs(readings: Readings) -> list[Doubt]:
    """Files with runs, too few to hold any out."""
    out = []
    for s in readings.series:
        runs = int(s.run[-1]) + 1
        if 1 < runs < FEW_RUNS and s.nuisance.shape[1]:
            message = f"{_name(readings, s)} has {runs} runs, each with a zero of its own: too few to separate them."
            out.append(Doubt("few_runs", message, f"Measure at least {FEW_RUNS} runs."))
    return out
