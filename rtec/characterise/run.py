"""Characterises a machine: from measurements to a geometric-thermal model."""

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats
from rtec.characterise.assemble import assemble, model_of
from rtec.characterise.candidates import (
    EVERY_MACHINE,
    Drive,
    TermCandidate,
    at_constant_temperature,
    drive,
    every_machine_has,
    is_at_constant,
)
from rtec.characterise.choose import TermChoice, choose, completed
from rtec.characterise.grouping import apart, joined
from rtec.characterise.own_scale import REMEDY, OwnScale, own_scale
from rtec.characterise.refine import refined
from rtec.characterise.result import Characterisation, Warn
from rtec.characterise.screen import Screened, screen
from rtec.characterise.significance import spared, surety
from rtec.characterise.warnings import FEW_BLOCKS
from rtec.effects import Effect
from rtec.effects.base import Kind, component_kind
from rtec.effects.effect_list import AskedEffects, read_wanted
from rtec.effects.spindle import SpindleGrowth
from rtec.effects.thermal import AxisExpansion, ColumnTilt, MountExpansion
from rtec.errors import MeasurementError as Fault
from rtec.errors import ModelError
from rtec.estimation import floor
from rtec.estimation.candidates import away_from
from rtec.estimation.columns import base_of
from rtec.estimation.contradiction import contradiction
from rtec.estimation.gram.fit import Estimate, estimate
from rtec.estimation.gram.identifiable import check_seen, names, tellable
from rtec.estimation.gram.projection import starting_terms
from rtec.estimation.gram.source import Source, reads, thinned
from rtec.estimation.gram.stream import Term, gather
from rtec.estimation.gram.weights import rough_noise
from rtec.estimation.held_out import cuts
from rtec.estimation.judge import Judgement
from rtec.estimation.moved_zero import STEP, moved_zeros
from rtec.estimation.one_pass import one_pass
from rtec.estimation.outliers import Clean, clean
from rtec.estimation.readings import Readings, faults_of
from rtec.estimation.rotary import STEP as ONE_ANGLE
from rtec.estimation.rotary import turned_with
from rtec.estimation.slipped import STEP as APART
from rtec.estimation.slipped import slipped
from rtec.estimation.targets import FEW as FEW_TARGETS
from rtec.estimation.targets import WAVES, predicts_targets, targets_along
from rtec.estimation.warm_start import STEP as BEGIN
from rtec.estimation.warm_start import WarmStart, cooling, in_words
from rtec.estimation.warmth import EXPANDS, SENSOR_S, SURE
from rtec.estimation.wrong_scale import odd_scales
from rtec.machine import Machine
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.metrology.measurement import Measurement
from rtec.metrology.travel import outside_travel, travel_words
from rtec.metrology.unread import is_rotary
from rtec.model import Model
from rtec.parallel import one_blas_thread
from rtec.wording import listed

Stage = Callable[[str, int, int], None]
"""Progress callback: called with the name of a stage, the number of steps done, and their total."""

SEARCHED = 20_000
"""Number of instants of each measurement for starting values of non-linear parameters."""
WORSE = 1.01
"""If parameters from the search raise the held-out error by more than this share, those of the choice are used."""
QUADRATIC = 2
OWN_SCALES = 3
"""Most times that measurements get a scale of their own."""
PLACES = ("position", "region", "cyclic")
"""Kinds of what depends on positions only."""
POOR, REFERENCES = 3.0, 4
"""A law that leaves more than this many times the noise of several files is asked about the sign of each; and this many
of them are fitted alone for that, at most."""
PITCHES = 41
"""Number of pitches at which a wave is fitted without the held-out targets."""


def characterise(
    measurements: Sequence[Measurement],
    *,
    wanted: AskedEffects | None = None,
    leave_out_h: float | None = None,
    name: str = "model",
    stage: Stage | None = None,
) -> Characterisation:
    """Choose the effects that the measurements show, fit them, and judge the model.

    The same measurements give the same model to the last bit.

    Args:
        measurements: measurements of one machine, by any instruments.
        wanted: the only effects to fit; None for a free choice.
        leave_out_h: hours that are held out together; by default whole runs, or 4 h where there are few runs.
        name: name of the model.
        stage: progress callback, see `Stage`.

    Raises:
        MeasurementError: there is no measurement, machines differ, or a channel has missing values.
        ModelError: nothing can be fitted, or the readings do not show a named effect.
    """
    with one_blas_thread():
        fitted = _whole_fit(measurements, wanted, leave_out_h, stage)
        given, fit = fitted.given, fitted.fit
        few = _too_few_circles(given, leave_out_h) if wanted is None else None
        made = assemble(fit, fitted.screened, fitted.choice, given, name)
        first = [*fitted.warnings, *([few] if few else [])]
        first += [fitted.doubt] if fitted.doubt else _of_wrong_scale(made.model, given, wanted, leave_out_h)
        first += _outside_travel(given.readings.measurements)
        first += [Warn("one_pass", p.message.rstrip("."), p.next_step.rstrip(".")) for p in one_pass(given.readings)]
        return replace(made, warnings=(*first, *made.warnings))


