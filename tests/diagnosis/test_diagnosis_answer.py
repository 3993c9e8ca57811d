"""What the answer says beside the name: more is missing, out of date, folded waves, what hardly shows.

Oracles: the effects that were put in; trigonometry of samples at equal steps.
"""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rtec.diagnosis import words
from rtec.diagnosis.result import Member
from rtec.diagnosis.search.answer import determined
from rtec.diagnosis.search.confounded import aliases_mm, fold, step_mm
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects import Parameter
from rtec.estimation.candidates import library
from rtec.estimation.outliers import clean
from rtec.estimation.readings import read
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser, small_machine

BACKLASH = "backlash,component=EXX,axis=X,B=6"
SCREW = "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=1.2,c1=0.5,pitch=5"
EVEN: dict[str, Any] = {"targets": {"step_mm": 9.6}}


def model(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts), name="base")


def test_what_stands_behind_the_first_is_not_called_absent() -> None:
    """Both are true; the larger is named, and the smaller is told to speak up beside it."""
    d = diagnose(model(), [laser([BACKLASH, SCREW], 3)], explain=True)
    assert d.findings[0].effect.effect == "backlash"
    assert "cyclic_screw" not in {a.effect for a in d.absent}
    assert any("more is missing" in note and "cyclic_screw(EXX, X)" in note for note in d.notes), d.notes


def test_nothing_more_is_said_where_nothing_more_is() -> None:
    d = diagnose(model(), [laser([BACKLASH], 4)], explain=True)
    assert d.findings[0].effect.effect == "backlash"
    assert not any("more is missing" in note for note in d.notes)


def test_numbers_that_no_longer_fit_are_told() -> None:
    """A model fitted to 6 µm of play, readings with 9: no effect is missing, and a refit would cure it."""
    known = model(BACKLASH)
    d = diagnose(known, [laser(["backlash,component=EXX,axis=X,B=9"], 5)], explain=True)
    assert d.verdict == "nothing_missing"
    assert d.out_of_date
    assert d.facts()["out_of_date"] is True
    assert d.refit == pytest.approx(0.3, rel=0.1)
    assert "out of date" in d.sentence
    still = diagnose(known, [laser([BACKLASH], 5)])
    assert not still.out_of_date
    assert "out of date" not in still.sentence
    little, enough = (words.with_sentence(still, times * still.rms_residual).sentence for times in (2.5, 1.5))
    assert "(they show little: half of the effects tested only from" in little
    assert "(half of those tested from" in enough


def test_aliases_are_one_wave_at_the_targets() -> None:
    """Cosines of all of them agree at every multiple of the step, up to the sign of the sine."""
    at = 9.6 * np.arange(30)
    others = aliases_mm(5.0, 9.6)
    assert max(others) == pytest.approx(120.0)
    for other in others:
        np.testing.assert_allclose(np.cos(2 * np.pi * at / other), np.cos(2 * np.pi * at / 5.0), atol=1e-9)


def test_a_wave_folded_by_equal_steps_is_not_named_alone() -> None:
    """The screw's own period fits, and so does any that equal steps fold onto it."""
    d = diagnose(model(), [laser([SCREW], 6, **EVEN)])
    assert d.findings[0].effect.effect == "cyclic_screw"
    assert d.verdict == "ambiguous"
    assert "unequal steps along X" in d.sentence
    (longest,) = re.findall(r"looks like one of ([0-9.]+)", d.findings[0].confused_with[-1].why)
    assert float(longest) == pytest.approx(1.0 / (2.0 / 9.6 - 1.0 / 5.0), rel=0.01)


def test_steps_that_are_not_equal_fold_nothing() -> None:
    m = laser([SCREW], 7, **EVEN)
    x_mm = m.channels["x"]
    readings = read([replace(m, channels={**m.channels, "x": x_mm + 1.3 * np.sin(x_mm)})])
    assert step_mm(readings, "x", readings.arms("EXX") != 0.0) is None
    (screw,) = effects(SCREW)
    nothing, part = np.zeros((len(readings), 0)), np.sin(2 * np.pi * readings.channel("x") / 5.0)
    assert fold(readings, nothing, screw.effect, screw.theta, part) is None
    even = read([laser([SCREW], 7, targets={"step_mm": 2.0})])
    assert step_mm(even, "x", even.arms("EXX") != 0.0) == pytest.approx(2.0)
    nothing, part = np.zeros((len(even), 0)), np.sin(2 * np.pi * even.channel("x") / 5.0)
    assert fold(even, nothing, screw.effect, screw.theta, part) is None, "2.5 readings a period are enough"


