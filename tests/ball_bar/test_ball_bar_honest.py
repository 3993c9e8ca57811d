"""The diagnosis asserts nothing that the readings cannot show; the oracle is `ball_bar_truth`, exact transforms."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rtec.metrology.ball_bar.diagnosis import BallBarDiagnosis, diagnose
from rtec.report.ball_bar import ball_bar_page
from rtec.report.page import render
from tests.support import proof
from tests.support.ball_bar_truth import SIDES, THREE, Bar, TrueMachine, recordings, truth_of


def off_se(d: BallBarDiagnosis, truth: dict[str, float]) -> dict[str, float]:
    """How many standard errors each asserted parameter is off."""
    return {
        v.name: abs(v.value - truth[v.name]) / v.se
        for v in d.fitted.values
        if v.name in truth and np.isfinite(v.value) and np.isfinite(truth[v.name])
    }


def table_of(d: BallBarDiagnosis, heading: str) -> dict[str, list[str]]:
    section = next(s for s in ball_bar_page(d, figures=False).sections if s.heading.startswith(heading))
    assert section.table is not None
    return {row[0]: list(row) for row in section.table.rows}


# ---- 1: the height of the table ball


@pytest.mark.parametrize("model", ["auto", "non-linear"])
def test_a_ball_that_is_higher_than_said_is_no_bend(model: Any) -> None:
    """Oracle: a perfect machine; the ball is 10 µm higher in the two tests that have a height."""
    bars = [replace(b, height_um=10.0 if b.h else 0.0) for b in THREE]
    d = diagnose(recordings(TrueMachine("tool", "XY"), bars), model)
    assert max(off_se(d, truth_of(TrueMachine("tool", "XY"), bars)).values()) < 3.5
    said = ball_bar_page(d, figures=False).lead
    assert "bend" not in said
    assert not d.found.beyond.picks
    if model == "non-linear":
        v = d.fitted.value("pitch_x")
        assert v.low < 0.0 < v.high
        # λ h r / 2 per 1/km against h / L per µm.
        assert v.high - v.low == pytest.approx(4 * 50.0 / (60.0 / 150.0) * 0.4 / (137.477**2 * 1e-3), rel=0.5)
        text = render(ball_bar_page(d, figures=False))
        assert "height of the table ball" in text
        assert "plane ZX" in text, "the test that separates them is named"


def test_a_height_that_was_measured_gives_the_bend_back() -> None:
    """Oracle: what was made true, with a ball whose height is known to 1 µm."""
    m = TrueMachine("tool", "XY", {"arch_a": 1.5})
    d = diagnose(recordings(m, THREE, height_uncertainty_mm=0.001), "non-linear")
    v = d.fitted.value("pitch_x")
    assert abs(v.value - 1.5) < 3 * v.se
    assert v.se < 0.2
    assert "bend X out of plane" in ball_bar_page(d, figures=False).lead


def test_a_scale_allows_for_what_the_height_hides() -> None:
    """Oracle: a perfect machine, both heights off by 0.12 mm: as a bend that is 0.1 mm out of plane, which makes a flat
    bar 50 nm longer, and that looks like a scale. Its interval holds the true 0, and no bend is named."""
    bars = [replace(b, height_um=120.0 if b.h else 0.0) for b in THREE]
    d = diagnose(recordings(TrueMachine("tool", "XY"), bars, 0.02), "non-linear", dynamic=False)
    for name in ("scale_x", "scale_y"):
        v = d.fitted.value(name)
        assert abs(v.value) > 0.2, "else this shows nothing"
        assert v.low < 0.0 < v.high
    assert d.named is None


# ---- 2: a bar of unknown length


def test_of_a_bar_of_unknown_length_only_differences_are_shown() -> None:
    """Oracle: a perfect machine; each test's bar is off by a length of its own."""
    bars = [replace(b, longer_um=long) for b, long in zip(THREE, (-46.8, 12.0, 30.0), strict=True)]
    for m in (TrueMachine("tool", "XY"), TrueMachine("tool", "XY", {"scale_a": 25.0, "scale_b": 5.0})):
        d = diagnose(recordings(m, bars, zero="setup"))
        for name in ("scale_x", "scale_y"):
            assert np.isnan(d.fitted.value(name).value)
            assert np.isnan(d.facts()["parameters"][name]["value"])
        apart = next(c for c in d.fitted.combinations if dict(c.terms) == {"scale_x": 1.0, "scale_y": -1.0})
        assert abs(apart.value - (m["scale_a"] - m["scale_b"])) < 3.5 * apart.se
        page = ball_bar_page(d, figures=False)
        assert "312" not in render(page)
        assert not d.fitted.heights, "it is the length that hides the scales; a height that is known would not help"
        group = "scale X or scale Y, not separated"
        if m.size:
            assert f"The largest cause is {group}" in page.lead
            assert "position scale X - position scale Y" in table_of(d, "Causes")[group][3]
        else:
            assert "largest cause" not in page.lead


