"""One run of the daemon, the code of `rtec run`, behind real buses: its far sides, its log, its result."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.util import register_after_fork
from pathlib import Path
from types import FrameType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Bools, Floats, Ints
from rtec.correction.flags import HOLD_REASONS, MODE_TAKEN_OVER, ORDER_MASK
from rtec.daemon.status import Report, Status
from rtec.daemon.supervisor import Supervisor
from rtec.errors import DriverUnavailable, LogError
from rtec.hil import FaultOrder, Tell
from rtec.log.reader import LogReader
from rtec.loop.clock import RealClock
from rtec.loop.records import Commands, Samples
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.state_files import state_places
from rtec_drivers.hil.faults import FaultWatch
from rtec_drivers.hil.plant import TipTrack
from rtec_drivers.hil.wiring import SENSED, TRACK, Wiring

NS = 1e-9


@dataclass(frozen=True)
class Logbook:
    """Summary of a log.

    Attributes:
        time_ns: instant of every cycle, (n,).
        held: was the correction held? (n,).
        age_s: by sensor, age of its reading, s, (n,), in single precision.
        fastest: largest rate of change of the correction between two cycles, relative to its slew limit, over all axes.
        commanded: output of every cycle, (n, axes).
        output: the last output, by axis.
    """

    time_ns: Ints
    held: Bools
    age_s: Mapping[str, NDArray[np.float32]]
    fastest: float
    commanded: Ints
    output: Mapping[str, int]

    def seconds(self, start_ns: int) -> Floats:
        """Time of every cycle since an instant, s, (n,)."""
        return np.asarray((self.time_ns - start_ns) * NS)


def read_logbook(path: Path, setup: Setup) -> Logbook:
    """Read a log once; memory grows by some ten bytes an axis and four a sensor for every cycle."""
    times, held, ages, outputs, fastest = [], [], [], [], 0.0
    before: tuple[Samples, Commands] | None = None
    with LogReader(path) as reader:
        layout = reader.layout
        slew = np.array([setup.file.limits[a].slew_um_s if a in setup.file.limits else np.inf for a in layout.axes])
        for samples, commands in reader.blocks():
            times.append(samples.time_ns.copy())
            held.append((commands.flags & HOLD_REASONS) != 0)
            ages.append(((samples.time_ns[:, None] - samples.degc_time_ns) * NS).astype(np.float32))
            fastest = max(fastest, _fastest(before, samples, commands, slew))
            before = (
                samples.rows(len(samples) - 1, len(samples)).copy(),
                commands.rows(len(samples) - 1, len(samples)).copy(),
            )
            outputs.append(commands.output.copy())
    age_s, commanded = np.concatenate(ages), np.concatenate(outputs)
    return Logbook(
        np.concatenate(times),
        np.concatenate(held),
        {name: age_s[:, k] for k, name in enumerate(layout.sensors)},
        fastest,
        commanded,
        dict(zip(layout.axes, commanded[-1].tolist(), strict=True)),
    )


def _fastest(before: tuple[Samples, Commands] | None, samples: Samples, commands: Commands, slew: Floats) -> float:
    """Largest change of a block, and from the block before, relative to what the slew limit allows in that time.

    A row whose ledger was taken over from the box is no change: the box had it already.
    """
    time_ns, applied, mode = samples.time_ns, commands.applied_um, samples.mode & ORDER_MASK
    if before is not None:
        time_ns = np.concatenate([before[0].time_ns, time_ns])
        applied = np.concatenate([before[1].applied_um, applied])
        mode = np.concatenate([before[0].mode & ORDER_MASK, mode])
    if len(time_ns) < 2:
        return 0.0
    allowed = np.diff(time_ns)[:, None] * NS * slew
    share = np.abs(np.diff(applied, axis=0)) / allowed
    share[mode[1:] == MODE_TAKEN_OVER] = 0.0
    share[mode[:-1] == MODE_TAKEN_OVER] = 0.0
    return float(share.max())


def held_spans(logbook: Logbook, start_ns: int) -> Sequence[tuple[float, float]]:
    """Begin and end of every hold, s since an instant."""
    seconds, held = logbook.seconds(start_ns), logbook.held
    edges = np.flatnonzero(np.diff(np.concatenate([[0], held.astype(np.int8), [0]])))
    return [
        (float(seconds[a]), float(seconds[min(b, len(seconds) - 1)]))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


@dataclass(frozen=True)
class BusRun:
    """Result of one run of the daemon behind real buses.

    Attributes:
        setup: its run file.
        report: the daemon's report.
        start_ns: start of the machine.
        track: positions of the tool tip.
        logbook: summary of the log.
        log: path of the log.
        far_counts: counts of the far sides.
        watch: the daemon's messages.
        warnings: what the system refused.
    """

    setup: Setup
    report: Report
    start_ns: int
    track: TipTrack
    logbook: Logbook
    log: Path
    far_counts: Mapping[str, Mapping[str, Any]]
    watch: FaultWatch
    warnings: Sequence[str]

    @property
    def duration_s(self) -> float:
        """Duration in cycles of the loop, s."""
        return float(self.report.summary["cycles"] / self.setup.file.run.rate_hz)


PARTS = ("machine", "sensors")
END_S = 10.0


class FarSides:
    """The far sides of all buses, in processes and sessions of their own, so that Ctrl-C does not reach them.

    Args:
        config: run file with section `[hil]`.
        folder: folder for ports and results.
        every_ms: period of recording the tip, ms.
        gateware: a library of simulated gateware, which replaces the box in software.

    Attributes:
        warnings: what the system refused them.
    """

    def __init__(self, config: Path, folder: Path, every_ms: int, gateware: Path | None = None) -> None:
        self.warnings: list[str] = []
        self._config, self._folder, self._every_ms, self._gateware = config, folder, every_ms, gateware
        self._processes: dict[str, subprocess.Popen[str]] = {}
        register_after_fork(self, FarSides._let_go)  # they end with this process, not with a copy of it

    def __enter__(self) -> Self:
        """Start them; return when their ports exist.

        Raises:
            DriverUnavailable: one could not start; the message says why.
        """
        for name in (SENSED, TRACK):
            (self._folder / name).unlink(missing_ok=True)
        try:
            # The machine creates the sensors' file, so its process comes first.
            for part in PARTS:
                self._processes[part] = self._start(part)
                self.warnings += [f"simulated {part}: {w}" for w in self._heard(part)["warnings"]]
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        """End them."""
        self._end()

    def start(self, at_ns: int, faults: Sequence[FaultOrder]) -> None:
        """Start the machine at that instant, from which the faults count."""
        order = {"do": "start", "at_ns": at_ns, "faults": [(f.name, f.at_s, f.end_s) for f in faults]}
        for part in PARTS:
            self._tell(part, order)

    def finish(self) -> dict[str, dict[str, Any]]:
        """End them and give each one's counts; the machine's record is then in the folder."""
        out = {}
        for part in PARTS:
            self._tell(part, {"do": "stop"})
            out[part] = self._heard(part)
        return out

    def _start(self, part: str) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "rtec_drivers.hil.far_side", str(self._config), "--part", part]
        command += ["--folder", str(self._folder), "--every-ms", str(self._every_ms)]
        command += ["--gateware", str(self._gateware)] if self._gateware else []
        return subprocess.Popen(  # noqa: S603 - our own interpreter and module
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def _tell(self, part: str, order: dict[str, Any]) -> None:
        pipe = self._processes[part].stdin
        if pipe is not None:
            try:
                pipe.write(json.dumps(order) + "\n")
                pipe.flush()
            except BrokenPipeError:
                raise self._died(part) from None

    def _heard(self, part: str) -> dict[str, Any]:
        pipe = self._processes[part].stdout
        line = pipe.readline() if pipe is not None else ""
        if not line:
            raise self._died(part)
        answer: dict[str, Any] = json.loads(line)
        return answer

    def _died(self, part: str) -> DriverUnavailable:
        process = self._processes[part]
        lines = process.communicate()[1].strip().splitlines()
        why = lines[-1] if lines else f"exit code {process.returncode}"
        return DriverUnavailable(f"the bench's process {part!r} ended: {why}")

    def _let_go(self) -> None:
        for process in self._processes.values():
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None and not pipe.closed:
                    try:
                        pipe.close()
                    except BrokenPipeError:
                        continue

    def _end(self) -> None:
        self._let_go()
        for process in self._processes.values():
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes = {}


LEAST_MS, MOST_ROWS = 10, 200_000


def every_ms_of(duration_s: float) -> int:
    """Period of recording the tip in a run of this length, ms."""
    return max(LEAST_MS, round(duration_s * 1e3 / MOST_ROWS))


def run_on_buses(
    wiring: Wiring,
    folder: Path,
    mode: str,
    duration_s: float,
    faults: Sequence[FaultOrder],
    every_ms: int,
    tell: Tell,
    keep: Path | None = None,
    look: Callable[[Status], None] = lambda _: None,
) -> BusRun:
    """Run the daemon against the far sides on the real clock.

    Args:
        wiring: the run file.
        folder: folder for ports, run files and the log.
        mode: "on" or "off".
        duration_s: duration, s.
        faults: to inject.
        every_ms: period of recording the tip, ms.
        tell: called with the seconds done.
        keep: folder in which the log is kept; None: it is removed.
        look: called with every status.

    Raises:
        KeyboardInterrupt: a signal ended it uncorrected, or within its first second; the far sides have ended.
    """
    clock, config = RealClock(), wiring.with_ports(folder, mode)
    if keep:
        _make(keep)
    setup, log = load_setup(config), (keep or folder) / f"hil-{mode}.arrows"
    log.unlink(missing_ok=True)
    words = f"behind real buses, {'corrected' if mode == 'on' else 'uncorrected'}"
    tell(words, 0, 0)
    with _no_state_left(config), FarSides(config, folder, every_ms, wiring.gateware) as far:
        tenths = round(duration_s * 10)
        watch = FaultWatch(faults, wiring.buses, clock, lambda s: tell(words, round(s * 10), tenths))

        def begin() -> None:
            watch.start_ns = clock.now_ns()
            far.start(watch.start_ns, faults)

        def show(status: Status) -> None:
            watch.look(status)
            look(status)

        supervisor = Supervisor(setup, log, show, begin, forks=True)
        watch.resume, watch.place = supervisor.order_resume, f"{folder}/"
        report = supervisor.run(duration_s)
        if report.interrupted and (mode == "off" or report.summary["cycles"] < setup.file.run.rate_hz):
            raise KeyboardInterrupt
        far_counts = far.finish()
        return BusRun(
            setup,
            report,
            watch.start_ns,
            TipTrack.load(folder / TRACK),
            read_logbook(log, setup),
            log,
            far_counts,
            watch,
            [*far.warnings, *report.warnings],
        )


@contextmanager
def ends_politely() -> Iterator[None]:
    """End at SIGTERM as at Ctrl-C, at any time: started processes are ended, temporary files are removed."""
    before = {number: signal.signal(number, _end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int, frame: FrameType | None) -> None:
    del number, frame
    raise KeyboardInterrupt


@contextmanager
def _no_state_left(config: Path) -> Iterator[None]:
    """Remove the ledger that the daemon keeps for the next start: a run file of the bench has none."""
    try:
        yield
    finally:
        state_places(config, None).memory.unlink(missing_ok=True)


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise LogError(f"{folder}: cannot be made: {e.strerror}") from e
