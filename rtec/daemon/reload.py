"""Reading run file, machine and model again while the loop runs: what may change, what must not, and what changed.

The supervisor's side of a reload: reads again, hands it to the loop, sees that the loop has it.
"""

import queue
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

from rtec.daemon.disk import DiskThread
from rtec.daemon.ring import Ring
from rtec.daemon.supervision import Part, fault
from rtec.errors import RtecError
from rtec.log.recording import Begin
from rtec.loop.orders import OrderRefused
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.state_files import read_snapshot
from rtec.loop.step import Step

MOST_BYTES = 65_536
"""So much fits into the pipe while the loop is not yet reading."""
_ORDERS = {"on": "enable", "hold": "hold", "off": "fade"}
STAYS = "the old one stays in force"


@dataclass(frozen=True)
class Reloaded:
    """What was read, ready for the loop.

    Attributes:
        setup: the new one.
        message: for the loop's pipe.
        changed: in words; empty where nothing did.
    """

    setup: Setup
    message: bytes
    changed: list[str]


def read_again(old: Setup) -> Reloaded:
    """Read the run file of a setup and all that it names again; compile the step.

    Raises:
        RtecError: something is wrong with it, or something changed that needs a new start; everything at once.
    """
    if old.step_um:
        raise OrderRefused("a sign check (--step) runs; end it, then start the run file itself")
    new = load_setup(old.path)
    if faults := _fixed(old, new):
        raise OrderRefused("\n".join(f"{old.path}: {fault}" for fault in faults))
    step, before = Step(new.step_settings()), Step(old.step_settings())
    step.warm_up()
    same = step.source.text == before.source.text
    message = _bytes(step.all_numbers() if same else new.step_settings())
    if len(message) > MOST_BYTES:
        raise OrderRefused(f"{new.model.name}: too large to be taken up while the loop runs; start it again")
    return Reloaded(new, message, _changed(old, new))


def _bytes(content: object) -> bytes:
    """As `Connection.recv` takes it."""
    return bytes(ForkingPickler.dumps(content))


def _fixed(old: Setup, new: Setup) -> list[str]:
    """What changed and may not while the loop runs."""
    out = [
        f"[{section}] changed; it is taken up at a start only: end the run and start it again"
        for section in ("device", "role", "output", "realtime", "log", "control")
        if _plain(getattr(old.file, section)) != _plain(getattr(new.file, section))
    ]
    free = {"machine", "model", "mode"}
    for key in sorted(set(type(old.file.run).model_fields) - free):
        if getattr(old.file.run, key) != getattr(new.file.run, key):
            out.append(f"[run] {key} changed; it is taken up at a start only: end the run and start it again")
    mine = [(a.name, a.counts_per_mm, a.compensate) for a in old.machine.axes]
    theirs = [(a.name, a.counts_per_mm, a.compensate) for a in new.machine.axes]
    if mine != theirs or old.machine.sensor_names != new.machine.sensor_names:
        out.append("axes, their counts_per_mm, or sensors of the machine changed; end the run and start it again")
    return out


def _changed(old: Setup, new: Setup) -> list[str]:
    out = [
        what
        for what, a, b in (
            ("machine", old.machine.hash, new.machine.hash),
            ("model", old.model.hash, new.model.hash),
            ("guard", old.file.guard, new.file.guard),
            ("inputs", old.file.inputs, new.file.inputs),
        )
        if a != b
    ]
    if old.file.run.mode != new.file.run.mode:
        out.append(f"[run] mode (for the next start; now: `rtec ctl {_ORDERS[new.file.run.mode]}`)")
    return out + [f"limits of {name}" for name in new.file.limits if old.file.limits.get(name) != new.file.limits[name]]


def _plain(value: Any) -> Any:
    return {k: repr(v) for k, v in value.items()} if isinstance(value, Mapping) else value


class Reader:
    """Reads again in a thread, one at a time; the supervisor goes on meanwhile.

    Args:
        setup: what is in force.
        part: counts the faults that nobody foresaw.
    """

    def __init__(self, setup: Setup, part: Part) -> None:
        self._setup, self._part = setup, part
        self._results: queue.SimpleQueue[Reloaded | str] = queue.SimpleQueue()
        self.busy = False

    def begin(self, setup: Setup) -> None:
        """Start reading.

        Raises:
            OrderRefused: an earlier order is not done with.
        """
        if self.busy:
            raise OrderRefused("an earlier order to reload is not done with yet; wait for it")
        self.busy, self._setup = True, setup
        threading.Thread(target=self._work, name="rtec-read-again", daemon=True).start()

    def poll(self) -> Reloaded | str | None:
        """Give what was read, or why not; None while there is nothing. `busy` stays until `done`."""
        return None if self._results.empty() else self._results.get()

    def done(self) -> None:
        """The loop has it, or it failed: the next may come."""
        self.busy = False

    def _work(self) -> None:
        try:
            self._results.put(read_again(self._setup))
        except RtecError as e:
            self._results.put(f"not reloaded, {STAYS}: {e}")
        except Exception as e:  # noqa: BLE001 - whatever it is: the order is answered, and the next may come
            self._part.failed(fault(e))
            self._results.put(f"not reloaded, {STAYS}: {fault(e)}")


Note = Callable[[Ring, str, str, str], None]


class ReloadDesk:
    """One reload at a time.

    Args:
        setup: what is in force.
        memory: file of the kept state.
        note: notes an event: ring, what, text, who.
        part: counts the faults of reading.

    Attributes:
        setup: what is in force now.
        text: what came of the last order; "" before the first.
    """

    def __init__(self, setup: Setup, memory: Path, note: Note, part: Part) -> None:
        self.setup, self.text = setup, ""
        self._memory, self._note = memory, note
        self._reader, self._generation = Reader(setup, part), 0
        self._coming: Reloaded | None = None

    @property
    def busy(self) -> bool:
        """Is an order not done with yet?"""
        return self._reader.busy

    def begin(self) -> None:
        """Start reading."""
        try:
            self._reader.begin(self.setup)
        except OrderRefused as e:
            self.text = str(e)

    def send(self, ring: Ring, pipe: Connection) -> None:
        """Hand what was read on to the loop."""
        found = self._reader.poll()
        if isinstance(found, str):
            self._done(ring, found, "not reloaded")
        elif found is not None and not found.changed:
            self._done(ring, "reloaded: nothing changed", "reloaded")
        elif found is not None:
            self._coming = found
            self._generation += 1
            with suppress(BrokenPipeError, ConnectionResetError):  # the loop died; who waits for its end says so
                pipe.send_bytes(found.message)
            ring.orders.reloads = self._generation

    def look(self, ring: Ring, disk: DiskThread) -> None:
        """When the loop has it, it is in force, and a new file of the log begins behind the row in which it took it.

        Called between taking rows from the ring and handing them on: the loop tells before it publishes that row.
        """
        if self._coming is None or abs(ring.reloads) != self._generation:
            return
        if ring.reloads < 0:
            self._done(ring, f"not reloaded: the loop could not take it; {STAYS}", "not reloaded")
            return
        self.setup = self._coming.setup
        if (saved := read_snapshot(self._memory)) is not None:
            disk.cut(Begin.behind(saved))
        self._done(ring, f"reloaded: {', '.join(self._coming.changed)}", "reloaded")

    def _done(self, ring: Ring, text: str, what: str) -> None:
        self._coming, self.text = None, text
        self._reader.done()
        self._note(ring, what, text, "rtec")
