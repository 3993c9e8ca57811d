"""Measurement files. Oracles: the tables as written by hand here; `hashlib` for the digest; bit-for-bit round trips."""

import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from pyarrow import parquet

from rtec.errors import MeasurementError
from rtec.metrology.files.checks import READING_CODES
from rtec.metrology.files.load import Leniency, load_measurement, load_measurements, save_measurement
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.measurement_examples import HEADER, TOML, machine, rows, spoilt, text, write


def fault(path: Path, **accepted: Any) -> str:
    """What is said about a file that is wrong."""
    with pytest.raises(MeasurementError) as caught:
        load_measurement(path, machine(), Leniency(**accepted))
    return str(caught.value)


def same(a: Measurement, b: Measurement) -> None:
    """Bit for bit, NaN and the sign of zero included; notes and digest are about files, not about the measurement."""
    assert (a.name, a.instrument, a.machine) == (b.name, b.instrument, b.machine)
    for one, two in ((a.channels, b.channels), (a.readings, b.readings)):
        assert sorted(one) == sorted(two)
        for name in one:
            assert one[name].tobytes() == two[name].tobytes(), name
    assert a.run.tobytes() == b.run.tobytes()
    assert a.time_s.tobytes() == b.time_s.tobytes()


def test_a_good_file(tmp_path: Path) -> None:
    table = write(tmp_path, text())
    m = load_measurement(table, machine())
    assert (m.name, len(m), m.notes) == ("laser-x", 12, ())
    assert m.run.tolist() == [1] * 6 + [2] * 6
    assert m.time_s.tolist() == [2.5 * i for i in range(12)]
    assert set(m.channels) == {"x", "z", "d_x", "spindle_rpm", "T_bed", "T_spindle"}
    assert m.channels["x"].tolist() == [0, 10, 20, 30, 40, 50, 50, 40, 30, 20, 10, 0]
    assert m.channels["d_x"].tolist() == [1] * 6 + [-1] * 6
    assert m.readings["reading_um"][4] == 0.1
    assert m.instrument.name == "laser_linear"
    assert m.instrument.axis == "X"
    assert m.matrix().shape == (1, 12)
    both = table.read_bytes() + table.with_suffix(".toml").read_bytes()
    assert m.sha256 == hashlib.sha256(both).hexdigest()


@pytest.mark.parametrize("name", ["laser-x", "laser-x.csv", "laser-x.toml"])
def test_a_measurement_is_found_by_stem_table_or_toml(tmp_path: Path, name: str) -> None:
    write(tmp_path, text())
    assert len(load_measurement(tmp_path / name, machine())) == 12


def test_a_stem_may_hold_a_point(tmp_path: Path) -> None:
    write(tmp_path, text(), stem="laser-1.5")
    assert load_measurement(tmp_path / "laser-1.5", machine()).name == "laser-1.5"


