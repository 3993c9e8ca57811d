"""Warnings on a fit in words, with numbers and a remedy.

Some are about the measurement, which no residual shows: targets in step with the pitch, an unused arm.
"""

from collections.abc import Sequence

import numpy as np

from rtec.arrays import Floats
from rtec.characterise.choose import SAME
from rtec.characterise.coverage import cover_warnings, places_mm
from rtec.characterise.result import UndecidedTerm, Warn
from rtec.estimation.end_targets import NEXT
from rtec.estimation.gram.fit import Estimate
from rtec.estimation.gram.identifiable import label
from rtec.estimation.gram.source import Source, reads
from rtec.estimation.gram.stream import Term
from rtec.estimation.joint import NARROW_K
from rtec.estimation.judge import Judgement
from rtec.estimation.kinds import neighbour_noise
from rtec.estimation.outliers import outlier_words
from rtec.estimation.unmeasured import unmeasured_motions
from rtec.estimation.visible import axis_of, moves
from rtec.estimation.warmth import expands_much
from rtec.machine import Axis, Machine
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.procedures.iso230_2 import hidden_period
from rtec.wording import counted, significant

SEEN_ALL_ROUND = 0.4
"""The periodic error shows if no gap between the readings' phases is larger (two phases: a half, three: a third)."""
ARM_WAY = "leave component out where these are the instrument's own readings; leave the offset out where they are not"
PITCH_WAY = "add a dense run over one or two pitches, or take targets that are no multiples of the pitch"


def setup_warnings(sources: Sequence[Source]) -> list[Warn]:
    """Warnings on errors that the set-ups hide from the fit."""
    machine = sources[0].measurement.machine
    hidden = [w for axis in machine.axes for w in _in_step_with_pitch(sources, axis)]
    unused = [(s.measurement.name, unused_offset(s.measurement.instrument)) for s in sources]
    return hidden + [Warn("arm_unused", f"{name}: {text}", ARM_WAY) for name, text in unused if text]


def unused_offset(instrument: Instrument) -> str | None:
    """A sentence on an offset in the set-up that is not used, because the instrument reads its component directly.

    None where there is no such offset, or it is zero.
    """
    if instrument.component is None:
        return None
    setup = instrument.setup.model_dump()
    away = {k: v for k, v in setup.items() if k.endswith("offset_mm") and v is not None and np.any(np.asarray(v))}
    if not away:
        return None
    offsets = " and ".join(f"{k} = [{', '.join(f'{x:g}' for x in v)}]" for k, v in away.items())
    return (
        f'component = "{instrument.component}" says that the readings are that component already, so {offsets} is not '
        "used and no Abbe arm enters"
    )


def _in_step_with_pitch(sources: Sequence[Source], axis: Axis) -> list[Warn]:
    """A warning on the joint positions of one axis in all measurements of its positioning error."""
    component = f"E{axis.direction}{axis.name}"
    if axis.pitch_mm is None or component not in sources[0].measurement.machine.components:
        return []
    seen = [s for s in sources if moves(s.measurement, axis) and reads(s, component)]
    if not seen:
        return []
    places = np.unique(np.concatenate([s.measurement.channels[axis.channel] for s in seen]))
    if _widest_gap(places / axis.pitch_mm) < SEEN_ALL_ROUND:
        return []
    names = ", ".join(s.measurement.name for s in seen)
    return [
        Warn("pitch_multiple", f"axis {axis.name} ({names}): {text[0].lower()}{text.partition('. ')[0][1:]}", PITCH_WAY)
        for text in hidden_period(places, axis.pitch_mm)
    ]


def _widest_gap(turns: Floats) -> float:
    """Largest part of a turn without a reading."""
    phase = np.sort(np.mod(turns, 1.0))
    return float(np.diff(np.append(phase, phase[0] + 1.0)).max())


