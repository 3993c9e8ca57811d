"""Scores answers to the benchmark's trials: a row for each claim of a diagnosis, with its goal; and their page."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rtec.arrays import Floats
from rtec.bench.rig.campaign import FORMS
from rtec.bench.trials import Names, Right, Trial
from rtec.errors import MeasurementError
from rtec.report.page import Page, Section, Table
from rtec.wording import percent

VERDICTS = ("nothing_missing", "undecided", "missing_effect", "ambiguous", "unknown_effect")
CLAIMS = ("missing_effect", "ambiguous")
NEAR = 1.1
"""An error on held-out runs counts as equally good up to this multiple of the true law's error, or of the noise."""


@dataclass(frozen=True)
class TrialAnswer:
    """Answer of a program to one data set.

    Attributes:
        verdict: one of `VERDICTS`.
        names: effects, best first.
        claimed: effects that are reported as missing, with rivals of the first.
        variables: channels of an effect without a name.
        doubts: reported doubts about the record or the machine file.
        seconds: processor time; NaN where it is unknown.
        predicted: predictions of the first record's readings, by column, (n,); empty where there are none.
    """

    verdict: str
    names: tuple[Right, ...] = ()
    claimed: tuple[Right, ...] = ()
    variables: frozenset[str] = frozenset()
    doubts: frozenset[str] = frozenset()
    seconds: float = float("nan")
    predicted: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class ScoreRow:
    """One row of the score.

    Attributes:
        what: claim in words.
        hits, total: number of hits, and number of cases.
        goal: required share of hits.
        at_most: whether the goal is an upper limit.
    """

    what: str
    hits: int
    total: int
    goal: float
    at_most: bool = False

    @property
    def met(self) -> bool:
        """Whether the goal is met."""
        share = self.hits / self.total
        return share <= self.goal if self.at_most else share >= self.goal


Pair = tuple[Trial, TrialAnswer]


def is_right(name: Right, names: Names) -> bool:
    """Whether a name is one of the right ones."""
    return any(
        name.effect == r.effect and r.component in ("", name.component) and r.sensor in ("", name.sensor) for r in names
    )


def confidently_wrong(trial: Trial, answer: TrialAnswer) -> bool:
    """Whether an answer claims a wrong name without a rival."""
    if answer.verdict != "missing_effect" or not answer.names:
        return False
    return not any(is_right(answer.names[0], names) for names in trial.hidden)


@dataclass(frozen=True)
class HeldBack:
    """Root mean squares on held-back readings, without outliers and zeros.

    Attributes:
        error: error of the prediction; infinite where there is none.
        noise: drawn noise.
        reachable: error of the true law with its free numbers fitted by least squares to the given readings; at least
            the noise.
    """

    error: float
    noise: float
    reachable: float


def held_back(trial: Trial, answer: TrialAnswer) -> HeldBack:
    """Error of an answer's predictions on held-back readings, and the reachable error.

    The true law is fitted to the given readings without outliers, together with the model's own numbers: once with one
    zero, and once with a zero for each run, which is robust to slow drift; the better of both counts. The law has
    curves of positions, feeds or loads exactly. For bodies without a sensor it has the part that follows from recorded
    channels by the exact heat flow. A probe that the effect does not move has the noise alone. If the law happens to
    follow the drift of the instrument, it predicts this, too; an answer need not do that.
    """
    (record,) = trial.records
    squares = np.zeros(3)
    for name, readings in record.held_back.items():
        noise, given = record.noise[name], record.readings[name]
        back, fitted = (np.isfinite(v) & np.isfinite(noise) for v in (readings, given))
        lefts: list[Floats] = [noise]
        if name in trial.law:
            law = trial.law[name]
            zeros = (np.ones((len(noise), 1)), (record.plan.run[:, None] == np.unique(record.plan.run)) * 1.0)
            numbers = [np.linalg.lstsq(np.hstack([law, z])[fitted], given[fitted], rcond=None)[0] for z in zeros]
            lefts = [readings - law @ n[: law.shape[1]] for n in numbers]
        error = readings - answer.predicted.get(name, np.full(len(noise), np.inf))
        whole = bool(np.isfinite(error[back]).all())
        found = np.var(error[back]) if whole else np.inf
        squares += np.array([found, np.var(noise[back]), min(np.var(v[back]) for v in lefts)])
    error_um, noise_um, law_um = np.sqrt(squares).tolist()
    return HeldBack(error_um, noise_um, max(noise_um, law_um))


def score(trials: Sequence[Trial], answers: Mapping[str, TrialAnswer]) -> list[ScoreRow]:
    """All rows for which there are trials.

    Args:
        trials: data sets with their truth.
        answers: answers by the label of the trial.

    Raises:
        MeasurementError: a trial has no answer.
    """
    missing = [t.label for t in trials if t.label not in answers]
    if missing:
        raise MeasurementError(f"{len(missing)} data sets have no answer")
    pairs = [(t, answers[t.label]) for t in trials]
    rows = [*_named(pairs), *_plates(pairs), *_predicted(pairs), *_doubted(pairs), *_quiet(pairs)]
    rows.append(_row("asserted without rivals and false", pairs, confidently_wrong, 0.01, True))
    return [r for r in rows if r.total]


