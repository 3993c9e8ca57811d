"""What a log of temperatures carries besides temperatures: spindle speed, feed, load; and what of it is not used.

Oracle: the speed that the log has at or before each reading; it steps, and no value between two steps ever existed.
"""

import tomllib
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import import_table, load_map, propose

TURNING = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
MACHINE = load_machine(TURNING)
BEGAN = datetime(2026, 3, 12, 8)
READ_S = np.arange(5, 1200, 10)
"""Times of the readings after eight o'clock; each is between two rows of the log."""
LOG_S = np.arange(0, 1230, 30)
RPM = np.where(LOG_S < 300, 0.0, np.where(LOG_S < 900, 3000.0, 1200.0))
HELD = np.where(READ_S < 300, 0.0, np.where(READ_S < 900, 3000.0, 1200.0))


def laser(folder: Path) -> Path:
    lines = ["Time;X [mm];Deviation [um]"]
    lines += [f"{BEGAN + timedelta(seconds=int(s))};{10 * (i % 9)};{i % 5}" for i, s in enumerate(READ_S)]
    path = folder / "laser.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def log(folder: Path, columns: dict[str, np.ndarray], kept: np.ndarray | None = None) -> Path:
    """A log with the nut's temperature and further columns."""
    columns = {"T_x_nut [°C]": 20.0 + LOG_S / 600.0, **columns}
    rows = zip(*columns.values(), strict=True)
    lines = [
        f"{BEGAN + timedelta(seconds=int(s))};" + ";".join(map(str, row)) for s, row in zip(LOG_S, rows, strict=True)
    ]
    lines = lines if kept is None else [line for line, keep in zip(lines, kept, strict=True) if keep]
    path = folder / "logger.csv"
    path.write_text("\n".join([f"Time;{';'.join(columns)}", *lines]), encoding="utf-8")
    return path


def columns_of(folder: Path, log_path: Path) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    file = laser(folder)
    asked = propose(file, MACHINE, {"temperatures": {"file": log_path.name}}, {})
    done = import_table(file, asked.import_map())
    return {n: np.asarray(v, dtype=np.float64) for n, v in done.columns.items()}, done.notes


@pytest.mark.parametrize("name", ["Drehzahl [1/min]", "spindle_speed", "Spindle [rpm]", "spindle_rpm"])
def test_the_spindle_speed_of_a_log_is_held_and_not_interpolated(name: str, tmp_path: Path) -> None:
    columns, notes = columns_of(tmp_path, log(tmp_path, {name: RPM}))
    np.testing.assert_array_equal(columns["spindle_rpm"], HELD)
    np.testing.assert_allclose(columns["T_x_nut_degc"], 20.0 + READ_S / 600.0, atol=1e-9)
    assert [n for n in notes if "spindle_rpm" in n] == [
        "spindle_rpm as the last row of the log before each reading has it, rows 30 s apart"
    ]


def test_feed_and_load_of_a_log_are_taken(tmp_path: Path) -> None:
    """A load in t, a feed in m/min."""
    more = {"Vorschub [m/min]": RPM / 1000.0, "Beladung [t]": np.where(LOG_S < 600, 0.0, 0.25)}
    columns, _ = columns_of(tmp_path, log(tmp_path, more))
    np.testing.assert_allclose(columns["feed_mm_min"], HELD)
    np.testing.assert_allclose(columns["load_kg"], np.where(READ_S < 600, 0.0, 250.0))


def test_the_map_keeps_the_speed_and_imports_again(tmp_path: Path) -> None:
    file, path = laser(tmp_path), log(tmp_path, {"Drehzahl [1/min]": RPM})
    out = tmp_path / "made"
    assert status(["import", str(file), "--temperatures", str(path), "-m", str(TURNING), "-o", str(out)]) == 0
    np.testing.assert_array_equal(load_measurement(out, MACHINE).channels["spindle_rpm"], HELD)
    kept = tomllib.loads((tmp_path / "made-map.toml").read_text(encoding="utf-8"))
    assert kept["temperatures"]["column"]["spindle_rpm"]["from"] == "Drehzahl [1/min]"
    again = import_table(file, load_map(tmp_path / "made-map.toml"))
    np.testing.assert_array_equal(again.columns["spindle_rpm"], HELD)


def test_a_speed_is_not_held_over_a_long_gap(tmp_path: Path) -> None:
    """The logger was off from 100 s to 1000 s: more than ten minutes. A row up to one step away counts."""
    kept = (LOG_S < 100) | (LOG_S > 1000)
    columns, _ = columns_of(tmp_path, log(tmp_path, {"Drehzahl [1/min]": RPM}, kept))
    off = (READ_S > 90 + 30) & (READ_S < 1020 - 30)
    np.testing.assert_array_equal(np.isnan(columns["spindle_rpm"]), off)


def test_a_log_of_the_speed_alone_is_enough(tmp_path: Path) -> None:
    path = log(tmp_path, {"Drehzahl [1/min]": RPM})
    path.write_text(path.read_text(encoding="utf-8").replace("T_x_nut [°C]", "Name"), encoding="utf-8")
    columns, notes = columns_of(tmp_path, path)
    np.testing.assert_array_equal(columns["spindle_rpm"], HELD)
    assert "columns of logger.csv not used: Name" in notes


