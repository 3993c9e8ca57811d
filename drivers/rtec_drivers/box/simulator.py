"""An encoder box in software, for tests and hardware in the loop: bytes in, bytes out.

Written from `docs/rtec-box-link.md` alone, byte by byte as firmware would be. It shares no code with the driver, so
each checks the other. `pty_peer` puts it behind a serial port; `python -m rtec_drivers.box.simulator LINK` runs one
in a process of its own, until its input ends.
"""

import argparse
import struct
import sys
from pathlib import Path
from typing import Protocol

from rtec.loop.clock import RealClock
from rtec_drivers.pty_peer import PtyPeer

WRAP = 0xFFFF_FFFF


class Plant(Protocol):
    """Encoders and controller at a box."""

    def counts(self, now_ns: int) -> list[int]:
        """Raw counts of every axis, x4, as its encoder has them."""
        ...

    def insert(self, ledger: list[int]) -> None:
        """Add this many counts to those that the controller sees."""
        ...


class BoxSimulator:
    """The box's firmware.

    Args:
        plant: its encoders and the controller behind it.
        axes: number of axes.
        counter_bits: width of its counters.
        hold_after_ms: silence after which it holds.
        counts_per_s: highest rate at which it inserts.
        box_serial, boot: its number, and that of its start.

    Attributes:
        frozen: its processor hangs in the part that latches: answers come, with the same time and counts.
        commands: number of accepted commands.
        encoder_fault: an encoder's signal is impossible; remembered until it is ordered to resume and the fault is
            over.
    """

    def __init__(
        self,
        plant: Plant,
        axes: int,
        counter_bits: int = 32,
        hold_after_ms: int = 100,
        counts_per_s: int = 20_000,
        box_serial: int = 42,
        boot: int = 1,
    ) -> None:
        self.plant, self.axes, self.counter_bits = plant, axes, counter_bits
        self.hold_after_ms, self.counts_per_s, self.box_serial = hold_after_ms, counts_per_s, box_serial
        self.frozen, self.commands, self.encoder_fault = False, 0, False
        self._latched: tuple[int, list[int]] = (0, [0] * axes)
        self._boot = boot - 1
        self.reset()

    def reset(self) -> None:
        """Power off and on: ledger zero, another start, no insertion before it is ordered to resume."""
        self._boot = (self._boot + 1) & 0xFFFF
        self._ledger = [0] * self.axes
        self._target = [0] * self.axes
        self._resumed = self._held = False
        self._saw_fault = False
        self._last_command, self._last_heard_ns, self._last_tick_ns, self._credit = 0, 0, -1, 0.0
        self._block: bytearray = bytearray()
        self.plant.insert(list(self._ledger))

    def receive(self, data: bytes, now_ns: int) -> bytes:
        """Process bytes; give the answer."""
        self.tick(now_ns)
        out = b""
        for byte in data:
            if byte:
                if len(self._block) < 300:
                    self._block.append(byte)
            elif self._block:
                out += self._frame(bytes(self._block), now_ns)
                self._block.clear()
        return out

    def idle(self, now_ns: int) -> bytes:
        """Advance time; the box never sends unasked."""
        self.tick(now_ns)
        return b""

    def tick(self, now_ns: int) -> None:
        """Insert what is due, no faster than allowed; hold where commands have ended."""
        span_ns = now_ns - self._last_tick_ns if self._last_tick_ns >= 0 else 0
        self._last_tick_ns = now_ns
        self._saw_fault = self._saw_fault or self.encoder_fault
        if self._resumed and now_ns - self._last_heard_ns > self.hold_after_ms * 1_000_000:
            self._held, self._target = True, list(self._ledger)
        self._credit = min(
            self._credit + span_ns * 1e-9 * self.counts_per_s, max(1.0, span_ns * 1e-9 * self.counts_per_s)
        )
        steps, before = int(self._credit), list(self._ledger)
        for i, target in enumerate(self._target):
            distance = target - self._ledger[i]
            self._ledger[i] += max(-steps, min(steps, distance))
        if self._ledger != before:
            self._credit -= steps
            self.plant.insert(list(self._ledger))

    def _frame(self, block: bytes, now_ns: int) -> bytes:
        body = unstuff(block)
        if len(body) < 8 or crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
            return b""
        kind, sequence, payload = body[1], int.from_bytes(body[2:4], "little"), body[4:-4]
        if body[0] != 1:
            return self._send(0x81, sequence, self._info()) if kind == 0x01 else b""
        if kind == 0x01 and not payload:
            return self._send(0x81, sequence, self._info())
        if kind == 0x02 and not payload:
            return self._send(0x82, sequence, self._state(now_ns))
        if kind == 0x03:
            self._command(sequence, payload, now_ns)
        elif kind == 0x04 and len(payload) == 2:
            return self._resume(sequence, payload, now_ns)
        return b""

    def _command(self, sequence: int, payload: bytes, now_ns: int) -> None:
        if len(payload) != 2 + 4 * self.axes or not self._resumed:
            return
        if int.from_bytes(payload[:2], "little") != self._boot:
            return
        self._target = [int.from_bytes(payload[2 + 4 * i : 6 + 4 * i], "little", signed=True) for i in range(self.axes)]
        self._last_command, self._last_heard_ns, self._held = sequence, now_ns, False
        self.commands += 1

    def _resume(self, sequence: int, payload: bytes, now_ns: int) -> bytes:
        if int.from_bytes(payload, "little") == self._boot and not self.encoder_fault:
            if not self._resumed:
                self._last_heard_ns = now_ns
            self._resumed, self._saw_fault = True, False
        return self._send(0x82, sequence, self._state(now_ns))

    def _info(self) -> bytes:
        return (
            self._boot.to_bytes(2, "little")
            + self.box_serial.to_bytes(4, "little")
            + bytes((self.axes, self.counter_bits))
            + self.hold_after_ms.to_bytes(2, "little")
            + self.counts_per_s.to_bytes(4, "little")
        )

    def _state(self, now_ns: int) -> bytes:
        if not self.frozen:
            mask = (1 << self.counter_bits) - 1
            self._latched = (now_ns // 1000 & WRAP, [n & mask for n in self.plant.counts(now_ns)])
        time_us, counts = self._latched
        moving = self._ledger != self._target
        status = (not self._resumed) | self._held << 1 | moving << 2 | self._saw_fault << 3
        out = self._boot.to_bytes(2, "little") + bytes((status,)) + self._last_command.to_bytes(2, "little")
        out += time_us.to_bytes(4, "little")
        for count, inserted in zip(counts, self._ledger, strict=True):
            out += struct.pack("<Ii", count, inserted)
        return out

    def _send(self, kind: int, sequence: int, payload: bytes) -> bytes:
        body = bytes((1, kind)) + sequence.to_bytes(2, "little") + payload
        return b"\0" + stuff(body + crc32(body).to_bytes(4, "little")) + b"\0"


def _table() -> list[int]:
    out = []
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = register >> 1 ^ (0xEDB8_8320 if register & 1 else 0)
        out.append(register)
    return out


_TABLE = _table()


def crc32(data: bytes) -> int:
    """CRC-32 of the link, by a table of its own."""
    register = WRAP
    for byte in data:
        register = register >> 8 ^ _TABLE[(register ^ byte) & 0xFF]
    return register ^ WRAP


def stuff(body: bytes) -> bytes:
    """Replace every zero by the distance to the next one, and put the first distance in front."""
    out, at = bytearray(b"\0"), 0
    for byte in body:
        if byte:
            out.append(byte)
        else:
            out[at] = len(out) - at
            at = len(out)
            out.append(0)
    out[at] = len(out) - at
    return bytes(out)


def unstuff(block: bytes) -> bytes:
    """The body; empty where a distance points beyond the end."""
    out, distance = bytearray(), block[0]
    if len(block) > 255:
        return b""
    for byte in block[1:]:
        distance -= 1
        if distance:
            out.append(byte)
        else:
            out.append(0)
            distance = byte
    return bytes(out) if distance == 1 else b""


class MovingPlant:
    """Every axis moves back and forth by `span_counts` at `counts_per_s`."""

    def __init__(self, axes: int, counts_per_s: int, span_counts: int) -> None:
        self._axes, self._speed, self._span = axes, counts_per_s, span_counts

    def counts(self, now_ns: int) -> list[int]:
        """A triangle over time."""
        way = now_ns * self._speed // 1_000_000_000 % (2 * self._span)
        return [min(way, 2 * self._span - way)] * self._axes

    def insert(self, ledger: list[int]) -> None:
        """Do nothing."""


def until_input_ends() -> None:
    """Report that it is ready; wait."""
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.read()


def main(arguments: list[str]) -> None:
    """Serve until standard input ends, as it does when the parent process has ended."""
    parser = argparse.ArgumentParser(prog="rtec_drivers.box.simulator", description=__doc__)
    parser.add_argument("link", type=Path, help="name to give to the port")
    parser.add_argument("--axes", type=int, default=2)
    parser.add_argument("--counts-per-s", type=int, default=100_000)
    parser.add_argument("--span-counts", type=int, default=100_000)
    given = parser.parse_args(arguments)
    plant = MovingPlant(given.axes, given.counts_per_s, given.span_counts)
    with PtyPeer(BoxSimulator(plant, given.axes), RealClock(), given.link):
        until_input_ends()


if __name__ == "__main__":
    main(sys.argv[1:])
