"""[XT 2] over the workspace: grid set-ups fitted together, the model compiled, the tool tip better; else what to add.

The truth is written as expressions that are no effects of the library, on a bridge machine; the tool-tip error to
compare with is the exact product of the machine's transforms.
"""

import functools
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import Characterisation, characterise, read_wanted
from rtec.characterise.candidates import extended
from rtec.estimation.gram.source import Source
from rtec.estimation.visible import visible_components
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from rtec.model import Model, load_model, save_model
from rtec.sim.campaign.truth import truth_of
from tests.metrology.test_grid_encoder import measured, own
from tests.support.compiled_model import compile_model
from tests.support.exact_chain import exact_tip_errors_um
from tests.support.machines import axis, machine

pytestmark = pytest.mark.xdist_group("grid-workspace")  # what is fitted once is used by all of them

Floats = NDArray[np.float64]
TRAVEL = {"X": 500.0, "Y": 500.0, "Z": 400.0}
RIGID = (
    "scale,component=EXX,axis=X,k=12",
    "scale,component=EYY,axis=Y,k=-9",
    "squareness,component=EC0X,alpha=-20",
    "squareness,component=EA0Y,alpha=15",
    own("EZX", "4 * sin(x / 300) ** 2"),
    own("EAY", "10 * (y / 500) ** 2"),
)
BEYOND = (
    own("EAY", "12 * sin(y / 400) * (1 - cos(z / 250))"),  # cross-talk [XT 4]
    own("ECX", "4 * d_x"),  # direction [XT 5]
    own("EZY", "5 * (abs(v_y) / 100) ** 0.6"),  # velocity [XT Table 9]
)
LOW, HIGH = (-300.0, 0.0), (-300.0, 0.0, 300.0)


def bridge() -> Machine:
    """[XT]'s machine, a metre long."""
    axes = {k: axis(k, travel_mm=[-t, t]) for k, t in TRAVEL.items()}
    return machine("bridge", ["Y", "Z"], ["X"], axes)


@functools.cache
def plates(heights_mm: tuple[float, ...], effects: tuple[str, ...] = (*RIGID, *BEYOND)) -> list[Measurement]:
    """Plates in YZ and XY at three places each for every height, and in XZ at three places."""
    at = [("YZ", [0.0, y, z]) for z in heights_mm for y in (-400.0, 0.0, 400.0)]
    at += [("XY", [x, 0.0, z]) for z in heights_mm for x in (-400.0, 0.0, 400.0)]
    at += [("XZ", [x, 0.0, 0.0]) for x in (-400.0, 0.0, 400.0)]
    feeds = (500.0, 6000.0)
    return [measured(bridge(), p, o, effects, seed=i, step_mm=16.0, feeds_mm_min=feeds) for i, (p, o) in enumerate(at)]


@functools.cache
def whole() -> Characterisation:
    return characterise(plates(HIGH))


@functools.cache
def as_a_rigid_body() -> Characterisation:
    names = "scale,squareness,polynomial_position,backlash"
    return characterise(plates(HIGH), wanted=read_wanted(names, bridge()))


def held_out(n: int = 400) -> tuple[Floats, dict[str, Floats]]:
    """Places all over the workspace, at any direction and speed that was measured; none of them on a plate's path."""
    rng = np.random.default_rng(77)
    channels: dict[str, Floats] = {}
    for name, travel in TRAVEL.items():
        low = name.lower()
        channels[low] = rng.uniform(-0.75 * travel, 0.75 * travel, n)
        channels[f"d_{low}"] = rng.choice([-1.0, 1.0], n)
        channels[f"v_{low}"] = channels[f"d_{low}"] * rng.uniform(500.0 / 60.0, 100.0, n)
    return np.arange(n, dtype=np.float64), channels


def true_tip_um() -> Floats:
    """Exact product, nothing neglected."""
    truth = truth_of(bridge(), effects=(*RIGID, *BEYOND))
    state = truth.state(*held_out())
    components = truth.components(state)
    names = truth.machine.components
    return exact_tip_errors_um(truth.machine, state.positions_mm(), dict(zip(names, components.T, strict=True)))


