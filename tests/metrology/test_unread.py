"""Columns that nothing reads and that vary. Oracles: the tables as written here, and the sentence by hand."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from rtec.metrology.files.load import Leniency, load_measurement, save_measurement
from rtec.metrology.importing import import_to_files, propose
from rtec.metrology.unread import is_rotary, not_read, radians
from tests.support.measurement_examples import HEADER, machine, rows, text, write

ANGLE = [15.0 * i for i in range(12)]


def beside(name: str, cells: list[str], lines: list[str] | None = None) -> str:
    """The good table with one column more."""
    lines = rows() if lines is None else lines
    return text([f"{line},{cell}" for line, cell in zip(lines, cells, strict=True)], f"{HEADER},{name}")


@pytest.mark.parametrize(
    ("name", "rotary"),
    [
        *((n, True) for n in ("c_deg", "C [°]", "b_deg", "A [deg]", "C", "B axis", "winkel", "tilt_rad", "C (deg)")),
        *((n, True) for n in ("b_cmd", "rot_b", "B1", "axis4", "rotary", "table", "Tisch", "phi", "b_gon", "b_arcmin")),
        *((n, True) for n in ("b_mrad [mrad]", "b_turns", "4th axis", "B Achse")),
        *((n, False) for n in ("T_deg", "temp_deg", "T_air_degc", "Air [°C]", "humidity", "X [mm]", "abc", "grade")),
        *((n, False) for n in ("axis1", "x", "d1", "index", "T_table", "table_temp", "adc3", "bias", "returns")),
    ],
)
def test_what_is_an_angle_of_a_rotary_axis(name: str, rotary: bool) -> None:
    assert is_rotary(name) is rotary


@pytest.mark.parametrize(
    ("name", "turn"),
    [("c_deg", 360.0), ("C", 360.0), ("b_rad", 2.0 * np.pi), ("b [mrad]", 2000.0 * np.pi), ("b_gon", 400.0),
     ("b_arcmin", 21600.0), ("b_arcsec", 1296000.0), ("b_turns", 1.0)],
)  # fmt: skip
def test_a_turn_in_each_unit(name: str, turn: float) -> None:
    assert radians(name, np.array([turn]))[0] == pytest.approx(2.0 * np.pi)


def test_the_sentence() -> None:
    assert not_read({}) == ""
    assert not_read({"c_deg": np.array([0.0, 350.0])}) == (
        "Not read: c_deg (0 to 350), which varies; rtec has no rotary axes, so a dependence of the readings on it will "
        "look like something else."
    )
    many = {
        "humidity": np.array([40.25, 55.0]),
        **{f"{n}_deg": np.array([-90.0, 30.0]) for n in "abc"},
        "z": np.zeros(2),
    }
    assert not_read(many).startswith(
        "Not read: a_deg (-90 to 30), b_deg (-90 to 30), c_deg (-90 to 30), humidity (40.25 to 55) and 1 more, which "
        "vary; "
    )
    assert "rotary" not in not_read({"humidity": np.array([40.0, 55.0])})


@pytest.mark.parametrize(
    ("name", "cells", "kept"),
    [
        ("c_deg", [f"{v}" for v in ANGLE], True),
        ("c_deg", ["90.0"] * 12, False),
        ("humidity", [f"{40 + i % 3}" for i in range(12)], True),
        ("counter", [f"{i}" for i in range(12)], False),
        ("operator", ["Ann", "Bob"] * 6, False),
        ("c_deg", ["", "nan", *(f"{v}" for v in ANGLE[2:])], True),
        ("c_deg", [*(f"{v}" for v in ANGLE[1:]), "-"], False),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_numbers_that_vary_are_kept(tmp_path: Path, name: str, cells: list[str], kept: bool, suffix: str) -> None:
    path = write(tmp_path, beside(name, cells))
    numbers = [float(c) if c not in ("", "nan") else np.nan for c in cells] if cells[-1][-1].isdigit() else None
    if suffix == ".parquet":
        lines = [line.split(",") for line in path.read_text().splitlines()]
        columns = {n: [float(r[i]) for r in lines[1:]] for i, n in enumerate(lines[0][:-1])}
        columns["run"] = [int(v) for v in columns["run"]]
        path.unlink()
        path = path.with_suffix(".parquet")
        parquet.write_table(pa.table(columns | {name: numbers or cells}), path)
    m = load_measurement(path, machine())
    assert list(m.unread) == [name] * kept
    if kept:
        np.testing.assert_array_equal(m.unread[name], np.array(numbers))
        saved = load_measurement(save_measurement(m, tmp_path / f"again{suffix}"), machine())
        np.testing.assert_array_equal(saved.unread[name], m.unread[name])


def test_rows_that_are_left_out_are_left_out_of_it(tmp_path: Path) -> None:
    lines = rows()
    lines[4] = lines[4].rsplit(",", 1)[0] + ",broken"
    lines.insert(2, "")
    cells = [f"{v}" for v in [0.0, 15.0, np.nan, *ANGLE[2:]]]
    content = beside("c_deg", cells, lines).replace(f"\n,{np.nan}\n", "\n\n")
    m = load_measurement(write(tmp_path, content), machine(), Leniency(drop_bad_rows=True))
    assert m.unread["c_deg"].tolist() == [v for i, v in enumerate(ANGLE) if i != 4]


def test_an_angle_is_kept_where_it_is_ignored_on_purpose(tmp_path: Path) -> None:
    for name, kept in (("c_deg", True), ("humidity", False)):
        cells = [f"{v % 40}" for v in ANGLE]
        path = write(tmp_path, beside(name, cells), f'[table]\nignore_columns = ["{name}"]\n')
        assert (name in load_measurement(path, machine()).unread) is kept


def test_decimal_commas(tmp_path: Path) -> None:
    content = beside("c_deg", [f"{v}" for v in ANGLE]).replace(",", ";").replace(".", ",")
    m = load_measurement(write(tmp_path, content, '[table]\ndelimiter = ";"\ndecimal = ","\n'), machine())
    assert m.unread["c_deg"].tolist() == ANGLE


@pytest.mark.parametrize(
    ("name", "target", "per_deg"),
    [
        ("C [°]", "c_deg", 1.0),
        ("B-Achse [deg]", "b_deg", 1.0),
        ("A [rad]", "a_deg", np.pi / 180.0),
        ("Winkel [°]", "angle_deg", 1.0),
    ],
)
def test_an_import_keeps_the_angle_and_says_so(tmp_path: Path, name: str, target: str, per_deg: float) -> None:
    raw = tmp_path / "raw.csv"
    lines = (f"{i};{10.0 * i};300;{a * per_deg:.9f};{0.3 * i:.3f};{40 + i % 3}" for i, a in enumerate(ANGLE))
    raw.write_text("\n".join([f"t [s];X [mm];Z [mm];{name};Dev X [um];Feuchte", *lines, ""]))
    proposal = propose(raw, machine(), {}, {"instrument": "tool_tip"})
    assert proposal.open == ()
    done = import_to_files(raw, proposal.import_map(), tmp_path / "out.csv", machine())
    assert done.measurement is not None
    np.testing.assert_allclose(done.measurement.unread[target], ANGLE, atol=1e-6)
    said = [n for n in done.measurement.notes if n.startswith("Not read: ")]
    assert said == [
        f"Not read: {target} (0 to 165) and Feuchte (40 to 42), which vary; rtec has no rotary axes, so a dependence "
        "of the readings on them will look like something else."
    ]


def test_an_angle_that_an_instrument_reads_is_a_reading(tmp_path: Path) -> None:
    """A level that is off by hundredths of a degree."""
    raw = tmp_path / "raw.csv"
    raw.write_text("\n".join(["t [s];X [mm];A [deg]", *(f"{i};{10.0 * i};{0.001 * i:.4f}" for i in range(12)), ""]))
    proposal = propose(raw, machine(), {}, {"instrument": "level", "setup.about": "B"})
    assert proposal.content["column"]["reading_urad"]["from"] == "A [deg]"
