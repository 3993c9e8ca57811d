"""One question has one number: every command judges the same model on the same files alike. Oracle: each other."""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.characterise import Characterisation, characterise, read_wanted
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.plan.plan import SURE, separation
from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import load_machine
from rtec.metrology.ball_bar.diagnosis import diagnose as diagnose_circles
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model, load_model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.characterise.joint_proof import Truth, bar, laser, plate
from tests.support.both import both
from tests.support.frame_thermal import COMPONENT, recorded

CONFIGS = Path(__file__).parents[2] / "configs"


def shipped(name: str, instrument: str, axis: str, *truth: str, **setup: str) -> list[Measurement]:
    """A shipped machine with errors, one reading made wrong."""
    machine = load_machine(CONFIGS / "machines" / f"{name}.toml")
    model = Model(machine, tuple(effect_from_text(t, machine) for t in truth), name="truth")
    made = make_instrument(instrument, setup, axis, None, machine, "test")
    settings = Settings.model_validate({"cycles": 2, "noise": {"white_um": 0.3, "drift_um": 0.5}})
    m = simulate(model, made, settings, 3, "laser")
    m.readings[made.columns()[0]][17] += 60.0
    return [m]


def mill(*names: str, drift: bool = True) -> list[Measurement]:
    """Exact transforms of the shipped mill, measured by a laser, a ball bar and a grid plate, as far as named."""
    truth = Truth(
        load_machine(CONFIGS / "machines" / "vertical-mill.toml"), {"scale:EXX": 12.0, "squareness:EC0Y": 20.0}
    )
    made = {
        "laser": lambda: laser(truth, "X", 4, drift),
        "bar": lambda: bar(truth, "XY", "ccw", 4, drift),
        "back": lambda: bar(truth, "XY", "cw", 4, drift),
        "plate": lambda: plate(truth, (150.0, 140.0), 4, drift),
    }
    return [made[n]() for n in names]


def tutorial() -> list[Measurement]:
    """The measurements of the tutorial, both with hidden effects."""
    machine = load_machine(CONFIGS / "machines" / "turning-centre.toml")
    truth = load_model(CONFIGS / "tutorial" / "hidden.toml", machine)
    settings = Settings.model_validate(tomllib.loads((CONFIGS / "tutorial" / "day.toml").read_text(encoding="utf-8")))
    setups: tuple[dict[str, object], ...] = ({}, {"beam_offset_mm": [0.0, 0.0, 150.0]})
    lasers = [make_instrument("laser_linear", s, "X", None, machine, "test") for s in setups]
    return [simulate(truth, i, settings, seed, f"laser-{seed}") for seed, i in enumerate(lasers, 1)]


def both_kinds() -> list[Measurement]:
    """Micrometres and microradians: numbers are multiples of the noise."""
    truth = ("scale,component=EXX,axis=X,k=12", "polynomial_position,component=EBX,axis=X,degrees=[1],c1=9")
    (one,) = shipped("turning-centre", "laser_linear", "X", *truth)
    (other,) = shipped("turning-centre", "laser_angular", "X", *truth, about="B")
    return [one, replace(other, name="autocollimator")]


EXAMPLES: dict[str, tuple[Callable[[], list[Measurement]], str]] = {
    "turning centre": (
        lambda: shipped("turning-centre", "laser_linear", "X", "scale,component=EXX,axis=X,k=12"),
        "scale,backlash",
    ),
    "vertical mill": (
        lambda: shipped("vertical-mill", "laser_linear", "Y", "backlash,component=EYY,axis=Y,B=4"),
        "backlash",
    ),
    "tutorial": (tutorial, "scale,axis_expansion:EXX:sensor=T_x_nut"),
    "ball bar": (lambda: mill("bar", "back"), "squareness"),
    "laser, ball bar and plate": (lambda: mill("laser", "bar", "plate"), "scale:EXX,squareness:EC0Y"),
    "laser and autocollimator": (both_kinds, "scale:EXX,polynomial_position:EBX:degrees=[1]"),
    "gantry": (lambda: [recorded("gross_outliers")], f"mount_expansion:{COMPONENT}:sensor=T_frame"),
}


