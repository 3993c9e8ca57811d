"""One daemon at an actuator. Oracles: the kernel's table of sockets; a second daemon that is refused."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtec.daemon.claim import Claim, commanded_places
from rtec.daemon.supervisor import Supervisor
from rtec.errors import RtecError
from rtec.loop.clock import RealClock, VirtualClock
from rtec.loop.run_file import Setup, load_setup
from tests.support import setups
from tests.support.offset_controller import OffsetController, controller_over_tcp

OFFSETS = {"driver": "ascii_offset", "command": ["OFS X={X:.4f} Z={Z:.4f}"], "unit": "mm", "resolution_um": 0.1}
SINK = {"kind": "origin_offset", "resolution_um": 0.1}


def run_file(folder: Path, port: int, name: str = "run.toml") -> Path:
    """A run file whose actuator is a controller at this port."""
    folder.mkdir(exist_ok=True)
    content = setups.tables(folder, program="G4 X3600")
    content["role"]["actuator"] = "offsets"
    content["device"]["offsets"] = {**OFFSETS, "tcp": {"host": "127.0.0.1", "port": port}}
    content["output"] = {"X": SINK, "Z": SINK}
    return setups.write(folder, content).rename(folder / name)


@pytest.fixture
def port() -> Iterator[int]:
    with controller_over_tcp(OffsetController()) as port:
        yield port


@pytest.fixture
def setup(tmp_path: Path, port: int, monkeypatch: pytest.MonkeyPatch) -> Setup:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    return load_setup(run_file(tmp_path / "one", port))


@pytest.mark.parametrize(
    ("table", "places"),
    [
        ({"tcp": {"host": "Mill", "port": 5000}}, ["mill:5000"]),
        ({"serial": {"port": "/dev/../dev/absent", "baud": 9600}}, ["/dev/absent"]),
        ({"port": "/dev/absent"}, ["/dev/absent"]),
        ({"tcp": {"host": "localhost", "port": 5000}}, ["127.0.0.1:5000"]),
        ({"state": "ipc://s", "command": "ipc:///dev/../absent/command"}, ["ipc:///absent/command"]),
        ({"command": "tcp://LocalHost:5555"}, ["tcp://127.0.0.1:5555"]),
        ({"socket": "/run/rtec/linuxcnc.sock"}, ["/run/rtec/linuxcnc.sock"]),
        ({"interface": "socketcan", "channel": "can0", "base_id": 0x140}, ["socketcan can0, identifier 0x140"]),
        ({"truth": "sim.toml"}, []),
    ],
)
def test_the_places_of_an_actuator(setup: Setup, table: dict[str, Any], places: list[str]) -> None:
    device = {**setup.file.device, "offsets": {"driver": "x", **table}}
    assert commanded_places(replace(setup, file=setup.file.model_copy(update={"device": device}))) == places


def test_without_an_actuator_nothing_is_taken(setup: Setup) -> None:
    role = setup.file.role.model_copy(update={"actuator": None})
    assert commanded_places(replace(setup, file=setup.file.model_copy(update={"role": role}))) == []


def test_a_second_daemon_with_another_run_file_is_refused_before_it_commands_anything(
    setup: Setup, tmp_path: Path, port: int
) -> None:
    """Two run files in two folders: nothing else is common to them. When the first has ended, the second may run."""
    first = Claim(setup)
    first.take(VirtualClock())
    other = load_setup(run_file(tmp_path / "two", port, "other.toml"))
    with pytest.raises(RtecError, match=rf"127\.0\.0\.1:{port}: another rtec sends its commands there"):
        Supervisor(other, None).run(0.2)
    first.free()
    assert Supervisor(other, None).run(0.2).summary["cycles"] == 200


def test_a_daemon_that_was_killed_leaves_nothing_behind(setup: Setup) -> None:
    """Another process takes the place, and is killed while it holds it."""
    text = (
        "import sys; from pathlib import Path; from rtec.daemon.claim import Claim; "
        "from rtec.loop.clock import RealClock; from rtec.loop.run_file import load_setup; "
        "c = Claim(load_setup(Path(sys.argv[1]))); c.take(RealClock()); print('taken', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", text, str(setup.path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "taken\n"
        claim = Claim(setup)
        with pytest.raises(RtecError, match="another rtec sends its commands there"):
            claim.take(VirtualClock())
        process.kill()
        process.wait()
    claim.take(RealClock())
    claim.free()