def test_two_feeds_tell_a_servo_gain_from_a_difference_of_scales() -> None:
    """Oracle: algebra: a gain of both loops is a length of the bar, that of one goes with the feed squared."""
    bars = [replace(b, longer_um=12.0) for b in (*THREE, Bar(0.0, 150.0, "cw", 3000.0))]
    m = TrueMachine("tool", "XY", {"scale_a": 40.0})
    two = diagnose(recordings(m, bars, zero="setup"))
    assert "scale X or scale Y, not separated: " in ball_bar_page(two, figures=False).lead
    one = diagnose(recordings(m, bars[:1], zero="setup"))
    assert "not separated (or servo gain error of X and servo gain" in ball_bar_page(one, figures=False).lead
    assert "servo gain error of X" in render(ball_bar_page(one, figures=False))


def test_a_size_is_shown_with_what_one_feed_does_not_separate_from_it() -> None:
    """Oracle: what was made true: no scale, but two servo loops that make the circle smaller; at one feed it is one."""
    d = diagnose(recordings(TrueMachine("table", "XY", {"lag_ms": 25.0}), THREE, 0.1))
    for axis in "XY":
        v = d.fitted.value(f"scale_{axis.lower()}")
        assert v.high < 0.0, "else this shows nothing"
        assert f"together with servo gain error of {axis}" in table_of(d, "Causes")[f"scale {axis}"][3]


def test_a_larger_cause_that_is_not_determined_makes_none_the_largest() -> None:
    """Oracle: what was made true: loops that make the circle 1.2 µm smaller at the other feed, and 0.3 µm of twist."""
    size = {"ex": -4.2, "ey": -9.2, "roll": 37.2, "lag_ms": 12.07}
    bars = (
        THREE[0],
        replace(THREE[1], height_um=18.9),
        replace(THREE[2], height_um=-36.7),
        Bar(0.0, 150.0, "cw", 3000.0),
    )
    d = diagnose(recordings(TrueMachine("bridge", "XZ", size), bars, 0.404, 200130))
    assert d.named is not None
    assert d.named.group == "twist X"
    lead = ball_bar_page(replace(d, fitted=replace(d.fitted, combinations=())), figures=False).lead
    assert "The largest cause that these tests determine is twist X" in lead
    assert "Not determined: scale X, up to" in lead


# ---- 3: bent guides on other machines


@pytest.mark.parametrize("kind", list(SIDES))
@pytest.mark.parametrize("plane", ["XY", "XZ", "YZ"])
def test_bent_guides_are_found_on_every_kind_of_machine(kind: str, plane: str) -> None:
    """Oracle: what was made true: two guides bent in the plane, one along the third direction, and a twist."""
    size = {"bend_a": 0.3, "bend_b": -0.2, "arch_a": 0.4, "arch_b": 0.4, "roll": 150.0, "scale_a": -10.0, "lean": 20.0}
    m = TrueMachine(kind, plane, size)
    d = diagnose(recordings(m, THREE))
    assert d.fitted.model == "non-linear", d.reason
    far = off_se(d, truth_of(m, THREE))
    assert set(far) >= {"twist", "squareness", f"yaw_{plane[0].lower()}", f"yaw_{plane[1].lower()}"}
    assert max(far.values()) < 3.5, far
    assert d.explained > 0.99
    assert not d.found.beyond.picks