@pytest.mark.parametrize(
    ("line", "column", "cell", "said"),
    [
        (4, "x_mm", "abc", ["line 4: x_mm: 'abc' is no number", 'missing_codes = ["abc"]']),
        (4, "x_mm", "", ["line 4: x_mm is empty", "drop_bad_rows = true"]),
        (4, "x_mm", "NaN", ["line 4: x_mm is empty"]),
        (5, "x_mm", "1_0", ["line 5: x_mm: '1_0' is no number"]),
        (5, "x_mm", "0x10", ["line 5: x_mm: '0x10' is no number"]),
        (5, "x_mm", '"1,5"', ["line 5: x_mm: '1,5' has a decimal comma", 'decimal = ","']),
        (5, "x_mm", '"1.234,5"', ["line 5: x_mm: '1.234,5' has thousands separators", "thousands"]),
        (5, "x_mm", '"1,234,567"', ["line 5: x_mm: '1,234,567' has thousands separators"]),
        (5, "x_mm", "1,5", ["line 5: has 10 cells, the header has 9", "decimal commas?"]),
        (5, "x_mm", "inf", ["line 5: x_mm is inf, which is no value"]),
        (7, "time_s", "2026-11-21 08:00:00", ["line 7: time_s: '2026-11-21 08:00:00' is a date", "rtec import"]),
        (7, "time_s", "1.0", ["line 7: time_s falls from 10 to 1", "in order of time"]),
        (6, "run", "2", ["line 7: run 1 comes back", "uninterrupted"]),
        (6, "run", "1.5", ["line 6: run is 1.5, which is no integer"]),
        (6, "dir_x", "2", ["line 6: dir_x is 2; a direction is -1 or +1"]),
        (6, "T_bed_degc", "1372", ["line 6: T_bed_degc is 1372: an open type K", "missing_codes = [1372]"]),
        (6, "T_bed_degc", "-180", ["line 6: T_bed_degc is -180: an open thermocouple"]),
        (6, "T_bed_degc", "9999.00", ["line 6: T_bed_degc is 9999: no value"]),
        (6, "T_bed_degc", "850", ["line 6: T_bed_degc is 850: an open Pt100"]),
        (6, "T_bed_degc", "121.5", ["line 6: T_bed_degc is 121.5 °C, outside", "-20 to 120", "[temperature.T_bed]"]),
        (6, "T_bed_degc", "", ["line 6: T_bed_degc is empty", "hold_temperature_s", "ignore_columns = ['T_bed_degc']"]),
        (6, "reading_um", "9999", ["line 6: reading_um is 9999", "missing_codes = [9999]", "accept_values = [9999]"]),
        (6, "reading_um", "inf", ["line 6: reading_um is inf"]),
        (6, "reading_um", "OL", ["line 6: reading_um: 'OL' is no number", 'missing_codes = ["OL"]']),
    ],
)  # fmt: skip
def test_a_bad_cell_is_told_by_line_with_a_way_on(
    tmp_path: Path, line: int, column: str, cell: str, said: list[str]
) -> None:
    message = fault(write(tmp_path, spoilt(line, column, cell)))
    for words in said:
        assert words in message
    assert message.startswith(str(tmp_path / "laser-x.csv"))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("x_mm", "x_um", ["column 'x_um': 'x_mm' is what is read, in mm", "column 'x_mm' is missing"]),
        ("x_mm", "x_inch", ["column 'x_inch': 'x_mm' is what is read"]),
        ("x_mm", "x", ["column 'x': 'x_mm' is what is read"]),
        ("x_mm", "X_mm", ["unknown column 'X_mm'; write 'x_mm'", "column 'x_mm' is missing (there is 'X_mm')"]),
        ("z_mm", " z_mm", ["unknown column ' z_mm'; write 'z_mm'"]),
        ("z_mm", "y_mm", ["unknown column 'y_mm'", "axes X, Z"]),
        ("dir_x", "dir_y", ["unknown column 'dir_y'"]),
        ("reading_um", "reading_mm", ["column 'reading_mm': 'reading_um' is what is read, in um", "rtec import"]),
        ("reading_um", "reading_x_um", ["unknown column 'reading_x_um'; the laser_linear gives reading_um"]),
        ("spindle_rpm", "spindel_rpm", ["unknown column 'spindel_rpm'; did you mean 'spindle_rpm'"]),
        ("T_bed_degc", "T_bed_degf", ["column 'T_bed_degf': 'T_bed_degc' is what is read"]),
        ("T_bed_degc", "T_bett_degc", ["no such sensor; did you mean 'T_bed_degc'"]),
        ("T_bed_degc", "T_spindle_degc", ["column 'T_spindle_degc' stands 2 times"]),
        ("run", "lauf", ["column 'run' is missing", "1 in every row"]),
        ("time_s", "time_min", ["column 'time_min': 'time_s' is what is read, in s", "'time_s' is missing"]),
        ("z_mm", "", ["a column has no name"]),
    ],
)
def test_a_wrong_column_is_told_with_the_right_one(tmp_path: Path, old: str, new: str, said: list[str]) -> None:
    names = [new if n == old else n for n in HEADER.split(",")]
    message = fault(write(tmp_path, text(header=",".join(names))))
    for words in said:
        assert words in message


def test_columns_of_others_are_left_unread_and_told(tmp_path: Path) -> None:
    lines = [f"{r},Meier" for r in rows()]
    m = load_measurement(write(tmp_path, text(lines, HEADER + ",operator")), machine())
    assert m.notes == ("columns not read: 'operator'",)


