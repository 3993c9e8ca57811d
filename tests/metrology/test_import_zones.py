"""Time zones: a file whose times have one beside a log in local time, and the hour that comes twice in autumn.

Oracle: the same instants, written by `datetime` and `zoneinfo` in several zones; the nut's temperature at each.
"""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import import_table, load_map

TURNING = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
MACHINE = load_machine(TURNING)
BERLIN = ZoneInfo("Europe/Berlin")
SUMMER = datetime(2026, 3, 31, 5, 3, tzinfo=UTC)
AUTUMN = datetime(2026, 10, 24, 23, 40, tzinfo=UTC)
"""Twenty minutes before the hour that comes twice in Berlin."""
STEP_S, ROWS = 30, 240


def nut_degc(moment: datetime, began: datetime) -> float:
    return 20.0 + (moment - began).total_seconds() / 600.0


def local(moment: datetime) -> str:
    return f"{moment.astimezone(BERLIN):%Y-%m-%d %H:%M:%S}"


WRITTEN: dict[str, Callable[[datetime], str]] = {
    "offset": lambda t: t.astimezone(BERLIN).isoformat(),
    "Z": lambda t: f"{t:%Y-%m-%dT%H:%M:%SZ}",
    "Unix": lambda t: f"{t.timestamp():.0f}",
}


def laser(folder: Path, began: datetime, write: Callable[[datetime], str], head: str = "Time") -> Path:
    lines = [f"{head},Target X [mm],Deviation [um]"]
    for i in range(ROWS):
        x = float(abs(100 - (i * 10) % 200))
        lines.append(f"{write(began + timedelta(seconds=STEP_S * i))},{x:.1f},{0.01 * x + 0.1 * (i % 3):.2f}")
    path = folder / "laser.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def log(folder: Path, began: datetime, write: Callable[[datetime], str] = local) -> Path:
    lines = ["timestamp,T_x_nut [degC]"]
    for s in range(-600, STEP_S * ROWS + 600, 60):
        when = began + timedelta(seconds=s)
        lines.append(f"{write(when)},{nut_degc(when, began):.4f}")
    path = folder / "log.csv"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def imported(file: Path, folder: Path, *answers: str, logged: Path | None = None) -> int:
    more = ["--temperatures", str(logged)] if logged is not None else []
    said = [w for a in ("axis=X", *answers) for w in ("-a", a)]
    return status(["import", str(file), *more, "-m", str(TURNING), *said, "-o", str(folder / "out"), "--force"])


def expected(began: datetime) -> list[float]:
    return [nut_degc(began + timedelta(seconds=STEP_S * i), began) for i in range(ROWS)]


@pytest.mark.parametrize("form", WRITTEN)
def test_the_zone_of_a_local_log_is_asked_where_the_file_says_its_own(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As it was, local times were taken as UTC, and every temperature was two hours off without a word."""
    head = "Unix time" if form == "Unix" else "Time"
    file, logged = laser(tmp_path, SUMMER, WRITTEN[form], head), log(tmp_path, SUMMER)
    assert imported(file, tmp_path, logged=logged) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "log.csv: No time zone is in it; laser.csv says" in said
    assert "zone of log=" in said
    assert not (tmp_path / "out.csv").exists()
    for zone in ("Europe/Berlin", "+02:00"):
        assert imported(file, tmp_path, f"zone of log={zone}", logged=logged) == 0
        made = load_measurement(tmp_path / "out", MACHINE)
        np.testing.assert_allclose(made.channels["T_x_nut"], expected(SUMMER), atol=1e-3)
    again = import_table(file, load_map(tmp_path / "out-map.toml"))
    np.testing.assert_allclose(again.columns["T_x_nut_degc"], expected(SUMMER), atol=1e-3)


def test_the_zone_of_the_file_is_asked_where_only_the_log_says_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, logged = laser(tmp_path, SUMMER, local), log(tmp_path, SUMMER, WRITTEN["Z"])
    assert imported(file, tmp_path, logged=logged) == 2
    assert "No time zone is in laser.csv; log.csv says UTC" in " ".join(capsys.readouterr().err.split())
    assert imported(file, tmp_path, "zone=Europe/Berlin", logged=logged) == 0
    made = load_measurement(tmp_path / "out", MACHINE)
    np.testing.assert_allclose(made.channels["T_x_nut"], expected(SUMMER), atol=1e-3)
    assert any("time 0 is 2026-03-31 07:03:00 +02:00" in n for n in made.notes)


def test_a_log_without_a_date_goes_by_the_clock_of_its_zone(tmp_path: Path) -> None:
    file = laser(tmp_path, SUMMER, WRITTEN["Z"])
    logged = log(tmp_path, SUMMER, lambda t: f"{t.astimezone(BERLIN):%H:%M:%S}")
    assert imported(file, tmp_path, logged=logged) == 2
    assert imported(file, tmp_path, "zone of log=Europe/Berlin", logged=logged) == 0
    made = load_measurement(tmp_path / "out", MACHINE)
    np.testing.assert_allclose(made.channels["T_x_nut"], expected(SUMMER), atol=1e-3)


def test_two_files_of_one_local_clock_are_not_asked_about(tmp_path: Path) -> None:
    assert imported(laser(tmp_path, SUMMER, local), tmp_path, logged=log(tmp_path, SUMMER)) == 0


def test_the_hour_that_comes_twice_is_told_apart_by_the_zone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As it was, the advice was to let every run begin its clock again, or to sort the rows: both are wrong."""
    file, logged = laser(tmp_path, AUTUMN, local), log(tmp_path, AUTUMN)
    assert imported(file, tmp_path, logged=logged) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "Local time falls by an hour, as at the end of summer time. In which time zone are its times?" in said
    berlin = ("zone=Europe/Berlin", "zone of log=Europe/Berlin")
    assert imported(file, tmp_path, *berlin, logged=logged) == 0
    made = load_measurement(tmp_path / "out", MACHINE)
    np.testing.assert_allclose(np.diff(made.time_s), STEP_S)
    np.testing.assert_allclose(made.channels["T_x_nut"], expected(AUTUMN), atol=1e-3)


def test_a_zone_that_does_not_exist_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, logged = laser(tmp_path, SUMMER, WRITTEN["Z"]), log(tmp_path, SUMMER)
    assert imported(file, tmp_path, "zone of log=Europe/Atlantis", logged=logged) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "'Europe/Atlantis' is no time zone, such as Europe/Berlin, UTC or +02:00" in said


def test_a_map_by_hand_without_the_zone_is_refused(tmp_path: Path) -> None:
    file, logged = laser(tmp_path, SUMMER, WRITTEN["Z"]), log(tmp_path, SUMMER)
    assert imported(file, tmp_path, "zone of log=+02:00", logged=logged) == 0
    path = tmp_path / "out-map.toml"
    path.write_text(path.read_text(encoding="utf-8").replace('zone = "+02:00"\n', ""), encoding="utf-8")
    with pytest.raises(MeasurementError, match=r"says no time zone, and laser.csv says one; .*\[temperatures.time\]"):
        import_table(file, load_map(path))