OVER_FITTED = 1.5
"""Held-out error over in-sample error."""
LEFT_OVER = 2.0
"""Residual over the noise floor."""
UNEVEN = 2.5
"""Residuals over the noise between neighbours that differ by more than this factor."""
ILL = 30.0
"""Condition number of scaled columns above which coefficients are poorly separated (Belsley, Kuh and Welsch)."""
COLLINEAR = 0.98
ONE = 0.005
"""A factor that differs from one by less than this is not shown."""
VISITED = 0.9
GAP = 0.4
"""A gap between places counts as not read if it is larger than this share of the travel."""
FEW_BLOCKS = 8
LITTLE_INFORMATION = 0.05
OPPOSITE = 0.5
RIVALS = 6
"""Largest number of equally good effects that are named."""


def all_warnings(
    fit: Estimate,
    judged: Judgement,
    undecided: Sequence[UndecidedTerm],
    same: Sequence[tuple[Term, Term, float]],
    unused: Sequence[tuple[str, str]],
) -> list[Warn]:
    """All warnings, the most important ones first."""
    found = [
        *(Warn("end_targets", ends.message, NEXT) for ends in judged.given.ends),
        *_confounded(same, fit.sources[0].measurement.machine),
        *_over_fitted(fit, judged),
        *_left_over(judged),
        *_uneven(fit),
        *_undecided([r for r in undecided if not _of_another_part(r)]),
        *_which_part([r for r in undecided if _of_another_part(r)]),
        *_ill_conditioned(fit),
        *_collinear(fit),
        *_sign_changes(fit),
        *setup_warnings(fit.sources),
        *_expands_much(fit),
        *_unmeasured(judged),
        *_not_visited(fit),
        *cover_warnings(fit.sources),
        *_on_bound(fit),
        *_few_blocks(fit),
        *_outliers(judged),
    ]
    return found + [Warn("sensor_unused", text, way) for text, way in unused]


def _confounded(same: Sequence[tuple[Term, Term, float]], machine: Machine) -> list[Warn]:
    """Terms whose coefficient is that of a sum: a term that was not chosen is confounded with them."""
    out = []
    for mine in dict.fromkeys(label(t) for t, _, _ in same):
        rows = [(_number(t, machine), _called(o, machine), share) for t, o, share in same if label(t) == mine]
        numbers, others = list(dict.fromkeys(n for n, _, _ in rows)), list(dict.fromkeys(o for _, o, _ in rows))
        one = next(_called(t, machine) for t, _, _ in same if label(t) == mine)
        sums = [
            (one if len(numbers) == 1 else number)
            + "".join(f" {'+' if a > 0 else '-'} {_times(abs(a))}{o}" for n, o, a in rows if n == number)
            for number in numbers
        ]
        make = "makes" if len(others) == 1 else "make"
        its = "its number is that" if len(numbers) == 1 else "its numbers are those"
        out.append(
            Warn(
                "confounded",
                f"{mine} is not determined alone: {' and '.join(others)} {make} the same readings; {its} of "
                f"{', '.join(sums)}",
                "take a test that separates them (rtec plan names it); correct with this number only where the "
                "others are zero",
            )
        )
    return out


def _number(term: Term, machine: Machine) -> str:
    """Names of the coefficients of a term."""
    return ", ".join(term.names(machine))


def _called(term: Term, machine: Machine) -> str:
    """Short name of a term; with its coefficient where the same effect may have several terms."""
    several = term.only is not None or hasattr(term.effect, "degrees")
    return f"{label(term)} {_number(term, machine)}" if several else label(term)


def _times(factor: float) -> str:
    return "" if abs(factor - 1.0) < ONE else f"{significant(factor)} · "


def _over_fitted(fit: Estimate, judged: Judgement) -> list[Warn]:
    ratio = judged.held_out / max(judged.residual, 1e-12)
    if ratio <= OVER_FITTED:
        return []
    return [
        Warn(
            "over_fitted",
            f"over-fitted: the error on held-out readings is {ratio:.1f} times that in sample; the "
            f"{fit.linear.width} coefficients follow these readings more than the machine",
            "fit fewer effects, or measure over more thermal cycles",
        )
    ]


