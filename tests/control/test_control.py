"""Control and telemetry by real sockets on this computer.

Oracles: the orders that the daemon was given; the answers as `docs/control.md` has them, read by `json` alone; the
permissions that the file system says; the tally against what was sent.
"""

import json
import os
import random
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from rtec.control.client import Client, Place, find
from rtec.control.messages import LARGEST_REQUEST, TOPIC
from rtec.control.places import ORDERS, STATUS, answers, listen, socket_path
from rtec.control.server import QUEUED, Control
from rtec.errors import RtecError
from rtec.loop.clock import RealClock
from rtec.loop.orders import Order
from rtec.loop.run_file import Setup
from tests.support import setups
from tests.support.control_rig import SHORT_MS, FakeDaemon, Line


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))


@pytest.fixture
def daemon(setup: Setup) -> FakeDaemon:
    return FakeDaemon(setup)


@pytest.fixture
def control(setup: Setup, daemon: FakeDaemon) -> Iterator[Control]:
    with Control(setup, daemon, RealClock()) as control:
        yield control


@pytest.fixture
def local(setup: Setup, control: Control) -> Iterator[Line]:
    del control
    with Line(f"ipc://{socket_path(setup.path, ORDERS)}") as line:
        yield line


def test_status_is_plain_json(local: Line, daemon: FakeDaemon, setup: Setup) -> None:
    """Every figure of the daemon's status arrives; what is not a number is null, as JSON has no word for it."""
    found = local.ask(ask="status", id=5)
    assert found is not None
    assert (found["id"], found["machine"], found["config"]) == (5, setup.machine.name, str(setup.path.resolve()))
    assert found["status"]["requested_um"] == daemon.status.requested_um
    assert found["status"]["applied_um"] == {"X": 1.25, "Z": None}
    assert found["status"]["degc"]["T_air"] is None
    assert found["status"]["flags"] == []
    assert found["left"]["axes"] == {}
    assert set(found["control"].values()) == {0}


def test_an_order_reaches_the_daemon_with_the_name_of_the_user(local: Line, daemon: FakeDaemon) -> None:
    import pwd

    local.send(local.order(order="mark", text="first part, 20 µm"))
    assert local.receive() == {"schema": 1, "done": "mark ordered"}
    assert daemon.orders == [(Order.MARK, "first part, 20 µm", pwd.getpwuid(os.geteuid()).pw_name)]
    local.send(local.order(order="reload"))
    found = local.receive()
    assert found is not None
    assert found["refused"] == "an earlier order to reload is not done with yet"


def test_nobody_else_can_open_the_sockets(control: Control, setup: Setup) -> None:
    del control
    for suffix in (ORDERS, STATUS):
        assert stat.S_IMODE(socket_path(setup.path, suffix).stat().st_mode) == 0o600


def test_the_group_can_where_the_run_file_says_so(tmp_path: Path) -> None:
    """Whatever the umask allows more or less."""
    before = os.umask(0)
    try:
        made = listen(tmp_path / "s", "group")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o660
    os.close(made.fd)


def test_a_living_daemon_keeps_its_sockets_and_a_dead_one_does_not(setup: Setup, daemon: FakeDaemon) -> None:
    path = socket_path(setup.path, ORDERS)
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    assert not answers(path)
    with Control(setup, daemon, RealClock()):
        with pytest.raises(RtecError, match="another rtec runs"), Control(setup, daemon, RealClock()):
            pass
        with Client(find(setup.path, None, None)) as client:
            assert client.status()["machine"] == setup.machine.name
    assert not path.exists()


def test_a_path_too_long_for_a_socket_is_told(tmp_path: Path) -> None:
    with pytest.raises(RtecError, match="shorter RUNTIME_DIRECTORY"):
        listen(tmp_path / ("x" * 120), "user")


def test_finding_a_daemon(setup: Setup, control: Control, tmp_path: Path) -> None:
    del control
    expected = f"ipc://{socket_path(setup.path, ORDERS)}"
    assert find(setup.path, None, None) == Place(expected)
    with pytest.raises(RtecError, match=r"no daemon runs with .*other.toml.*start one with `rtec run .*other.toml`"):
        find(tmp_path / "other.toml", None, None)
    with pytest.raises(RtecError, match="--key FILE"):
        find(None, "127.0.0.1:7300", None)


