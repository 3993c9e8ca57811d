"""Reading run file, machine and model again while the loop runs: what may change, what must not, and what changed."""

import queue
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from typing import Any

from rtec.errors import RtecError
from rtec.loop.orders import OrderRefused
from rtec.loop.run_file import Setup, load_setup
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
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
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
