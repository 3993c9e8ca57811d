"""`rtec import`: maps, units, times, runs.

Oracles: conversions worked out by hand from the definitions of the units; tables written by hand; the README of the
real data.
"""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.files.toml import MeasurementFile
from rtec.metrology.importing import Imported, import_table, import_to_files, load_map, propose
from rtec.metrology.importing.map import ImportMap
from rtec.metrology.readers import READERS
from rtec.metrology.units import ALIASES, UNITS, canonical, convert, unit_of_column
from rtec.tomlfile import validated
from tests.support.real_data import real_file

ROOT = Path(__file__).parents[2]
MAPS = ROOT / "configs" / "maps"
TURNING = ROOT / "configs" / "machines" / "turning-centre.toml"
HEAD = {"instrument": "laser_linear", "axis": "X", "component": "EXX", "machine": "turning-centre"}
BASE: dict[str, Any] = {
    "measurement": HEAD,
    "setup": {"beam_offset_mm": [0.0, 150.0, 80.0]},
    "time": {"column": "t", "unit": "s"},
    "column": {"x_mm": {"from": "x", "unit": "mm"}, "reading_um": {"from": "e", "unit": "um"}},
}
TABLE = "t,x,e\n0,0,1\n1,10,2\n2,20,3\n3,10,4\n4,0,5\n"
GERMAN = """Laserprogramm 3.2
Bediener: Müller

Uhrzeit;Sollposition [mm];Z;Abweichung;Bett;Bemerkung
21.11.2026 08:00:00;0,0;0,3;1,5;68,0;Anfang
21.11.2026 08:00:05;100,0;0,3;-2,25;68,9;
21.11.2026 08:00:10;200,0;0,3;---;69,8;Strahl weg
21.11.2026 08:00:15;100,0;0,3;1.000,5;71,6;
21.11.2026 08:00:20;0,0;0,3;0,0;77,0;
"""