def test_an_order_given_before_is_refused(local: Line, daemon: FakeDaemon, setup: Setup) -> None:
    """The same bytes again: by the same connection, by another, after a new session, to a daemon started anew."""
    order = local.order()
    local.send(order)
    assert local.receive() == {"schema": 1, "done": "hold ordered"}
    local.send(order)
    assert "given before" in (local.receive() or {})["refused"]
    with Line(f"ipc://{socket_path(setup.path, ORDERS)}") as other:
        other.send(order)
        assert "not of this connection" in (other.receive() or {})["refused"]
        other.ask(ask="session")
        other.send(order)
        assert "not of this connection" in (other.receive() or {})["refused"]
    local.ask(ask="session")
    local.send(order)
    assert "not of this connection" in (local.receive() or {})["refused"]
    assert len(daemon.orders) == 1


def test_an_order_from_before_a_new_start_is_refused(setup: Setup) -> None:
    """What libzmq keeps for a daemon that is away arrives at the next one: an order of yesterday must do nothing."""
    first, second = FakeDaemon(setup), FakeDaemon(setup)
    with Line(f"ipc://{socket_path(setup.path, ORDERS)}") as line:
        with Control(setup, first, RealClock()):
            order = line.order(order="enable")
        line.send(order)
        with Control(setup, second, RealClock()):
            found = line.receive()
    assert found is None or "not of this connection" in found["refused"]
    assert (first.orders, second.orders) == ([], [])


def test_ten_thousand_malformed_messages_by_the_socket(local: Line, control: Control, daemon: FakeDaemon) -> None:
    """All of them are counted, and the daemon answers as before; too long a one costs its sender the connection."""
    rng = random.Random(5)
    status, sent = b'{"schema":1,"ask":"status"}', 0
    while sent < 10_000:
        burst = min(QUEUED // 2, 10_000 - sent)
        for _ in range(burst):
            local.send(rng.randbytes(rng.randrange(1, 80)) if rng.random() < 0.5 else status[: rng.randrange(27)])
        for _ in range(burst):
            assert "error" in (local.receive() or {})
        sent += burst
    assert control.desk.tally.malformed == 10_000
    assert (local.ask(ask="status") or {})["status"]["cycles"] == daemon.status.cycles
    local.send(b"x" * (LARGEST_REQUEST + 1))
    assert local.receive(SHORT_MS) is None
    assert (local.ask(ask="status") or {})["control"]["malformed"] == 10_000
    assert daemon.orders == []


def test_a_client_that_asks_and_never_listens_keeps_nobody_waiting(local: Line, control: Control, setup: Setup) -> None:
    """It gets what its queue holds and the rest is dropped; another one that asks meanwhile gets every answer."""
    asked, heard, context = 40 * QUEUED, 0, zmq.Context()
    deaf: Any = context.socket(zmq.DEALER)
    try:
        deaf.rcvhwm, deaf.sndhwm = 1, 0
        deaf.connect(f"ipc://{socket_path(setup.path, ORDERS)}")
        for _ in range(asked):
            deaf.send_multipart([b"", b'{"schema":1,"ask":"status"}'])
        while control.desk.tally.answered < asked:
            assert (local.ask(ask="status", id=7) or {})["id"] == 7
        while deaf.poll(SHORT_MS):
            deaf.recv_multipart()
            heard += 1
    finally:
        context.destroy(linger=0)
    # The queues of both sides and of the kernel hold some hundreds; a busy computer lets a few more through meanwhile.
    assert QUEUED <= heard < asked * 3 // 4


def test_strange_envelopes_are_answered_or_dropped(local: Line) -> None:
    """A message of many parts, of none, without the empty one."""
    for parts in ([b"a"] * 50, [b""], [b'{"schema":1,"ask":"status"}']):
        local.socket.send_multipart(parts)
        assert local.receive() is not None
    assert local.ask(ask="status") is not None


def test_bytes_that_are_no_zeromq_hurt_nobody(local: Line, setup: Setup) -> None:
    rng = random.Random(6)
    for _ in range(50):
        with socket.socket(socket.AF_UNIX) as raw:
            raw.connect(str(socket_path(setup.path, ORDERS)))
            try:
                raw.sendall(rng.randbytes(200))
            except OSError:  # thrown out already
                continue
    assert local.ask(ask="status") is not None


def test_the_status_is_published(control: Control, setup: Setup, daemon: FakeDaemon) -> None:
    """A hundred subscribers all hear it; one that never reads costs nothing but what it did not read."""
    del control
    context: Any = zmq.Context()
    try:
        subscribers = [context.socket(zmq.SUB) for _ in range(101)]
        for made in subscribers:
            made.rcvhwm = 1
            made.subscribe(TOPIC)
            made.connect(f"ipc://{socket_path(setup.path, STATUS)}")
        for _ in range(5):
            for made in subscribers[1:]:
                assert made.poll(20_000)
                topic, message = made.recv_multipart()
                assert topic == TOPIC
                assert json.loads(message)["status"]["cycles"] == daemon.status.cycles
    finally:
        context.destroy(linger=0)
