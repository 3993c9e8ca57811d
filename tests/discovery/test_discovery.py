"""A small part of the benchmark of hidden effects: enough to see the diagnosis break, small enough for every run.

Oracle: the generator's truth, which shares nothing with the program. The whole benchmark is `make discovery`; its goals
are for hundreds of sets, so the limits here leave room for the chance of a few.
"""

import pytest

from rtec.effects import EFFECTS
from tests.discovery.figures import cut
from tests.discovery.generator.cases import BY_NAME, Case, single
from tests.discovery.generator.truths import TRUTHS
from tests.discovery.score import Outcome
from tests.discovery.work import one
from tests.support import proof

SEED = 400
SINGLES = (
    ("scale", "ou"),
    ("polynomial_position", "flicker"),
    ("cyclic_screw", "random_walk"),
    ("backlash", "steps"),
    ("backlash_position", "white"),
    ("servo_lag", "ou"),
    ("axis_expansion", "daily"),
    ("squareness", "heavy"),
    ("spindle_speed_shift", "ou"),
    ("guide_lift", "flicker"),
)
CLEAN = (("laser", "ou"), ("drift", "random_walk"), ("straightness", "flicker"), ("tool_tip", "steps"))
OUTSIDE = (("odd_period", "ou"), ("resonance", "white"))
GROUP = "discovery"


SUITE = ("cyclic_screw", "backlash", "backlash_position", "axis_expansion", "guide_lift")
"""Those that every run has; the others are in `make proof`."""


@pytest.fixture(scope="module")
def singles() -> list[Outcome]:
    chosen = [(i, *s) for i, s in enumerate(SINGLES) if proof.WHOLE or s[0] in SUITE]
    return [one("evidence", single(SEED + i, BY_NAME[name], noise)) for i, name, noise in chosen]


@pytest.mark.xdist_group(GROUP)
def test_every_hidden_effect_is_in_the_catalogue() -> None:
    """Oracle: the registry. A truth whose name is not there could never be found."""
    known = set(EFFECTS)
    assert {t.name for t in TRUTHS} <= known
    assert {s.effect for t in TRUTHS for s in t.same} <= known


@pytest.mark.xdist_group(GROUP)
def test_hidden_effects_are_named(singles: list[Outcome]) -> None:
    """At least 8 of 10 first, 9 among three; with 95 % and 98 % as goals of ten fewer come once in 90 and 60 seeds."""
    said = [f"{o.case.label}: {[str(n) for n in o.answer.names[:3]]} {o.failure}" for o in singles]
    assert sum(o.right == 1 for o in singles) >= 0.8 * len(singles), said
    assert sum(1 <= o.right <= 3 for o in singles) >= 0.9 * len(singles), said


@pytest.mark.xdist_group(GROUP)
def test_what_is_claimed_holds_the_truth(singles: list[Outcome]) -> None:
    """Of ten that are claimed at most one group lacks it, and most are claimed."""
    claimed = [o for o in singles if o.answer.accepted]
    assert len(claimed) >= 0.8 * len(singles)
    assert sum(o.in_group for o in claimed) >= 0.9 * len(claimed)


@pytest.mark.xdist_group(GROUP)
def test_improving_brings_the_error_down_where_nobody_looked(singles: list[Outcome]) -> None:
    """Oracle: the same with the true shapes fitted, and the noise alone in the runs left out."""
    own, oracle = cut(singles)
    assert own > oracle - 0.15
    assert sum(o.at_floor for o in singles) >= 0.8 * len(singles)


@pytest.mark.xdist_group(GROUP)
def test_nothing_is_claimed_where_nothing_is_hidden() -> None:
    """With a goal of 3 % two of four come once in two hundred seeds."""
    outcomes = [
        one("evidence", Case("clean", SEED + i, kind, form)) for i, (kind, form) in enumerate(proof.few(CLEAN, 2))
    ]
    assert not [o.failure for o in outcomes if o.failure]
    assert sum(o.answer.accepted for o in outcomes) <= 1


@pytest.mark.xdist_group(GROUP)
def test_what_has_no_name_is_told_by_its_variables() -> None:
    """A wave over a period that is no pitch; a shift of the spindle in a band of speeds."""
    cases = [Case("outside", SEED + i, BY_NAME[n].kind, form, (n,)) for i, (n, form) in enumerate(OUTSIDE)]
    outcomes = [one("evidence", case) for case in cases]
    said = [f"{o.case.label}: {o.answer.names[:1]} {o.answer.unknown} {o.failure}" for o in outcomes]
    assert sum(o.names_true_only for o in outcomes) >= 1, said
    assert sum(o.answer.accepted for o in outcomes) <= 1, said


@pytest.mark.xdist_group(GROUP)
def test_the_same_seed_gives_the_same_answer(singles: list[Outcome]) -> None:
    """Oracle: the first time, through the noise, the draws of chance and the refits."""
    first = next(o for o in singles if o.case.hidden == ("cyclic_screw",))
    second = one("evidence", first.case)
    assert first.answer == second.answer
    assert first.after == second.after