def test_a_column_may_be_left_unread_on_purpose(tmp_path: Path) -> None:
    table = write(tmp_path, spoilt(4, "T_bed_degc", "1372"), '[table]\nignore_columns = ["T_bed_degc"]\n')
    m = load_measurement(table, machine())
    assert "T_bed" not in m.channels
    assert "T_bed_degc" in m.notes[0]
    assert "no column of the file; did you mean 'T_bed_degc'" in fault(table, ignore_columns=("T_bet_degc",))


def test_all_faults_are_told_at_once_in_order_of_lines(tmp_path: Path) -> None:
    lines = rows()
    lines[3] = lines[3].replace(",300.0,", ",30o.0,")
    lines[6] = lines[6].replace(",1500,", ",,")
    lines[8] = lines[8].replace(",25.40,", ",1372,")
    message = fault(write(tmp_path, text(lines, HEADER.replace("dir_x", "dir_w")))).splitlines()
    assert [m.split(": ")[1][:7] for m in message] == ["unknown", "line 5", "line 8", "line 10"]


def test_the_first_twenty_are_shown_and_the_rest_counted(tmp_path: Path) -> None:
    lines = [r.replace(",300.0,", ",?,") for r in rows(60)]
    message = fault(write(tmp_path, text(lines))).splitlines()
    assert len(message) == 21
    assert "line 2: z_mm" in message[0]
    assert "and 40 more like it, the last at line 61" in message[0]
    assert message[-1].endswith("and 40 more")


def test_missing_readings_are_kept_and_told_never_zero(tmp_path: Path) -> None:
    lines = rows()
    lines[2] = lines[2].rsplit(",", 1)[0] + ","
    lines[5] = lines[5].rsplit(",", 1)[0] + ",NaN"
    m = load_measurement(write(tmp_path, text(lines)), machine())
    assert np.flatnonzero(np.isnan(m.readings["reading_um"])).tolist() == [2, 5]
    assert m.notes == ("reading_um: 2 of 12 readings missing (lines 4, 7)",)


def test_without_any_reading_there_is_no_measurement(tmp_path: Path) -> None:
    lines = [r.rsplit(",", 1)[0] + "," for r in rows()]
    assert "column 'reading_um' has no reading at all" in fault(write(tmp_path, text(lines)))


@pytest.mark.parametrize("way", ["toml", "options"])
def test_bad_rows_are_left_out_only_on_wish_and_told(tmp_path: Path, way: str) -> None:
    lines = rows()
    lines[2] = lines[2].replace(",300.0,", ",abc,")
    lines[4] = lines[4] + ",7"
    lines[9] = lines[9].replace(",20.09,", ",1372,")
    table = write(tmp_path, text(lines), "[table]\ndrop_bad_rows = true\n" if way == "toml" else "")
    m = load_measurement(table, machine(), Leniency(drop_bad_rows=True) if way == "options" else None)
    assert m.time_s.tolist() == [2.5 * i for i in range(12) if i not in (2, 4, 9)]
    told = "\n".join(m.notes)
    for words in ("line 4", "line 6", "line 11", "3 of 12 rows left out", "1372"):
        assert words in told


def test_leaving_rows_out_mends_no_clock_and_no_run(tmp_path: Path) -> None:
    assert "time_s falls" in fault(write(tmp_path, spoilt(7, "time_s", "1.0")), drop_bad_rows=True)
    assert "comes back" in fault(write(tmp_path, spoilt(6, "run", "2")), drop_bad_rows=True)


def test_a_clock_that_starts_again_with_each_run_has_its_own_way_on(tmp_path: Path) -> None:
    lines = rows()
    lines[6:] = [r.replace(f",{2.5 * (i + 6)},", f",{2.5 * i},", 1) for i, r in enumerate(lines[6:])]
    assert "restarts = true" in fault(write(tmp_path, text(lines)))


def test_missing_codes(tmp_path: Path) -> None:
    table = write(tmp_path, spoilt(6, "reading_um", "9999"))
    m = load_measurement(table, machine(), Leniency(missing_codes=(9999.0,)))
    assert np.isnan(m.readings["reading_um"][4])
    assert "reading_um: 9999 taken as missing (line 6)" in m.notes
    same(m, load_measurement(table, machine(), Leniency(missing_codes=(9999.0, 300.0))))  # a place is no code
    assert load_measurement(table, machine(), Leniency(accept_values=(9999.0,))).readings["reading_um"][4] == 9999.0
    m = load_measurement(write(tmp_path, spoilt(6, "reading_um", "OL")), machine(), Leniency(missing_codes=("OL",)))
    assert np.isnan(m.readings["reading_um"][4])
    assert Leniency(missing_codes=(float("nan"), 9999.0)).missing_codes == (9999.0,)  # NaN is missing by itself


