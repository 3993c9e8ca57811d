"""Control from another computer: `--at` by ssh, `rtec ctl relay` behind sshd, roles by the key.

Oracles: the orders that the daemon was given; what ssh is started with; a real sshd, where there is one.
"""

import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtec.control.client import Client, DaemonPlace, find, relay
from rtec.control.server import Control
from rtec.errors import ConfigError, RtecError
from rtec.loop.clock import RealClock
from rtec.loop.orders import Order, OrderRefused
from rtec.loop.run_file import ControlTable, Setup
from rtec.tomlfile import validated
from tests.support import setups
from tests.support.conformance import soon
from tests.support.control_rig import FakeDaemon, Line, free_place

pytestmark = pytest.mark.usefixtures("runtime_folder")

RTEC = f"{sys.executable} -m rtec.cli.main"
SSHD = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin")


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


@pytest.fixture
def daemon(setup: Setup) -> Iterator[FakeDaemon]:
    daemon = FakeDaemon(setup)
    with Control(setup, daemon, RealClock()):
        yield daemon


def test_what_ssh_is_started_with() -> None:
    """Nothing in `--at` or in the name of a file can become an option, or a command there. Oracle: the man page."""
    place = find(Path("/etc/rtec/mill 2;reboot.toml"), "cell@192.168.10.5:2222", Path("cell"))
    assert place.command[:2] == ("ssh", "-T")
    assert place.command[-3:] == (
        "--",
        "cell@192.168.10.5",
        "rtec ctl relay --role operate '/etc/rtec/mill 2;reboot.toml'",
    )
    assert place.command[place.command.index("-p") + 1] == "2222"
    assert place.command[place.command.index("-i") + 1] == "cell"
    assert find(None, "[fe80::1]:22", None).command[-2:] == ("fe80::1", "rtec ctl relay --role operate")
    for bad in ("-oProxyCommand=reboot", "a b", "a@-x", "a;b", "", "a:b", "a@b@c"):
        with pytest.raises(RtecError, match="is not"):
            find(None, bad, None)


def test_it_hands_on_both_ways_and_ends_when_all_is_answered(setup: Setup, daemon: FakeDaemon, tmp_path: Path) -> None:
    near, far = socket.socketpair()
    path = find(setup.path, None, None).path
    assert path is not None
    thread = threading.Thread(target=relay, args=(path, "cell", "operate", far.fileno(), far.fileno()))
    thread.start()
    with Line(near) as line, far:
        line.send(line.order(order="fade"))
        near.shutdown(socket.SHUT_WR)
        assert line.receive() == {"schema": 1, "done": "fade ordered"}
        thread.join(20)
    assert not thread.is_alive()
    assert [(order, who.split()[0]) for order, _, who in daemon.orders] == [(Order.FADE, "cell")]
    with pytest.raises(RtecError, match="'name' must have letters"):
        relay(path, "a b", "read")
    with pytest.raises(RtecError, match="none"):
        relay(tmp_path / "none", "cell", "read")


def test_who_reads_and_who_operates(setup: Setup, daemon: FakeDaemon) -> None:
    """By the command that the key is bound to. Oracle: the orders that the daemon was given."""
    relays = {
        role: DaemonPlace(command=(*RTEC.split(), "ctl", "relay", str(setup.path), "--role", role, "--name", role))
        for role in ("read", "operate")
    }
    with Client(relays["read"]) as office:
        assert office.status()["machine"] == setup.machine.name
        with pytest.raises(OrderRefused, match=r"read \(.*\) may read, not operate"):
            office.order(Order.HOLD)
    with Client(relays["operate"]) as cell:
        cell.order(Order.HOLD)
    assert [(order, who.split()[0]) for order, _, who in daemon.orders] == [(Order.HOLD, "operate")]


def test_the_client_says_why() -> None:
    with pytest.raises(RtecError, match="cannot be started: No such file"):
        Client(DaemonPlace(command=("no-such-ssh",)))
    with Client(DaemonPlace(command=("false",))) as client, pytest.raises(RtecError, match="no answer by `false`"):
        client.status()


@pytest.mark.parametrize("key", ["tcp", "tcp_status", "keys"])
def test_run_files_from_before_say_what_to_do(key: str) -> None:
    with pytest.raises(ConfigError, match=f"{key}: .* clients come by ssh: take this out, and see docs/control.md"):
        validated(ControlTable, {key: "a:1"}, "run.toml")


@pytest.mark.skipif(SSHD is None, reason="needs sshd (Debian: openssh-server)")
def test_through_a_real_sshd(setup: Setup, daemon: FakeDaemon, runtime_folder: Path, tmp_path: Path) -> None:
    """Keys bound to a command, as docs/control.md has them: whatever a client asks for, it gets its own role only."""
    assert SSHD is not None
    port = free_place().split(":")[1]
    for name in ("host", "office", "cell", "stranger"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(tmp_path / name)], check=True)
    inside = f"env RUNTIME_DIRECTORY={runtime_folder} {RTEC} ctl relay {setup.path}"
    (tmp_path / "authorized_keys").write_text(
        "".join(
            f'restrict,command="{inside} --role {role} --name {name}" {(tmp_path / f"{name}.pub").read_text()}'
            for name, role in (("office", "read"), ("cell", "operate"))
        )
    )
    (tmp_path / "config").write_text(
        f"ListenAddress 127.0.0.1\nPort {port}\nHostKey {tmp_path}/host\nPidFile none\n"
        f"AuthorizedKeysFile {tmp_path}/authorized_keys\nStrictModes no\n"
        "UsePAM no\nPasswordAuthentication no\nPermitRootLogin forced-commands-only\n"
    )
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(exist_ok=True)

    def at(name: str) -> DaemonPlace:
        place = find(setup.path, f"127.0.0.1:{port}", tmp_path / name)
        trust = ("-o", "StrictHostKeyChecking=no", "-o", f"UserKnownHostsFile={tmp_path}/known")
        return DaemonPlace(command=(place.command[0], *trust, *place.command[1:]))

    with subprocess.Popen([SSHD, "-D", "-e", "-f", str(tmp_path / "config")], stderr=subprocess.PIPE) as sshd:
        try:
            soon(RealClock(), lambda: _listens(int(port)))
            with Client(at("office")) as office:
                assert office.status()["machine"] == setup.machine.name
                with pytest.raises(OrderRefused, match="may read, not operate"):
                    office.order(Order.HOLD)
            with Client(at("cell")) as cell:
                cell.order(Order.HOLD)
            with Client(at("stranger")) as stranger, pytest.raises(RtecError, match="is it allowed there"):
                stranger.status()
        finally:
            sshd.terminate()
    assert [(order, who.split()[0]) for order, _, who in daemon.orders] == [(Order.HOLD, "cell")]


def _listens(port: int) -> bool:
    with socket.socket() as trial:
        return trial.connect_ex(("127.0.0.1", port)) == 0
