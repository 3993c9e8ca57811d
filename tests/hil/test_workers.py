"""A slow sensor in a process of its own: killed, stopped, absent. Real processes and clock, a Modbus line on a pty.

Oracles: the kernel, which says who has the line open and who is a child of whom; the slave, which gives a value of its
own by the number of the request; the run's own log, read afterwards.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.correction.flags import Flag
from rtec.daemon.status import Report, Status
from rtec.daemon.supervisor import Supervisor
from rtec.errors import RtecError
from rtec.log.reader import LogReader
from rtec.log.recording import Event
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.state_files import MemoryState, state_places
from tests.support import setups
from tests.support.modbus_peer import FakeLine, FakeSlave, line, serial

pytestmark = [pytest.mark.xdist_group("real-clock"), pytest.mark.usefixtures("runtime_folder")]
LONGEST_NS = 90_000_000_000
Script = Iterator[bool]


def config(folder: Path, port: str, **more: Any) -> Setup:
    """The simulated machine with its two thermometers of interest on a Modbus line."""
    content = setups.tables(folder)
    content["role"]["temperatures"] = ["sensors"]
    registers = {"T_bed": {"address": 0, "scale": 0.01}, "T_spindle_front": {"address": 1, "scale": 0.01}}
    slave = {"id": 1, "period_s": 0.05, "timeout_s": 0.1, "register": registers}
    content["device"]["sensors"] = {"driver": "modbus", "serial": serial(port, **more), "slave": {"one": slave}}
    content["guard"] = {"temperature_max_age_s": 1.0, "counts_max_age_s": 0.05}
    return load_setup(setups.write(folder, content))


def fds(pid: int | str, what: str) -> int:
    """How many descriptors of a process lead there."""
    found = 0
    with suppress(OSError):
        for fd in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(OSError):
                found += what in str(fd.readlink())
    return found


def children() -> list[int]:
    """Living processes that this one has started."""
    out = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state, parent = (entry / "stat").read_text().rpartition(")")[2].split()[:2]
            if int(parent) == os.getpid() and state != "Z":
                out.append(int(entry.name))
    return out


def holders(port: str) -> list[int]:
    """Children of this process that have the line open."""
    return [pid for pid in children() if fds(pid, port)]


def loops() -> list[int]:
    """Children of this process that have a ring mapped: the loop's."""
    return [pid for pid in children() if "/dev/shm/rtec-" in Path(f"/proc/{pid}/maps").read_text()]  # noqa: S108


class Play:
    """Runs a setup; a script looks at each status and does things in between, and says by ending that it is over."""

    def __init__(self, setup: Setup, folder: Path, on_event: Callable[[Event], None] | None = None) -> None:
        self.status, self._first_ns = Status(), 0
        self.log = folder / "run.arrows"
        self._supervisor = Supervisor(setup, self.log, on_status=self._look, on_event=on_event)
        self._script: Script = iter(())

    def run(self, script: Script) -> Report:
        """Until the script is over."""
        self._script = script
        return self._supervisor.run(None)

    def _look(self, status: Status) -> None:
        self.status, self._first_ns = status, self._first_ns or status.time_ns
        assert status.time_ns - self._first_ns < LONGEST_NS, (status, "the script waits in vain")
        try:
            next(self._script)
        except StopIteration:
            self._supervisor.end()

    def until(self, condition: Any) -> Script:
        """Wait for a status that is so."""
        while not condition():
            yield True


@pytest.fixture
def wire() -> Iterator[FakeLine]:
    """A slave that gives 20 °C and up, a hundredth more at each request."""
    with line({1: FakeSlave(value=lambda k: 2000 + k)}) as fake:
        yield fake


