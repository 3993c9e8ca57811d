"""Tables for the procedures: units, encodings, delimiters, dense targets; oracle: the same table written right."""

import csv
from pathlib import Path

import numpy as np
import pytest

from rtec.errors import MeasurementError
from rtec.metrology.procedures.iso230_2 import hidden_period
from rtec.metrology.procedures.tables import drift_table, read_table

HEAD = ["time_s", "spindle_rpm", "radial1_um", "axial_um"]
ROWS = [[600.0 * i, 2000.0, 10.0 * (1.0 - np.exp(-i / 6.0)), 20.0 * (1.0 - np.exp(-i / 6.0))] for i in range(48)]


def written(path: Path, head: list[str], encoding: str = "utf-8") -> Path:
    with path.open("w", newline="", encoding=encoding) as file:
        csv.writer(file).writerows([head, *ROWS])
    return path


def test_a_probe_in_mm_is_refused_not_taken_for_um(tmp_path: Path) -> None:
    """A factor of a thousand; the message names the column and says what to do."""
    path = written(tmp_path / "drift.csv", ["time_s", "spindle_rpm", "radial_mm", "axial_um"])
    with pytest.raises(MeasurementError, match=r"drift.csv: column 'radial_mm' is in mm; convert its numbers to µm"):
        drift_table(path, {"radial1": "radial_mm", "axial": "axial_um"}, None)


def test_utf16_reads_as_utf8_does(tmp_path: Path) -> None:
    plain = read_table(written(tmp_path / "a.csv", HEAD))
    wide = read_table(written(tmp_path / "b.csv", HEAD, "utf-16"))
    assert list(plain) == list(wide)
    for name in plain:
        np.testing.assert_array_equal(plain[name], wide[name])


def test_semicolons_are_read_and_decimal_commas_get_a_way_on(tmp_path: Path) -> None:
    path = tmp_path / "c.csv"
    path.write_text("\n".join(";".join(map(str, row)) for row in (HEAD, *ROWS)) + "\n", encoding="utf-8")
    np.testing.assert_array_equal(read_table(path)["axial_um"], [row[3] for row in ROWS])
    lines = [";".join(HEAD), *(";".join(f"{v:.3f}".replace(".", ",") for v in row) for row in ROWS)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(
        MeasurementError, match=r"line 2: column 'time_s': '0,000' is no number; write decimals with a point"
    ):
        read_table(path)


def test_a_number_beyond_a_float_is_none(tmp_path: Path) -> None:
    path = written(tmp_path / "d.csv", HEAD)
    path.write_text(path.read_text(encoding="utf-8") + "1e999,1,2,3\n", encoding="utf-8")
    with pytest.raises(MeasurementError, match=r"line 50: column 'time_s': '1e999' is no number"):
        read_table(path)


def test_a_dense_run_sees_the_whole_pitch() -> None:
    """Oracle: by definition; targets at the pitch see one place of it, at half of it two, every tenth of it all."""
    assert hidden_period(np.arange(0.0, 200.0, 0.5), 5.0) == []
    assert "multiples of the pitch" in hidden_period(np.arange(0.0, 200.0, 5.0), 5.0)[0]
    assert "half the pitch" in hidden_period(np.arange(0.0, 200.0, 2.5), 5.0)[0]