def test_a_temperature_may_be_held_for_a_while(tmp_path: Path) -> None:
    lines = rows()
    for i in (3, 4, 5):
        lines[i] = lines[i].replace(f",{20 + 0.01 * i:.2f},", ",-180,")
    table = write(tmp_path, text(lines))
    m = load_measurement(table, machine(), Leniency(missing_codes=(-180.0,), hold_temperature_s=8.0))
    assert m.channels["T_bed"][2:6].tolist() == [20.02] * 4
    assert "T_bed_degc: last good value held (lines 5, 6, 7)" in m.notes
    assert "line 7: T_bed_degc is empty" in fault(table, missing_codes=(-180.0,), hold_temperature_s=6.0)


@pytest.mark.parametrize(
    ("encoding", "accepted"),
    [
        ("utf-8", {}),
        ("utf-8-sig", {}),
        ("utf-16", {}),
        ("utf-16-le", {"encoding": "utf-16-le"}),
        ("utf-16-be", {"encoding": "utf-16-be"}),
        ("latin-1", {"encoding": "latin-1"}),
        ("cp1252", {"encoding": "cp1252"}),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_encodings_give_the_same_numbers(tmp_path: Path, encoding: str, accepted: Any, end: str) -> None:
    plain = load_measurement(write(tmp_path, text()), machine())
    lines = [f"{r},20 °C µ" for r in rows()]
    content = text(lines, HEADER + ",Bemerkung °").replace("\n", end)
    m = load_measurement(write(tmp_path, content.encode(encoding)), machine(), Leniency(**accepted))
    same(plain, m)
    assert ("text is" in "".join(m.notes)) == (encoding != "utf-8")


def test_text_in_another_encoding_is_told_by_line_and_byte(tmp_path: Path) -> None:
    lines = [f"{r},ok" for r in rows()]
    lines[4] = lines[4].replace("ok", "20 °C")
    data = text(lines, HEADER + ",note").encode("latin-1")
    message = fault(write(tmp_path, data))
    assert "line 6: byte 0xB0" in message
    assert "under [table] of laser-x.toml encoding = 'latin-1'" in message
    assert f"byte {data.index(0xB0)} of the file" in message
    mixed = b"\xef\xbb\xbf" + data
    assert "line 6: byte 0xB0" in fault(write(tmp_path, mixed))


def test_utf_16_without_a_mark_is_asked_for(tmp_path: Path) -> None:
    assert "encoding = 'utf-16-le'" in fault(write(tmp_path, text().encode("utf-16-le")))
    assert "encoding = 'utf-16-be'" in fault(write(tmp_path, text().encode("utf-16-be")))


@pytest.mark.parametrize("mark", [";", "\t"])
def test_decimal_commas_are_read_only_on_wish(tmp_path: Path, mark: str) -> None:
    plain = load_measurement(write(tmp_path, text()), machine())
    table = write(tmp_path, text().replace(",", mark).replace(".", ","))
    shown = "\\t" if mark == "\t" else mark
    assert f'delimiter = "{shown}" and, where numbers have commas, decimal = ","' in fault(table)
    assert "has a decimal comma" in fault(table, delimiter=mark)
    same(plain, load_measurement(table, machine(), Leniency(delimiter=mark, decimal=",")))


def test_blank_lines(tmp_path: Path) -> None:
    plain = load_measurement(write(tmp_path, text()), machine())
    m = load_measurement(write(tmp_path, text() + "\n\n"), machine())
    same(plain, m)
    assert m.notes == ()
    lines = rows()
    lines.insert(3, "")
    m = load_measurement(write(tmp_path, text(lines)), machine())
    same(plain, m)
    assert m.notes == ("blank line 5 not read",)


def test_what_is_allowed_and_odd_is_told(tmp_path: Path) -> None:
    m = load_measurement(write(tmp_path, spoilt(5, "x_mm", "25400")), machine())
    assert "x_mm goes from 0 to 25400 mm, axis X from 0 to 200: right unit?" in m.notes
    twice = [",".join([str(1 + i // 6), *r.split(",")[1:-1], f"{i % 6 * 0.4}"]) for i, r in enumerate(rows())]
    m = load_measurement(write(tmp_path, text(twice)), machine())
    assert m.notes == ("run 2 has the readings of run 1 to the last digit",)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", "line 1 is empty"),
        ("\n\n", "line 1 is empty"),
        (HEADER + "\n", "no rows under the header"),
        (text([r.replace("300.0", "?") for r in rows()]), "line 2"),
    ],
)
def test_files_without_rows(tmp_path: Path, content: str, said: str) -> None:
    assert said in fault(write(tmp_path, content))


def test_nothing_left_after_leaving_rows_out(tmp_path: Path) -> None:
    table = write(tmp_path, text([r.replace("300.0", "?") for r in rows()]))
    assert "every one of its 12 rows is bad" in fault(table, drop_bad_rows=True)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('machine = "turning-centre"', 'machine = "mill"', "machine is 'mill', the machine given is 'turning-centre'"),
        ('instrument = "laser_linear"\n', "", "key 'instrument' is missing"),
        ("[setup]", "[setop]", "unknown key 'setop'; did you mean 'setup'"),
        ("beam_offset_mm", "beam_offst_mm", "beam_offset_mm"),
        ('"laser_linear"', '"laser_liner"', "laser_linear"),
        ("[measurement]", "[measurement", "not valid TOML"),
        ("[setup]", '[table]\ndecimal = ","\n[setup]', "delimiter and decimal are both ','"),
        ("[setup]", "[table]\nencoding = 'klingon'\n[setup]", "encoding"),
        ("[setup]", "[table]\ndrop_bad_row = true\n[setup]", "did you mean 'drop_bad_rows'"),
    ],
)
def test_the_toml_is_read_strictly(tmp_path: Path, old: str, new: str, said: str) -> None:
    table = write(tmp_path, text())
    table.with_suffix(".toml").write_text(TOML.replace(old, new), encoding="utf-8")
    message = fault(table)
    assert said in message
    assert "laser-x.toml" in message


def test_a_table_without_toml_says_how_to_write_one(tmp_path: Path) -> None:
    table = write(tmp_path, text())
    table.with_suffix(".toml").unlink()
    message = fault(table)
    assert 'instrument = "laser_linear"' in message
    assert "rtec import" in message


def test_files_that_are_not_there(tmp_path: Path) -> None:
    assert "no such file" in fault(tmp_path / "absent.csv")
    assert "absent.csv or .parquet" in fault(tmp_path / "absent")
    assert "absent.csv or .parquet" in fault(tmp_path / "absent.toml")
    assert "a measurement is" in fault(tmp_path)
    m = load_measurement(write(tmp_path, text()), machine())
    save_measurement(m, tmp_path / "laser-x.parquet")
    assert "name the one you mean" in fault(tmp_path / "laser-x")
    assert load_measurement(tmp_path / "laser-x.parquet", machine()).sha256 != m.sha256


def test_several_files_tell_their_faults_together(tmp_path: Path) -> None:
    one = write(tmp_path, spoilt(4, "x_mm", "abc"), stem="one")
    two = write(tmp_path, spoilt(5, "x_mm", "abc"), stem="two")
    good = write(tmp_path, text(), stem="three")
    with pytest.raises(MeasurementError) as caught:
        load_measurements([one, good, two], machine())
    assert [line.split(": ")[1] for line in str(caught.value).splitlines()] == ["line 4", "line 5"]
    assert [m.name for m in load_measurements([good], machine())] == ["three"]


# --- Parquet


def as_parquet(folder: Path, **columns: Any) -> Path:
    table = {n: [float(r.split(",")[i]) for r in rows()] for i, n in enumerate(HEADER.split(","))}
    path = folder / "laser-x.parquet"
    parquet.write_table(pa.table({n: v for n, v in (table | columns).items() if v is not None}), path)
    path.with_suffix(".toml").write_text(TOML, encoding="utf-8")
    return path


def test_parquet_gives_what_csv_gives(tmp_path: Path) -> None:
    plain = load_measurement(write(tmp_path, text()), machine())
    same(plain, load_measurement(as_parquet(tmp_path), machine()))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ({"x_mm": ["a"] * 12}, "column 'x_mm' is of type string; write it as numbers"),
        ({"x_mm": None}, "column 'x_mm' is missing"),
        ({"x_mm": [None, *[1.0] * 11]}, "row 1: x_mm is empty"),
        ({"T_bed_degc": [20.0] * 5 + [1372.0] + [20.0] * 6}, "row 6: T_bed_degc is 1372: an open type K"),
        ({"x_um": [0.0] * 12}, "column 'x_um'"),
    ],
)
def test_parquet_faults_are_told_by_row(tmp_path: Path, columns: Any, said: str) -> None:
    assert said in fault(as_parquet(tmp_path, **columns))


