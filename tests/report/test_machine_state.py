"""What a report of a model in one state has. Oracles: `Model.predict`, and the words of the effects."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from rtec.effects import effect_class
from rtec.machine import load_machine
from rtec.machine.links import link_places, room_around, room_mm, tool_at_work
from rtec.model import FittedEffect, Model
from rtec.model.volume import component_errors
from rtec.report.machine_state import SIDES, MachineState, fed_errors, machine_state_sections, state_sentence
from rtec.report.machine_state_figures import HALF_VIEW_RAD, Camera, bars, links, projection
from rtec.studio.parts.figures import bars as on_page
from tests.support.figures import drawn, overlapping

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


def test_names_of_links_lie_apart(state: MachineState) -> None:
    """Oracle: the boxes of the texts as laid out, at both ends of the travels and magnified."""
    machine = state.model.machine
    for end, magnified in product((0, 1), (1.0, 1e4)):
        at = {a.name: a.travel_mm[end] for a in machine.axes}
        errors = component_errors(state.model, {**state.state, **at})
        sides = {side: link_places(machine, errors, at, side) for side in SIDES}
        (ax,) = drawn(links, machine, sides, magnified, Camera()).axes
        assert len(ax.texts) >= 3
        assert not overlapping(list(ax.texts))


def test_errors_of_two_units_have_two_scales() -> None:
    """Oracle: the titles of the axes; each number beside its bar, none over another text."""
    rows = [("EC0Y\nline of travel of Y turned about Z", 60.0, "µrad"), ("EXX\npositioning of X", 13.5, "µm"),
            ("EYY\npositioning of Y", -10.5, "µm")]  # fmt: skip
    figure = drawn(bars, rows)
    assert [ax.get_xlabel() for ax in figure.axes] == ["component error, µrad", "component error, µm"]
    names = [t for ax in figure.axes for t in ax.get_yticklabels()]
    assert not overlapping([t for ax in figure.axes for t in ax.texts] + names)
    units = {"EC0Y": "µrad", "EXX": "µm", "EYY": "µm"}
    shown = on_page({"EC0Y": 60.0, "EXX": 13.5, "EYY": -10.5}, units, "component error", units)
    assert [t["text"] for t in shown["data"]] == [["+60.00 µrad"], ["+13.50 µm", "-10.50 µm"]]
    titles = [shown["layout"][a]["title"]["text"] for a in ("xaxis", "xaxis2")]
    assert [t.rpartition(", ")[2] for t in titles] == ["µrad", "µm"]


@pytest.mark.parametrize("name", ["turning-centre", "vertical-mill"])
def test_the_whole_room_is_seen_at_first(name: str) -> None:
    """With space for titles and numbers at its edges, also in a square. Oracle: the corners in the picture."""
    machine = load_machine(MACHINES / f"{name}.toml")
    poses = np.array(list(product(*(a.travel_mm for a in machine.axes))))
    for room in (room_mm(machine), room_around(tool_at_work(machine, poses))):
        corners = np.array([(*c, 1.0) for c in product(*room)]) @ projection(room, Camera()).T
        seen = np.abs(corners[:, :2] / corners[:, 3:]) / np.tan(HALF_VIEW_RAD)
        assert 0.7 < seen.max() < 0.76