def put(folder: Path, content: str | bytes, name: str = "file.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def merged(base: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in more.items():
        out[key] = merged(out[key], value) if isinstance(value, dict) and isinstance(out.get(key), dict) else value
    return {k: v for k, v in out.items() if v is not None}


def a_map(folder: Path, **more: Any) -> Path:
    return put(folder, tomli_w.dumps(merged(BASE, more)), "map.toml")


def done(folder: Path, table: str = TABLE, **more: Any) -> Imported:
    return import_table(put(folder, table), load_map(a_map(folder, **more)))


def fault(folder: Path, table: str = TABLE, **more: Any) -> str:
    with pytest.raises(MeasurementError) as caught:
        done(folder, table, **more)
    return str(caught.value)


# --- units


@pytest.mark.parametrize(
    ("value", "unit", "target", "expected"),
    [
        (1.0, "inch", "mm", 25.4),
        (2.0, "m", "mm", 2000.0),
        (1.0, "inch", "um", 25400.0),
        (1500.0, "nm", "um", 1.5),
        (3.0, "µm", "mm", 0.003),
        (212.0, "°F", "degc", 100.0),
        (-40.0, "°F", "degc", -40.0),
        (293.15, "K", "degc", 20.0),
        (180.0, "deg", "urad", 3.141592653589793e6),
        (3600.0, "arcsec", "deg", 1.0),
        (1.0, "arcsec", "urad", 4.84813681109536),
        (1.0, "mrad", "urad", 1000.0),
        (0.02, "mm/m", "urad", 20.0),
        (90.0, "min", "s", 5400.0),
        (250.0, "ms", "s", 0.25),
        (6.0, "m/min", "mm/s", 100.0),
        (10.0, "mm/s", "mm/min", 600.0),
        (50.0, "Hz", "rpm", 3000.0),
        (1.0, "t", "kg", 1000.0),
    ],
)
def test_conversions(value: float, unit: str, target: str, expected: float) -> None:
    assert convert(np.array([value]), unit, target)[0] == pytest.approx(expected, rel=1e-12)


@given(st.sampled_from(sorted(UNITS)), st.sampled_from(sorted(UNITS)), st.floats(-1e6, 1e6))
def test_there_and_back(one: str, two: str, value: float) -> None:
    if UNITS[one].kind == UNITS[two].kind:
        back = convert(convert(np.array([value]), one, two), two, one)[0]
        assert back == pytest.approx(value, rel=1e-9, abs=1e-6)
    else:
        with pytest.raises(ValueError, match="is a unit of"):
            convert(np.array([value]), one, two)


def test_unit_names() -> None:
    assert all(alias.lower() == alias and unit in UNITS for alias, unit in ALIASES.items())
    assert canonical(" MM ") == "mm"
    with pytest.raises(ValueError, match="did you mean 'arcsec'"):
        canonical("arcsecs")
    names = {"x_mm": "mm", "vx_mm_s": "mm/s", "ax_mm_s2": "mm/s2", "feed_mm_min": "mm/min", "run": "1", "dir_x": "1"}
    names |= {"T_bed_degc": "degc", "spindle_rpm": "rpm", "reading_x_urad": "urad", "load_kg": "kg", "angle_deg": "deg"}
    assert {n: unit_of_column(n) for n in names} == names


# --- columns


def test_a_plain_table(tmp_path: Path) -> None:
    i = done(tmp_path)
    assert {k: v.tolist() for k, v in i.columns.items()} == {
        "run": [1] * 5,
        "time_s": [0, 1, 2, 3, 4],
        "x_mm": [0, 10, 20, 10, 0],
        "reading_um": [1, 2, 3, 4, 5],
    }
    assert (i.rows_in, i.rows_out, i.reader) == (5, 5, "delimited")
    assert "read as delimited, as it looks" in i.notes


def test_scale_sign_offset_minus_and_unit(tmp_path: Path) -> None:
    """value = sign · scale · (from - minus), converted, plus offset: -2 · (e - x) mm = -2000 · (e - x) µm, + 7."""
    how = {"from": "e", "minus": "x", "unit": "mm", "scale": 2.0, "sign": -1, "offset": 7.0}
    i = done(tmp_path, column={"reading_um": how})
    assert np.allclose(
        i.columns["reading_um"], [-2000 * (e - x) + 7 for e, x in zip(range(1, 6), [0, 10, 20, 10, 0], strict=True)]
    )
    assert "reading_um from 'e' minus 'x' × -2, mm to um + 7" in i.notes


def test_words_codes_and_held_values(tmp_path: Path) -> None:
    table = "t,x,e,side,T\n0,0,1,fwd,20\n1,10,999,fwd,\n2,20,3,bwd,\n3,10,4,,21\n"
    more = {
        "reading_um": {"from": "e", "unit": "um", "missing_codes": [999.0]},
        "dir_x": {"from": "side", "values": {"fwd": 1.0, "bwd": -1.0}},
        "T_bed_degc": {"from": "T", "unit": "degc", "fill": "hold"},
    }
    i = done(tmp_path, table, column=more)
    assert np.array_equal(i.columns["reading_um"], [1, np.nan, 3, 4], equal_nan=True)
    assert np.array_equal(i.columns["dir_x"], [1, 1, -1, np.nan], equal_nan=True)
    assert i.columns["T_bed_degc"].tolist() == [20, 20, 20, 21]
    assert "column 'T': last value held in 2 rows" in i.notes
    assert "reading_um: 999 taken as missing in 1 rows" in i.notes
    wrong = {**more, "dir_x": {"from": "side", "values": {"fwd": 1.0, "bwdd": -1.0}}}
    assert "line 4: column 'side': 'bwd' has no meaning in values; did you mean 'bwdd'" in fault(
        tmp_path, table, column=wrong
    )


def test_rows_without_a_value_are_left_out_only_on_wish(tmp_path: Path) -> None:
    table = "t,x,e,T\n0,0,,20\n1,10,2,\n2,20,3,\n3,10,,21\n4,0,5,\n"
    column = {"T_bed_degc": {"from": "T", "unit": "degc", "fill": "hold"}}
    i = done(tmp_path, table, column=column, rows={"require": ["e"]})
    assert (i.rows_in, i.rows_out) == (5, 3)
    assert i.columns["T_bed_degc"].tolist() == [20, 20, 21]
    assert "2 rows without e left out" in i.notes
    assert "no row remains" in fault(tmp_path, "t,x,e,T\n0,0,,1\n", column=column, rows={"require": ["e"]})


def test_the_unit_that_the_file_tells_is_used_and_not_contradicted(tmp_path: Path) -> None:
    table = TABLE.replace("x,e", "x [inch],e")
    assert done(tmp_path, table, column={"x_mm": {"from": "x [inch]", "unit": None}}).columns["x_mm"][1] == 254.0
    wrong = fault(tmp_path, table, column={"x_mm": {"from": "x [inch]", "unit": "m"}})
    assert "unit = 'm', but the file says that 'x [inch]' is in inch" in wrong


# --- time


@pytest.mark.parametrize(
    ("cells", "time", "expected"),
    [
        (["0", "500", "2000"], {"unit": "ms"}, [0, 0.5, 2]),
        (["1", "2", "3"], {"unit": "h"}, [0, 3600, 7200]),
        (["5", "6", "8"], {"unit": "s", "from_zero": False}, [5, 6, 8]),
        (["132900081483250000", "132900081483350000", "132900081493250000"], {"unit": "filetime"}, [0, 0.01, 1]),
        (["46000.5", "46000.75", "46001"], {"unit": "excel"}, [0, 21600, 43200]),
        (["2026-11-21T08:00:00", "2026-11-21 08:00:00.5", "2026-11-22T08:00"], {"unit": "iso"}, [0, 0.5, 86400]),
        (["2026-11-21T08:00:00+01:00", "2026-11-21T07:00:01Z", "2026-11-21T07:00:02Z"], {"unit": "iso"}, [0, 1, 2]),
        (["21.11.26 08:00", "21.11.26 08:01", "22.11.26 08:00"], {"format": "%d.%m.%y %H:%M"}, [0, 60, 86400]),
    ],
)
def test_times(tmp_path: Path, cells: list[str], time: Any, expected: list[float]) -> None:
    table = "t,x,e\n" + "".join(f"{c},0,1\n" for c in cells)
    i = done(tmp_path, table, time={"unit": None, **time})
    assert np.allclose(i.columns["time_s"], expected, rtol=0, atol=2e-6)


def test_a_file_without_time(tmp_path: Path) -> None:
    i = done(tmp_path, time={"column": None, "unit": None, "step_s": 0.5})
    assert i.columns["time_s"].tolist() == [0, 0.5, 1, 1.5, 2]
    assert "the file has no time: its rows are taken as 0.5 s apart" in i.notes


def test_a_clock_that_starts_again(tmp_path: Path) -> None:
    table = "t,x,e\n5,0,1\n6,10,2\n5,0,3\n7,10,4\n"
    assert "line 4: time falls from 6 to 5 s" in fault(tmp_path, table)
    assert "restarts = true" in fault(tmp_path, table)
    i = done(tmp_path, table, time={"restarts": True, "restart_gap_s": 10.0})
    assert i.columns["time_s"].tolist() == [0, 1, 11, 13]
    assert i.columns["run"].tolist() == [1, 1, 2, 2]
    assert "the clock starts again 1 times; 10 s are put between" in i.notes


# --- runs


@pytest.mark.parametrize(
    ("run", "expected"),
    [
        ({}, [1, 1, 1, 1, 1, 1]),
        ({"direction_of": "x_mm"}, [1, 1, 1, 2, 2, 2]),
        ({"direction_of": "x_mm", "dead_band_mm": 15.0}, [1, 1, 1, 1, 2, 2]),
        ({"gap_s": 1.5}, [1, 1, 2, 2, 2, 2]),
        ({"jump_mm": 50.0}, [1, 1, 1, 1, 1, 2]),
        ({"gap_s": 1.5, "jump_mm": 50.0}, [1, 1, 2, 2, 2, 3]),
        ({"column": "n"}, [3, 3, 3, 1, 1, 2]),
    ],
)
def test_runs(tmp_path: Path, run: Any, expected: list[int]) -> None:
    table = "t,x,e,n\n0,0,1,3\n1,10,1,3\n3,20,1,3\n4,10,1,1\n5,0,1,1\n6,-100,1,2\n"
    assert done(tmp_path, table, run=run).columns["run"].tolist() == expected


def test_run_numbers_are_integers(tmp_path: Path) -> None:
    table = "t,x,e,n\n0,0,1,1\n1,10,1,1.5\n"
    assert "line 3: column 'n': 1.5 is no run number" in fault(tmp_path, table, run={"column": "n"})
    table = "t,x,e,n\n0,0,1,1\n1,10,1,\n"
    assert "line 3: column 'n'" in fault(tmp_path, table, run={"column": "n"})


# --- a map that is wrong


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"colum": {}}, "unknown key 'colum'; did you mean 'column'"),
        ({"column": {"x_mm": {"frm": "x"}}}, "[column.x_mm] unknown key 'frm'; did you mean 'from'"),
        ({"column": {"x_mm": {"from": None}}}, "give either from, a column of the file, or value"),
        ({"column": {"x_mm": {"value": 1.0}}}, "give either from, a column of the file, or value"),
        ({"column": {"z_mm": {"value": 1.0, "scale": 2.0}}}, "value stands alone, or with unit; scale belongs to from"),
        ({"column": {"z_mm": {"value": 1.0, "unit": "s"}}}, "[column.z_mm] s is a unit of time, mm of length"),
        ({"column": {"reading_um": {"from": None, "unit": None, "value": 1.0}}}, "a reading comes from a column"),
        ({"column": {"x_mm": {"from": "y"}}}, "there is no column 'y'"),
        ({"column": {"x_mm": {"unit": "parsec"}}}, "unit 'parsec' is not known"),
        ({"column": {"x_mm": {"unit": "s"}}}, "[column.x_mm] s is a unit of time, mm of length"),
        ({"column": {"x_mm": {"unit": None}}}, "[column.x_mm] nobody tells the unit of 'x'; say unit"),
        ({"column": {"x_mm": {"sign": 2}}}, "sign"),
        ({"column": {"x_mm": {"scale": 0}}}, "scale: must not be 0"),
        ({"column": {"x_mm": {"fill": "zero"}}}, "fill"),
        ({"column": {"reading_um": {"minus": "q"}}}, "there is no column 'q'"),
        ({"column": {"reading_um": None}}, "no reading"),
        ({"column": {"x_um": {"from": "x"}}}, "'x_um' is no column of a measurement"),
        ({"column": {"time_s": {"from": "t"}}}, "time_s has a table of its own, [time]"),
        ({"column": {"run": {"from": "t"}}}, "run has a table of its own, [run]"),
        ({"column": {"T_a_degc": {"from": "x", "minus": "t", "unit": "degf"}}}, "a difference of temperatures"),
        ({"time": {"column": None}}, "give either column or step_s"),
        ({"time": {"step_s": 1.0}}, "give either column or step_s"),
        ({"time": {"format": "%H"}}, "give unit or format, not both"),
        ({"time": {"unit": "mm"}}, "unit 'mm' is no unit of time"),
        ({"time": {"unit": None}}, "the file tells no unit"),
        ({"time": {"column": "tt"}}, "there is no column 'tt'; did you mean 't'"),
        ({"time": {"unit": "iso"}}, "line 2: column 't': '0.0' is no time"),
        ({"time": {"unit": None, "format": "%H:%M"}}, "line 2: column 't'"),
        ({"time": {"column": None, "unit": None, "step_s": 1.0, "restarts": True}}, "step_s stands alone"),
        ({"run": {"column": "t", "gap_s": 1.0}}, "not both"),
        ({"run": {"direction_of": "z_mm"}}, "direction_of = 'z_mm' is no position"),
        ({"run": {"gap_s": -1.0}}, "gap_s"),
        ({"rows": {"require": ["q"]}}, "there is no column 'q'"),
        ({"source": {"reader": "excel"}}, "there is no reader 'excel'"),
        ({"source": {"table": "block2"}}, "table 'block2' is not there"),
        ({"source": {"encoding": "ebcdic"}}, "encoding"),
        ({"measurement": {"machine": None}}, "key 'machine' is missing"),
        ({"measurement": {"instrment": "x"}}, "unknown key 'instrment'; did you mean 'instrument'"),
    ],
)
def test_a_wrong_map_is_told(tmp_path: Path, more: Any, said: str) -> None:
    message = fault(tmp_path, **more)
    assert said in message
    assert str(tmp_path) in message


