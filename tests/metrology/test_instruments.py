"""Instruments: signs by injection through the true product of transforms, and laws that every one obeys."""

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.effects import State
from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.metrology.files.load import load_measurement, save_measurement
from rtec.metrology.instruments.ball_bar import BallBar, circle_channels
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.laser import LaserDiagonal
from rtec.metrology.instruments.registry import INSTRUMENTS, make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.instrument_examples import EXAMPLES, Example, frames
from tests.support.laws import law_for
from tests.support.machines import bridge, turning_centre, vertical_mill

Floats = NDArray[np.float64]
every_example = law_for(EXAMPLES)
SIZE = 20.0  # µm and µrad; second order: (20 µrad)² times a metre 0.4 nm, (20 µm)² over a radius 3 nm


def poses(machine: Machine, n: int, seed: int = 5) -> Floats:
    low, high = np.array([a.travel_mm for a in machine.axes]).T
    return np.random.default_rng(seed).uniform(low, high, (n, len(low)))


def state(machine: Machine, n: int = 12) -> State:
    pose = poses(machine, n)
    channels = {a.channel: pose[:, i] for i, a in enumerate(machine.axes)}
    channels |= {s: 20.0 + np.linspace(0.0, 5.0 + i, n) for i, s in enumerate(machine.sensor_names)}
    return State(machine, np.arange(float(n)), channels)


def test_every_instrument_has_an_example() -> None:
    """Else the laws below say nothing of it."""
    assert {e.name for e in EXAMPLES} == set(INSTRUMENTS)
    assert all(kind.name == name for name, kind in INSTRUMENTS.items())


@every_example
def test_each_component_alone_is_read_as_geometry_says(example: Example) -> None:
    """Oracle: `instrument_examples`, true rotations multiplied out and the instrument placed in space."""
    machine, instrument = example.machine(), example.make()
    pose = poses(machine, 2)
    arms = instrument.arms(machine, pose)
    for i, where in enumerate(pose):
        for k, component in enumerate(machine.components):
            seen = example.read(frames(machine, where, {component: SIZE}))
            np.testing.assert_allclose(arms[:, i, k] * SIZE, seen, atol=4e-3, err_msg=component)


@every_example
def test_all_components_at_once_add_up(example: Example) -> None:
    """Oracle: as above; what is left is second order, pairs of 20 µrad at a few metres."""
    machine, instrument = example.machine(), example.make()
    rng, where = np.random.default_rng(1), poses(machine, 1)
    errors = dict(zip(machine.components, rng.uniform(-SIZE, SIZE, len(machine.components)), strict=True))
    predicted = instrument.arms(machine, where)[:, 0] @ np.array(list(errors.values()))
    np.testing.assert_allclose(predicted, example.read(frames(machine, where[0], errors)), atol=0.05)


def test_a_work_side_axis_is_read_as_tool_relative_to_work() -> None:
    """The bridge's table goes the other way itself; a laser on X still reads +1 µm per µm of EXX, and its Abbe arms
    are those of `ε × p` at the beam: oracle worked out by hand."""
    machine = bridge()
    laser = make_instrument("laser_linear", {"beam_offset_mm": [0.0, 100.0, 50.0]}, "X", None, machine, "test")
    pose = {"X": 300.0, "Y": -200.0, "Z": 400.0}
    where = np.array([[pose[a] for a in machine.axis_names]])
    arms = dict(zip(machine.components, laser.arms(machine, where)[0, 0], strict=True))
    assert arms["EXX"] == 1.0
    # Point at y = -200 + 100, z = 400 + 50 in the table's frame: e_x = -EC y + EB z.
    assert arms["ECX"] == pytest.approx(-(-200.0 + 100.0) * 1e-3)
    assert arms["EBX"] == pytest.approx((400.0 + 50.0) * 1e-3)


def test_a_level_on_the_table_alone_reads_the_opposite() -> None:
    """A table that rolls by +EAX relative to itself is a tool that rolls by -EAX; oracle: ADR 3."""
    machine = bridge()
    one = {on: make_instrument("level", {"about": "A", "on": on}, "X", None, machine, "t") for on in ("work", "both")}
    pose = poses(machine, 1)
    assert one["work"].arms_of(machine, pose, "EAX") == -1.0
    assert one["both"].arms_of(machine, pose, "EAX") == 1.0
    assert one["work"].arms_of(machine, pose, "EAZ") == 0.0


def test_tilt_from_two_radial_probes() -> None:
    """Oracle: [G 3.5], tilt = (radial1 - radial2) / distance, for a spindle that turns by EB0spindle alone."""
    machine = turning_centre()
    probes = {"radial1": {"direction": "X"}, "radial2": {"direction": "X", "offset_mm": [0.0, 0.0, -60.0]}}
    drift = make_instrument("spindle_drift", {"probe": probes}, None, None, machine, "test")
    radial = drift.arms_of(machine, poses(machine, 4), "EB0spindle") * 30.0
    np.testing.assert_allclose((radial[0] - radial[1]) / drift.setup.distance_mm * 1e3, -30.0)  # type: ignore[attr-defined]


