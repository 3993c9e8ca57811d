"""A reload: run file, machine and model are read again, judged whole, and taken over while the loop goes on.

A change that needs a restart is refused. So is one that the loop could not take over (too large for the pipe or for
the kept state). A change that reverses a correction, or would move it by much at once, needs confirmation in the
order (`YES`): a reversed sign in a file is a mistake far more often than an intention.

A thread reads and judges (`ReloadReader`); the supervisor sends the result to the loop and waits until the loop has
taken it over (`ReloadDesk`).
"""

import queue
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, Final

import numpy as np

from rtec.arrays import Floats
from rtec.correction.flags import MODE_ON
from rtec.daemon.disk import DiskThread
from rtec.daemon.ring import Ring
from rtec.daemon.supervision import DaemonPart, fault
from rtec.errors import RtecError
from rtec.log.recording import Begin
from rtec.loop.orders import YES, OrderRefused
from rtec.loop.records import Samples
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.state import IMAGE_BYTES, Saved, StateWriter, structure_of
from rtec.loop.state_files import MemoryState
from rtec.loop.step import Step
from rtec.loop.zero import Home

MOST_BYTES = 65_536
"""Bytes that fit into the pipe while the loop is not reading yet."""
_ORDERS = {"on": "enable", "hold": "hold", "off": "fade"}
STAYS = "the old one stays in force"
LOST_SUPPLY: Final = "not homed: the device was without supply meanwhile; reference the axes, then order again"
STEP_SHARE: Final = 0.2
"""Share of an axis' `warning_um`; a reload that moves the correction by more needs confirmation."""
CLIMATES: Final = 16
POSES: Final = 32
"""Number of climates (temperatures and spindle speed), and of positions in each, at which two models are compared."""
USUAL_K: Final = 10.0
"""K on either side of the model's reference temperature, where it has no fitted range."""


@dataclass(frozen=True)
class Now:
    """Present state of the loop.

    Attributes:
        samples: its newest row.
        saved: its memory at about that row; None where it is unknown.
    """

    samples: Samples
    saved: Saved | None


@dataclass(frozen=True)
class Change:
    """A change on its way to the loop.

    Attributes:
        setup: the setup in force after it.
        done: the change in words.
        homes: is it another zero of the axes?
    """

    setup: Setup
    done: str
    homes: bool = False


@dataclass(frozen=True)
class Reloaded:
    """A set-up that was read, ready for the loop.

    Attributes:
        setup: the new one.
        message: for the loop's pipe.
        changed: the changes in words; empty where there are none.
    """

    setup: Setup
    message: bytes
    changed: list[str]


def read_again(old: Setup, now: Now | None = None, accepts_doubts: bool = False) -> Reloaded:
    """Read a setup's run file again, with every file that it names; compile the step, and judge it.

    Args:
        old: the setup in force.
        now: state of the loop; None: it has not begun.
        accepts_doubts: accept a change that reverses the correction or moves it by much.

    Raises:
        RtecError: a file is at fault, or something changed that needs a restart; all faults at once.
    """
    if old.step_um:
        raise OrderRefused("a sign check (--step) runs; end it, then start the run file itself")
    new = load_setup(old.path)
    if faults := _fixed(old, new):
        raise OrderRefused("\n".join(f"{old.path}: {fault}" for fault in faults))
    step, before = Step(new.step_settings()), Step(old.step_settings())
    StateWriter(np.zeros(IMAGE_BYTES, np.uint8), step, MODE_ON)  # does its memory fit?
    step.warm_up()
    same = step.source.text == before.source.text
    message = _bytes(step.all_numbers() if same else new.step_settings())
    if len(message) > MOST_BYTES:
        raise OrderRefused(f"{new.model.name}: too large to be taken up while the loop runs; start it again")
    if not accepts_doubts and (reasons := doubts(before, step, now)):
        raise OrderRefused(f"{'; '.join(reasons)}; if that is meant: `rtec ctl reload --yes`")
    return Reloaded(new, message, _changed(old, new))


def doubts(old: Step, new: Step, now: Now | None) -> list[str]:
    """Reasons to doubt a new step, one an axis: it reverses the correction, or moves it by much.

    Both steps run over the same positions, temperatures and spindle speeds of the machine, and lose their memory.

    Raises:
        OrderRefused: the new step gives no finite correction at a point where the old one does.
    """
    running_um, coming_um = _over_the_machine(old, new)
    known = [bool(np.isfinite(running_um[..., k]).all()) for k in range(len(new.layout.axes))]
    if not np.isfinite(coming_um[..., known]).all():
        raise OrderRefused(f"{new.settings.model.name}: gives no finite correction where the running model does")
    moves_um = [] if now is None else _at_this_moment(old, new, now)
    out = []
    for k, axis in enumerate(new.layout.axes):
        if axis not in new.settings.limits or not known[k]:
            continue
        quantum_um = abs(float(new.constants("quantum")[k] / new.constants("per_um")[k]))
        why = _turned(running_um[..., k], coming_um[..., k], quantum_um)
        limits = new.settings.limits[axis]
        from_um, to_um = (min(max(um, -limits.stop_um), limits.stop_um) for um in moves_um[k]) if moves_um else (0, 0)
        if abs(to_um - from_um) > STEP_SHARE * limits.warning_um:
            why.append(
                f"the correction would go from {from_um:+.1f} µm to {to_um:+.1f} µm, more than a fifth of warning_um "
                f"({limits.warning_um:g} µm)"
            )
        out += [f"axis {axis}: {text}" for text in why]
    return out


