"""Which candidates these readings cannot separate, and why.

Targets at equal steps show a wave of a period and its aliases as the same.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from rtec.arrays import Bools, Floats
from rtec.diagnosis.result import Alike
from rtec.diagnosis.words import labels
from rtec.effects import Effect
from rtec.effects.base import component_kind
from rtec.effects.cyclic import CyclicPole
from rtec.effects.motion import ServoLag
from rtec.effects.registry import all_effects
from rtec.effects.thermal import AxisExpansion, AxisExpansionNonuniform
from rtec.estimation.candidates import away_from
from rtec.estimation.readings import Readings
from rtec.machine import Machine
from rtec.model import FittedEffect
from rtec.wording import significant

SAME = 0.99
"""From this cosine between two contributions on, these readings cannot distinguish them."""
WITHIN = math.log(20.0)
WAVE = 0.9
"""From this cosine on, a curve may be a wave that equal targets fold onto it."""
FEIGNED = 10.0
"""Log odds that small errors of a sensor, its steps and its delay, can feign between effects that predict alike."""
ONE_FORMULA = 1.0 - 1e-6
APART = 0.3
"""Below this cosine two effects explain different parts of the readings."""


INDIRECT = 0.4
"""Each step away from the direct component lowers the logarithm of the prior by this."""
ELSEWHERE = math.log(30.0)
"""A sensor that is named after another axis lowers the logarithm of the prior by this, twice where the axis has one of
its own; one that is named after no axis once, then."""
AHEAD = math.log(10.0)
"""A drive that runs ahead of its command lowers the logarithm of the prior by this: without excessive feed-forward it
lags."""
USUAL = math.log(10.0)
"""Factor by which coefficients scatter about the usual size."""


NO_MACHINE = 1000.0
"""No machine has an effect of this many times its usual size."""


def plausibility(effect: Effect, values: Floats, machine: Machine) -> float:
    """Log of a weak prior on the size of an effect: its largest coefficient against its usual size.

    It orders what readings cannot separate, and never exceeds a few units, so that readings overrule it. Of two names
    for one shape, the less likely is the one that

    - would have to be a hundred times its usual size;
    - reaches the readings less directly: an angle of another axis, times its arm;
    - follows a sensor whose name says that it is at another axis, or on no axis where the axis has its own;
    - is a drive ahead of its command.
    """
    size = min(0.5 * (math.log(max(_against_usual(effect, values, machine), 1.0)) / USUAL) ** 2, 6.0)
    ahead = type(effect) is ServoLag and values[0] > 0.0
    return -size - INDIRECT * directness(effect, machine) - ELSEWHERE * away(effect, machine) - AHEAD * ahead


def unheard_of(effect: Effect, values: Floats, machine: Machine) -> bool:
    """Whether an effect would have a size that no machine has."""
    return _against_usual(effect, values, machine) > NO_MACHINE


def _against_usual(effect: Effect, values: Floats, machine: Machine) -> float:
    """Largest coefficient of an effect against its usual size."""
    usual = np.array([p.typical for p in effect.coefficients(machine)])
    return float(np.max(np.abs(values) / usual, initial=1e-300))


def elsewhere(effect: Effect, machine: Machine) -> bool:
    """Whether an effect follows a sensor whose name says that it is at another axis; of a spindle, at any axis."""
    axis = getattr(effect, "axis", None) or effect.component[2:].removeprefix("0")
    return any(machine.of_another_axis(c, axis) for c in effect.channels(machine) if c in machine.sensor_names)


def away(effect: Effect, machine: Machine) -> int:
    """How far the sensors of an effect are from what they act on, by their names; see `away_from`."""
    if not isinstance(effect, AxisExpansion | AxisExpansionNonuniform):
        return int(elsewhere(effect, machine))
    return away_from(machine, effect.sensor, effect.axis, machine.sensor_names)


def cosine(a: Floats, b: Floats) -> float:
    """Cosine between two contributions."""
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    return abs(float(a @ b)) / size if size > 0 else 0.0


def alike(one: Effect, other: Effect, cos: float, log_odds: float) -> Alike:
    """Why another effect is confused with one, and what separates them.

    Args:
        one: the effect in question.
        other: the other.
        cos: cosine between what the two contribute to the readings.
        log_odds: log evidence of the one over the other.
    """
    why, test = _from_catalogue(one, other)
    apart = cos < APART
    if apart:
        why, test = "", "add rank 1, then diagnose again"
        how = (
            f"it explains another part of the readings (cosine {cos:.2f}) and lowers the error on held-out runs: both "
            "may be missing"
        )
    elif cos > ONE_FORMULA:
        how = "on this machine, with these readings, the two are one and the same formula: either describes the error"
    elif cos > SAME:
        how = f"in these readings the two are the same shape (cosine {cos:.3f})"
    elif log_odds < 0.0:
        how = "it is likelier beside a slow drift, yet it predicts held-out runs far worse"
        test = ""
    elif log_odds > 2.0 * WITHIN:
        how = "it is less likely from these data, yet it predicts held-out runs as well or better"
        test = ""
    else:
        how = f"these readings favour it only {math.exp(min(log_odds, 20.0)):.0f} to 1"
    return Alike(
        other.effect,
        other.component,
        f"{how}; {why}" if why else how,
        test,
        label=labels([FittedEffect(one, {}), FittedEffect(other, {})])[1],
        apart=apart,
    )


TILTS = {"mount_expansion", "column_tilt", "spindle_tilt"}
"""What turns one part by one temperature or by the difference of two."""


def _from_catalogue(one: Effect, other: Effect) -> tuple[str, str]:
    """The catalogue's entries about two effects, in both directions."""
    kinds = all_effects()
    if one.component == other.component and one.component[1] in "ABC" and {one.effect, other.effect} <= TILTS:
        return "", _generic(one, other)
    for a, b in ((one, other), (other, one)):
        for confusion in kinds[a.effect].about.confusions if a.effect in kinds else ():
            if confusion.effect == b.effect:
                return confusion.why, confusion.separate_by
    return "", _generic(one, other)


