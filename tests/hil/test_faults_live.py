"""Parts of a running daemon that fail: real processes, real clock, exceptions put in by the test.

Oracles: what a service manager's socket receives; the mode in the loop's own rows; the log, replayed bit by bit.
"""

import errno
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from rtec.daemon.status import Status
from rtec.daemon.supervision import LOST_AFTER
from rtec.daemon.supervisor import Supervisor
from rtec.errors import RtecError
from rtec.log.recording import Event
from rtec.loop.clock import VirtualClock
from rtec.loop.orders import Order
from rtec.loop.run_file import Setup
from rtec.loop.state_files import DiskState, read_disk
from rtec.playback.replay import replay_log
from tests.support import setups

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]
Script = Iterator[bool]
LONGEST_NS = 90_000_000_000


class Play:
    """Runs a daemon in this process; a script waits for what it looks for in the status, and does things in between."""

    def __init__(self, setup: Setup, log: Path | None) -> None:
        self.status, self.events, self._first_ns = Status(), list[Event](), 0
        self.supervisor = Supervisor(setup, log, self._look, on_event=self.events.append)

    def run(self, script: Script) -> None:
        self._script = script
        self.supervisor.run(None)

    def _look(self, status: Status) -> None:
        self.status, self._first_ns = status, self._first_ns or status.time_ns
        assert status.time_ns - self._first_ns < LONGEST_NS, f"the script waits in vain: {status} {self.events}"
        try:
            next(self._script)
        except StopIteration:
            self.supervisor.end()

    def told(self, what: str) -> list[str]:
        """Texts of the events of a kind."""
        return [event.text for event in self.events if event.what == what]


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return setups.setup(tmp_path)


def test_without_a_part_that_it_needs_the_daemon_holds_and_asks_for_a_restart(
    setup: Setup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
    manager.bind(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "10000000")
    play, heard = Play(setup, None), list[str]()
    part = play.supervisor.parts.add("made up", essential=True)
    other = play.supervisor.parts.add("not needed")

    def hear() -> bool:
        while True:
            try:
                heard.append(manager.recv(4096).decode())
            except BlockingIOError:
                return "WATCHDOG=trigger" in heard

    def script() -> Script:
        while not play.status.cycles or play.status.flags:
            yield True
        for _ in range(LOST_AFTER):
            other.failed("whatever")
        for _ in range(LOST_AFTER - 1):
            part.failed("nobody foresaw this")
        for _ in range(5):
            yield True
        assert (play.status.mode, hear()) == ("on", False)
        part.failed("nobody foresaw this")
        while play.status.mode != "hold" or not hear() or "made up: nobody foresaw this" not in "".join(heard):
            yield True

    with manager:
        play.run(script())
    assert play.status.faults == {"made up": LOST_AFTER, "not needed": LOST_AFTER}
    assert play.status.parts == {"made up": "nobody foresaw this", "not needed": "whatever"}
    assert play.told("hold") == ["rtec does not correct without: made up"]
    assert heard.count("WATCHDOG=trigger") == 1
    assert len(play.told("fault")) == 2 * LOST_AFTER


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), ZeroDivisionError()])
def test_a_fault_of_the_disk_s_thread_is_told_and_the_log_goes_on(
    setup: Setup, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """EIO of one `fsync`, a fault in the program: the state is on disk again a little later, and rows reach the log."""
    right, left = DiskState.write, [1]

    def wrong(state: DiskState, saved: object) -> None:
        if left[0]:
            left[0] -= 1
            raise error
        right(state, saved)  # type: ignore[arg-type]

    monkeypatch.setattr(DiskState, "write", wrong)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "kept"))
    log = tmp_path / "run.arrows"
    play = Play(setup, log)

    def script() -> Script:
        while left[0] or play.status.log or not (tmp_path / "kept" / "run.state").exists():
            yield True
        play.supervisor.order(Order.MARK, "behind it")
        while not play.told("mark"):
            yield True

    play.run(script())
    assert play.status.faults == ({} if isinstance(error, OSError) else {"disk": 1})
    assert len(play.told("fault")) == len(play.status.faults)
    assert replay_log(setup, log).different == 0
    assert b"behind it" in (tmp_path / "run.events.jsonl").read_bytes()
    assert (tmp_path / "kept" / "run.state").stat().st_size > 0


def test_a_state_that_another_daemon_keeps_is_not_written(setup: Setup, tmp_path: Path) -> None:
    """Another run file of that name, another runtime folder, the same state folder: refused before a process starts."""
    other = DiskState(tmp_path / "logs" / "run.state")
    other.lock(VirtualClock())
    with pytest.raises(RtecError, match=r"another rtec keeps its state there.*state_folder of its own"):
        Supervisor(setup, None).run(1.0)
    other.close()


def test_a_deleted_state_is_told_and_the_copy_on_disk_goes_on(
    setup: Setup, tmp_path: Path, runtime_folder: Path
) -> None:
    """Nor does a second daemon begin, though the lock in memory is gone with the file. Oracle: rows in the copy."""
    play, seen = Play(setup, None), dict[str, int]()

    def row() -> int:
        saved, _ = read_disk(tmp_path / "logs" / "run.state")
        return -1 if saved is None else saved.row

    def script() -> Script:
        while row() < 0:
            yield True
        next(runtime_folder.glob("rtec.*.state")).unlink()
        seen["row"] = row()
        while row() < seen["row"] + 500 or not play.told("note"):
            yield True
        with pytest.raises(RtecError, match="another rtec keeps its state there"):
            DiskState(tmp_path / "logs" / "run.state").lock(VirtualClock())

    play.run(script())
    (note,) = play.told("note")
    assert "somebody deleted" in note
