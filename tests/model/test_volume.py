"""Errors over the travels. Oracles: `Model.predict` place by place; a scale error worked out by hand."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

import rtec
from rtec.effects import effect_class
from rtec.machine import Machine
from rtec.model import FittedEffect, Model
from rtec.model.volume import component_errors, cylinder, tip_errors

MACHINES = Path(__file__).parents[2] / "configs" / "machines"
MACHINE, MILL = MACHINES / "turning-centre.toml", MACHINES / "vertical-mill.toml"


@pytest.fixture(scope="module", params=[MACHINE, MILL], ids=["lathe", "mill"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return rtec.load_machine(request.param)


def _scaled(machine: Machine, axis: str, k: float) -> Model:
    effect = effect_class("scale", "test").model_validate(
        {"effect": "scale", "component": f"E{axis}{axis}", "axis": axis}
    )
    return Model(machine, (FittedEffect(effect, {"k": k}),))


def test_a_scale_error_makes_a_turned_cylinder_larger() -> None:
    """Oracle by hand: 50 µm/m make 5 µm more at 100 mm than at 0; the diameter has twice the error at its radius."""
    model = _scaled(rtec.load_machine(MACHINE), "X", 50.0)
    at_radius, at_zero = (float(model.predict(X=x, Z=0.0)[0]) for x in (100.0, 0.0))
    assert at_radius - at_zero == pytest.approx(50.0 * 0.1)
    found = cylinder(model, {"X": 0.0, "Z": 200.0})
    assert found.turned
    assert found.larger_um == pytest.approx(2.0 * at_radius)
    assert found.form_um == pytest.approx(0.0, abs=1e-9)


def test_a_scale_error_makes_a_milled_cylinder_oval() -> None:
    """Oracle by hand: e_x = k x is k r cos² outwards, in the mean k r / 2: the diameter grows by k r, oval by k r."""
    machine = rtec.load_machine(MILL)
    axis = next(a.name for a in machine.axes if a.direction == "X")
    model = _scaled(machine, axis, 50.0)
    found = cylinder(model, {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes})
    assert not found.turned
    assert found.larger_um == pytest.approx(50.0 * 0.1)
    assert found.form_um == pytest.approx(50.0 * 0.1, rel=1e-3)


def test_places_over_the_travels_are_those_that_are_commanded(machine: Machine) -> None:
    """Also along axes that carry the work. Oracle: the commanded positions themselves, along each axis' direction."""
    over = tip_errors(_scaled(machine, machine.axes[0].name, 50.0), {}, places=3)
    grid = np.array(list(product(*(np.linspace(*a.travel_mm, 3) for a in machine.axes))))
    along = np.array([np.eye(3)["XYZ".index(a.direction)] for a in machine.axes])
    assert np.allclose(over.place_mm - over.place_mm[0], (grid - grid[0]) @ along)


def test_without_effects_the_part_is_as_drawn(machine: Machine) -> None:
    """A perfect machine makes a perfect part."""
    model = replace(_scaled(machine, machine.axes[0].name, 1.0), effects=())
    found = cylinder(model, {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes})
    assert (found.larger_um, found.form_um) == (0.0, 0.0)


def test_errors_over_the_travels_are_those_of_each_place(machine: Machine) -> None:
    """And the component errors of a state, through the chain, are its error at the tool tip."""
    model = _scaled(machine, machine.axes[0].name, 50.0)
    over = tip_errors(model, {}, places=3)
    assert over.place_mm.shape == over.error_um.shape == (3 ** len(machine.axes), 3)
    first = {a.name: a.travel_mm[0] for a in machine.axes}
    assert np.array_equal(over.error_um[0], model.predict(first))
    assert np.allclose(over.size_um, np.sqrt((over.error_um**2).sum(axis=1)))
    parts = np.array(list(component_errors(model, first).values()))
    pose = np.array([first[a.name] for a in machine.axes])
    assert np.allclose(machine.chain.tip_error_um(pose, parts), over.error_um[0])