def fitted_model(
    measurements: Sequence[Measurement], *, wanted: AskedEffects | None = None, name: str = "model"
) -> Model:
    """Fit as `characterise`, for predictions only: without the judgement, which takes longer than the fit.

    Files that contradict the others are excluded without a warning.

    Raises:
        MeasurementError, ModelError: as `characterise`.
    """
    with one_blas_thread():
        return model_of(_whole_fit(measurements, wanted, None, None).fit, name)


def _given(measurements: Sequence[Measurement], leave_out_h: float | None) -> tuple[Clean, Warn | None]:
    """Exclude outliers, files that contradict the others, and runs whose zero has moved; a warning on the latter."""
    given = clean(measurements, leave_out_h=leave_out_h).without_ends()
    found = contradiction(Judgement(Model(measurements[0].machine), given))
    if found is None:
        return _without_moved_zeros(given)
    if not found.odd:
        return given, Warn("contradiction", found.message, f"{found.check}; {found.again}")
    rest = [m for i, m in enumerate(measurements) if i not in found.odd]
    text = f"{found.message} ({'it was' if len(found.odd) == 1 else 'they were'} left out of the fit)"
    return clean(rest, leave_out_h=leave_out_h).without_ends(), Warn(
        "contradiction", text, f"{found.check}; put right, fit again"
    )


@dataclass(frozen=True)
class _WholeFit:
    """A fit with its readings, the choice before it, and warnings on measurements that do not fit to the others."""

    given: Clean
    doubt: Warn | None
    fit: Estimate
    screened: Screened | None
    choice: TermChoice | None
    warnings: tuple[Warn, ...] = ()


def _whole_fit(
    measurements: Sequence[Measurement], wanted: AskedEffects | None, leave_out_h: float | None, stage: Stage | None
) -> _WholeFit:
    """Fit, and again where measurements get a scale of their own, which the others contradict, or an unknown start."""
    _check(measurements)
    measurements, turned = _without_turned(measurements, wanted, leave_out_h)
    told: list[OwnScale] = []
    begun: list[WarmStart] = []
    while True:
        given, doubt = _given(measurements, leave_out_h)
        fit, screened, choice = _fit(given, doubt, wanted, leave_out_h, stage)
        files = given.readings.measurements
        begun = cooling(model_of(fit, ""), given.readings) or begun
        warm = {s.name for s in begun}
        freed = {m.name: _opened(m, "start", "settled", "unknown") for m in files if m.name in warm}
        own = {name: m for name, m in freed.items() if m is not None}
        found = None
        if not own and wanted is None and screened is not None and choice is not None and len(told) < OWN_SCALES:
            candidates = screened.candidates
            found = own_scale(screened.sources, [candidates[i] for i in choice.chosen], candidates)
        if found is not None:
            told.append(found)
            freed = {files[i].name: _opened(files[i], "slope", "none", "setup") for i in found.files if found.decided}
            own = {name: m for name, m in freed.items() if m is not None}
        if not own:
            break
        measurements = [own.get(m.name, m) for m in measurements]
    scales = (_of_own_scale(t, files, fit) for t in told)
    return _WholeFit(given, doubt, fit, screened, choice, (*turned, *scales, *_of_starts(begun, files)))


def _opened(measurement: Measurement, key: str, closed: str, now: str) -> Measurement | None:
    """The measurement with an unknown more in its set-up; None if its instrument cannot have it, or has it."""
    setup = measurement.instrument.setup
    if getattr(setup, key, None) != closed:
        return None
    return replace(measurement, instrument=replace(measurement.instrument, setup=setup.model_copy(update={key: now})))


def _outside_travel(files: Sequence[Measurement]) -> list[Warn]:
    """Warn of positions outside the travel of their axis."""
    found = [(m, a, at_mm) for m in files for a in m.machine.axes if (at_mm := outside_travel(m, a)) is not None]
    return [Warn("outside_travel", *travel_words(m, a, at_mm)) for m, a, at_mm in found]


def _of_starts(begun: Sequence[WarmStart], files: Sequence[Measurement]) -> list[Warn]:
    """Warn of records that begin while the machine is warm."""
    opened = {m.name for m in files if getattr(m.instrument.setup, "start", "") == "unknown"}
    told = (
        ([s for s in begun if s.name in opened], "the fit estimates what follows from that"),
        ([s for s in begun if s.name not in opened], "the fit takes them as settled, so its numbers may be wrong"),
    )
    step = BEGIN.rstrip(".")
    return [Warn("warm_start", in_words(starts, assumed).rstrip("."), step) for starts, assumed in told if starts]


