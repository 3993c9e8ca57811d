"""`rtec run --step`: a simulated machine that stands still is moved by a step, and back. Real processes and clock.

Oracle: the machine's own encoder. Its controller keeps what it sees where it was, so the slide goes the other way than
the inserted counts: raw counts grow by the step where the correction is positive.
"""

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.cli.run import show_report
from rtec.daemon.sign_check import with_step
from rtec.daemon.status import Status
from rtec.daemon.supervisor import Supervisor
from rtec.log.reader import LogReader
from rtec.loop.run_file import load_setup
from tests.support import faulty, setups

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]
LONGEST_S = 60.0
LATE_UM = 0.1
"""A cycle that comes late brakes late, within its acceleration: a fifth of a count."""
STANDS = "G4 X3600"


def rtec(*arguments: object, env: dict[str, str] | None = None) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "rtec.cli.main", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, env=env, start_new_session=True, timeout=240, check=False
    )


def arrays(log: Path) -> tuple[Any, Any, Any]:
    """Instants, s; raw counts; applied corrections, µm."""
    with LogReader(log) as reader:
        blocks = list(reader.blocks())
    time_s = np.concatenate([s.time_ns for s, _ in blocks]) * 1e-9
    return time_s, np.concatenate([s.counts for s, _ in blocks]), np.concatenate([c.applied_um for _, c in blocks])


def test_the_axis_goes_by_the_step_and_back_within_its_limits(tmp_path: Path) -> None:
    config = setups.write(tmp_path, setups.tables(tmp_path, program=STANDS))
    log = tmp_path / "step.arrows"
    done = rtec("run", config, "--step", "X=20um", "--duration", 2.5, "--log", log, "--json")
    assert done.returncode == 0, done.stderr
    assert "axis X goes by +20 µm" in done.stderr
    facts = json.loads(done.stdout)
    assert facts["output"] == {"X": 0, "Z": 0}
    assert not any("way back" in w or "ledger" in w for w in facts["warnings"]), facts["warnings"]
    time_s, counts, applied_um = arrays(log)
    x_um = applied_um[:, 0]
    assert (x_um[0], x_um[-1]) == (0.0, 0.0)
    assert x_um.max() == pytest.approx(20.0, abs=LATE_UM)
    assert not applied_um[:, 1].any()
    assert (np.abs(np.diff(x_um)) <= 50.0 * np.diff(time_s).max() * (1 + 1e-9)).all()  # slew_um_s of the run file
    there = np.flatnonzero(np.abs(x_um - 20.0) < 1e-3)[500:]
    assert len(there) > 500
    moved = np.median(counts[there], axis=0) - counts[0]
    counts_per_um = 2.0  # of the shipped turning centre
    assert moved[0] == pytest.approx(20.0 * counts_per_um, abs=1.5)
    assert abs(moved[1]) <= 1.0
    assert not list(tmp_path.rglob("logs/*.arrows"))  # a replay of the ordinary logs would meet another model there


def test_ctrl_c_takes_the_step_back_before_it_ends(tmp_path: Path) -> None:
    """What the actuator was told last is nothing, although the machine was 15 µm away when Ctrl-C came."""
    told = tmp_path / "told"
    env = faulty.install(tmp_path / "site")
    tables = setups.tables(tmp_path, driver="faulty", program=STANDS, happens="ctrl_c", at_cycle=900, told=str(told))
    done = rtec("run", setups.write(tmp_path, tables), "--step", "Z=-15um", "--json", env=env)
    assert done.returncode == 130, done.stderr
    assert json.loads(done.stdout)["largest_um"] == pytest.approx({"X": 0.0, "Z": 15.0}, abs=LATE_UM)
    applied = [line for line in told.read_text().splitlines() if line.startswith("apply")]
    assert applied[-1] == "apply [0, 0]"


def test_a_slow_actuator_is_back_at_nothing_before_it_ends(tmp_path: Path) -> None:
    """Oracle: the actuator's own output at the end. It takes an offset every 0.5 s, later than the correction is 0."""
    tables = setups.tables(tmp_path, actuator="origin_offset", unit_um=0.1, program=STANDS)
    sink = {"kind": "origin_offset", "resolution_um": 0.1, "period_s": 0.5}
    tables["output"] = {"X": sink, "Z": sink}
    setup = with_step(load_setup(setups.write(tmp_path, tables)), {"X": 20.0})
    interrupted_with: list[int] = []

    def look(status: Status) -> None:
        assert status.time_s < LONGEST_S
        if not interrupted_with and status.output.get("X") == 200:
            interrupted_with.append(status.output["X"])
            signal.raise_signal(signal.SIGINT)

    report = Supervisor(setup, None, on_status=look).run(None)
    assert report.interrupted
    assert interrupted_with == [200]
    assert report.summary["output"] == report.status.output == {"X": 0, "Z": 0}
    assert not report.unfinished


def test_a_second_ctrl_c_ends_at_once_and_says_where_it_stands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first at 4 µm of the way, the second while it goes back, at 2 µm a second: some micrometres are left."""
    tables = setups.tables(tmp_path, program=STANDS)
    tables["limits"]["X"]["slew_um_s"] = 2.0
    setup = with_step(load_setup(setups.write(tmp_path, tables)), {"X": 20.0})
    interrupted_at_um: list[float] = []

    def look(status: Status) -> None:
        x_um = status.applied_um.get("X", 0.0)
        assert status.time_s < LONGEST_S
        first, second = len(interrupted_at_um) == 0, len(interrupted_at_um) == 1
        if (first and x_um > 4.0) or (second and status.mode == "off" and x_um < interrupted_at_um[0] - 0.5):
            interrupted_at_um.append(x_um)
            signal.raise_signal(signal.SIGINT)

    report = Supervisor(setup, None, on_status=look).run(None)
    assert report.interrupted
    assert len(interrupted_at_um) == 2
    left_um = report.status.applied_um["X"]
    assert 2.0 < left_um < interrupted_at_um[0]
    assert report.unfinished == f"the way back to nothing was not finished, and is held at X {left_um:+.2f} µm"
    show_report(setup, report)
    said = capsys.readouterr().out
    assert report.unfinished in said
    assert "zero" not in said