def test_two_tests_find_what_they_separate() -> None:
    """Oracle: what was made true. Two tests do not tell squareness, servo phase and twist apart; the bend they do."""
    m = TrueMachine("tool", "XY", {"bend_a": 0.3, "lean": 20.0})
    d = diagnose(recordings(m, THREE[:2]))
    assert max(off_se(d, truth_of(m, THREE)).values()) < 3.5
    assert abs(d.fitted.value("yaw_x").value - 0.3) < 0.02
    assert np.isnan(d.fitted.value("squareness").value)


# ---- 4: confounded parameters


def test_one_test_names_the_set_and_what_of_it_is_determined() -> None:
    """Oracle: what was made true: -78.8 of squareness and a phase of 71 µrad, which one test reads as -149.8."""
    lead_ms = 71e-6 / (1000.0 / 60.0 / 150.0) * 1e3
    m = TrueMachine("tool", "XY", {"lean": -78.8, "lead_ms": lead_ms})
    d = diagnose(recordings(m, THREE[:1]))
    lead = ball_bar_page(d, figures=False).lead
    assert "squareness or servo phase, not separated" in lead
    assert np.isnan(d.fitted.value("squareness").value)
    both = next(c for c in d.fitted.combinations if {n for n, _ in c.terms} == {"squareness", "phase"})
    assert dict(both.terms) == {"squareness": 1.0, "phase": -1.0}
    assert abs(both.value + 149.8) < 3.5 * both.se + 0.1
    facts = d.facts()
    assert facts["combinations"][0]["terms"] == {"squareness": 1.0, "phase": -1.0}
    size = table_of(d, "Causes")["squareness or servo phase, not separated"]
    assert "squareness X-Y - servo phase mismatch X-Y" in size[3]


# ---- 5: one angle or one time, undecided


@pytest.mark.parametrize("seed", proof.few(range(4), 2))
def test_where_angle_or_time_is_undecided_intervals_hold_both_answers(seed: int) -> None:
    """Oracle: what was made true, a lag that is one time, in tests of three angular speeds that cannot tell."""
    rng = np.random.default_rng(seed)
    m = TrueMachine("tool", "XY", {"lean": float(rng.uniform(-40, 40)), "lead_ms": float(rng.uniform(-0.5, 0.5)),
                                   "roll": 80.0, "bend_a": 0.3})  # fmt: skip
    bars = (Bar(0.0, 150.0, "ccw"), Bar(90.0, 120.0, "cw"), Bar(90.0, 120.0, "ccw"))
    d = diagnose(recordings(m, bars, seed=seed))
    assert not d.phase.decided
    far = off_se(d, truth_of(m, bars))
    assert max(far.values()) < 3.5, far
    v = d.fitted.value("squareness")
    assert v.low <= m["lean"] <= v.high
    assert d.facts()["parameters"]["squareness"]["low"] == v.low


def test_a_twist_as_large_as_the_difference_decides_nothing() -> None:
    """Oracle: what was made true, a lag and a twist which together make what one angle and no twist would make."""
    bars = (Bar(0.0, 150.0, "ccw"), Bar(60.0, 137.477, "cw"), Bar(60.0, 137.477, "ccw"))
    m = TrueMachine("tool", "XY", {"lead_ms": 0.3196, "roll": -52.9, "play_a": 3.6, "scale_a": -3.1})
    d = diagnose(recordings(m, bars, 0.25, 20007))
    assert not d.phase.decided
    assert max(off_se(d, truth_of(m, bars)).values()) < 3.5
    v = d.fitted.value("squareness")
    assert v.low <= 0.0 <= v.high


# ---- 6: servo loops without feed-forward