def _generic(one: Effect, other: Effect) -> str:
    """What separates two effects without a common entry in the catalogue: move what drives only one of them."""
    mine, yours = _drivers(one), _drivers(other)
    if (one.effect, one.component) == (other.effect, other.component) and mine == yours:
        return ""  # another form of the same effect is no other cause
    only, others = sorted(mine - yours), sorted(yours - mine)
    if one.component != other.component:
        whole = all(getattr(e, "axis", None) is None for e in (one, other))
        if whole and one.component[1] == other.component[1] and one.component[1] in "XYZ":
            change = f"; {_changes(only, others)}" if only or others else ""
            return f"an indicator on each part, for at the tool tip only their sum shows{change}"
        return (
            f"measure where {one.component} and {other.component} act differently: another offset of the instrument, "
            "or one that reads one of them directly"
        )
    if only or others:
        return _changes(only, others)
    return "measure again with other values of what drives them, in another order"


def _changes(only: Sequence[str], others: Sequence[str]) -> str:
    """What drives one effect alone and what drives the other is changed in turn."""
    if not (only and others):
        return f"change {' or '.join(only or others)} with everything else as it is"
    stay = "stays as it is" if len(others) == 1 else "stay as they are"
    return f"change {' or '.join(only)} while {' and '.join(others)} {stay}, and the other way round"


def _drivers(effect: Effect) -> set[str]:
    given = effect.model_dump(exclude={"effect", "component"}, exclude_none=True)
    return {str(v) for k, v in given.items() if k in ("sensor", "front", "back", "axis", "other", "across")}


STEPS = {"positioning": 0, "straightness": 1, "axis_angle": 1, "tilt": 2, "roll": 2, "link": 3, "link_angle": 4}


def directness(effect: Effect, machine: Machine) -> int:
    """How directly a component shows in readings; the lower the more direct."""
    return STEPS.get(component_kind(effect.component, machine), 4)


def diverse(order: Sequence[int], kinds: Sequence[str], most: int, of_a_kind: int) -> list[int]:
    """The first items of an order, at most `most`, at most `of_a_kind` of each kind."""
    count: dict[str, int] = {}
    out = []
    for i in order:
        count[kinds[i]] = count.get(kinds[i], 0) + 1
        if count[kinds[i]] <= of_a_kind:
            out.append(i)
        if len(out) == most:
            break
    return out


