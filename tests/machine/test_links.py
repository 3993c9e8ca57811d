"""Places of links with their errors, and component errors in words. Oracles: the chain's lever arms; ISO 230-1."""

from pathlib import Path

import numpy as np
import pytest

import rtec
from rtec.machine import Machine
from rtec.machine.links import component_words, link_places

MACHINES = Path(__file__).parents[2] / "configs" / "machines"
LATHE, MILL = MACHINES / "turning-centre.toml", MACHINES / "vertical-mill.toml"


@pytest.fixture(scope="module", params=[LATHE, MILL], ids=["lathe", "mill"])
def machine(request: pytest.FixtureRequest) -> Machine:
    return rtec.load_machine(request.param)


def test_each_error_moves_the_tip_as_the_chain_says(machine: Machine) -> None:
    """Tool side minus work side at the cutting point is J times the component, for errors of axes and of tool links."""
    pose = {a.name: a.travel_mm[0] + 0.7 * (a.travel_mm[1] - a.travel_mm[0]) for a in machine.axes}
    arms = machine.chain.jacobian(np.array([pose[a.name] for a in machine.axes]))
    for k, component in enumerate(machine.components):
        if not any(component.endswith(n) for n in machine.tool_chain):
            continue
        moved = link_places(machine, {component: 10.0}, pose, "tool").moved_um[-1]
        assert np.allclose(moved, 10.0 * arms[:, k], atol=1e-9), component


def test_a_component_error_has_the_words_of_the_standard() -> None:
    """Oracle: ISO 230-1's names of the errors of a linear axis, and of the relations of axes."""
    mill = rtec.load_machine(MILL)
    words = {
        "EXX": "positioning of X",
        "EYX": "straightness of X along Y",
        "EAX": "roll of X",
        "EBX": "tilt of X about Y",
        "ECZ": "roll of Z",
        "EC0Y": "line of travel of Y turned about Z",
    }
    assert {c: component_words(c, mill) for c in words} == words
    link = next(n for n in mill.tool_chain if n not in mill.axis_names)
    assert component_words(f"EZ0{link}", mill) == f"shift of {link} along Z"
    assert component_words(f"EA0{link}", mill) == f"tilt of {link} about X"


def test_no_two_component_errors_have_the_same_words(machine: Machine) -> None:
    """Of a whole machine."""
    words = [component_words(c, machine) for c in machine.components]
    assert len(set(words)) == len(words)
