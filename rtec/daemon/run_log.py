"""The logs of a running daemon: their folder, each file's header, the start of a new file, the removal of old ones.

The thread that writes the log calls `Keeper`. It never waits: it orders a new file (`Recording.cut`), and starts and
polls the process that packs and removes (`rtec.log.tidy`).
"""

import json
import os
import platform
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from typing import Final

from rtec.errors import LogError
from rtec.log.folder import WRITTEN, both_clocks, first_name, log_files, time_header
from rtec.log.recording import Begin, Recording
from rtec.log.writer import LogWriter
from rtec.loop.clock import Clock, wall_clock_iso
from rtec.loop.records import Layout
from rtec.loop.run_file import LogTable, Setup
from rtec.loop.state import Saved

LOOK_NS: Final = 1_000_000_000
TIDY_NS: Final = 60_000_000_000
"""Wait for the first time after the start, and between two times, ns; it runs only where there are new files."""
TIDY_ANYWAY_NS: Final = 3600_000_000_000
STEP_NS: Final = 500_000_000
END_S: Final = 2.0

Tell = Callable[[str, str], None]
"""Called with a kind of event and a sentence; both are written to the events."""


class Keeper:
    """Splits, packs and removes the logs in one folder.

    Args:
        folder: folder of the logs; a file elsewhere is never changed.
        rules: the run file's rules.
        clock: monotonic.
        tell: writes an event.
        clocks: gives monotonic and wall clock at one instant, ns.

    Attributes:
        trouble: why logs are not packed or removed; "" where there is no fault.
    """

    def __init__(
        self,
        folder: Path,
        rules: LogTable,
        clock: Clock,
        tell: Tell,
        clocks: Callable[[Clock], tuple[int, int]] = both_clocks,
    ) -> None:
        self._folder, self._rules, self._clock, self._tell, self._clocks = folder, rules, clock, tell, clocks
        self.trouble = ""
        now = clock.now_ns()
        self._next_look_ns, self._next_tidy_ns, self._tidy_anyway_ns = now, now + TIDY_NS, now + TIDY_ANYWAY_NS
        self._path: Path | None = None
        self._begun_ns, self._offset_ns = now, 0
        self._ordered = False
        self._tidier: Popen[bytes] | None = None
        self._known: frozenset[Path] = frozenset()

    def look(self, recording: Recording, newest: Callable[[], Saved | None]) -> None:
        """Order a new file, or start packing and removing, where it is time."""
        now = self._clock.now_ns()
        if now < self._next_look_ns or recording.path is None or recording.path.parent != self._folder:
            return
        self._next_look_ns = now + LOOK_NS
        if recording.path != self._path:
            self._begin(recording.path, now)
        if not self._ordered and not recording.trouble and self._is_time(recording.path, now):
            self._order(recording, newest)
        self._tidy(recording.path, now)

    def close(self) -> None:
        """End the process that packs and removes; the next run goes on with its work."""
        tidier, self._tidier = self._tidier, None
        if tidier is None:
            return
        tidier.terminate()
        with suppress(TimeoutExpired):
            tidier.communicate(timeout=END_S)
            return
        tidier.kill()
        tidier.communicate()

    def _begin(self, path: Path, now: int) -> None:
        self._path, self._begun_ns, self._ordered = path, now, False
        monotonic_ns, wall_ns = self._clocks(self._clock)
        self._offset_ns = wall_ns - monotonic_ns

    def _is_time(self, path: Path, now: int) -> bool:
        monotonic_ns, wall_ns = self._clocks(self._clock)
        step_ns = wall_ns - monotonic_ns - self._offset_ns
        if abs(step_ns) > STEP_NS:
            self._offset_ns += step_ns
            self._tell("clock step", f"the date and time of this computer was set by {step_ns * 1e-9:+.3f} s")
            return True
        if now - self._begun_ns >= self._rules.segment_s * 1e9:
            return True
        with suppress(OSError):
            return path.stat().st_size >= self._rules.segment_mb * 1e6
        return False

    def _order(self, recording: Recording, newest: Callable[[], Saved | None]) -> None:
        saved = newest()
        if saved is not None:
            recording.cut(Begin.behind(saved))
            self._ordered = True

    def _tidy(self, path: Path, now: int) -> None:
        if self._tidier is not None:
            if self._tidier.poll() is None:
                return
            self._take_in(self._tidier)
            self._tidier = None
        if now < self._next_tidy_ns:
            return
        self._next_tidy_ns = now + TIDY_NS
        closed = frozenset(p for p in log_files(self._folder) if p.suffix == WRITTEN and p != path)
        if closed <= self._known and now < self._tidy_anyway_ns:
            return
        self._known, self._tidy_anyway_ns = closed, now + TIDY_ANYWAY_NS
        self._start()

    def _start(self) -> None:
        how = "pack" if self._rules.pack else "leave"
        command = [
            sys.executable,
            "-m",
            "rtec.log.tidy",
            str(self._folder),
            str(self._rules.disk_share),
            how,
        ]
        try:
            self._tidier = Popen(  # noqa: S603 (our own module)
                command, stdin=DEVNULL, stdout=PIPE, stderr=PIPE
            )
        except OSError as error:
            self.trouble = f"logs are not packed: {error.strerror}"

    def _take_in(self, ended: "Popen[bytes]") -> None:
        out, err = ended.communicate()
        try:
            result = json.loads(out)
            troubles, removed = [str(t) for t in result["troubles"]], [str(r) for r in result["removed"]]
        except (ValueError, KeyError, TypeError):
            last = (err.decode(errors="replace").strip().splitlines() or [f"status {ended.returncode}"])[-1]
            troubles, removed = [f"tidying the logs failed: {last}"], []
        self.trouble = "; ".join(troubles)
        if removed:
            self._tell("logs removed", f"for their disk space: {', '.join(removed)}")


def log_folder(setup: Setup) -> Path | None:
    """Log folder of a run file, else the one that systemd gives (LOGS_DIRECTORY); None: no log."""
    folder = setup.file.run.log_folder
    if folder is None:
        given = os.environ.get("LOGS_DIRECTORY", "").split(":", maxsplit=1)[0]
        return Path(given).resolve() if given else None
    return (setup.base / folder).resolve()


def new_log_path(setup: Setup) -> Path | None:
    """Path of the log of a run that starts now: number, date and time, in the run file's log folder.

    Raises:
        LogError: the folder cannot be created.
    """
    folder = log_folder(setup)
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise LogError(f"{folder}: cannot be made: {e.strerror}") from e
    return first_name(folder, setup.path.stem, wall_clock_iso().replace(":", "").replace("-", ""))


def new_log(path: Path, setup: Setup, layout: Layout, clock: Clock, begin: Mapping[str, str]) -> LogWriter:
    """Begin a file of the log.

    Args:
        path: path of the file.
        setup: the setup in force.
        layout: axes and sensors.
        clock: monotonic; the header has its relation to date and time.
        begin: further entries of the header: the step's whole memory.

    Raises:
        LogError: the file cannot be created.
    """
    header = {
        **setup.log_header(),
        "host": platform.node(),
        "python": platform.python_version(),
        "started": wall_clock_iso(),
        **time_header(clock),
        **begin,
    }
    return LogWriter(path, layout, header)
