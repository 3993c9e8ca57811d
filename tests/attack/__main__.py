"""Attacks for so many minutes, prints figures, fails on any loss: `python -m tests.attack [MINUTES]`.

A loss: an order to hold that is not answered, a daemon or loop that ends, a command beyond its limit, a ledger that is
not the machine's, memory that grows, a file that is neither read nor refused. Deadlines are reported, not judged: that
is for `make bench` on a quiet computer.
"""

import itertools
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from unittest import mock

import numpy as np
from rich.table import Table

from rtec.cli.screen import Console
from rtec.control.client import Client, find
from rtec.control.places import socket_path
from rtec.errors import RtecError
from rtec.log.reader import LogReader
from rtec.loop.clock import RealClock
from rtec.loop.orders import Order
from tests import extremes, fuzz
from tests.attack.clients import ATTACKS
from tests.support import hil_rig, kill_rig, setups
from tests.support.control_rig import free_place

MINUTES: Final = 10.0
SHARES: Final = {"kills": 0.2, "buses": 0.3, "clients": 0.35, "files": 0.15}
GROWTH_MB: Final = 48.0
"""Of the supervisor, during one attack: 256 connections with full buffers are a third of it."""
EVERY_NS: Final = 200_000_000
KILLS: Final = 50
CYCLE_NS: Final = 1_000_000
BATCH: Final = 50
NUMBERS: Final = 5
SLEW_UM_S, COUNTS_PER_UM = 50.0, 2.0
ROUNDING: Final = 1e-9
CLOCK: Final = RealClock()


@dataclass
class Row:
    """What came of one attack.

    Attributes:
        name: of it.
        tried, survived: how often.
        step: largest command beside what the limits allow, as a share; None: nothing is commanded.
        slowest_s: longest wait for an answer; None: nobody asked.
        memory_mb: by how much the attacked process grew; None: not looked at.
        deadlines: missed, of how many.
        losses: in words.
    """

    name: str
    tried: int
    survived: int
    step: float | None = None
    slowest_s: float | None = None
    memory_mb: float | None = None
    deadlines: str = ""
    losses: list[str] = field(default_factory=list)

    @property
    def lost(self) -> list[str]:
        """Everything that must not be."""
        out = list(self.losses)
        if self.survived < self.tried or not self.tried:
            out.append(f"{self.survived} of {self.tried} survived")
        if self.step is not None and self.step > 1 + ROUNDING:
            out.append(f"a command of {self.step:.2f} times its limit")
        if self.memory_mb is not None and self.memory_mb > GROWTH_MB:
            out.append(f"grew by {self.memory_mb:.0f} MB")
        return out


def kills(seconds: float) -> Iterator[Row]:
    """The loop, by SIGKILL, on a machine that outlives it, whether the actuator can tell its ledger or not."""
    for kind in ("box", "register"):
        row, end_ns = Row(f"kill -9 of the loop, {kind}", 0, 0, 0.0), CLOCK.now_ns() + round(seconds * 0.5e9)
        while not row.tried or CLOCK.now_ns() < end_ns:
            with tempfile.TemporaryDirectory() as folder:
                command = [sys.executable, "-m", kill_rig.__name__, folder, str(KILLS), str(row.tried + 1), kind]
                done = subprocess.run(command, capture_output=True, text=True, check=False)
            row.tried += KILLS
            if done.returncode:
                row.losses.append(done.stderr[-200:])
                break
            survived, step = killed(json.loads(done.stdout), kind)
            row.survived += survived
            row.step = max(row.step or 0.0, step)
        yield row


def killed(found: dict[str, Any], kind: str) -> tuple[int, float]:
    """How many loops took over what the machine has; the largest command beside its limit."""
    commands = np.array(found["commands"])
    output = commands[:, 3:]
    may = 1 + np.ceil(SLEW_UM_S * COUNTS_PER_UM * CYCLE_NS * 1e-9)  # of one cycle, however long the loop was dead
    offs = [np.abs(np.array(b["output"]) - output[b["after"] - 1]).max() for b in found["begins"][1:]]
    bad = sum(off > (0 if kind == "box" else 1) for off in offs)
    lost = np.abs(np.array(found["saved"]) - found["inserted"]).max() > 1
    # A loop that was killed before it took over anything has no entry among the begins: it lost nothing.
    return KILLS - int(bad) - int(lost), float((np.abs(np.diff(output, axis=0)).max(axis=1) / may).max())


