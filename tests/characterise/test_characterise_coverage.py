"""What the readings of each component cover, and which components `--effects NAME` fits."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.characterise import Characterisation, characterise, read_wanted
from rtec.characterise.coverage import highest_degree
from rtec.errors import ModelError
from rtec.machine import Axis, load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import truth_of
from tests.support import proof

MILL = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "vertical-mill.toml")
X: Axis = MILL.axis("X")
"""Travel 0 to 500 mm."""
TRUE = (
    "scale,component=EXX,axis=X,k=14",
    "straightness,component=EYX,axis=X,c2=3,c3=-1",
    "cyclic_screw,component=EYY,axis=Y,s1=2,c1=0,pitch=90,harmonics=1",
)


def taken(
    instrument: str, seed: int, setup: dict[str, Any], axis: str | None = None, true: tuple[str, ...] = TRUE,
    **more: Any,
) -> Measurement:  # fmt: skip
    made = make_instrument(instrument, setup, axis, None, MILL, f"{instrument} {seed}")
    settings = Settings.model_validate({"noise": {"white_um": 0.3}, "cycles": 2, **more})
    return simulate(truth_of(MILL, effects=true), made, settings, seed, f"{instrument} {seed}")


def laser() -> Measurement:
    return taken("laser_linear", 1, {}, "X", targets={"step_mm": 23.7})


def plates() -> list[Measurement]:
    """In the middle of the travel of X and Y only."""
    places = ([170.0, 180.0, 200.0], [200.0, 200.0, 200.0])
    made = [{"plane": "XY", "origin_mm": p} for p in places]
    return [taken("grid_encoder", 30 + i, s, path={"step_mm": 8.0}) for i, s in enumerate(made)]


def wanted(measured: list[Measurement], effects: str | None) -> Characterisation:
    return characterise(measured, wanted=read_wanted(effects, MILL) if effects else None)


@pytest.mark.parametrize(
    ("places", "degree"),
    [
        (np.linspace(0.0, 500.0, 11), 6),
        (np.linspace(0.0, 500.0, 5), 4),
        (np.linspace(0.0, 500.0, 3), 2),
        (np.linspace(25.0, 475.0, 200), 6),
        (np.linspace(75.0, 425.0, 200), 3),
        (np.linspace(150.0, 350.0, 200), 1),
        (np.concatenate([np.linspace(0.0, 80.0, 50), np.linspace(420.0, 500.0, 50)]), 3),
        (np.array([250.0]), 0),
        (np.zeros(0), 0),
    ],
)
def test_degrees_that_places_determine(places: np.ndarray[Any, Any], degree: int) -> None:
    """Oracle: numpy's polynomial fits. Up to this degree, the largest error that 1 µm at the places can make anywhere
    on the travel stays below 10 µm; in the cases that are cut short by the ends, one degree more exceeds it."""
    found = highest_degree(places, X)
    assert min(found, 6) == degree
    if len(places) > 1:
        on = np.linspace(0.0, 500.0, 1001)
        middle, half = 0.5 * (places[0] + places[-1]), 0.5 * (places[-1] - places[0])
        grown = [np.polynomial.chebyshev.Chebyshev.basis(k)((on - middle) / half) for k in (degree, found + 1)]
        assert np.abs(grown[0]).max() <= 10.0
        if half < 225.0 and len(places) == 200:
            assert np.abs(grown[1]).max() > 10.0


@pytest.mark.parametrize("effects", [None, "scale,polynomial_position"])
def test_a_component_read_on_a_part_of_the_travel(effects: str | None) -> None:
    """Oracle: the truth. The laser covers the axis; the plates, which alone read its straightness, do not."""
    result = wanted([laser(), *plates()], effects)
    said = [w.text for w in result.warnings if w.code == "not_visited"]
    if effects is None:
        assert any("EYX: axis X was measured from 90 to 280 mm only" in t and "extrapolated" in t for t in said)
    assert not any("EXX" in t for t in said)
    degrees = {
        (f.effect.component, k)
        for f in result.model.effects
        for k in getattr(f.effect, "degrees", ())
        if f.effect.effect == "polynomial_position"
    }
    assert all(k <= 2 for c, k in degrees if c != "EXX")


@pytest.mark.parametrize(("axis", "reference", "component"), [("X", "Y", "EC0X"), ("Y", "X", "EC0Y")])
def test_the_reference_axis_of_a_square_is_square(axis: str, reference: str, component: str) -> None:
    """Oracle: the truth, an angle of 25 µrad between the axes; the axis that is no reference carries it."""
    m = taken("squareness", 3, {"reference_axis": reference}, axis, ("squareness,component=EC0X,alpha=25",))
    for effects in (None, "squareness"):
        found = wanted([m], effects).coefficients
        assert [c.component for c in found] == [component]
        assert found[0].value == pytest.approx(25.0 if axis == "X" else -25.0, abs=1.0)


def test_named_effects_are_those_of_the_axis_that_is_read() -> None:
    """Oracle: a tool tip sees eighteen components through arms; three effects were asked for, each along its axis."""
    at = {"X": [60.0, 260.0, 430.0], "Y": [50.0, 190.0, 350.0], "Z": [70.0, 330.0]}
    m = taken("tool_tip", 5, {"alignment": "setup"}, true=TRUE[:2], targets={"step_mm": 61.3, "at_mm": at})
    result = wanted([m], "scale,polynomial_position,backlash")
    assert {c.component for c in result.coefficients} == {"EXX", "EYY", "EZZ"}
    assert len(result.model.effects) <= 9


def test_a_file_that_names_its_component_is_fitted_there() -> None:
    """Oracle: the file; `polynomial_position` usually feeds positioning, here a straightness is read."""
    m = taken("straightness", 7, {"direction": "Y"}, "X", targets={"step_mm": 23.7})
    made = make_instrument("straightness", {"slope": "setup"}, "X", "EYX", MILL, "named")
    named = replace(m, instrument=made, readings=dict(zip(made.columns(), m.readings.values(), strict=True)))
    result = wanted([named], "polynomial_position,scale")
    assert {f.effect.component for f in result.model.effects} == {"EYX"}


def straight(noise_um: float, seed: int) -> Measurement:
    """A slide without any error, read across its axis; numpy's noise, larger than any curve in it."""
    m = taken("straightness", seed, {"direction": "Y"}, "X", (), targets={"step_mm": 23.7})
    noise = np.random.default_rng(seed).normal(0.0, noise_um, len(m))
    return replace(m, readings={"reading_um": noise})


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
def test_a_shape_along_the_axis_that_is_named_is_fitted_to_noise_too(seed: int) -> None:
    """Oracle: the name; the readings are noise, so its numbers are within four standard errors of zero."""
    result = wanted([straight(1.0, seed)], "straightness")
    assert {(f.effect.effect, f.effect.component) for f in result.model.effects} == {("straightness", "EYX")}
    assert all(c.se is not None and abs(c.value) < 4.0 * c.se for c in result.coefficients)


def test_a_temperature_that_is_named_and_explains_nothing_is_refused_with_the_way_to_fit_it() -> None:
    """Oracle: the way on that the message names fits it."""
    m = straight(1.0, 1)
    sensor = MILL.sensor_names[0]
    m = replace(m, channels={**m.channels, sensor: 20.0 + np.linspace(0.0, 4.0, len(m))})
    with pytest.raises(ModelError, match=r"none of the effects named \(mount_expansion\).*component and arguments"):
        wanted([m], "mount_expansion")
    assert len(wanted([m], f"mount_expansion:EYX:sensor={sensor}").model.effects) == 1
