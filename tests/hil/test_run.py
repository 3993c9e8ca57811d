"""`rtec run` as a user starts it: real processes, real clock, the simulated machine behind the ordinary driver ports.

What happens to a run happens at a given cycle, from inside the driver, so no test waits for the clock.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.log.reader import LogReader
from tests.support import faulty, setups
from tests.support.command import here

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]


def rtec(*arguments: object, env: dict[str, str] | None = None) -> "subprocess.CompletedProcess[str]":
    """Run the command line in a process group of its own."""
    command = [sys.executable, "-m", "rtec.cli.main", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, env=env, start_new_session=True, timeout=240, check=False
    )


def faulty_run(tmp_path: Path, *options: object, **device: Any) -> "subprocess.CompletedProcess[str]":
    """Run the machine that something happens to."""
    env = faulty.install(tmp_path / "site")
    config = setups.write(tmp_path, setups.tables(tmp_path, driver="faulty", **device))
    return rtec("run", config, "--json", *options, env=env)


def only_log(tmp_path: Path) -> Path:
    """The one log that was written."""
    (log,) = (tmp_path / "logs").glob("*.arrows")
    return log


def rings_left() -> list[str]:
    """Rings of rtec that nobody removed and whose owner is gone: "rtec-", the owner's number, "-" and a word."""
    rings = [p.name for p in Path("/dev/shm").glob("rtec-*-*") if p.name.split("-")[1].isdigit()]  # noqa: S108
    return [name for name in rings if not Path("/proc", name.split("-")[1]).exists()]


@pytest.fixture(autouse=True)
def _no_rings_of_earlier_faults() -> None:
    """A test that failed may have left one; the next is to be judged by its own."""
    for name in rings_left():
        (Path("/dev/shm") / name).unlink()  # noqa: S108


