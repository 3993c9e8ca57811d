"""A free choice that takes what every machine has, and its axes' own sensors. Oracle: what made the readings."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import rtec
from rtec.characterise import characterise, fitted_model
from rtec.effects.effect_list import read_wanted
from rtec.errors import ModelError
from rtec.metrology.measurement import Measurement
from tests.support import proof
from tests.support.sim_example import CONFIGS, MACHINE_FILE

Floats = NDArray[np.float64]

SCREW_S = 900.0
"""The screw follows its nut within this time."""


def late(time_s: Floats, degc: Floats) -> Floats:
    out = degc.copy()
    for i in range(1, len(out)):
        out[i] = degc[i] + (out[i - 1] - degc[i]) * np.exp(-(time_s[i] - time_s[i - 1]) / SCREW_S)
    return out


def warming(seed: int) -> Measurement:
    """Eight runs of X while it warms; the headstock's sensor rises as the screw does, by three tenths of it."""
    noise = {"white_um": 0.3, "drift_um": 0.3, "drift_tau_s": 1800.0}
    m = rtec.simulate(
        MACHINE_FILE, "laser_linear", axis="X", seed=seed, changes={"cycles": 1, "noise": noise}
    ).measurement
    rng, x = np.random.default_rng(seed), m.channels["x"]
    warmer = late(m.time_s, m.channels["T_x_nut"]) - 20.0
    headstock = np.round(20.0 + 0.3 * warmer + rng.normal(0.0, 0.03, len(m)), 1)
    readings = m.readings["reading_um"] + 9e-3 * x * (warmer + 1.0) + m.channels["d_x"]
    kept = np.isin(m.run, np.unique(m.run)[:8])
    return replace(
        m,
        time_s=m.time_s[kept],
        run=m.run[kept],
        channels={name: v[kept] for name, v in {**m.channels, "T_headstock": headstock}.items()},
        readings={"reading_um": readings[kept]},
    )


def test_a_screw_grows_with_its_own_nut() -> None:
    """Of ten such days six had followed the headstock, at 30 µm/m/K: no material grows so much."""
    followed = set()
    for seed in range(1, 1 + proof.of(10, 3)):
        model = characterise([warming(seed)]).model
        followed |= {f.label for f in model.effects if f.effect.effect == "axis_expansion"}
    assert followed == {"axis_expansion(EXX, X, T_x_nut)"}


MADE = (
    "scale,component=EXX,axis=X,k=12",
    "scale,component=EYY,axis=Y,k=-8",
    "squareness,component=EC0Y,alpha=25",
    "backlash,component=EXX,axis=X,B=1.5",
    "backlash,component=EYY,axis=Y,B=2",
)


def circle(direction: str, seed: int, effects: Sequence[str] = MADE) -> Measurement:
    """A bar's circle on a mill, of known length."""
    setup = {
        "plane": "XY",
        "centre_mm": [250.0, 200.0, 200.0],
        "radius_mm": 150.0,
        "direction": direction,
        "feed_mm_min": 1000.0,
    }
    noise = {"white_um": 0.15, "drift_um": 0.1, "drift_tau_s": 300.0}
    mill = CONFIGS / "machines" / "vertical-mill.toml"
    made = rtec.simulate(mill, "ball_bar", setup=setup, effects=effects, changes={"noise": noise}, seed=seed)
    return replace(made.measurement, name=direction)


@pytest.mark.parametrize("seed", proof.few([10, 20], 1))
def test_a_bar_s_circles_show_scales_and_squareness_and_no_guide_that_bends(seed: int) -> None:
    """A yaw of X that grows, with another squareness, makes the same readings: 9 µrad had been read in place of 25."""
    model = characterise([circle("ccw", seed), circle("cw", seed + 1)]).model
    found = {f.label: next(iter(f.values.values())) for f in model.effects}
    assert found["squareness(EC0Y)"] == pytest.approx(25.0, abs=0.5)
    assert found["scale(EXX, X)"] == pytest.approx(12.0, abs=1.5)
    assert found["scale(EYY, Y)"] == pytest.approx(-8.0, abs=1.5)
    assert "polynomial_position(ECX, X)" not in found


def every(m: Measurement, step: int) -> Measurement:
    """Some of the readings."""
    return replace(
        m,
        time_s=m.time_s[::step],
        run=m.run[::step],
        channels={name: v[::step] for name, v in m.channels.items()},
        readings={name: v[::step] for name, v in m.readings.items()},
    )


SQUARE = (
    "squareness,component=EC0Y,alpha=22",
    "squareness,component=EB0Z,alpha=-15",
    "polynomial_position,component=EYX,axis=X,degrees=[2],c2=2",
    "column_tilt,component=EB0Z,front=T_column,back=T_air,k=3",
)