def _without_turned(
    measurements: Sequence[Measurement], wanted: AskedEffects | None, leave_out_h: float | None
) -> tuple[Sequence[Measurement], list[Warn]]:
    """Without files whose readings depend on the angle of a rotary axis, as the model of the other files tells."""
    turned = [m for m in measurements if any(map(is_rotary, m.unread))]
    others = [m for m in measurements if not any(map(is_rotary, m.unread))]
    if not turned:
        return measurements, []

    def depend(model: Model) -> dict[str, str]:
        judged = {m.name: Judgement(model, clean([m], model.reference_degc)) for m in turned}
        return {name: said for name, j in judged.items() if (said := turned_with(j))}

    try:
        fitted = _whole_fit(others, wanted, leave_out_h, None)  # none, or a channel of its model is not in a file
        found, alone = depend(model_of(fitted.fit, "")), False
    except (ModelError, Fault):
        found, alone = depend(Model(turned[0].machine)), True
    if not found:
        return measurements, []
    rest = measurements if alone else [m for m in measurements if m.name not in found]
    names, said = listed(list(found)), next(iter(found.values())).rstrip(".")
    text = f"{names}: {said}" if alone else f"{names}: not in the fit, as {said[0].lower()}{said[1:]}"
    return rest, [Warn("not_read", text, ONE_ANGLE.rstrip("."))]


def _of_own_scale(found: OwnScale, files: Sequence[Measurement], fit: Estimate) -> Warn:
    """Warn of measurements with another scale; its size is that of the fit where this has it."""
    slopes = {f"slope of {files[i].name}" for i in found.files}
    places = [fit.linear.width + k for k, name in enumerate(fit.linear.extra) if name in slopes]
    if not places:
        return Warn("contradiction", found.message(files), REMEDY)
    said = replace(found, um_per_m=float(fit.values[places].mean())).message(files)
    goes = "the fit goes by the others, and the residual is without that"
    return Warn("contradiction", f"{said}; {goes}", REMEDY)


def _too_few_circles(given: Clean, leave_out_h: float | None) -> Warn | None:
    """Where a ball bar went round too few times for a choice: every machine has what its circles show."""
    measurements = given.readings.measurements
    count = sum(len(b.fold) for b in cuts(measurements, leave_out_h))
    if count >= FEW_BLOCKS or not all(isinstance(m.instrument, BallBar) for m in measurements):
        return None
    text = (
        f"{count} circles are too few to choose among effects: scale errors, squareness and backlashes were fitted, "
        "as every machine has them"
    )
    return Warn("too_few_runs", text, f"for a choice measure at least {FEW_BLOCKS} circles, or name what to fit")


def _of_wrong_scale(model: Model, given: Clean, wanted: AskedEffects | None, leave_out_h: float | None) -> list[Warn]:
    """Warn of files that follow a fit of another file with the other sign or in another unit.

    Where days differ, the same places read differently for good reasons, and only the laws of both days show it. This
    takes a fit of a file, so only a law that leaves much of all of them is asked about.
    """
    judged, files = Judgement(model, given), given.readings.measurements
    if len(files) < 2 or judged.residual < POOR * judged.noise_floor:
        return []
    readings = given.readings
    found: list[str] = []
    measured = floor.cleaned(readings, readings.values)
    for m in files[:REFERENCES]:
        try:
            there = clean([m], leave_out_h=leave_out_h).without_ends()
            alone = model_of(_fit(there, None, wanted, leave_out_h, None)[0], "")
            predicted = floor.cleaned(readings, base_of(alone, readings).predicted)
        except (ModelError, Fault):
            continue
        odd = odd_scales(readings, measured, predicted, f"a fit of {m.name} alone")
        if odd and (not found or len(odd) < len(found)):
            found = list(odd)
    step = "look at the sign and the unit of both files; without the wrong one, fit again"
    return [Warn("contradiction", "; ".join(f.rstrip("?") for f in found), step)] if found else []


def _without_moved_zeros(given: Clean) -> tuple[Clean, Warn | None]:
    runs, slips = moved_zeros(given.readings), slipped(given.readings)
    if not runs and not slips:
        return given, None
    off = np.full(len(given.readings), np.nan)
    for m in (*runs, *slips):
        off[m.readings] = m.by
    were = "what follows was" if slips else "it was" if len(runs) == 1 else "they were"
    text = f"{'; '.join(m.message.rstrip('?') for m in (*runs, *slips))} ({were} left out of the fit)"
    return given.rejecting(off, "whose zero has moved"), Warn("moved_zero", text, APART if slips else STEP)


