"""Everything that the supervisor writes to disk, in a thread of its own: a disk that stalls delays nothing else.

Rows wait in memory, up to a number; further rows are dropped and counted. An unforeseen fault ends the job that met
it: the log's file ends there, and the thread restarts after it (`rtec.daemon.supervision`).

The logs have a folder, a header for each file, and a `Keeper`, which never waits: it orders a new file
(`Recording.cut`), and starts and polls the process that packs files and removes old ones (`rtec.log.tidy`).
"""

import json
import os
import platform
import queue
import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen, TimeoutExpired
from typing import Final, Self

from rtec.daemon.supervision import DaemonPart, KeptThread
from rtec.errors import LogError, ModelError
from rtec.log.folder import WRITTEN, both_clocks, first_name, log_files, model_copy, time_header
from rtec.log.recording import Begin, Event, Events, Recording
from rtec.log.writer import LogWriter
from rtec.loop.clock import Clock, wall_clock_iso
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.run_file import LogTable, Setup
from rtec.loop.state import Saved
from rtec.loop.state_files import DiskState
from rtec.model import save_model

LOOK_NS: Final = 1_000_000_000
TIDY_NS: Final = 60_000_000_000
"""Wait for the first time after the start, and between two times, ns; it runs only where there are new files."""
TIDY_ANYWAY_NS: Final = 3600_000_000_000
STEP_NS: Final = 500_000_000
TIDIER_END_S: Final = 2.0

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
            tidier.communicate(timeout=TIDIER_END_S)
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


def _named(setup: Setup) -> str:
    return "LOGS_DIRECTORY" if setup.file.run.log_folder is None else "[run] log_folder"


def unusable(folder: Path) -> str:
    """Why this user cannot write into a folder, which need not exist yet; "" where that is possible."""
    there = next(p for p in (folder, *folder.parents) if os.path.lexists(p))
    if not there.is_dir():
        return f"{'it' if there == folder else there} is no folder"
    return "" if os.access(there, os.W_OK | os.X_OK) else f"this user may not write into {there}"


def folder_faults(setup: Setup) -> list[str]:
    """Folders of the run file that a run could not use, a line each; nothing is made."""
    kept = setup.file.run.state_folder
    folders = {} if kept is None else {"[run] state_folder": (setup.base / kept).resolve()}
    if (logs := log_folder(setup)) is not None:
        folders[_named(setup)] = logs
    return [f"{name} {folder}: {why}" for name, folder in folders.items() if (why := unusable(folder))]


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
        raise LogError(f"{_named(setup)} {folder}: {unusable(folder) or f'cannot be made: {e.strerror}'}") from e
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
    writer = LogWriter(path, layout, header)
    if setup.model.effects and path.parent == log_folder(setup):
        _keep_model(setup, path.parent)
    return writer


def _keep_model(setup: Setup, folder: Path) -> None:
    """Keep a copy of a model beside the logs that it made, once: after a reload a log can be replayed with its own."""
    copy = model_copy(folder, setup.model.hash)
    with suppress(OSError, ModelError):  # a disk that is full is reported with the log; the next file tries again
        copy.parent.mkdir(exist_ok=True)
        if not copy.exists():
            save_model(setup.model, copy, replace=False)


MOST_SECONDS: Final = 60.0
END_S: Final = 5.0


@dataclass(frozen=True)
class _Rows:
    samples: Samples
    commands: Commands
    first_row: int


@dataclass(frozen=True)
class _Do:
    action: Callable[[], None]