def test_a_run_its_log_and_its_replay(tmp_path: Path) -> None:
    """Every cycle is in the log; the log replays to the same bits; a changed limit does not."""
    config = setups.write(tmp_path, setups.tables(tmp_path))
    done = rtec("run", config, "--duration", 1.5, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["cycles"] == 1500
    assert facts["rows_not_logged"] == 0
    log = only_log(tmp_path)
    with LogReader(log) as reader:
        assert (reader.rows, reader.complete) == (1500, True)
        blocks = list(reader.blocks())
    assert blocks[-1][1].output[-1].tolist() == list(facts["output"].values())
    applied_um = np.concatenate([commands.applied_um for _, commands in blocks])
    time_ns = np.concatenate([samples.time_ns for samples, _ in blocks])
    moved = np.abs(np.diff(applied_um, axis=0)).max()
    gap_s = np.diff(time_ns).max() * 1e-9
    assert moved <= 50.0 * gap_s * (1 + 1e-9)
    assert np.abs(list(facts["applied_um"].values())).max() > 10.0
    assert list(facts["largest_um"].values()) == np.abs(applied_um).max(axis=0).tolist()
    checked = here("replay", config, log, "--check")
    assert (checked.returncode, checked.stdout) == (0, "1500 commands checked: all bit-identical\n")

    content = setups.tables(tmp_path)
    content["limits"]["X"]["slew_um_s"] = 49.0
    (tmp_path / "other").mkdir()
    other = here("replay", setups.write(tmp_path / "other", content), log, "--check")
    assert other.returncode == 1
    assert "applied_um was" in other.stdout
    assert "the run file is not the one that the log was made with" in other.stdout


def test_ctrl_c_holds_flushes_closes_and_says_so(tmp_path: Path) -> None:
    done = faulty_run(tmp_path, happens="ctrl_c", at_cycle=700, told=str(tmp_path / "told"))
    assert done.returncode == 130, done.stderr
    facts = json.loads(done.stdout)
    assert facts["interrupted"]
    assert 700 <= facts["cycles"] < 1500
    with LogReader(only_log(tmp_path)) as reader:
        assert (reader.rows, reader.complete) == (facts["cycles"], True)
    assert (tmp_path / "told").read_text().splitlines()[-2:] == ["held", "closed"]
    assert rings_left() == []


def test_ctrl_c_while_it_starts_is_no_error(tmp_path: Path) -> None:
    """Oracle: `formats.md`, 130 interrupted; the device was opened and closed in order, nothing was left behind."""
    told = tmp_path / "told"
    env = faulty.interrupt_at_once(tmp_path / "site", faulty.install(tmp_path / "site"))
    config = setups.write(tmp_path, setups.tables(tmp_path, driver="faulty", told=str(told)))
    done = rtec("run", config, env=env)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert "interrupted: correction held, log flushed, devices closed" in done.stdout
    assert told.read_text().splitlines()[-2:] == ["held", "closed"]
    assert rings_left() == []


def test_a_killed_run_keeps_its_log_but_for_the_last_second(tmp_path: Path) -> None:
    done = faulty_run(tmp_path, happens="kill_all", at_cycle=2600)
    assert done.returncode < 0
    log = only_log(tmp_path)
    with LogReader(log) as reader:
        assert not reader.complete
        assert 1600 <= reader.rows <= 2600
    checked = rtec("replay", tmp_path / "run.toml", log, "--check", env=faulty.install(tmp_path / "again"))
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert rings_left() == []


@pytest.mark.parametrize("at_cycle", [1 - faulty.REHEARSAL, 300])
def test_without_its_supervisor_the_loop_holds_and_ends(tmp_path: Path, at_cycle: int) -> None:
    """The pipe that the test reads ends when the last process that could write to it has ended: the loop's.

    Killed while the loop still makes itself ready, at its very first reading, and in the middle of the run.
    """
    told = tmp_path / "told"
    done = faulty_run(tmp_path, happens="kill_supervisor", at_cycle=at_cycle, told=str(told))
    assert done.returncode == -9
    lines = told.read_text().splitlines()
    assert lines[-2:] == ["held", "closed"]
    assert lines.count("held") == 1
    assert rings_left() == []


def test_an_output_beyond_the_stop_limit_gets_no_other_command_before_an_order(tmp_path: Path) -> None:
    """500 µm in the machine, 100 allowed. Oracle: the actuator's own list of commands, the rehearsal's too."""
    told = tmp_path / "told"
    done = faulty_run(tmp_path, "--duration", 0.3, has=[1000, 0], told=str(told))
    assert done.returncode == 0, done.stderr
    assert {line for line in told.read_text().splitlines() if line.startswith("apply")} == {"apply [1000, 0]"}


def test_a_duration_is_a_time_where_the_cycles_are_late(tmp_path: Path) -> None:
    """Readings of 50 ms in cycles of 1 ms. Oracle: 0.2 s and the second of grace hold some 24 of them, not 200."""
    done = faulty_run(tmp_path, "--duration", 0.2, happens="slow", at_cycle=1)
    assert done.returncode == 0, done.stderr
    assert 0 < json.loads(done.stdout)["cycles"] < 60


def test_a_slow_loop_without_its_supervisor_ends_in_its_next_cycle(tmp_path: Path) -> None:
    """At one cycle a second. Oracle: the actuator's own list of commands, none but that of the cycle of the kill.

    A start right after that finds the devices and the state free.
    """
    told = tmp_path / "told"
    content = setups.tables(tmp_path, driver="faulty", happens="kill_supervisor", at_cycle=1, told=str(told))
    content["run"]["rate_hz"] = 1.0
    done = rtec("run", setups.write(tmp_path, content), "--json", env=faulty.install(tmp_path / "site"))
    assert done.returncode == -9
    lines = told.read_text().splitlines()
    assert lines[-2:] == ["held", "closed"]
    assert sum(line.startswith("apply") for line in lines) == faulty.REHEARSAL + 1
    again = rtec("run", tmp_path / "run.toml", "--json", "--duration", "1", env=faulty.install(tmp_path / "again"))
    assert again.returncode == -9, "it ran, to the cycle in which it is killed again"


def test_a_correction_that_the_machine_has_already_is_taken_over(tmp_path: Path) -> None:
    """No jump at the start. Oracle: what the actuator held when it was opened, a count or so to either side."""
    done = faulty_run(tmp_path, "--duration", 0.05, has=[-30, 44])
    assert done.returncode == 0, done.stderr
    log = only_log(tmp_path)
    with LogReader(log) as reader:
        assert reader.header["initial_output"] == "[-30, 44]"
        output = np.concatenate([commands.output for _, commands in reader.blocks()])
    assert np.abs(output[0] - [-30, 44]).max() <= 1
    assert np.abs(np.diff(output, axis=0)).max() <= 1
    checked = rtec("replay", tmp_path / "run.toml", log, "--check", env=faulty.install(tmp_path / "again"))
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_a_silent_device_costs_no_cycle(tmp_path: Path) -> None:
    done = faulty_run(tmp_path, "--duration", 1.0, happens="silence", at_cycle=400)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["cycles"], facts["driver_errors"]) == (1000, 200)
    assert facts["last_error"] == "encoder box: no answer within 1 ms"
    assert facts["flags_seen"]["STALE_COUNTS"] == pytest.approx(0.195, abs=0.01)
    assert "HELD" in facts["flags_seen"]