@pytest.mark.parametrize(("off_mm", "period_mm", "said"), [(0.1, 16.0, True), (0.8, 9.0, True), (1.4, 16.0, False)])
def test_targets_that_are_a_little_off_their_step_fold_too(off_mm: float, period_mm: float, said: bool) -> None:
    """Oracle: a wave's shares by scatter, exp(-(2π·off/p)²/2): told where it is high, and near the step always."""
    m = laser([SCREW], 9, **EVEN)
    x_mm = m.channels["x"] + off_mm * np.random.default_rng(4).standard_normal(len(m.channels["x"]))
    readings = read([replace(m, channels={**m.channels, "x": x_mm})])
    assert step_mm(readings, "x", readings.arms("EXX") != 0.0) is None
    (pole,) = effects(f"cyclic_pole,component=EXX,axis=X,s=1,c=0,period={period_mm}")
    part = np.sin(2 * np.pi * readings.channel("x") / period_mm)
    answer = fold(readings, np.zeros((len(readings), 0)), pole.effect, pole.theta, part)
    assert (answer is not None) == said
    if answer is not None:
        (longest,) = re.findall(r"is like one of ([0-9.]+) mm", answer.why)
        assert float(longest) == pytest.approx(aliases_mm(period_mm, 9.6)[0], rel=0.15)
        assert "unequal steps along X" in answer.separating_test


def test_a_machine_that_errs_in_the_same_places_has_no_wrong_readings() -> None:
    """A slope and a coarse wave under little noise: neighbours differ, nothing is wrong. Wrong readings are found."""
    m = laser([SCREW, "scale,component=EXX,axis=X,k=60"], 8, **EVEN)
    assert not clean([m]).wrong
    wrong = np.array([40, 111, 205])
    values = m.readings["reading_um"].copy()
    values[wrong] += [15.0, -15.0, 15.0]
    assert [w.row for w in clean([replace(m, readings={"reading_um": values})]).wrong] == wrong.tolist()


def test_what_hardly_moved_is_not_called_absent() -> None:
    """Temperatures that hardly rose show no expansion; a day of warming up does."""
    m = laser([BACKLASH], 9)
    warm = diagnose(model(), [m])
    assert "axis_expansion" in {a.effect for a in warm.absent}
    cold = {n: 20.0 + 0.1 * (v - v.mean()) if n.startswith("T_") else v for n, v in m.channels.items()}
    d = diagnose(model(), [replace(m, channels=cold)])
    assert d.findings[0].effect.effect == "backlash"
    assert "axis_expansion" not in {a.effect for a in d.absent}
    (why,) = {n.why for n in d.not_testable if n.effect == "axis_expansion"}
    assert why.startswith("at its usual size it adds ")


@pytest.mark.parametrize(
    ("known", "size", "said"),
    [
        ((), 1.396, "1.40 µm of the 1.40 µm residual"),
        ((), 1.7, "explains all of the 1.40 µm residual"),
        ((BACKLASH,), 1.7, "compensate a part"),
    ],
)
def test_an_effect_makes_no_more_of_what_is_left_than_there_is(known: tuple[str, ...], size: float, said: str) -> None:
    """Oracle: sums. 1.7 of 1.4 µm would be nonsense, and is what a model leaves that follows the effect in part."""
    d = diagnose(model(*known), [laser([SCREW, *known], 6)])
    finding = replace(d.findings[0], size_um=size)
    told = words.with_sentence(replace(d, verdict="missing_effect", findings=(finding,), rms_residual=1.4), 1.0)
    assert said in told.sentence


def test_the_size_that_would_have_been_seen() -> None:
    """Of a backlash that is not there, in white noise. Oracle: numpy's projection, and the gain that a name needs.

    With ln m for m candidates and ½ ln n for one number the log likelihood must gain ln m + ½ ln n.
    """
    noise_um = 0.3
    m = laser([], 41, noise={"white_um": noise_um})
    d = diagnose(model("scale,component=EXX,axis=X,k=0"), [m])
    (found,) = [a for a in d.absent if (a.effect, a.component) == ("backlash", "EXX")]
    x, way = m.channels["x"], 0.5 * m.channels["d_x"]
    known = np.stack([np.ones_like(x), x], axis=1)
    off = way - known @ np.linalg.lstsq(known, way, rcond=None)[0]
    most = len(library(read([m], 20.0))[0])
    low, high = (
        noise_um * np.sqrt(2.0 * (np.log(count) + 0.5 * np.log(len(m)))) * 0.5 / np.linalg.norm(off)
        for count in (most / 4, most)
    )
    assert 0.9 * low < found.smallest < 1.1 * high


