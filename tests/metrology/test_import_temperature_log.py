"""`rtec import --temperatures`: a log of temperatures in a file of its own, matched by date or time of day.

Oracle: a nut that warms along a straight line of the clock; its value at each reading is worked out by hand.
"""

import tomllib
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

import rtec
from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import import_table, load_map, propose

TURNING = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
MACHINE = load_machine(TURNING)
BEGAN = datetime(2026, 3, 12, 8, 0, 6)
STEP_S, LOG_STEP_S, READINGS = 6, 30, 400


def nut_degc(moment: datetime) -> float:
    """20 °C at eight o'clock, one degree more each 10 minutes."""
    return 20.0 + (moment - datetime(2026, 3, 12, 8)).total_seconds() / 600.0


def laser(folder: Path, form: str = "%H:%M:%S") -> Path:
    """A laser's file with a clock, without any temperature."""
    lines = ["Laser;;", "Zeit;Soll [mm];Abweichung [µm]"]
    for i in range(READINGS):
        x = float(np.abs(100 - (i * 10) % 200))
        when = BEGAN + timedelta(seconds=STEP_S * i)
        lines.append(
            f"{when:{form}};{x:.1f};{0.01 * x + 0.1 * (i % 3):.2f}".replace(".", ",", 2 if "%d" not in form else 0)
        )
    path = folder / "laser X.csv"
    path.write_bytes("\r\n".join(lines).encode("cp1252"))
    return path


def log(folder: Path, form: str = "%d.%m.%Y %H:%M:%S", first: int = -600, last: int = 3600, more: str = "") -> Path:
    """The logger's file; the nut's sensor is called as in the machine file, and one more as the machine's bed."""
    lines = [f"Zeit;T_x_nut [°C];Bett [°C]{more and ';Luft'}"]
    for s in range(first, last, LOG_STEP_S):
        when = datetime(2026, 3, 12, 8) + timedelta(seconds=s)
        lines.append(f"{when:{form}};" + f"{nut_degc(when):.4f};21.5{more}".replace(".", ","))
    path = folder / "Temperatur.csv"
    path.write_bytes("\r\n".join(lines).encode("cp1252"))
    return path


def expected() -> list[float]:
    return [nut_degc(BEGAN + timedelta(seconds=STEP_S * i)) for i in range(READINGS)]


@pytest.mark.parametrize("mine", ["%H:%M:%S", "%Y-%m-%d %H:%M:%S"])
@pytest.mark.parametrize("theirs", ["%H:%M:%S", "%d.%m.%Y %H:%M:%S"])
def test_a_log_beside_the_readings_is_matched_by_its_clock(mine: str, theirs: str, tmp_path: Path) -> None:
    file, out = laser(tmp_path, mine), tmp_path / "laser-x"
    command = ["import", str(file), "--temperatures", str(log(tmp_path, theirs)), "-m", str(TURNING), "-a", "axis=X"]
    assert status([*command, "-o", str(out)]) == 0
    made = load_measurement(out, MACHINE)
    np.testing.assert_allclose(made.channels["T_x_nut"], expected(), atol=1e-3)
    np.testing.assert_allclose(made.channels["T_bed"], 21.5, atol=1e-9)
    assert any("Temperatur.csv" in note for note in made.notes)


def test_the_map_has_the_log_and_imports_again(tmp_path: Path) -> None:
    file, out = laser(tmp_path), tmp_path / "laser-x"
    command = ["import", str(file), "--temperatures", str(log(tmp_path)), "-m", str(TURNING), "-a", "axis=X"]
    assert status([*command, "-o", str(out)]) == 0
    kept = tomllib.loads((tmp_path / "laser-x-map.toml").read_text(encoding="utf-8"))
    assert kept["temperatures"]["file"] == "Temperatur.csv"
    again = import_table(file, load_map(tmp_path / "laser-x-map.toml"))
    np.testing.assert_allclose(again.columns["T_x_nut_degc"], expected(), atol=1e-3)


