"""Control and telemetry by the real local socket.

Oracles: the orders that the daemon was given; the answers as `docs/control.md` has them, read by `json` alone; the
permissions that the file system says; the tally against what was sent.
"""

import json
import os
import random
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rtec.control import server
from rtec.control.client import Client, DaemonPlace, find
from rtec.control.messages import LARGEST_REQUEST
from rtec.control.places import answers, listen, socket_path, status_path
from rtec.control.server import LARGEST_BUFFER, MOST_CONNECTIONS, Control, Guests
from rtec.control.server import Line as Served
from rtec.errors import RtecError
from rtec.loop.clock import RealClock
from rtec.loop.orders import Order
from rtec.loop.run_file import Setup
from tests.support import setups
from tests.support.conformance import soon
from tests.support.control_rig import FakeDaemon, Line

pytestmark = pytest.mark.usefixtures("runtime_folder")


@pytest.fixture(scope="module")
def setup(tmp_path_factory: pytest.TempPathFactory) -> Setup:
    return setups.setup(tmp_path_factory.mktemp("run"))


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
    with Line.to(setup.path) as line:
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


def test_nobody_else_can_open_the_socket(control: Control, setup: Setup) -> None:
    del control
    assert stat.S_IMODE(socket_path(setup.path).stat().st_mode) == 0o600


@pytest.mark.parametrize("umask", [0, 0o022, 0o027, 0o077])
def test_the_group_can_where_the_run_file_says_so(tmp_path: Path, umask: int) -> None:
    """Whatever the umask allows more or less: 027 is that of the service."""
    before = os.umask(umask)
    try:
        made = listen(tmp_path / "s", "group")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o660
    made.socket.close()


def test_a_living_daemon_keeps_its_sockets_and_a_dead_one_does_not(setup: Setup, daemon: FakeDaemon) -> None:
    path = socket_path(setup.path)
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
    assert find(setup.path, None, None) == DaemonPlace(socket_path(setup.path))
    with pytest.raises(RtecError, match=r"other.toml: no such file$"):
        find(tmp_path / "other.toml", None, None)
    (tmp_path / "other.toml").touch()
    with pytest.raises(RtecError, match=r"no daemon runs with .*other.toml.*start one with `rtec run .*other.toml`"):
        find(tmp_path / "other.toml", None, None)


def test_an_order_given_before_is_refused(local: Line, daemon: FakeDaemon, setup: Setup) -> None:
    """The same bytes again: by the same connection, by another, after a new session, to a daemon restarted."""
    order = local.order()
    local.send(order)
    assert local.receive() == {"schema": 1, "done": "hold ordered"}
    local.send(order)
    assert "given before" in (local.receive() or {})["refused"]
    with Line.to(setup.path) as other:
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
    """Bytes that arrive at the next daemon: an order of yesterday must do nothing."""
    first, second = FakeDaemon(setup), FakeDaemon(setup)
    with Control(setup, first, RealClock()), Line.to(setup.path) as line:
        order = line.order(order="enable")
    with Control(setup, second, RealClock()), Line.to(setup.path) as line:
        line.send(order)
        assert "not of this connection" in (line.receive() or {})["refused"]
    assert (first.orders, second.orders) == ([], [])


def test_rights_can_be_lowered_and_never_rise(local: Line, daemon: FakeDaemon) -> None:
    """What the relay says first for a client on the network. Oracle: the orders that the daemon was given."""
    import pwd

    me = pwd.getpwuid(os.geteuid()).pw_name
    assert local.ask(ask="as", name="office", role="read") == {"schema": 1, "name": f"office ({me})", "role": "read"}
    assert (local.ask(ask="status") or {})["status"]["cycles"] == daemon.status.cycles
    assert "cannot take" in (local.ask(ask="as", name="cell", role="operate") or {})["refused"]
    for asked in ({"ask": "session"}, {"ask": "order", "session": "0" * 32, "seq": 1, "order": "fade"}):
        assert "may read, not operate" in (local.ask(**asked) or {})["refused"]
    assert daemon.orders == []


@pytest.mark.parametrize("name", ["", "a b", "a\x1b[31m", "\ud800", "x" * 41, 7])
def test_a_name_that_would_do_things_to_the_events_is_refused(local: Line, name: object) -> None:
    assert "'name' must have letters" in (local.ask(ask="as", name=name, role="read") or {})["error"]