def test_temperatures_that_would_be_in_range_in_fahrenheit_are_asked_about(tmp_path: Path) -> None:
    """20 to 52 °C in °F; one hot sensor among cool readings is a fault of its own."""
    degf = [68.0 + 5.0 * i for i in range(12)]
    assert "if it is in °F, convert all to (T - 32) / 1.8" in fault(
        as_parquet(tmp_path, T_bed_degc=degf, T_spindle_degc=degf)
    )
    assert "°F" not in fault(as_parquet(tmp_path, T_bed_degc=[20.0] * 11 + [125.0]))


def test_a_direction_that_contradicts_the_positions_is_told(tmp_path: Path) -> None:
    x, run = [0.0, 10.0, 20.0, 30.0, 20.0, 10.0] * 2, [1.0] * 12
    ways = [0.0 if i == 0 else 1.0 if x[i] > x[i - 1] else -1.0 for i in range(12)]
    for sign, told in ((-1.0, True), (1.0, False)):
        path = as_parquet(tmp_path, run=run, x_mm=x, dir_x=[sign * w for w in ways])
        notes = load_measurement(path, machine()).notes
        assert ("dir_x contradicts the order of x_mm in 11 of 11 moves: right sign?" in notes) is told


def test_an_axis_that_never_moves_in_its_own_measurement_is_refused(tmp_path: Path) -> None:
    """Where nothing moves, as in a warm-up, nothing contradicts the TOML."""
    toml = '[measurement]\ninstrument = "laser_linear"\naxis = "X"\nmachine = "turning-centre"\n'

    def moved(z_mm: list[float]) -> Path:
        path = as_parquet(tmp_path, x_mm=[90.0] * 12, z_mm=z_mm)
        path.with_suffix(".toml").write_text(toml, encoding="utf-8")
        return path

    said = 'axis = "X" in its TOML, but X never moves here and Z does: name the axis along which it reads'
    assert said in fault(moved([10.0 * i for i in range(12)]))
    assert load_measurement(moved([50.0] * 12), machine()).channels["x"].tolist() == [90.0] * 12