def _row(
    what: str, pairs: Sequence[Pair], test: Callable[[Trial, TrialAnswer], bool], goal: float, at_most: bool = False
) -> ScoreRow:
    return ScoreRow(what, sum(test(t, a) for t, a in pairs), len(pairs), goal, at_most)


def _first(count: int) -> Callable[[Trial, TrialAnswer], bool]:
    """A test whether a right name is among the first `count` ones."""
    return lambda t, a: any(is_right(n, t.hidden[0]) for n in a.names[:count])


def _named(pairs: Sequence[Pair]) -> list[ScoreRow]:
    out = []
    for size, said, goal in (("natural", "natural size", 0.97), ("faint", "signal-to-noise 1", 0.85)):
        one = [(t, a) for t, a in pairs if len(t.hidden) == 1 and t.size == size]
        out.append(_row(f"one effect, {said}: the right name comes first", one, _first(1), goal))
        for group in sorted({t.group for t, _ in one}):
            mine = [(t, a) for t, a in one if t.group == group]
            out.append(_row(f"… {group}", mine, _first(1), goal))
    natural = [(t, a) for t, a in pairs if len(t.hidden) == 1 and t.size == "natural"]
    out.append(_row("one effect, natural size: the right name among three", natural, _first(3), 0.99))
    beyond = [(t, a) for t, a in pairs if t.group == "beyond"]
    only_true = _row(
        "outside the catalogue: only true variables named",
        beyond,
        lambda t, a: a.verdict == "unknown_effect" and bool(a.variables) and a.variables <= t.variables,
        0.92,
    )
    return [*out, only_true]


def _plates(pairs: Sequence[Pair]) -> list[ScoreRow]:
    out = []
    for count, said, goal in ((2, "two", 0.92), (3, "three", 0.75)):
        mine = [(t, a) for t, a in pairs if len(t.hidden) == count]
        out.append(
            _row(
                f"{said} effects on a plate: all claimed",
                mine,
                lambda t, a: all(any(is_right(n, names) for n in a.claimed) for names in t.hidden),
                goal,
            )
        )
    return out


def _predicted(pairs: Sequence[Pair]) -> list[ScoreRow]:
    """Rows on held-out runs after improving: predicted as well as by the true law, and down to their noise."""
    mine = [(t, a) for t, a in pairs if any(r.held_back for r in t.records)]

    def reached(t: Trial, a: TrialAnswer) -> bool:
        found = held_back(t, a)
        return found.error <= NEAR * found.reachable

    def at_noise(t: Trial, a: TrialAnswer) -> bool:
        found = held_back(t, a)
        return found.error <= NEAR * found.noise

    out = [_row(f"held-out error at most {NEAR} × that of the true law, after improving", mine, reached, 0.95)]
    for form in ("bursts", "warm_up"):
        part = [(t, a) for t, a in mine if t.what.startswith(f"{form}_")]
        out.append(_row(f"… {form.replace('_', ' ')}", part, reached, 0.95))
    return [*out, _row(f"held-out error at most {NEAR} × the noise, after improving", mine, at_noise, 0.95)]


def _doubted(pairs: Sequence[Pair]) -> list[ScoreRow]:
    """Rows on reported doubts: records and machine files that are wrong, or that do not decide."""
    out = []
    for doubt in sorted({t.doubt for t, _ in pairs if t.doubt}):
        mine = [(t, a) for t, a in pairs if t.doubt == doubt]
        words = doubt.replace("_", " ")
        out.append(_row(f"{words}: it is said", mine, lambda t, a: t.doubt in a.doubts, 0.97))
    return out


def _quiet(pairs: Sequence[Pair]) -> list[ScoreRow]:
    out = []
    for form in FORMS:
        mine = [(t, a) for t, a in pairs if t.group == "quiet" and t.what.startswith(f"{form}_")]
        words = form.replace("_", " ")
        out.append(
            _row(f"nothing hidden, {words}: an effect is named", mine, lambda _, a: a.verdict in CLAIMS, 0.02, True)
        )
    return out


def bench_page(rows: Sequence[ScoreRow], sets: int) -> Page:
    """Every row with its goal.

    Args:
        rows: rows of the score.
        sets: number of data sets.
    """
    met = sum(r.met for r in rows)
    lines = [
        (r.what, f"{r.hits} of {r.total}", f"{'at most' if r.at_most else 'at least'} {percent(r.goal)}",
         "met" if r.met else "missed")
        for r in rows
    ]  # fmt: skip
    table = Table(("what", "sets", "goal", ""), lines, words=(0, 3))
    lead = f"{met} of {len(rows)} goals are met, over {sets} data sets."
    return Page("Benchmark of hidden effects", lead, [], [Section("Score", [], table)])