def test_hundreds_of_malformed_messages(local: Line, control: Control, daemon: FakeDaemon) -> None:
    """All of them are counted, and the daemon answers as before; too long a one costs its sender the connection."""
    rng = random.Random(5)
    status = b'{"schema":1,"ask":"status"}'
    for _ in range(300):
        raw = rng.randbytes(rng.randrange(1, 80)).replace(b"\n", b"")
        local.send(raw if rng.random() < 0.5 else status[: rng.randrange(27)])
    for _ in range(300):
        assert "error" in (local.receive() or {})
    assert control.desk.tally.malformed == 300
    assert (local.ask(ask="status") or {})["status"]["cycles"] == daemon.status.cycles
    assert daemon.orders == []


@pytest.mark.parametrize("ends", [b"\n", b""])
def test_a_request_without_an_end_costs_its_sender_the_connection(
    local: Line, control: Control, setup: Setup, ends: bytes
) -> None:
    """No more than a request's bytes are kept of it, however many come; the others go on."""
    with Line.to(setup.path) as endless:
        try:
            for _ in range(1000):
                endless.socket.sendall(b"x" * LARGEST_REQUEST)
            endless.socket.sendall(ends)
        except OSError:
            assert local.ask(ask="status") is not None
        assert endless.receive() is None or endless.receive() is None
    assert control.desk.tally.malformed == 1


def test_a_client_that_asks_and_never_listens_keeps_nobody_waiting(local: Line, control: Control, setup: Setup) -> None:
    """It gets what its buffer holds, and is served no further; another one that asks meanwhile gets every answer."""
    size = len(json.dumps(local.ask(ask="status")))
    most = 0
    with Line.to(setup.path) as deaf:
        deaf.socket.setblocking(False)
        while most <= LARGEST_BUFFER:
            with suppress(BlockingIOError):
                deaf.socket.sendall(b'{"schema":1,"ask":"status"}\n' * 100)
            assert (local.ask(ask="status", id=7) or {})["id"] == 7
            most = max(one.writer.transport.get_write_buffer_size() for one in control.guests.lines if one.writer)
        for k in range(100):
            assert (local.ask(ask="status", id=k) or {})["id"] == k
            most = max(one.writer.transport.get_write_buffer_size() for one in control.guests.lines if one.writer)
            assert most < LARGEST_BUFFER + 2 * size