AT_PITCH = 0.03
"""A period within this relative distance of the screw's pitch is that of the screw."""
ASKS = ("cyclic_pole", "coupling_misalignment")
"""Waves that a screw of another pitch causes as well."""
ABSENT = 0.1
"""A harmonic below this share of the largest is absent."""
LONGEST_PITCH_MM = 60.0
"""No screw has a longer pitch."""


def pitch_in_doubt(effect: Effect, theta: Mapping[str, float], machine: Machine, numbers: Floats) -> Alike | None:
    """A wave whose period is not the machine file's pitch: the file may be wrong; None for anything else.

    Twice a turn without a wave once a turn may be a screw of half the pitch or a coupling.

    Args:
        effect: the wave.
        theta: its parameters.
        machine: whose file is asked about.
        numbers: its coefficients, (k,).
    """
    period, part = period_mm(effect, theta), _part_of_turn(effect, numbers)
    if period is not None and part > 1:
        period /= part
    elif effect.effect not in ASKS:
        return None
    if period is None or period > LONGEST_PITCH_MM:
        return None
    axis = machine.axis(str(getattr(effect, "axis", "")))
    if axis.pitch_mm is None or abs(period / axis.pitch_mm - 1.0) < AT_PITCH:
        return None
    fits = "as well" if effect.effect in ("coupling_misalignment", "cyclic_screw") else "better"
    why = (
        f"a screw of pitch {significant(period, 3)} mm makes the same wave, and the machine file says pitch_mm = "
        f"{axis.pitch_mm:g}: these readings fit {fits} with {significant(period, 3)}"
    )
    test = f"read the pitch of {axis.name} from the screw or its data sheet, and correct pitch_mm if it is wrong"
    return Alike(
        "cyclic_screw", effect.component, why, test, label=f"cyclic_screw({effect.component}) of another pitch_mm"
    )


def _part_of_turn(effect: Effect, numbers: Floats) -> int:
    """How many times a screw's wave repeats in a turn: 2 where only even harmonics are there; 1 for others."""
    if effect.effect != "cyclic_screw":
        return 1
    size = np.hypot(numbers[0::2], numbers[1::2])
    most = int(np.argmax(size)) + 1
    others = [v for k, v in enumerate(size, 1) if k % most]
    return most if others and max(others) < ABSENT * float(size.max()) else 1


PERIODS = ("pitch", "period")
ANOTHER = 0.05
"""Periods within this relative difference are one."""
COINCIDES = 5e-3
"""A period that may be any is within this relative difference of the screw's in one case of some hundred."""
EVEN = 1e-3
"""Steps within this relative difference are equal."""
SCATTER, MOST_MOVES = 0.25, 0.8
"""Steps within this relative difference were meant to be equal, where this share of all are."""
NEAR_STEP = 0.15
"""A period within this relative distance of the step between targets is near it."""
AROUND = 0.5
"""Turns over the span by which an alias may deviate."""
LEAST_TARGETS = 5
PER_WAVE = 2.0
"""From this many steps in a period on it is not folded."""
ORDERS = (1, 2)
"""Multiples of the steps' own frequency whose aliases are reported."""
ALIASES = 2
"""This many aliases, the longest, are reported beside a curve and beside a wave without a name."""
RESOLVED_MM = 1e-3


def period_mm(effect: Effect, theta: Mapping[str, float]) -> float | None:
    """Period of a wave along an axis, mm; None for anything else, and for effects that may be more than a wave."""
    if getattr(effect, "axis", None) is None:
        return None
    return next((theta[name] for name in PERIODS if name in theta), getattr(effect, "lambda_mm", None))


def coincides(effect: Effect, theta: Mapping[str, float], machine: Machine) -> bool:
    """Whether a wave that is not the screw's has the screw's period, or half of it, by coincidence."""
    if not isinstance(effect, CyclicPole) or (pitch := effect.the_axis(machine).pitch_mm) is None:
        return False
    return any(abs(turn * pitch / theta["period"] - 1.0) < COINCIDES for turn in (1.0, 0.5))


