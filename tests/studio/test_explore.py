"""What the page Explore draws and computes. Oracles: the chain's exact lever arms; a scale error worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

import rtec
from rtec.effects import effect_class
from rtec.machine import Machine
from rtec.model import FittedEffect, Model
from rtec.studio.geometry import cylinder, nodes
from tests.studio.studio_rig import MACHINE, ROOT

MILL = ROOT / "configs" / "machines" / "vertical-mill.toml"


@pytest.fixture(scope="module", params=[MACHINE, MILL], ids=["lathe", "mill"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return rtec.load_machine(request.param)


def test_each_error_moves_the_tip_as_the_chain_says(machine: Machine) -> None:
    """Tool side minus work side at the cutting point is J times the component, for errors of axes and of tool links."""
    pose = {a.name: a.travel_mm[0] + 0.7 * (a.travel_mm[1] - a.travel_mm[0]) for a in machine.axes}
    arms = machine.chain.jacobian(np.array([pose[a.name] for a in machine.axes]))
    for k, component in enumerate(machine.components):
        if not any(component.endswith(n) for n in machine.tool_chain):
            continue
        moved = nodes(machine, {component: 10.0}, pose, "tool").moved_um[-1]
        assert np.allclose(moved, 10.0 * arms[:, k], atol=1e-9), component


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


def test_without_effects_the_part_is_as_drawn(machine: Machine) -> None:
    """A perfect machine makes a perfect part."""
    model = replace(_scaled(machine, machine.axes[0].name, 1.0), effects=())
    found = cylinder(model, {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes})
    assert (found.larger_um, found.form_um) == (0.0, 0.0)