def _fit(
    given: Clean, doubt: Warn | None, wanted: AskedEffects | None, leave_out_h: float | None, stage: Stage | None
) -> tuple[Estimate, Screened | None, TermChoice | None]:
    if wanted is None and _too_few_circles(given, leave_out_h):
        wanted = read_wanted(",".join(EVERY_MACHINE), given.readings.machine)
    try:
        found = _fit_to(given, wanted, leave_out_h, stage or (lambda _what, _done, _total: None))
        _check_waves(found[0])
        return found
    except ModelError as e:
        if doubt is None:
            raise
        raise ModelError(f"{e}\n{doubt.text}: {doubt.remedy}") from e


def _check_waves(fit: Estimate) -> None:
    """Raise ModelError where the readings show a wave that was asked for at too few of its phases."""
    loose = [i for i in fit.undetermined if isinstance(fit.terms[i].effect, WAVES)]
    if loose:
        raise ModelError(
            f"fit: these readings do not determine {names(fit.terms, loose)}: the targets show too little of a turn; "
            "leave it out, or measure at unequal steps"
        )


def _fit_to(
    given: Clean, wanted: AskedEffects | None, leave_out_h: float | None, tell: Stage
) -> tuple[Estimate, Screened | None, TermChoice | None]:
    measurements = given.readings.measurements
    blocks = cuts(measurements, leave_out_h)
    sources = [Source.of(m, b) for m, b in zip(measurements, blocks, strict=True)]
    sources = _without_wrong(sources, given)
    scaled = [s.weighted(_rough_weights(s)) for s in sources]
    exact = wanted.exact if wanted else ()
    _check_channels(sources, exact)
    fixed = starting_terms(exact, [thinned(s, SEARCHED) for s in scaled]) if exact else []
    if wanted is not None and not wanted.names:
        return _significant(sources, fixed, [], wanted, (), tell), None, None
    one_way = wanted is None and any(p.one_way for p in one_pass(given.readings))
    named, rules = _is_named(wanted), _Rules(places_only=one_way)
    while True:
        screened, choice = _chosen(scaled, wanted, rules, tell)
        chosen = _with_constant(screened, choice, rules)
        chosen = joined([chosen[i] for i in tellable(gather(scaled, chosen), chosen)] if chosen else [])
        fit = _significant(sources, fixed, chosen, wanted, screened.candidates, tell)
        further = _further_rules(given.readings, fit, len(fixed), named, rules)
        if further == rules:
            return fit, screened, choice
        rules = further


@dataclass(frozen=True)
class _Rules:
    """Rules for a choice from an earlier fit.

    Attributes:
        single: drives of which a choice may have only one: two of them cancel.
        barred: drives that a choice must not have: waves that do not predict held-out targets.
        places_only: whether a choice may only have what depends on positions: an axis that never came back shows no
            more.
    """

    single: tuple[frozenset[Drive], ...] = ()
    barred: frozenset[Drive] = frozenset()
    places_only: bool = False

    def allow(self, one: TermCandidate) -> bool:
        """Whether a choice may have a candidate.

        Behind a lever arm an angle reads as what is barred in the direction that the instrument reads.
        """
        component, *by = mine = drive(one.term.effect)
        arm = not one.direct and any(of[2:] == component[2:] and [*rest] == by for of, *rest in self.barred)
        return mine not in self.barred and not arm and (not self.places_only or one.kind in PLACES)

    def cancel(self, one: TermCandidate, other: TermCandidate) -> bool:
        """Whether a choice may have only one of the two."""
        return any({drive(one.term.effect), drive(other.term.effect)} <= only for only in self.single)


def _further_rules(
    readings: Readings, fit: Estimate, fixed: int, named: Callable[[Term], bool], rules: _Rules
) -> _Rules:
    """The rules, extended by drives that cancel in a fit, and waves that do not predict held-out targets."""
    cancelling = [frozenset(drive(fit.terms[i].effect) for i in fit.undetermined if i >= fixed)]
    more = [c for c in (*cancelling, *_against_each_other(fit, fixed, named)) if c and c not in rules.single]
    single = (*rules.single, *dict.fromkeys(more))
    waves = [t for t in fit.terms[fixed:] if isinstance(t.effect, WAVES) and not named(t)]
    loose = [fit.terms[i] for i in fit.undetermined]
    barred = rules.barred | {drive(t.effect) for t in waves if t in loose or not _predicts(readings, fit, t)}
    barred |= _crowded(readings, fit.terms[fixed:], named) | _one_too_many(fit, fixed, named)
    barred |= _of_two_temperatures(fit.terms[fixed:], named)
    return replace(rules, single=single, barred=barred)


def _of_two_temperatures(terms: Sequence[Term], named: Callable[[Term], bool]) -> frozenset[Drive]:
    """Drives by the difference of two temperatures, beside effects in the same direction by each of the two.

    Of three such numbers the readings show two.
    """
    by = {
        (t.effect.component[:2], t.effect.sensor)
        for t in terms
        if isinstance(t.effect, SpindleGrowth | MountExpansion) and t.effect.sensor is not None
    }
    tilts = {t.effect for t in terms if isinstance(t.effect, ColumnTilt) and not named(t)}
    return frozenset(drive(e) for e in tilts if by.issuperset((e.component[:2], s) for s in (e.front, e.back)))


