"""Result of a diagnosis: verdict, candidates with their evidence, absent effects, untestable effects."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal

from rtec.arrays import Floats, Ints
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.effects import Effect
from rtec.estimation.joint import ChangedNumber
from rtec.estimation.judge import Judgement
from rtec.model import FittedEffect
from rtec.result import Result

AT_FLOOR = 1.05
"""Error over the noise floor up to which a model is at the floor."""
REFIT = 0.8
"""A model is out of date where a refit of its numbers leaves less than this share of its residual."""

Verdict = Literal["nothing_missing", "undecided", "missing_effect", "ambiguous", "unknown_effect"]


@dataclass(frozen=True)
class Number:
    """A fitted number; `se` is its standard error, None where the data do not determine it."""

    value: float
    se: float | None
    unit: str


@dataclass(frozen=True)
class Alike:
    """Another candidate that these readings cannot distinguish from this one.

    Attributes:
        effect, component: of the candidate.
        why: in words.
        separating_test: experiment that separates them.
        label: short name with what it depends on, such as its sensor.
        gain: expected log Bayes factor of that experiment; None where it was not computed.
        apart: it explains another part of the readings: no rival, but maybe missing as well.
        fitted: it, its coefficients zero where no test was looked for; None where it is no candidate of the catalogue.
    """

    effect: str
    component: str
    why: str
    separating_test: str
    gain: float | None = None
    label: str = ""
    apart: bool = False
    fitted: FittedEffect | None = None


@dataclass(frozen=True)
class Finding:
    """One candidate, with its evidence.

    Attributes:
        rank: 1 is the best.
        effect: with its arguments.
        theta: its non-linear parameters.
        parameters: every number with its standard error, coefficients first.
        heldout_drop: relative fall of the residual's mean square on held-out runs.
        confidence: posterior probability among all candidates and "none".
        log_evidence: gain in log evidence over the current model.
        p: family-wise probability that noise alone would look as good.
        size_um: root mean square of its contribution to the readings, in the unit of the diagnosis (`Diagnosis.unit`).
        accepted: whether it passed every check.
        group: shares rank 1's group: these readings cannot distinguish it from rank 1.
        confused_with: effects that are confounded with it, and the tests that separate them.
        why_not: why it was not accepted or not preferred, in words; empty for rank 1 when accepted.
        partner: a second effect that has to be added with it, as neither alone predicts held-out runs better.
        same_components: of other parts between tool and work, on which the effect is the same in these readings.
    """

    rank: int
    effect: Effect
    theta: Mapping[str, float]
    parameters: Mapping[str, Number]
    channels: tuple[str, ...]
    heldout_drop: float
    confidence: float
    log_evidence: float
    p: float
    size_um: float
    accepted: bool
    group: bool
    confused_with: tuple[Alike, ...] = ()
    why_not: str = ""
    partner: "Finding | None" = None
    same_components: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Short name for tables: effect, component, and what it depends on."""
        return self.effect.label


@dataclass(frozen=True)
class NotTestable:
    """An effect that these measurements could not have shown, or only if it were far larger than usual.

    Attributes:
        effect, component: of the effect; an empty component means all.
        why: what was never moved or recorded.
        test: the measurement that would show it.
        usual: root mean square of its usual size in these readings; None where it has no effect on them.
        smallest: smallest root mean square that would have been detected; None where none would.
    """

    effect: str
    component: str
    why: str
    test: str
    usual: float | None = None
    smallest: float | None = None


@dataclass(frozen=True)
class Absent:
    """An effect that was searched and not detected.

    Attributes:
        effect, component: of the effect.
        smallest: the smallest size that would have been detected, in `unit`, root mean square in the readings.
        unit: "um" or "urad".
    """

    effect: str
    component: str
    smallest: float
    unit: str


@dataclass(frozen=True)
class Unknown:
    """Structure of the residual that no effect of the catalogue explains.

    Attributes:
        component: where it acts, as the readings see it; empty where several are equally good.
        channels: variables that it depends on.
        shape: "smooth", "periodic" or "steps".
        period: of a periodic one, with its unit; None otherwise.
        p: family-wise probability of it by noise alone.
        r2: share of the residual's variance that it explains on held-out runs.
        where: place along its channels, in words; empty where there is nothing to report.
        with_time: the channel rises with time in this record, so that a drift would look the same.
        step_mm: of equal steps between the targets; None where they are not equal, or it is no wave along an axis.
        aliases_mm: other periods that targets at these steps cannot distinguish from it.
        within: of each temperature, load and speed in the expression, its name and the range of these readings: it is
            no law beyond.
        expression, parameters, feeds: the nearest simple expression for `rtec add`, as `--expr`, `--param` and
            `--component` take them; empty where there is none.
    """

    component: str
    channels: tuple[str, ...]
    shape: Literal["smooth", "periodic", "steps"]
    period: Number | None
    p: float
    r2: float
    where: str = ""
    expression: str = ""
    parameters: tuple[str, ...] = ()
    feeds: str = ""
    with_time: bool = False
    step_mm: float | None = None
    aliases_mm: tuple[float, ...] = ()
    within: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class RunsDiffer:
    """Runs that differ by more than the noise of their readings, but are too few to determine the cause.

    Attributes:
        size: standard deviation of the runs' means beyond the noise, in the unit of the diagnosis.
        count: number of runs.
        test: the measurement that would decide.
    """

    size: float
    count: int
    test: str


