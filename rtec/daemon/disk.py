"""Everything that the supervisor writes to disk, in a thread of its own: a disk that stalls delays nothing else.

Rows wait in memory, up to a number; further rows are dropped and counted. An unforeseen fault ends the job that met
it: the log's file ends there, and the thread restarts after it (`rtec.daemon.supervision`).
"""

import queue
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import Final, Self

from rtec.daemon.run_log import Keeper
from rtec.daemon.supervision import DaemonPart, KeptThread
from rtec.log.events import Event, Events
from rtec.log.recording import Begin, Recording
from rtec.loop.records import Commands, Samples
from rtec.loop.state import Saved
from rtec.loop.state_files import DiskState

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
