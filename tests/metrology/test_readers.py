"""Readers of other programs' files.

Oracles: the published reports beside the real files; figures counted in the files with other means (grep, the README);
the layouts as their makers document them, written by hand here.
"""

import re
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtec.errors import MeasurementError
from rtec.metrology.readers import READERS, ForeignTable, SourceOptions, delimited, detect, read_tables
from rtec.metrology.readers.isg_csv import unit, write
from tests.support.real_data import real_file

ECMC = """TEST_DATA=# Input data file
# comments
UNIT=mm
CYCLES=2
POSITIONS=3
TGT_DATA[1]=0
TGT_DATA[2]=10
TGT_DATA[3]=20
""" + "".join(
    f"REF_DATA_{w}[{i},{j}]={10 * (i - 1) + 0.001 * (i + 10 * j + (0.5 if w == 'BWD' else 0)):.4f}\n"
    for w in ("FWD", "BWD")
    for j in (1, 2)
    for i in (1, 2, 3)
)
SCOPE = """Name;a scope;
File;C:\\x.csv;
Starttime of export;132900081483250000;Tuesday, February 22, 2022;13:55:48.325
Endtime of export;132900081936650000;Tuesday, February 22, 2022;13:56:33.665


Name;pos;vel
SymbolComment;Actual position;Actual velocity
Data-Type;REAL64;REAL64
SampleTime;10;10
Unit;mm;(None)


132900081483250000;1.5;0
132900081483350000;1.625;-2e-3
EOF
"""
JSON = '{"ts": 1.5, "bed": {"c": 20}, "list": [{"id": "A", "t": 1}, 7]}\n\n{"ts": 2.5, "z": -0.5, "name": "x"}\n'
ISG = """// Component errors of X
X  EXX  EAX  // at the end too
0.0   0.02  0.0042
10.0  -0.1  1e-5

#
Y0A C0Y
0.1 2e-5
"""
TABLE = "Pos [mm];T (°C);wann;nichts\n1;20,5;2026-01-01;\n2;21;2026-01-02;\n"
EXAMPLES = {"ecmc_iso230": ECMC, "twincat_scope": SCOPE, "json_lines": JSON, "isg_csv": ISG, "delimited": TABLE}


def put(folder: Path, content: str | bytes, name: str = "file.txt") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def one(path: Path, **source: Any) -> ForeignTable:
    _, tables = read_tables(path, SourceOptions(**source))
    assert len(tables) == 1
    return tables[0]


def fault(path: Path, **source: Any) -> str:
    with pytest.raises(MeasurementError) as caught:
        read_tables(path, SourceOptions(**source))
    return str(caught.value)


def test_every_reader_has_an_example_here() -> None:
    assert set(EXAMPLES) == set(READERS)


@pytest.mark.parametrize("name", EXAMPLES)
def test_each_reader_knows_its_own_files(tmp_path: Path, name: str) -> None:
    path = put(tmp_path, EXAMPLES[name])
    assert detect(path) == name
    found, tables = read_tables(path)
    assert found == name
    for table in tables:
        assert all(len(v) == len(table) for v in table.columns.values())
        assert set(table.units) <= set(table.columns)


@pytest.mark.parametrize("name", EXAMPLES)
@pytest.mark.parametrize("form", ["crlf", "bom", "utf-16"])
def test_each_reader_takes_the_usual_text_forms(tmp_path: Path, name: str, form: str) -> None:
    _, plain = read_tables(put(tmp_path, EXAMPLES[name]))
    text = EXAMPLES[name].replace("\n", "\r\n") if form == "crlf" else EXAMPLES[name]
    data = text.encode({"crlf": "utf-8", "bom": "utf-8-sig", "utf-16": "utf-16"}[form])
    found, tables = read_tables(put(tmp_path, data))
    assert found == name
    for a, b in zip(plain, tables, strict=True):
        assert list(a.columns) == list(b.columns)
        for k in a.columns:
            assert str(a.columns[k].tolist()) == str(b.columns[k].tolist())


def test_a_reader_that_is_not_there(tmp_path: Path) -> None:
    assert "did you mean 'json_lines'" in fault(put(tmp_path, JSON), reader="json_line")
    assert "no such file" in fault(tmp_path / "absent")


# --- ecmc


