"""Deadlines that the loop misses at 1 kHz: quiet, with the supervisor stopped, with a log disk that stalls, with
a hundred subscribers, with everything that telemetry publishes, with hostile clients,
with the studio's live page open."""

import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from rtec.control.places import socket_path
from rtec.daemon.supervisor import Supervisor
from rtec.loop.clock import RealClock
from rtec.loop.run_file import Setup
from tests.bench.table import Row
from tests.studio.studio_rig import CHROMIUM
from tests.support import setups
from tests.support.control_rig import Line, free_place
from tests.support.telemetry_rig import Broker, certificates

SECONDS = 10.0
DISTURBED_S = 5.0
BEFORE_S = 2.0
TURNS = 2
SUBSCRIBERS = 100
HOSTILE = ("1100 idle connections", "requests, answers unread", "connections that come and go", "slow scrapes")
SLACK_MISSES = 5
"""What two quiet runs differ by on a computer that does other things too."""

Facts = dict[str, Any]


def rows() -> list[Row]:
    """All figures of this file; each the better of two runs, in turns with the quiet one."""
    runs: dict[str, Callable[[Path], Facts]] = {
        "quiet": _quiet,
        f"supervisor stopped for {DISTURBED_S:g} s": _stopped,
        f"log disk stalled for {DISTURBED_S:g} s": _stalled,
        f"{SUBSCRIBERS} subscribers for {DISTURBED_S:g} s": _subscribed,
        f"MQTT, MTConnect, OPC UA; killed after {DISTURBED_S:g} s": _published,
        **{f"{name}, for {DISTURBED_S:g} s": partial(_attacked, name) for name in HOSTILE},
        **({"the studio's live page open": _watched} if CHROMIUM else {}),
    }
    found: dict[str, list[Facts]] = {name: [] for name in runs}
    for _ in range(TURNS):
        for name, run in runs.items():
            with tempfile.TemporaryDirectory() as folder:
                found[name].append(run(Path(folder)))
    best = {name: min(facts, key=lambda f: f["deadline_misses"]) for name, facts in found.items()}
    quiet = best["quiet"]["deadline_misses"]
    return [_row(name, facts, quiet) for name, facts in best.items()]


def _row(name: str, facts: Facts, quiet: int) -> Row:
    misses, cycles = facts["deadline_misses"], facts["cycles"]
    value = f"{misses} of {cycles}, wake-up p99.9 {facts['wake_up']['p99_9_us']:.0f} µs"
    against = f"quiet: {quiet}; rows not logged: {facts['rows_not_logged']}{facts.get('more', '')}"
    if name == "quiet":
        return Row(f"deadlines missed, {name}", value, None, against, "", True)
    ratio = (misses + 1) / (quiet + 1)
    met = misses <= quiet + SLACK_MISSES
    return Row(f"deadlines missed, {name}", value, ratio, against, f"≤ quiet + {SLACK_MISSES}", met)


def _quiet(folder: Path) -> Facts:
    return _here(setups.setup(folder), folder)


def _here(setup: Setup, folder: Path) -> Facts:
    report = Supervisor(setup, folder / "bench.arrows").run(SECONDS)
    return {**report.summary, "rows_not_logged": report.overruns}


def _stopped(folder: Path) -> Facts:
    """The whole supervisor stands still, by SIGSTOP; its loop is another process."""

    def disturb(config: Path, pid: int) -> str:
        del config
        os.kill(pid, signal.SIGSTOP)
        _after(DISTURBED_S)
        os.kill(pid, signal.SIGCONT)
        return ""

    return _elsewhere(folder, disturb)


def _subscribed(folder: Path) -> Facts:
    """A hundred listen to the published status, all of them by sockets of their own, attached at once."""

    def disturb(config: Path, pid: int) -> str:
        del pid
        heard, count = _listen(config)
        return f"; {heard} subscribers heard {count} statuses"

    return _elsewhere(folder, disturb)


def _published(folder: Path) -> Facts:
    """All protocols of `rtec telemetry`, which was there before the daemon; killed while the loop goes on."""
    place, broker = free_place(), Broker(folder)
    keys = certificates(folder, "mill")
    (keys / "trusted").mkdir()
    telemetry = {
        "mqtt": {"broker": broker.place, "tls": False, "period_s": 0.1},
        "mtconnect": {"listen": place},
        "opcua": {
            "listen": free_place(), "certificate_file": "mill.pem", "key_file": "mill.key", "trusted_folder": "trusted",
        },
    }  # fmt: skip
    config = setups.write(folder, {**setups.tables(folder), "telemetry": telemetry})
    command = [sys.executable, "-m", "rtec.cli.main", "telemetry", str(config)]
    with broker, subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            return _elsewhere(folder, partial(_heard_and_killed, process, place), telemetry=telemetry)
        finally:
            process.kill()