def test_a_map_that_is_no_map(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="not valid TOML"):
        load_map(put(tmp_path, "[time\n", "map.toml"))
    with pytest.raises(MeasurementError, match="no such file"):
        load_map(tmp_path / "absent.toml")


def test_all_faults_of_the_columns_are_told_at_once(tmp_path: Path) -> None:
    message = fault(tmp_path, column={"x_mm": {"from": "y"}, "reading_um": {"from": "f"}})
    assert len(message.splitlines()) == 2


def test_which_of_several_tables_is_asked(tmp_path: Path) -> None:
    text = "X EXX\n0 0.001\n10 0.002\n#\nY EYY\n0 0.003\n"
    column = {"x_mm": {"from": "X"}, "reading_um": {"from": "EXX", "unit": None}}
    time = {"column": None, "unit": None, "step_s": 1.0}
    assert "say [source] table = one of block1, block2" in fault(tmp_path, text, column=column, time=time)
    i = done(tmp_path, text, column=column, time=time, source={"table": "block1"})
    assert np.allclose(i.columns["reading_um"], [1.0, 2.0])


# --- the command


def test_the_shipped_laser_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: by hand: 68 °F = 20 °C, 77 °F = 25 °C, Z 0.3 m = 300 mm, reading with the sign turned, a run each way."""
    file = put(tmp_path, GERMAN.encode("latin-1"))
    arguments = ["import", str(file), "--map", str(MAPS / "laser-decimal-comma.toml"), "-o", str(tmp_path / "laser-x")]
    assert status([*arguments, "--machine", str(TURNING), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    m = load_measurement(tmp_path / "laser-x", load_machine(TURNING))
    assert m.run.tolist() == [1, 1, 1, 2, 2]
    assert m.time_s.tolist() == [0, 5, 10, 15, 20]
    assert m.channels["x"].tolist() == [0, 100, 200, 100, 0]
    assert m.channels["z"].tolist() == [300.0] * 5
    assert np.array_equal(m.readings["reading_um"], [-1.5, 2.25, np.nan, -1000.5, 0.0], equal_nan=True)
    assert np.allclose(m.channels["T_bed"], [20, 20.5, 21, 22, 25])
    assert facts["rows_in"] == facts["rows_out"] == 5
    assert facts["checked"]
    assert facts["sha256"] == m.sha256
    assert "imported from file.csv" in m.notes
    assert "columns of the file not used: Bemerkung (no numbers: 'Anfang')" in m.notes
    assert "reading_um: 1 of 5 readings missing (line 4)" in m.notes


def test_the_shipped_ecmc_map_on_real_data(tmp_path: Path) -> None:
    """Oracle: the largest reversal of this test as published, B = 0.03358 mm."""
    file = real_file("iso230_positioning", "b02-x_target_x.md_ISO230.dat")
    i = import_to_files(file, load_map(MAPS / "ecmc-iso230.toml"), tmp_path / "b02")
    assert i.table == tmp_path / "b02.csv"
    x, side, e = (i.columns[c] for c in ("x_mm", "dir_x", "reading_um"))
    gaps = [e[(x == t) & (side == 1)].mean() - e[(x == t) & (side == -1)].mean() for t in np.unique(x)]
    assert np.max(np.abs(gaps)) == pytest.approx(33.58, abs=0.01)
    assert i.columns["run"].max() == 5


def test_real_json_lines_with_slow_temperatures() -> None:
    """Oracle: the lines of the file taken apart here by hand."""
    file = real_file("probe_thermal", "probe_accuracy_superpinda.json")
    column = {
        "x_mm": None,
        "reading_um": {"from": "z", "unit": "mm"},
        "T_bed_degc": {"from": "btemp", "unit": "degc", "fill": "hold"},
    }
    how = merged(BASE, {"time": {"column": "ts"}, "column": column, "rows": {"require": ["z"]}})
    i = import_table(file, ImportMap.model_validate(how))
    z, t, last = [], [], float("nan")
    for line in file.read_text(encoding="utf-8").splitlines():
        found = json.loads(line)
        last = found.get("btemp", last)
        if "z" in found:
            z.append(found["z"] * 1000)
            t.append(last)
    assert i.rows_out == len(z)
    assert np.allclose(i.columns["reading_um"], z)
    assert i.columns["T_bed_degc"].tolist() == t


def test_real_scope_recording() -> None:
    file = real_file("resolver_cyclic", "ResolverCiclicError2.csv")
    how = merged(
        BASE,
        {
            "measurement": {"component": "ECX"},
            "time": {"column": "time", "unit": None},
            "column": {
                "x_mm": None,
                "angle_deg": {"from": "fActPosition (Internal Counter)", "unit": "deg"},
                "reading_um": None,
                "reading_urad": {
                    "from": "fActPosition (Resolver)",
                    "minus": "fActPosition (Internal Counter)",
                    "unit": "deg",
                },
            },
        },
    )
    i = import_table(file, ImportMap.model_validate(how))
    assert i.rows_out == 4535
    assert i.columns["reading_urad"][0] == pytest.approx(-0.07104400728496757 * np.pi / 180 * 1e6)


def test_the_command_tells_what_it_did(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["import", str(put(tmp_path, TABLE)), "--map", str(a_map(tmp_path)), "-o", str(tmp_path / "out")]
    assert status(arguments) == 0
    said = capsys.readouterr().out
    assert "5 rows in, 5 rows out" in said
    assert "x_mm from 'x'" in said
    assert "not checked against a machine" in said
    assert status(arguments) == 2
    assert "--force" in capsys.readouterr().err
    assert status([*arguments, "--force"]) == 0


def test_what_is_imported_is_never_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its own name is the first one that comes to mind. Oracle: the bytes of the file."""
    table = put(tmp_path, TABLE).rename(tmp_path / "dial.csv")
    before = table.read_bytes()
    words = ["import", str(table), "--map", str(a_map(tmp_path)), "-o", str(tmp_path / "dial"), "--force"]
    assert status(words) == 2
    assert "dial.csv: is imported here and must not be written over; give another name by -o" in capsys.readouterr().err
    assert table.read_bytes() == before