@every_example
def test_batch_is_singles_and_components_are_columns(example: Example) -> None:
    """Oracle: the same, one pose at a time; `Instrument.arms_of` as the base class has it."""
    machine, instrument = example.machine(), example.make()
    pose = poses(machine, 40)
    arms = instrument.arms(machine, pose)
    assert arms.shape == (len(instrument.columns()), 40, len(machine.components))
    singles = np.concatenate([instrument.arms(machine, p[None]) for p in pose], axis=1)
    np.testing.assert_allclose(arms, singles, rtol=1e-12, atol=1e-15)
    for k, component in enumerate(machine.components):
        one = instrument.arms_of(machine, pose, component)
        np.testing.assert_allclose(one, arms[:, :, k], rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(Instrument.arms_of(instrument, machine, pose, component), arms[:, :, k], rtol=1e-12)


@law_for([e for e in EXAMPLES if e.name in ("laser_linear", "straightness")])
def test_point_readings_are_rows_of_the_chain(example: Example) -> None:
    """Oracle: `Chain.jacobian` with the point beside the tool tip, for instruments that read one point."""
    machine, setup = example.machine(), dict(example.setup)
    offset = setup.get("beam_offset_mm", setup.get("probe_offset_mm", ()))
    pose = poses(machine, 7)
    row = "XYZ".index(setup.get("direction") or machine.axis(example.axis or "").direction)
    np.testing.assert_allclose(example.make().arms(machine, pose)[0], machine.chain.jacobian(pose, offset)[:, row])


@every_example
def test_names_and_units(example: Example) -> None:
    """Oracle: `formats.md`; a reading column ends with its unit, and angles are read in µrad only."""
    instrument = example.make()
    columns = instrument.columns()
    assert len(set(columns)) == len(columns) > 0
    unit = "_urad" if example.name in ("laser_angular", "level") else "_um"
    assert all(c.startswith("reading_") and c.endswith(unit) for c in columns)
    assert len(instrument.reads_while(None)) == len(columns)


@every_example
def test_nuisances_have_the_shape_of_the_readings(example: Example) -> None:
    machine, instrument = example.machine(), example.make()
    here = state(machine)
    nuisances = instrument.nuisance(here, np.repeat([1, 2, 3], 4))
    assert len({n.name for n in nuisances}) == len(nuisances)
    for n in nuisances:
        assert n.values.shape == (len(instrument.columns()), len(here))
        assert np.isfinite(n.values).all()
        assert n.values.any()
        assert n.per in ("run", "setup")


@every_example
def test_written_and_read_again(example: Example, tmp_path: Path) -> None:
    """Saving and loading is the identity: the instrument, its set-up, every number."""
    machine, instrument = example.machine(), example.make()
    pose, rng = poses(machine, 6), np.random.default_rng(3)
    if isinstance(instrument, LaserDiagonal):  # whose axes move together
        parts = np.array([instrument.line["XYZ".index(a.direction)] for a in machine.axes])
        pose = pose[0] + np.arange(6.0)[:, None] * parts
    channels = {a.channel: pose[:, i] for i, a in enumerate(machine.axes)}
    if isinstance(instrument, BallBar):  # whose file may hold nothing beside its circle
        channels = circle_channels(machine, instrument.setup, instrument.setup.sense * np.arange(6.0))
    made = Measurement(
        name="m",
        instrument=instrument,
        machine=machine,
        run=np.array([1, 1, 1, 2, 2, 2]),
        time_s=np.arange(6.0),
        channels=channels,
        readings={c: rng.standard_normal(6) for c in instrument.columns()},
    )
    read = load_measurement(save_measurement(made, tmp_path / "m.csv"), machine)
    assert read.instrument == instrument
    assert all(np.array_equal(read.readings[c], made.readings[c]) for c in instrument.columns())


DIRECT = {"laser_linear": "EXX", "laser_angular": "EBX", "level": "EAX", "straightness": "EZX", "squareness": "EB0X"}


@pytest.mark.parametrize(("name", "component"), DIRECT.items())
def test_a_component_read_directly_has_the_arm_one(name: str, component: str) -> None:
    machine = turning_centre()
    instrument = make_instrument(name, {}, "X", component, machine, "test")
    arms = instrument.arms(machine, poses(machine, 5))
    expected = np.array([float(c == component) for c in machine.components])
    np.testing.assert_array_equal(arms, np.broadcast_to(expected, (1, 5, len(expected))))
    assert instrument.columns() == (f"reading_{component_unit(component)}",)


def test_a_million_poses_stay_light() -> None:
    """One component of a million poses: below 100 MB, where the whole tensor would take 320 MB. The base class'
    own way, for instruments that are not affine: as little."""
    machine = turning_centre()
    laser = make_instrument("laser_linear", {}, "X", None, machine, "test")
    pose = poses(machine, 10**6)
    for way in (type(laser).arms_of, Instrument.arms_of):
        tracemalloc.start()
        assert way(laser, machine, pose, "EBZ").shape == (1, 10**6)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 100e6


def test_artefact_and_slide_part_by_reversal() -> None:
    """Oracle: [G 3.1-3.3] with made-up forms; slide and artefact both follow a cubic, only the reversal parts them."""
    machine = turning_centre()
    setup = {"direction": "X", "reversed_runs": [2], "artefact_degree": 3}
    probe = make_instrument("straightness", setup, "Z", None, machine, "test")
    z = np.tile(np.linspace(0.0, 400.0, 21), 2)
    run = np.repeat([1, 2], 21)
    here = State(machine, np.arange(42.0), {"z": z, "x": np.full(42, 100.0)})
    u = z / 200.0 - 1.0
    slide, artefact = 3.0 * (1.5 * u**2 - 0.5), -2.0 * (2.5 * u**3 - 1.5 * u)
    reading = slide + np.where(run == 1, 1.0, -1.0) * artefact + 7.0 + 12.0 * u
    arm = probe.arms_of(machine, here.positions_mm(), "EXZ")[0]
    columns = [arm * (1.5 * u**2 - 0.5), arm * (2.5 * u**3 - 1.5 * u)]
    nuisances = probe.nuisance(here, run)
    columns += [n.values[0] for n in nuisances]
    found = np.linalg.lstsq(np.stack(columns, axis=1), reading, rcond=None)[0]
    by_name = dict(zip(["slide 2", "slide 3", *(n.name for n in nuisances)], found, strict=True))
    assert by_name["slide 2"] == pytest.approx(3.0)
    assert by_name["slide 3"] == pytest.approx(0.0, abs=1e-9)
    assert by_name["artefact 2"] == pytest.approx(0.0, abs=1e-9)
    assert by_name["artefact 3"] == pytest.approx(-2.0)
    assert by_name["slope"] == pytest.approx(60.0)


@pytest.mark.parametrize("phi_urad", [15.0, -40.0])
def test_a_turned_square_is_its_alignment(phi_urad: float) -> None:
    """Oracle: a square turned by φ in space, and points on its arms. The machine is perfect, so a probe that goes
    straight sees nothing but the arms moving away."""
    machine = bridge()
    square = make_instrument("squareness", {"reference_axis": "Y"}, "X", None, machine, "test")
    x, y = np.meshgrid([-500.0, 0.0, 700.0], [-300.0, 0.0, 400.0])
    here = State(machine, np.arange(9.0), {"x": x.ravel(), "y": y.ravel(), "z": np.zeros(9)})
    alignment = next(n for n in square.nuisance(here, np.ones(9, np.int64)) if n.name == "alignment")
    phi = phi_urad * 1e-6
    # An arm along Y, turned by φ about Z, lies at x = -φ y; the probe on it reads x of the tool minus x of the arm.
    np.testing.assert_allclose(alignment.values[0] * phi_urad, phi * y.ravel() * 1e3, atol=1e-9)
    np.testing.assert_allclose(alignment.values[1] * phi_urad, -phi * x.ravel() * 1e3, atol=1e-9)


def test_squareness_of_a_machine_is_found_whatever_way_the_square_lies() -> None:
    """Oracle: a chosen EC0Y, read through the true product of transforms, found by least squares with the square's
    alignment unknown."""
    machine = bridge()
    square = make_instrument("squareness", {"reference_axis": "X"}, "Y", None, machine, "test")
    places = np.linspace(-500.0, 500.0, 11)
    pose = np.zeros((22, 3))
    pose[:11, machine.axis_names.index("X")] = places
    pose[11:, machine.axis_names.index("Y")] = places
    here = State(machine, np.arange(22.0), {a.channel: pose[:, i] for i, a in enumerate(machine.axes)})
    tip = np.array([frames(machine, p, {"EC0Y": 25.0}).seen() for p in pose]) * 1e3
    matrix = {n.name: n.values for n in square.nuisance(here, np.ones(22, np.int64))}
    reading = tip.T[:2] + 33.0 * matrix["alignment"]
    taken = np.stack([np.arange(22) >= 11, np.arange(22) < 11])  # x is read while Y travels
    assert square.reads_while("Y") == (True, False)
    columns = [square.arms_of(machine, pose, "EC0Y"), *matrix.values()]
    found = np.linalg.lstsq(np.stack([c[taken] for c in columns], axis=1), reading[taken], rcond=None)[0]
    assert found[0] == pytest.approx(25.0, abs=1e-3)
    assert found[1 + list(matrix).index("alignment")] == pytest.approx(33.0, abs=1e-3)


def test_nuisances_that_the_setup_asks_for() -> None:
    machine = vertical_mill()
    setup = {"zero": "run", "slope": "run", "air_sensor": "T_air", "interferometer_mm": -300.0}
    laser = make_instrument("laser_linear", setup, "X", None, machine, "test")
    here = state(machine)
    zero, slope, air = laser.nuisance(here, np.ones(12, np.int64))
    assert (zero.per, slope.per, air.per) == ("run", "run", "setup")
    np.testing.assert_allclose(slope.values[0], (here.value("x") - 200.0) * 1e-3)
    np.testing.assert_allclose(air.values[0], (here.value("x") + 300.0) * 1e-3 * here.rise("T_air"))
    quiet = make_instrument("laser_linear", {"zero": "none"}, "X", None, machine, "test")
    assert quiet.nuisance(here, np.ones(12, np.int64)) == ()
    tracker = make_instrument("tool_tip", {"alignment": "setup"}, None, None, machine, "test")
    assert [n.name for n in tracker.nuisance(here, np.ones(12, np.int64))][3:] == [f"alignment {k}" for k in "ABC"]
    part = make_instrument("work_piece", {"feature": "length"}, "Z", None, machine, "test")
    assert [n.per for n in part.nuisance(here, np.ones(12, np.int64))] == ["run"]


@pytest.mark.parametrize(
    ("name", "setup", "axis", "component", "words"),
    [
        ("laser_liner", {}, "X", None, ["no instrument 'laser_liner'", "did you mean 'laser_linear'"]),
        ("laser_linear", {"beam_offset": [0, 0, 0]}, "X", None, ["[setup]", "'beam_offset'", "'beam_offset_mm'"]),
        ("laser_linear", {}, None, None, ["key 'axis' is missing", "X, Z"]),
        ("laser_linear", {}, "Y", None, ["axis 'Y'", "turning-centre"]),
        ("laser_linear", {}, "X", "EBX", ["component 'EBX'", "in µm"]),
        ("laser_linear", {}, "X", "EXY", ["component 'EXY'"]),
        ("laser_linear", {"air_sensor": "T_aer", "interferometer_mm": 0.0}, "X", None, ["'T_aer'", "'T_air'"]),
        ("laser_linear", {"air_sensor": "T_air"}, "X", None, ["belong together"]),
        ("laser_diagonal", {}, None, None, ["'direction' is missing"]),
        ("laser_diagonal", {"direction": [0, 0, 1]}, None, None, ["two parts or more"]),
        ("laser_diagonal", {"direction": [1, 1, 1]}, None, None, ["a part along Y", "no axis of turning-centre"]),
        ("laser_diagonal", {"direction": [1, 0, 1]}, "X", None, ["follows no axis"]),
        ("laser_angular", {}, "X", None, ["'about' is missing"]),
        ("laser_angular", {"about": "A"}, "X", None, ["roll of axis X"]),
        ("level", {"about": "C"}, None, None, ["about the vertical"]),
        ("straightness", {"direction": "X"}, "X", None, ["across"]),
        ("straightness", {"direction": "Y", "artefact_degree": 3}, "X", None, ["reversed_runs"]),
        ("squareness", {}, "X", None, ["'reference_axis' is missing"]),
        ("squareness", {"reference_axis": "Q"}, "X", None, ["'Q'", "X, Z"]),
        ("squareness", {"reference_axis": "X"}, "X", None, ["cannot be square"]),
        ("spindle_drift", {}, None, None, ["'probe' is missing"]),
        ("spindle_drift", {"probe": {"Radial 1": {"direction": "X"}}}, None, None, ["small letters"]),
        ("spindle_drift", {"probe": {"r": {"direction": "X"}}}, None, "EX0spindle", ["no component directly"]),
        ("tool_tip", {}, "X", None, ["follows no axis"]),
        ("tool_tip", {"directions": ["X", "X"]}, None, None, ["twice"]),
        ("work_piece", {"feature": "diametre"}, "X", None, ["'diameter' or 'length'"]),
    ],
)
def test_what_does_not_fit_is_told(
    name: str, setup: dict[str, Any], axis: str | None, component: str | None, words: list[str]
) -> None:
    with pytest.raises(MeasurementError) as caught:
        make_instrument(name, setup, axis, component, turning_centre(), "laser-x.toml")
    assert str(caught.value).startswith("laser-x.toml: ")
    assert all(word in str(caught.value) for word in words), str(caught.value)
