"""What `diagnose` says: the order of effects, the period of a wave, each thing once. Oracles: written by hand."""

import math
from dataclasses import replace
from typing import Any

from rtec.diagnosis import words
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.diagnosis.extend.add import Added
from rtec.diagnosis.extend.history import Errors
from rtec.diagnosis.extend.improve import Improved
from rtec.diagnosis.result import Diagnosis, Finding, Member, Unknown
from rtec.diagnosis.search.diagnose import diagnose
from rtec.model import FittedEffect, Model
from rtec.report.diagnosis import diagnosis_page
from rtec.report.history import improved_page
from tests.diagnosis.test_other_machine import HEAT, HOT, THEIRS, fitted
from tests.support.diagnosis_examples import effects, laser, small_machine

CURVE, GROWTH, WAVE = effects(
    "polynomial_position,component=EXX,axis=X,c1=1,c2=1",
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11",
    "cyclic_pole,component=EXX,axis=X,s=2,c=0,period=39.87",
)


def finding(f: FittedEffect, rank: int = 1, confidence: float = 0.9, **more: Any) -> Finding:
    channels = f.effect.channels(small_machine())
    made = Finding(rank, f.effect, f.theta, {}, channels, 0.6, confidence, 50.0, 0.001, 3.0, rank == 1, rank == 1)
    return replace(made, **more)


def answer(verdict: str, *found: Finding, **more: Any) -> Diagnosis:
    made = Diagnosis(verdict, "", "um", 3.0, 0.3, 1.0, found, None, (), (), (), ())  # type: ignore[arg-type]
    return words.with_sentence(replace(made, **more), math.nan)


def test_what_removes_most_is_named_first() -> None:
    """The second removes 28 % of the held-out mean square error, the first 2 %."""
    both = (Member(CURVE, 0.02), Member(GROWTH, 0.30))
    said = answer("missing_effect", finding(CURVE), together=both).sentence
    assert said.startswith("axis_expansion(EXX, X, T_bed) (28 % of the held-out mean square error) and polynomial_")
    larger_first = answer("missing_effect", finding(GROWTH), together=(Member(GROWTH, 0.28), Member(CURVE, 0.30)))
    assert larger_first.sentence == said
    # One that is larger without the next has no share of its own: then they stay as they were added.
    order = answer("missing_effect", finding(CURVE), together=(Member(CURVE, 0.40), Member(GROWTH, 0.30))).sentence
    assert order.startswith("polynomial_position(EXX, X) and axis_expansion(EXX, X, T_bed), which together remove 30 %")


def test_what_is_named_beside_an_effect_is_no_rival_of_it() -> None:
    other = "mount_expansion(EXX, T_bed)"
    both = (Member(GROWTH, 0.28), Member(CURVE, 0.30, ("axis_expansion(EXX, X, T_bed)", other)))
    said = answer("missing_effect", finding(GROWTH), together=both).sentence
    assert f"(2.0 % of the held-out mean square error, or {other} in its place)" in said


def test_a_wave_is_named_with_its_period() -> None:
    wave = "cyclic_pole(EXX, X) with a period of 39.87 mm"
    assert answer("missing_effect", finding(WAVE)).sentence.startswith(f"{wave} is missing: it explains ")
    forms = (finding(WAVE), replace(finding(WAVE, 2), group=True))
    said = answer("missing_effect", *forms).sentence
    assert said.startswith(f"{wave} is missing: it explains ")
    assert "; its form cannot be determined from these data" in said
    together = (Member(WAVE, 0.5), Member(GROWTH, 0.8))
    assert f"{wave} (50 % of the " in answer("missing_effect", finding(WAVE), together=together).sentence
    pair = finding(GROWTH, partner=finding(WAVE, 2))
    assert f" and {wave} are missing together" in answer("missing_effect", pair).sentence
    assert "period" not in answer("missing_effect", finding(GROWTH)).sentence
    # Two of one name have the period in their names already.
    other = replace(WAVE, theta={"period": 12.5})
    two = answer("missing_effect", finding(WAVE), together=(Member(WAVE, 0.5), Member(other, 0.8))).sentence
    assert two.count("39.9") == two.count("12.5") == 1
    assert two.count("period") == 2


def caption(d: Diagnosis) -> str:
    brief = diagnosis_page(d, figures=False).brief
    assert brief is not None
    assert brief.table is not None
    return brief.table.caption


