"""The supervisor: starts the fast path, drains its ring, passes orders on, shows the status, ends it in order.

It is a process beside the loop's. A thread of its own writes to the disk (`rtec.daemon.disk`), so that neither the
loop nor an operator's order waits for a disk.
"""

import os
import queue
import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from types import FrameType
from typing import Any, Final

from rtec.correction.flags import Flag
from rtec.daemon.causes import causes
from rtec.daemon.claim import Claim
from rtec.daemon.disk import MOST_SECONDS, DiskThread, Keeper, log_folder, new_log
from rtec.daemon.fastpath import LoopTask, fast_path
from rtec.daemon.homing import Homing
from rtec.daemon.process import Notifier, child_context, signals, signals_wait
from rtec.daemon.reload import ReloadDesk
from rtec.daemon.ring import Ring
from rtec.daemon.sign_check import StepOrders
from rtec.daemon.status import MODE_NAMES, Alarms, Report, RowWatch, Status
from rtec.daemon.supervision import DaemonParts
from rtec.daemon.tables import TableKeeper, TableThread
from rtec.daemon.workers import Workers
from rtec.errors import DriverFault, RtecError
from rtec.log.recording import Begin, Event, Events, Recording, events_path
from rtec.log.writer import LogWriter
from rtec.loop.clock import RealClock, wall_clock_iso
from rtec.loop.orders import LONGEST_TEXT, MODE_OF, Order, OrderRefused
from rtec.loop.records import MODES_BY_NAME, Commands, Layout, Samples
from rtec.loop.run_file import Setup
from rtec.loop.state_files import DiskState, MemoryState, state_places
from rtec.loop.zero import Home

__all__ = ["Report", "Status", "Supervisor"]

DRAIN_PERIOD_NS: Final = 20_000_000
STOP_TIMEOUT_S: Final = 5.0
STANDS_NS: Final = 2_000_000_000
"""A loop without a cycle for this long, ns, stands."""
LATE: Final = 1.5
LATE_S: Final = 1.0
"""A run whose cycles are late ends after this many times its duration and this many seconds, with fewer cycles."""
START_S: Final = 300
"""The loop begins within this time: a slow computer compiles for a minute, and a device may be late."""
RING_SECONDS: Final = 6.0
"""The supervisor may stop for this long before rows are lost."""

DELETED: Final = (
    "somebody deleted {}, the state in memory: the run goes on, but if it is killed now, ledger and mode are known "
    "from the disk alone, up to a second old; end it in order and start it again"
)

Rows = Callable[[Samples, Commands], None]