def test_ecmc_order_and_directions(tmp_path: Path) -> None:
    t = one(put(tmp_path, ECMC))
    assert t.columns["cycle"].tolist() == [1] * 6 + [2] * 6
    assert t.columns["position"].tolist() == [1, 2, 3, 3, 2, 1] * 2
    assert t.columns["direction"].tolist() == [1, 1, 1, -1, -1, -1] * 2
    assert t.columns["target"].tolist() == [0, 10, 20, 20, 10, 0] * 2
    assert np.allclose(t.numbers("deviation", "")[:6] * 1e3, [11, 12, 13, 13.5, 12.5, 11.5])
    assert t.units == {"target": "mm", "reference": "mm", "deviation": "mm"}
    assert ECMC.split("\n")[t.lines[0] - 1].startswith("REF_DATA_FWD[1,1]")


def test_ecmc_swapped_and_falling_targets(tmp_path: Path) -> None:
    t = one(put(tmp_path, ECMC), swap_directions=True)
    assert np.allclose(t.numbers("deviation", "")[:3] * 1e3, [11.5, 12.5, 13.5])
    falling = re.sub(r"TGT_DATA\[(\d)\]=.*", lambda m: f"TGT_DATA[{m[1]}]={30 - 10 * int(m[1])}", ECMC)
    assert one(put(tmp_path, falling)).columns["direction"].tolist()[:4] == [-1, -1, -1, 1]


def report(name: str, direction: str) -> list[list[float]]:
    """The table of one direction in a published report: [target, reading of cycle 1, …] for each position."""
    text = real_file("iso230_positioning", name).read_text(encoding="utf-8")
    part = text.split(f"### Data {direction} direction")[1].split("##")[0]
    rows = [line.strip("|").split("|") for line in part.splitlines() if re.match(r"\d+\|", line)]
    return [[float(c) for c in row[1:]] for row in rows]