class DiskThread:
    """Writes log and state. Entering starts it; leaving writes the waiting jobs, for a few seconds at most.

    Args:
        recording: the log; from now on other threads may only read its attributes.
        state: the copy of the state; None: no copy is kept.
        newest: gives the newest state.
        most_rows: largest number of waiting rows.
        part: counts the thread's faults.
        keeper: begins new files and removes the old ones; None: the log is one file.

    Attributes:
        dropped: rows dropped because too many were waiting.
        state_trouble: why the state is not on disk; "" where it is.
        kept_mode: the mode of the state on disk; None before it is first written.
    """

    def __init__(
        self,
        recording: Recording,
        state: DiskState | None,
        newest: Callable[[], Saved | None],
        most_rows: int,
        part: DaemonPart,
        keeper: Keeper | None = None,
    ) -> None:
        self.recording, self.dropped, self.state_trouble = recording, 0, ""
        self.kept_mode: int | None = None
        self._behind: Events | None = None
        self._state, self._newest, self._most_rows, self._keeper = state, newest, most_rows, keeper
        self._jobs: queue.SimpleQueue[_Rows | _Do | None] = queue.SimpleQueue()
        self._waiting = self._done = 0
        self._thread = KeptThread(part, self._work)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._jobs.put(None)
        if not self._thread.end(END_S):
            self.recording.warnings.append("the disk did not answer at the end: the last rows may not be in the log")

    @property
    def keeps(self) -> bool:
        """Is a copy of the state kept on disk?"""
        return self._state is not None

    @property
    def missed(self) -> int:
        """Rows that are in no log."""
        return self.dropped + self.recording.missed

    @property
    def trouble(self) -> str:
        """Present fault of the disk; "" where there is none."""
        waiting = self._waiting - self._done
        slow = f"the disk is slow: {waiting} rows wait" if waiting > self._most_rows // 4 else ""
        kept = "" if self._keeper is None else self._keeper.trouble
        return "; ".join(text for text in (self.recording.trouble, slow, self.state_trouble, kept) if text)

    def write(self, samples: Samples, commands: Commands, first_row: int) -> None:
        """Queue rows; the caller does not change them afterwards."""
        if self._waiting - self._done + len(samples) > self._most_rows:
            self.dropped += len(samples)
            return
        self._waiting += len(samples)
        self._jobs.put(_Rows(samples, commands, first_row))

    def flush(self) -> None:
        """Write all queued jobs to the disk, with the state."""
        self._jobs.put(_Do(self._flush))

    def cut(self, begin: Begin) -> None:
        """Begin a new file of the log at that row."""
        self._jobs.put(_Do(lambda: self.recording.cut(begin)))

    def event(self, events: Events, event: Event) -> None:
        """Queue an event."""
        self._jobs.put(_Do(lambda: self._event(events, event)))

    def _event(self, events: Events, event: Event) -> None:
        try:
            events.write(event)
            self._behind = None
        except OSError as e:
            if self._behind is None:
                why = f"{events.path}: events wait until they can be written: {e.strerror}"
                self.recording.warnings.append(why)
            self._behind = events

    def _flush(self) -> None:
        self.recording.flush()
        self._keep_state()
        if self._behind is not None:
            with suppress(OSError):  # reported already, and tried again with the next flush
                self._behind.catch_up()
                self._behind = None

    def _keep_state(self) -> None:
        saved = self._newest() if self._state is not None else None
        if self._state is None or saved is None:
            return
        kept = None
        try:
            self._state.write(saved)
            kept, self.state_trouble = saved.mode, ""
        except OSError as e:
            if not self.state_trouble:
                self.recording.warnings.append(f"state {self._state.path}: cannot be written: {e.strerror}")
            self.state_trouble = f"the state is not on disk: {e.strerror}"
        finally:
            self.kept_mode = kept

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            if isinstance(job, _Rows):
                try:
                    self.recording.write(job.samples, job.commands, job.first_row)
                finally:
                    self._done += len(job.samples)
            else:
                job.action()
            if self.recording.wants_to_try_again() and (saved := self._newest()) is not None:
                self.recording.cut(Begin.behind(saved))
            if self._keeper is not None:
                self._keeper.look(self.recording, self._newest)
        self._jobs.put(None)  # for the next attempt, if this end fails
        with ExitStack() as last:  # each callback runs, whatever becomes of the others; the last one runs first
            if self._state is not None:
                last.callback(self._state.close)
            last.callback(self._keep_state)
            if self._keeper is not None:
                last.callback(self._keeper.close)
            last.callback(self.recording.close)