def square(axis: str, seed: int) -> Measurement:
    """Both arms of a square between X and another axis, through a warm-up."""
    noise = {"white_um": 0.3, "drift_um": 0.5, "drift_tau_s": 1800.0}
    mill, setup = CONFIGS / "machines" / "vertical-mill.toml", {"reference_axis": "X"}
    made = rtec.simulate(
        mill, "squareness", axis=axis, setup=setup, effects=SQUARE, changes={"noise": noise}, seed=seed
    ).measurement
    return replace(every(made, 7), name=axis)


@pytest.mark.parametrize("seed", proof.few([20, 10], 1))
def test_a_square_shows_squareness_and_no_angle_behind_an_arm(seed: int) -> None:
    """A pitch of Y and a growth of the spindle had taken the place of one of them."""
    model = characterise([square("Y", seed), square("Z", seed + 1)]).model
    found = {f.label: next(iter(f.values.values())) for f in model.effects}
    assert found["squareness(EC0Y)"] == pytest.approx(22.0, abs=0.5)
    assert found["squareness(EB0Z)"] == pytest.approx(-15.0, abs=1.0)


def short_circle(
    direction: str, seed: int, effects: Sequence[str], radius_mm: float, noise_um: float, drift_um: float
) -> Measurement:
    """Two turns with a reading every three degrees, as a bar that is read by hand or by its own program gives."""
    setup = {
        "plane": "XY",
        "centre_mm": [250.0, 200.0, 200.0],
        "radius_mm": radius_mm,
        "direction": direction,
        "feed_mm_min": 1000.0,
    }
    changes = {"cycles": 2, "noise": {"white_um": noise_um, "drift_um": drift_um, "drift_tau_s": 300.0}}
    mill = CONFIGS / "machines" / "vertical-mill.toml"
    m = rtec.simulate(mill, "ball_bar", setup=setup, effects=effects, changes=changes, seed=seed).measurement
    return replace(every(m, 12), name=direction)


PLAIN = (
    "scale,component=EXX,axis=X,k=12",
    "scale,component=EYY,axis=Y,k=-6",
    "squareness,component=EC0Y,alpha=12",
    "backlash,component=EXX,axis=X,B=2",
    "backlash,component=EYY,axis=Y,B=3",
)
USUAL = {"scale(EXX, X)", "scale(EYY, Y)", "squareness(EC0Y)", "backlash(EXX, X)", "backlash(EYY, Y)"}


@pytest.mark.parametrize("seed", proof.few([13, 3, 23, 33], 2))
def test_a_bar_that_grows_by_a_tenth_of_a_micrometre_shows_no_yaw_and_no_play_across(seed: int) -> None:
    """The second circle is larger than the first; a yaw and a play across had made up for that, without squareness."""
    bars = [short_circle(d, seed + i, PLAIN, 100.0, 0.15, 0.1) for i, d in enumerate(("ccw", "cw"))]
    found = characterise(bars)
    model = found.model
    assert {f.label for f in model.effects} == USUAL
    terms = [step["terms"] for step in found.facts()["steps"]]
    assert terms == sorted(terms), "else the figure of the choice goes back to nothing"
    values = {f.label: next(iter(f.values.values())) for f in model.effects}
    assert values["squareness(EC0Y)"] == pytest.approx(12.0, abs=0.7)
    assert values["backlash(EXX, X)"] == pytest.approx(2.0, abs=0.2)
    assert values["backlash(EYY, Y)"] == pytest.approx(3.0, abs=0.2)


SMALL = ("scale,component=EXX,axis=X,k=6", "squareness,component=EC0Y,alpha=5")


def test_a_bar_too_noisy_for_a_choice_is_told_what_to_fit_without_one() -> None:
    """Oracle: what the message names can be fitted; the bar's growth by 0.6 µm is 6 µm/m of its length."""
    bars = [short_circle(d, 13 + i, SMALL, 100.0, 0.3, 0.6) for i, d in enumerate(("ccw", "cw"))]
    with pytest.raises(ModelError) as refused:
        characterise(bars)
    typed = re.search(r"add --effects (\S+), fitted without a choice", str(refused.value))
    assert typed is not None
    fitted = {f.label: f for f in characterise(bars, wanted=read_wanted(typed[1], bars[0].machine)).model.effects}
    assert set(fitted) == USUAL
    assert fitted["squareness(EC0Y)"].values["alpha"] == pytest.approx(5.0, abs=2.0)
    assert fitted["scale(EXX, X)"].values["k"] == pytest.approx(6.0, abs=6.0)


def test_two_turns_each_way_are_too_few_for_a_choice_and_show_what_every_machine_has() -> None:
    """Ten minutes between the turns. A choice had found two backlashes, and left three times the noise."""
    bars = []
    for i, direction in enumerate(("ccw", "cw")):
        m = short_circle(direction, 3 + i, PLAIN, 100.0, 0.3, 0.3)
        bars.append(replace(m, time_s=m.time_s + 600.0 * (m.run - m.run[0])))
    found = characterise(bars)
    assert {f.label for f in found.model.effects} == USUAL
    assert {f.label for f in fitted_model(bars).effects} == USUAL
    assert found.warnings[0].code == "too_few_runs"
    assert found.warnings[0].text.startswith("4 circles are too few")
