"""The whole answer of `rtec plan`: what is separated, what to add, what separates rivals, what cannot be."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from rtec.diagnosis.plan.ideas import extra_tests
from rtec.diagnosis.plan.parameters import Planned, Stays, ball_bar_set, centres, planned
from rtec.diagnosis.plan.plan import (
    WEAK,
    Extra,
    Proposal,
    Separation,
    information_by_test,
    judge,
    propose,
    route,
    total_information,
)
from rtec.diagnosis.plan.separating import Pair, Separator, SimulatedRival, ranked, separated, separating
from rtec.diagnosis.plan.tests import wanted_effects
from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.result import Result

BallBarModel = Literal["linear", "non-linear"]
Stage = Callable[[str, int, int], None]
MOST_RIVALS = 6


@dataclass(frozen=True)
class Question:
    """A question about tests.

    Attributes:
        effects: as `rtec fit --effects`; None for those of the model, or the usual ones.
        model: file of a model with the effects in question.
        ball_bar: the parameters of `rtec ballbar` instead; by default where all tests are ball bars and nothing else
            is in question.
        rivals: effects to separate from each other, all others fitted along.
        stays: whether the table-side ball stays where it is from test to test.
        noise: white noise of a reading, µm or µrad.
        suggest: also search tests to add.
    """

    effects: str | None = None
    model: Path | None = None
    ball_bar: BallBarModel | None = None
    rivals: str | None = None
    stays: Stays = "shared"
    noise: float = 0.5
    suggest: bool = True


@dataclass(frozen=True)
class Answer(Result):
    """What the tests determine, and what to add.

    Attributes:
        tests: their names.
        separation: of the parameters by these tests.
        proposals: tests that would help, best first.
        route: tests one after another until everything is separated.
        hopeless: sets that no usual test on this machine separates (of a ball bar's parameters: no circle of that
            plane), and parameters that none of them sees.
        circles: whether `hopeless` is about circles alone.
        separators: tests by how well they separate rivals.
        rivals: how well these tests separate the rivals in question, all pairs; empty without such a question.
        noise: assumed white noise, µm or µrad.
    """

    page_maker: ClassVar[str] = "rtec.report.plan:plan_page"

    tests: tuple[str, ...]
    separation: Separation
    proposals: tuple[Proposal, ...] = ()
    route: tuple[Proposal, ...] = ()
    hopeless: tuple[tuple[str, ...], ...] = ()
    separators: tuple[Separator, ...] = ()
    noise: float = 0.5
    circles: bool = False
    rivals: tuple[Pair, ...] = ()

    def rows(self) -> list[Mapping[str, Any]]:
        """The parameters, with the smallest size of each that the tests detect."""
        found = self.separation.facts()
        return [p | {"smallest_detectable": found["smallest_detectable"].get(p["name"])} for p in found["parameters"]]

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return self.separation.facts() | {
            "tests": list(self.tests),
            "noise": self.noise,
            "proposals": [_proposal(p) for p in self.proposals],
            "route": [_proposal(p) for p in self.route],
            "hopeless": [list(h) for h in self.hopeless],
            "separators": [s.test.facts() | {"pairs": [_pair(p) for p in s.pairs]} for s in self.separators],
            "rivals": [_pair(p) for p in self.rivals],
        }


def _pair(p: Pair) -> dict[str, Any]:
    return vars(p) | {"clear": p.clear}


def _proposal(p: Proposal) -> dict[str, Any]:
    return p.test.facts() | {
        "rank": p.after.rank, "gained": list(p.gained), "condition_number": p.after.condition,
    }  # fmt: skip


def answer(machine: Machine, tests: Sequence[Measurement], question: Question, stage: Stage | None = None) -> Answer:
    """What tests determine, and what to add.

    Args:
        machine: of the tests.
        tests: measurements or planned ones (`plan_tests.load_test`).
        question: about them.
        stage: progress callback: called with the stage, steps done, steps in total.

    Raises:
        ConfigError: there is nothing to ask about, or the question does not fit the tests.
        ModelError: an unknown effect, component or argument.
    """
    progress = stage or (lambda *_: None)
    asked, beside, base, rivals = _asked(machine, tests, question)
    if len(rivals) == 1:
        raise ConfigError("plan: --rivals names one effect; name two or more to separate from each other")
    noise = {m.name: question.noise for m in tests}
    found = separation_of(asked, tests, noise, question.stays)
    names = tuple(m.name for m in tests)
    pairs = separated(base, rivals, tests, question.noise) if rivals else ()
    if not question.suggest or (found.complete and found.condition <= WEAK and not rivals and not beside):
        return Answer(names, found, noise=question.noise, rivals=pairs)
    progress("looking for tests to add", 0, 1)
    extras = extra_tests(machine, tests)
    everything = planned([*asked, *beside], machine)
    here, more = (
        total_information(everything, tests, noise, question.stays),
        information_by_test(everything, extras, noise, question.stays),
    )
    return Answer(
        names,
        found,
        tuple(propose(asked, tests, extras, noise, question.stays)),
        tuple(route(asked, tests, extras, noise, question.stays)),
        _hopeless(everything, here + sum(m for e, m in more if not beside or _on_a_circle(e, tests)), beside),
        tuple(
            separating(base, rivals, tests, extras, noise=question.noise)
            if rivals
            else _separators(everything, here, more, _groups(found))
        ),
        question.noise,
        bool(beside),
        pairs,
    )


def _on_a_circle(extra: Extra, tests: Sequence[Measurement]) -> bool:
    """Whether it is a ball bar in the plane of the tests."""
    mine, theirs = extra.measurement.instrument, tests[0].instrument
    return isinstance(mine, BallBar) and isinstance(theirs, BallBar) and mine.setup.plane == theirs.setup.plane


def separation_of(
    asked: Sequence[Planned], tests: Sequence[Measurement], noise: Mapping[str, float], stays: Stays
) -> Separation:
    """Separation of parameters by tests."""
    return judge(asked, total_information(asked, tests, noise, stays))


def _asked(
    machine: Machine, tests: Sequence[Measurement], question: Question
) -> tuple[tuple[Planned, ...], tuple[Planned, ...], Model, list[FittedEffect]]:
    """Parameters; others that only matter for what can never be separated; the rivals, and what is fitted along."""
    nothing = Model(machine, (), name="nothing")
    bars = [m for m in tests if isinstance(m.instrument, BallBar)]
    plain = question.effects is None and question.model is None and question.rivals is None
    if question.ball_bar is not None or (plain and len(bars) == len(tests)):
        _check_bars(bars, question)
        bent = question.ball_bar == "non-linear"
        asked = ball_bar_set(bars, bent=bent, stays=question.stays)
        names = {p.name for p in asked}
        whole = ball_bar_set(bars, bent=bent, stays=question.stays, rolls=True)
        return asked, tuple(p for p in whole if p.name not in names), nothing, []
    balls = centres(tests, question.stays)
    if question.rivals is None:
        effects = wanted_effects(question.effects, question.model, tests, machine)
        return planned([*balls, *effects], machine), (), nothing, []
    rivals = wanted_effects(question.rivals, None, tests, machine, "--rivals")
    base = wanted_effects(question.effects, question.model, tests, machine) if not plain_base(question) else []
    known = [f for f in base if f.effect not in [r.effect for r in rivals]]
    return planned([*balls, *known, *rivals], machine), (), replace(nothing, effects=tuple(known)), rivals


def plain_base(question: Question) -> bool:
    """Whether the question is only about rivals."""
    return question.effects is None and question.model is None


def _check_bars(bars: Sequence[Measurement], question: Question) -> None:
    if question.effects is not None or question.model is not None or question.rivals is not None:
        raise ConfigError("plan: --ball-bar has its own parameters; leave --effects, --model and --rivals out")
    if not bars:
        raise ConfigError("plan: --ball-bar needs a ball-bar test among the tests")
    planes = {m.instrument.setup.plane for m in bars if isinstance(m.instrument, BallBar)}
    if len(planes) > 1:
        raise ConfigError(f"plan: ball bars in the planes {', '.join(sorted(planes))}; plan each plane by itself")


def _hopeless(
    parameters: Sequence[Planned], whole: "np.ndarray[Any, Any]", beside: Sequence[Planned]
) -> tuple[tuple[str, ...], ...]:
    """Sets that stay confounded, or unseen, with every test that the machine can take."""
    last = judge(parameters, np.asarray(whole))
    extra = {p.name for p in beside}
    unseen = tuple((name,) for name in last.never if name not in extra)
    return (*last.confounded, *unseen)


def _groups(found: Separation) -> list[tuple[str, ...]]:
    return [g for g in found.confounded if 1 < len(g) <= MOST_RIVALS][:1]


def _separators(
    parameters: Sequence[Planned],
    here: "np.ndarray[Any, Any]",
    more: Sequence[tuple[Extra, "np.ndarray[Any, Any]"]],
    groups: Sequence[tuple[str, ...]],
) -> list[Separator]:
    """Tests by how well they separate the rivals of a group, all other parameters fitted along."""
    if not groups:
        return []
    rivals = list(_rivals(parameters, groups[0]))
    taken = {int(i) for r in rivals for i in r.columns}
    base = np.array([i for i in range(len(parameters)) if i not in taken], dtype=np.int64)
    return ranked(here, more, base, rivals) if len(rivals) > 1 else []


def _rivals(parameters: Sequence[Planned], names: Sequence[str]) -> list[SimulatedRival]:
    """One rival for each effect, at its usual size; a parameter of a ball bar is one by itself."""
    groups: dict[str, list[int]] = {}
    for i, p in enumerate(parameters):
        if p.name in names:
            groups.setdefault(p.of or p.name, []).append(i)
    return [
        SimulatedRival(name, np.array(rows), np.array([parameters[i].typical for i in rows]))
        for name, rows in groups.items()
    ]