@pytest.mark.parametrize(("k_v", "play"), [(31.0, (2.2, 5.0)), (58.0, (5.8, 1.7)), (90.0, (3.0, 6.0))])
def test_a_plain_servo_loop_has_no_reversal_spikes(k_v: float, play: tuple[float, float]) -> None:
    """Oracle: first-order loops and clearance, nothing else; four tests, the last at 3000 mm/min."""
    size = {"lag_ms": 1e3 / k_v, "play_a": play[0], "play_b": play[1], "ex": -5.0, "ey": 7.0, "lean": 20.0}
    m, bars = TrueMachine("tool", "XY", size), (*THREE, Bar(0.0, 150.0, "cw", 3000.0))
    d = diagnose(recordings(m, bars, 0.1, int(k_v), 0.5))
    assert {p.candidate.name for p in d.found.beyond.picks} == {"gain_x", "gain_y"}
    assert d.lag_s == pytest.approx(1.0 / k_v, rel=0.05)
    far = off_se(d, truth_of(m, bars))
    assert max(far.values()) < 3.5, far


def test_a_spike_of_a_machine_that_is_late_keeps_its_height() -> None:
    """Oracle: what was made true: a spike of 6 µm that comes after the reversal of the slide, not of the command."""
    m = TrueMachine("tool", "XY", {"lag_ms": 25.0, "play_a": 3.0, "play_b": 3.0, "stick_a": 6.0, "stick_mm": 0.3})
    bars = (*THREE, Bar(0.0, 150.0, "cw", 3000.0))
    d = diagnose(recordings(m, bars, 0.1, 3, 0.5))
    assert {p.candidate.name for p in d.found.beyond.picks} == {"gain_x", "gain_y", "spike_x_f1000", "spike_x_f3000"}
    for name in ("spike_x_plus_f1000", "spike_x_minus_f3000"):
        assert abs(d.fitted.value(name).value - 6.0) < 4.0 * d.fitted.value(name).se + 0.05, name


# ---- between causes that do as well, nothing is decided


def test_a_cause_that_does_as_well_is_named_beside_it() -> None:
    """Oracle: plain servo loops. Two plays do nearly as well: the one other test in that sense has the other feed."""
    m = TrueMachine("tool", "YZ", {"ex": -6.0, "ey": 1.4, "roll": 198.65, "lead_ms": -0.4446, "lag_ms": 14.12})
    bars = (THREE[0], replace(THREE[1], height_um=-63.4), replace(THREE[2], height_um=-46.9))
    d = diagnose(recordings(m, (*bars, Bar(0.0, 150.0, "cw", 3000.0)), 0.365, 60219))
    assert {p.candidate.name for p in d.found.beyond.picks} == {"delay", "gain_y", "gain_z"}
    assert set(d.fitted.value("gain_y").with_) == {"play_y_z", "play_z_y"}
    assert abs(d.fitted.value("gain_y").value - 99.7) < 3.0 * d.fitted.value("gain_y").se
    said = " ".join(render(ball_bar_page(d, figures=False)).split())
    assert "Instead of servo gain error of Y: too short by, for each m/s² and servo gain error of Z: too short" in said
    assert "it may be lateral play of Y along Z and lateral play of Z along Y: the readings do not decide." in said
    assert (
        "or lateral play of Y along Z and lateral play of Z along Y instead" in table_of(d, "Causes")["servo gain Y"][3]
    )
    assert not {"play_y_z", "play_z_y"} & {n.candidate.name for n in d.found.not_found}


# ---- 8: a carriage that turns with its guide


@pytest.mark.parametrize(("kind", "plane"), [("tool", "XY"), ("tool", "XZ"), ("table", "YZ")])
def test_the_bend_of_a_carriage_that_turns_has_the_other_sign(kind: str, plane: str) -> None:
    """Oracle: a rigid arc of 0.3 per km whose carriage follows it; only where it carries the other axis it matters."""
    m = TrueMachine(kind, plane, {"turn_b": 0.3})
    v = diagnose(recordings(m, THREE), "non-linear", dynamic=False).fitted.value(f"yaw_{plane[1].lower()}")
    if m.carrier == 1:
        assert abs(v.value + 0.3) < 3.5 * v.se
        assert float(v.note.split()[0]) == pytest.approx(0.3, abs=0.02)
        assert "if the carriage turns with its guide" in v.note
    else:
        assert abs(v.value - 0.3) < 3.5 * v.se
        assert "turns" not in v.note


# ---- a positioning error that is curved along its axis