def _left_over(judged: Judgement) -> list[Warn]:
    out = []
    for m, met in zip(judged.readings.measurements, judged.by_measurement, strict=True):
        ratio = met.residual / max(met.floor, 1e-12)
        if ratio > LEFT_OVER:
            out.append(
                Warn(
                    "left_over",
                    f"{m.name}: the residual is {ratio:.1f} times the noise floor",
                    "an effect is missing from the model: rtec diagnose names it, rtec compare shows where it is",
                )
            )
    return out


def _uneven(fit: Estimate) -> list[Warn]:
    """Measurements by equal instruments where one has a far larger residual, though their noise is the same."""
    ratios: dict[tuple[str, str | None], list[tuple[float, str]]] = {}
    for source, left in zip(fit.sources, fit.residuals, strict=True):
        m = source.measurement
        size = max(float(np.sqrt(np.nanmean(row**2))) / neighbour_noise(row, m.run) for row in left)
        ratios.setdefault((m.instrument.name, m.instrument.component), []).append((size, m.name))
    out = []
    for found in ratios.values():
        (low, best), (high, worst) = min(found), max(found)
        if len(found) > 1 and high > UNEVEN * max(low, 1.0):
            text = (
                f"{worst} is met {high / low:.0f} times worse than {best}, though their neighbouring readings differ "
                "alike: what differs between them (heat, load, place) is not in the model"
            )
            out.append(Warn("uneven", text, f"fit them apart, or add what changed; without {best} the numbers differ"))
    return out


def _undecided(rivals: Sequence[UndecidedTerm]) -> list[Warn]:
    """For each term the equally good alternatives, the best one of each effect: causes are named, not sensors."""
    out = []
    for mine in dict.fromkeys(r.instead_of for r in rivals):
        kinds: dict[str, list[UndecidedTerm]] = {}
        for r in rivals:
            if r.instead_of == mine:
                kinds.setdefault(r.candidate.split(" of ")[0], []).append(r)
        said = "; ".join(_as_well(alike) for alike in list(kinds.values())[:RIVALS])
        more = f"; and {counted(len(kinds) - RIVALS, 'more effect')}" if len(kinds) > RIVALS else ""
        component = next(r.component for r in rivals if r.instead_of == mine)
        out.append(
            Warn(
                "undecided",
                f"undecided for {component}: these readings do not decide between near-equal choices: in place of "
                f"{mine} as well {said}{more}",
                "measure through another cycle in which these temperatures part (another speed, a rest, a warm start)",
            )
        )
    return out


def _of_another_part(rival: UndecidedTerm) -> bool:
    """Whether an alternative makes the same readings by the same temperature, in another component."""
    return rival.alike and rival.apart <= SAME * rival.chosen_held_out


def _which_part(rivals: Sequence[UndecidedTerm]) -> list[Warn]:
    """One warning on all terms whose readings another part would make as well."""
    alike: dict[str, dict[str, None]] = {}
    for r in rivals:
        alike.setdefault(r.instead_of, {})[r.candidate.partition(" of ")[0]] = None
    if not alike:
        return []
    each = [f"in place of {mine} as well {' or '.join(others)}" for mine, others in alike.items()]
    more = f"; and {counted(len(each) - RIVALS, 'more term')}" if len(each) > RIVALS else ""
    return [
        Warn(
            "which_part",
            f"these readings do not show which part moved: {'; '.join(each[:RIVALS])}{more}",
            "none of this changes the correction at the arms and poses that were measured; an indicator on each part, "
            "or an instrument at another arm, separates them",
        )
    ]


def _as_well(alike: Sequence[UndecidedTerm]) -> str:
    best = alike[0]
    others = f", {len(alike) - 1} more of this effect" if len(alike) > 1 else ""
    return f"{best.candidate} ({100 * (best.held_out / best.chosen_held_out - 1):+.1f} % held out{others})"