def test_a_first_name_of_low_probability_is_explained() -> None:
    """The probabilities are of each effect as the only one that is missing; the answer has more than one part."""
    rest = Unknown("laser", ("x", "time_s"), "smooth", None, 0.001, 0.8)
    low, high = finding(GROWTH, confidence=0.0004), finding(CURVE, 2, 0.7)
    beside = answer("ambiguous", low, high, together=(Member(GROWTH, 0.57),), unknown=rest)
    said = "Probability: that it is all that is missing; the first is named beside what has no name."
    assert said in caption(beside)
    assert "probability of the first" not in str(diagnosis_page(beside, figures=False).numbers)
    alone = answer("missing_effect", low, high)
    assert "The first is less probable. It comes first because it has fewer numbers, is what the instrument" in caption(
        alone
    )
    usual = answer("missing_effect", finding(GROWTH), finding(CURVE, 2, 0.1))
    assert "robab" not in caption(usual)


def test_files_that_are_asked_about_share_one_sentence() -> None:
    """Oracle: two files of another machine, simulated; each is named once, with its own residual."""
    d = diagnose(fitted()[0], [laser([*THEIRS, HEAT], seed, thermal=HOT) for seed in (3, 4)], draws=50)
    assert [doubt.kind for doubt in d.doubts] == ["other_machine"] * 2
    for once in ("The model leaves ", "of laser-x-3", "of laser-x-4", "Check whether they are of this machine."):
        assert d.sentence.count(once) == 1, once
    texts = [doubt.words for doubt in d.doubts]
    assert words.of_files(texts[:1]) == texts[:1]
    assert words.of_files([*texts, "Anything else."])[1:] == ["Anything else."]


def test_an_improvement_prints_the_diagnosis_that_ended_it() -> None:
    """It had said "see the last diagnosis", which only the report has."""
    model = Model(small_machine(), (GROWTH,), name="m")
    errors = Errors(2.0, 2.0, 2.0, 1.0)
    step = Added(model, (GROWTH.effect.label,), errors, replace(errors, held_out=1.0), 0.3, "um", True, 0.3)
    doubt = Doubt("few_runs", "Two runs only.", "Measure more.", fatal=True)
    last = replace(answer("undecided", finding(CURVE, accepted=False)), sentence="the runs differ by 2 µm")
    done = Improved(model, (step,), (replace(last, doubts=(doubt,)),), "undecided")
    lead = improved_page(done, figures=False).lead
    assert lead.endswith("because these readings do not decide what is missing. The runs differ by 2 µm.")
    assert "see the last" not in lead


def test_what_depends_on_the_feed_alone_may_be_an_effect_of_the_velocity() -> None:
    """Oracle: no velocity beside the feed, so that no effect of it was tried; the key lets them be."""
    feed = Unknown("straightness", ("feed_mm_min",), "smooth", None, 0.001, 0.8)
    found = finding(CURVE, accepted=False)
    said = answer("unknown_effect", found, unknown=feed, adequacy=None).sentence
    assert "Effects of the velocity were not tested" in said
    assert "write moves_at_feed = true under [table]" in said
    other = answer("unknown_effect", found, unknown=replace(feed, channels=("x",)), adequacy=None).sentence
    assert "moves_at_feed" not in other


def test_a_step_is_no_smooth_dependence() -> None:
    step = Unknown("laser", ("x",), "smooth", None, 0.001, 0.8, where="a step at X ≈ 64.0 mm")
    said = answer("unknown_effect", finding(CURVE, accepted=False), unknown=step, adequacy=None).sentence
    assert "the residual depends on X, with a step at X ≈ 64.0 mm" in said


def test_of_effects_that_cannot_be_distinguished_none_has_a_probability_of_its_own() -> None:
    """Oracle: the large numbers of one candidate, and of two that are alike."""
    alone = diagnosis_page(answer("missing_effect", finding(GROWTH, confidence=0.999)), figures=False)
    assert alone.numbers[-1][1] == "probability of the first candidate"
    two = answer("ambiguous", finding(GROWTH, confidence=0.999), replace(finding(CURVE, 2), group=True))
    assert diagnosis_page(two, figures=False).numbers[-1] == ("1 of 2", "effects that these data cannot distinguish")
