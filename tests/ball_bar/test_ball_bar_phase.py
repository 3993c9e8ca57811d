"""Servo phase as one angle or one time, tests of different angular speeds; readings of the exact simulation."""

from pathlib import Path

import pytest

from rtec.machine import load_machine
from rtec.metrology.ball_bar.beyond import candidates
from rtec.metrology.ball_bar.circle import circles_of
from rtec.metrology.ball_bar.design import NotLookedFor
from rtec.metrology.ball_bar.diagnosis import BallBarDiagnosis, diagnose, next_tests
from rtec.metrology.ball_bar.phase import Phase
from rtec.report.ball_bar import ball_bar_page
from tests.support.ball_bar_dynamic import Test, run_tests

MILL = Path(__file__).parents[2] / "configs/machines/vertical-mill.toml"
FOUR = (Test(0.0, 150.0, "ccw"), Test(0.0, 150.0, "cw"), Test(50.0, 140.0, "ccw"), Test(50.0, 140.0, "cw"))
THREE = (Test(0.0, 150.0, "ccw"), Test(90.0, 120.0, "cw"), Test(90.0, 120.0, "ccw"))
STATIC = {"ex": 8.0, "ey": -20.0, "dx": 3.0, "dy": 1.5, "Sx": 1.000012, "Sy": 0.999993, "thetax": 25e-6}
DELAY_MS = 0.3
BENT = {"rho_yaw_x": 5000.0}


def mill(dynamic: dict[str, float], psi: float = 0.0, phase: Phase = "auto") -> BallBarDiagnosis:
    """Four tests on a machine that carries X on Y under the table: twist does not show there."""
    given = run_tests(FOUR, STATIC | {"psi": psi}, dynamic, 0.2, seed=5, machine=load_machine(MILL))[0]
    return diagnose(given, phase=phase)


def off_se(d: BallBarDiagnosis, truth: dict[str, float]) -> dict[str, float]:
    return {k: abs(d.fitted.value(k).value - v) / d.fitted.value(k).se for k, v in truth.items()}


def test_a_lag_is_one_time_and_no_clearance_that_changes() -> None:
    """Oracle: what was made true. As one angle the 140 mm circle's larger phase was called clearance by position,
    and both clearances were off by more than a micrometre."""
    d = mill({"delay": DELAY_MS})
    assert (d.phase.taken, d.phase.decided) == ("time", True)
    assert not d.found.beyond.picks
    truth = {"clearance_x": 3.0, "clearance_y": 1.5, "squareness": 25.0, "scale_x": 12.0,
             "phase": DELAY_MS * 1e-3 * 1000.0 / 60.0 / 150.0 * 1e6}  # fmt: skip
    assert max(off_se(d, truth).values()) < 3.5
    note = d.fitted.value("phase").note
    assert float(note.split()[0]) == pytest.approx(DELAY_MS, abs=0.01)
    assert note.count("ms") == 1, "one time in all four tests"


def test_one_angle_stays_one_angle() -> None:
    """Oracle: what was made true, [BB 24]: the same angle at every radius."""
    d = mill({}, psi=35e-6)
    assert (d.phase.taken, d.phase.decided) == ("angle", True)
    assert max(off_se(d, {"clearance_x": 3.0, "squareness": 25.0, "phase": 35.0}).values()) < 3.5


def test_what_was_asked_for_is_taken() -> None:
    """Oracle: the four amplitudes of sin 2ζ of one angle do not fit those of one time."""
    d = mill({"delay": DELAY_MS}, phase="angle")
    assert (d.phase.taken, d.phase.reason) == ("angle", "as asked")
    assert max(off_se(d, {"clearance_x": 3.0}).values()) > 5.0