def buses(seconds: float) -> Iterator[Row]:
    """Every fault of every bus by chance, against the daemon on simulated hardware."""
    command = (
        "hil",
        hil_rig.SHIPPED,
        "--soak",
        max(0.5, seconds / 60),
        "--seed",
        random.randrange(1000),
        "--shared",
        "--json",
    )
    done = hil_rig.rtec(*command)
    if not done.stdout:
        yield Row("faults on every bus", 1, 0, losses=[done.stderr[-200:]])
        return
    found = json.loads(done.stdout)
    bad = [f"{check['name']}: {check['found']}" for check in found["checks"] if check["judged"] and not check["passed"]]
    timing = found["timing"]
    deadlines = f"{timing['deadline_misses']} of {timing['cycles']}"
    tried = sum(fault["times"] for fault in found["faults"])
    yield Row("faults on every bus", tried, tried, deadlines=deadlines, losses=bad)


def clients(seconds: float) -> Iterator[Row]:
    """Each hostile client in turn; meanwhile somebody gives orders and wants answers."""
    each_s = max(1.5, seconds / (len(ATTACKS) + 2))
    with tempfile.TemporaryDirectory() as name, mock.patch.dict(os.environ, RUNTIME_DIRECTORY=name):
        folder = Path(name)
        place, content = free_place(), setups.tables(folder)
        config = setups.write(folder, {**content, "control": {"prometheus": place, "status_hz": 50}})
        command = [
            sys.executable,
            "-m",
            "rtec.cli.main",
            "run",
            str(config),
            "--log",
            str(folder / "log.arrows"),
            "--json",
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as daemon:
            _until_it_runs(config, daemon)
            rows = [_attacked("none (quiet)", config, place, each_s, daemon.pid)]
            rows += [_attacked(attack, config, place, each_s, daemon.pid) for attack in ATTACKS]
            marks = sum(event["text"] == "once" for event in _events(folder))
            if marks > 1:
                rows[-1].losses.append(f"a replayed order was carried out {marks - 1} times")
            daemon.send_signal(signal.SIGTERM)
            daemon.communicate()
        if daemon.returncode != 130:
            rows[-1].losses.append(f"the daemon ended with {daemon.returncode}")
        rows[-1].step = _largest_step(folder / "log.arrows")
    yield from rows


def _until_it_runs(config: Path, daemon: "subprocess.Popen[str]") -> None:
    while daemon.poll() is None:
        try:
            with Client(find(config, None, None)) as client:
                if client.status()["status"]["cycles"]:
                    return
        except RtecError:
            CLOCK.sleep_until_ns(CLOCK.now_ns() + EVERY_NS)
    raise SystemExit("the daemon did not begin")


def _attacked(name: str, config: Path, place: str, seconds: float, pid: int) -> Row:
    """One hostile client in a process of its own; an order every fifth of a second from new connections."""
    row, before, grown = Row(name, 0, 0), _status(config), _memory_mb(pid)
    hostile = None
    if name in ATTACKS:
        words = ("-m", "tests.attack.clients", name, str(socket_path(config)), place, str(seconds))
        hostile = subprocess.Popen([sys.executable, *words], stderr=subprocess.DEVNULL)
    end_ns = CLOCK.now_ns() + round(seconds * 1e9)
    largest = grown
    while CLOCK.now_ns() < end_ns or (hostile is not None and hostile.poll() is None):
        row.tried, asked_ns = row.tried + 1, CLOCK.now_ns()
        try:
            with Client(find(config, None, None)) as client:
                client.order(Order.HOLD if row.tried % 2 else Order.ENABLE)
            row.survived += 1
            row.slowest_s = max(row.slowest_s or 0.0, (CLOCK.now_ns() - asked_ns) * 1e-9)
        except RtecError as e:
            row.losses.append(str(e))
        largest = max(largest, _memory_mb(pid))
        CLOCK.sleep_until_ns(CLOCK.now_ns() + EVERY_NS)
    after = _status(config)
    row.memory_mb = largest - grown
    row.deadlines = f"{after['misses'] - before['misses']} of {after['cycles'] - before['cycles']}"
    if after["cycles"] == before["cycles"] or after["overruns"]:
        row.losses.append(f"the loop stands, or rows are lost ({after['overruns']})")
    return row


def _status(config: Path) -> dict[str, Any]:
    with Client(find(config, None, None), wait_s=20.0) as client:
        found: dict[str, Any] = client.status()["status"]
        return found


def _memory_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return float(next(line for line in lines if line.startswith("RssAnon")).split()[1]) / 1024


def _events(folder: Path) -> list[dict[str, Any]]:
    lines = (folder / "log.events.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def _largest_step(log: Path) -> float:
    """Largest change of the correction beside what its slew limit allows in the time between, one cycle at most."""
    with LogReader(log) as reader:
        blocks = list(reader.blocks())
    um = np.concatenate([commands.applied_um for _, commands in blocks])
    time_ns = np.concatenate([samples.time_ns for samples, _ in blocks])
    return float(
        (np.abs(np.diff(um, axis=0)).max(axis=1) / (SLEW_UM_S * np.minimum(np.diff(time_ns), CYCLE_NS) * 1e-9)).max()
    )


def files(seconds: float) -> Iterator[Row]:
    """Texts that are spoilt, numbers beyond reason, files that are larger inside than outside."""
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)
        before = _peak_mb()
        row = Row("spoilt files and requests", 0, 0)
        readers = fuzz.kinds(Path(name))
        for seed in _rounds(seconds / 2):
            for read, seeds in readers.values():
                found = fuzz.feed(read, seeds, BATCH, seed)
                row.tried += BATCH
                row.survived += found.read + found.refused
                row.losses += [fault for _, fault in found.faults]
        row.memory_mb = _peak_mb() - before
        yield row
        row, kinds = Row("numbers beyond reason", 0, 0), extremes.kinds(Path(name))
        for seed in _rounds(seconds / 2):
            for kind in kinds.values():
                every = extremes.trials(kind)
                some = random.Random(seed).sample(every, min(NUMBERS, len(every)))
                outcome = extremes.attack(kind, Path(name), some)
                row.tried += len(some)
                row.survived += outcome.good + outcome.refused
                row.losses += outcome.faults
        yield row
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/metrology/test_file_bombs.py"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    counts = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|error)", done.stdout)}
    losses = [done.stdout[-400:]] if done.returncode else []
    yield Row("file bombs", sum(counts.values()), counts.get("passed", 0), losses=losses)