def test_a_missing_port_is_one_clear_message(tmp_path: Path) -> None:
    done = faulty_run(tmp_path, happens="no_port")
    assert done.returncode == 2
    assert done.stderr == "rtec: [device.box] /dev/ttyUSB7: no such port; plug it in, or name another\n"
    assert list((tmp_path / "logs").glob("*")) == []
    assert rings_left() == []


def test_a_dry_run_commands_nothing(tmp_path: Path) -> None:
    told = tmp_path / "told"
    done = faulty_run(tmp_path, "--dry-run", told=str(told))
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert abs(facts["requested_um"]["X"]) > 5.0
    assert facts["reasons"] == []
    assert told.read_text().splitlines() == ["closed"]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: t["limits"].pop("Z"), "[limits.Z] is missing: axis Z is compensated and needs warning_um"),
        (lambda t: t["run"].update(rate_hzz=1000), "[run] unknown key 'rate_hzz'; did you mean 'rate_hz'?"),
        (lambda t: t["device"]["box"].update(driver="simm"), "no driver 'simm'; did you mean 'sim'?"),
        (lambda t: t["device"]["box"].update(program="G1 Q1"), "[device.box] program line 1 'G1 Q1': unknown word Q"),
        (lambda t: t["device"]["box"].update(sed=1), "unknown key 'sed'; did you mean 'seed'?"),
        (lambda t: t["role"].update(counts="bax"), "[role] counts: no [device.bax]; did you mean 'box'?"),
        (lambda t: t["limits"]["X"].update(warning_um=200.0), "warning_um 200 is above stop_um 100"),
        (
            lambda t: t.update(output={"X": {"kind": "following_error", "resolution_um": 0.5}}),
            "[output.X] [device.box] takes 'pulse', not 'following_error': write kind = \"pulse\" there",
        ),
        (
            lambda t: (
                t["device"]["box"].update(actuator="following_error", unit_um=0.1),
                t.update(
                    output={
                        k: {"kind": "following_error", "resolution_um": r}
                        for k, r in zip("XZ", (0.5, 0.1), strict=True)
                    }
                ),
            ),
            "has units of 0.1 µm (its option unit_um), the output has 0.5 µm",
        ),
        (lambda t: t["run"].update(model="absent.toml"), "absent.toml: no such file"),
        (lambda t: t["run"].update(rate_hz=5000.0), "must be from 1 to 4000, found 5000.0"),
    ],
)
def test_a_wrong_run_file_is_told_in_one_line(tmp_path: Path, spoil: Any, message: str) -> None:
    content = setups.tables(tmp_path)
    spoil(content)
    done = here("run", setups.write(tmp_path, content), "--duration", "0.1")
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_four_kilohertz(tmp_path: Path) -> None:
    content = setups.tables(tmp_path)
    content["run"]["rate_hz"] = 4000.0
    done = rtec("run", setups.write(tmp_path, content), "--duration", "0.5", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["cycles"] == 2000


def test_no_terminal_no_escape_codes(tmp_path: Path) -> None:
    config = setups.write(tmp_path, setups.tables(tmp_path))
    env = {k: v for k, v in os.environ.items() if k not in ("FORCE_COLOR", "CI", "GITHUB_ACTIONS")}
    done = rtec("run", config, "--duration", "0.2", env=env)
    assert done.returncode == 0, done.stderr
    assert "\x1b" not in done.stdout + done.stderr
    assert "turning-centre: running at 1000 Hz, log" in done.stderr
    assert "deadlines missed" in done.stdout


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None, reason="needs root, to give rights up")
def test_without_rights_one_plain_warning(tmp_path: Path) -> None:
    """Oracle: the kernel, asked without CAP_SYS_NICE and CAP_IPC_LOCK."""
    config = setups.write(tmp_path, setups.tables(tmp_path))
    poor = ["setpriv", "--bounding-set=-sys_nice,-ipc_lock,-sys_resource", "prlimit", "--memlock=65536"]
    command = [*poor, sys.executable, "-m", "rtec.cli.main", "run", str(config), "--duration", "0.3", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    (warning,) = json.loads(done.stdout)["warnings"]
    assert warning.startswith("no real-time treatment for: SCHED_FIFO priority 80, locking memory")
    assert json.loads(done.stdout)["cycles"] == 300