def _turned(running_um: Floats, coming_um: Floats, quantum_um: float) -> list[str]:
    """The part of a correction that is reversed: the part that varies with positions, or with climate, or is constant.

    Args:
        running_um, coming_um: of one axis, (climates, poses).
        quantum_um: one unit of the output; smaller variations are ignored.
    """
    a, b = running_um, coming_um
    parts = {
        "positions": (a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)),
        "temperatures and speeds": (a.mean(axis=1) - a.mean(), b.mean(axis=1) - b.mean()),
    }
    out = []
    for over, (old, new) in parts.items():
        sizes = float(old.std()), float(new.std())
        together = float(np.mean(old * new)) / (sizes[0] * sizes[1]) if min(sizes) > quantum_um else 1.0
        if together < 0:
            out.append(
                f"over the machine's {over} the new correction runs against the running one (correlation "
                f"{together:+.2f}; {sizes[1]:.1f} µm and {sizes[0]:.1f} µm rms), as after a turned sign"
            )
    if a.mean() * b.mean() < 0 and min(abs(a.mean()), abs(b.mean())) > max(quantum_um, a.std(), b.std()):
        out.append(f"the new correction is {b.mean():+.1f} µm on average, the running one {a.mean():+.1f} µm")
    return out


def _over_the_machine(old: Step, new: Step) -> tuple[Floats, Floats]:
    """Requests of both, µm, (climates, poses, axes) each: the same poses in each climate."""
    model, layout = old.settings.model, old.layout
    machine, chance = model.machine, np.random.default_rng(0)
    travel_mm = np.array([a.travel_mm for a in machine.axes])
    usual = (model.reference_degc - USUAL_K, model.reference_degc + USUAL_K)
    degc = np.array([model.valid_range.get(name, usual) for name in machine.sensor_names]).reshape(-1, 2)
    rows = Samples.empty(layout, POSES)
    rows.time_ns[:] = rows.counts_time_ns[:] = 1_000_000_000 * (1 + np.arange(POSES))
    rows.mode[:] = MODE_ON
    rows.counts[:] = np.rint(
        chance.uniform(travel_mm[:, 0], travel_mm[:, 1], (POSES, len(travel_mm)))
        * [a.counts_per_mm for a in machine.axes]
    )
    rows.degc_time_ns[:] = rows.time_ns[:, None]
    out = np.empty((2, CLIMATES, POSES, len(layout.axes)))
    for climate in range(CLIMATES):
        rows.degc[:] = chance.uniform(degc[:, 0], degc[:, 1])
        rows.spindle_rpm[:] = chance.uniform(*model.valid_range.get("spindle_rpm", (0.0, 0.0)))
        for step, into in zip((old, new), out, strict=True):
            into[climate] = step.advance(step.fresh_state(), rows)[1].requested_um
    return out[0], out[1]


def _at_this_moment(old: Step, new: Step, now: Now) -> list[tuple[float, float]]:
    """Requests of both now, µm, by axis; empty where they are unknown."""
    if now.saved is not None and now.saved.structure == structure_of(old):
        old.restore(now.saved.state)
    else:
        old.run(now.samples)
    if old.source.text == new.source.text:
        new.restore(old.state)
    else:
        new.adopt(old, now.samples)
    requests = []
    for step in (old, new):
        step.recompute_slow_part()
        requests.append(step.run(now.samples).requested_um[0])
    return list(zip(*np.array(requests).tolist(), strict=True)) if np.isfinite(requests).all() else []


def _bytes(content: object) -> bytes:
    """Bytes that `Connection.recv` reads."""
    return bytes(ForkingPickler.dumps(content))


