"""What tells rival effects apart; oracle: least squares on the stacked readings, and odds of simulated readings."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.cli.main import status
from rtec.diagnosis.plan.ideas import extra_tests
from rtec.diagnosis.plan.plan import Extra
from rtec.diagnosis.plan.separating import CLEAR, Pair, Separator, fitted_to, separating, with_gains
from rtec.diagnosis.result import Alike
from rtec.diagnosis.search.prepared import prepare
from rtec.diagnosis.words import NONE_SETTLES
from rtec.estimation.outliers import clean
from rtec.machine import load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.report.plan import separator_sections
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.support.diagnosis_examples import effects, laser, small_machine, write_machine
from tests.support.setups import CONFIGS

Floats = NDArray[np.float64]
SCALE = "scale,component=EXX,axis=X,k=20"
CURVATURE = "guide_curvature,component=EBX,axis=X,k=250"  # 80 mm of arm make 20 µm/m of it
BACKLASH = "backlash,component=EXX,axis=X,B=2"
LAG = "servo_lag,component=EXX,axis=X,tau=0.02"
COLD: dict[str, Any] = {"protocol": "cold", "cycles": 2}
ARM_M, BESIDE_M = 0.08, 0.15
NOISE = 0.5


def nothing(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts), name="base")


def beside(height_mm: float = 150.0, truth: Sequence[str] = (), seed: int = 2, **more: Any) -> Measurement:
    return laser(truth, seed, setup={"beam_offset_mm": [0.0, 0.0, height_mm]}, **{**COLD, **more})


def zeroed(columns: Floats, runs: NDArray[np.int64]) -> Floats:
    """Less the mean of each run, as a laser's zero takes it."""
    out = columns.copy()
    for r in np.unique(runs):
        out[runs == r] -= out[runs == r].mean(axis=0)
    return out


def by_hand(tests: Sequence[tuple[Measurement, float]]) -> float:
    """Half the squared misfit of a curvature that is fitted to a scale's readings, zeros fitted along."""
    said: list[Floats] = []
    theirs: list[Floats] = []
    for m, arm_m in tests:
        x_m = m.channels["x"] * 1e-3
        zeros = (np.arange(len(tests)) == len(said)) * np.ones((len(m), 1))
        said.append(20.0 * x_m / NOISE)
        theirs.append(np.column_stack([arm_m * x_m, zeros]) / NOISE)
    target, design = np.concatenate(said), np.concatenate(theirs)
    left = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
    return 0.5 * float(left @ left)


def test_gain_is_the_misfit_of_the_other() -> None:
    """Oracle: lstsq on both lasers with a zero each; the rival's arms are 80 mm and 230 mm, written down by hand."""
    one, two = laser([], 1, **COLD), beside()
    extras = [Extra("beside", two, 1.0), Extra("the same again", laser([], 3, **COLD), 1.0)]
    found = {s.test.name: s for s in separating(nothing(), effects(SCALE, CURVATURE), [one], extras, noise=NOISE)}
    pair = found["beside"].pairs[0]
    assert pair.before == 0.0
    assert pair.gain == pytest.approx(by_hand([(one, ARM_M), (two, ARM_M + BESIDE_M)]), rel=1e-6)
    assert found["the same again"].pairs[0].gain == pytest.approx(0.0, abs=1e-6)


def test_gain_is_the_log_odds_that_the_test_then_gives() -> None:
    """Oracle: readings simulated with the one true; log likelihood of the right fit over the wrong, mean of 60."""
    base, rivals = nothing(), effects("backlash,component=EXX,axis=X,B=0.4", LAG)
    grid = make_instrument("grid_encoder", {"plane": "XZ", "origin_mm": [100.0, 0.0, 200.0]}, None, None,
                           small_machine(), "test")  # fmt: skip
    settings = Settings.model_validate(
        {"protocol": "cold", "noise": {"white_um": NOISE},
         "path": {"kinds": ["straight"], "travel_mm": 100.0, "step_mm": 10.0, "feeds_mm_min": [200.0, 4000.0]}}
    )  # fmt: skip
    plate = simulate(base, grid, settings, 1, "plate")
    gain = separating(base, rivals, [], [Extra("plate", plate, 1.0)], noise=NOISE)[0].pairs[0].gain
    columns = [_clean_column(f, plate) for f in rivals]
    odds = []
    for seed in range(60):
        made = simulate(Model(base.machine, (rivals[0],), name="true"), grid, settings, seed, "plate")
        readings = _clean_readings(made)
        left = [readings - c * (c @ readings) / (c @ c) for c in columns]
        odds.append(0.5 * float(left[1] @ left[1] - left[0] @ left[0]) / NOISE**2)
    ways = [0.5 * _misfit(columns[i], columns[1 - i]) / NOISE**2 for i in (0, 1)]
    # Told as if no more than a hundred of its readings were independent.
    assert gain == pytest.approx(min(ways) * 100.0 / len(columns[0]), rel=1e-6)
    # Of one true, the odds expected are those of its own way round.
    assert float(np.mean(odds)) == pytest.approx(ways[0], abs=4.0 * float(np.std(odds)) / math.sqrt(60) + 0.05)