def test_a_worker_that_is_killed_and_one_that_is_stopped(tmp_path: Path, wire: FakeLine) -> None:
    """Its own channels grow stale and are held; the loop goes on; a new worker brings values that are new."""
    before, memories, threads = set(children()), fds("self", "rtec-readings"), threading.active_count()
    play = Play(config(tmp_path, wire.port), tmp_path)
    seen: dict[str, Any] = {}

    def good() -> bool:
        return play.status.devices == {} and play.status.degc_age_s["T_bed"] < 0.5 and not play.status.flags

    def told(text: str) -> bool:
        return any(text in reason for reason in play.status.devices.get("sensors", []))

    def script() -> Script:
        yield from play.until(good)
        (seen["first"],) = holders(wire.port)
        assert seen["first"] not in loops()
        assert len(loops()) == 1
        seen["degc"] = play.status.degc["T_bed"]
        os.kill(seen["first"], signal.SIGKILL)
        yield from play.until(lambda: told("SIGKILL"))
        assert str(play.status.devices).count(str(seen["first"])) == 1
        yield from play.until(lambda: holders(wire.port) and good())
        (seen["second"],) = holders(wire.port)
        assert play.status.degc["T_bed"] > seen["degc"]

        os.kill(seen["second"], signal.SIGSTOP)
        yield from play.until(lambda: told("no life") and play.status.degc_age_s["T_bed"] > 1.6)
        assert Flag.STALE_TEMPERATURE in play.status.flags
        seen["held"] = dict(play.status.degc)
        os.kill(seen["second"], signal.SIGCONT)
        yield from play.until(good)
        assert play.status.degc["T_bed"] > seen["held"]["T_bed"]
        seen["cycle"] = play.status.cycles

        os.kill(seen["second"], signal.SIGSTOP)  # such a one is ended, too

    report = play.run(script())
    assert seen["second"] != seen["first"]
    assert report.summary["cycles"] >= seen["cycle"]
    assert set(report.summary["devices"]) == {"sensors"}
    with LogReader(play.log) as reader:
        blocks = list(reader.blocks())
    time_ns = np.concatenate([samples.time_ns for samples, _ in blocks])
    flags = np.concatenate([commands.flags for _, commands in blocks])
    assert len(time_ns) == report.summary["cycles"]
    stale = flags & int(Flag.STALE_TEMPERATURE) != 0
    applied = np.concatenate([commands.applied_um for _, commands in blocks])
    read_ns = np.concatenate([samples.degc_time_ns for samples, _ in blocks])
    end = np.flatnonzero(stale)[-1]
    begin = end - np.argmin(stale[end::-1]) + 1
    later = applied[(begin + end) // 2 : end]  # the axes move on, and with them what is asked for
    assert len(later) > 50
    assert np.ptp(later, axis=0).tolist() == [0.0, 0.0]
    assert (
        np.ptp(applied, axis=0).min() > 0.1
    )  # of the whole record: how far axes come in a part depends on the computer
    assert (np.diff(time_ns) > 0).all()
    assert np.isfinite(applied).all()
    assert (read_ns[:-1] < time_ns[1:, None]).all()  # nothing is younger than the cycle that read it
    assert (np.diff(read_ns, axis=0) >= 0).all()  # nor does a new worker bring back what is old
    assert set(children()) <= before | trackers()
    assert fds("self", "rtec-readings") == memories
    assert threading.active_count() == threads


def trackers() -> set[int]:
    """The process that Python itself starts with the first child, and keeps."""
    return {pid for pid in children() if b"resource_tracker" in Path(f"/proc/{pid}/cmdline").read_bytes()}


def test_a_required_line_that_is_not_there(tmp_path: Path) -> None:
    """Refused before anything runs, by the device's name and for the driver's own reason; nothing stays."""
    before, memories = set(children()), fds("self", "rtec-readings")
    play = Play(config(tmp_path, "/dev/no-such-line", at_start="required"), tmp_path)
    with pytest.raises(RtecError, match=r"\[device\.sensors\].*no-such-line"):
        play.run(iter(()))
    assert set(children()) <= before | trackers()
    assert fds("self", "rtec-readings") == memories


def test_a_line_that_comes_later_is_told_in_the_drivers_words(tmp_path: Path) -> None:
    play = Play(config(tmp_path, "/dev/no-such-line", at_start="later"), tmp_path)

    def script() -> Script:
        yield from play.until(lambda: "no-such-line" in str(play.status.devices.get("sensors")))

    report = play.run(script())
    assert "no-such-line" in report.summary["devices"]["sensors"]["last"]["temperatures"]


def test_the_rows_before_the_loop_died_are_in_the_log(tmp_path: Path, runtime_folder: Path) -> None:
    """To the last one. Oracle: the state that the loop keeps with every cycle, which knows the number of its row."""
    made = load_setup(setups.write(tmp_path, setups.tables(tmp_path)))
    told: list[str] = []
    play = Play(made, tmp_path, lambda event: told.append(event.what))

    def script() -> Script:
        yield from play.until(lambda: play.status.cycles > 300)
        (loop,) = loops()
        while kept_row() < play.status.cycles + 15:
            pass  # the supervisor, in whose thread this runs, looks at no row meanwhile
        os.kill(loop, signal.SIGKILL)
        os.waitid(os.P_PID, loop, os.WEXITED | os.WNOWAIT)  # all of its threads are gone
        yield True

    def kept_row() -> int:
        kept = MemoryState(next(runtime_folder.glob("rtec.*.state"))).newest()
        return 0 if kept is None else kept.row

    with pytest.raises(RtecError, match=r"was killed \(signal 9, Killed\) without a word"):
        play.run(script())
    (memory,) = runtime_folder.glob("rtec.*.state")
    kept = MemoryState(memory).newest()
    assert kept is not None
    with LogReader(play.log) as log:
        assert log.rows in (kept.row, kept.row + 1)  # kept before the row is published: killed in between, or not
        assert log.complete
    assert told == ["alarm"]
    assert "was killed" in play.log.with_suffix(".events.jsonl").read_text(encoding="utf-8")


def test_what_is_wrong_at_the_start_is_told_at_the_start(tmp_path: Path) -> None:
    """A state that is damaged: an event, not only a line in a summary that comes after weeks."""
    made = load_setup(setups.write(tmp_path, setups.tables(tmp_path)))
    spoilt = state_places(made.path, None).memory
    spoilt.write_bytes(b"no state at all" * 9000)
    spoilt.chmod(0o600)
    told: list[tuple[str, str]] = []
    play = Play(made, tmp_path, lambda event: told.append((event.what, event.text)))

    def script() -> Script:
        yield from play.until(lambda: play.status.cycles > 300)
        assert any(what == "note" and f"{spoilt} is damaged" in text for what, text in told)

    play.run(script())
    assert "is damaged" in (tmp_path / "run.events.jsonl").read_text(encoding="utf-8")
