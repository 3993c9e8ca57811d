"""`rtec plan` with ball bars and grids; oracle: [BB §3], the ball bar's own design, and tables written down by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

import rtec
from rtec.cli.main import status
from rtec.diagnosis.plan.ideas import extra_tests
from rtec.diagnosis.plan.parameters import ball_bar_set, centres
from rtec.diagnosis.plan.plan import route, separation
from rtec.diagnosis.plan.tests import dry
from rtec.effects import Effect
from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.metrology.ball_bar.circle import circles_of
from rtec.metrology.ball_bar.design import design_of
from rtec.metrology.measurement import Measurement
from rtec.sim.campaign.settings import DrivenPath, Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.support.ball_bar_examples import bar, gantry
from tests.support.machines import axis, turning_centre

MILL = Path(__file__).parents[2] / "configs" / "machines" / "vertical-mill.toml"
ONE = (0.0, 150.0, "ccw")
TWO = (30.0, 146.969, "cw")
THREE = (30.0, 146.969, "ccw")
FLAT_CW = (0.0, 150.0, "cw")
SQUARE, PHASE, TWIST = "squareness X-Y", "servo phase mismatch X-Y", "twist of the guide of Y (roll)"
PHI_X, PHI_Y, PSI_Y = "perpendicularity of X to Z", "perpendicularity of Y to Z", "constant roll of Y"
CENTRE_X, CENTRE_Y = "centre offset X", "centre offset Y"


def circle(test: tuple[float, float, str], machine: Machine | None = None, **setup: Any) -> Measurement:
    height, radius, direction = test
    setup = {"height_uncertainty_mm": 0.0, **setup}  # [BB] takes heights as exact
    instrument = bar(machine or gantry(), height_mm=height, radius_mm=radius, direction=direction, **setup)
    name = f"{direction} {height:g} {setup.get('feed_mm_min', '')}".strip()
    return dry(machine or gantry(), instrument, Settings(path=DrivenPath(step_deg=1.0)), name)


def circles(*tests: tuple[float, float, str]) -> list[Measurement]:
    return [circle(t) for t in tests]


def sets(found: Any) -> list[set[str]]:
    return [set(c) for c in found.confounded]


# ---- [BB §3]: what two and three tests separate


def test_one_test_does_not_separate_the_linear_model_two_do() -> None:
    """Oracle: [BB §3]: h = 0 CCW alone does not; with h != 0 CW it does, all ten."""
    one, two = circles(ONE), circles(ONE, TWO)
    found = separation(ball_bar_set(one, bent=False), one)
    assert (found.rank, len(found.parameters)) == (7, 10)
    assert set(found.never) == {PHI_X, PHI_Y}
    assert sets(found) == [{SQUARE, PHASE}]
    assert separation(ball_bar_set(two, bent=False), two).complete


def test_the_non_linear_model_needs_the_third() -> None:
    """Oracle: [BB §3]: two tests leave squareness, phase and twist together; h != 0 CCW as well separates all 15."""
    two, three = circles(ONE, TWO), circles(ONE, TWO, THREE)
    found = separation(ball_bar_set(two, bent=True), two)
    assert (found.rank, len(found.parameters)) == (14, 15)
    assert sets(found) == [{SQUARE, PHASE, TWIST}]
    assert separation(ball_bar_set(three, bent=True), three).complete


def test_the_height_of_the_ball_is_one_more_unknown() -> None:
    """Oracle: the inverse of the whole normal matrix, heights as columns with what is known of them before."""
    given = [circle(t, height_uncertainty_mm=0.05) for t in (ONE, TWO, THREE)]
    found = separation(ball_bar_set(given, bent=True), given)
    design = design_of(circles_of(given), bent=True)
    normal = design.columns.T @ design.columns / 0.5**2 + np.diag([c.prior**-2.0 for c in design.labels])
    errors = np.sqrt(np.diag(np.linalg.inv(normal)))
    for cause, error in zip(design.labels, errors, strict=True):
        if cause.title in found.detectable:
            assert found.detectable[cause.title] == pytest.approx(3.0 * error, rel=1e-3), cause.title
    bend = "bend of X along Z (pitch)"
    assert found.detectable[bend] > 9.0, "50 µm of height hide it"
    exact = circles(ONE, TWO, THREE)
    assert separation(ball_bar_set(exact, bent=True), exact).detectable[bend] < 0.5


@pytest.mark.parametrize("bent", [False, True])
@pytest.mark.parametrize("tests", [(ONE,), (ONE, TWO), (ONE, TWO, THREE), (TWO, THREE)], ids=len)
def test_rank_and_condition_are_those_of_the_ball_bars_own_design(tests: Any, bent: bool) -> None:
    """Oracle: singular values of the whole stacked design, which `rtec ballbar` fits."""
    given = circles(*tests)
    found = separation(ball_bar_set(given, bent=bent), given)
    design = design_of(circles_of(given), bent=bent)
    wanted, title = design.rank, {c.name: c.title for c in design.labels}
    assert found.rank == wanted.rank
    assert found.condition == pytest.approx(wanted.condition, rel=1e-6)
    assert sets(found) == [{title[n] for n in c} for c in wanted.confounded]


def test_phi_x_and_psi_y_never_separate() -> None:
    """Oracle: [BB §3]. Not with any height, sense, radius and feed; only a square with Z, whose line the roll turns
    along and the perpendicularity does not, tells them apart."""
    given = circles(ONE, TWO, THREE, FLAT_CW)
    asked = ball_bar_set(given, bent=True, rolls=True)
    more = [*given, circle((70.0, 132.0, "cw")), circle((-60.0, 100.0, "ccw"), feed_mm_min=4000.0)]
    more += [e.measurement for e in extra_tests(gantry(), given) if e.name.startswith("ball bar XY")]
    for tests in (given, more):
        found = separation(asked, tests)
        assert sets(found) == [{PHI_X, PSI_Y}]
        assert found.rank == 15
    square = next(e for e in extra_tests(gantry()) if e.name == "square between X and Z, cold")
    assert separation(asked, [*given, square.measurement]).complete


@pytest.mark.parametrize(
    ("height", "apart"),
    [(30.0, False), (0.0, True)],
    ids=["the same height again", "a second height"],
)
def test_centre_offset_and_perpendicularity_need_a_second_height(height: float, apart: bool) -> None:
    """Oracle: rows of [BB Table 1]: λ ex cos ζ and λ h φx cos ζ differ by the height alone."""
    given = [circle((30.0, 146.969, "ccw")), circle((height, 146.969, "cw"))]
    found = separation(ball_bar_set(given, bent=False), given)
    together = [{CENTRE_X, PHI_X}, {CENTRE_Y, PHI_Y}]
    assert (sets(found) == []) == apart
    assert apart or [s for s in sets(found) if s in together] == together


@pytest.mark.parametrize(("direction", "apart"), [("ccw", False), ("cw", True)])
def test_squareness_and_phase_need_both_senses(direction: str, apart: bool) -> None:
    """Oracle: rows of [BB Table 1]: r θ sin 2ζ / 2 and -s r ψ sin 2ζ / 2 differ by the sense alone."""
    given = [circle(ONE), circle((30.0, 146.969, direction))]
    found = separation(ball_bar_set(given, bent=False), given)
    assert ({SQUARE, PHASE} in sets(found)) != apart


def test_a_ball_of_its_own_for_each_test_loses_perpendicularity() -> None:
    """Oracle: the two rows are one where each test has a centre of its own."""
    given = circles(ONE, TWO)
    found = separation(ball_bar_set(given, bent=False, stays="each"), given, stays="each")
    assert found.rank == 10
    assert len(found.parameters) == 12
    assert {"centre offset X, cw 30", PHI_X} in sets(found)


# ---- the cheapest test to add


def test_the_cheapest_test_to_add_is_named() -> None:
    """Oracle: [BB §3]: to h = 0 CCW one circle of the other sense at a height is enough; to that pair the third."""
    one, two = circles(ONE), circles(ONE, TWO)
    linear = route(ball_bar_set(one, bent=False), one, extra_tests(gantry(), one))
    assert [p.test.name for p in linear] == ["ball bar XY, cw, height 30 mm"]
    assert linear[0].after.complete
    bent = route(ball_bar_set(two, bent=True), two, extra_tests(gantry(), two))
    assert [p.test.name for p in bent] == ["ball bar XY, ccw, height 30 mm"]
    assert bent[0].after.complete
    both = route(ball_bar_set(one, bent=True), one, extra_tests(gantry(), one))
    assert len(both) == 2
    assert all(p.test.name.startswith("ball bar XY, ") for p in both)
    assert both[-1].after.complete


def test_ideas_are_what_the_machine_can_take() -> None:
    """Oracle: the turning centre has X and Z; its X travels 200 mm, so a bar of 50 mm goes and one of 100 does not."""
    extras = {e.name: e for e in extra_tests(turning_centre())}
    bars = [n for n in extras if n.startswith("ball bar")]
    assert bars
    assert all(n.startswith("ball bar XZ") for n in bars)
    assert extras[bars[0]].measurement.instrument.setup.model_dump()["radius_mm"] == 50.0
    plates = [n for n in extras if n.startswith("grid encoder")]
    assert plates
    assert all("XZ" in n for n in plates)
    assert all(e.hours > 0.0 for e in extras.values())


def test_a_part_of_a_circle_is_run_back_over_the_same_part() -> None:
    """Oracle: by hand: 220° from -20° ccw are -20° … 200°, so cw they begin at 200°; beyond is the table. The feed goes
    with the radius, so that the angular speed is the same."""
    part = [circle(ONE, start_deg=-20.0, arc_deg=220.0, feed_mm_min=1000.0)]
    extras = {e.name: e.measurement.instrument.setup.model_dump() for e in extra_tests(gantry(), part)}
    for name, start, feed in (
        ("ball bar XY, cw, height 0 mm", 200.0, 1000.0),
        ("ball bar XY, ccw, height 30 mm", -20.0, 979.8),
        ("ball bar XY, cw, height 30 mm", 200.0, 979.8),
    ):
        assert (extras[name]["start_deg"], extras[name]["arc_deg"], extras[name]["feed_mm_min"]) == (start, 220.0, feed)
    whole = {e.name: e.measurement.instrument.setup.model_dump() for e in extra_tests(gantry(), circles(ONE))}
    assert whole["ball bar XY, cw, height 30 mm"]["start_deg"] == 0.0


# ---- the same with effects, and with other instruments beside


def effects_of(machine: Machine, *texts: str) -> list[Effect]:
    return [effect_from_text(t, machine).effect for t in texts]


EFFECTS = (
    "scale,component=EXX,axis=X,k=1",
    "scale,component=EYY,axis=Y,k=1",
    "backlash,component=EXX,axis=X,B=1",
    "backlash,component=EYY,axis=Y,B=1",
    "squareness,component=EC0X,alpha=1",
    "squareness,component=EB0X,alpha=1",
    "squareness,component=EA0Y,alpha=1",
    "servo_lag,component=EXX,axis=X,tau=1",
)


@pytest.mark.parametrize("centres_mm", [[(0.0, 0.0), (0.0, 0.0)], [(0.0, 0.0), (50.0, -20.0)]])
def test_no_two_ideas_have_one_name(centres_mm: list[tuple[float, float]]) -> None:
    """Circles in both senses about one ball lead to one idea each; about two balls the name says about which."""
    given = [circle(t, centre_mm=[*c, 0.0]) for t, c in zip((ONE, FLAT_CW), centres_mm, strict=True)]
    names = [e.name for e in extra_tests(gantry(), given) if e.name.startswith("ball bar XY")]
    assert len(set(names)) == len(names)
    assert any("centre 50, -20, 0 mm" in n for n in names) == (len(set(centres_mm)) > 1)


@pytest.mark.parametrize("cycles", [1, 5, 20])
def test_cycles_count_as_often_as_they_are_run(tmp_path: Path, cycles: int) -> None:
    """Oracle: the mean of n circles is sqrt(n) times as good as one."""
    one = _smallest(tmp_path, 1)
    for name, size in _smallest(tmp_path, cycles).items():
        assert size * cycles**0.5 == pytest.approx(one[name], rel=0.02), name


def _smallest(folder: Path, cycles: int) -> dict[str, float]:
    tests = []
    for direction in ("ccw", "cw"):
        content = {
            "cycles": cycles,
            "measurement": {"instrument": "ball_bar"},
            "setup": {
                "plane": "XY",
                "centre_mm": [250.0, 200.0, 200.0],
                "radius_mm": 150.0,
                "direction": direction,
                "feed_mm_min": 1000.0,
            },
        }
        tests.append(folder / f"{direction}-{cycles}.toml")
        tests[-1].write_text(tomli_w.dumps(content))
    answer = rtec.plan(MILL, tests, suggest=False).to_dict()
    return {n: v for n, v in answer["smallest_detectable"].items() if v is not None}


def test_effects_are_separated_as_the_parameters_are() -> None:
    """Oracle: the ten of [BB], written as effects: eight, and two centre offsets that the two tests share."""
    one, two = circles(ONE), circles(ONE, TWO)
    asked = effects_of(gantry(), *EFFECTS)
    first = separation([*centres(one), *asked], one)
    assert (first.rank, len(first.parameters)) == (7, 10)
    assert {"squareness(EC0X)", "servo_lag(EXX, X)"} in sets(first)
    assert separation([*centres(two), *asked], two).complete


def test_without_the_shared_ball_the_offset_is_a_nuisance_of_each_test() -> None:
    """Oracle: with a centre taken out of each test nothing of a perpendicularity is left, whatever the heights."""
    two = circles(ONE, TWO)
    found = separation(effects_of(gantry(), *EFFECTS), two)
    assert set(found.never) == {"squareness(EB0X)", "squareness(EA0Y)"}


def test_a_grid_separates_what_one_circle_does_not() -> None:
    """Oracle: a lag shows in the reading along the motion, a squareness in the one across it."""
    from rtec.metrology.instruments.registry import make_instrument

    m, one = gantry(), circles(ONE)
    grid = make_instrument("grid_encoder", {"plane": "XY", "origin_mm": [0.0, 0.0, 0.0]}, None, None, m, "test")
    plate = dry(m, grid, Settings(path=DrivenPath(step_mm=4.0, feeds_mm_min=(500.0, 2000.0))), "plate")
    asked = effects_of(m, EFFECTS[4], EFFECTS[7], EFFECTS[2])
    assert sets(separation([*centres(one), *asked], one)) == [{"squareness(EC0X)", "servo_lag(EXX, X)"}]
    assert separation(asked, [plate]).complete


# ---- the command


def write(folder: Path, machine: bool = True, **tests: tuple[float, float, str]) -> list[str]:
    table = {
        "machine": {"name": "gantry", "tool_chain": ["Y", "X", "Z"], "work_chain": []},
        "axis": {k: axis(k, travel_mm=[-400.0, 400.0]) for k in "XYZ"},
    }
    if machine:
        (folder / "gantry.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    out = [str(folder / "gantry.toml")]
    for name, (height, radius, direction) in tests.items():
        setup = {
            "plane": "XY", "centre_mm": [0.0, 0.0, 0.0], "radius_mm": radius, "height_mm": height,
            "direction": direction, "feed_mm_min": 1000.0,
        }  # fmt: skip
        content = {"path": {"step_deg": 1.0}, "measurement": {"instrument": "ball_bar"}, "setup": setup}
        (folder / f"{name}.toml").write_text(tomli_w.dumps(content), encoding="utf-8")
        out.append(str(folder / f"{name}.toml"))
    return out


def test_command_for_ball_bars(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: as above; and the test that it names, written as a file and added, leaves nothing open."""
    words = write(tmp_path, one=ONE)
    assert status(["plan", *words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["rank"], found["count"]) == (7, 10)
    assert found["route"][0]["test"] == "ball bar XY, cw, height 30 mm"
    assert found["route"][0]["rank"] == 10
    assert found["hopeless"] == [[PHI_X, PSI_Y]]
    words = write(tmp_path, one=ONE, two=(30.0, 146.969, "cw"))
    assert status(["plan", *words]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "These tests separate all 10 parameters." in shown
    assert f"No circle in this plane separates these: {PHI_X}, {PSI_Y}" in shown


def test_command_ranks_what_tells_the_confounded_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: circles of the other sense about the same ball tell a phase from a squareness; others do not."""
    assert status(["plan", *write(tmp_path, one=ONE), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    gains = {s["test"]: s["pairs"][0]["gain"] for s in found["separators"] if s["test"].startswith("ball bar XY")}
    assert all(np.isclose(g, 0.0, atol=1e-3) for t, g in gains.items() if ", ccw" in t and "feed" not in t), gains
    assert all(g > 10.0 for t, g in gains.items() if ", cw" in t)


def test_command_refuses_what_does_not_go_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write(tmp_path, one=ONE)
    assert status(["plan", *words, "--ball-bar", "linear", "--effects", "scale"]) == 2
    assert "leave --effects" in capsys.readouterr().err


def test_ball_bars_of_two_planes_are_planned_apart() -> None:
    from rtec.diagnosis.plan.answer import Question, answer

    m = gantry()
    tests = [circle(ONE), dry(m, bar(m, plane="YZ"), Settings(path=DrivenPath(step_deg=1.0)), "yz")]
    with pytest.raises(ConfigError, match="plan each plane by itself"):
        answer(m, tests, Question(ball_bar="linear"))