def _ill_conditioned(fit: Estimate) -> list[Warn]:
    condition = fit.linear.condition()
    if condition <= ILL:
        return []
    scaled, _ = fit.linear.scaled()
    weak = np.abs(np.linalg.eigh(scaled)[1][:, 0])
    index = [int(fit.linear.owner[i]) for i in np.flatnonzero(weak[: fit.linear.width] > 0.2 * weak.max())]
    said = ", ".join(dict.fromkeys(label(fit.terms[i]) for i in index)) or "the nuisances"
    return [
        Warn(
            "ill_conditioned",
            f"condition number {condition:.0f}: hardly separated: {said}; their sum is known, each alone is not",
            "leave one out, or measure where they differ",
        )
    ]


def _collinear(fit: Estimate) -> list[Warn]:
    machine = fit.sources[0].measurement.machine
    used = sorted({c for t in fit.terms for c in t.effect.channels(machine)} & set(machine.sensor_names))
    names = [n for n in machine.sensor_names if all(n in s.measurement.channels for s in fit.sources)]
    if len(names) < 2:
        return []
    series = np.stack([np.concatenate([s.measurement.channels[n] for s in fit.sources]) for n in names])
    ok = np.isfinite(series).all(axis=1) & (np.ptp(np.nan_to_num(series), axis=1) > 0)
    good = [n for n, fine in zip(names, ok, strict=True) if fine]
    table = np.corrcoef(series[ok]) if len(good) > 1 else np.eye(len(good))
    pairs = [
        f"{a} and {b} ({table[i, j]:.3f})"
        for i, a in enumerate(good)
        for j, b in enumerate(good)
        if (i < j and a in used and b in used) and abs(table[i, j]) > COLLINEAR
    ]
    if not pairs:
        return []
    more = f" and {len(pairs) - 6} pairs more" if len(pairs) > 6 else ""
    return [
        Warn(
            "collinear",
            f"sensors that the model uses are collinear: {', '.join(pairs[:6])}{more}; either may stand for the other",
            "warm one part without the other (spindle off and axis moving, or the reverse), or use one of them",
        )
    ]


def _sign_changes(fit: Estimate) -> list[Warn]:
    """Coefficients that change their sign between parts of the day, each estimated alone with the others fixed."""
    normal, values = fit.linear.by_part, fit.values
    machine = fit.sources[0].measurement.machine
    named = [(label(t), n) for t in fit.terms for n in t.names(machine)]
    out = []
    diagonal = np.diagonal(normal.gram, axis1=1, axis2=2)[:, : normal.width]
    score = normal.gram[:, : normal.width, -1] - normal.gram[:, : normal.width, :-1] @ values
    noise = max(fit.inside, 1e-12)
    for k, (term, name) in enumerate(named):
        informed = diagonal[:, k] > LITTLE_INFORMATION * diagonal[:, k].sum() / len(diagonal)
        alone = values[k] + score[informed, k] / diagonal[informed, k]
        sure = np.abs(alone) > 4.0 * noise / np.sqrt(diagonal[informed, k])
        against = (np.sign(alone) == -np.sign(values[k])) & (np.abs(alone) > OPPOSITE * abs(values[k])) & sure
        if against.any():
            out.append(
                Warn(
                    "sign_change",
                    f"{term} {name} changes sign between cycles: {significant(values[k])} over all, but of the other "
                    f"sign in {int(against.sum())} of {int(informed.sum())} parts of the record (as far as "
                    f"{significant(alone[against][0])})",
                    "it takes the place of another cause; look for that, or omit it",
                )
            )
    return out


def _expands_much(fit: Estimate) -> list[Warn]:
    """Screws and scales that would expand more than any material of a machine."""
    out = []
    for i, term in enumerate(fit.terms):
        k, error = (float(v[np.flatnonzero(fit.linear.owner == i)[0]]) for v in (fit.values, fit.errors))
        if expands_much(term.effect, k, error):
            text = (
                f"{label(term)}: k = {significant(k)} µm/(m·K) is more than a material of a machine expands (steel 12, "
                "aluminium 23): the sensor shows less than the screw warms, or this number stands for another effect, "
                "such as a scale, and is wrong on another day"
            )
            out.append(
                Warn("expands_much", text, "fit with scale and squareness beside it, on days of other temperatures")
            )
    return out