def _rounds(seconds: float) -> Iterator[int]:
    """Seeds until the time is over, one at least."""
    end_ns = CLOCK.now_ns() + round(seconds * 1e9)
    for seed in itertools.count(1):
        yield seed
        if CLOCK.now_ns() > end_ns:
            return


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


ROOMS: Final[dict[str, Callable[[float], Iterator[Row]]]] = {
    "kills": kills,
    "buses": buses,
    "clients": clients,
    "files": files,
}


def show(rows: list[Row]) -> int:
    """Print the table; give an exit status."""
    table = Table(
        *(
            "attack",
            "tried",
            "survived",
            "largest step / limit",
            "slowest answer, s",
            "memory, MB",
            "deadlines missed",
            "",
        )
    )
    for row in rows:
        step = "" if row.step is None else f"{row.step:.2f}"
        memory = "" if row.memory_mb is None else f"{row.memory_mb:+.1f}"
        slowest = "" if row.slowest_s is None else f"{row.slowest_s:.2f}"
        verdict = "LOST" if row.lost else "ok"
        table.add_row(row.name, str(row.tried), str(row.survived), step, slowest, memory, row.deadlines, verdict)
    console = Console(width=150)
    console.print(table)
    for row in rows:
        for loss in row.lost:
            console.print(f"LOST: {row.name}: {loss}")
    return 1 if any(row.lost for row in rows) else 0


def main(minutes: float) -> int:
    """Attack everything; give an exit status."""
    rows: list[Row] = []
    for name, room in ROOMS.items():
        for row in room(60 * minutes * SHARES[name]):
            sys.stdout.write(f"{row.name}: {row.survived} of {row.tried}\n")
            sys.stdout.flush()
            rows.append(row)
    return show(rows)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]) if len(sys.argv) > 1 else MINUTES))