def _fixed(old: Setup, new: Setup) -> list[str]:
    """Changes that are not allowed while the loop runs."""
    out = [
        f"[{section}] changed; it is taken up at a start only: end the run and start it again"
        for section in ("device", "role", "output", "realtime", "log", "control", "table")
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


class ReloadReader:
    """Reads again in a thread, one order at a time, while the supervisor goes on.

    Args:
        setup: the setup in force.
        part: counts the unforeseen faults.
    """

    def __init__(self, setup: Setup, part: DaemonPart) -> None:
        self._setup, self._part = setup, part
        self._results: queue.SimpleQueue[Reloaded | str] = queue.SimpleQueue()
        self.busy = False
        self._now: Now | None = None
        self._accepts_doubts = False

    def begin(self, setup: Setup, now: Now | None = None, accepts_doubts: bool = False) -> None:
        """Start reading; as for `read_again`.

        Raises:
            OrderRefused: an earlier order is not finished.
        """
        if self.busy:
            raise OrderRefused("an earlier order to reload is not done with yet; wait for it")
        self.busy, self._setup, self._now, self._accepts_doubts = True, setup, now, accepts_doubts
        threading.Thread(target=self._work, name="rtec-read-again", daemon=True).start()

    def poll(self) -> Reloaded | str | None:
        """The result, or the reason against it; None while there is none. `busy` stays True until `done`."""
        return None if self._results.empty() else self._results.get()

    def done(self) -> None:
        """Finish the order, after the loop has taken the result over or it failed: the next order may come."""
        self.busy = False

    def _work(self) -> None:
        try:
            self._results.put(read_again(self._setup, self._now, self._accepts_doubts))
        except RtecError as e:
            faults = "; ".join(str(e).splitlines())  # an event is one line
            self._results.put(f"not reloaded, {STAYS}: {faults}")
        except Exception as e:  # noqa: BLE001 - any fault answers the order, and the next may come
            self._part.failed(fault(e))
            self._results.put(f"not reloaded, {STAYS}: {fault(e)}")


Note = Callable[[Ring, str, str, str], None]


class ReloadDesk:
    """One change of the running loop at a time: a reload, or another zero of the axes.

    Args:
        setup: the setup in force.
        memory: the loop's memory.
        note: writes an event: ring, kind, text, who.
        part: counts the faults of reading.

    Attributes:
        setup: the setup in force now.
        text: result of the last order; "" before the first.
    """

    def __init__(self, setup: Setup, memory: MemoryState, note: Note, part: DaemonPart) -> None:
        self.setup, self.text = setup, ""
        self._memory, self._note = memory, note
        self._reader, self._generation = ReloadReader(setup, part), 0
        self._coming: Change | None = None

    @property
    def busy(self) -> bool:
        """Is an order unfinished?"""
        return self._reader.busy or self._coming is not None

    def begin(self, samples: Samples | None = None, text: str = "") -> None:
        """Start reading.

        Args:
            samples: the loop's newest row; None: there is none.
            text: text of the order; `YES` confirms large changes, too.
        """
        now = None if samples is None else Now(samples, self._memory.newest())
        try:
            self._reader.begin(self.setup, now, text == YES)
        except OrderRefused as e:
            self.text = str(e)

    def send(self, ring: Ring, pipe: Connection) -> None:
        """Send the result to the loop."""
        outcome = self._reader.poll()
        if isinstance(outcome, str):
            self._done(ring, outcome, "not reloaded")
        elif outcome is not None and not outcome.changed:
            self._done(ring, "reloaded: nothing changed", "reloaded")
        elif outcome is not None:
            done = f"reloaded: {', '.join(outcome.changed)}"
            self._send(ring, pipe, outcome.message, Change(outcome.setup, done))

    def home(self, ring: Ring, pipe: Connection, home: Home, text: str) -> None:
        """Send another zero of the axes to the loop; `text` is the event when it has it."""
        self._send(ring, pipe, _bytes(home), Change(self.setup, text, homes=True))

    def _send(self, ring: Ring, pipe: Connection, message: bytes, change: Change) -> None:
        self._coming = change
        self._generation += 1
        with suppress(BrokenPipeError, ConnectionResetError):  # the loop died; its end is reported elsewhere
            pipe.send_bytes(message)
        ring.orders.reloads = self._generation

    def look(self, ring: Ring, disk: DiskThread) -> None:
        """When the loop has taken a change over, put it in force; begin a new file of the log after that row.

        Called after rows are taken from the ring and before they are passed on: the loop reports before it publishes
        the row.
        """
        change = self._coming
        if change is None or abs(ring.reloads) != self._generation:
            return
        self._coming = None
        if ring.reloads > 0:
            self.setup = change.setup
            if (saved := self._memory.snapshot()) is not None:
                disk.cut(Begin.behind(saved))
        if change.homes and ring.reloads > 0:
            self._note(ring, "homed", change.done, "rtec")
        elif change.homes:
            self._note(ring, "not homed", LOST_SUPPLY, "rtec")
        elif ring.reloads > 0:
            self._done(ring, change.done, "reloaded")
        else:
            self._done(ring, f"not reloaded: the loop could not take it; {STAYS}", "not reloaded")

    def _done(self, ring: Ring, text: str, what: str) -> None:
        self.text = text
        self._reader.done()
        self._note(ring, what, text, "rtec")