def left_um(model: Model | None) -> float:
    """What a compiled model leaves of it, rms. Where the whole workspace lies and how it is turned is nobody's error,
    and no plate knows: six numbers are taken out."""
    left = true_tip_um()
    if model is not None:
        left = left - compile_model(model).predict(model.state(*held_out()))[0]
    _, channels = held_out()
    place_m = np.stack([channels[k] for k in "xyz"], axis=1) * 1e-3
    shift = np.tile(np.eye(3), (len(left), 1))
    turn = np.stack([np.cross(axis, place_m).ravel() for axis in np.eye(3)], axis=1)
    design = np.concatenate([shift, turn], axis=1)
    flat = left.ravel() - design @ np.linalg.lstsq(design, left.ravel(), rcond=None)[0]
    return float(np.sqrt(np.mean(flat**2) * 3.0))


def test_components_beyond_the_rigid_body_are_found() -> None:
    """Oracle: the truth. EAY that changes with z is cross-talk of EAY, or, its arm being z, a shift EYY that does."""
    found = {(c.effect.split("(")[0], c.component) for c in whole().coefficients}
    assert found & {("cross_talk", "EAY"), ("cross_talk", "EYY")}
    assert ("guide_lift", "EZY") in found
    lift = {c.name: c.value for c in whole().coefficients if c.effect.startswith("guide_lift(EZY")}
    assert lift["A"] == pytest.approx(5.0, abs=0.1)
    assert lift["q"] == pytest.approx(0.6, abs=0.05)
    turn = next(c.value for c in whole().coefficients if c.effect.startswith("backlash(ECX"))
    assert turn == pytest.approx(8.0, abs=0.3)


def test_the_tool_tip_is_better_for_it(tmp_path: Path) -> None:
    """Oracle: the exact tool-tip error at places of which no reading was taken; the model went through its file and
    the kernel that the loop runs."""
    save_model(whole().model, tmp_path / "model.toml")
    extended = left_um(load_model(tmp_path / "model.toml", bridge()))
    rigid, nothing = left_um(as_a_rigid_body().model), left_um(None)
    assert extended < 0.3
    assert extended < 0.2 * rigid
    assert rigid < 0.6 * nothing


def test_a_file_of_the_model_says_where_it_holds() -> None:
    """Oracle: the ranges that the plates visited; the guard holds the correction outside."""
    ranges = whole().model.valid_range
    assert ranges["z"][0] == pytest.approx(-380.0, abs=40.0)
    assert ranges["v_y"][1] == pytest.approx(100.0, rel=0.2)


@functools.cache
def too_low() -> Characterisation:
    names = "scale,squareness,polynomial_position,backlash,cross_talk,guide_lift"
    return characterise(plates(LOW), wanted=read_wanted(names, bridge()))


def test_where_plates_do_not_cover_it_the_places_to_add_are_said() -> None:
    """Oracle: counted by hand. With plates at two heights Z's upper third is empty over all of Y: three places."""
    found = too_low()
    assert not any("cross_talk" in c.effect and "Z" in c.effect for c in found.coefficients)
    over = next(w for w in found.warnings if "errors of Y were not followed over Z" in w.text)
    assert over.code == "not_covered"
    assert "6 of the 9 thirds" in over.text
    assert "(y -333.3, z 266.7; y 0, z 266.7; y 333.3, z 266.7)" in over.remedy
    covered = [w.text for w in whole().warnings if w.code == "not_covered"]
    assert not any("errors of Y were not followed over Z" in t for t in covered)
    assert any("errors of X were not followed over Y" in t for t in covered)


def asked(heights_mm: tuple[float, ...]) -> set[tuple[str, str]]:
    """Effects beyond the rigid body that are looked for in Y's pitch, and what they go with."""
    sources = [Source.of(m) for m in plates(heights_mm)]
    pitch = next(s for s in visible_components([s.measurement for s in sources]) if s.name == "EAY")
    made = [c.term.effect.model_dump() for c in extended(pitch, sources)]
    return {(e["effect"], e.get("other", "speed")) for e in made}


def test_nothing_is_asked_that_was_not_covered() -> None:
    """Oracle: counted by hand. Two heights leave a third of Z empty; over X there is one column of YZ plates only."""
    assert asked(HIGH) == {("guide_lift", "speed"), ("cross_talk", "Z")}
    assert asked(LOW) == {("guide_lift", "speed")}


def test_a_rigid_machine_is_given_nothing_beyond_it() -> None:
    """Oracle: nothing of the kind is true."""
    found = characterise(plates(HIGH, RIGID))
    beyond = [c for c in found.coefficients if c.effect.split("(")[0] in ("cross_talk", "guide_lift", "servo_lag")]
    assert all(abs(c.value) < 0.3 for c in beyond), beyond