def test_parquet_takes_integers_and_small_floats(tmp_path: Path) -> None:
    path = as_parquet(tmp_path, run=pa.array([1] * 12, pa.int8()), z_mm=pa.array([1.5] * 12, pa.float32()))
    assert load_measurement(path, machine()).channels["z"].tolist() == [1.5] * 12


def test_a_torn_parquet_file(tmp_path: Path) -> None:
    path = as_parquet(tmp_path)
    path.write_bytes(path.read_bytes()[:-40])
    assert "not a whole Parquet file" in fault(path)


# --- Round trips

FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
SMALL = st.floats(-1e6, 1e6, width=64)


@st.composite
def measurements(draw: st.DrawFn) -> Measurement:
    """Any measurement that the file form can hold, the awkward ones first of all."""
    m = machine()
    n = draw(st.integers(1, 8))

    def column(values: st.SearchStrategy[float]) -> Any:
        return draw(arrays.arrays(np.float64, n, elements=values))

    sensors = {f"{s.name}_degc": column(st.floats(*s.range_degc)) for s in m.sensors}
    sides = {c: column(st.sampled_from([-1.0, 0.0, 1.0])) for c in ("dir_x", "dir_z")}
    others = {c: column(FINITE) for c in sorted(set(m.columns) - set(sensors) - set(sides))}
    chosen = draw(st.sets(st.sampled_from(sorted({**sensors, **sides, **others}))))
    columns = {c: v for c, v in {**sensors, **sides, **others}.items() if c in chosen or c in ("x_mm", "dir_x")}
    readings = column(st.one_of(SMALL, st.just(float("nan"))))
    readings[draw(st.integers(0, n - 1))] = draw(SMALL)
    offsets = draw(st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3))
    axis_setup = {"beam_offset_mm": offsets}
    return Measurement(
        "round",
        make_instrument("laser_linear", axis_setup, "X", "EXX", m, "here"),
        m,
        np.sort(np.array(draw(st.lists(st.integers(-(2**53), 2**53), min_size=n, max_size=n)), dtype=np.int64)),
        np.sort(column(FINITE)),
        {m.columns[c]: v for c, v in columns.items()},
        {"reading_um": readings},
    )


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(measurement=measurements())
def test_load_of_save_is_the_identity(tmp_path: Path, suffix: str, measurement: Measurement) -> None:
    path = save_measurement(measurement, tmp_path / f"round{suffix}")
    accepted = Leniency(accept_values=READING_CODES)  # hypothesis knows these numbers too
    loaded = load_measurement(path, machine(), accepted)
    same(measurement, loaded)
    again = load_measurement(save_measurement(loaded, tmp_path / f"round{suffix}"), machine(), accepted)
    same(loaded, again)
    assert again.notes == loaded.notes


