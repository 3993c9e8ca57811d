"""A simulated device behind a real serial port of the system, for tests and hardware in the loop.

A pseudo terminal, a thread, a cable that can be pulled, and a wire that loses, doubles and damages bytes.
"""

import os
import random
import select
import threading
import tty
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Protocol, Self

from rtec.loop.clock import Clock


class WireFaults:
    """A wire with faults. Every fault may be switched on and off at any time.

    Attributes:
        silent: nothing arrives.
        flip_rate: share of messages that arrive with one wrong bit.
        cut_next: the next message ends after this number of bytes; -1: it is whole.
        cut_every: one message of this number is cut in half; 0: none.
        late_ns: delay of all bytes.
        babble: these bytes come before every message, and by themselves.
        garbled, passed: number of messages that arrived damaged, and of all that arrived.

    Args:
        seed: seed of the random choices in `flip_rate`.
    """

    def __init__(self, seed: int = 0) -> None:
        self.silent, self.flip_rate, self.cut_next, self.late_ns, self.babble = False, 0.0, -1, 0, b""
        self.cut_every = 0
        self.garbled = self.passed = 0
        self._chance = random.Random(seed)  # noqa: S311 - random numbers of a test
        self._on_the_way: deque[tuple[int, bytes]] = deque()

    def put(self, message: bytes, now_ns: int) -> None:
        """Send a message."""
        if self.silent:
            return
        data = self.babble + self._damaged(message)
        if data:
            self._on_the_way.append((now_ns + self.late_ns, data))

    def take(self, now_ns: int) -> bytes:
        """The bytes that have arrived by now."""
        out = b""
        while self._on_the_way and self._on_the_way[0][0] <= now_ns:
            out += self._on_the_way.popleft()[1]
        return out

    def next_ns(self) -> int | None:
        """When the next bytes arrive; None without any on the way."""
        return self._on_the_way[0][0] if self._on_the_way else None

    def _damaged(self, message: bytes) -> bytes:
        if not message:
            return message
        self.passed += 1
        if self.cut_every and self.passed % self.cut_every == 0:
            self.cut_next = len(message) // 2
        if self.cut_next >= 0:
            message, self.cut_next = message[: self.cut_next], -1
            self.garbled += 1
        elif self._chance.random() < self.flip_rate:
            bit = self._chance.randrange(8 * len(message))
            damaged = bytearray(message)
            damaged[bit // 8] ^= 1 << bit % 8
            message = bytes(damaged)
            self.garbled += 1
        return message


class SimulatedPeer(Protocol):
    """A device as its line sees it."""

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Process bytes; give the answer."""
        ...

    def idle(self, now_ns: int) -> bytes:
        """The bytes that it sends unasked."""
        ...


class PtyPeer:
    """Serves a device on a pseudo terminal until closed.

    Args:
        peer: the simulated device.
        clock: clock of the device.
        link: a name for the port that stays when the cable is pulled and plugged again; the real name changes.
        period_s: period in which the device may send unasked.

    Attributes:
        faults: faults of the wire from the device.
        lock: held while the device works; hold it to read or change the device.
    """

    def __init__(self, peer: SimulatedPeer, clock: Clock, link: Path, period_s: float = 0.01) -> None:
        self.peer, self.link, self.faults, self.lock = peer, link, WireFaults(), threading.Lock()
        self._clock, self._period_s = clock, period_s
        self._master = self._slave = -1
        self._thread: threading.Thread | None = None
        self._rounds = 0
        self._wake: tuple[int, int] = (-1, -1)

    def __enter__(self) -> Self:
        """Plug the cable in."""
        self.plug()
        return self

    def __exit__(self, *error: object) -> None:
        """Pull the cable."""
        self.pull()

    @property
    def device(self) -> str:
        """Real name of the port while it is plugged in."""
        return os.ttyname(self._slave)

    def plug(self) -> None:
        """Make the port appear, usually under another real name than before."""
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
        """Remove the port, whatever is on the line; a second call does nothing."""
        if self._thread is None:
            return
        os.write(self._wake[1], b".")
        self._thread.join()
        self._thread = None
        self.link.unlink()
        for fd in (self._master, self._slave, *self._wake):
            os.close(fd)

    def settle(self) -> None:
        """Wait until the device has worked on all that was sent to it."""
        rounds, thread = self._rounds, self._thread
        while thread is not None and thread.is_alive() and self._rounds < rounds + 2:
            if select.select((self._master,), (), (), 0.0)[0]:
                rounds = self._rounds
            thread.join(1e-3)

    def _serve(self) -> None:
        while True:
            self._rounds += 1
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
            with suppress(BlockingIOError):  # no reader: the bytes are lost, as on a wire
                os.write(self._master, arrived)

    def _timeout_s(self) -> float:
        next_ns = self.faults.next_ns()
        if next_ns is None:
            return self._period_s
        return min(self._period_s, max(0.0, (next_ns - self._clock.now_ns()) * 1e-9))
