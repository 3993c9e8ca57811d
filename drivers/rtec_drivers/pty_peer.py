"""A simulated device behind a real serial port of the system: a pseudo terminal, a thread, and a cable to pull."""

import os
import select
import threading
import tty
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from rtec.loop.clock import Clock
from rtec_drivers.wire_faults import WireFaults


class Peer(Protocol):
    """A device as its line sees it."""

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Take in bytes; give the answer."""
        ...

    def idle(self, now_ns: int) -> bytes:
        """Give what it says unasked."""
        ...


class PtyPeer:
    """Serves a device on a pseudo terminal until closed.

    Args:
        peer: the device.
        clock: its time.
        link: a name for the port that stays when the cable is pulled and put back; the real name changes.
        period_s: the device may speak unasked this often.

    Attributes:
        faults: what happens to the device's bytes on their way.
        lock: held while the device works; take it to look at the device or to change it.
    """

    def __init__(self, peer: Peer, clock: Clock, link: Path, period_s: float = 0.01) -> None:
        self.peer, self.link, self.faults, self.lock = peer, link, WireFaults(), threading.Lock()
        self._clock, self._period_s = clock, period_s
        self._master = self._slave = -1
        self._thread: threading.Thread | None = None
        self._wake: tuple[int, int] = (-1, -1)

    def __enter__(self) -> Self:
        """Plug it in."""
        self.plug()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Pull it out."""
        self.pull()

    @property
    def device(self) -> str:
        """Name of the port as long as it is plugged in."""
        return os.ttyname(self._slave)

    def plug(self) -> None:
        """Make the port appear, mostly under another real name than before."""
        if self._thread is not None:
            return
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._wake = os.pipe()
        aside = self.link.with_name(self.link.name + ".new")
        aside.symlink_to(self.device)
        aside.replace(self.link)
        self._thread = threading.Thread(target=self._serve, name="rtec-pty-peer", daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """Make the port vanish, whatever is on the line; again does nothing."""
        if self._thread is None:
            return
        os.write(self._wake[1], b".")
        self._thread.join()
        self._thread = None
        self.link.unlink()
        for fd in (self._master, self._slave, *self._wake):
            os.close(fd)

    def _serve(self) -> None:
        while True:
            ready = select.select((self._master, self._wake[0]), (), (), self._timeout_s())[0]
            if self._wake[0] in ready:
                return
            data = b""
            if self._master in ready:
                with suppress(BlockingIOError):
                    data = os.read(self._master, 4096)
            now_ns = self._clock.now_ns()
            with self.lock:
                answer = self.peer.receive(data, now_ns) if data else self.peer.idle(now_ns)
                self.faults.put(answer, now_ns)
                arrived = self.faults.take(now_ns)
            with suppress(BlockingIOError):  # nobody reads: the bytes are lost, as on a wire
                os.write(self._master, arrived)

    def _timeout_s(self) -> float:
        next_ns = self.faults.next_ns()
        if next_ns is None:
            return self._period_s
        return min(self._period_s, max(0.0, (next_ns - self._clock.now_ns()) * 1e-9))