def _one_too_many(fit: Estimate, fixed: int, named: Callable[[Term], bool]) -> frozenset[Drive]:
    """Drives of expansions that only this day has, by sensors of other parts than their axis where it has its own.

    One that is more than any material's, or an angle that is as much at an arm of 1 m. And of several expansions of one
    component, where one is less than two standard errors from zero, the one farthest from the axis: the readings show
    the sum of two that warm alike. And beside the axis' own sensor that of another axis.
    """
    machine, out = fit.sources[0].measurement.machine, set()
    several: dict[str, list[tuple[int, float, Drive]]] = {}
    recorded = [n for n in machine.sensor_names if any(n in s.measurement.channels for s in fit.sources)]
    for i, term in enumerate(fit.terms[fixed:], fixed):
        if not isinstance(term.effect, AxisExpansion) or named(term):
            continue
        k, error = (float(v[np.flatnonzero(fit.linear.owner == i)[0]]) for v in (fit.values, fit.errors))
        away, own = away_from(machine, term.effect.sensor, term.effect.axis, recorded), drive(term.effect)
        if away and abs(k) - SURE * error > EXPANDS:
            out.add(own)
        several.setdefault(term.effect.component, []).append((away, error / max(abs(k), TINY), own))
    for of in several.values():
        if any(away == 0 for away, _, _ in of):  # beside the axis' own sensor, another axis' is a second look at it
            out |= {d for away, _, d in of if away == ANOTHER}
        if len({d for _, _, d in of}) > 1 and max(unsure for _, unsure, _ in of) > 1.0 / SURE:
            out.add(max(of, key=lambda f: f[:2])[2])
    return frozenset(out)


TINY = 1e-300
ANOTHER = 2
"""How far a sensor is from an axis whose name says that it is on another one."""
UNSURE = 2.0
"""A number within so many standard errors of zero is not known."""
TAKES_BACK = 3.0
"""Two delays of one temperature take back what the other makes, where one makes this many times what both do."""


def _against_each_other(fit: Estimate, fixed: int, named: Callable[[Term], bool]) -> list[frozenset[Drive]]:
    """Drives of expansions of one component, each more than any material's, of which one takes back what others make.

    They fit the difference of two temperatures on this day. And drives of one effect by one temperature with two
    delays, of which one makes several times what both together do: they fit how fast it changes. Or of which neither is
    two standard errors from zero, once the delays are estimated: only their sum is known. Or which only make up for the
    delay of the sensor itself: both are short, and of opposite signs.
    """

    def value(i: int) -> float:
        return float(fit.values[np.flatnonzero(fit.linear.owner == i)[0]])

    grown: dict[str, list[tuple[float, Drive]]] = {}
    for i, term in enumerate(fit.terms[fixed:], fixed):
        k = value(i)
        if isinstance(term.effect, AxisExpansion) and abs(k) > EXPANDS and not named(term):
            grown.setdefault(term.effect.component, []).append((k, drive(term.effect)))
    signs = [(frozenset(d for _, d in of), {k > 0.0 for k, _ in of}) for of in grown.values()]

    def square(*terms: int) -> float:
        own = np.flatnonzero(np.isin(fit.linear.owner, terms))
        return float(fit.values[own] @ fit.linear.total[np.ix_(own, own)] @ fit.values[own])

    def leads(i: int, j: int) -> bool:
        soon = max(fit.terms[k].theta.get("tau", 0.0) for k in (i, j)) < SENSOR_S
        return soon and value(i) * value(j) < 0.0

    late = [i for i, t in enumerate(fit.terms) if i >= fixed and _sensed(t) and not named(t)]
    pairs = [
        (i, j)
        for i, j in itertools.combinations(late, 2)
        if drive(fit.terms[i].effect) == drive(fit.terms[j].effect)
        and fit.terms[i].theta.get("tau") != fit.terms[j].theta.get("tau")
    ]

    def unsure(i: int) -> bool:
        own = np.flatnonzero(fit.linear.owner == i)
        return bool((np.abs(fit.values[own]) < UNSURE * fit.errors[own]).all())

    both = [
        (i, j)
        for i, j in pairs
        if max(square(i), square(j)) > TAKES_BACK**2 * square(i, j) or (unsure(i) and unsure(j)) or leads(i, j)
    ]
    return [drives for drives, ways in signs if len(ways) > 1] + [
        frozenset({drive(fit.terms[i].effect)}) for i, _ in both
    ]