@pytest.mark.parametrize(
    ("data", "published", "digits"),
    [
        ("b02-x_target_x.md_ISO230.dat", "b02-x_x_iso230_2_report.md", 5),
        ("muts-target_x_report_ILD50.md_ISO230.dat", "muts-target_x_report_ILD50.md", 5),
        ("ecmccomgui-example_data_ISO230_2.dat", "ecmccomgui-example_report_ISO230_2.md", 5),
        ("psi-fat_sat_report.md_ISO230.dat", "psi-fat_sat_report.md", 8),
    ],
)
def test_ecmc_real_files_are_the_published_numbers_with_directions_exchanged(
    data: str, published: str, digits: int
) -> None:
    t = one(real_file("iso230_positioning", data), swap_directions=True)
    for direction, sign in (("forward", 1.0), ("backward", -1.0)):
        rows = report(published, direction)
        assert len(rows) == t.numbers("position", "").max()
        for i, row in enumerate(rows, start=1):
            here = (t.columns["position"] == i) & (t.columns["direction"] == sign)
            assert set(t.columns["target"][here]) == {row[0]}
            assert np.allclose(t.numbers("reference", "")[here], row[1:], rtol=0, atol=0.51 * 10.0**-digits)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("TGT_DATA[2]=10", "TGT_DATA[2]=1o", "line 7: 'TGT_DATA[2]=1o' is no line of this format"),
        ("TGT_DATA[2]=10\n", "", "TGT_DATA[2] is missing"),
        ("TGT_DATA[2]=10", "TGT_DATA[1]=10", "line 7: TGT_DATA[1] is given twice"),
        ("TGT_DATA[2]=10", "TGT_DATA[2,1]=10", "line 7: 'TGT_DATA[2,1]=10': wrong index"),
        ("TGT_DATA[1]=0", "TGT_DATA[0]=0", "wrong index"),
        ("POSITIONS=3", "POSITIONS=4", "POSITIONS=4, and 3 are there"),
        ("CYCLES=2", "CYCLES=5", "CYCLES=5, and 2 are there"),
        ("UNIT=mm", "UNIT=furlong", "unit 'furlong' is not known"),
        ("REF_DATA_FWD[1,1]", "REF_DATA_FWD[4,1]", "readings for position 4, which has no TGT_DATA[4]"),
        ("REF_DATA_FWD[1,1]", "REF_DATA_FWD[1,999999]", "CYCLES=2, and 999999"),
    ],
)  # fmt: skip
def test_ecmc_faults(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert said in fault(put(tmp_path, ECMC.replace(old, new)), reader="ecmc_iso230")


def test_ecmc_missing_readings_are_kept_and_told(tmp_path: Path) -> None:
    lines = [line for line in ECMC.splitlines() if not line.startswith("REF_DATA_BWD[2,1]")]
    t = one(put(tmp_path, "\n".join(lines)))
    assert np.flatnonzero(np.isnan(t.numbers("reference", ""))).tolist() == [4]
    assert "1 of 12 readings are not in the file" in t.notes


# --- TwinCAT Scope


def test_twincat(tmp_path: Path) -> None:
    t = one(put(tmp_path, SCOPE))
    assert t.columns["time"].tolist() == [0.0, 0.01]
    assert t.columns["pos"].tolist() == [1.5, 1.625]
    assert t.columns["vel"].tolist() == [0.0, -0.002]
    assert t.units == {"time": "s", "pos": "mm"}
    assert t.lines.tolist() == [14, 15]
    # 13:55:48.325 local time in the file's own header is one hour east of Greenwich.
    assert "time 0 is 2022-02-22T12:55:48.325000+00:00" in t.notes


def test_twincat_milliseconds_tabs_and_decimal_commas(tmp_path: Path) -> None:
    text = SCOPE.replace("132900081483250000;1", "0;1").replace("132900081483350000;1", "10;1")
    t = one(put(tmp_path, text.replace(".", ",").replace(";", "\t")), decimal=",")
    assert t.columns["time"].tolist() == [0.0, 0.01]
    assert t.columns["pos"].tolist() == [1.5, 1.625]
    assert 'decimal = ","' in fault(put(tmp_path, text.replace(".", ",")))
    assert "line 14: pos: '1.5' is no number" in fault(put(tmp_path, text), decimal=",")


def test_twincat_with_a_time_for_each_channel(tmp_path: Path) -> None:
    text = SCOPE.replace("Name;pos;vel", "Name;pos;Name;vel").replace("Unit;mm;(None)", "Unit;mm;Unit;m/s")
    text = text.split("\n\n\n1329")[0] + "\n\n\n0;1.5;0;5\n10;1.625;5;6\n;;10;7\n"
    _, tables = read_tables(put(tmp_path, text))
    assert [t.columns["time"].tolist() for t in tables] == [[0.0, 0.01], [0.0, 0.005, 0.01]]
    assert tables[1].columns["vel"].tolist() == [5, 6, 7]
    assert tables[1].units["vel"] == "m/s"


def test_twincat_real_file() -> None:
    """Oracle: `grep -c '^1329'` counts 4535 rows; SampleTime 10 ms; the last row read with an editor."""
    t = one(real_file("resolver_cyclic", "ResolverCiclicError2.csv"))
    assert len(t) == 4535
    assert np.allclose(np.diff(t.numbers("time", "")), 0.01, atol=1e-9)
    assert t.columns["fActPosition (Resolver)"][-1] == -0.083107466477998784
    assert t.numbers("fActPosition (Internal Counter)", "").max() == pytest.approx(360, abs=1)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("1.625", "abc", "line 15: pos: 'abc' is no number"),
        ("132900081483350000;1.625;-2e-3", "132900081483350000", "line 15: has 1 values, its header 3"),
        ("132900081483350000;1", "12x;1", "line 15: '12x' is no FILETIME"),
        ("Name;pos;vel", "Nome;pos;vel", "no block of channels"),
        ("Name;pos;vel", "Name;;", "no channel has a name"),
        (SCOPE[SCOPE.index("1329", 250) :], "", "no values under the header"),
    ],
)
def test_twincat_faults(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert said in fault(put(tmp_path, SCOPE.replace(old, new)), reader="twincat_scope")


# --- JSON lines


def test_json_lines(tmp_path: Path) -> None:
    t = one(put(tmp_path, JSON))
    assert list(t.columns) == ["ts", "bed.c", "list.A.id", "list.A.t", "list.1", "z", "name"]
    assert t.columns["ts"].tolist() == [1.5, 2.5]
    assert np.array_equal(t.numbers("z", ""), [np.nan, -0.5], equal_nan=True)
    assert t.columns["name"].tolist() == ["", "x"]
    assert t.lines.tolist() == [1, 3]


@pytest.mark.parametrize("name", ["probe_accuracy_superpinda.json", "probe_accuracy_TL-Q5MC1-Z.json"])
def test_json_lines_real_files(name: str) -> None:
    """Oracle: lines counted as text."""
    path = real_file("probe_thermal", name)
    lines = path.read_text(encoding="utf-8").splitlines()
    t = one(path)
    assert len(t) == len(lines) == 1573
    assert np.isfinite(t.numbers("z", "")).sum() == sum('"z":' in line for line in lines)
    assert np.isfinite(t.numbers("atherms.C.temp", "")).sum() == sum('"atherms":' in line for line in lines)
    assert t.columns["ts"][0] == float(re.findall(r"[\d.]+", lines[0])[0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": 1}\n{"a": 2\n', "line 2: is no JSON"),
        ('{"a": 1}\n[1]\n', "line 2: holds list, not an object"),
        ("", "no lines"),
        ("{}\n", "hold nothing"),
        ('{"a": 1}\n' + '{"a": ' * 30 + "1" + "}" * 30, "line 2: nested more than 8 deep"),
        ('{"a": 1}\n' + "[" * 100_000, "line 2: is no JSON"),
    ],
)
def test_json_lines_faults(tmp_path: Path, text: str, said: str) -> None:
    assert said in fault(put(tmp_path, text), reader="json_lines")


def test_json_numbers_too_large_for_a_double_stay_text(tmp_path: Path) -> None:
    assert one(put(tmp_path, '{"a": 1' + "0" * 400 + "}")).columns["a"].dtype == object


# --- ISG / Beckhoff


def test_isg_blocks_names_and_units(tmp_path: Path) -> None:
    _, (first, second) = read_tables(put(tmp_path, ISG))
    assert {k: v.tolist() for k, v in first.columns.items()} == {
        "X": [0.0, 10.0],
        "EXX": [0.02, -0.1],
        "EAX": [0.0042, 1e-5],
    }
    assert first.units == {"X": "mm", "EXX": "mm", "EAX": "rad"}
    assert first.lines.tolist() == [3, 4]
    assert list(second.columns) == ["EY0A", "EC0Y"]  # position errors by their ISO 230-1 names
    assert second.units == {"EY0A": "mm", "EC0Y": "rad"}


def test_isg_documented_examples(tmp_path: Path) -> None:
    """The shape of the example on the maker's page on updating: three arguments, two component errors."""
    text = "X Y Z EXX EYY\n" + "".join(f"0 {5 * k} 0 {k / 1000:.3f} {k / 1000:.3f}\n" for k in range(9))
    path = put(tmp_path, text)
    assert detect(path) == "isg_csv"
    t = one(path)
    assert t.columns["Y"].tolist() == [5.0 * k for k in range(9)]
    assert t.columns["EYY"][8] == 0.008


NAMES = ["X", "Y", "C", "EXX", "EYX", "EZX", "EAX", "EBX", "ECX", "EC0Y", "EX0Z", "P0X", "PXA", "N0Z", "VXX"]


@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_isg_read_of_write_is_the_identity(tmp_path: Path, data: st.DataObject) -> None:
    tables = []
    for k in range(data.draw(st.integers(1, 3))):
        names = data.draw(st.lists(st.sampled_from(NAMES), min_size=1, unique=True))
        n = data.draw(st.integers(1, 4))
        values = st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=n, max_size=n)
        columns = {name: np.array(data.draw(values)) for name in names}
        tables.append(ForeignTable(f"block{k + 1}", columns, {m: unit(m) for m in names}, np.arange(n)))
    write(tables, tmp_path / "volcomp.csv")
    _, back = read_tables(tmp_path / "volcomp.csv", SourceOptions(reader="isg_csv"))
    assert len(back) == len(tables)
    for a, b in zip(tables, back, strict=True):
        assert list(a.columns) == list(b.columns)
        assert a.units == b.units
        assert all(a.columns[k].tobytes() == b.columns[k].tobytes() for k in a.columns)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("X  EXX", "X  EXQ", "line 2: 'EXQ' is no argument and no error parameter"),
        ("X  EXX", "X  X", "line 2: 'X' is given twice"),
        ("10.0  -0.1  1e-5", "10.0  -0.1", "line 4: has 2 values, its header 3"),
        ("10.0  -0.1  1e-5", "10.0  -0,1  1e-5", "line 4: '-0,1' is no number"),
        ("0.1 2e-5\n", "", "line 7: no rows under this header"),
        ("Y0A C0Y", ";", "line 8: '0.1' is no argument and no error parameter"),
    ],
)
def test_isg_faults(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert said in fault(put(tmp_path, ISG.replace(old, new)), reader="isg_csv")


@pytest.mark.parametrize(
    ("name", "unit_", "value", "said"),
    [
        ("EXX", "um", 1.0, "EXX is in 'um', this format wants mm"),
        ("EXQ", "mm", 1.0, "'EXQ' is no argument"),
        ("C0Y", "rad", 1.0, "'C0Y' is no argument"),
        ("EXX", "mm", np.nan, "not finite"),
    ],
)
def test_isg_writes_only_what_the_format_has(tmp_path: Path, name: str, unit_: str, value: float, said: str) -> None:
    table = ForeignTable("t", {name: np.array([value])}, {name: unit_}, np.arange(1))
    with pytest.raises(MeasurementError, match=re.escape(said)):
        write([table], tmp_path / "x.csv")


# --- any delimited text


def test_delimited_units_texts_and_numbers(tmp_path: Path) -> None:
    t = one(put(tmp_path, TABLE), decimal=",")
    assert t.columns["Pos [mm]"].tolist() == [1, 2]
    assert t.columns["T (°C)"].tolist() == [20.5, 21]
    assert t.columns["wann"].tolist() == ["2026-01-01", "2026-01-02"]
    assert np.isnan(t.numbers("nichts", "")).all()
    assert t.units == {"Pos [mm]": "mm", "T (°C)": "degc"}
    assert "cells are divided by ';', as it seems" in t.notes


def test_delimited_forms(tmp_path: Path) -> None:
    text = "made by hand\n\n# note\nx|y\nmm|µm\n# more\n 1.234.567,5 |+2\n-|3\n"
    t = one(put(tmp_path, text), skip_rows=1, comment="#", unit_row=True, decimal=",", thousands=".", missing=("-",))
    assert np.array_equal(t.numbers("x", ""), [1234567.5, np.nan], equal_nan=True)
    assert t.columns["y"].tolist() == [2, 3]
    assert t.units == {"x": "mm", "y": "um"}
    assert t.lines.tolist() == [7, 8]
    assert one(put(tmp_path, "1\t2\n3\t4\n"), header=False).columns["c2"].tolist() == [2, 4]


@pytest.mark.parametrize(
    ("cell", "source", "value"),
    [
        ("1.234", {}, 1.234),
        ("1,234", {"decimal": ","}, 1.234),
        ("1.234", {"decimal": ","}, None),  # one and a bit, or a thousand? not read
        ("1.234", {"decimal": ",", "thousands": "."}, 1234),
        ("-12.345.678,9", {"decimal": ",", "thousands": "."}, -12345678.9),
        ("1.234.567.890", {"decimal": ",", "thousands": "."}, 1234567890),
        ("1.2345", {"decimal": ",", "thousands": "."}, None),
        ("0.123", {"decimal": ",", "thousands": "."}, None),
        ("1 234.5", {"thousands": " "}, 1234.5),
        ("1,234", {"thousands": ","}, 1234),
        ("1,234", {}, None),
        ("1_000", {}, None),
        ("0x10", {}, None),
    ],
)
def test_marks_in_numbers_are_never_guessed(tmp_path: Path, cell: str, source: Any, value: float | None) -> None:
    t = one(put(tmp_path, f"a;b\n{cell};1\n"), reader="delimited", delimiter=";", **source)
    if value is not None:
        assert t.columns["a"].tolist() == [value]
        return
    with pytest.raises(MeasurementError, match="line 2: column 'a'") as caught:
        t.numbers("a", "file")
    assert ("decimal commas?" in str(caught.value)) == ("." in cell)


@pytest.mark.parametrize(
    ("text", "source", "said"),
    [
        ("", {}, "no rows"),
        ("a;b\n", {}, "no rows under the header"),
        ("a\nb\n", {"skip_rows": 9}, "no rows after the first 9"),
        ("a;a\n1;2\n", {}, "column 'a' is 2 times"),
        ("a;b\n1;2\n1;2;3\n4\n", {}, "line 3: has 3 cells, the header has 2"),
        ("a;b\n", {"unit_row": True}, "unit_row"),
        ('a;b\n1;"2\n3;4\n', {}, "quote"),
    ],
)
def test_delimited_faults(tmp_path: Path, text: str, source: Any, said: str) -> None:
    assert said in fault(put(tmp_path, text), reader="delimited", **source)


@pytest.mark.parametrize(
    ("cell", "way"),
    [
        ("1,5", 'decimal = ","'),
        ("1.234,5", "thousands"),
        ("12:30:00", 'unit = "iso"'),
        ("lost", 'missing = ["lost"]'),
    ],
)
def test_a_text_among_numbers_is_told_by_line_when_numbers_are_wanted(tmp_path: Path, cell: str, way: str) -> None:
    t = one(put(tmp_path, f"a;b\n1;2\n1;{cell}\n"))
    with pytest.raises(MeasurementError, match=r"file: line 3: column 'b'") as caught:
        t.numbers("b", "file")
    assert way in str(caught.value)


def test_real_delimited_file() -> None:
    """Oracle: the README's 60 s and 46 h; the value read with an editor."""
    t = one(real_file("spindle_thermal", "caiviac_spindle_thermal_15s_to_60s.csv"))
    assert len(t) == 2779
    assert t.columns["t16_C"][3] == 27.292


# --- Fuzz: tables or a MeasurementError, never another exception


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(sorted(READERS)), data=st.binary(max_size=300), started=st.booleans())
def test_random_bytes(tmp_path: Path, name: str, data: bytes, started: bool) -> None:
    path = put(tmp_path, EXAMPLES[name].encode() + data if started else data)
    for reader in (name, None):
        try:
            read_tables(path, SourceOptions(reader=reader))
        except MeasurementError as e:
            assert str(path) in str(e)  # noqa: PT017


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    name=st.sampled_from(sorted(READERS)),
    at=st.floats(0, 1, exclude_max=True),
    removed=st.integers(0, 4),
    new=st.one_of(
        st.text(max_size=3), st.sampled_from([";", ",", "\n", "Name", "#", "9" * 30, "[", "{", "e999", "\0", "-", '"'])
    ),
)
def test_mutated_files(tmp_path: Path, name: str, at: float, removed: int, new: str) -> None:
    text = EXAMPLES[name]
    i = int(at * len(text))
    path = tmp_path / "file.txt"
    path.write_bytes((text[:i] + new + text[i + removed :]).encode(errors="replace"))
    try:
        read_tables(path, SourceOptions(reader=name))
    except MeasurementError as e:
        assert str(path) in str(e)  # noqa: PT017


