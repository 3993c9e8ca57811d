"""The supervisor's side of a reload: reads again, hands it to the loop, sees that the loop has it."""

from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

from rtec.daemon.disk import DiskThread
from rtec.daemon.reload import STAYS, Reader, Reloaded
from rtec.daemon.ring import Ring
from rtec.log.recording import Begin
from rtec.loop.orders import OrderRefused
from rtec.loop.run_file import Setup
from rtec.loop.state_files import read_snapshot

Note = Callable[[Ring, str, str, str], None]


class ReloadDesk:
    """One reload at a time.

    Args:
        setup: what is in force.
        memory: file of the kept state.
        note: notes an event: ring, what, text, who.

    Attributes:
        setup: what is in force now.
        text: what came of the last order; "" before the first.
    """

    def __init__(self, setup: Setup, memory: Path, note: Note) -> None:
        self.setup, self.text = setup, ""
        self._memory, self._note = memory, note
        self._reader, self._generation = Reader(setup), 0
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