def _crowded(readings: Readings, terms: Sequence[Term], named: Callable[[Term], bool]) -> frozenset[Drive]:
    """Drive of the richest curve along an axis that has more numbers than half of the targets, with its neighbours.

    Together they would meet every target, and be anything between them.
    """
    machine, barred = readings.machine, set()
    for axis in machine.axes:
        along = [t for t in terms if t.effect.channels(machine) == (axis.channel,) and not isinstance(t.effect, WAVES)]
        for component in {t.effect.component for t in along}:
            mine = [(t, len(t.effect.coefficients(machine))) for t in along if t.effect.component == component]
            free = [(t, n) for t, n in mine if n > 1 and not named(t)]
            count = targets_along(readings, axis, component)
            if free and count <= FEW_TARGETS and sum(n for _, n in mine) > count / 2.0:
                barred.add(drive(max(free, key=lambda f: f[1])[0].effect))
    return frozenset(barred)


def _predicts(readings: Readings, fit: Estimate, wave: Term) -> bool:
    """Whether a wave predicts held-out targets, with a pitch that is estimated without them."""
    machine = readings.machine
    beside = [readings.columns(t.effect, t.theta) for t in fit.terms if t is not wave]
    base = np.concatenate([np.zeros((len(readings), 0)), *beside], axis=1)
    (pitch,) = wave.effect.nonlinear(machine) or (None,)
    if pitch is None:
        return predicts_targets(readings, base, wave.effect, [wave.theta])
    near = np.linspace(pitch.low, pitch.high, PITCHES)
    return predicts_targets(readings, base, wave.effect, [{pitch.name: float(p)} for p in near])


def _chosen(
    scaled: Sequence[Source], wanted: AskedEffects | None, rules: _Rules, tell: Stage
) -> tuple[Screened, TermChoice]:
    """Choose twice: the first choice, subtracted, uncovers smaller effects for the second one.

    A ball bar warms up in the hand, so each circle is a little larger than the one before. A yaw or a play across would
    make up for that, so only what every machine has is chosen by the length of a bar.
    """
    tell("looking for what goes with what", 0, 1)
    names = wanted.names if wanted else None
    free = [_of_unknown_length(s) for s in scaled]
    if wanted is None and any(f is not s for f, s in zip(free, scaled, strict=True)):
        screened, choice = _chosen(free, wanted, rules, tell)
        normal = gather(scaled, [c.term for c in screened.candidates], by_fold=True)
        choice = completed(normal, screened.candidates, choice, len(scaled), rules.single)
        return replace(screened, sources=tuple(scaled)), choice
    screened = _without(screen(scaled, names), rules)
    choice = _choose(screened, wanted, rules, tell)
    first = [screened.candidates[i] for i in choice.chosen]
    found = refined(screened.sources, first, screened.candidates)
    if any(c.feature and not c.direct for c in first):
        found += _refined_as_shown(screened, wanted, rules, tell)
    screened = _without(screen(scaled, names, first), rules)
    screened = replace(screened, candidates=(*screened.candidates, *found))
    return screened, _choose(screened, wanted, rules, tell)


def _refined_as_shown(
    screened: Screened, wanted: AskedEffects | None, rules: _Rules, tell: Stage
) -> list[TermCandidate]:
    """What `refined` finds for a choice among components that the readings show directly.

    A tilt that stands for the growth of two directions has none of their delays.
    """
    shown = replace(screened, candidates=tuple(c for c in screened.candidates if c.direct))
    if not shown.candidates:
        return []
    choice = _choose(shown, wanted, rules, tell)
    return refined(shown.sources, [shown.candidates[i] for i in choice.chosen], shown.candidates)


def _of_unknown_length(source: Source) -> Source:
    """A ball bar as if nobody knew its length; anything else as it is."""
    bar, m = source.measurement.instrument, source.measurement
    if not isinstance(bar, BallBar) or bar.setup.zero != "none":
        return source
    return replace(source, measurement=replace(m, instrument=bar.of_unknown_length()))


def _without(screened: Screened, rules: _Rules) -> Screened:
    """The candidates that the rules allow."""
    return replace(screened, candidates=tuple(filter(rules.allow, screened.candidates)))


def _choose(screened: Screened, wanted: AskedEffects | None, rules: _Rules, tell: Stage) -> TermChoice:
    candidates = screened.candidates
    if not candidates:
        raise ModelError("fit: the measurements see no component error that any effect could explain")
    normal = gather(screened.sources, [c.term for c in candidates], lambda d, t: tell("candidates", d, t), by_fold=True)
    machine = screened.sources[0].measurement.machine
    forced = [i for i, c in enumerate(candidates) if wanted is not None and c.offered and _is_forced(c, machine)]
    return choose(normal, candidates, forced, lambda d, t: tell("choosing on held-out runs", d, t), rules.single)


