"""The processes of `rtec telemetry`. Oracles: the broker's last will; what the kernel says of processes; the daemon."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtec.cli.main import status
from rtec.control.server import Control
from rtec.errors import ConfigError
from rtec.loop.clock import RealClock
from rtec.loop.run_file import load_setup
from rtec.telemetry.processes import tasks
from tests.support import setups
from tests.support.conformance import soon
from tests.support.control_rig import LONG_S, Line
from tests.support.telemetry_rig import Broker, LivingDaemon, Subscriber

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


def test_off_by_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run file without the table starts nothing: status 2, and what to write."""
    config = setups.write(tmp_path, setups.tables(tmp_path))
    assert status(["telemetry", str(config)]) == 2
    assert "asks for no telemetry" in capsys.readouterr().err


def test_a_package_that_is_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiomqtt", None)
    with pytest.raises(ConfigError, match=r"run.toml: .*pip install 'rtec\[mqtt\]'"):
        tasks(load_setup(run_file(tmp_path, mqtt={"broker": "localhost:1883", "tls": False})))
