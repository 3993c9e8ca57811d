"""Spindle drift (ISO 230-3) where no axis moves: which link of the column turns.

Oracle: the cross product of the angle and the vector from the link to the probe, in numpy.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.candidates import visible
from rtec.estimation.readings import read
from rtec.machine import Machine, load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof

Floats = NDArray[np.float64]
MACHINE = """[machine]
name = "hmc"
tool_chain = ["X", "Y", "spindle", "tool"]
work_chain = ["Z", "table"]
[axis]
X = { direction = "X", travel_mm = [0, 600], counts_per_mm = 1000, offset_mm = [0, 200, -600] }
Y = { direction = "Y", travel_mm = [0, 450], counts_per_mm = 1000, offset_mm = [0, 300, 250] }
Z = { direction = "Z", travel_mm = [0, 520], counts_per_mm = 1000, offset_mm = [0, 150, 500] }
[link]
spindle.offset_mm = [0, 0, 150]
tool.offset_mm = [0, 0, 200]
table.offset_mm = [0, 100, 0]
"""
SENSORS = ("T_front", "T_rear", "T_head", "T_bed")
POSE_MM = {"x": 300.0, "y": 200.0, "z": 250.0}
PROBES = {"x1": ("X", 0.0), "x2": ("X", -80.0), "y1": ("Y", 0.0), "y2": ("Y", -80.0), "z1": ("Z", 0.0)}
"""Direction, and offset along the arbor, mm."""
FROM_MM = {"EAX": (0.0, 500.0, 600.0), "EAY": (0.0, 0.0, 350.0), "EA0spindle": (0.0, 0.0, 200.0)}
"""From the link that turns to the tool at this pose."""


def machine(folder: Path) -> Machine:
    sensors = "".join(f"[temperature.{s}]\nrange_degc = [0.0, 90.0]\n" for s in SENSORS)
    (folder / "machine.toml").write_text(MACHINE + sensors)
    return load_machine(folder / "machine.toml")


def drift(folder: Path, component: str, seed: int) -> Measurement:
    """Eight hours; the link turns by 8 µrad per kelvin between front and rear."""
    rng, made, time_s = np.random.default_rng(seed), machine(folder), np.arange(0.0, 8 * 3600.0, 160.0)
    warm = {s: 20.0 + sum(a * (1.0 - np.exp(-np.maximum(time_s - t, 0.0) / tau)) for a, t, tau in zip(
        rng.uniform(-4.0, 5.0, 3), rng.uniform(0.0, 20000.0, 3), rng.uniform(900.0, 9000.0, 3), strict=True
    )) for s in SENSORS}  # fmt: skip
    turn = np.zeros((len(time_s), 3))
    turn[:, "ABC".index(component[1])] = 8e-3 * (warm["T_front"] - warm["T_rear"])
    readings: dict[str, Floats] = {}
    for probe, (letter, along) in PROBES.items():
        moved = np.cross(turn, np.add(FROM_MM[component], (0.0, 0.0, along)))
        readings[f"reading_{probe}_um"] = moved[:, "XYZ".index(letter)] + rng.normal(0.0, 0.1, len(time_s))
    setup = {"probe": {p: {"direction": d, "offset_mm": [0.0, 0.0, o]} for p, (d, o) in PROBES.items()}}
    channels = {**{a: np.full(len(time_s), v) for a, v in POSE_MM.items()}, **warm}
    instrument = make_instrument("spindle_drift", setup, None, None, made, "drift")
    return Measurement("drift", instrument, made, np.ones(len(time_s), dtype=np.int64), time_s, channels, readings)


@pytest.mark.parametrize("component", FROM_MM)
@pytest.mark.parametrize("seed", proof.few([1, 2], 1))
def test_the_link_that_turns_is_named(tmp_path: Path, component: str, seed: int) -> None:
    m = drift(tmp_path, component, seed)
    first, *rest = diagnose(Model(m.machine), [m], draws=50).findings
    assert first.accepted
    assert (first.effect.effect, first.effect.component) == ("column_tilt", component)
    assert {"T_front", "T_rear"} == set(first.effect.channels(m.machine))
    assert not any(f.group for f in rest)
    assert abs(next(iter(first.parameters.values())).value) == pytest.approx(8.0, rel=0.05)


def test_only_tilts_of_the_chain_of_the_spindle_that_differ_are_candidates(tmp_path: Path) -> None:
    """A turn about the arbor is a shift of both probes along X, or is not seen; the table is on another chain."""
    m = drift(tmp_path, "EAX", 1)
    tilts = [v.name for v in visible(read([m])) if v.axis is not None]
    assert tilts == ["EAX", "EBX", "EAY", "EBY"]


GANTRY = """[machine]
name = "cmm"
tool_chain = ["Y", "X", "Z", "tool"]
work_chain = ["table"]
[axis]
X = { direction = "X", travel_mm = [0, 700], counts_per_mm = 1000 }
Y = { direction = "Y", travel_mm = [0, 1000], counts_per_mm = 1000 }
Z = { direction = "Z", travel_mm = [0, 500], counts_per_mm = 1000 }
[link]
tool.offset_mm = [0, 0, -80]
table = {}
"""


@pytest.mark.parametrize("seed", [1, 2])
def test_an_axis_that_stands_elsewhere_in_each_file_is_a_candidate(tmp_path: Path, seed: int) -> None:
    """A plate in YZ at two places of X, whose beam twists by 45 µrad/m. Oracle: the angle times the height."""
    (tmp_path / "machine.toml").write_text(GANTRY)
    made, rng = load_machine(tmp_path / "machine.toml"), np.random.default_rng(seed)
    y, z = (v.ravel() for v in np.meshgrid(np.linspace(300.0, 900.0, 6), np.linspace(60.0, 440.0, 5)))
    y, z, run = np.tile(y, 3), np.tile(z, 3), np.repeat([1, 2, 3], 30)
    plates = []
    for at in (150.0, 550.0):
        turned = 45.0 * at * 1e-3
        read_um = {f"reading_{a}_um": 0.4 * rng.standard_normal(90) for a in "xyz"}
        read_um["reading_y_um"] = read_um["reading_y_um"] + 1e-3 * turned * (z - 250.0)
        channels = {"x": np.full(90, at), "y": y, "z": z}
        instrument = make_instrument("tool_tip", {}, None, None, made, "plate")
        plates.append(Measurement(f"at{at:.0f}", instrument, made, run, 20.0 * np.arange(90.0), channels, read_um))
    first = diagnose(Model(made), plates, draws=50).findings[0]
    assert first.accepted
    assert first.effect.effect == "guide_twist"
    assert first.effect.component == "EAX"
    assert abs(first.parameters["k"].value) == pytest.approx(45.0, rel=0.1)


def test_a_chiller_that_switches_is_no_scatter(tmp_path: Path) -> None:
    """Oracle: a square wave of ±3 µm with a period of 21 readings, at a model that was fitted to quiet ones."""
    m = drift(tmp_path, "EAY", 5)
    rng, on = np.random.default_rng(5), 3.0 * np.sign(np.sin(2.0 * np.pi * m.time_s / 3360.0 + 0.1))
    quiet = {name: on + rng.normal(0.0, 0.3, len(m)) for name in m.readings}
    d = diagnose(Model(m.machine, (), noise_um=0.3), [replace(m, readings=quiet)], draws=50)
    assert d.verdict == "undecided"
    assert re.search(r"swings by ±[34]\.?\d* µm with a period of 5\d min", d.sentence), d.sentence


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 1))
def test_the_angle_of_an_axis_that_stands_while_others_move_on_it_is_a_candidate(tmp_path: Path, seed: int) -> None:
    """A laser along Z at two places of X, on a bridge that rolls by 3 µrad/K. Oracle: the angle times the place of X.

    As it was, an expansion of Z and a mount "are missing", and the angle was not even in a table.
    """
    text = GANTRY.replace('"tool"', '"spindle"').replace("tool.", "spindle.")
    (tmp_path / "machine.toml").write_text(text + "[temperature]\nT_bridge = {}\nT_room = {}\n")
    made, rng = load_machine(tmp_path / "machine.toml"), np.random.default_rng(seed)
    run = np.repeat(np.arange(1, 21), 12)
    lasers = []
    for at in (100.0, 600.0):
        time_s = 30.0 * np.arange(240.0) + 1500.0 * run
        bridge = 20.0 + 4.0 * np.sin(time_s / 9000.0 + rng.uniform(0.0, 6.0))
        room = 20.0 + 1.5 * np.sin(time_s / 5000.0 + rng.uniform(0.0, 6.0))
        turned = -3e-3 * (bridge - 20.0) * at
        channels = {"x": np.full(240, at), "y": np.full(240, 500.0), "z": np.tile(np.linspace(20.0, 480.0, 12), 20)}
        channels |= {n: np.round(v, 1) for n, v in (("T_bridge", bridge), ("T_room", room))}
        instrument = make_instrument("laser_linear", {}, "Z", None, made, "laser")
        read_um = {"reading_um": turned + 0.3 * rng.standard_normal(240)}
        lasers.append(Measurement(f"at{at:.0f}", instrument, made, run, time_s, channels, read_um))
    d = diagnose(Model(made), lasers, draws=50)
    first = d.findings[0]
    assert d.verdict in ("missing_effect", "ambiguous")
    assert (first.effect.component, first.effect.channels(made)) == ("EBY", ("T_bridge",))
    assert abs(first.parameters["k"].value) == pytest.approx(3.0, rel=0.05)