def _with_constant(screened: Screened, choice: TermChoice, rules: _Rules) -> list[Term]:
    """The chosen terms, and for each temperature the same shape at constant temperature.

    A temperature that hardly changed, far from the reference, could otherwise replace that shape: the fit is as good,
    but on a warmer day the model is wrong. The one of both that is not significant is dropped later.
    """
    chosen = [screened.candidates[i] for i in choice.chosen]
    for candidate in tuple(chosen):
        shape = at_constant_temperature(candidate, screened.candidates)
        if shape is not None and shape not in chosen and not any(rules.cancel(c, shape) for c in chosen):
            chosen.append(shape)
    return [c.term for c in chosen]


def _is_forced(one: TermCandidate, machine: Machine) -> bool:
    """Whether a named effect is fitted without a choice: geometry of one axis is; others are chosen.

    Of a position up to the quadratic form, else the degrees that the effect has if none are given.
    """
    effect, degrees = one.term.effect, getattr(one.term.effect, "degrees", (0,))
    if one.kind in ("position", "direction", "cyclic"):
        return max(degrees) <= QUADRATIC
    usual = "degrees" not in type(effect).model_fields or degrees == type(effect).model_fields["degrees"].default
    along = any({a.channel, a.direction_channel}.issuperset(effect.channels(machine)) for a in machine.axes)
    return one.kind == "other" and one.direct and not one.term.theta and along and usual


def _is_named(wanted: AskedEffects | None) -> Callable[[Term], bool]:
    names = wanted.names if wanted else ()
    return lambda term: term.effect.effect in names


def _significant(
    sources: Sequence[Source],
    fixed: list[Term],
    chosen: list[Term],
    wanted: AskedEffects | None,
    candidates: Sequence[TermCandidate],
    tell: Stage,
) -> Estimate:
    """Fit, and drop chosen terms that are neither significant nor spared, the least significant one first.

    A squareness or a backlash goes last: beside another shape that acts alike neither is significant. Of a shape at
    constant temperature and several that change it with a temperature, all alike, none is significant; the first goes
    after all of these but one. Degrees of a polynomial were chosen one by one, and are tested one by one.
    """
    named, offered = _is_named(wanted), sum(c.offered for c in candidates)
    while chosen or fixed:
        fit, kept = _fitted(sources, [*fixed, *chosen], tell), len(fixed)
        sure, owner = surety(fit, offered), fit.linear.owner - kept
        there = {_form(t) for i, t in enumerate(chosen) if sure[owner == i].max() >= 1.0}
        idle: list[tuple[float, int, Term, list[Term]]] = []
        for i, term in enumerate(chosen):
            # A named effect stays, but with one sensor only: further sensors must be significant.
            if named(term) and not (_sensed(term) and _form(term) in there):
                continue
            parts, columns = apart(term), np.flatnonzero(owner == i)
            for k, own in enumerate(np.split(columns, len(parts))):
                if (s := float(sure[own].max())) < 1.0 and not spared(fit, own):
                    idle.append((s, i, parts[k], joined([*parts[:k], *parts[k + 1 :]])))
        if not idle:
            return fit
        thermal = [t.effect for _, _, t, _ in idle if _sensed(t)]
        later = [
            (sum(is_at_constant(t.effect, changed) for changed in thermal) > 1, _stays_longer(t.effect))
            for _, _, t, _ in idle
        ]
        _, (_, gone, _, rest) = min(zip(later, idle, strict=True), key=lambda one: (one[0], *one[1][:2]))
        chosen = [*chosen[:gone], *rest, *chosen[gone + 1 :]]
    blocks = sum(len(s.blocks.fold) for s in sources)
    why = "the readings are noise, or show an error that no effect predicts in other runs; `rtec compare` says which"
    if blocks < FEW_BLOCKS:
        why = f"{blocks} blocks of readings are too few to choose among {offered} effects"
    if wanted is not None:
        raise ModelError(
            f"fit: none of the effects named ({', '.join(wanted.names)}) lowers the error on held-out runs "
            f"significantly: {why}; name an effect with its component and arguments to fit it nonetheless: --effects "
            "mount_expansion:EXX:sensor=T_bed"
        )
    way = "to go on without a model, give rtec diagnose or rtec improve the machine file in its place"
    if first := _first_model(sources, candidates):
        way = f"for a first model, which rtec improve extends, add --effects {first}, fitted without a choice"
    more = f"; for a choice measure at least {FEW_BLOCKS} runs" if blocks < FEW_BLOCKS else ""
    raise ModelError(f"fit: no effect lowers the error on held-out runs significantly: {why}; {way}{more}")


def _stays_longer(effect: Effect) -> bool:
    """Whether every machine has an effect on every day; a scale error may be the warmth of one."""
    return every_machine_has(effect) and effect.effect != "scale"


USUAL: Mapping[Kind, str] = {
    "positioning": "scale",
    "straightness": "straightness",
    "tilt": "angular_motion",
    "roll": "angular_motion",
    "axis_angle": "squareness",
}
"""The first effect to fit, by the kind of a component that the readings show directly."""