def _heard_and_killed(process: "subprocess.Popen[bytes]", place: str, config: Path, pid: int) -> str:
    del config, pid
    host, port = place.split(":")
    clock, lines = RealClock(), 0
    last_ns = clock.now_ns() + round(DISTURBED_S * 1e9)
    with socket.create_connection((host, int(port))) as agent, agent.makefile("rb") as stream:
        while clock.now_ns() < last_ns:
            lines += bool(stream.readline())
    process.kill()
    return f"; {lines} lines of MTConnect read"


def _attacked(name: str, folder: Path) -> Facts:
    """A hostile client of `make attack`, on processors that it leaves to others, as one on another computer does."""
    place = free_place()

    def disturb(config: Path, pid: int) -> str:
        del pid
        words = ("-m", "tests.attack.clients", name, str(socket_path(config)), place, str(DISTURBED_S))
        subprocess.run(["nice", "-n", "19", sys.executable, *words], stderr=subprocess.DEVNULL, check=True)
        return ""

    return _elsewhere(folder, disturb, control={"prometheus": place})


def _watched(folder: Path) -> Facts:
    """The studio beside it, with its page Live in a browser, on processors that they leave to others."""
    config = setups.write(folder, setups.tables(folder))
    words = ("nice", "-n", "19", sys.executable, "-m", "tests.studio.watch", str(config), str(DISTURBED_S))
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as page:
        assert page.stdout is not None
        page.stdout.readline()  # it is open
        return _started(config, lambda _: f"; the page says {page.communicate()[0].strip() or 'nothing'}")


def _listen(config: Path) -> tuple[int, int]:
    """Attach; give how many heard anything, and how many statuses all of them heard together."""
    clock, heard = RealClock(), [0] * SUBSCRIBERS
    with ExitStack() as opened, selectors.DefaultSelector() as ready:
        for k in range(SUBSCRIBERS):
            line = opened.enter_context(Line.to(config))
            line.send(b'{"schema":1,"ask":"watch"}')
            ready.register(line.socket, selectors.EVENT_READ, k)
        last_ns = clock.now_ns() + round(DISTURBED_S * 1e9)
        while clock.now_ns() < last_ns:
            for key, _ in ready.select(0.1):
                assert isinstance(key.fileobj, socket.socket)
                heard[key.data] += key.fileobj.recv(65536).count(b"\n")
    return sum(n > 0 for n in heard), sum(heard)


def _elsewhere(folder: Path, disturb: Callable[[Path, int], str], **tables: dict[str, Any]) -> Facts:
    """`rtec run` as a process; what the disturbance says goes with the facts."""
    config = setups.write(folder, {**setups.tables(folder), **tables})
    return _started(config, lambda pid: disturb(config, pid))


def _started(config: Path, disturb: Callable[[int], str]) -> Facts:
    """`rtec run`, disturbed after a while."""
    command = [sys.executable, "-m", "rtec.cli.main", "run", str(config), "--json", "--duration", str(SECONDS)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        process.stderr.readline()  # it says when the loop begins
        _after(BEFORE_S)
        more = disturb(process.pid)
        told, _ = process.communicate()
    facts: Facts = {**json.loads(told), "more": more}
    return facts


def _stalled(folder: Path) -> Facts:
    """The disk takes five seconds over one write."""
    setup = setups.setup(folder)
    with _slow_disk():
        return _here(setup, folder)


@contextmanager
def _slow_disk() -> Iterator[None]:
    real, stalled = os.fdatasync, threading.Event()

    def fdatasync(fd: int) -> None:
        if threading.current_thread().name == "rtec-disk" and not stalled.is_set():
            stalled.set()
            _after(DISTURBED_S)
        real(fd)

    os.fdatasync = fdatasync  # type: ignore[assignment]
    try:
        yield
    finally:
        os.fdatasync = real


def _after(seconds: float) -> None:
    clock = RealClock()
    clock.sleep_until_ns(clock.now_ns() + round(seconds * 1e9))
