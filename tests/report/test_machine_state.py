"""What a report of a model in one state has. Oracles: `Model.predict`, and the words of the effects."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from rtec.effects import effect_class
from rtec.machine import load_machine
from rtec.machine.links import room_around, room_mm, tool_at_work
from rtec.model import FittedEffect, Model
from rtec.report.machine_state import MachineState, fed_errors, machine_state_sections, state_sentence
from rtec.report.machine_state_figures import HALF_VIEW_RAD, Camera, projection

MACHINES = Path(__file__).parents[2] / "configs" / "machines"


@pytest.fixture(scope="module", params=["turning-centre", "vertical-mill"])
def state(request: pytest.FixtureRequest) -> MachineState:
    machine = load_machine(MACHINES / f"{request.param}.toml")
    scale = effect_class("scale", "test").model_validate({"effect": "scale", "component": "EXX", "axis": "X"})
    play = effect_class("backlash", "test").model_validate({"effect": "backlash", "component": "EXX", "axis": "X"})
    effects = FittedEffect(scale, {"k": 40.0}), FittedEffect(play, {"B": 4.0})
    at = {a.name: a.travel_mm[1] for a in machine.axes} | {f"dir_{a.name}": -1.0 for a in machine.axes}
    return MachineState(Model(machine, effects), at)


def test_an_effect_that_is_off_adds_nothing(state: MachineState) -> None:
    """Oracle: the model without it; the table names it, and says that it is off."""
    off = replace(state, off=frozenset({1}))
    alone = replace(state.model, effects=state.model.effects[:1])
    assert off.switched == alone
    assert state_sentence(off) == state_sentence(replace(state, model=alone))
    assert state_sentence(off) != state_sentence(state)
    assert fed_errors(off) == {"EXX": pytest.approx(float(alone.predict(dict(state.state))[0]))}
    table = next(s.table for s in machine_state_sections(off, figures=False) if s.heading == "Effects of the model")
    assert table is not None
    assert [row[1] for row in table.rows] == ["on", "off"]


def test_the_report_has_the_state_the_errors_and_three_figures(state: MachineState) -> None:
    """Oracle: the state that went in; PNG."""
    sections = machine_state_sections(state)
    cells = [tuple(row) for s in sections if s.table is not None for row in s.table.rows]
    for axis in state.model.machine.axes:
        assert (f"{axis.name}, mm", f"{axis.travel_mm[1]:.1f}") in cells
    assert ("X moved last", "−") in cells
    assert ("EXX", "positioning of X") in [row[:2] for row in cells]
    figures = [s.figure for s in sections if s.figure is not None]
    assert [f.name for f in figures] == ["components.png", "machine.png", "volume.png"]
    assert all(f.png.startswith(b"\x89PNG") for f in figures)


def test_without_an_effect_nothing_is_fed(state: MachineState) -> None:
    """All effects are off: no component error, and still a machine to draw."""
    off = replace(state, off=frozenset({0, 1}))
    sections = machine_state_sections(off)
    assert fed_errors(off) == {}
    assert [s.figure.name for s in sections if s.figure is not None] == ["machine.png", "volume.png"]


@pytest.mark.parametrize("name", ["turning-centre", "vertical-mill"])
def test_the_whole_room_is_seen_at_first(name: str) -> None:
    """With space for titles and numbers at its edges, also in a square. Oracle: the corners in the picture."""
    machine = load_machine(MACHINES / f"{name}.toml")
    poses = np.array(list(product(*(a.travel_mm for a in machine.axes))))
    for room in (room_mm(machine), room_around(tool_at_work(machine, poses))):
        corners = np.array([(*c, 1.0) for c in product(*room)]) @ projection(room, Camera()).T
        seen = np.abs(corners[:, :2] / corners[:, 3:]) / np.tan(HALF_VIEW_RAD)
        assert seen.max() < 0.75
