"""Fixed links that give the same readings. Oracle: the part that was moved, and the chain of the machine."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.candidates import library, on_part, same_components, same_effects, visible
from rtec.estimation.readings import read
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.support.machines import axis

SENSORS = ("T_wheel", "T_oil", "T_air")


def grinder(*work: str, sensors: Sequence[str] = SENSORS) -> Machine:
    """A wheel head that X carries, and a table Z with what is on it."""
    return machine_from(
        {
            "machine": {"name": "grinder", "tool_chain": ["X", "wheel"], "work_chain": ["Z", *work]},
            "axis": {"X": axis("X", pitch_mm=6.0), "Z": axis("Z", pitch_mm=10.0)},
            "link": {"wheel": {"offset_mm": [-150.0, 0.0, 40.0]}},
            "temperature": {s: {} for s in sensors},
        },
        "grinder",
    )


def drift(machine: Machine, truth: str, seed: int) -> Measurement:
    """Eight hours of a probe along X at rest, while the wheel's bearing and the oil warm up apart."""
    probe: dict[str, Any] = {"probe": {"p1": {"direction": "X", "offset_mm": [0.0, 0.0, 0.0]}}}
    instrument = make_instrument("spindle_drift", probe, None, None, machine, "test")
    bodies = {"T_wheel": {"on_degc": 12.0, "tau_s": 2000.0}, "T_oil": {"on_degc": 6.0, "tau_s": 9000.0}}
    heat = {"body": {k: v for k, v in bodies.items() if k in machine.sensor_names}}
    settings = Settings.model_validate({"thermal": heat, "noise": {"white_um": 0.3}})
    return simulate(
        Model(machine, (effect_from_text(truth, machine),), name="truth"), instrument, settings, seed, "drift"
    )


def laser_along_x(machine: Machine) -> Measurement:
    """A laser along X on a cold day."""
    instrument = make_instrument("laser_linear", {"beam_offset_mm": [0.0, 60.0, 90.0]}, "X", None, machine, "test")
    return simulate(Model(machine, (), name="truth"), instrument, Settings(), 5, "laser")


def first(machine: Machine, truth: str, seed: int, *known: str) -> Diagnosis:
    model = Model(machine, tuple(effect_from_text(k, machine) for k in known), name="known")
    return diagnose(model, [drift(machine, truth, seed)], draws=50)


TRUTH = "mount_expansion,component=EX0wheel,sensor={},k=-2.4"


def test_it_is_said_that_the_readings_do_not_show_which_part_moved() -> None:
    """Oracle: with everything at rest, wheel head, work and both slides move the probe alike."""
    d = first(grinder("work", sensors=("T_oil", "T_air")), TRUTH.format("T_oil"), 1)
    found = d.findings[0]
    assert found.accepted
    assert found.effect.component == "EX0work"
    assert found.same_components == ("EX0wheel", "EXZ", "EXX")
    part = "EX0wheel and 2 more are the same as EX0work in these readings: they do not show which part moved"
    assert part in d.sentence
    assert d.facts()["candidates"][0]["same_components"] == ["EX0wheel", "EXZ", "EXX"]


def test_the_part_that_the_sensor_is_on_stands_for_all() -> None:
    """Oracle: the part that moved has the sensor; the number has the sign of that part."""
    d = first(grinder("work"), TRUTH.format("T_wheel"), 2)
    found = d.findings[0]
    assert found.effect.component == "EX0wheel"
    assert found.parameters["k"].value == pytest.approx(-2.4, abs=0.1)
    assert found.same_components[0] == "EX0work"


def test_the_part_that_the_model_has_effects_of_stands_for_all() -> None:
    """Oracle: the effects of the model."""
    machine = grinder("work", sensors=("T_oil", "T_air"))
    readings = read([drift(machine, TRUTH.format("T_oil"), 3)])
    known = effect_from_text("mount_expansion,component=EX0wheel,sensor=T_air,k=1", machine)
    assert {"EX0work", "EX0wheel"} & {c.name for c in visible(readings)} == {"EX0work"}
    assert {"EX0work", "EX0wheel"} & {c.name for c in visible(readings, [known])} == {"EX0wheel"}


@pytest.mark.parametrize("sensors", [SENSORS, ("T_oil", "T_air")])
def test_the_search_has_as_many_candidates_whichever_part_stands_for_all(sensors: Sequence[str]) -> None:
    """Oracle: the search for the first link of the work side, effect by effect."""
    readings = read([drift(grinder("work", sensors=sensors), TRUTH.format("T_oil"), 4)])
    by_name, plain = library(readings, None, ())[0], library(readings)[0]
    assert [c.effect.effect for c in by_name] == [c.effect.effect for c in plain]
    for one, other in zip(by_name, plain, strict=True):
        mine, its = (np.abs(readings.arms(c.effect.component)) for c in (one, other))
        assert mine == pytest.approx(its)


def test_what_moves_the_readings_differently_is_not_the_same() -> None:
    """Oracle: the lever arms. A turn about another place moves the probe differently while the slide travels."""
    machine = grinder("work")
    readings = read([laser_along_x(machine)])
    assert "EX0work" in same_components(readings, "EX0wheel")
    for name in same_components(readings, "EB0work"):
        mine, its = readings.arms("EB0work"), readings.arms(name)
        assert abs(mine @ its) == pytest.approx(np.linalg.norm(mine) * np.linalg.norm(its))
    scale = effect_from_text("axis_expansion,component=EXX,axis=X,sensor=T_oil,k=9", machine).effect
    assert not same_effects(readings, scale)


@pytest.mark.parametrize(
    ("part", "sensor", "fits"),
    [
        ("wheel", "T_wheel", True),
        ("column", "T_col_front", True),
        ("X", "T_xnut", True),
        ("X", "T_x", True),
        ("X", "T_xylophone", False),
        ("work", "T_wheel", False),
        ("tool", "T_to", False),
    ],
)
def test_a_sensor_is_on_the_part_of_its_name(part: str, sensor: str, fits: bool) -> None:
    assert on_part(part, [sensor]) is fits
