"""The protocol of the service manager. Oracles: what a real datagram socket receives; `sd_notify(3)`.

The daemon itself is tested with real processes: something happens to it at a given cycle, from inside its driver.
"""

import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from rtec.correction.flags import Flag
from rtec.daemon.process import STATUS_NS, Notifier, signals
from rtec.daemon.status import Status
from rtec.loop.clock import VirtualClock
from tests.support import faulty, setups
from tests.support.modbus_peer import until

SECOND = 1_000_000_000


@contextmanager
def manager(address: str) -> Iterator[socket.socket]:
    """A service manager's end of the socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as made:
        made.bind("\0" + address[1:] if address.startswith("@") else address)
        made.setblocking(False)
        yield made


def received(made: socket.socket) -> list[str]:
    out = []
    while True:
        try:
            out.append(made.recv(4096).decode())
        except BlockingIOError:
            return out


NONE = Flag(0)


def status(cycles: int, flags: Flag = NONE, **more: Any) -> Status:
    return Status(cycles=cycles, flags=flags, mode="on", **more)


@pytest.fixture(params=["path", "abstract"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "notify") if request.param == "path" else f"@rtec-test-{os.getpid()}-{tmp_path.name}"


def test_ready_once_and_not_before_the_first_good_cycle(address: str) -> None:
    clock = VirtualClock()
    with manager(address) as made:
        told = Notifier(address, 0, clock)
        told.look(Status())
        told.look(status(0))
        told.look(status(1, Flag.STALE_COUNTS | Flag.HELD))
        told.look(status(2, Flag.STALE_TEMPERATURE | Flag.HELD))
        assert not any("READY=1" in text for text in received(made))
        told.look(status(3, Flag.OUT_OF_RANGE | Flag.HELD))  # a cold machine in the morning: it runs, and holds
        told.look(status(4))
        assert [text for text in received(made) if "READY=1" in text] == [
            "READY=1\nSTATUS=correction on; outside the range that the model was fitted in"
        ]
        told.stopping()
        assert received(made)[-1] == "STOPPING=1"


def test_signs_of_life_follow_the_cycles_and_not_the_time(address: str) -> None:
    """A watchdog of 10 s: at most one sign in 2.5 s while cycles pass, none however long they do not."""
    clock, cycles, signs = VirtualClock(), 1, []
    with manager(address) as made:
        told = Notifier(address, 10 * SECOND, clock)
        for _ in range(1000):  # 20 s
            clock.sleep_until_ns(clock.now_ns() + SECOND // 50)
            cycles += 20
            told.look(status(cycles))
            signs += [clock.now_ns()] * received(made).count("WATCHDOG=1")
        assert 8 <= len(signs) <= 9
        assert max(b - a for a, b in itertools.pairwise(signs)) < 3 * SECOND
        for _ in range(1000):
            clock.sleep_until_ns(clock.now_ns() + SECOND)
            told.look(status(cycles))
        assert "WATCHDOG=1" not in received(made)
        told.look(status(cycles + 1))
        assert "WATCHDOG=1" in received(made)


def test_what_is_wrong_stands_in_the_status(address: str) -> None:
    """Once a change, at most once a second, one line each."""
    clock = VirtualClock()
    with manager(address) as made:
        told = Notifier(address, 0, clock)
        for cycles in range(1, 100):
            clock.sleep_until_ns(clock.now_ns() + STATUS_NS // 5)
            told.look(status(cycles, devices={"box": ["no answer\nwithin 1 ms"]} if cycles > 50 else {}))
        texts = received(made)
    assert [t.splitlines()[-1] for t in texts] == [
        "STATUS=correction on",
        "STATUS=correction on",
        "STATUS=correction on; box: no answer within 1 ms",
    ]


def test_a_manager_that_does_not_listen_holds_nobody_up(address: str) -> None:
    """Its socket is full, then gone: nothing waits, nothing is raised, and ready is told when it listens again."""
    told = Notifier(address, SECOND, VirtualClock())
    told.look(status(1))
    with manager(address) as made:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as flood:
            flood.connect("\0" + address[1:] if address.startswith("@") else address)
            with suppress(BlockingIOError):
                for _ in range(100_000):
                    flood.send(b"x" * 1000)
        told.look(status(2))
        assert not any("READY" in text for text in received(made))
        told.look(status(3))
        assert any(text.startswith("READY=1") for text in received(made))


@pytest.mark.parametrize(
    ("environment", "asked", "watched"),
    [
        ({}, False, False),
        ({"NOTIFY_SOCKET": ""}, False, False),
        ({"NOTIFY_SOCKET": "@a"}, True, False),
        ({"NOTIFY_SOCKET": "@a", "WATCHDOG_USEC": "1000000"}, True, True),
        ({"NOTIFY_SOCKET": "@a", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": str(os.getpid())}, True, True),
        ({"NOTIFY_SOCKET": "@a", "WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}, True, False),
        ({"NOTIFY_SOCKET": "@a", "WATCHDOG_USEC": "-5 s"}, True, False),
    ],
)
def test_what_is_asked_for_in_the_environment(environment: dict[str, str], asked: bool, watched: bool) -> None:
    told = Notifier.from_environment(environment, VirtualClock())
    assert (told.listens, told._period_ns > 0) == (asked, watched)
    told.look(status(1))
    told.stopping()


# The daemon ----------------------------------------------------------------------------------------------------------


class Service:
    """`rtec run` as a service manager starts it, and what it tells."""

    def __init__(self, folder: Path, made: socket.socket, watchdog_s: float, **device: Any) -> None:
        env = faulty.install(folder / "site") | {
            "NOTIFY_SOCKET": str(folder / "notify"),
        }
        env |= {"WATCHDOG_USEC": str(round(watchdog_s * 1e6))}
        config = setups.write(folder, setups.tables(folder, driver="faulty", **device))
        made.settimeout(120)
        self._made = made
        command = [sys.executable, "-m", "rtec.cli.main", "run", str(config), "--json"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env, start_new_session=True
        )

    def until(self, wanted: str) -> list[str]:
        """Everything that comes, until this does; fails after two minutes of silence."""
        out = [self._made.recv(4096).decode()]
        while wanted not in out[-1]:
            out.append(self._made.recv(4096).decode())
        return out

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=60)
        return self.process.returncode

    def loop_pid(self) -> int:
        """The child that does the cycles: of a run without workers the only one but for Python's own."""
        children = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        pids = [pid for file in children for pid in file.read_text().split()]
        (found,) = [p for p in pids if b"resource_tracker" not in Path(f"/proc/{p}/cmdline").read_bytes()]
        return int(found)