@dataclass(frozen=True)
class Member:
    """One of several effects that are named together.

    Attributes:
        fitted: the effect, with its numbers beside the others.
        heldout_drop: share of the mean square on held-out runs that it removes together with those before it.
        rivals: short names of effects that the readings cannot distinguish from it beside the others.
    """

    fitted: FittedEffect
    heldout_drop: float
    rivals: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Short name."""
        return self.fitted.effect.label

    def facts(self) -> dict[str, Any]:
        """As plain data."""
        effect = self.fitted.effect
        named = {"label": self.label, "effect": effect.effect, "component": effect.component}
        return {**named, "heldout_drop": self.heldout_drop, "rivals": self.rivals}


@dataclass(frozen=True)
class OnCircle:
    """Angles of a ball bar's readings: letters of the plane, sense (+1 ccw, -1 cw), angles, rad, (n,)."""

    letters: tuple[str, str]
    sense: int
    angle_rad: Floats


@dataclass(frozen=True)
class Picture:
    """Data of a figure that shows a finding in one reading column, less what the instruments cannot know.

    Attributes:
        label: of the effect, or the variables of an unknown.
        unit: "um" or "urad".
        residual: of the current model, and of the effects that the title names as subtracted, refitted with it, (n,).
        part: contribution of the effect to it, (n,).
        drivers: channel, its unit and values (n,); the first is the horizontal axis.
        period_mm: of a wave along the first; None for anything else.
        direction: last direction of the first driver where it is a position, (n,); None otherwise.
        time_s, run: of each reading, (n,).
        title: the label and the measurement, with its column where it has several.
        place: the measurement, with its column where it has several.
        others: pictures of the other reading columns that the finding moves most, strongest first.
        circle: for a ball bar.
    """

    label: str
    unit: Literal["um", "urad"]
    residual: Floats
    part: Floats
    drivers: tuple[tuple[str, str, Floats], ...]
    direction: Floats | None
    time_s: Floats
    run: Ints
    title: str = ""
    place: str = ""
    others: "tuple[Picture, ...]" = ()
    period_mm: float | None = None
    circle: OnCircle | None = None


