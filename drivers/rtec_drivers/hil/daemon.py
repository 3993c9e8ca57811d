"""Runs the daemon, the code of `rtec run`, against the far sides, on the real clock."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from rtec.daemon.status import Status
from rtec.daemon.supervisor import Supervisor
from rtec.errors import LogError
from rtec.hil import FaultOrder, Tell
from rtec.loop.clock import RealClock
from rtec.loop.run_file import load_setup
from rtec.loop.state_files import state_places
from rtec_drivers.hil.bus_run import BusRun
from rtec_drivers.hil.far_sides import FarSides
from rtec_drivers.hil.logbook import read_logbook
from rtec_drivers.hil.track import TipTrack
from rtec_drivers.hil.watch import FaultWatch
from rtec_drivers.hil.wiring import TRACK, Wiring

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
        KeyboardInterrupt: a signal ended it; the far sides have ended.
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
        if report.interrupted:
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