def _misfit(said: Floats, other: Floats) -> float:
    left = said - other * (other @ said) / (other @ other)
    return float(left @ left)


def _clean_column(fitted: FittedEffect, m: Measurement) -> Floats:
    state = m.state()
    basis = np.asarray(fitted.effect.basis(m.machine, state, {})[0]) * next(iter(fitted.values.values()))
    arms = m.instrument.arms_of(m.machine, state.positions_mm(), fitted.effect.component)
    return _without_unknowns((arms * basis).ravel(), m)


def _clean_readings(m: Measurement) -> Floats:
    return _without_unknowns(m.matrix().ravel(), m)


def _without_unknowns(values: Floats, m: Measurement) -> Floats:
    unknown = np.stack([n.values.ravel() for n in m.instrument.nuisance(m.state(), m.run)], axis=1)
    return np.asarray(values - unknown @ np.linalg.lstsq(unknown, values, rcond=None)[0])


def test_several_rivals_want_the_test_that_separates_most() -> None:
    """Oracle: what each test moves. A second beam parts curvature from scale; a backlash is told from both by any laser
    that turns round. Of tests that separate as many pairs the quicker comes first."""
    extras = [Extra("beside", beside(), 1.0), Extra("beside, slow to set up", beside(160.0), 3.0),
              Extra("again", laser([], 5, **COLD), 0.1)]  # fmt: skip
    found = separating(nothing(), effects(SCALE, CURVATURE, BACKLASH), [laser([], 1, **COLD)], extras, noise=NOISE)
    assert [s.test.name for s in found] == ["beside", "beside, slow to set up", "again"]
    assert found[0].clear == 3
    assert found[-1].clear == 2  # backlash is told from both by any laser that turns round
    assert {(p.one, p.other) for p in found[-1].pairs if not p.clear} == {("scale(EXX, X)", "guide_curvature(EBX, X)")}


def test_two_sensors_in_a_short_cold_test_stay_rivals() -> None:
    """Oracle: physics. Two sensors of one spindle, cold for ten minutes: neither their noise nor a tenth of a kelvin
    may count as telling them apart, however many readings a circle has; hours of heating and cooling do."""
    machine = load_machine(CONFIGS / "machines" / "turning-centre.toml")
    one, two = (
        effect_from_text(f"spindle_growth,component=EZ0spindle,sensor=T_spindle_{end},k=2.5", machine)
        for end in ("front", "rear")
    )
    found = {s.test.name: s.pairs[0] for s in separating(Model(machine, ()), [one, two], [], noise=0.3)}
    bars = [pair for name, pair in found.items() if name.startswith("ball bar")]
    assert bars
    assert not any(pair.clear for pair in bars)
    assert found["drift probes, spindle on and off over 8 h"].clear


def test_a_cold_machine_does_not_separate_temperatures() -> None:
    """Sensors that differ by some tenths of a kelvin had looked like a square's tilt, at odds of 20 to 1."""
    mill = load_machine(CONFIGS / "machines" / "vertical-mill.toml")
    tilt = effect_from_text("column_tilt,component=EB0Z,front=T_bed,back=T_y_nut,k=30", mill)
    other = effect_from_text("column_tilt,component=EB0Z,front=T_column,back=T_air,k=30", mill)
    square = next(t for t in extra_tests(mill) if t.name.startswith("square between Z and X"))
    wander = np.linspace(0.0, 0.4, len(square.measurement))
    channels = {**square.measurement.channels, "T_bed": 20.0 + wander, "T_column": 20.3 - wander}
    test = replace(square, measurement=replace(square.measurement, channels=channels))
    (found,) = separating(Model(mill, (), name="base"), [tilt, other], [], [test], noise=0.1)
    assert found.least == 0.0


def test_the_current_model_is_fitted_along() -> None:
    """Oracle: with the scale in the model already, nothing of a scale is left for a rival to explain."""
    extras = [Extra("beside", beside(), 1.0)]
    rivals = effects(CURVATURE, "polynomial_position,component=EXX,axis=X,degrees=[1],c1=5")
    without = separating(nothing(), rivals, [laser([], 1, **COLD)], extras, noise=NOISE)[0]
    along = separating(nothing(SCALE), rivals, [laser([], 1, **COLD)], extras, noise=NOISE)[0]
    assert without.clear == 1
    assert along.pairs[0].gain == pytest.approx(0.0, abs=1e-6)