@dataclass(frozen=True)
class Diagnosis(Result):
    """What a model is missing, as far as these measurements determine it.

    Attributes:
        verdict: see `Verdict`.
        sentence: the answer in one sentence.
        unit: "um"; "urad" where the measurements read angles only; "noise" (multiples of it) where there are both.
        rms_residual: of readings minus prediction, nuisances projected out.
        noise_floor: residual of noise alone.
        refit: residual of the model with its own numbers refitted to these readings; no more than
            `rms_residual` but for rounding.
        adequacy: gain of rank 1 over the best gain of any smooth or periodic model; below 0.7 no effect of the
            catalogue fits.
        findings: best first.
        unknown: structure that remains unexplained, if any.
        not_testable, absent: effects that could not be checked, and effects that were checked and not detected.
        notes: treatment of the data, in words (rejected readings, smoothed temperatures, …).
        noise: fitted noise by measurement, in words.
        together: effects that are named together while part of the residual has no name, which is `unknown`; rank 1
            is the first of them.
        judged: the model with its current numbers, judged as in every command.
        doubts: about the record itself.
        picture: of rank 1 or of the unknown, where there is one.
        runs: of an undecided answer, the differences between runs; None otherwise.
        changed: numbers of the model that have changed since the readings that it was fitted to, where that was asked.
        changed_rms: residual with these refitted and all others kept.
        changed_held_out: the same on held-out runs.
        within_errors: where a refit lowers the residual, that no number then differs by more than its error.
    """

    page_maker: ClassVar[str] = "rtec.report.diagnosis:diagnosis_page"

    verdict: Verdict
    sentence: str
    unit: Literal["um", "urad", "noise"]
    rms_residual: float
    noise_floor: float
    adequacy: float | None
    findings: tuple[Finding, ...]
    unknown: Unknown | None
    not_testable: tuple[NotTestable, ...]
    absent: tuple[Absent, ...]
    notes: tuple[str, ...]
    noise: tuple[str, ...]
    seed: int = 1
    picture: Picture | None = field(default=None, repr=False, compare=False)
    refit: float = math.nan
    together: tuple[Member, ...] = ()
    judged: Judgement | None = field(default=None, repr=False, compare=False)
    doubts: tuple[Doubt, ...] = ()
    runs: RunsDiffer | None = None
    changed: tuple[ChangedNumber, ...] = ()
    changed_rms: float = math.nan
    changed_held_out: float = math.nan
    within_errors: bool = False

    @property
    def out_of_date(self) -> bool:
        """Whether a refit of the model's own numbers would clearly lower the residual, also on held-out runs.

        A refit to a few runs follows their drift, and so may one that moves no number beyond its error.
        """
        return (
            self.refit_fits
            and not self.within_errors
            and (self.judged is None or self.judged.held_out < self.rms_residual)
        )

    @property
    def refit_fits(self) -> bool:
        """Whether a refit of the model's own numbers would clearly lower the residual of these readings."""
        return self.refit < REFIT * self.rms_residual and self.rms_residual > self.noise_floor / REFIT

    @property
    def mostly_changed(self) -> bool:
        """Whether changed numbers of the model, refitted, remove most of the mean square, also on held-out runs.

        What follows the drift of a few runs does not.
        """
        return max(self.changed_rms, self.changed_held_out) ** 2 < 0.5 * self.rms_residual**2

    @property
    def refits_changed(self) -> bool:
        """Whether `improve` refits numbers that have changed, whatever else these readings leave undecided.

        Not to a slow change without a name, nor in one pass of an axis, where numbers absorb a missing effect.
        """
        one_pass = any(d.kind == "one_pass" for d in self.doubts)
        at_floor = self.changed_rms <= AT_FLOOR * self.noise_floor
        return self.mostly_changed and not self.changes_slowly and (at_floor or not one_pass)

    @property
    def changes_slowly(self) -> bool:
        """Whether what has no name follows a temperature or the time: numbers of the model would follow it, too."""
        if self.unknown is None or self.judged is None:
            return False
        return bool(set(self.unknown.channels) & {*self.judged.model.machine.sensor_names, "time_s"})

    @property
    def named_drop(self) -> float:
        """Share of the mean square on held-out runs that what is named removes; zero where nothing is."""
        if not self.group:
            return 0.0
        return max([self.findings[0].heldout_drop, *(m.heldout_drop for m in self.together)])

    @property
    def shows_rank_1(self) -> bool:
        """Whether `picture` is of rank 1, not of what has no name."""
        return self.picture is not None and bool(self.group) and (self.unknown is None or bool(self.together))

    @property
    def group(self) -> tuple[Finding, ...]:
        """Rank 1 and the findings confounded with it, where rank 1 was accepted; empty otherwise."""
        return tuple(f for f in self.findings if f.group and self.findings[0].accepted)

    def rows(self) -> list[Mapping[str, Any]]:
        """The candidates, best first."""
        return [_finding(f) for f in self.findings]

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return {
            "verdict": self.verdict,
            "sentence": self.sentence,
            "unit": self.unit,
            "rms_residual_um": self.rms_residual,
            "noise_floor_um": self.noise_floor,
            "refit_um": self.refit if math.isfinite(self.refit) else None,
            "out_of_date": self.out_of_date,
            "changed": [asdict(c) for c in self.changed],
            "adequacy": self.adequacy,
            "candidates": [_finding(f) for f in self.findings],
            "unknown": _unknown(self.unknown),
            "together": [m.facts() for m in self.together],
            "not_testable": [vars(n) for n in self.not_testable],
            "absent": [vars(a) for a in self.absent],
            "judged": self.judged.facts() if self.judged is not None else None,
            "doubts": [vars(d) for d in self.doubts],
            "runs_differ": vars(self.runs) if self.runs is not None else None,
            "noise": list(self.noise),
            "notes": list(self.notes),
            "seed": self.seed,
        }


def _finding(f: Finding) -> dict[str, Any]:
    return {
        "rank": f.rank,
        "effect": f.effect.effect,
        "component": f.effect.component,
        "arguments": f.effect.model_dump(mode="json", exclude={"effect", "component"}, exclude_none=True),
        "channels": list(f.channels),
        "parameters": {k: vars(n) for k, n in f.parameters.items()},
        "heldout_drop": f.heldout_drop,
        "confidence": f.confidence,
        "log_evidence": f.log_evidence,
        "p": f.p,
        "size_um": f.size_um,
        "accepted": f.accepted,
        "same_group_as_rank_1": f.group,
        "confused_with": [{k: v for k, v in vars(a).items() if k != "fitted"} for a in f.confused_with],
        "why_not": f.why_not,
        "together_with": f.partner.label if f.partner else None,
        "same_components": list(f.same_components),
    }


def _unknown(u: Unknown | None) -> dict[str, Any] | None:
    if u is None:
        return None
    return {
        "component": u.component,
        "channels": list(u.channels),
        "shape": u.shape,
        "period": vars(u.period) if u.period else None,
        "p": u.p,
        "r2": u.r2,
        "where": u.where,
        "expression": u.expression,
        "parameters": list(u.parameters),
        "feeds": u.feeds,
        "with_time": u.with_time,
        "step_mm": u.step_mm,
        "aliases_mm": list(u.aliases_mm),
        "within": [{"channel": name, "low": low, "high": high} for name, low, high in u.within],
    }