def test_python_takes_the_log_as_well(tmp_path: Path) -> None:
    proposal = rtec.propose_import(laser(tmp_path), TURNING, {"axis": "X"}, temperatures=log(tmp_path))
    assert str(proposal) == proposal.toml()
    done = rtec.import_table(proposal.path, proposal, tmp_path / "made")
    assert done.measurement is not None
    np.testing.assert_allclose(done.measurement.channels["T_x_nut"], expected(), atol=1e-3)


def test_a_sensor_of_the_log_that_the_machine_has_not_is_asked_for(tmp_path: Path) -> None:
    file = laser(tmp_path)
    path = log(tmp_path)
    path.write_bytes(path.read_bytes().replace(b"T_x_nut", b"Fuehler 3"))
    asked = propose(file, MACHINE, {"temperatures": {"file": path.name}}, {"axis": "X"})
    assert [q.key for q in asked.open] == ["sensor of Fuehler 3 [°C]"]
    done = import_table(file, asked.answered({"sensor of Fuehler 3 [°C]": "T_x_nut"}).import_map())
    np.testing.assert_allclose(done.columns["T_x_nut_degc"], expected(), atol=1e-3)


def test_a_question_about_a_cell_of_the_log_names_the_log(tmp_path: Path) -> None:
    """Oracle: the comma before three digits is in the log only; its columns of sensors are asked about there, too."""
    file, path = laser(tmp_path), tmp_path / "Temperatur.csv"
    rows = [f"12.03.2026 08:{m:02d}:00;19,{900 + m};21,50{m % 10}" for m in range(45)]
    path.write_text("\n".join(["Zeit;Fuehler 3 [°C];Bett [°C]", *rows]), encoding="utf-8")
    asked = propose(file, MACHINE, {"temperatures": {"file": path.name}}, {"axis": "X"})
    with pytest.raises(MeasurementError) as caught:
        asked.import_map()
    said = str(caught.value).splitlines()
    assert len(said) == 2
    assert said[0].startswith(f"{path}: Is the comma in '19,900' the decimal sign")
    assert said[1].startswith(f"{path}: ")
    assert "Temperatur.csv: Is the comma" in " ".join(asked.toml().replace("#", "").split())
    with pytest.raises(MeasurementError, match=r"Temperatur\.csv: decimal: ';' is not possible"):
        asked.answered({"decimal": ";"})


def test_readings_beyond_the_log_have_no_temperature_and_are_counted(tmp_path: Path) -> None:
    """Oracle: the log ends 20 minutes after eight, at 08:19:30; a reading up to one step later has its last value."""
    file = laser(tmp_path)
    log(tmp_path, last=1200)
    asked = propose(file, MACHINE, {"temperatures": {"file": "Temperatur.csv"}}, {"axis": "X"})
    done = import_table(file, asked.import_map())
    late = np.array([6 + STEP_S * i > 1170 + LOG_STEP_S for i in range(READINGS)])
    np.testing.assert_array_equal(np.isnan(done.columns["T_x_nut_degc"]), late)
    assert any(f"T_x_nut_degc: {late.sum()} of {READINGS} rows have none" in n for n in done.notes)


@pytest.mark.parametrize(
    ("first", "theirs", "words"),
    [
        (7200, "%d.%m.%Y %H:%M:%S", "from 2026-03-12 10:00:00"),  # two hours later
        (7200, "%H:%M:%S", "from 10:00:00"),
        (86400 * 3, "%d.%m.%Y %H:%M:%S", "2026-03-15"),
    ],
)
def test_a_log_of_another_time_is_refused_with_both_spans(first: int, theirs: str, words: str, tmp_path: Path) -> None:
    file = laser(tmp_path, "%Y-%m-%d %H:%M:%S")
    log(tmp_path, theirs, first, first + 3600)
    asked = propose(file, MACHINE, {"temperatures": {"file": "Temperatur.csv"}}, {"axis": "X"})
    with pytest.raises(MeasurementError) as caught:
        import_table(file, asked.import_map())
    said = str(caught.value)
    assert "Temperatur.csv" in said
    assert words in said
    assert "08:00:06" in said


