"""The log of a real run, in several files and on a full disk. Oracles: the run's own count of cycles; `rtec replay`."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.log.folder import log_files
from rtec.log.reader import open_log
from rtec.log.tidy import tidy
from tests.support import setups
from tests.support.command import here

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]


def rtec(*arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "rtec.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)


def logged(folder: Path) -> Iterator[int]:
    """Instants of all rows in the order of the files."""
    for path in log_files(folder):
        with open_log(path) as log:
            for samples, _ in log.blocks():
                yield from samples.time_ns.tolist()


def test_a_run_in_several_files_replays_from_each_of_them(tmp_path: Path) -> None:
    """No row is lost or written twice at the change; every file begins with the memory of the step; packed too."""
    content: dict[str, Any] = setups.tables(tmp_path)
    content["log"] = {"segment_mb": 0.02}
    config = setups.write(tmp_path, content)
    done = rtec("run", config, "--duration", 5, "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert (facts["cycles"], facts["rows_not_logged"]) == (5000, 0)
    folder = tmp_path / "logs"
    assert len(log_files(folder)) >= 2  # a busy PC writes seldom, and much at once
    before = list(logged(folder))
    assert len(before) == 5000
    assert (np.diff(before) > 0).all()
    for _ in range(2):
        checked = here("replay", config, folder)
        assert (checked.returncode, checked.stdout) == (0, "5000 commands checked: all bit-identical\n")
        tidy(folder, 1 << 60)
    assert {p.suffix for p in log_files(folder)} == {".parquet"}
    assert list(logged(folder)) == before


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to mount a small disk")
def test_on_a_full_disk_the_correction_goes_on_and_every_row_is_accounted_for(tmp_path: Path) -> None:
    """Oracle: the kernel's ENOSPC on a disk of 300 kB, full after about a second."""
    content: dict[str, Any] = setups.tables(tmp_path)
    content["run"]["state_folder"] = str(tmp_path)
    config = setups.write(tmp_path, content)
    folder = tmp_path / "logs"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no right to mount a small disk")
    try:
        done = rtec("run", config, "--duration", 4, "--json")
        kept = len(list(logged(folder)))
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["cycles"] == 4000
    assert 500 < kept < 3000
    assert facts["rows_not_logged"] == 4000 - kept
    assert np.abs(list(facts["applied_um"].values())).max() > 10.0
    (told,) = [w for w in facts["warnings"] if w.startswith("logging stopped, the correction went on")]
    assert "No space left on device" in told


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to mount a small disk")
def test_a_log_that_was_never_made_is_not_named(tmp_path: Path) -> None:
    """Oracle: the kernel's ENOSPC on a disk that has no room for another file."""
    content: dict[str, Any] = setups.tables(tmp_path)
    content["run"]["state_folder"] = str(tmp_path)
    config = setups.write(tmp_path, content)
    folder = tmp_path / "logs"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8k,nr_inodes=2", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no right to mount a small disk")
    try:
        (folder / "full").touch()
        done = rtec("run", config, "--duration", 1, "--json")
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["rows_not_logged"] == facts["cycles"] == 1000
    assert facts["log"] is None
