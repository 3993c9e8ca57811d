"""The processes of `rtec telemetry`. Oracles: the broker's last will; what the kernel says of processes; the daemon."""

import json
import os
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from rtec.cli.main import status
from rtec.control.places import status_path
from rtec.control.server import Control
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.run_file import load_setup
from rtec.telemetry.processes import tasks
from tests.support import setups
from tests.support.conformance import soon
from tests.support.control_rig import LONG_S, Line, free_place
from tests.support.telemetry_rig import Broker, LivingDaemon, Subscriber, certificates

pytestmark = pytest.mark.xdist_group("real-clock")


def run_file(folder: Path, **telemetry: dict[str, Any]) -> Path:
    return setups.write(folder, {**setups.tables(folder), "telemetry": telemetry})


@contextmanager
def telemetry(config: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """`rtec telemetry` as a process."""
    process = subprocess.Popen([sys.executable, "-m", "rtec.cli.main", "telemetry", str(config)])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def children(pid: int) -> list[int]:
    """Processes that a process has started with our names, by the kernel."""
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    return [int(one) for one in listed if b"spawn_main" in Path(f"/proc/{one}/cmdline").read_bytes()]


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_a_killed_process_is_started_again(tmp_path: Path, runtime_folder: Path) -> None:
    """The daemon goes on to answer. A parent that is killed takes all of them along; the end in order says offline."""
    del runtime_folder
    with Broker(tmp_path) as broker, Subscriber(broker) as sub:
        config = run_file(tmp_path, mqtt={"broker": broker.place, "tls": False, "period_s": 0.1})
        setup, clock = load_setup(config), RealClock()
        with Control(setup, LivingDaemon(setup), clock), Line.to(config) as line:
            with telemetry(config) as parent:
                sub.until(lambda topic, _: topic == "rtec/run/values")
                (child,) = children(parent.pid)
                assert os.getpriority(os.PRIO_PROCESS, child) > os.getpriority(os.PRIO_PROCESS, os.getpid())
                os.kill(child, signal.SIGKILL)
                sub.until(lambda _, content: content.get("state") == "offline")
                sub.until(lambda topic, _: topic == "rtec/run/values")
                assert line.ask(ask="status") is not None
                parent.send_signal(signal.SIGTERM)
                sub.until(lambda _, content: content.get("state") == "offline")
                assert parent.wait(LONG_S) == 130
            with telemetry(config) as parent:
                sub.until(lambda topic, _: topic == "rtec/run/values")
                (child,) = children(parent.pid)
                parent.kill()
                sub.until(lambda _, content: content.get("state") == "offline")
                soon(clock, lambda: gone(child))
                assert line.ask(ask="status") is not None


def heard(place: str, what: bytes) -> bool:
    """Connect to the adapter as an agent does; is that among what it says at once?"""
    try:
        host, port = place.split(":")
        with socket.create_connection((host, int(port)), timeout=LONG_S) as agent:
            said = b""
            while what not in said:
                if not (more := agent.recv(65536)):
                    return False
                said += more
            return True
    except OSError:
        return False


def acknowledged(place: str) -> bool:
    """Does the OPC UA server answer a Hello? The bytes are those of OPC 10000-6, 7.1.2.3."""
    url, (host, port) = f"opc.tcp://{place}/rtec".encode(), place.split(":")
    hello = struct.pack("<5II", 0, 65536, 65536, 0, 0, len(url)) + url
    try:
        with socket.create_connection((host, int(port)), timeout=LONG_S) as client:
            client.sendall(b"HELF" + struct.pack("<I", 8 + len(hello)) + hello)
            return client.recv(4) == b"ACKF"
    except OSError:
        return False


def at_last(clock: RealClock, done: Callable[[], bool]) -> None:
    """Wait for a process that has to start: far longer than for anything else."""
    for _ in range(8):
        with suppress(AssertionError):
            soon(clock, done)
            return
    raise AssertionError


def test_the_loop_does_not_notice(tmp_path: Path, runtime_folder: Path) -> None:
    """A daemon runs, the processes in the network are killed and come again, then their parent is killed and takes them
    along. Oracle: the daemon itself: its cycles go on, none of its parts is in trouble, it ends as ever."""
    del runtime_folder
    place, other = free_place(), free_place()
    (certificates(tmp_path, "mill") / "trusted").mkdir()
    files = {"certificate_file": "mill.pem", "key_file": "mill.key", "trusted_folder": "trusted"}
    adapter, server = {"listen": place, "period_s": 0.05}, {"listen": other, **files}
    config, clock = run_file(tmp_path, mtconnect=adapter, opcua=server), RealClock()
    command = [sys.executable, "-m", "rtec.cli.main", "run", str(config), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as daemon:
        try:
            with telemetry(config) as parent:
                at_last(clock, lambda: heard(place, b"|avail|AVAILABLE") and acknowledged(other))
                first = children(parent.pid)
                for child in first:
                    os.kill(child, signal.SIGKILL)
                soon(clock, lambda: all(map(gone, first)))
                at_last(clock, lambda: heard(place, b"|avail|AVAILABLE") and len(children(parent.pid)) == 2)
                again = children(parent.pid)
                assert len(first) == 2
                parent.kill()
                at_last(clock, lambda: all(map(gone, again)))
            with Line.to(config, status_path) as line:
                before = line.ask(ask="status")
                soon(clock, lambda: (line.ask(ask="status") or {})["status"]["cycles"] > before["status"]["cycles"])  # type: ignore[index]
            assert before is not None
            assert before["status"]["parts"] == {}
            assert before["control"]["not_let_in"] == 0
            daemon.send_signal(signal.SIGINT)
            out, _ = daemon.communicate(timeout=LONG_S)
        finally:
            daemon.kill()
    assert json.loads(out)["cycles"] > before["status"]["cycles"]


def test_off_by_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run file without the table starts nothing: status 2, and what to write."""
    config = setups.write(tmp_path, setups.tables(tmp_path))
    assert status(["telemetry", str(config)]) == 2
    assert "asks for no telemetry" in capsys.readouterr().err


def test_a_package_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    with pytest.raises(ConfigError, match=r"run.toml: .*pip install 'rtec\[mqtt\]'"):
        tasks(load_setup(run_file(tmp_path, mqtt={"broker": "localhost:1883", "tls": False})))