ODD = ("7", " 3 ", "+2", "1,5", "1.5", "", '""', "nan", "-nan", "NaN", "inf", "infinity", "1e999", "-7e-2", ".5", "5.",
       "0x10", "1_0", "−3", "n/a", "x", '"4"', "1.234,5", " ")  # fmt: skip


@pytest.mark.parametrize("decimal", [".", ","])
def test_numbers_come_out_alike_however_many_rows_there_are(
    tmp_path: Path, decimal: Literal[".", ","], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cells that are no plain numbers, behind many that are. Oracle: the way that looks at every cell."""
    for odd in ODD:
        lines = ["a;b;c", *(f"{k};{k}{decimal}5;{k}" for k in range(8)), f"8;{odd};n/a", "", " ", f"9;3{decimal}25;"]
        path = tmp_path / "t.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        source = SourceOptions(delimiter=";", decimal=decimal, missing=("n/a",))
        tables = []
        for few in (3, 1000):
            monkeypatch.setattr(delimited, "FEW", few)
            tables.append(delimited.read(path, source)[0])
        quick, slow = tables
        assert quick.wrong == slow.wrong
        assert quick.lines.tolist() == slow.lines.tolist() == [*range(2, 11), 13]
        for name in "abc":
            assert quick.columns[name].dtype == slow.columns[name].dtype
            np.testing.assert_array_equal(quick.columns[name], slow.columns[name])