def test_a_log_of_several_days_beside_readings_without_a_date_is_ambiguous(tmp_path: Path) -> None:
    file = laser(tmp_path)
    log(tmp_path, last=3 * 86400)
    asked = propose(file, MACHINE, {"temperatures": {"file": "Temperatur.csv"}}, {"axis": "X"})
    with pytest.raises(MeasurementError, match=r"no date.* 3 days"):
        import_table(file, asked.import_map())


def test_a_clock_that_only_counts_seconds_is_not_matched(tmp_path: Path) -> None:
    file = tmp_path / "laser X.csv"
    file.write_text("time [s],x [mm],dev [um]\n" + "".join(f"{i},{i % 7 * 10},{i % 5}\n" for i in range(60)))
    log(tmp_path)
    asked = propose(file, MACHINE, {"temperatures": {"file": "Temperatur.csv"}}, {"axis": "X"})
    with pytest.raises(MeasurementError, match=r"laser X\.csv: no time of day .*--answer T_x_nut_degc=20\.5"):
        import_table(file, asked.import_map())


def test_a_log_without_a_clock_or_a_temperature_is_refused(tmp_path: Path) -> None:
    file = laser(tmp_path)
    (tmp_path / "Temperatur.csv").write_text("T_x_nut [°C],T_bed [°C]\n20.1,20.2\n20.2,20.3\n", encoding="utf-8")
    with pytest.raises(MeasurementError, match=r"Temperatur\.csv: no column of times"):
        propose(file, MACHINE, {"temperatures": {"file": "Temperatur.csv"}}, {"axis": "X"})
    (tmp_path / "Temperatur.csv").write_text("Zeit;Weg [mm]\n08:00:00;1,5\n08:00:30;2,5\n")
    with pytest.raises(MeasurementError, match=r"Temperatur\.csv: no column of temperatures"):
        propose(file, MACHINE, {"temperatures": {"file": "Temperatur.csv"}}, {"axis": "X"})


def test_a_gap_in_the_log_is_not_bridged(tmp_path: Path) -> None:
    """Oracle: the logger was off from 08:05 to 08:25; that is more than ten minutes."""
    file, path = laser(tmp_path), log(tmp_path)
    kept = [x for x in path.read_bytes().split(b"\r\n") if not b" 08:05" <= x[10:16] < b" 08:25"]
    path.write_bytes(b"\r\n".join(kept))
    asked = propose(file, MACHINE, {"temperatures": {"file": path.name}}, {"axis": "X"})
    got = import_table(file, asked.import_map()).columns["T_x_nut_degc"]
    at_s = 6.0 + STEP_S * np.arange(READINGS)
    np.testing.assert_array_equal(np.isnan(got), (at_s > 270.0 + LOG_STEP_S) & (at_s < 1500.0 - LOG_STEP_S))


def test_two_files_of_different_form_name_the_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["import", str(laser(tmp_path)), str(log(tmp_path)), "-m", str(TURNING), "-a", "axis=X"]
    assert status([*command, "-o", str(tmp_path / "made")]) == 2
    assert "--temperatures" in capsys.readouterr().err


def test_a_log_alone_names_the_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["import", str(log(tmp_path)), "-m", str(TURNING), "-o", str(tmp_path / "made")]) == 2
    assert "--temperatures" in capsys.readouterr().err


def test_a_map_that_names_no_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"\[temperatures\] file is missing"):
        propose(laser(tmp_path), MACHINE, {"temperatures": {"source": {"delimiter": ";"}}}, {"axis": "X"})