def test_eleven_hundred_idle_connections_keep_nobody_out(local: Line, control: Control, setup: Setup) -> None:
    """Of another process of the same user; a new client is answered, and so is one from before. Oracle: its answers."""
    code = (
        "import socket, sys\n"
        "kept = []\n"
        "for _ in range(1100):\n"
        "    made = socket.socket(socket.AF_UNIX)\n"
        "    made.connect(sys.argv[1])\n"
        "    kept.append(made)\n"
        "print('ready', flush=True)\n"
        "sys.stdin.read()\n"
    )
    assert local.ask(ask="status") is not None
    command = [sys.executable, "-c", code, str(socket_path(setup.path))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as flood:
        assert flood.stdout is not None
        assert flood.stdin is not None
        assert flood.stdout.readline() == b"ready\n"
        with Line.to(setup.path) as late:
            for line in (local, late):
                line.send(line.order())
                assert (line.receive() or {})["done"] == "hold ordered"
        assert len(control.guests.lines) <= MOST_CONNECTIONS
        flood.stdin.close()
    assert control.desk.tally.not_let_in >= 1100 - MOST_CONNECTIONS


def test_whoever_has_most_connections_makes_room() -> None:
    """The idlest one of the busiest process of the busiest user. Oracle: the table of who has how many."""
    guests = Guests(5)
    with ExitStack() as opened:

        def line(uid: int, pid: int, used_ns: int) -> Served:
            ends = [opened.enter_context(made) for made in socket.socketpair()]
            return Served(ends[0], uid, pid, used_ns)

        kept = [line(0, 1, 0), line(7, 70, 1), line(7, 71, 2), line(7, 71, 9), line(8, 80, 0)]
        assert [guests.admit(one) for one in kept] == [None] * 5
        assert guests.admit(line(8, 81, 10)) is kept[2]
        assert guests.admit(line(8, 82, 11)) is kept[4]
        assert guests.lines[0] is kept[0]


def test_bytes_that_are_no_text_hurt_nobody(local: Line, setup: Setup) -> None:
    rng = random.Random(6)
    for _ in range(50):
        with Line.to(setup.path) as raw:
            raw.socket.sendall(rng.randbytes(200))
    assert local.ask(ask="status") is not None


def test_a_fault_of_the_program_keeps_no_order_out(local: Line, daemon: FakeDaemon) -> None:
    """A status that cannot be made is told; a hold still gets through, over the same connection."""
    daemon.status.devices = {"box": {object()}}  # type: ignore[dict-item]
    assert "fault in the program" in (local.ask(ask="status") or {})["refused"]
    local.send(local.order())
    assert (local.receive() or {})["done"] == "hold ordered"
    assert any("fault in the program" in note for note in daemon.notes)


def test_a_thread_that_fails_is_begun_again_with_the_same_socket(
    setup: Setup, daemon: FakeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reported, counted; whoever connects meanwhile is answered afterwards."""
    real, fails = Control._publish, iter([True])

    async def publish(self: Control) -> None:
        if next(fails, False):
            raise OverflowError("an integer of 400 digits")
        await real(self)

    monkeypatch.setattr(Control, "_publish", publish)
    with Control(setup, daemon, RealClock()):
        soon(RealClock(), lambda: daemon.parts.faults or None)
        with Line.to(setup.path) as line:
            line.send(line.order())
            assert (line.receive() or {})["done"] == "hold ordered"
    assert daemon.parts.faults == {"control": 1}
    assert "control: fault in the program" in daemon.notes[0]


def test_the_status_is_sent_to_whoever_watches(control: Control, setup: Setup, daemon: FakeDaemon) -> None:
    """A hundred watch and all hear it; one that never reads costs nothing but what it did not read."""
    del control
    with ExitStack() as opened:
        watching = [opened.enter_context(Line.to(setup.path)) for _ in range(101)]
        for one in watching:
            one.send(b'{"schema":1,"ask":"watch"}')
        for _ in range(3):
            for one in watching[1:]:
                assert (one.receive() or {})["status"]["cycles"] == daemon.status.cycles


@pytest.mark.parametrize("ask", [{"ask": "session"}, {"ask": "order", "order": "hold", "session": "0" * 32, "seq": 1}])
def test_the_status_socket_shows_the_status_and_takes_no_order(
    control: Control, setup: Setup, daemon: FakeDaemon, ask: dict[str, object]
) -> None:
    """Law: whoever has only this socket can order nothing, not even after asking for the right to it."""
    del control
    with Line.to(setup.path, status_path) as line:
        seen = line.ask(ask="status")
        assert seen is not None
        assert seen["machine"] == setup.machine.name
        raised = line.ask(ask="as", name="cell", role="operate")
        assert raised is not None
        assert "more rights" in raised["refused"]
        refused = line.ask(**ask)  # type: ignore[arg-type]
        assert refused is not None
        assert "may read, not operate" in refused["refused"]
    assert daemon.orders == []


def test_watchers_of_the_status_socket_are_sent_it_and_take_no_place_of_orders(
    control: Control, setup: Setup, daemon: FakeDaemon
) -> None:
    """More watchers than there are places, silent ones: an order goes through at once, and the newest still watch."""
    with ExitStack() as opened:
        lines = [opened.enter_context(Line.to(setup.path, status_path)) for _ in range(server.MOST_WATCHERS + 8)]
        assert lines[-1].ask(ask="watch") is not None
        assert lines[-1].receive() is not None
        with Line.to(setup.path) as line:
            line.send(line.order())
            done = line.receive()
        assert done is not None
        assert "done" in done
    assert len(daemon.orders) == 1
    assert control.guests.lines == [] or len(control.guests.lines) <= 1


def test_the_user_of_the_network_process_may_only_read(
    control: Control, setup: Setup, daemon: FakeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even through the socket for orders, which its group may open with `access = "group"`."""
    del control
    monkeypatch.setattr(server, "_user", lambda _uid: server.TELEMETRY_USER)
    with Line.to(setup.path) as line:
        refused = line.ask(ask="session")
    assert refused is not None
    assert refused["refused"] == f"{server.TELEMETRY_USER} may read, not operate"
    assert daemon.orders == []


@pytest.mark.skipif(os.geteuid() != 0, reason="another user than root is needed")
def test_another_user_of_the_group_reads_the_status_and_finds_no_socket_for_orders(
    setup: Setup, daemon: FakeDaemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the kernel, with a process of user 65534 in the group of the sockets."""
    script = """
import socket, sys
for path in sys.argv[1:]:
    with socket.socket(socket.AF_UNIX) as one:
        try:
            one.connect(path)
            one.sendall(b'{"schema": 1, "ask": "status"}\\n')
            print("read" if one.recv(10) else "nothing")
        except PermissionError:
            print("refused")
"""
    with tempfile.TemporaryDirectory(prefix="rtec-") as folder:
        Path(folder).chmod(0o755)
        monkeypatch.setenv("RUNTIME_DIRECTORY", folder)
        with Control(setup, daemon, RealClock()):
            places = [str(status_path(setup.path)), str(socket_path(setup.path))]
            done = subprocess.run(
                ["/usr/bin/python3", "-c", script, *places],
                user=65534, group=os.getegid(), extra_groups=[], capture_output=True, text=True, check=True, cwd="/",
            )  # fmt: skip
    assert done.stdout.split() == ["read", "refused"]