class Supervisor:
    """Runs a setup on the real clock.

    The signals INT and TERM end the run in order. So does HUP, the end of the terminal, unless it was ignored already,
    as under `nohup`; under a service manager HUP is the order to reload. USR1 is the operator's order to resume.

    Args:
        setup: the setup to run.
        log_path: a new file, the first of this run's log; None: no log.
        on_status: called with the newest status some 50 times a second, in the supervisor's thread: sockets may be
            polled in it, too.
        on_start: called when the loop begins.
        on_rows: called with every row that passes.
        on_event: called with every event, from any thread; must not wait.
        forks: loop and workers begin as copies of this process; see `rtec.daemon.process.child_context`.

    Attributes:
        parts: parts of the daemon (`rtec.daemon.supervision`); code that runs a thread in this process adds one.
    """

    def __init__(
        self,
        setup: Setup,
        log_path: Path | None,
        on_status: Callable[[Status], None] | None = None,
        on_start: Callable[[], None] | None = None,
        on_rows: Rows | None = None,
        on_event: Callable[[Event], None] | None = None,
        forks: bool = False,
    ) -> None:
        self._forks = forks
        self.layout = Layout(setup.machine.axis_names, setup.machine.sensor_names)
        self.warnings: list[str] = []
        self._on_status, self._on_start = on_status or (lambda _: None), on_start or (lambda: None)
        self._on_rows: Rows = on_rows or (lambda _samples, _commands: None)
        self._on_event = on_event or (lambda _: None)
        self._clock = RealClock()
        self._notifier = Notifier.from_environment(os.environ, self._clock)
        longest_s = max(s.period_s for s in setup.step_settings().sinks.values())
        without = Flag(0) if setup.file.role.actuator else Flag.ORDERED_OFF
        self._watch = RowWatch(self.layout, without, round(longest_s * 1e9))
        self._recording = Recording(log_path, self._clock, self._new_log, self.warnings)
        self.events = Events(events_path(log_path))
        self.parts = DaemonParts(self._clock, self.note)
        self._tables = TableKeeper(setup, self.note) if setup.file.table else None
        self._alarms, self._warnings_told = Alarms(self.note), 0
        self._places = state_places(setup.path, setup.state_folder)
        self._orders: queue.SimpleQueue[tuple[Order, str, str]] = queue.SimpleQueue()
        self._memory, disk = MemoryState(self._places.memory), self._places.disk
        self._disk_state, self._claim = None if disk is None else DiskState(disk), Claim(setup)
        self._reload = ReloadDesk(setup, self._memory, self._note, self.parts.add("reload"))
        self._homing = Homing(setup, self._memory.newest)
        self._step_orders = StepOrders(setup, self._clock)
        self._interrupted, self._ended, self._ends_at_once = False, False, False
        self._row_ns = 0
        self._disk: DiskThread | None = None
        self._held_without: list[str] = []
        self._flush_ns, self._deleted = 0, False
        self._lasts_ns: int | None = None

    @property
    def setup(self) -> Setup:
        """The setup in force: the newest one that the loop has taken over."""
        return self._reload.setup

    @property
    def status(self) -> Status:
        """Status of the newest row."""
        disk = self._disk
        status = replace(self._newest(), reload=self._reload.text, faults=self.parts.faults, parts=self.parts.troubles)
        if disk is None:
            return status
        kept = ("" if disk.kept_mode is None else MODE_NAMES.get(disk.kept_mode, "")) if disk.keeps else None
        return replace(status, log=disk.trouble, overruns=status.overruns + disk.missed, kept_mode=kept)

    def _newest(self) -> Status:
        """Status of the newest row, with the causes of its flags."""
        status = self._watch.status
        return replace(status, causes=causes(self.setup, status)) if status.flags else status

    def order(self, order: Order, text: str = "", who: str = "local") -> str:
        """Give an order, from any thread; return an answer in words. A running loop carries it out within some 20 ms.

        When it is done, the status has the result of RELOAD in `reload`, of RESUME in `takeovers` and `devices`.

        Args:
            order: the order.
            text: text of the order's event; a mark needs one, and HOME the positions, as "X=0 Z=120.5".
            who: the user who gives it.

        Raises:
            OrderRefused: it cannot be carried out now.
        """
        text = text[:LONGEST_TEXT]
        if order is Order.MARK and not text.strip():
            raise OrderRefused("a mark needs a text")
        if order in (Order.RELOAD, Order.HOME) and (self._reload.busy or self._homing.busy):
            raise OrderRefused("an earlier order to reload or to home is not done with yet; wait for it")
        if order is Order.HOME:
            self._homing.check(text)
        self._orders.put((order, text, who))
        return f"{order} ordered"

    def order_resume(self) -> None:
        """Order the devices to go on after a reset or a lost position."""
        self.order(Order.RESUME)

    def note(self, what: str, text: str) -> None:
        """Write an event that rtec itself observed; from any thread."""
        self._keep(Event(self._watch.rows - 1, self._watch.status.time_ns, wall_clock_iso(), what, text, "rtec"))

    def recent_events(self, most: int) -> tuple[int, list[Event]]:
        """The number of events so far, and the newest of them; from any thread."""
        return self.events.total, list(self.events.newest)[-most:]

    def end(self) -> None:
        """End the run in order, as Ctrl-C does; from any thread."""
        self._ended = True

    def run(self, duration_s: float | None, beside: AbstractContextManager[object] | None = None) -> Report:
        """Run for that time, or until a signal. A sign check lasts longer by its return to zero.

        Args:
            duration_s: duration, s; None: until a signal.
            beside: context that starts threads; entered after the loop's process has started, left before it has ended.

        Raises:
            RtecError: another daemon keeps its state in the same file, or commands the same device; the fast path could
                not start, or died.
        """
        try:
            if self._disk_state is not None:
                self._disk_state.lock(self._clock)
            self._claim.take(self._clock)
            return self._run(duration_s, nullcontext() if beside is None else beside)
        finally:
            self._claim.free()
            self._memory.close()
            if self._disk_state is not None:
                self._disk_state.close()

    def _run(self, duration_s: float | None, beside: AbstractContextManager[object]) -> Report:
        cycles = None if duration_s is None else max(1, round(duration_s * self.setup.file.run.rate_hz))
        if self.setup.step_um:
            self._step_orders.lasts_s, cycles = duration_s, None
        elif duration_s is not None:
            self._lasts_ns = round((LATE * duration_s + LATE_S) * 1e9)
        capacity = max(64, round(RING_SECONDS * self.setup.file.run.rate_hz))
        context = child_context(self._forks)
        workers = Workers(self.setup, self._clock, self.parts, self._forks)
        with signals(self._on_signal), workers, Ring.create(self.layout, capacity) as ring:
            ring.orders.mode = MODES_BY_NAME[self.setup.file.run.mode]
            here, there = context.Pipe()
            task = LoopTask(self.setup.path, ring.name, cycles, self._places, workers.memories, self.setup.step_um)
            process = context.Process(target=fast_path, args=(task, there), name="rtec-loop", daemon=True)
            with signals_wait():
                process.start()
            there.close()
            try:
                with beside:
                    return self._supervise(ring, here, process, workers)
            finally:
                ring.stop_requested = 1
                process.join(STOP_TIMEOUT_S)
                if process.is_alive():
                    process.kill()
                    process.join()

    def _supervise(self, ring: Ring, pipe: Connection, process: Any, workers: Workers) -> Report:
        self._wait_for_start(pipe, process, workers)
        ready = self._receive(pipe, process)
        ring.unlink()  # both sides have it: it is now freed with the last of them, however that ends
        self.warnings += ready["warnings"]
        self._recording.begin(Begin.at_start(ready["output"], ready["state"]))
        with self._to_disk() as disk, self._tables_kept(ring):
            self._on_start()
            self._until_done(ring, pipe, process, disk, workers)
            self._notifier.stopping()
            try:
                summary = self._receive(pipe, process)
            finally:  # the last rows before the loop died are the most interesting ones
                while self._drain(ring, disk):
                    pass
        self._remove_state(ready["forgets"])
        return Report(
            summary=summary,
            warnings=self.warnings,
            log=_made(self._recording.path),
            overruns=ring.overruns + disk.missed,
            interrupted=self._interrupted,
            status=self.status,
            flags_seen=self._watch.flags_seen,
            largest_um=self._watch.largest_um,
            unfinished=self._step_orders.trouble(self.status),
        )

    def _wait_for_start(self, pipe: Connection, process: Any, workers: Workers) -> None:
        """Wait until the loop has opened its devices, or has ended.

        Raises:
            DriverFault: it did neither for `START_S`, or for `STOP_TIMEOUT_S` after an order to end.
        """
        began, ends = self._clock.now_ns(), False
        last = began + START_S * 1_000_000_000
        while not pipe.poll(DRAIN_PERIOD_NS * 1e-9) and process.is_alive():
            workers.look(again=False)
            now = self._clock.now_ns()
            if self._interrupted and not ends:
                ends, last = True, now + round(STOP_TIMEOUT_S * 1e9)
            if now > last:
                waited = f"the loop has not begun for {round((now - began) * 1e-9)} s"
                way = f"`rtec doctor {self.setup.path.name}` tries each"
                raise DriverFault(f"{waited}; a driver hangs while it opens its device. {way}")

    def _until_done(self, ring: Ring, pipe: Connection, process: Any, disk: DiskThread, workers: Workers) -> None:
        flush_ns = round(self.setup.file.run.flush_s * 1e9)
        self._row_ns = began = now = self._clock.now_ns()
        self._flush_ns = now + flush_ns
        stop_ns = None
        while not pipe.poll() and process.is_alive():
            now = self._clock.now_ns()
            if stop_ns is not None and now - stop_ns > STOP_TIMEOUT_S * 1e9:
                raise DriverFault(f"{self._stands(now)}; the run was ended; the actuator keeps its last command")
            ring.consumer_heartbeat_ns = now
            workers.look()
            self._carry_out(ring)
            ending = self._interrupted or self._ended or (self._lasts_ns is not None and now - began > self._lasts_ns)
            if self._step_orders.look(ring.orders, self._watch.status, ending) or self._ends_at_once:
                ring.stop_requested = 1
                stop_ns = now if stop_ns is None else stop_ns
            self._reload.send(ring, pipe)
            self._drain(ring, disk)
            self._home(ring, pipe)
            self._tell_what_is_wrong(now)
            self._hold_without(self.parts.lost)
            if now >= self._flush_ns:
                disk.flush()
                self._flush_ns = now + flush_ns
            self._notifier.look(self.status)
            self._on_status(self.status)
            self._clock.sleep_until_ns(now + DRAIN_PERIOD_NS)

    def _drain(self, ring: Ring, disk: DiskThread) -> int:
        samples, commands = ring.drain()
        self._reload.look(ring, disk)
        if len(samples):
            self._row_ns = self._clock.now_ns()
            disk.write(samples, commands, ring.tail - len(samples))
            self._watch.look(samples, commands, ring)
            self._on_rows(samples, commands)
        return len(samples)

    def _carry_out(self, ring: Ring) -> None:
        while not self._orders.empty():
            order, text, who = self._orders.get()
            if order in MODE_OF:
                ring.orders.mode = MODE_OF[order]
                self._flush_ns = min(
                    self._flush_ns, self._clock.now_ns() + max(DRAIN_PERIOD_NS, 2 * self.setup.period_ns)
                )
            elif order is Order.RESUME:
                ring.orders.resumes += 1
            elif order is Order.RELOAD:
                self._reload.begin(self._watch.newest, text)
            elif order is Order.HOME:
                self._homing.begin(text)
            self._note(ring, str(order), text, who)

    def _home(self, ring: Ring, pipe: Connection) -> None:
        newest = self._watch.newest
        found = None if newest is None else self._homing.look(newest)
        if isinstance(found, Home):
            self._reload.home(ring, pipe, found, self._homing.text(newest))
        elif found is not None:
            self._note(ring, "not homed", f"not homed: {found}", "rtec")

    def _note(self, ring: Ring, what: str, text: str, who: str) -> None:
        self._keep(Event(ring.tail - 1, self._watch.status.time_ns, wall_clock_iso(), what, text, who))

    @contextmanager
    def _to_disk(self) -> Iterator[DiskThread]:
        most_rows = round(MOST_SECONDS * self.setup.file.run.rate_hz)
        folder = log_folder(self.setup)
        keeper = None if folder is None else Keeper(folder, self.setup.file.log, self._clock, self.note)
        part = self.parts.add("disk", essential=True)
        with DiskThread(self._recording, self._disk_state, self._memory.newest, most_rows, part, keeper) as disk:
            self._disk = disk
            yield disk

    def _tables_kept(self, ring: Ring) -> TableThread:
        def now() -> tuple[Setup, Status, str]:
            return self.setup, self._watch.status, MODE_NAMES.get(ring.orders.mode, "")

        return TableThread(self._tables, now, self.parts.add("tables"))

    def _keep(self, event: Event) -> None:
        self.events.note(event)
        self._on_event(event)
        if self._disk is not None:
            self._disk.event(self.events, event)

    def _tell_what_is_wrong(self, now_ns: int) -> None:
        """Write faults to the events when they occur: nobody reads the summary at the end of a run of weeks."""
        if self._memory.deleted and not self._deleted:
            self._deleted = True
            self.warnings.append(DELETED.format(self._memory.path))
        for text in self.warnings[self._warnings_told :]:
            self._warnings_told += 1
            self.note("note", text)
        passed = self._watch.take_passed()
        status = self._newest() if passed else self._watch.status
        stands = self._stands(now_ns) if now_ns - self._row_ns > STANDS_NS else ""
        self._alarms.look(now_ns, passed, status.devices, status.causes, stands, status.takeovers)

    def _stands(self, now_ns: int) -> str:
        """What to say of a loop that ran its last cycle some time ago."""
        way = f"`rtec doctor {self.setup.path.name}` tries each device alone"
        gone_s = (now_ns - self._row_ns) * 1e-9
        return f"the loop stands: no cycle for {gone_s:.0f} s; a driver of its process hangs. {way}"

    def _hold_without(self, lost: list[str]) -> None:
        """Hold, once for each lost part that the daemon must not correct without; ask for a restart."""
        if new := [name for name in lost if name not in self._held_without]:
            self._orders.put((Order.HOLD, f"rtec does not correct without: {', '.join(new)}", "rtec"))
        self._held_without = lost
        if lost:
            self._notifier.lost()

    def _remove_state(self, forgets: bool) -> None:
        """Remove the state in memory after a run that ended in order, if the disk has it or the next run needs none.

        The next run needs an order that stays, and the output of an actuator that forgets it.
        """
        saved = self._memory.newest()
        on_disk = self._disk_state is not None and not self._state_trouble()
        needed = saved is not None and (forgets or saved.mode != saved.start_mode)
        if saved is not None and saved.clean and (on_disk or not needed):
            self._memory.remove()

    def _state_trouble(self) -> str:
        return "" if self._disk is None else self._disk.state_trouble

    def _new_log(self, path: Path, begin: Mapping[str, str]) -> LogWriter:
        return new_log(path, self.setup, self.layout, self._clock, begin)

    def _receive(self, pipe: Connection, process: Any) -> Any:
        try:
            kind, content = pipe.recv()
        except (EOFError, ConnectionResetError):
            process.join(STOP_TIMEOUT_S)
            kind, content = "died", ""
        if kind == "died":
            why = _died(process.exitcode, content)
            self.note("alarm", why)
            raise DriverFault(why)
        if kind == "error":
            raise RtecError(content)
        return content

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del frame
        if number == signal.SIGUSR1:
            self._orders.put((Order.RESUME, "signal USR1", "signal"))
        elif number == signal.SIGHUP and self._notifier.listens:
            self._orders.put((Order.RELOAD, "signal HUP", "signal"))
        else:
            self._ends_at_once, self._interrupted = self._interrupted, True


def _died(code: int | None, last_words: str) -> str:
    """How the loop's process ended, and what that means for the machine."""
    if last_words:
        how = f"ended at a {last_words}"
        again = "in a driver of your own, mend it, else please report it"
    else:
        killed = code is not None and code < 0
        how = f"was killed (signal {-code}, {signal.strsignal(-code)})" if killed and code is not None else "ended"
        how += f" without a word (exit code {code})"
        again = "if it happens again: `journalctl -k` tells of memory that ran out"
    return (
        f"the loop's process {how}: nothing is commanded any more. Ledger and mode are kept; start it again, and it "
        f"goes on from there; {again}; the last rows are in the log"
    )


def _made(log: Path | None) -> Path | None:
    """The log, if there is one: on a full disk it may never have been made."""
    return log if log is not None and log.exists() else None