@pytest.mark.usefixtures("runtime_folder")
@pytest.mark.xdist_group("real-clock")
def test_the_daemon_is_ready_after_its_first_good_cycle_and_reloads_on_hup(
    tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """The counts are silent from cycle 0 to 200 of the loop: not ready in them. Then HUP is a reload, TERM the end."""
    own = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # not as `nohup` leaves it
    request.addfinalizer(lambda: signal.signal(signal.SIGHUP, own))
    with manager(str(tmp_path / "notify")) as made:
        service = Service(tmp_path, made, 10.0, happens="silence", at_cycle=1)
        try:
            before = service.until("READY=1")
            assert not any("WATCHDOG" in text and "READY" in text for text in before)
            assert "stale" not in before[-1]
            service.until("WATCHDOG=1")
            service.process.send_signal(signal.SIGHUP)
            assert service.process.poll() is None
        finally:
            status_of_end = service.end()
        assert status_of_end == 130
        service.until("STOPPING=1")
    (events,) = (tmp_path / "logs").glob("*.events.jsonl")
    assert [line.split('"what": "')[1].split('"')[0] for line in events.read_text().splitlines()][:1] == ["reload"]


@pytest.mark.usefixtures("runtime_folder")
@pytest.mark.xdist_group("real-clock")
def test_no_sign_of_life_while_the_loop_is_stopped(tmp_path: Path) -> None:
    """SIGSTOP to the loop alone; the supervisor runs on, and says so by its status. Oracle: the socket's silence.

    A watchdog of 0.8 s asks for a sign in every 0.2 s; the socket is listened to for 2 s.
    """
    with manager(str(tmp_path / "notify")) as made:
        service = Service(tmp_path, made, 0.8)
        loop = 0
        try:
            service.until("WATCHDOG=1")
            service.until("WATCHDOG=1")
            loop = service.loop_pid()
            os.kill(loop, signal.SIGSTOP)
            _drain(made, 0.5)
            assert "WATCHDOG=1" not in _drain(made, 2.0)
            os.kill(loop, signal.SIGCONT)
            service.until("WATCHDOG=1")
        finally:
            if loop:
                os.kill(loop, signal.SIGCONT)
            assert service.end() == 130


@pytest.mark.usefixtures("runtime_folder")
@pytest.mark.xdist_group("real-clock")
@pytest.mark.parametrize(
    ("happens", "why"),
    [("hangs", "a driver hangs while it opens its device"), ("hangs_later", "the loop stands: no cycle for")],
)
def test_a_driver_that_hangs_can_be_ended(tmp_path: Path, happens: str, why: str) -> None:
    """While it opens its device, and in a cycle. Oracle: the process table. Ctrl-C had done nothing."""
    told = tmp_path / "pid"
    with manager(str(tmp_path / "notify")) as made:
        service = Service(tmp_path, made, 10.0, happens=happens, at_cycle=50, told=str(told))
        assert until(lambda: told.exists() and told.read_text() != "")
        service.process.send_signal(signal.SIGINT)
        _, said = service.process.communicate(timeout=60)
    assert service.process.returncode == 2
    assert why in said
    assert not Path(f"/proc/{told.read_text()}").exists()


def _drain(made: socket.socket, seconds: float) -> list[str]:
    """What comes before it is silent for so long."""
    made.settimeout(seconds)
    out = []
    try:
        while True:
            out.append(made.recv(4096).decode())
    except TimeoutError:
        made.settimeout(120)
        return out


@pytest.mark.parametrize("before", [signal.SIG_IGN, signal.SIG_DFL])
def test_the_end_of_the_terminal_stays_ignored_under_nohup(before: signal.Handlers) -> None:
    """`nohup` starts it with SIGHUP ignored. Oracle: a signal that is sent for real, and what stood there before."""
    came: list[int] = []
    own = signal.signal(signal.SIGHUP, before)
    try:
        with signals(lambda number, _: came.append(number)):
            os.kill(os.getpid(), signal.SIGHUP)
            os.kill(os.getpid(), signal.SIGUSR1)
        assert signal.getsignal(signal.SIGHUP) == before
    finally:
        signal.signal(signal.SIGHUP, own)
    assert came == ([signal.SIGUSR1] if before == signal.SIG_IGN else [signal.SIGHUP, signal.SIGUSR1])