def _first_model(sources: Sequence[Source], candidates: Sequence[TermCandidate]) -> str:
    """Geometry that can be fitted without a choice, as `--effects` takes it; empty where these readings show none.

    Where not all of it can be fitted (a ball bar on one plane): scales, squareness and backlashes.
    """
    machine = sources[0].measurement.machine
    own = [(c.effect, c.component) for c in candidates if c.offered and c.direct]
    kinds = {component: component_kind(component, machine) for _, component in own}
    # Two axes are square to each other or not: of their two angles in one plane the readings show the difference.
    angles = {c[:3]: c for c, kind in reversed(kinds.items()) if kind == "axis_angle"}
    kinds = {c: kind for c, kind in kinds.items() if angles.get(c[:3], c) == c}

    def named(of: Collection[Kind]) -> list[str]:
        usual = {f"{USUAL[kind]}:{c}" for c, kind in kinds.items() if kind in of}
        plays = {f"backlash:{c}" for c, kind in kinds.items() if kind == "positioning" and ("backlash", c) in own}
        return sorted(usual | plays, key=lambda name: (list(kinds).index(name.partition(":")[2]), name in plays))

    few = [thinned(s, SEARCHED) for s in sources]
    for text in map(",".join, filter(None, (named(USUAL), named(("positioning", "axis_angle"))))):
        try:
            _fitted(sources, starting_terms(read_wanted(text, machine).exact, few), lambda *_: None)
        except ModelError:
            continue
        return text
    return ""


def _form(term: Term) -> tuple[str, str]:
    return term.effect.effect, term.effect.component


def _sensed(term: Term) -> bool:
    return any(n in type(term.effect).model_fields for n in ("sensor", "front"))


def _fitted(sources: Sequence[Source], terms: Sequence[Term], tell: Stage) -> Estimate:
    def progress(done: int, total: int) -> None:
        tell("fitting", done, total)

    try:
        fit = estimate(sources, terms, progress=progress)
    except ModelError:  # the search may have made two terms the same
        return estimate(sources, terms, search=False, progress=progress)
    if fit.found.slopes or fit.found.on_bound:
        try:
            check_seen(fit.found.normal, [*fit.terms, *[s.term for s in fit.found.slopes]])
            good = True
        except ModelError:
            good = False
        still = estimate(sources, terms, search=False, progress=progress)
        if not good or fit.held_out * _scale(fit) > WORSE * still.held_out * _scale(still):
            return still
    return fit


def _scale(fit: Estimate) -> float:
    """Noise that the weights assume; makes the errors of two fits comparable."""
    return float(np.sqrt(np.mean([np.mean(1.0 / np.maximum(s.weight[s.weight > 0], 1e-12) ** 2) for s in fit.sources])))


def _rough_weights(source: Source) -> Floats:
    return (source.weight.reshape(-1, source.count) / rough_noise(source)).ravel()


def _without_wrong(sources: Sequence[Source], given: Clean) -> list[Source]:
    """The sources without outliers."""
    kept = [s.weight.copy() for s in sources]
    number = {s.measurement.name: i for i, s in enumerate(sources)}
    for w in given.wrong:
        i = number[w.measurement]
        lane = sources[i].measurement.instrument.columns().index(w.column)
        kept[i][w.row * sources[i].count + lane] = 0.0
    return [s.weighted(k) for s, k in zip(sources, kept, strict=True)]


def _check(measurements: Sequence[Measurement]) -> None:
    if not measurements:
        raise Fault("fit: no measurement was given")
    faults = faults_of(measurements)
    faults += [_missing(m, a.channel) for m in measurements for a in m.machine.axes if _gaps(m, a.channel)]
    if faults:
        raise Fault("\n".join(faults))


def _check_channels(sources: Sequence[Source], effects: Sequence[Effect]) -> None:
    faults = []
    for effect in effects:
        for source in sources:
            m = source.measurement
            if not reads(source, effect.component):
                continue
            moving = {c for a in m.machine.axes for c in (a.channel, a.direction_channel)}
            rates = {c: a for a in m.machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
            moving |= {c for c, a in rates.items() if source.rate(a, c) is not None}
            for channel in effect.channels(m.machine):
                if channel not in m.channels and channel not in moving:
                    faults.append(
                        f"{m.name}: has no column for {channel}, which {effect.effect}({effect.component}) needs"
                    )
                elif _gaps(m, channel):
                    faults.append(_missing(m, channel))
    if faults:
        raise Fault("\n".join(dict.fromkeys(faults)))


def _gaps(measurement: Measurement, channel: str) -> bool:
    return channel in measurement.channels and not np.isfinite(measurement.channels[channel]).all()


def _missing(measurement: Measurement, channel: str) -> str:
    rows = np.flatnonzero(~np.isfinite(measurement.channels[channel]))
    return (
        f"{measurement.name}: row {int(rows[0]) + 1}: {channel} is missing ({len(rows)} rows in all); "
        "fill them, or leave the rows out"
    )
