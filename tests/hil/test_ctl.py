"""`rtec run` in a process of its own, looked at and ordered about by `rtec status` and `rtec ctl`.

Oracles: what the commands say against the log's rows and the events beside it; the exit status.
"""

import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from rtec.control.client import Client, find
from rtec.control.places import answers, socket_path
from rtec.correction.flags import Flag
from rtec.log.reader import LogReader
from rtec.loop.clock import RealClock
from tests.hil.test_run import rtec
from tests.support import setups
from tests.support.command import here
from tests.support.control_rig import Line
from tests.support.modbus_peer import until

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]
PERIOD_NS = 20_000_000
START_NS = 120_000_000_000
SLEW_UM_S = 50.0
ANSWERED = (0, 1)
"""Statuses of `rtec status` where a daemon answers; 1: in trouble, as its loop may be that a busy computer holds up."""


class Running:
    """A daemon that runs until it is told to end."""

    def __init__(self, config: Path, log: Path) -> None:
        self.config, self.log = config, log
        command = [sys.executable, "-m", "rtec.cli.main", "run", str(config), "--log", str(log), "--json"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )

    def until_it_runs(self) -> None:
        """Wait for its first row."""
        clock = RealClock()
        last_ns = clock.now_ns() + START_NS
        while clock.now_ns() < last_ns:
            assert self.process.poll() is None, self.process.communicate()[1]
            if answers(socket_path(self.config)):
                with Client(find(self.config, None, None), wait_s=20.0) as client:
                    if client.status()["status"]["cycles"]:
                        return
            clock.sleep_until_ns(clock.now_ns() + PERIOD_NS)
        raise AssertionError("the daemon did not begin")

    def children(self) -> list[int]:
        """The processes that it started."""
        return [int(p) for p in Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()]

    def end(self) -> dict[str, Any]:
        """End it in order; give its summary."""
        self.process.send_signal(signal.SIGTERM)
        out, err = self.process.communicate(timeout=60)
        assert self.process.returncode == 130, err
        found = json.loads(out)
        assert isinstance(found, dict)
        return found


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Running]:
    content = setups.tables(tmp_path)
    content["control"] = {"status_hz": 50}
    running = Running(setups.write(tmp_path, content), tmp_path / "log.arrows")
    try:
        running.until_it_runs()
        yield running
    finally:
        running.process.kill()
        running.process.communicate()