def test_saving_tells_what_it_cannot_write(tmp_path: Path) -> None:
    m = load_measurement(write(tmp_path, text()), machine())
    with pytest.raises(MeasurementError, match=r"NAME\.csv or NAME\.parquet"):
        save_measurement(m, tmp_path / "x.xlsx")
    with pytest.raises(MeasurementError, match="channel 'T_bet' has no column; did you mean 'T_bed'"):
        save_measurement(replace(m, channels={"T_bet": m.time_s}), tmp_path / "x.csv")
    x = np.where(np.arange(12) == 2, np.inf, 0.0)
    with pytest.raises(MeasurementError, match="x_mm is infinite in row 3"):
        save_measurement(replace(m, channels={"x": x}), tmp_path / "x.csv")
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(MeasurementError, match="cannot be written"):
        save_measurement(m, tmp_path / "file" / "x.csv")
    assert not list(tmp_path.glob("*.part"))


# --- Fuzz: a measurement or a MeasurementError, never another exception

GOOD = text().encode()


def survives(path: Path, accepted: Leniency | None = None) -> None:
    try:
        load_measurement(path, machine(), accepted)
    except MeasurementError as e:
        assert str(path.with_suffix("")) in str(e)  # noqa: PT017


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.binary(max_size=400))
def test_random_bytes(tmp_path: Path, data: bytes) -> None:
    survives(write(tmp_path, data))
    survives(write(tmp_path, (HEADER + "\n").encode() + data))


MUTATIONS = st.lists(
    st.tuples(
        st.integers(0, len(GOOD) - 1),
        st.integers(0, 3),
        st.one_of(
            st.binary(min_size=1, max_size=3),
            st.sampled_from([b",", b";", b'"', b"\n", b"\r", b"\0", b"\xff", b"-", b"e", b".", b"nan", b"1372"]),
        ),
    ),
    min_size=1,
    max_size=4,
)  # fmt: skip


@settings(max_examples=250, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(mutations=MUTATIONS, drop=st.booleans(), encoding=st.sampled_from([None, "latin-1", "utf-16"]))
def test_mutated_good_files(tmp_path: Path, mutations: Any, drop: bool, encoding: Any) -> None:
    data = bytearray(GOOD)
    for at, removed, new in mutations:
        data[at : at + removed] = new
    content = bytes(data)
    if encoding == "utf-16":
        content = content.decode("latin-1").encode("utf-16")
    survives(write(tmp_path, content), Leniency(drop_bad_rows=drop, encoding=encoding))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 5000), new=st.binary(min_size=1, max_size=4))
def test_mutated_parquet(tmp_path: Path, at: int, new: bytes) -> None:
    path = as_parquet(tmp_path)
    data = bytearray(path.read_bytes())
    data[at % len(data) : at % len(data) + len(new)] = new
    path.write_bytes(bytes(data))
    survives(path)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, len(TOML) - 1), new=st.text(max_size=3))
