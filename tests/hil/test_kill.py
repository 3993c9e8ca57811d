"""The loop is killed with SIGKILL at random points; the machine goes on, the next loop takes over.

Oracle: the simulated machine, which outlives every loop: what it was told and what it has inserted, by its own account.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.correction.flags import MODE_HOLD, MODE_ON
from tests.hil.test_run import faulty_run, only_log
from tests.support import faulty, proof, setups

KILLS = proof.of(200, 40)

pytestmark = pytest.mark.xdist_group("real-clock")


def killed(folder: Path, kind: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.support.kill_rig", str(folder), str(KILLS), "1", kind]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, cwd=Path(__file__).parents[2]
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("kind", ["box", "register"])
def test_kills_at_random_points(tmp_path: Path, kind: str) -> None:
    """No jump, no count lost, no order of the operator forgotten, whether the actuator can tell its ledger or not."""
    found = killed(tmp_path, kind)
    assert (found["alive"], len(found["begins"])) == (KILLS, KILLS)
    commands = np.array(found["commands"])
    output = commands[:, 3:]
    assert len(commands) > 50 * KILLS
    assert np.ptp(output[:, 0]) > 20

    # One cycle's 0.1 counts are one count at most, however long nobody commanded. A register cannot say that it never
    # got the command that died on its way; a real start repeats that first (the rehearsal), this short one does not.
    assert np.abs(np.diff(output, axis=0)).max() <= (1 if kind == "box" else 2)

    # Between what was kept and what the machine has lies one cycle's command at most, the one that died on the way.
    assert np.abs(np.array(found["saved"]) - found["inserted"]).max() <= 1
    for begin in found["begins"][1:]:
        told = output[begin["after"] - 1]
        off = np.abs(np.array(begin["output"]) - told).max()
        assert off == 0 if kind == "box" else off <= 1
        # Kept in every cycle: of the last command, or of the one that died on its way.
        assert 0 <= begin["kept_ns"] - commands[begin["after"] - 1, 0] <= 1_000_000
    assert {begin["mode"] for begin in found["begins"]} == {MODE_ON, MODE_HOLD}


def rtec_again(tmp_path: Path, name: str, *options: str) -> "subprocess.CompletedProcess[str]":
    """The same run file once more, on a machine to which nothing happens."""
    command = [sys.executable, "-m", "rtec.cli.main", "run", str(tmp_path / "run.toml"), "--json", *options]
    env = faulty.install(tmp_path / name)
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=240, check=False)


def test_the_daemon_after_a_kill(tmp_path: Path, runtime_folder: Path) -> None:
    """Supervisor and loop die together; the next start finds ledger and mode, and a machine that has lost its own.

    The simulated machine dies with the loop that it lives in: the next one begins with a ledger of zero, as a box that
    was reset. So the correction holds at what the machine has until the order to resume comes; it never does here.
    """
    done = faulty_run(tmp_path, happens="kill_all", at_cycle=2000)
    assert done.returncode < 0
    (kept,) = runtime_folder.glob("rtec.*.state")
    assert kept.stat().st_mode & 0o777 == 0o600
    for log in (tmp_path / "logs").glob("*.arrows"):
        log.unlink()
    content = setups.tables(tmp_path, driver="faulty")
    setups.write(tmp_path, content)
    again = rtec_again(tmp_path, "second", "--duration", "1")
    assert again.returncode == 0, again.stderr
    facts = json.loads(again.stdout)
    assert any("did not end in order" in w and "mode 'on'" in w for w in facts["warnings"])
    assert any("it restarted" in w and "ordered to resume" in w for w in facts["warnings"])
    assert facts["output"] == {"X": 0, "Z": 0}
    assert facts["flags_seen"]["ORDERED_HOLD"] == 1.0
    assert "it restarted" in facts["devices"]["box"]["last"]["state"]
    assert only_log(tmp_path).exists()
    # It waited until its end: so does the next one.
    third = json.loads(rtec_again(tmp_path, "third", "--duration", "0.2").stdout)
    assert any("stopped while it waited" in w for w in third["warnings"])


@pytest.mark.usefixtures("runtime_folder")
def test_one_run_file_one_loop(tmp_path: Path) -> None:
    """Two loops on one machine would each undo the other's correction. Oracle: the kernel's file lock."""
    import fcntl

    from rtec.loop.state_files import state_places

    config = setups.write(tmp_path, setups.tables(tmp_path))
    path = state_places(config, None).memory
    fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(fd, fcntl.LOCK_EX)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "rtec.cli.main", "run", str(config), "--duration", "0.2"],
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
    finally:
        os.close(fd)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("rtec: another rtec runs with this run file")