def test_the_command_checks_against_a_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = (
        TABLE.replace("t,x,e", "t,x,e,T").replace("\n", ",1372\n").replace("T,1372", "T").replace(",1372\n", ",20\n", 2)
    )
    more = {"T_bed_degc": {"from": "T", "unit": "degc"}}
    start = ["import", str(put(tmp_path, table)), "--map", str(a_map(tmp_path, column=more)), "--machine", str(TURNING)]
    assert status([*start, "-o", str(tmp_path / "one")]) == 2
    said = capsys.readouterr().err
    assert "one.csv: line 4: T_bed_degc is 1372: an open type K" in said
    assert "Traceback" not in said
    assert status([*start, "-o", str(tmp_path / "two"), "--missing-code", "1372", "--drop-bad-rows", "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert any("3 of 5 rows left out" in n for n in notes)
    assert len(load_measurement(tmp_path / "two.csv", load_machine(TURNING))) == 2


def test_a_word_as_missing_code(tmp_path: Path) -> None:
    table = TABLE.replace(",3\n", ",lost\n", 1)
    start = ["import", str(put(tmp_path, table)), "--map", str(a_map(tmp_path)), "-o", str(tmp_path / "out.parquet")]
    assert status(start) == 2
    assert status([*start, "--missing-code", "lost", "--machine", str(TURNING)]) == 0
    m = load_measurement(tmp_path / "out.parquet", load_machine(TURNING))
    assert np.flatnonzero(np.isnan(m.readings["reading_um"])).tolist() == [2]


@pytest.mark.parametrize("code", ["NaN", "nan", "inf"])
@pytest.mark.parametrize("cell", ["NaN", ""])
def test_what_is_no_number_is_missing_by_itself(code: str, cell: str, tmp_path: Path) -> None:
    """Oracle: the same import without the option."""
    table = TABLE.replace(",3\n", f",{cell}\n", 1)
    start = ["import", str(put(tmp_path, table)), "--map", str(a_map(tmp_path)), "--machine", str(TURNING)]
    assert status([*start, "-o", str(tmp_path / "plain")]) == 0
    assert status([*start, "-o", str(tmp_path / "coded"), "--missing-code", code]) == 0
    for suffix in (".csv", ".toml"):
        one, other = ((tmp_path / name).with_suffix(suffix).read_text() for name in ("plain", "coded"))
        assert one == other


def test_nan_as_a_code_in_a_map_does_nothing(tmp_path: Path) -> None:
    """Oracle: the same map without it."""
    file = put(tmp_path, TABLE.replace(",3\n", ",NaN\n", 1))
    plain = {"reading_um": {"from": "e", "unit": "um"}}
    coded = {"reading_um": {"from": "e", "unit": "um", "missing_codes": [float("nan")]}}
    one, other = (import_table(file, load_map(a_map(tmp_path, column=c))) for c in (plain, coded))
    np.testing.assert_array_equal(one.columns["reading_um"], other.columns["reading_um"])
    assert one.notes == other.notes


def test_the_last_line_tells_how_many_rows_are_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: three of five rows have no temperature."""
    table = TABLE.replace("t,x,e", "t,x,e,T").replace("\n", ",\n").replace("T,\n", "T\n").replace(",\n", ",20\n", 2)
    more = {"T_bed_degc": {"from": "T", "unit": "degc"}}
    start = ["import", str(put(tmp_path, table)), "--map", str(a_map(tmp_path, column=more)), "-o", str(tmp_path / "o")]
    assert status([*start, "--machine", str(TURNING), "--drop-bad-rows"]) == 0
    said = capsys.readouterr().out
    assert "3 of 5 rows left out in all" in said
    assert said.splitlines()[-1] == f"5 rows in, 5 rows out, 2 of them used: {tmp_path / 'o.csv'} and o.toml"


def test_list_names_every_reader(capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["import", "--list"]) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in READERS)
    assert status(["import", "--list", "--json"]) == 0
    assert [r["name"] for r in json.loads(capsys.readouterr().out)] == list(READERS)


def test_without_a_map_a_map_to_begin_with_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the shown map is read back and used."""
    file = put(tmp_path, TABLE)
    answers = ["--answer", "machine=turning-centre", "--answer", "reading=e", "--answer", "unit of e=um"]
    assert status(["import", str(file), *answers]) == 0
    shown = capsys.readouterr().out
    assert "read as delimited" in shown
    how = load_map(put(tmp_path, shown, "shown.toml"))
    assert how.time.column == "t"
    assert how.column["reading_um"].from_ == "e"
    assert status(["import", str(file), "--json"]) == 0
    assert [c["name"] for c in json.loads(capsys.readouterr().out)["columns"]] == ["t", "x", "e"]


def test_a_map_of_source_alone_shows_a_file_that_is_not_plain(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the file, written in Latin-1 with decimal commas and a line before the header, and the map shown."""
    text = "Messung 7\nZeit;Weg [mm];Größe [µm]\n0;0,5;1,5\n1;1,5;2,5\n"
    file = put(tmp_path, text.encode("latin-1"))
    told = put(tmp_path, '[source]\nencoding = "latin-1"\ndecimal = ","\nskip_rows = 1\n', "source.toml")
    answers = ["--answer", "machine=turning-centre", "--answer", "axis=X"]
    assert status(["import", str(file), "--map", str(told), *answers]) == 0
    shown = capsys.readouterr().out
    assert "Größe [µm]" in shown
    how = load_map(put(tmp_path, shown, "shown.toml"))
    assert (how.source.encoding, how.source.decimal, how.source.skip_rows) == ("latin-1", ",", 1)
    assert status(["import", str(file), "--map", str(put(tmp_path, "[source]\nskip = 1\n", "wrong.toml"))]) == 2
    assert "unknown key 'skip'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [["import"], ["import", "absent.csv"], ["import", "a.csv", "-o", "b"], ["import", "a.csv", "--map", "m.toml"]],
)
def test_wrong_use(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert status(arguments) == 2
    assert capsys.readouterr().err


def test_another_reader_may_be_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = put(tmp_path, '{"a": 1}\n')
    assert status(["import", str(file), "--as", "delimited", "--json"]) == 2  # a header, and nothing under it
    assert status(["import", str(file), "--as", "jsonlines"]) == 2
    assert "did you mean 'json_lines'" in capsys.readouterr().err


@pytest.mark.parametrize("path", sorted(MAPS.glob("*.toml")), ids=lambda p: p.stem)
def test_every_shipped_map_is_read(path: Path) -> None:
    assert load_map(path).column


def test_the_examples_in_the_documentation_are_read() -> None:
    blocks = re.findall(
        r"```toml\n(.*?)```", (ROOT / "docs" / "measurements.md").read_text(encoding="utf-8"), re.DOTALL
    )
    beside, how = (tomllib.loads(b) for b in blocks)
    assert validated(MeasurementFile, beside, "documentation").table.decimal == ","
    assert validated(ImportMap, how, "documentation").run.direction_of == "x_mm"


# --- Fuzz


MAP_TEXT = tomli_w.dumps(BASE)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    map_at=st.integers(0, len(MAP_TEXT) - 1),
    map_new=st.text(max_size=2),
    at=st.integers(0, len(TABLE) - 1),
    new=st.one_of(st.text(max_size=2), st.sampled_from(["\n", ",", "1e999", "-", "nan"])),
)
def test_mutated_maps_and_tables(tmp_path: Path, map_at: int, map_new: str, at: int, new: str) -> None:
    text = MAP_TEXT[:map_at] + map_new + MAP_TEXT[map_at + 1 :]
    file = put(tmp_path, (TABLE[:at] + new + TABLE[at + 1 :]).encode(errors="replace"))
    how = put(tmp_path, text.encode(errors="replace"), "map.toml")
    try:
        import_to_files(file, load_map(how), tmp_path / "out", load_machine(TURNING), force=True)
    except MeasurementError as e:
        assert str(tmp_path) in str(e)  # noqa: PT017


def test_a_shown_map_holds_odd_names(tmp_path: Path) -> None:
    """Oracle: the TOML parser."""
    p = propose(put(tmp_path, 'a "b" \\c,d\n1,2\n'), None, {}, {"reading": "d", "unit of d": "um", "machine": "m",
                "instrument": "tool_tip"})  # fmt: skip
    assert load_map(put(tmp_path, p.toml(), "m.toml")).column
    assert 'a "b" \\c' in p.toml()