def events(running: Running) -> list[dict[str, Any]]:
    lines = running.log.with_suffix(".events.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def test_every_order_by_the_command_line(daemon: Running) -> None:
    """Each says what came of it; the log has it at the row that the events name, and nowhere a jump."""
    said = {}
    for name in ("hold", "enable", "fade", "resume"):
        if name == "resume":  # the fade has ended: a resume goes on from whole counts, which is no limited motion
            assert until(lambda: not any(status(daemon)["status"]["applied_um"].values()))
        done = rtec("ctl", name, daemon.config)
        assert done.returncode == 0, done.stderr
        said[name] = done.stdout
    assert "stays where it is; applied now: X " in said["hold"]
    assert "goes to nothing" in said["fade"]
    assert "go on from where they are" in said["resume"]
    marked = here("ctl", "mark", "first part", daemon.config, "--json")
    assert json.loads(marked.stdout)["text"].endswith(": first part")

    content = tomllib.loads(daemon.config.read_text(encoding="utf-8"))
    content["limits"]["X"]["stop_um"] = 80.0
    daemon.config.write_text(tomli_w.dumps(content), encoding="utf-8")
    assert here("ctl", "reload", daemon.config).stdout == "reloaded: limits of X\n"
    daemon.config.write_text("[run", encoding="utf-8")
    spoilt = here("ctl", "reload", daemon.config)
    assert spoilt.returncode == 1
    assert "the old one stays in force" in spoilt.stdout

    shown = rtec("status", daemon.config)
    assert shown.returncode in ANSWERED, shown.stdout
    assert "mode off: the correction goes to nothing" in shown.stdout
    assert "deadlines missed" in shown.stdout
    summary = daemon.end()
    found = events(daemon)
    assert [e["what"] for e in found] == [
        *("hold", "enable", "fade", "resume", "mark"),
        *("reload", "reloaded", "reload", "not reloaded"),
    ]
    with LogReader(daemon.log) as reader:
        blocks = list(reader.blocks())
    flags = [int(f) for _, commands in blocks for f in commands.flags]
    um = np.concatenate([commands.applied_um for _, commands in blocks])
    ns = np.concatenate([samples.time_ns for samples, _ in blocks])
    assert (np.abs(np.diff(um, axis=0)).max(axis=1) <= SLEW_UM_S * np.diff(ns) * 1e-9 * (1 + 1e-9)).all()
    held = [k for k, f in enumerate(flags) if f & Flag.ORDERED_HOLD and k < found[2]["row"]]
    assert found[0]["row"] <= held[0] <= found[0]["row"] + 500
    assert held[-1] <= found[1]["row"] + 500
    sys.stdout.write(f"deadlines missed: {summary['deadline_misses']} of {summary['cycles']}\n")


def test_from_another_computer(daemon: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    """`--at` and a program in the place of ssh, which does what sshd does with a key that is bound to a command."""
    folder = daemon.config.parent
    ssh = folder / "bin" / "ssh"
    ssh.parent.mkdir()
    relay = f"{sys.executable} -m rtec.cli.main ctl relay {daemon.config}"
    ssh.write_text(
        f'#!/bin/sh\ncase "$*" in *office@*) exec {relay} --name office;; esac\n'
        f"exec {relay} --role operate --name cell\n"
    )
    ssh.chmod(0o755)
    monkeypatch.setenv("PATH", f"{ssh.parent}:{os.environ['PATH']}")
    told = json.loads(here("status", daemon.config, "--json").stdout)
    assert json.loads(here("status", "--at", "office@mill", "--json").stdout)["pid"] == told["pid"]
    refused = here("ctl", "fade", "--at", "office@mill")
    assert refused.returncode == 2
    assert refused.stderr.startswith("rtec: refused: office (")
    assert here("ctl", "fade", "--at", "cell@mill").returncode == 0
    daemon.end()
    assert [(e["what"], e["who"].split()[0]) for e in events(daemon)][:2] == [("refused", "rtec"), ("fade", "cell")]


def test_a_hundred_subscribers_slow_and_dead_ones_too(daemon: Running) -> None:
    """All that listen hear every row's status; whoever does not read, or vanished, keeps nobody waiting.

    Deadlines missed are told, not judged: the test's own hundred sockets share the processors with the loop.
    """
    before = status(daemon)["status"]
    with ExitStack() as opened:
        *listening, slow, dead = (opened.enter_context(Line.to(daemon.config)) for _ in range(102))
        for one in (*listening, slow, dead):
            one.send(b'{"schema":1,"ask":"watch"}')
        dead.socket.close()
        seen = [0] * len(listening)
        for _ in range(50):
            for k, one in enumerate(listening):
                cycles = (one.receive() or {})["status"]["cycles"]
                assert cycles >= seen[k]
                seen[k] = cycles
        assert slow.receive() is not None
    after = status(daemon)["status"]
    assert after["overruns"] == 0
    daemon.end()
    sys.stdout.write(
        f"deadlines missed: {before['misses']} of {before['cycles']} before, "
        f"{after['misses'] - before['misses']} of {after['cycles'] - before['cycles']} meanwhile\n"
    )


def status(running: Running) -> dict[str, Any]:
    with Client(find(running.config, None, None)) as client:
        return client.status()


def test_no_daemon_and_a_killed_one(tmp_path: Path) -> None:
    """The message says how to go on; what a killed daemon left behind is no daemon, and is in nobody's way."""
    config = setups.write(tmp_path, setups.tables(tmp_path))
    for arguments in (("status", config), ("ctl", "hold", config)):
        found = here(*arguments)
        assert found.returncode == 2
        assert f"no daemon runs with {config}: start one with `rtec run {config}`" in found.stderr
    running = Running(config, tmp_path / "log.arrows")
    try:
        running.until_it_runs()
        for pid in running.children():  # the loop outlives its supervisor, and keeps none of its sockets
            os.kill(pid, signal.SIGSTOP)
        running.process.kill()
        running.process.wait()
        assert socket_path(config).exists()
        assert not answers(socket_path(config))
    finally:
        os.killpg(running.process.pid, signal.SIGKILL)
        running.process.communicate()
    assert socket_path(config).exists()
    assert here("status", config).returncode == 2
    again = Running(config, tmp_path / "log-2.arrows")
    try:
        again.until_it_runs()
        second = rtec("run", config, "--duration", 1)
        assert second.returncode == 2
        assert "another rtec runs with this run file" in second.stderr
        assert here("status", config).returncode in ANSWERED
        again.end()
    finally:
        again.process.kill()
        again.process.communicate()
    assert not socket_path(config).exists()


@pytest.mark.parametrize("folder", ["on disk", "in memory"])
def test_an_ordered_hold_stays_over_an_orderly_restart(tmp_path: Path, folder: str) -> None:
    """Whether the run file names a folder for the state or not. Oracle: the orders; the run file's mode is on."""
    content = setups.tables(tmp_path)
    if folder == "in memory":
        del content["run"]["log_folder"]
    config = setups.write(tmp_path, content)

    def run(order: str, before: str, after: str) -> None:
        running = Running(config, tmp_path / f"{order}.arrows")
        try:
            running.until_it_runs()
            assert status(running)["status"]["mode"] == before
            assert here("ctl", order, config).returncode == 0
            assert until(lambda: status(running)["status"]["mode"] == after)
            running.end()
        finally:
            running.process.kill()
            running.process.communicate()

    run("hold", before="on", after="hold")
    run("enable", before="hold", after="on")
    run("fade", before="on", after="off")


def test_a_sensor_that_holds_the_correction_is_named_and_the_exit_status_is_1(
    tmp_path: Path,
) -> None:
    """Oracle: docs/runbook.md, SENSOR_FAULT. The machine file says that T_bed never reads more than 5 °C."""
    content = setups.tables(tmp_path)
    machine = tomllib.loads(Path(content["run"]["machine"]).read_text(encoding="utf-8"))
    machine["temperature"]["T_bed"]["range_degc"] = [0.0, 5.0]
    content["run"]["machine"] = str(tmp_path / "machine.toml")
    (tmp_path / "machine.toml").write_text(tomli_w.dumps(machine), encoding="utf-8")
    running = Running(setups.write(tmp_path, content), tmp_path / "log.arrows")
    try:
        running.until_it_runs()
        shown, found = here("status", running.config), here("status", running.config, "--json")
    finally:
        running.process.kill()
        running.process.communicate()
    assert shown.returncode == found.returncode == 1
    status = json.loads(found.stdout)["status"]
    assert status["devices"] == {}
    assert status["causes"]["SENSOR_FAULT"].startswith("sensor T_bed of device box reads ")
    assert "and its range is 0 to 5 °C" in " ".join(shown.stdout.split())