def step_mm(readings: Readings, channel: str, seen: Bools) -> float | None:
    """Step between targets along an axis where all are equal, mm; None where they are not, or are few.

    Args:
        readings: the readings.
        channel: position channel of the axis.
        seen: which readings count, (m,).
    """
    places = np.unique(np.round(readings.channel(channel)[seen] / RESOLVED_MM) * RESOLVED_MM)
    if len(places) < LEAST_TARGETS:
        return None
    steps = np.diff(places)
    step = float(np.median(steps))
    return step if float(np.ptp(steps)) <= max(EVEN * step, 2.0 * RESOLVED_MM) else None


def nominal_step_mm(readings: Readings, channel: str, component: str) -> float | None:
    """Intended step between targets along an axis where each deviates slightly, mm; None where there is none.

    Args:
        readings: the readings.
        channel: position channel of the axis.
        component: whose readings count.
    """
    seen, places = readings.arms(component) != 0.0, readings.channel(channel)
    moves = np.abs(np.concatenate([np.diff(places[s.part][seen[s.part]]) for s in readings.series]))
    moves = moves[moves > RESOLVED_MM]
    if len(moves) < LEAST_TARGETS:
        return None
    near = moves[np.abs(moves / np.median(moves) - 1.0) < SCATTER]
    return float(near.mean()) if len(near) >= MOST_MOVES * len(moves) else None


def aliases_mm(period_mm: float, step: float) -> tuple[float, ...]:
    """Periods that targets at these steps cannot distinguish from this one, mm, the longest first."""
    own, comb = 1.0 / period_mm, 1.0 / step
    found = {abs(order * comb + sign * own) for order in (0, *ORDERS) for sign in (-1.0, 1.0)}
    others = sorted(f for f in found if f > 1e-9 and abs(f - own) > 1e-6 * own)
    return tuple(1.0 / f for f in others)


UNEVEN = 3.0
"""Of two numbers of opposite signs the larger is at most this many times the other where a difference is the cause."""
SHIFTS = ("mount_expansion", "ambient_drift", "spindle_growth")
"""Shifts by one sensor. Two of them with opposite signs are what a bending part does."""


def bent_part(effect: Effect, k: float, others: Sequence[tuple[Effect, float]]) -> Alike | None:
    """The part that bends by the difference of two sensors, where two shifts by one each were named; None elsewhere.

    Args:
        effect: the named one.
        k: its coefficient.
        others: effects beside it, and those of the model, with their first coefficients.
    """
    sensor = getattr(effect, "sensor", None)
    for other, value in others:
        its = getattr(other, "sensor", None)
        alike_ones = effect.effect in SHIFTS and other.effect in SHIFTS and effect.component == other.component
        if not alike_ones or None in (sensor, its) or sensor == its or not k * value < 0.0:
            continue
        if max(abs(k), abs(value)) > UNEVEN * min(abs(k), abs(value)):
            continue
        front, back = (sensor, its) if k > 0.0 else (its, sensor)
        why = f"shifts by {sensor} and by {its} with opposite signs are one part that bends by {front} - {back}"
        test = "drift probes at two heights, or a level, while one side is heated"
        return Alike("column_tilt", effect.component, why, test, label=f"column_tilt({front}, {back})")
    return None


LONG = 1.0
"""From this many turns over the span on, a curve may be a wave."""
FREQUENCIES = 60
CURVES = ("polynomial_position", "piecewise_position", "straightness", "angular_motion")