@pytest.mark.parametrize(
    ("parameter", "value", "se", "known"),
    [
        (Parameter("s0", "mm", low=0.005, high=20.0), 0.01, 1.3e14, False),
        (Parameter("s0", "mm", low=0.005, high=20.0), 0.3, 0.1, True),
        (Parameter("k", "um_per_m", typical=10.0), 130.9, 16252.0, False),
        (Parameter("k", "um_per_m", typical=10.0), 0.0, 49.0, True),
    ],
)
def test_an_error_beyond_all_that_is_looked_for_tells_nothing(
    parameter: Parameter, value: float, se: float, known: bool
) -> None:
    """Oracle: the range of the search, and a hundred times the usual size."""
    assert determined(parameter, value, se) is known


def test_one_effect_with_two_delays_is_told_apart_by_them() -> None:
    """Oracle: the delays that are given; 4500 s are 75 min."""
    late = [
        replace(f, theta={"tau": tau})
        for tau in (27000.0, 4500.0)
        for f in effects("mount_expansion,component=EXX,sensor=T_air,lag=true,k=1,tau=1800")
    ]
    d = diagnose(model(), [laser([BACKLASH], 4)])
    d = replace(d, together=(Member(late[0], 0.65), Member(late[1], 0.93)), verdict="missing_effect")
    name = "mount_expansion(EXX, T_air)"
    said = words.with_sentence(d, 0.1).sentence
    assert said.startswith(f"{name}, 7.5 h late (65 % of the held-out mean square error) and {name}, 75 min late (28 %")
    first, other = (replace(d.findings[0], effect=f.effect, theta=f.theta) for f in late)
    pair = replace(d, together=(), findings=(replace(first, partner=other), other))
    assert words.with_sentence(pair, 0.1).sentence.startswith(f"{name}, 7.5 h late and {name}, 75 min late are missing")


@pytest.mark.parametrize(
    ("ahead", "whole", "says"),
    [
        (11.0, 30.0, "likelier than rank 1 by itself; rank 1 and what is named with it are likelier together"),
        (11.0, 5.0, "likelier than rank 1 by itself"),
        (11.0, None, "likelier than rank 1 by itself"),
        (2.0, 30.0, "as likely as rank 1"),
    ],
)
@pytest.mark.parametrize("same", [True, False])
def test_what_is_far_likelier_is_not_called_as_likely(ahead: float, whole: float | None, says: str, same: bool) -> None:
    """Oracle: the odds, e¹¹ to one and e² to one."""
    assert words.why_not(ahead, 0.0, 1.0, same=same, whole=whole).startswith(says)


def test_an_expression_over_a_temperature_says_where_it_holds() -> None:
    """A wave above a threshold of a temperature. Oracle: the range of the readings."""
    m = laser([], 8)
    bed = m.channels["T_bed"]
    warm = 12.0 * np.maximum((bed - np.quantile(bed, 0.6)) / np.ptp(bed), 0.0) ** 2
    bent = replace(m, readings={k: v + warm * np.cos(m.channels["x"] / 30.0) for k, v in m.readings.items()})
    d = diagnose(model(), [bent], draws=50, explain=True)
    assert d.unknown is not None
    assert "T_bed" in d.unknown.expression
    ((name, low, high),) = d.unknown.within
    assert name == "T_bed"
    assert (low, high) == pytest.approx((bed.min(), bed.max()), abs=0.1)
    assert f"holds only in the range of these readings: T_bed {low:.1f} to {high:.1f} °C" in d.sentence
    assert d.facts()["unknown"]["within"] == [{"channel": "T_bed", "low": low, "high": high}]


def test_an_expression_over_a_place_has_no_such_range() -> None:
    """A sawtooth along the axis. Oracle: what was put in."""
    m = laser([], 8, targets={"step_mm": 3.1})
    teeth = {k: v + 4.0 * np.mod(m.channels["x"] / 61.0, 1.0) for k, v in m.readings.items()}
    d = diagnose(model(), [replace(m, readings=teeth)], draws=50, explain=True)
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)
    assert d.unknown.expression
    assert d.unknown.within == ()
    assert "range of these readings" not in d.sentence