def test_mutated_toml(tmp_path: Path, at: int, new: str) -> None:
    table = write(tmp_path, text())
    table.with_suffix(".toml").write_text(TOML[:at] + new + TOML[at + 1 :], encoding="utf-8", errors="replace")
    survives(table)


def test_the_quick_and_the_exact_reader_agree(tmp_path: Path) -> None:
    """Oracle: each other. A blank line is more than the quick one takes, so that file goes through the exact one."""
    random = np.random.default_rng(5)
    lines = [
        f"1,{i},{x!r},{y!r},1,1e3,20,+20.5, {z!r} " for i, (x, y, z) in enumerate(random.normal(size=(50, 3)).tolist())
    ]
    quick = load_measurement(write(tmp_path, text(lines)), machine())
    exact = load_measurement(write(tmp_path, text([*lines[:20], "", *lines[20:]])), machine())
    assert "blank line 22 not read" in exact.notes
    same(quick, exact)


def test_an_axis_without_a_column_stands_still_and_is_told(tmp_path: Path) -> None:
    lines = [",".join(r.split(",")[:3] + r.split(",")[4:]) for r in rows()]
    m = load_measurement(write(tmp_path, text(lines, HEADER.replace("z_mm,", ""))), machine())
    assert "z" not in m.channels
    assert m.notes == ("no column z_mm: axis Z is taken as fixed at 0 mm; add the column if it stood elsewhere",)


def test_a_missing_reading_is_saved_as_an_empty_cell(tmp_path: Path) -> None:
    lines = rows()
    lines[2] = lines[2].rsplit(",", 1)[0] + ","
    m = load_measurement(write(tmp_path, text(lines)), machine())
    saved = save_measurement(m, tmp_path / "saved.csv").read_text(encoding="utf-8").splitlines()
    assert [line.endswith(",") for line in saved] == [False] * 3 + [True] + [False] * 9


def test_a_table_uses_one_decimal_mark(tmp_path: Path) -> None:
    table = write(tmp_path, text().replace(",", ";").replace(".", ",").replace(";300,0;", ";300.5;", 1))
    message = fault(table, delimiter=";", decimal=",")
    assert "line 2: z_mm: '300.5' has a decimal point where decimal = ',' was said" in message
    whole = write(tmp_path, HEADER.replace(",", ";") + "\n1;0;0;1.234;1;0;20;20;1\n")
    assert "line 2: z_mm: '1.234' has a decimal point" in fault(whole, delimiter=";", decimal=",")


READ = """import sys
from pathlib import Path
from rtec.metrology.files.load import load_measurement
from tests.support.measurement_examples import machine
for path in sys.argv[1:]:
    load_measurement(Path(path), machine())
sys.exit("pandas" in sys.modules)
"""


def test_reading_a_table_does_not_load_pandas(tmp_path: Path) -> None:
    """It would take half a second of every command, where pandas is installed. Oracle: the modules of a process."""
    (tmp_path / "other").mkdir()
    paths = [str(write(tmp_path, text(rows()))), str(as_parquet(tmp_path / "other"))]
    root = Path(__file__).parents[2]
    assert subprocess.run([sys.executable, "-c", READ, *paths], cwd=root, check=False).returncode == 0


def test_a_tool_tip_that_reads_fewer_directions_says_how_to_write_it(tmp_path: Path) -> None:
    """Oracle: the file is read once the words of the fault are in it."""
    path = tmp_path / "tip.csv"
    path.write_text(
        "run,time_s,x_mm,z_mm,reading_x_um,reading_z_um\n1,0,0,0,1.5,2.5\n1,9,50,0,1.0,2.0\n", encoding="utf-8"
    )
    meta = '[measurement]\ninstrument = "tool_tip"\nmachine = "turning-centre"\n[setup]\n'
    path.with_suffix(".toml").write_text(meta, encoding="utf-8")
    said = fault(path)
    assert "column 'reading_y_um' is missing" in said
    words = 'directions = ["X", "Z"]'
    assert f"with {words} in [setup] it reads no others" in said
    path.with_suffix(".toml").write_text(meta + words + "\n", encoding="utf-8")
    assert tuple(load_measurement(path, machine()).readings) == ("reading_x_um", "reading_z_um")