@pytest.mark.parametrize("dynamic", [True, False])
@pytest.mark.parametrize(("plane", "curved", "shown"), [("XY", "curve_a", "ZX"), ("XZ", "curve_b", "YZ")])
def test_one_radius_does_not_tell_a_curved_positioning_error_from_a_bend(
    plane: str, curved: str, shown: str, dynamic: bool
) -> None:
    """Oracle: what was made true, 70 µm/m² and nothing else. cos³ and -cos sin² have the same third harmonic."""
    m = TrueMachine("tool", plane, {curved: 70.0})
    own, bent = m.letters["ab".index(curved[-1])], m.letters["ba".index(curved[-1])]
    d = diagnose(recordings(m, THREE), dynamic=dynamic)
    assert abs(d.fitted.value(f"yaw_{bent.lower()}").value - 70.0 / 500.0) < 0.01, "the bend that would make it"
    assert d.fitted.value(f"yaw_{bent.lower()}").with_ == (f"curve_{own.lower()}",)
    for v in (d.fitted.value(f"{name}_{own.lower()}") for name in ("perpendicularity", "centre")):
        assert v.low <= 0.0 <= v.high, v.name
        assert abs(v.value) < 2.0 * v.se, v.name
    page = ball_bar_page(d, figures=False)
    assert f"bend {bent} in plane (or curved positioning error of {own})" in page.lead
    said = " ".join(render(page).split())
    found = re.search(rf"from a curved positioning error of {own} of (\S+) µm/m²", said)
    assert found
    assert float(found[1]) == pytest.approx(70.0, rel=0.05)
    assert f"A circle in plane {shown} shows only the latter again" in said


def test_the_bend_of_a_guide_is_named_with_what_may_be_there_instead() -> None:
    """Oracle: what was made true, a bend of Y; its size stays, and the interval of a perpendicularity of 0 holds 0."""
    d = diagnose(recordings(TrueMachine("tool", "XY", {"bend_b": 0.3}), THREE))
    v, square = d.fitted.value("yaw_y"), d.fitted.value("perpendicularity_x")
    assert abs(v.value - 0.3) < 3.5 * v.se
    assert v.low > 0.25
    assert square.low <= 0.0 <= square.high
    assert "bend Y in plane (or curved positioning error of X)" in ball_bar_page(d, figures=False).lead


def test_a_clean_machine_has_neither() -> None:
    """Oracle: a perfect machine; no sentence on bends, and a perpendicularity as narrow as that of straight guides."""
    d = diagnose(recordings(TrueMachine("tool", "XY"), THREE))
    v = d.fitted.value("perpendicularity_x")
    assert v.low < 0.0 < v.high
    assert v.high - v.low < 1.5
    assert "curved positioning" not in render(ball_bar_page(d, figures=False))


@pytest.mark.parametrize("size", [{"curve_a": 70.0}, {"bend_b": 0.3}, {"curve_a": 70.0, "bend_b": 0.2}])
def test_two_radii_tell_a_curved_positioning_error_from_a_bend(size: dict[str, float]) -> None:
    """Oracle: what was made true. The centre stays, a curve's first harmonic goes with the square of the radius."""
    m, bars = TrueMachine("tool", "XY", {**size, "rise_a": 10.0}), (*THREE, Bar(0.0, 100.0, "ccw", 2000.0 / 3.0))
    d = diagnose(recordings(m, bars))
    assert {p.candidate.name for p in d.found.beyond.picks} == {n.replace("_a", "_x") for n in size if n == "curve_a"}
    far = off_se(d, truth_of(m, bars))
    assert max(far.values()) < 3.5, far
    if "curve_a" in size:
        assert d.fitted.value("curve_x").low > 60.0
    else:
        assert d.fitted.value("yaw_y").low > 0.2


# ---- 9: one measure of what is explained


def test_what_is_explained_and_what_is_not_add_up() -> None:
    """Oracle: the mean squares of the readings; shares and the residual's share come to one."""
    d = diagnose(recordings(TrueMachine("tool", "XY", {"lean": 60.0, "play_a": 3.0}), THREE, 0.5))
    shares = {s.group: s.share for s in d.shares}
    assert shares["residual"] == pytest.approx(1.0 - d.explained)
    assert sum(shares.values()) == pytest.approx(1.0)
    assert all(s >= 0.0 for s in shares.values())