def test_of_two_speeds_the_actual_one_is_taken(tmp_path: Path) -> None:
    path = log(tmp_path, {"Drehzahl Soll [1/min]": RPM + 7.0, "Drehzahl Ist [1/min]": RPM})
    columns, notes = columns_of(tmp_path, path)
    np.testing.assert_array_equal(columns["spindle_rpm"], HELD)
    assert "columns of logger.csv not used: Drehzahl Soll [1/min]" in notes


@pytest.mark.parametrize("name", ["Fan speed", "Fan [rpm]", "Kühlmittelpumpe Drehzahl [1/min]", "Spindle speed [%]"])
def test_another_speed_is_not_the_spindle_s(name: str, tmp_path: Path) -> None:
    columns, notes = columns_of(tmp_path, log(tmp_path, {name: RPM + 7.0, "Drehzahl [1/min]": RPM}))
    np.testing.assert_array_equal(columns["spindle_rpm"], HELD)
    assert f"columns of logger.csv not used: {name}" in notes


def test_every_column_of_the_log_that_is_not_used_is_named_in_one_note(tmp_path: Path) -> None:
    more = {"Load [%]": RPM / 100.0, "Status": np.full(len(LOG_S), "ok"), "Drehzahl [1/min]": RPM}
    _, notes = columns_of(tmp_path, log(tmp_path, more))
    assert [n for n in notes if "logger.csv not used" in n] == [
        "columns of logger.csv not used: Load [%], Status (no numbers: 'ok')"
    ]


def test_no_position_comes_from_a_log(tmp_path: Path) -> None:
    """A position a minute old is none."""
    path = log(tmp_path, {"Z [mm]": RPM})
    _, notes = columns_of(tmp_path, path)
    assert "columns of logger.csv not used: Z [mm]" in notes
    content = dict(propose(laser(tmp_path), MACHINE, {"temperatures": {"file": path.name}}, {}).content)
    content["temperatures"]["column"]["z_mm"] = {"from": "Z [mm]"}
    written = tmp_path / "map.toml"
    written.write_text(tomli_w.dumps(content), encoding="utf-8")
    with pytest.raises(MeasurementError, match=r"'z_mm' does not come from a log; it gives SENSOR_degc, spindle_rpm"):
        load_map(written)


# --- a map that has the log already


def made_map(folder: Path) -> Path:
    """A map of an import with a sensor and a column of the log that were asked for; the latter was left out."""
    file, path = (
        laser(folder),
        log(folder, {"Fuehler 3 [°C]": 20.0 + LOG_S / 100.0, "Fuehler 4 [°C]": 20.0 + LOG_S / 50.0}),
    )
    given = ["sensor of Fuehler 3 [°C]=T_bed", "sensor of Fuehler 4 [°C]=leave out"]
    answers = [x for a in given for x in ("--answer", a)]
    command = ["import", str(file), "--temperatures", str(path), "-m", str(TURNING), *answers]
    assert status([*command, "-o", str(folder / "first")]) == 0
    return folder / "first-map.toml"


@pytest.mark.parametrize("answers", [[], ["--answer", "sensor of Fuehler 3 [°C]=T_bed"]])
def test_a_map_that_names_the_sensors_is_not_asked_for_them_again(answers: list[str], tmp_path: Path) -> None:
    """Tuesday's log comes with Monday's map; a repeated answer does no harm."""
    map_ = made_map(tmp_path)
    tuesday = tmp_path / "tuesday"
    tuesday.mkdir()
    path = log(tuesday, {"Fuehler 3 [°C]": 20.0 + LOG_S / 100.0 + 1.0, "Fuehler 4 [°C]": 20.0 + LOG_S / 50.0})
    command = ["import", str(laser(tmp_path)), "--map", str(map_), "--temperatures", str(path), "-m", str(TURNING)]
    assert status([*command, *answers, "-o", str(tmp_path / "second")]) == 0
    m = load_measurement(tmp_path / "second", MACHINE)
    np.testing.assert_allclose(m.channels["T_bed"], 21.0 + READ_S / 100.0, atol=1e-9)
    assert any("tuesday/logger.csv" in n and n.startswith("temperatures from") for n in m.notes)
    assert "columns of logger.csv not used: Fuehler 4 [°C]" in m.notes


def test_an_answer_against_the_map_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    map_ = made_map(tmp_path)
    command = ["import", str(tmp_path / "laser.csv"), "--map", str(map_), "-m", str(TURNING)]
    command += ["--temperatures", str(tmp_path / "logger.csv"), "--answer", "sensor of Fuehler 3 [°C]=T_air"]
    assert status([*command, "-o", str(tmp_path / "second")]) == 2
    assert "'sensor of Fuehler 3 [°C]' is no question here: the file shows 'T_bed'" in capsys.readouterr().err


def test_a_whole_map_does_not_ask_for_columns_that_it_leaves_out(tmp_path: Path) -> None:
    """The readings' file has a sensor that the user left out, too."""
    file = laser(tmp_path)
    lines = file.read_text(encoding="utf-8").splitlines()
    more = [f"{line};{'Fuehler 9 [°C]' if i == 0 else 21.5}" for i, line in enumerate(lines)]
    file.write_text("\n".join(more), encoding="utf-8")
    path = log(tmp_path, {})
    left = ["--answer", "sensor of Fuehler 9 [°C]=leave out"]
    command = ["import", str(file), "--temperatures", str(path), "-m", str(TURNING)]
    assert status([*command, *left, "-o", str(tmp_path / "first")]) == 0
    again = [*command, "--map", str(tmp_path / "first-map.toml"), "-o", str(tmp_path / "second")]
    assert status(again) == 0
    assert status([*again, *left, "--force"]) == 0