def test_a_time_constant_is_fitted_along() -> None:
    """Oracle: a rival with a free time constant follows more; what is left of the other cannot be more than without."""
    text = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=8"
    lagged = "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,k=8,tau=600"
    warm = laser([], 4, cycles=2)
    one = separating(nothing(), effects(text, lagged), [], [Extra("warm", warm, 1.0)], noise=NOISE)[0].pairs[0]
    fixed = FittedEffect(effects(lagged)[0].effect, {"k": 8.0}, {"tau": 600.0})
    columns = [_laser_column(f, warm) for f in (effects(text)[0], fixed)]
    assert one.gain < 0.5 * _misfit(columns[0], columns[1]) / NOISE**2


def _laser_column(fitted: FittedEffect, m: Measurement) -> Floats:
    state = m.state()
    value = np.asarray(fitted.effect.basis(m.machine, state, fitted.theta)[0]) * fitted.values["k"]
    return zeroed(value[:, None], m.run)[:, 0]


def test_a_confusion_gets_its_test_and_its_odds() -> None:
    """Oracle: an angular laser, or a beam elsewhere, tells a turning slide from a scale; the same beam does not."""
    made = laser([SCALE], 1, **COLD)
    prepared = prepare(nothing(), clean([made]))
    mine, other = (fitted_to(prepared.whitener, prepared.base, f.effect, f.theta) for f in effects(SCALE, CURVATURE))
    assert mine.values["k"] == pytest.approx(20.0, abs=3.0)
    assert other.values["k"] == pytest.approx(250.0, abs=40.0)
    alike = Alike("guide_curvature", "EBX", "the same shape", "two heights")
    extras = [Extra("beside", beside(), 1.0), Extra("again", laser([], 3, **COLD), 0.2)]
    (told,) = with_gains([(alike, other)], mine, nothing(), prepared.whitener, extras)
    assert told.gain is not None
    assert told.gain > CLEAR
    assert told.separating_test.startswith("two heights; here: beside (60 min), expected odds")
    (blind,) = with_gains([(alike, other)], mine, nothing(), prepared.whitener, extras[1:])
    assert blind.gain == pytest.approx(0.0, abs=0.05)
    assert blind.separating_test == f"two heights; {NONE_SETTLES}"
    days = [replace(extras[0], hours=30.0), extras[1]]
    (long,) = with_gains([(replace(alike, separating_test=""), other)], mine, nothing(), prepared.whitener, days)
    assert long.separating_test == f"{NONE_SETTLES} within a day"
    assert with_gains([], mine, nothing(), prepared.whitener) == ()


def test_command_ranks_tests_for_rivals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the feed parts a lag from a backlash [effects.md A2], so a laser at one feed never comes first."""
    import tomli_w

    machine, test = write_machine(tmp_path), tmp_path / "laser-x.toml"
    table = {"measurement": {"instrument": "laser_linear", "axis": "X"}, "setup": {}, **COLD}
    test.write_text(tomli_w.dumps(table), encoding="utf-8")
    words = ["plan", str(machine), str(test), "--rivals", "scale:EXX,guide_curvature:EBX"]
    assert status([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["separators"]
    assert found[0]["pairs"][0]["clear"] is True
    by_name = {s["test"]: s["pairs"][0]["gain"] for s in found}
    assert by_name["laser along X, both ways, cold"] == pytest.approx(0.0, abs=1e-6)
    assert by_name["angular laser along X, about Y, cold"] > CLEAR
    hours = [s["hours"] for s in found if s["pairs"][0]["clear"]]
    assert hours == sorted(hours)
    assert status([*words, "--full"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Tests that separate the rivals, best first" in shown
    assert found[0]["test"] in shown


@pytest.mark.parametrize(("gain", "rows"), [(0.0, 0), (math.log(5.0), 1)])
def test_where_no_test_tells_the_rivals_apart_that_is_said(gain: float, rows: int) -> None:
    """Oracle: odds of 1 and of 5 to 1, both below the 20 that tell apart; even odds name no test."""
    test = Extra("laser along X", laser([SCALE], 1), 1.0)
    (section,) = separator_sections([Separator(test, (Pair("a", "b", gain, 0.0),))])
    assert "No single test on this machine separates any two of them" in section.text[1]
    assert (len(section.table.rows) if section.table else 0) == rows
