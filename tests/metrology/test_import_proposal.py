"""`rtec import` without a map: what it concludes from a file, what it asks, and what it never makes up.

Oracles: one measurement written in five ways must come back as the same numbers; the law that made it must be named by
the diagnosis; tables written by hand; the README of the real data.
"""

import re
import tomllib
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import (
    Imported,
    ImportProposal,
    import_measurement,
    import_table,
    import_to_files,
    load_map,
    propose,
)
from rtec.metrology.importing.rows import condition
from rtec.metrology.importing.words import sign_said
from tests.support.foreign_tables import ANSWERS, BEGAN, WRITTEN, Row, comma, date_and_time, rows, semicolons
from tests.support.real_data import real_file

ROOT = Path(__file__).parents[2]
TURNING = ROOT / "configs" / "machines" / "turning-centre.toml"
MACHINE = load_machine(TURNING)


@pytest.mark.parametrize("way", list(WRITTEN))
def test_five_foreign_tables_are_one_command_away(way: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the numbers that were written, in five ways of writing; and that the map that is kept does it again."""
    file, data = put(tmp_path, WRITTEN[way](rows()), "foreign.txt"), rows()
    answers = [x for a in ANSWERS.get(way, []) for x in ("--answer", a)]
    out = ["-o", str(tmp_path / "laser-x")]
    assert status(["import", str(file), "--machine", str(TURNING), *answers, *out]) == 0
    said = capsys.readouterr().out
    assert "66 rows out" in said
    assert "Which instrument took the readings? laser_linear" in said  # assumed, and so said
    m = load_measurement(tmp_path / "laser-x.csv", MACHINE)
    t, x, e, nut = (np.array(v) for v in zip(*data, strict=True))
    np.testing.assert_array_equal(m.time_s, t)
    np.testing.assert_array_equal(m.channels["x"], x)
    np.testing.assert_allclose(m.readings["reading_um"], e, atol=1e-8)
    np.testing.assert_allclose(m.channels["T_x_nut"], nut, atol=1e-3 if way == "date_and_time" else 1e-12)
    assert m.run.tolist() == [1 + i // 11 for i in range(66)]
    again = import_table(file, load_map(tmp_path / "laser-x-map.toml"))
    np.testing.assert_array_equal(again.columns["reading_um"], m.readings["reading_um"])


def test_a_wrong_set_up_is_refused_where_it_is_answered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The third number of an offset is forgotten. Nothing is written, so that the corrected answer goes through."""
    file = put(tmp_path, WRITTEN["semicolons"](rows()), "foreign.txt")
    given = [x for a in ANSWERS.get("semicolons", []) for x in ("--answer", a)]
    words = ["import", str(file), "--machine", str(TURNING), *given, "-o", str(tmp_path / "laser-x")]
    assert status([*words, "--answer", "setup.beam_offset_mm=[0, 180]"]) == 2
    assert "foreign.txt: [setup]: beam_offset_mm: has 2 values, and 3 are needed" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["foreign.txt"]
    assert status([*words, "--answer", "setup.beam_offset_mm=[0, 180, 0]"]) == 0


def test_an_import_that_fails_its_check_leaves_what_was_there(tmp_path: Path) -> None:
    """A map with a set-up that cannot be; by `--force` over a good measurement. Oracle: the folder's files before."""
    file = put(tmp_path, WRITTEN["semicolons"](rows()), "foreign.txt")
    given = [x for a in ANSWERS.get("semicolons", []) for x in ("--answer", a)]
    out = tmp_path / "laser-x"
    assert status(["import", str(file), "--machine", str(TURNING), *given, "-o", str(out)]) == 0
    how = load_map(tmp_path / "laser-x-map.toml")
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    wrong = how.model_copy(update={"setup": {"beam_offset_mm": [0.0, 180.0]}})
    for name, force in (("laser-x", True), ("other", False)):
        with pytest.raises(MeasurementError) as refused:
            import_to_files(file, wrong, tmp_path / name, MACHINE, force=force)
        assert str(refused.value).startswith(f"{tmp_path / name}.toml: [setup]: beam_offset_mm: has 2 values")
        assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before
    with pytest.raises(MeasurementError, match=r"^foreign\.toml: \[setup\]: beam_offset_mm"):
        import_measurement(file, wrong, MACHINE)


def excel(data: list[Row]) -> str:
    """A title, names, units with gaps, an empty column, a remark, and a last line that is no row."""
    out = ["Positioniermessung X;;;;;;", "Datum;Uhrzeit;Sollposition;;Abweichung;Mutter;Bemerkung", ";;mm;;µm;°C;"]
    for i, (t, x, e, nut) in enumerate(data):
        when, mark = BEGAN + timedelta(seconds=t), "Tür offen" if i == 5 else ""
        out.append(f"{when:%d.%m.%Y;%H:%M:%S};{comma(x)};;{comma(e)};{comma(nut)};{mark}")
    return "\ufeff" + "\r\n".join([*out, "", "Ende der Messung;;;;;;"]) + "\r\n"


def in_um(data: list[Row]) -> str:
    """Nominal and actual position in µm, with points between thousands."""
    out = ["Zeit in s;Soll in µm;Ist in µm;Mutter in °C"]
    for t, x, e, nut in data:
        places = (f"{v:,.3f}".translate(str.maketrans(",.", ".,")) for v in (1000.0 * x, 1000.0 * x + e))
        out.append(";".join([comma(t), *places, comma(nut)]))
    return "\n".join(out)


@pytest.mark.parametrize("written", [excel, in_um])
def test_tables_of_german_offices(written: Callable[[list[Row]], str], tmp_path: Path) -> None:
    """Oracle: the numbers that were written."""
    file, data = put(tmp_path, written(rows())), rows()
    nut = next(q.key for q in propose(file, MACHINE).questions if q.key.startswith("sensor of"))
    proposal = propose(file, MACHINE, {}, {"axis": "X", nut: "T_x_nut", "instrument": "laser_linear"})
    columns = import_table(file, proposal.import_map()).columns
    t, x, e, degc = (np.array(v) for v in zip(*data, strict=True))
    np.testing.assert_array_equal(columns["time_s"], t)
    for name, values, within in (("x_mm", x, 1e-12), ("reading_um", e, 1e-8), ("T_x_nut_degc", degc, 1e-12)):
        np.testing.assert_allclose(np.asarray(columns[name]), values, atol=within)


def put(folder: Path, content: str | bytes, name: str = "file.csv") -> Path:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def proposed(folder: Path, content: str | bytes, answers: Mapping[str, str] | None = None) -> ImportProposal:
    return propose(put(folder, content), MACHINE, {}, answers)


# --- how a file is written

BODY = "".join(f"{i};{i * 0.5:.1f}\n" for i in range(8))


@pytest.mark.parametrize(
    ("text", "source"),
    [
        ("t;e\n" + BODY, {"delimiter": ";"}),
        ("t;e\n" + BODY.replace(".", ","), {"delimiter": ";", "decimal": ","}),
        ("t\te\n" + BODY.replace(";", "\t"), {"delimiter": "\t"}),
        ("t|e\n" + BODY.replace(";", "|"), {"delimiter": "|"}),
        ("t  e\n" + BODY.replace(";", "   "), {"delimiter": " "}),
        (BODY, {"delimiter": ";", "header": False}),
        ("made by X\n\nt;e\n" + BODY, {"delimiter": ";", "skip_rows": 2}),
        ("# made by X\nt;e\n" + BODY, {"delimiter": ";", "comment": "#"}),
        ("t;e\ns;um\n" + BODY, {"delimiter": ";", "unit_row": True}),
        ("t;e\n[s];[µm]\n" + BODY, {"delimiter": ";", "unit_row": True}),
        ("t;e\n" + BODY + "9;---\n", {"delimiter": ";", "missing": ["---"]}),
        ("t;e\n" + BODY + "1.000,5;1\n", {"delimiter": ";", "decimal": ",", "thousands": "."}),
        ("t;e\n" + BODY + "1'000.5;1\n", {"delimiter": ";", "thousands": "'"}),
        ("t,e\n" + BODY.replace(";", ",") + '"1,000.5",1\n', {"delimiter": ",", "thousands": ","}),
        ("t;e\n0;150\n1;300\n2;450\n3;1,050\n", {"delimiter": ";", "thousands": ","}),
        ("t;e\n0;150\n1;300\n2;450\n3;1.050\n", {"delimiter": ";", "decimal": ",", "thousands": "."}),
        ("t;e\n0;1\n1;3\n2;7\n3;1.250\n", {"delimiter": ";"}),
        ("t,e\n0,348\n1,558\n2,822\n" + '3,"1,138"\n4,"1,329"\n5,"1,391"\n', {"delimiter": ",", "thousands": ","}),
        (("t;µ\n" + BODY).encode("cp1252"), {"delimiter": ";", "encoding": "cp1252"}),
        (("t;e\n" + BODY).encode("utf-16"), {"delimiter": ";"}),
        (("t;e\n" + BODY).encode("utf-16-le"), {"delimiter": ";", "encoding": "utf-16-le"}),
        (("t;e\n" + BODY).replace("\n", "\r\n"), {"delimiter": ";"}),
        ("# t e\n" + BODY.replace(";", " "), {"delimiter": " ", "names": ["t", "e"], "header": False}),
    ],
)
def test_how_a_table_is_written(tmp_path: Path, text: str | bytes, source: dict[str, object]) -> None:
    """Oracle: the tables were written so."""
    found = dict(proposed(tmp_path, text).content["source"])
    for key, value in source.items():
        assert found.get(key) == value, (key, found)
    extra = set(found) - set(source) - {"reader", "names", "skip_rows", "comment"}
    assert not extra, found


def test_places_over_columns_of_plain_numbers_are_names(tmp_path: Path) -> None:
    """Oracle: the file. They are no row of readings, though they are numbers with units."""
    p = proposed(tmp_path, "0 mm;50 mm;100 mm\n" + "".join(f"{k}.5;{k}.25;{k}.75\n" for k in range(8)))
    assert p.rows == 8
    assert any("line 1 is taken for the header" in line for line in p.conclusions)


@pytest.mark.parametrize("cut", [";", ","])
@pytest.mark.parametrize("header", ["t [s];x [mm];e [um];T1", "Zeit;x;e;T1", "t;x;e [nm];T1"])
def test_a_cell_may_hold_its_unit(tmp_path: Path, cut: str, header: str) -> None:
    """Oracle: the numbers that were written. A cell that contradicts its header is no number, and that is asked."""
    lines = [f"{12 * k} s;{125 * k}.0 mm;{k}.5 µm;{20 + k}.25 °C" for k in range(8)]
    text = "\n".join([header, *lines]).replace(";", cut) + "\n"
    p = proposed(tmp_path, text, {"axis": "X"} if "nm" in header else {"axis": "X", "sensor of T1": "T_x_nut"})
    if "nm" in header:
        assert [q.key for q in p.open if q.default is None]
        assert "e [nm]" not in [c.get("from") for c in p.content["column"].values()]
        return
    columns = import_table(p.path, p.import_map()).columns
    assert columns["x_mm"].tolist() == [125.0 * k for k in range(8)]
    assert columns["reading_um"].tolist() == [k + 0.5 for k in range(8)]
    assert columns["T_x_nut_degc"].tolist() == [20.25 + k for k in range(8)]
    assert columns["time_s"].tolist() == [12.0 * k for k in range(8)]


@pytest.mark.parametrize(
    ("cut", "number", "clock"),
    [
        (";", lambda v: f"{v}".replace("-", "\u2212"), "%H:%M:%S"),
        (",", lambda v: f'"{v}"'.replace(".", ","), "%H:%M:%S"),
        ("\t", str, "%I:%M:%S %p"),
    ],
)
def test_signs_and_a_night(tmp_path: Path, cut: str, number: Callable[[float], str], clock: str) -> None:
    """A minus of typesetters, commas twice in quotes, times of day over two midnights. Oracle: the numbers written."""
    e = [-2.5, 1.25, -0.5, 3.5, 4.25, -6.5]
    times = [BEGAN.replace(hour=20) + timedelta(hours=7 * k) for k in range(6)]
    rows = [
        cut.join((f"{t:{clock}}", number(100.0 * k), number(v))) for k, (t, v) in enumerate(zip(times, e, strict=True))
    ]
    p = proposed(tmp_path, "\n".join([f"Time{cut}x [mm]{cut}e [um]", *rows]) + "\n", {"axis": "X"})
    table = import_table(p.path, p.import_map())
    assert table.columns["reading_um"].tolist() == e
    assert table.columns["x_mm"].tolist() == [100.0 * k for k in range(6)]
    assert table.columns["time_s"].tolist() == [7 * 3600.0 * k for k in range(6)]
    assert any("pass midnight 2 times" in n for n in table.notes)


def test_a_factor_of_a_thousand_is_asked(tmp_path: Path) -> None:
    """Oracle: 3,320 nm and 3.320 nm are written alike where every number has three digits after its comma."""
    text = "t [s];x [mm];e [nm]\n" + "".join(f"{k};{10 * k};{k + 3},{320 + k}\n" for k in range(6))
    (question,) = (q for q in proposed(tmp_path, text).open if q.key == "decimal")
    assert question.default is None
    assert set(question.choices) == {",", "."}
    for answer, factor in ((",", 1), (".", 1000)):
        p = proposed(tmp_path, text, {"decimal": answer, "axis": "X"})
        columns = import_table(p.path, p.import_map()).columns
        assert columns["reading_um"][0] == pytest.approx(3.320 * factor / 1000)


def test_a_first_row_of_numbers_is_data_and_that_is_said(tmp_path: Path) -> None:
    """A program that takes row one for names loses a reading in silence. Oracle: the number of rows in the file."""
    p = proposed(tmp_path, BODY)
    assert p.rows == 8
    assert any("taken for a row, not for a header" in line for line in p.conclusions)
    p = proposed(tmp_path, "t;e\n" + BODY)
    assert any("line 1 is taken for the header" in line for line in p.conclusions)


def test_a_time_that_is_made_up_is_said(tmp_path: Path) -> None:
    """Oracle: the file has no time."""
    p = proposed(tmp_path, "x [mm];dev [um]\n0;1\n10;2\n20;3\n")
    assert p.content["time"] == {"step_s": 1.0}
    assert any("made up" in line for line in p.conclusions)
    notes = import_measurement(p.path, p.import_map(), MACHINE).notes
    assert any("the file has no time" in n for n in notes)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no lines"),
        (b"\n\n\n", "no lines"),
        (b"a;b\n", "no row with a number"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8, "save as CSV"),
        (b"PK\x03\x04" + bytes(range(1, 256)) * 40, "save as CSV"),
        (b"1,5,2,5\n", "no row"),
        (b"x,y\n1,5,2,5\n2,5,3,5\n3,5,4,5\n", "commas divide cells and decimals alike"),
        (b"t;e\n" + b"9" * (2 << 20), "a line is longer"),
        ("t;e\n1;2\n".encode("utf-16")[:-1], "is this a text table?"),
    ],
)
def test_what_is_no_table_gets_one_clear_message(
    tmp_path: Path, content: bytes, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: exit status 2, one message that names the file, no traceback."""
    file = put(tmp_path, content)
    if said == "no row":  # one line of numbers is a table without names: it is shown, and asks what it is
        assert status(["import", str(file)]) == 0
        return
    assert status(["import", str(file)]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert str(file) in err
    assert "Traceback" not in err


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 200), new=st.one_of(st.text(max_size=3), st.sampled_from(['"', ";;", "\n", "=1+1", "\x00"])))
def test_hostile_cells(tmp_path: Path, at: int, new: str) -> None:
    """Whatever is in a cell: a proposal whose TOML reads back, or one clear error."""
    text = semicolons(rows()[:9]).decode("cp1252")
    file = put(tmp_path, (text[:at] + new + text[at + 1 :]).encode(errors="replace"))
    try:
        p = propose(file, MACHINE)
        assert tomllib.loads(p.toml())["source"]["reader"] == p.reader
    except MeasurementError as e:
        assert str(tmp_path) in str(e)  # noqa: PT017


def test_of_a_huge_file_the_beginning_is_looked_at(tmp_path: Path) -> None:
    """Oracle: more rows than 4 MiB hold; the proposal says so, and the import has all."""
    n = 50_000
    file = put(tmp_path, "t s;x mm;dev um;remark\n" + "".join(f"{i};{i % 200};1;{'-' * 80}\n" for i in range(n)))
    p = propose(file, MACHINE)
    assert not p.whole
    assert "there are more" in p.toml()
    assert import_table(file, p.import_map()).rows_out == n


# --- what columns are


def test_remarks_hold_beyond_the_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The beginning has one way out, the whole table six: no number of the beginning is told as the table's."""
    text = WRITTEN["semicolons"](rows())
    file = put(tmp_path, text, "foreign.txt")
    monkeypatch.setattr("rtec.metrology.readers.layout.SAMPLE_BYTES", len(text) // 3)
    answers = [x for a in ANSWERS.get("semicolons", []) for x in ("--answer", a)]
    assert status(["import", str(file), "--machine", str(TURNING), *answers, "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "concluded from the beginning of the file, " in said
    beginning = said.partition("concluded from")[2].partition("assumed on import")[0]
    assert re.findall(r"\d+ (?:times|runs)", beginning) == []
    assert "66 rows in, 66 rows out" in said


def test_a_t_and_a_place_in_one_word_is_a_temperature(tmp_path: Path) -> None:
    """Old programs have no room for a blank: TNUT and TAIR. Oracle: the machine's names."""
    lines = [f"{10 * k} {10 * k} {k}.0 2{k}.5 20.{k}" for k in range(8)]
    file = put(tmp_path, "\n".join(["TIME NOMINAL DEV TNUT TAIR", *lines]) + "\n", "old.txt")
    proposal = propose(file, MACHINE, None, {"axis": "X", "sensor of TNUT": "T_x_nut"})
    assert {"T_x_nut_degc", "T_air_degc"} <= set(proposal.content["column"])


def test_actual_and_nominal_beside_a_deviation_decide_its_sign(tmp_path: Path) -> None:
    """Oracle: ist - soll is +2 µm where the program writes -2."""
    p = proposed(tmp_path, "Soll X [mm];Ist X [mm];Abw [um]\n0;0.002;-2\n10;10.004;-4\n20;19.994;6\n30;30;0\n")
    assert p.content["column"]["reading_um"]["sign"] == -1
    assert not any(q.key == "sign" for q in p.questions)


def test_counts_have_a_size(tmp_path: Path) -> None:
    """Oracle: 2.5 µm a count, by hand."""
    text = "time s;mcu_pos_z;bed_t\n0;-4;20\n1;-6;20.5\n2;-9;21\n"
    answers = {"reading": "mcu_pos_z", "unit of mcu_pos_z": "2.5 um", "instrument": "tool_tip", "machine": "m"}
    p = propose(put(tmp_path, text), None, {}, answers)
    assert p.content["column"]["reading_z_um"] == {"from": "mcu_pos_z", "unit": "um", "scale": 2.5}
    assert p.content["setup"]["directions"] == ["Z"]
    assert p.content["column"]["T_bed_degc"]["from"] == "bed_t"


@pytest.mark.parametrize(
    ("header", "cells", "time"),
    [
        ("Datum;e", "21.11.2026 08:00:00", {"column": "Datum", "format": "%d.%m.%Y %H:%M:%S"}),
        ("when;e", "2026-11-21T08:00:00+01:00", {"column": "when", "unit": "iso"}),
        ("when;e", "2026/11/21-08:00:00", {"column": "when", "format": "%Y/%m/%d-%H:%M:%S"}),
        ("Uhrzeit;e", "08:00:00,250", {"column": "Uhrzeit", "format": "%H:%M:%S,%f"}),
        ("time;e", "11/21/2026 08:00 AM", {"column": "time", "format": "%m/%d/%Y %I:%M %p"}),
        ("ts;e", "1771779746.5", {"column": "ts", "unit": "unix"}),
        ("time;e", "132900081483250000", {"column": "time", "unit": "filetime"}),
        ("t [ms];e", "12", {"column": "t [ms]"}),
    ],
)
def test_forms_of_time(tmp_path: Path, header: str, cells: str, time: dict[str, str]) -> None:
    """Oracle: the form that they were written in."""
    p = proposed(tmp_path, f"{header}\n" + "".join(f"{cells};{e}\n" for e in (1.5, 2.5, 3.5)))
    assert p.content["time"] == time


def test_day_or_month_first_is_asked_where_both_can_be(tmp_path: Path) -> None:
    """Oracle: 03/04/2026 is 3 April or 4 March; 13 is no month."""
    text = "when;e\n03/04/2026 08:00:00;1.5\n04/04/2026 08:00:00;2.5\n"
    p = proposed(tmp_path, text)
    assert [q.default for q in p.questions if q.key == "date of when"] == ["%d/%m/%Y %H:%M:%S"]
    p = p.answered({"date of when": "%m/%d/%Y %H:%M:%S"})
    assert p.content["time"]["format"] == "%m/%d/%Y %H:%M:%S"
    assert "date of when" not in [q.key for q in proposed(tmp_path, text.replace("04/04", "13/04")).questions]


def test_an_ambiguous_comma_is_asked(tmp_path: Path) -> None:
    """Oracle: 1,234 is a thousand in London and one and a bit in Berlin."""
    text = "t s;dev um\n1;1,234\n2;2,345\n3;1,111\n"
    p = proposed(tmp_path, text)
    assert [q.choices for q in p.questions if q.key == "decimal"] == [(",", ".")]
    answered = p.answered({"decimal": ".", "instrument": "tool_tip", "coordinate": "Z"})
    assert import_table(p.path, answered.import_map()).columns["reading_z_um"].tolist() == [1234.0, 2345.0, 1111.0]


def test_an_odd_cell_among_numbers_is_named_and_not_guessed(tmp_path: Path) -> None:
    """Oracle: the table as it was written, where one cell of 500 is a broken number."""
    cells = [f"{k};{k % 10 * 20};{k % 7},25" for k in range(500)]
    cells[256] = "256;120;1.2.3"
    file = put(tmp_path, "\n".join(["Zeit [s];Soll X [mm];Abweichung [µm]", *cells]))
    proposal = propose(file, MACHINE)
    question = next(q for q in proposal.open if q.default is None)
    assert question.text.startswith("Line 258, column 'Abweichung [µm]': '1.2.3' is no number; 499 cells are.")
    assert "reading" not in [q.key for q in proposal.open]
    with pytest.raises(MeasurementError, match=r"Line 258.*'1\.2\.3'.*--answer 'odd cell of Abweichung \[µm\]=…'"):
        proposal.import_map()
    done = import_table(file, proposal.answered({question.key: "no value"}).import_map())
    reading = np.asarray(done.columns["reading_um"], dtype=np.float64)
    assert np.flatnonzero(np.isnan(reading)).tolist() == [256]
    np.testing.assert_array_equal(np.delete(reading, 256), np.delete(np.arange(500) % 7 + 0.25, 256))
    left = proposal.answered({question.key: "leave out"})
    assert "reading_um" not in left.content["column"]


def test_questions_and_answers(tmp_path: Path) -> None:
    """What is open stops the import and names the way; an answer to no question is refused with the nearest one."""
    p = proposed(tmp_path, semicolons(rows()))
    assert {q.key for q in p.open} == {"axis", "sensor of Mutter [°C]"}
    with pytest.raises(MeasurementError, match=r"--answer 'axis=…' \(X, Z\)"):
        p.import_map()
    with pytest.raises(MeasurementError, match="'axes' is no question here; did you mean 'axis'"):
        p.answered({"axes": "X"})
    with pytest.raises(MeasurementError, match="axis: 'Q' is not possible"):
        p.answered({"axis": "Q"})
    full = p.answered({"axis": "X"}).answered({"sensor of Mutter [°C]": "leave out", "sign": "-1"})
    assert full.open == ()
    column = full.import_map().column
    assert column["reading_um"].sign == -1
    assert "T_x_nut_degc" not in column


def nuts_in_the_names(data: list[Row]) -> str:
    """A German log: nuts named by their axis, the sign in a remark above the names, runs as `zyk`."""
    out = ["! export v2.1", "! error = nominal - actual", "t(s)\tzyk\tPos_X\tFehler(mm)\tMutterX\tRaum"]
    for i, (t, x, e, nut) in enumerate(data):
        out.append(f"{t}\t{1 + i // 11}\t{x}\t{-1e-3 * e:.6f}\t{nut}\t20.5")
    return "\n".join(out)


def in_fahrenheit(data: list[Row]) -> str:
    """Inches, and temperatures whose names end in F."""
    out = ["Time s,Run,Target X (in),Error (in),X nut F,Air F"]
    for i, (t, x, e, nut) in enumerate(data):
        out.append(f"{t},{1 + i // 11},{x / 25.4:.9f},{e / 25400:.10f},{32 + 1.8 * nut},68.9")
    return "\n".join(out)


@pytest.mark.parametrize("name", ["Spindelmutter X [°C]", "Kugelgewindemutter X [°C]", "X-Spindelmutter °C"])
def test_a_german_nut_of_an_axis_is_its_sensor(name: str, tmp_path: Path) -> None:
    """Oracle: the machine's sensor of that nut; `T_z_nut` is another one."""
    data = nuts_in_the_names(rows()).replace("MutterX", name)
    proposal = propose(put(tmp_path, data), MACHINE, {}, {"axis": "X"})
    assert proposal.content["column"]["T_x_nut_degc"]["from"] == name
    assert not [q for q in proposal.open if q.key.startswith("sensor")]


@pytest.mark.parametrize(("written", "answers"), [(nuts_in_the_names, {}), (in_fahrenheit, {"sign": "+1"})])
def test_a_nut_named_by_its_axis_is_no_position(
    written: Callable[[list[Row]], str], answers: dict[str, str], tmp_path: Path
) -> None:
    """Oracle: the numbers that were written; a position of 20.5 mm that is a temperature was exit 0."""
    p = proposed(tmp_path, written(rows()), {"instrument": "laser_linear", **answers})
    assert p.open == ()
    assert "sign" not in [question.key for question, _ in p.assumed]
    columns = import_table(p.path, p.import_map()).columns
    t, x, e, nut = (np.array(v) for v in zip(*rows(), strict=True))
    np.testing.assert_array_equal(np.asarray(columns["run"]), [1 + i // 11 for i in range(66)])
    for name, values in (("time_s", t), ("x_mm", x), ("reading_um", e), ("T_x_nut_degc", nut)):
        np.testing.assert_allclose(np.asarray(columns[name], dtype=np.float64), values, atol=2e-5)
    assert "T_air_degc" in columns
    assert p.content["column"]["z_mm"] == {"value": 0.0}


def test_hot_temperatures_without_a_unit_are_asked_about(tmp_path: Path) -> None:
    """Oracle: 68 may be a room in °F; neither unit is assumed."""
    table = "t s;Pos X mm;dev um;T_x_nut\n" + "".join(f"{i};{i};{i % 7};{68 + i % 3}\n" for i in range(40))
    p = proposed(tmp_path, table, {"instrument": "laser_linear"})
    assert [(q.key, q.default) for q in p.open] == [("unit of T_x_nut", None)]
    column = p.answered({"unit of T_x_nut": "°F"}).import_map().column["T_x_nut_degc"]
    assert column.unit == "degf"


@pytest.mark.parametrize("answer", ["degf", "degF", "DEGF", "°F", "f", "Fahrenheit"])
def test_a_unit_may_be_answered_as_the_map_writes_it(answer: str, tmp_path: Path) -> None:
    """Oracle: the aliases of the unit; 68 °F are 20 °C. Where the name tells the unit, an answer may repeat it."""
    table = "t s;Pos X mm;dev um;T_x_nut\n" + "".join(f"{i};{i};{i % 7};68\n" for i in range(40))
    p = proposed(tmp_path, table, {"instrument": "laser_linear", "unit of T_x_nut": answer})
    with pytest.raises(MeasurementError, match="unit of T_x_nut: 'degR' is not possible"):
        p.answered({"unit of T_x_nut": "degR"})
    assert np.allclose(np.asarray(import_table(p.path, p.import_map()).columns["T_x_nut_degc"], dtype=np.float64), 20.0)
    named = {"instrument": "laser_linear", "unit of X nut F": answer}
    assert proposed(tmp_path, in_fahrenheit(rows()), named).import_map().column["T_x_nut_degc"].unit == "degf"


LASER = "t s;Pos X mm;dev um;pitch arcsec\n" + "".join(f"{i};{i};{i % 7};{i % 5}\n" for i in range(40))
AT = {"instrument": "laser_linear", "reading": "dev um"}


def test_where_another_axis_stood_is_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the answer, in the map, in the measurement, and again by the map alone.

    A table of a multi-axis laser has no column of the other axes. They were at 0 without a question, so that lever arms
    were wrong.
    """
    p = proposed(tmp_path, LASER, AT)
    question = next(q for q in p.questions if q.key == "z_mm")
    assert (question.text, question.default) == ("Where did axis Z stand, in mm?", "0")
    said = "assumed on import, not known: Where did axis Z stand, in mm? 0"
    assert said in p.content["measurement"]["notes"]
    given = p.answered({"z_mm": "180"})
    assert given.content["column"]["z_mm"] == {"value": 180.0}
    assert said not in given.content["measurement"]["notes"]
    command = ["import", str(p.path), "-m", str(TURNING)]
    answers = [word for key, value in AT.items() for word in ("-a", f"{key}={value}")]
    one, two = tmp_path / "one", tmp_path / "two"
    assert status([*command, *answers, "-a", "z_mm=180", "-o", str(one)]) == 0
    assert "z_mm is 180 in every row" in capsys.readouterr().out
    assert status([*command, "--map", f"{one}-map.toml", "-o", str(two)]) == 0
    assert two.with_suffix(".csv").read_bytes() == one.with_suffix(".csv").read_bytes()
    m = load_measurement(two, MACHINE)
    assert np.all(m.channels["z"] == 180.0)
    assert not [n for n in m.notes if "taken as fixed" in n]
    # An answer beside a whole map is not dropped: it may repeat what the map says, and not contradict it.
    again = [*command, "--map", f"{one}-map.toml", "-o", str(two), "--force"]
    assert status([*again, "-a", "z_mm=180.0"]) == 0
    assert status([*again, "-a", "z_mm=90"]) == 2
    assert "'z_mm' is no question here: the file shows '180.0'" in capsys.readouterr().err


def test_the_place_of_an_axis_is_asked_only_where_it_is_not_known(tmp_path: Path) -> None:
    """Oracle: what each file or instrument has; 0 is assumed only where the axis can be there."""

    def asked(table: str, answers: Mapping[str, str]) -> set[str]:
        return {q.key for q in proposed(tmp_path, table, answers).questions} & {"x_mm", "y_mm", "z_mm"}

    assert asked(LASER, AT) == {"z_mm"}
    assert asked(LASER, {**AT, "component": "EXX"}) == set()
    both, head = LASER.replace("pitch arcsec", "Pos Z mm"), {"instrument": "laser_linear", "axis": "X"}
    assert asked(both, head) == set()
    with pytest.raises(MeasurementError, match="'z_mm' is no question here: the file shows 'column Pos Z mm'"):
        asked(both, {**head, "z_mm": "3"})
    with pytest.raises(MeasurementError, match="z_mm: 'far' is no number; give it in mm"):
        asked(LASER, {**AT, "z_mm": "far"})
    text = TURNING.read_text(encoding="utf-8")
    low, high = MACHINE.axis("Z").travel_mm
    moved = text.replace(f"travel_mm = [{low}, {high}]", f"travel_mm = [{low + 50}, {high}]")
    assert moved != text
    (tmp_path / "moved.toml").write_text(moved, encoding="utf-8")
    p = propose(put(tmp_path, LASER), load_machine(tmp_path / "moved.toml"), None, AT)
    assert next(q.default for q in p.questions if q.key == "z_mm") == f"{low + 50:g}"


def test_columns_that_are_edited_keep_the_places_of_the_axes(tmp_path: Path) -> None:
    """Oracle: the studio edits the columns of the file alone."""
    p = proposed(tmp_path, LASER, {**AT, "z_mm": "180"})
    columns = {n: c for n, c in p.content["column"].items() if "from" in c}
    assert p.with_columns(columns).content["column"]["z_mm"] == {"value": 180.0}
    q = proposed(tmp_path, LASER, AT).with_columns({**columns, "z_mm": {"from": "pitch arcsec", "unit": "mm"}})
    assert q.content["column"]["z_mm"]["from"] == "pitch arcsec"
    assert "z_mm" not in [x.key for x in q.questions]
    assert not [n for n in q.content["measurement"]["notes"] if "axis Z" in n]


def test_a_temperature_that_was_not_logged_may_be_answered(tmp_path: Path) -> None:
    """Oracle: the answer. Sensors that the file lacks are not asked about."""
    p = proposed(tmp_path, LASER, AT)
    assert not [q.key for q in p.questions if "degc" in q.key]
    column = p.answered({"T_x_nut_degc": "20"}).content["column"]
    assert column["T_x_nut_degc"] == {"value": 20.0}
    with pytest.raises(MeasurementError, match="'T_xnut_degc' is no question here; did you mean 'T_x_nut_degc'"):
        p.answered({"T_xnut_degc": "20"})
    alone = propose(p.path, None, None, {**AT, "machine": "m", "z_mm": "180", "T_x_nut_degc": "20"})
    assert {n: c for n, c in alone.content["column"].items() if "value" in c} == {
        "z_mm": {"value": 180.0},
        "T_x_nut_degc": {"value": 20.0},
    }


@pytest.mark.parametrize(
    ("remark", "sign"),
    [
        ("error = nominal - actual", -1),
        ("Abweichung: Ist - Soll", 1),
        ("deviation = actual position minus target", 1),
        ("error of the run: 3 um", None),
        ("time = start - end", None),
    ],
)
def test_the_sign_may_be_in_a_remark(remark: str, sign: int | None) -> None:
    assert sign_said([(1, "made by a - b"), (4, remark)]) == (None if sign is None else (sign, 4))


def test_readings_of_drift_probes_are_named_by_the_set_up(tmp_path: Path) -> None:
    """Oracle: the table written here; one probe, whose table in the answer holds signs of equality itself."""
    file = tmp_path / "drift.csv"
    file.write_text("t/min;n/rpm;dz/um\n" + "".join(f"{2 * i};4000;{0.25 * i:.2f}\n" for i in range(9)))
    p = propose(file, None, {}, {"instrument": "spindle_drift", "machine": "mill"})
    assert [(q.key, q.hint) for q in p.questions if q.key == "setup.probe"] == [
        ("setup.probe", 'such as {z={direction="Z"}}: name and direction of each')
    ]
    given = ("instrument=spindle_drift", 'setup.probe={dz={direction="Z"}}', "machine=mill")
    answers = [x for a in given for x in ("--answer", a)]
    assert status(["import", str(file), *answers, "-o", str(tmp_path / "z")]) == 0
    header, first, *_ = (tmp_path / "z.csv").read_text().splitlines()
    assert (header, first) == ("run,time_s,spindle_rpm,reading_dz_um", "1,0,4000,0")
    assert '[setup.probe.dz]\ndirection = "Z"' in (tmp_path / "z.toml").read_text()


def test_what_the_file_says_itself_may_be_answered_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "feeds.csv"
    file.write_text("t_s,X [mm],dev [um]\n" + "".join(f"{i},{10 * i},{0.5 * i}\n" for i in range(9)))
    known = {"instrument": "laser_linear", "machine": "mill", "axis": "X"}
    assert propose(file, None, {}, known).content["measurement"]["axis"] == "X"
    with pytest.raises(MeasurementError, match="'axis' is no question here"):
        propose(file, None, {}, known | {"axis": "Y"})


def test_on_a_terminal_it_asks_what_the_file_does_not_say(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: a wrong answer is asked again, Enter takes the usual one, and the measurement has what was answered."""
    typed = {"Which axis moved?": ["Q", "X"], "Which sensor of the machine is 'Mutter [°C]'?": ["T_x_nut"]}
    typed |= {"Write the measurement as": [str(tmp_path / "laser-x")]}

    def prompt(text: str, *, default: str | None, err: bool) -> str:
        assert err  # standard output is for the result
        answers = next((a for start, a in typed.items() if text.startswith(start)), None)
        return answers.pop(0) if answers else str(default)

    monkeypatch.setattr("rtec.cli.import_._somebody_is_there", lambda: True)
    monkeypatch.setattr("typer.prompt", prompt)
    file = put(tmp_path, semicolons(rows()))
    assert status(["import", str(file), "--machine", str(TURNING)]) == 0
    out, err = capsys.readouterr()
    assert "axis: 'Q' is not possible" in err
    assert "66 rows out" in out
    m = load_measurement(tmp_path / "laser-x.csv", MACHINE)
    assert m.instrument.axis == "X"
    assert "T_x_nut" in m.channels
    assert not any("assumed" in n for n in m.notes)  # all of it was answered


def test_what_a_map_does_not_say_is_proposed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the rows of the first way along X, by hand; the rest of the map is the proposal's."""
    file = put(tmp_path, date_and_time(rows()))
    some = put(tmp_path, '[rows]\nwhere = "`T_x_nut [F]` < 69"\n', "some.toml")
    out = ["-o", str(tmp_path / "laser-x")]
    assert status(["import", str(file), "--map", str(some), "--machine", str(TURNING), *out]) == 0
    assert "rows left out where not `T_x_nut [F]` < 69" in capsys.readouterr().out
    assert len(load_measurement(tmp_path / "laser-x.csv", MACHINE)) == 11


# --- rows, sums, files


def test_conditions() -> None:
    """Oracle: Python's own comparisons on the same numbers."""
    for text in ("bed_target == 105", "a < 2 and not (b >= 3 or c != 'x y')", "`Soll [mm]` > -5.5", "1 < a <= 2"):
        assert condition(text).text == text
    for wrong in ("bed = 1", "a", "f(a) == 1", "a.b == 1", "__import__('os')", "a == b'x'", "a[0] == 1", "1 + a == 2"):
        with pytest.raises(ValueError, match="is no condition"):
            condition(wrong)


MAP = """
[measurement]
instrument = "tool_tip"
machine = "turning-centre"
[time]
{time}
[column.reading_um]
from = "e"
unit = "um"
{more}
"""


def with_map(folder: Path, text: str | list[str], more: str = "", time: str = 'column = "t"\nunit = "s"') -> Imported:
    how = load_map(put(folder, MAP.format(more=more, time=time), "map.toml"))
    texts = [text] if isinstance(text, str) else text
    return import_table([put(folder, x, f"{chr(97 + i)}.csv") for i, x in enumerate(texts)], how)


def test_rows_where(tmp_path: Path) -> None:
    """Oracle: the rows by hand; and what was left out is counted."""
    text = "t,e,bed,mode\n0,1,0,cold\n1,2,105,heat\n2,3,105,cool\n3,4,105,heat\n"
    i = with_map(tmp_path, text, "[rows]\nwhere = \"bed == 105 and mode != 'cool'\"")
    assert i.columns["reading_um"].tolist() == [2.0, 4.0]
    assert "2 rows left out where not bed == 105 and mode != 'cool'" in i.notes
    for wrong, said in (
        ("bed == 7", "holds in no row"),
        ("mode == 7", "numbers with words"),
        ("bad == 7", "did you mean"),
    ):
        with pytest.raises(MeasurementError, match=said):
            with_map(tmp_path, text, f'[rows]\nwhere = "{wrong}"')


def test_sums_and_differences(tmp_path: Path) -> None:
    """Oracle: by hand; rows that are left out have moved the axis all the same."""
    text = "t,e,dx,use\n0,1,0,1\n1,3,10,0\n2,6,10,1\n3,10,-5,1\n"
    more = '[column.x_mm]\nfrom = "dx"\nunit = "mm"\ntake = "sum"\n[rows]\nwhere = "use == 1"'
    i = with_map(tmp_path, text, more)
    assert i.columns["x_mm"].tolist() == [0.0, 20.0, 15.0]
    i = with_map(tmp_path, text, '[column.reading_x_um]\nfrom = "e"\nunit = "um"\ntake = "difference"')
    assert i.columns["reading_x_um"].tolist()[1:] == [2.0, 3.0, 4.0]
    assert np.isnan(i.columns["reading_x_um"][0])
    with pytest.raises(MeasurementError, match="line 3: column 'dx': no step"):
        with_map(tmp_path, text.replace("1,3,10", "1,3,"), more)


def test_files_become_runs_with_their_dates(tmp_path: Path) -> None:
    """Oracle: an hour between the files is an hour between the runs, whatever order they are named in."""
    one, two = (f"t,e\n2026-11-21T0{h}:00:00,1\n2026-11-21T0{h}:00:05,2\n" for h in (9, 8))
    i = with_map(tmp_path, [one, two], time='column = "t"\nunit = "iso"')
    assert i.columns["time_s"].tolist() == [0.0, 5.0, 3600.0, 3605.0]
    assert i.columns["run"].tolist() == [1, 1, 2, 2]
    assert "run 1 is b.csv, from 2026-11-21 08:00:00" in i.notes
    assert "run 2 is a.csv, from 2026-11-21 09:00:00" in i.notes
    with pytest.raises(MeasurementError, match=r"before b\.csv ends"):
        with_map(tmp_path, [one.replace("09:00:00", "08:00:01"), two], time='column = "t"\nunit = "iso"')


def test_files_without_dates_follow_and_that_is_said(tmp_path: Path) -> None:
    """Oracle: the made-up second between them is in the notes."""
    i = with_map(tmp_path, ["t,e\n0,1\n5,2\n", "t,e\n7,1\n8,2\n"])
    assert i.columns["time_s"].tolist() == [0.0, 5.0, 6.0, 7.0]
    assert any("have no dates" in n and "made up" in n for n in i.notes)


def test_an_event_log_with_units_and_words(tmp_path: Path) -> None:
    """Oracle: by hand; a channel that comes twice in an instant begins another row."""
    text = (
        "time s;signal;value;unit\n0;x;0,5;mm\n0;laser;1,5;um\n1;x;1,5;mm\n1;laser;2,5;um\n1;laser;2,75;um\n2;x;2;mm\n"
        "2;laser;3;um\n"
    )
    p = proposed(tmp_path, text)
    assert p.content["events"] == {"channel": "signal", "value": "value", "unit": "unit"}
    i = import_table(p.path, p.import_map())
    assert i.columns["reading_um"].tolist() == [1.5, 2.5, 2.75, 3.0]
    assert i.columns["x_mm"].tolist() == [0.5, 1.5, 1.5, 2.0]
    with pytest.raises(MeasurementError, match="has the units mm, um"):
        import_table(put(tmp_path, text.replace("1;x;1,5;mm", "1;x;1,5;um")), p.import_map())


def event_log(units: Mapping[str, str], header: str = "timestamp,signal,value,unit") -> str:
    """A log of a laser, a feed, a temperature of 293.15 K and a torque, written in other units; true values by hand."""
    values = {"x_pos": 1.0, "deviation": 2.5, "T_x_nut": 20.0, "feed": 600.0, "spindle_speed": 3000.0, "torque": 7.5}
    in_unit: dict[str, Callable[[float], float]] = {
        "°F": lambda v: v * 9.0 / 5.0 + 32.0, "K": lambda v: v + 273.15, "inch": lambda v: v / 25.4,
        "nm": lambda v: v * 1e3, "m/min": lambda v: v / 1e3, "Hz": lambda v: v / 60.0,
    }  # fmt: skip
    lines = [header]
    for i in range(24):
        x = 10.0 * (i % 12 if i < 12 else 11 - i % 12)
        for name, value in values.items():
            true = x if name == "x_pos" else value + (0.1 * i if name in ("deviation", "T_x_nut", "torque") else 0.0)
            unit = units[name]
            lines.append(f"{5.0 * i},{name},{in_unit.get(unit, float)(true):.9g},{unit}")
    return "\n".join(lines) + "\n"


PLAIN = {"x_pos": "mm", "deviation": "um", "T_x_nut": "degC", "feed": "mm/min", "spindle_speed": "rpm", "torque": "Nm"}


@pytest.mark.parametrize(
    "units",
    [
        {}, {"T_x_nut": "°C"}, {"T_x_nut": "C"}, {"T_x_nut": "deg C"}, {"T_x_nut": "°F"}, {"T_x_nut": "K"},
        {"x_pos": "inch"}, {"deviation": "nm"}, {"deviation": "µm"}, {"feed": "m/min"}, {"spindle_speed": "Hz"},
        {"spindle_speed": "U/min"},
        {"torque": "N·m"}, {"torque": "%"}, {"torque": "A"}, {"torque": "bar"}, {"torque": "-"}, {"torque": ""},
    ],
    ids=lambda u: "-".join(u.values()) or "plain",
)  # fmt: skip
def test_units_of_an_event_log(units: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the values that the log was written with, by hand; a torque is no column of a measurement."""
    text = event_log({**PLAIN, **units})
    file, out = put(tmp_path, text), tmp_path / "laser-x"
    words = ["import", str(file), "--machine", str(TURNING), "-o", str(out), "--answer", "axis=X"]
    assert status(words) == 0, capsys.readouterr().err
    i = np.arange(24.0)
    table = np.genfromtxt(out.with_suffix(".csv"), delimiter=",", names=True)
    np.testing.assert_allclose(table["reading_um"], 2.5 + 0.1 * i, rtol=1e-7)
    np.testing.assert_allclose(table["T_x_nut_degc"], 20.0 + 0.1 * i, rtol=1e-7)
    np.testing.assert_allclose(table["feed_mm_min"], 600.0, rtol=1e-7)
    np.testing.assert_allclose(table["spindle_rpm"], 3000.0, rtol=1e-7)
    np.testing.assert_allclose(table["x_mm"][:3], [0.0, 10.0, 20.0], atol=1e-6)
    assert not {n for n in table.dtype.names or () if n.startswith("reading")} - {"reading_um"}


def test_an_unknown_unit_of_an_event_log_is_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the words that are no units, and the first lines with them, counted by hand."""
    file = put(tmp_path, event_log({**PLAIN, "T_x_nut": "degX", "feed": "furlong"}))
    for words in ([], ["-o", str(tmp_path / "out")]):
        capsys.readouterr()
        assert status(["import", str(file), "--machine", str(TURNING), "--answer", "axis=X", *words]) == 2
        said = capsys.readouterr().err
        assert "Traceback" not in said
        assert "line 4: channel 'T_x_nut': unit 'degX' is not known; did you mean 'deg'?" in said
        assert "line 5: channel 'feed': unit 'furlong' is not known; allowed: " in said
    assert not (tmp_path / "out.csv").exists()


def test_a_map_reads_the_units_of_an_event_log(tmp_path: Path) -> None:
    """Oracle: the map that was kept reads the same; °C and degC are one unit."""
    text = event_log({**PLAIN, "T_x_nut": "°C"}).replace("°C", "degC", 3)
    p = proposed(tmp_path, text, {"axis": "X"})
    assert p.content["events"]["unit"] == "unit"
    i = import_table(p.path, p.import_map())
    np.testing.assert_allclose(i.columns["T_x_nut_degc"], 20.0 + 0.1 * np.arange(24))


def test_a_torque_in_brackets_is_no_nanometre(tmp_path: Path) -> None:
    """Oracle: SI writes newton metre Nm and nanometre nm; the deviation is the only reading."""
    lines = [f"{t},{x},{1 + 0.1 * t:g},{5 + t}" for t, x in enumerate([0, 10, 20, 30, 20, 10, 0])]
    p = proposed(tmp_path, "\n".join(["time [s],x [mm],deviation [um],torque [Nm]", *lines]) + "\n")
    assert {c.name: c.becomes for c in p.columns}["torque [Nm]"] == ""
    assert not [q for q in p.open if "reading" in q.key]


# --- recordings of others


@pytest.mark.parametrize(
    ("folder", "name", "answers", "rows_out", "reads"),
    [
        ("frame_thermal", "right_thermistor.csv",
         {"reading": "mcu_pos_z", "unit of mcu_pos_z": "2.5 um", "instrument": "tool_tip", "machine": "m"}, None,
         "mcu_pos_z"),
        ("probe_thermal", "probe_accuracy_superpinda.json",
         {"reading": "z", "unit of z": "mm", "instrument": "tool_tip", "machine": "m"}, 1430, "z"),
        ("spindle_thermal", "caiviac_spindle_thermal_15s_to_60s.csv",
         {"reading": "ch3_um", "instrument": "tool_tip", "coordinate": "Z", "machine": "m"}, 2779, "ch3_um"),
        ("iso230_positioning", "b02-x_target_x.md_ISO230.dat", {"axis": "X", "machine": "m"}, 90, "deviation"),
    ],
)  # fmt: skip
def test_real_files(folder: str, name: str, answers: dict[str, str], rows_out: int | None, reads: str) -> None:
    """Oracle: the README of the data: which column is the reading, and how many rows there are."""
    p = propose(real_file(folder, name), None, {}, answers)
    assert p.open == ()
    i = import_table(p.path, p.import_map())
    assert i.rows_out == (rows_out or i.rows_in)
    readings = [c["from"] for n, c in p.content["column"].items() if n.startswith("reading")]
    assert readings == [reads]


def test_the_real_ecmc_file_decides_the_sign_of_its_own_deviation() -> None:
    """Oracle: deviation is reference minus target in it."""
    p = propose(
        real_file("iso230_positioning", "b02-x_target_x.md_ISO230.dat"), None, {}, {"axis": "X", "machine": "m"}
    )
    assert "sign" not in [q.key for q in p.questions]
    assert p.content["column"]["reading_um"] == {"from": "deviation"}


def written(unit: str, name: str = "Error", clock: str = "Elapsed [s]", place: str = "Target [mm]") -> str:
    """A table of six readings, 12 s apart, with a unit as some people write it."""
    moments = (0, 12, 24, 36, 48, 60)
    times = [f"{s // 60}:{s % 60:02d}" if clock == "Elapsed" else f"{s}" for s in moments]
    lines = [f"{t},{50 * k},{1.5 * k + 2.0},20.{k}" for k, t in enumerate(times)]
    return "\n".join([f"{clock},{place},{name} [{unit}],T_bed [°C]", *lines]) + "\n"


AT_X = {"axis": "X", "instrument": "laser_linear", "diameter": "none"}


@pytest.mark.parametrize(
    ("unit", "um"),
    [("µin", 0.0254), ("uin", 0.0254), ("microinch", 0.0254), ("Zoll", 25400.0), ("in.", 25400.0), ("µm", 1.0)],
)
def test_units_as_they_are_written(tmp_path: Path, unit: str, um: float) -> None:
    """An unknown one had become µm. Oracle: the definition of the inch."""
    done = import_table(tmp_path / "file.csv", proposed(tmp_path, written(unit), AT_X).import_map())
    assert done.columns["reading_um"] == pytest.approx(um * (1.5 * np.arange(6) + 2.0))


@pytest.mark.parametrize("unit", ["0.1 µm", "1/10 µm", "10 nm", "counts", "tenths", "ppm"])
def test_a_unit_that_is_not_known_is_asked(tmp_path: Path, unit: str) -> None:
    p = proposed(tmp_path, written(unit), AT_X)
    question = next(q for q in p.questions if q.key == f"unit of Error [{unit}]")
    assert question.default is None
    assert f"{unit!r} is no unit that rtec knows." in question.text
    with pytest.raises(MeasurementError, match="is no unit that rtec knows"):
        p.import_map()


def test_a_place_in_an_unknown_unit_is_asked(tmp_path: Path) -> None:
    p = proposed(tmp_path, written("µm", place="Target [1/10 mm]"), AT_X)
    assert any("'1/10 mm' is no unit that rtec knows" in q.text for q in p.questions)


def test_elapsed_minutes_and_seconds(tmp_path: Path) -> None:
    """0:12 is twelve seconds where the column says that it is a time since the begin; it had been twelve minutes."""
    text = written("µm", clock="Elapsed")
    done = import_table(tmp_path / "file.csv", proposed(tmp_path, text, AT_X).import_map())
    assert done.columns["time_s"] == pytest.approx([0.0, 12.0, 24.0, 36.0, 48.0, 60.0])
    clock = import_table(
        tmp_path / "file.csv", proposed(tmp_path, text.replace("Elapsed", "Uhrzeit"), AT_X).import_map()
    )
    assert clock.columns["time_s"][1] == pytest.approx(720.0)


@pytest.mark.parametrize("name", ["Korrektur", "Correction", "Comp value"])
def test_the_sign_of_a_correction_is_asked(tmp_path: Path, name: str) -> None:
    """What a control adds is the negative of the error; it had been taken for the error."""
    p = proposed(tmp_path, written("µm", name=name), AT_X)
    assert next(q.default for q in p.questions if q.key == "sign") is None
    how = proposed(tmp_path, written("µm", name=name), {**AT_X, "sign": "-1"}).import_map()
    assert import_table(tmp_path / "file.csv", how).columns["reading_um"][0] == pytest.approx(-2.0)


@pytest.mark.parametrize(
    ("name", "kept"), [("Load [%]", "column Load [%]"), ("chuck", "chuck"), ("Druck, bar", "Druck_ bar")]
)
def test_a_column_that_nothing_reads_is_kept_for_the_diagnosis(tmp_path: Path, name: str, kept: str) -> None:
    """It had been dropped, and a backlash that followed it was "slow drift". A copy of the position is not kept."""
    lines = [f"{k};{10 * (k % 5)};{10 * (k % 5)}.001;{(7 * k) % 11};{0.1 * k}" for k in range(40)]
    text = "\n".join([f"Time [s];X radius [mm];Actual X;{name};Error [um]", *lines, ""])
    (tmp_path / "file.csv").write_text(text, encoding="utf-8")
    proposal = propose(tmp_path / "file.csv", MACHINE, {}, AT_X)
    import_to_files(tmp_path / "file.csv", proposal.import_map(), tmp_path / "out.csv", MACHINE)
    read = load_measurement(tmp_path / "out", MACHINE)
    assert list(read.unread) == [kept]
    np.testing.assert_array_equal(read.unread[kept], (7 * np.arange(40)) % 11)
