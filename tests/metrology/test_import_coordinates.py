"""Files of a laser tracker: nominal and measured positions of two or three axes become readings in each direction.

Oracle: the errors in µm that were added to the nominal positions.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import ImportProposal, import_table, import_to_files, propose

MACHINE = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "vertical-mill.toml")
PLACES = np.array([[x, y, z] for x in (50.0, 150.0, 300.0) for y in (40.0, 200.0) for z in (50.0, 200.0)])
ERRORS_UM = np.round(np.random.default_rng(3).normal(0.0, 10.0, PLACES.shape), 1)
NAMES = ("Nominal {} [mm]", "Measured {} [mm]")


def turned(angle_rad: float) -> np.ndarray:
    """A turn about Z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def tracker(
    folder: Path,
    names: tuple[str, str] = NAMES,
    letters: str = "XYZ",
    measured_mm: np.ndarray | None = None,
    more: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """A tracker's file: of each letter the nominal and the measured position."""
    measured_mm = PLACES + 1e-3 * ERRORS_UM if measured_mm is None else measured_mm
    columns = {names[0].format(c): PLACES[:, "XYZ".index(c)] for c in letters}
    columns |= {names[1].format(c): measured_mm[:, "XYZ".index(c)] for c in letters}
    columns |= dict(more or {})
    rows = [";".join(f"{v:.4f}" for v in row) for row in zip(*columns.values(), strict=True)]
    path = folder / "tracker.csv"
    lines = [f"{18 * i};{row}" for i, row in enumerate(rows)]
    path.write_text("\n".join([f"t [s];{';'.join(columns)}", *lines]), encoding="utf-8")
    return path


def proposed(path: Path, **answers: str) -> ImportProposal:
    return propose(path, MACHINE, {}, answers)


def readings_um(path: Path, letters: str = "XYZ", **answers: str) -> np.ndarray:
    done = import_table(path, proposed(path, **answers).import_map())
    return np.column_stack([np.asarray(done.columns[f"reading_{c.lower()}_um"], dtype=np.float64) for c in letters])


@pytest.mark.parametrize(
    "names",
    [
        NAMES,
        ("Nominal {} [mm]", "Actual {} [mm]"),
        ("{} target [mm]", "{} measured [mm]"),
        ("Commanded {} [mm]", "Actual {} [mm]"),
        ("{}_nom", "{}_meas"),
        ("Soll {} [mm]", "Ist {} [mm]"),
        ("{}-Soll [mm]", "{}-Ist [mm]"),
        ("{}soll [mm]", "{}ist [mm]"),
        ("{}Nom", "{}Act"),
        ("{} [mm]", "Measured {} [mm]"),
    ],
)
def test_pairs_of_positions_are_readings_of_the_tool_tip(names: tuple[str, str], tmp_path: Path) -> None:
    """No answer is needed; the result is read back as a measurement of the machine."""
    path = tracker(tmp_path, names)
    proposal = proposed(path)
    assert proposal.content["measurement"]["instrument"] == "tool_tip"
    done = import_to_files(path, proposal.import_map(), tmp_path / "made", MACHINE)
    m = load_measurement(tmp_path / "made", MACHINE)
    for i, c in enumerate("xyz"):
        np.testing.assert_array_equal(m.channels[c], PLACES[:, i])
        np.testing.assert_allclose(m.readings[f"reading_{c}_um"], ERRORS_UM[:, i], atol=1e-6)
    assert any("Which instrument took the readings? tool_tip" in n for n in done.notes) or any(
        "Which instrument took the readings? tool_tip" in n for n in m.notes
    )


def test_the_rotation_of_the_frame_is_unknown_and_said(tmp_path: Path) -> None:
    """A tracker is turned by a small angle against the machine: the fit estimates it unless the user says otherwise."""
    path = tracker(tmp_path)
    assert proposed(path).content["setup"]["alignment"] == "setup"
    assert proposed(path, **{"setup.alignment": "none"}).content["setup"]["alignment"] == "none"
    assert any(q.key == "setup.alignment" for q, _ in proposed(path).assumed)


def test_two_axes_are_two_readings(tmp_path: Path) -> None:
    path = tracker(tmp_path, letters="XZ")
    proposal = proposed(path)
    assert proposal.content["setup"]["directions"] == ["X", "Z"]
    np.testing.assert_allclose(readings_um(path, "XZ"), ERRORS_UM[:, [0, 2]], atol=1e-6)


def test_units_that_the_names_do_not_tell_are_asked(tmp_path: Path) -> None:
    """Measured in inch, as only the user knows."""
    path = tracker(tmp_path, ("{}_nom", "{}_meas [mm]"), measured_mm=(PLACES + 1e-3 * ERRORS_UM))
    assert {q.key for q, _ in proposed(path).assumed} >= {f"unit of {c}_nom" for c in "XYZ"}
    inches = {f"unit of {c}_nom": "inch" for c in "XYZ"}
    with pytest.raises(MeasurementError, match="these are positions, no deviations"):
        readings_um(path, **inches)


def test_another_instrument_may_be_answered(tmp_path: Path) -> None:
    """A laser along X beside the positions that the control displays: the reading is asked, as of old."""
    asked = proposed(tracker(tmp_path), instrument="laser_linear", axis="X")
    assert [q.key for q in asked.open] == ["reading"]
    done = asked.answered({"reading": "Measured X [mm]"})
    assert done.content["column"]["reading_um"]["from"] == "Measured X [mm]"


def test_the_length_of_the_deviation_is_no_reading(tmp_path: Path) -> None:
    """Trackers write it beside the coordinates."""
    length = {"3D deviation [mm]": 1e-3 * np.linalg.norm(ERRORS_UM, axis=1)}
    np.testing.assert_allclose(readings_um(tracker(tmp_path, more=length)), ERRORS_UM, atol=1e-6)


@pytest.mark.parametrize("name", ["d{} [mm]", "Δ{} [mm]", "Dev {} [mm]"])
def test_deviations_beside_the_positions_get_their_sign_from_them(tmp_path: Path, name: str) -> None:
    """The program writes nominal minus actual."""
    more = {name.format(c): -1e-3 * ERRORS_UM[:, i] for i, c in enumerate("XYZ")}
    path = tracker(tmp_path, more=more)
    assert "sign" not in {q.key for q in proposed(path).questions}
    np.testing.assert_allclose(readings_um(path), ERRORS_UM, atol=0.11)


# --- frames


def test_a_shift_is_said_and_taken_as_the_zero(tmp_path: Path) -> None:
    shift_mm = np.array([1000.0, -250.0, 12.0])
    path = tracker(tmp_path, measured_mm=PLACES + shift_mm + 1e-3 * ERRORS_UM)
    done = import_table(path, proposed(path).import_map())
    said = [n for n in done.notes if n.startswith("the readings are shifted by")]
    assert len(said) == 1
    assert "X 1000 mm, Y -250 mm and Z 12 mm" in said[0]


@pytest.mark.parametrize("angle_rad", [2e-3, 0.5, np.pi / 2, np.pi])
def test_a_frame_turned_by_more_than_a_small_angle_is_refused(tmp_path: Path, angle_rad: float) -> None:
    """A turn about Z; half a turn is also what a changed sign of X and Y is."""
    path = tracker(tmp_path, measured_mm=PLACES @ turned(angle_rad).T + 1e-3 * ERRORS_UM)
    with pytest.raises(MeasurementError, match=r"in another frame.*turned by .*fit the measured points to the nominal"):
        readings_um(path)


def test_a_small_turn_passes_and_is_said_where_the_fit_would_not_find_it(tmp_path: Path) -> None:
    """0.5 mrad: the small rotations of tool_tip hold."""
    path = tracker(tmp_path, measured_mm=PLACES @ turned(5e-4).T)
    assert not any("turned by" in n for n in import_table(path, proposed(path).import_map()).notes)
    none = proposed(path, **{"setup.alignment": "none"})
    said = [n for n in import_table(path, none.import_map()).notes if "turned by 0.5 mrad" in n]
    assert len(said) == 1
    assert 'alignment = "setup"' in said[0]


def test_a_lost_beam_is_no_other_frame(tmp_path: Path) -> None:
    """One measured point is written as 0, 0, 0; the checks of the readings are for such."""
    measured_mm = PLACES + 1e-3 * ERRORS_UM
    measured_mm[7] = 0.0
    readings = readings_um(tracker(tmp_path, measured_mm=measured_mm))
    np.testing.assert_allclose(np.delete(readings, 7, axis=0), np.delete(ERRORS_UM, 7, axis=0), atol=1e-6)


def test_a_mirrored_axis_is_another_frame(tmp_path: Path) -> None:
    """The tracker's Y points the other way."""
    with pytest.raises(MeasurementError, match=r"in another frame.*turned by 180°, or mirrored"):
        readings_um(tracker(tmp_path, measured_mm=PLACES * [1.0, -1.0, 1.0]))


def test_one_line_of_points_shows_its_own_turn(tmp_path: Path) -> None:
    """X alone moves, and the line is turned by 30°."""
    line = np.column_stack([np.linspace(0.0, 300.0, len(PLACES)), np.full((len(PLACES), 2), [100.0, 50.0])])
    text = [f"{i};" + ";".join(f"{v:.4f}" for v in (*p, *(turned(np.pi / 6) @ p))) for i, p in enumerate(line)]
    path = tmp_path / "line.csv"
    head = ";".join(["t [s]", *(n.format(c) for n in NAMES for c in "XYZ")])
    path.write_text("\n".join([head, *text]), encoding="utf-8")
    with pytest.raises(MeasurementError, match=r"in another frame.*turned by 30°"):
        readings_um(path)


# --- readings whose names have no letter


@pytest.mark.parametrize(
    ("names", "answers"),
    [
        (("X [mm]", "Deviation [um]"), {}),
        (("Soll [mm]", "Ist [mm]"), {"axis": "X"}),
        (("X [mm]", "Probe 1 [um]", "Probe 2 [um]"), {"reading": "Probe 1 [um]"}),
    ],
)
def test_a_coordinate_that_no_name_tells_is_asked(
    names: tuple[str, ...], answers: dict[str, str], tmp_path: Path
) -> None:
    """A tool tip has no reading without a direction."""
    x, error_um = PLACES[:, 0], ERRORS_UM[:, 0]
    read = 1e-3 * error_um + x if names[1] == "Ist [mm]" else error_um
    rows = [";".join(f"{v:.4f}" for v in row) for row in np.column_stack([x, *[read] * (len(names) - 1)])]
    path = tmp_path / "one.csv"
    lines = [f"{18 * i};{row}" for i, row in enumerate(rows)]
    path.write_text("\n".join([f"t [s];{';'.join(names)}", *lines]), encoding="utf-8")
    asked = proposed(path, instrument="tool_tip", **answers)
    assert [(q.key, q.choices) for q in asked.open] == [("coordinate", ("X", "Y", "Z"))]
    how = asked.answered({"coordinate": "Z"}).import_map()
    m = import_to_files(path, how, tmp_path / "made", MACHINE).measurement
    assert m is not None
    np.testing.assert_allclose(m.readings["reading_z_um"], error_um, atol=1e-6)