def test_where_tests_do_not_tell_both_are_told() -> None:
    """Oracle: what was made true. Bent guides and three tests: squareness and twist take the difference up, so the
    report has to say what they would be for one time."""
    given = run_tests(THREE, STATIC | {"psi": 0.0} | BENT, {"delay": DELAY_MS}, 0.2, seed=5)[0]
    d = diagnose(given)
    assert (d.phase.taken, d.phase.decided, d.fitted.model) == ("angle", False, "non-linear")
    shifts = {s.angle.name: s for s in d.changed}
    assert {"squareness", "twist"} <= set(shifts)
    for name, truth in (("squareness", 25.0), ("twist", 0.0)):
        s, v = shifts[name], d.fitted.value(name)
        assert abs(s.time - truth) < 4.0 * s.angle.se
        assert abs(s.angle.value - truth) > 10.0 * s.angle.se, "as one angle alone it would be far off"
        assert v.low <= min(s.angle.value, s.time) < max(s.angle.value, s.time) <= v.high
        assert v.low <= truth <= v.high
    said = " ".join(" ".join(s.text) for s in ball_bar_page(d, figures=False).sections)
    assert "--phase time" in said
    assert "radius 120 mm at 800 mm/min" in said
    assert d.facts()["servo_phase"]["if_one_time"]["squareness"] == pytest.approx(25.0, abs=1.0)
    time = diagnose(given, phase="time")
    assert off_se(time, {"squareness": 25.0, "twist": 0.0})["squareness"] < 4.0


def test_feeds_in_proportion_to_the_radii_leave_nothing_open() -> None:
    """Oracle: at one angular speed a lag is one angle, so nothing is off whichever it is."""
    tests = tuple(Test(t.h, t.r, t.sense, 1000.0 * t.r / 150.0) for t in THREE)
    d = diagnose(run_tests(tests, STATIC | {"psi": 0.0} | BENT, {"delay": DELAY_MS}, 0.2, seed=5)[0])
    assert (d.phase.decided, d.phase.reason, d.changed) == (True, "", ())
    assert max(off_se(d, {"squareness": 25.0, "twist": 0.0, "clearance_x": 3.0}).values()) < 3.5


def test_no_test_is_asked_for_that_is_there() -> None:
    """Oracle: the list of tests that were given; the causes are said to be open, whatever these show of them."""
    slow, fast = FOUR[:2], (Test(0.0, 150.0, "ccw", 3000.0),)
    for tests, there in ((slow, {"ccw 1000", "cw 1000"}), ((*slow, *fast), {"ccw 1000", "cw 1000", "ccw 3000"})):
        circles = circles_of(run_tests(tests, STATIC | {"psi": 0.0}, {}, 0.2, seed=5)[0])
        open_ = [NotLookedFor(c, "said to be") for c in candidates(circles) if not c.missing]
        asked = next_tests(circles, open_, "shared")
        assert asked
        assert not [w for w in asked if w.test.endswith(" again cw")]
        assert any(w.test == "test1 again at 3000 mm/min" for w in asked) == ("ccw 3000" not in there)


def test_spikes_of_feeds_that_go_with_the_radius_are_one() -> None:
    """Oracle: a spike of 7 µm, the same at 1000 and 800 mm/min; 3000 mm/min has one of its own."""
    tests = (*(Test(t.h, t.r, t.sense, 1000.0 * t.r / 150.0) for t in THREE), Test(0.0, 150.0, "cw", 3000.0))
    d = diagnose(run_tests(tests, STATIC | {"psi": 0.0}, {"spike_x": 7.0, "spike_x_way": 0.25}, 0.2, seed=5)[0])
    feeds = {p.candidate.feed_mm_min for p in d.found.beyond.picks}
    assert feeds == {1000.0, 3000.0}
    assert {p.candidate.group for p in d.found.beyond.picks} == {"reversal spike X"}
    for p in d.found.beyond.picks:
        v = d.fitted.value(p.candidate.name.replace("spike_x", "spike_x_plus"))
        assert abs(v.value - 7.0) < 4.0 * v.se