def _unmeasured(judged: Judgement) -> list[Warn]:
    """Motions that angles bring along where no reading shows them."""
    there = unmeasured_motions(judged.model.effects, judged.readings)
    return [Warn("unmeasured_motion", m.words, m.advice) for m in there]


def _not_visited(fit: Estimate) -> list[Warn]:
    """Components that were read over a part of the travel only, grouped by that part."""
    machine, out = fit.sources[0].measurement.machine, []
    parts: dict[tuple[str, float, float, str], list[str]] = {}
    for component in dict.fromkeys(t.effect.component for t in fit.terms):
        axis = axis_of(component, machine)
        mine = [t for t in fit.terms if t.effect.component == component]
        if axis is None or not any(axis.channel in t.effect.channels(machine) for t in mine):
            continue
        places = places_mm(fit.sources, component, axis)
        low, high = (float(places[0]), float(places[-1])) if len(places) else (0.0, 0.0)
        gap = int(np.argmax(np.diff(places))) if len(places) > 1 else 0
        travel = axis.travel_mm[1] - axis.travel_mm[0]
        wide = len(places) > 1 and places[gap + 1] - places[gap] > GAP * travel
        between = f", and nowhere between {places[gap]:g} and {places[gap + 1]:g} mm" if wide else ""
        if high - low < VISITED * travel or between:
            parts.setdefault((axis.name, low, high, between), []).append(component)
    for (name, low, high, between), components in parts.items():
        travelled, reach = machine.axis(name).travel_mm, _range(fit.sources, machine.axis(name).channel)
        beyond = reach[1] - reach[0] > 1.1 * (high - low)
        said = f"{', '.join(components)}: axis {name} was measured from {low:g} to {high:g} mm only{between}"
        then = (
            f"other components were read from {reach[0]:g} to {reach[1]:g} mm, where these are extrapolated"
            if beyond
            else "the correction holds outside"
        )
        text = f"{said}; its travel is {travelled[0]:g} to {travelled[1]:g} mm; {then}"
        out.append(Warn("not_visited", text, "measure them over the whole travel"))
    used = {c for t in fit.terms for c in t.effect.channels(machine)}
    for sensor in (s for s in machine.sensor_names if s in used):
        low, high = _range(fit.sources, sensor)
        if high - low < NARROW_K:
            out.append(
                Warn(
                    "narrow_temperature",
                    f"{sensor} varied from {low:.1f} to {high:.1f} °C only; its coefficient is for that range",
                    "measure through a full warm-up",
                )
            )
    return out


def _range(sources: Sequence[Source], channel: str) -> tuple[float, float]:
    there = [s.measurement.channels[channel] for s in sources if channel in s.measurement.channels]
    if not there:
        return 0.0, 0.0
    return float(min(np.nanmin(v) for v in there)), float(max(np.nanmax(v) for v in there))


def _on_bound(fit: Estimate) -> list[Warn]:
    return [
        Warn(
            "on_bound",
            f"{label(fit.terms[i])}: {name} = {fit.terms[i].theta[name]:.4g} is on the bound of the search",
            "the effect is not what its equation says; try it without lag, or another effect",
        )
        for i, name in fit.found.on_bound
    ]


def _few_blocks(fit: Estimate) -> list[Warn]:
    blocks = len(fit.linear.gram)
    if blocks >= FEW_BLOCKS:
        return []
    return [
        Warn(
            "few_blocks",
            f"only {blocks} blocks of readings: standard errors and held-out errors are rough",
            f"measure at least {FEW_BLOCKS} runs, over more than one thermal cycle",
        )
    ]


def _outliers(judged: Judgement) -> list[Warn]:
    """Outliers that were excluded, with their rows."""
    way = "look at these rows; if they are real, the model lacks their cause"
    return [Warn("outliers", text, way) for text in outlier_words(judged.given.wrong)]