IMPROVED = ("turning centre", "vertical mill", "gantry")
"""Where `improve` is run, too: it takes the longest."""


def judged(facts: dict[str, Any]) -> tuple[object, ...]:
    keys = ("unit", "rms_residual", "noise_floor", "noise_floor_from", "rms_held_out", "readings", "wrong_readings")
    return tuple(facts[k] for k in keys)


def fit_of(measured: Sequence[Measurement], effects: str) -> Characterisation:
    return characterise(measured, wanted=read_wanted(effects, measured[0].machine))


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_command_gives_the_same_numbers(name: str) -> None:
    make, effects = EXAMPLES[name]
    measured = make()
    result = fit_of(measured, effects)
    model, fit = result.model, result.facts()
    one = judged(fit["judged"])
    assert fit["rms_inside"] == fit["judged"]["rms_residual"]
    assert fit["rms_held_out"] == fit["judged"]["rms_held_out"]
    compared = compare(model, measured)
    assert judged(compared.facts()["together"]) == one
    d, better = both(model, measured, draws=20) if name in IMPROVED else (diagnose(model, measured, draws=20), None)
    assert judged(d.facts()["judged"]) == one
    assert (d.rms_residual, d.noise_floor) == (fit["rms_inside"], compared.judged.noise_floor)
    again = add(model, [], measured)
    assert again.before.as_given == pytest.approx(fit["rms_inside"], rel=1e-12)
    after = judged(compare(again.model, measured).facts()["together"])
    assert (again.after.inside, again.floor, again.after.held_out) == (after[1], after[2], after[4])
    if better is None:
        return
    last = [*([better.refit] if better.refit else []), *better.steps]
    if last:
        end = judged(compare(better.model, measured).facts()["together"])
        assert (last[-1].after.inside, last[-1].floor, last[-1].after.held_out) == (end[1], end[2], end[4])


def test_the_wrong_reading_is_named_by_all() -> None:
    make, effects = EXAMPLES["turning centre"]
    measured = make()
    result = fit_of(measured, effects)
    assert [o.row for o in result.outliers] == [17]
    for notes in (compare(result.model, measured).notes, diagnose(result.model, measured, draws=20).notes):
        assert any("row 18 of run 1" in n for n in notes)


def test_a_plan_promises_what_a_fit_of_its_readings_finds() -> None:
    """Oracle: each other; standard errors of a plan are those of white noise, these readings have no other."""
    measured = mill("laser", "bar", "plate", drift=False)
    result = fit_of(measured, "scale:EXX,squareness:EC0Y")
    noise = dict(zip([m.name for m in measured], (0.3, 0.4, 0.5), strict=True))
    promised = separation([f.effect for f in result.model.effects], measured, noise).detectable
    for c in result.coefficients:
        assert c.se is not None
        assert 0.5 < c.se / (promised[c.effect] / SURE) < 2.0


def test_a_ball_bar_diagnosis_agrees_with_the_fit_of_its_tests() -> None:
    """Oracle: each other, and the truth, 12 µm/m along X and none along Y."""
    measured = []
    for m in mill("bar", "back"):
        centre = np.array([np.mean(a.travel_mm) for a in m.machine.axes])
        angle = np.unwrap(np.arctan2(m.channels["y"] - centre[1], m.channels["x"] - centre[0]))
        measured.append(replace(m, channels={**m.channels, "angle_deg": np.degrees(angle)}))
    found = diagnose_circles(measured).facts()["parameters"]
    fitted = {c.component: c for c in fit_of(measured, "squareness:EC0Y,scale:EXX,scale:EYY").coefficients}
    for name, component, true in (("scale_x", "EXX", 12.0), ("scale_y", "EYY", 0.0)):
        one, other = found[name], fitted[component]
        assert other.se is not None
        assert abs(one["value"] - other.value) < 3.0 * np.hypot(one["se"], other.se)
        assert abs(other.value - true) < 3.0 * other.se