class _Along:
    """Waves along an axis at the readings that see a component, less what the current model can explain.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        component: whose readings count.
        channel: position channel of the axis.
    """

    def __init__(self, readings: Readings, base: Floats, component: str, channel: str) -> None:
        arms = readings.arms(component)
        self._seen = arms != 0.0
        self._arms, self._q = arms[self._seen], readings.channel(channel)[self._seen]
        self._known = np.linalg.qr(np.concatenate([np.ones((len(self._q), 1)), base[self._seen]], axis=1))[0]
        self.span_mm = float(np.ptp(self._q))

    def like_a_wave(self, per_mm: float, part: Floats) -> float:
        """Largest cosine between readings, (m,), and a wave of this frequency."""
        turns = 2.0 * np.pi * per_mm * self._q
        wave = self._left(np.stack([np.sin(turns), np.cos(turns)], axis=1) * self._arms[:, None])
        mine = self._left(part[self._seen])
        return cosine(wave @ np.linalg.lstsq(wave, mine, rcond=None)[0], mine)

    def like_a_wave_near(self, period_mm: float, part: Floats) -> float:
        """The same for the best of the periods that the span hardly separates from one."""
        about = np.linspace(-AROUND, AROUND, 11) / self.span_mm
        return max(self.like_a_wave(1.0 / period_mm + float(off), part) for off in about)

    def _left(self, values: Floats) -> Floats:
        return np.asarray(values - self._known @ (self._known.T @ values))


def curve_or_wave(readings: Readings, base: Floats, effect: Effect, part: Floats) -> Alike | None:
    """A wave near the step between equal targets that looks like a curve along the axis; None where there is none.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        effect: a curve along its axis, or anything else.
        part: what it adds to the readings, (m,).
    """
    axis = next((a for a in readings.machine.axes if a.name == getattr(effect, "axis", None)), None)
    if axis is None or effect.effect not in CURVES:
        return None
    step = step_mm(readings, axis.channel, readings.arms(effect.component) != 0.0)
    if step is None:
        return None
    along = _Along(readings, base, effect.component, axis.channel)
    frequencies = np.linspace(LONG / along.span_mm, 0.5 / step, FREQUENCIES)
    cosines = [along.like_a_wave(float(f), part) for f in frequencies]
    best, period = max(cosines), 1.0 / float(frequencies[int(np.argmax(cosines))])
    if best < WAVE:
        return None
    others = ", ".join(f"{p:.4g}" for p in aliases_mm(period, step)[:ALIASES])
    why = f"targets stand every {step:.4g} mm, and there a wave of {others} mm draws the same curve (cosine {best:.2f})"
    test = f"unequal steps along {axis.name}, or a few targets between two of these"
    return Alike("cyclic_pole", effect.component, why, test, label=f"a wave near the step ({effect.component})")


def fold(readings: Readings, base: Floats, effect: Effect, theta: Mapping[str, float], part: Floats) -> Alike | None:
    """A wave of another period that these targets cannot separate from that of an effect; None where they can.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        effect: a wave along its axis, or anything else.
        theta: its period.
        part: what it adds to the readings, (m,).
    """
    period, axis = period_mm(effect, theta), getattr(effect, "axis", None)
    if period is None or axis is None or not theta:
        return None
    channel = next(a.channel for a in readings.machine.axes if a.name == axis)
    step, nominal = step_mm(readings, channel, readings.arms(effect.component) != 0.0), False
    if step is None:
        step, nominal = nominal_step_mm(readings, channel, effect.component), True
    if step is None:
        return None
    known = "pitch" in theta or effect.effect != "cyclic_pole"
    folded = aliases_mm(period, step)[:3]
    if nominal:
        along = _Along(readings, base, effect.component, channel)
        cosines = {p: along.like_a_wave_near(p, part) for p in folded}
        close = abs(period / step - 1.0) < NEAR_STEP
        folded = tuple(p for p in folded if close or cosines[p] > WAVE)
        if not folded:
            return None
        listed = ", ".join(f"{p:.4g} mm (cosine {cosines[p]:.2f})" for p in folded)
        there = f"targets stand every {step:.4g} mm or nearly so, and there a wave of {period:.4g} mm"
        why = f"{there} is like one of {listed}"
    else:
        if known and period >= PER_WAVE * step:
            return None
        rests = "the period that the machine file gives" if known else "the longest period that may be"
        why = (
            f"targets stand every {step:.4g} mm, and there a wave of {period:.4g} mm looks like one of "
            f"{', '.join(f'{p:.4g}' for p in folded)} mm: the name rests on {rests}"
        )
    finest = period if known else min(folded)
    test = f"unequal steps along {axis}, or steps below {significant(finest / PER_WAVE)} mm"
    return Alike("cyclic_pole", effect.component, why, test, label=f"a wave of another period ({effect.component})")
