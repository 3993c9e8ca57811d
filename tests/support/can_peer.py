"""Things on a CAN bus, for the tests: an encoder box, an slcan adapter on a pty; all written apart."""

import itertools
import os
import select
import struct
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import can

from rtec.loop.clock import RealClock

CLOCK = RealClock()
MS = 1_000_000
BASE = 0x140
_numbers = itertools.count()


def new_channel() -> str:
    """A name for a virtual bus that nobody else uses."""
    return f"rtec-test-{os.getpid()}-{next(_numbers)}"


@contextmanager
def bus_on(channel: str) -> Iterator[can.BusABC]:
    """Another participant on a virtual bus."""
    bus = can.Bus(interface="virtual", channel=channel)
    try:
        yield bus
    finally:
        bus.shutdown()


def frame(identifier: int, data: bytes, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=extended)


class Repeater:
    """Says something again and again in a thread, as devices do."""

    def __init__(self, say: Callable[[int], None], period_s: float) -> None:
        self._say, self._period_s, self._stop = say, period_s, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "Repeater":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        for k in itertools.count():
            self._say(k)
            if self._stop.wait(self._period_s):
                return


def crc8(data: bytes) -> int:
    """CRC-8/AUTOSAR, bit by bit."""
    value = 0xFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = ((value << 1) ^ 0x2F if value & 0x80 else value << 1) & 0xFF
    return value ^ 0xFF


def box_bytes(identifier: int, number: int, sequence: int, boot: int, bits: int) -> bytes:
    """The 8 bytes of a frame of the box link, from its description."""
    body = struct.pack("<iBBB", number, sequence, boot, bits)
    return body + bytes([crc8(identifier.to_bytes(2, "little") + body)])


class FakeBox:
    """An encoder box, written from its description in docs/can.md.

    Attributes:
        counts: raw counters, one an axis.
        ledger: inserted counts.
        boot: number of its start.
        silent: it says nothing.
        deaf: whether the k-th command frame is not heard.
        spoil: what becomes of a frame that it sends: (k, content) to content, or None where it is lost.
        on_latch: is called at each latch.
        commands: those that it took: axis, inserted counts, sequence.
    """

    def __init__(self, channel: str, axes: int = 2) -> None:
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.counts, self.ledger = [0] * axes, [0] * axes
        self.boot, self.resumed, self.silent, self.version = 7, False, False, 1
        self.spoil: Callable[[int, bytes], bytes | None] = lambda _, data: data
        self.deaf: Callable[[int], bool] = lambda _: False
        self._orders = 0
        self.on_latch: Callable[[], None] = lambda: None
        self.commands: list[tuple[int, int, int]] = []
        self._taken = [0] * axes
        self._sent = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.bus.shutdown()

    def restart(self) -> None:
        """The power fails for a moment: ledger and counters are zero again, and nothing is inserted until ordered."""
        self.boot, self.resumed = self.boot % 255 + 1, False
        self.ledger, self.counts = [0] * len(self.ledger), [0] * len(self.counts)

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self.bus.recv(0.01)
            if message is not None and not self.silent:
                self._take(message.arbitration_id, bytes(message.data))

    def _take(self, identifier: int, data: bytes) -> None:
        if len(data) != 8 or crc8(identifier.to_bytes(2, "little") + data[:7]) != data[7]:
            return
        number, sequence, boot, bits = struct.unpack("<iBBB", data[:7])
        place = identifier - BASE
        if place == 0x00:
            self._latch(sequence, boot, bits)
        elif 0x20 <= place < 0x20 + len(self.ledger) and boot == self.boot and self.resumed:
            axis, self._orders = place - 0x20, self._orders + 1
            if self.deaf(self._orders):
                return
            self.commands.append((axis, number, sequence))
            self.ledger[axis], self._taken[axis] = number, sequence
            self._ledger(axis)

    def _latch(self, sequence: int, boot: int, bits: int) -> None:
        self.on_latch()
        if bits & 4 and boot == self.boot:
            self.resumed = True
        if bits & 1:
            number = struct.unpack("<i", struct.pack("<BBH", self.version, len(self.counts), 100))[0]
            self._say(0x01, number, sequence)
        for axis, value in enumerate(self.counts):
            wrapped = struct.unpack("<i", struct.pack("<I", value & 0xFFFFFFFF))[0]
            self._say(0x10 + axis, wrapped, sequence)
            if bits & 2:
                self._ledger(axis)

    def _ledger(self, axis: int) -> None:
        self._say(0x30 + axis, self.ledger[axis], self._taken[axis])

    def _say(self, place: int, number: int, sequence: int) -> None:
        identifier = BASE + place
        self._sent += 1
        data = self.spoil(self._sent, box_bytes(identifier, number, sequence, self.boot, 0 if self.resumed else 1))
        if data is not None:
            self.bus.send(frame(identifier, data))


class SlcanAdapter:
    """An slcan adapter on a pty: the text protocol of Lawicel's CAN232 manual, bridged to a virtual bus."""

    def __init__(self, channel: str) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.heard: list[str] = []
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._stop = threading.Event()
        self._open = False
        self._threads = [threading.Thread(target=t, daemon=True) for t in (self._from_host, self._from_bus)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Pull the cable."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._bus.shutdown()
        os.close(self.master)
        os.close(self._slave)

    def say(self, text: bytes) -> None:
        with suppress(OSError):
            os.write(self.master, text)

    def _from_host(self) -> None:
        data = b""
        while not self._stop.is_set():
            if not select.select([self.master], [], [], 0.02)[0]:
                continue
            data += os.read(self.master, 4096)
            *lines, data = data.split(b"\r")
            for line in lines:
                self._order(line.decode("ascii"))

    def _order(self, line: str) -> None:
        self.heard.append(line)
        if line in ("O", "C"):
            self._open = line == "O"
        elif line.startswith("t"):
            length = int(line[4])
            self._bus.send(frame(int(line[1:4], 16), bytes.fromhex(line[5 : 5 + 2 * length])))

    def _from_bus(self) -> None:
        while not self._stop.is_set():
            message = self._bus.recv(0.02)
            if message is not None and self._open:
                self.say(f"t{message.arbitration_id:03X}{message.dlc}{bytes(message.data).hex().upper()}\r".encode())
