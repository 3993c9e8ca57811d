"""Slaves on a pty that misbehave on request, with a checksum of their own; and waiting with a deadline."""

import os
import select
import threading
import tty
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.errors import DriverFault
from rtec.loop.clock import RealClock
from rtec.machine import Machine
from rtec.tomlfile import validated
from rtec_drivers.modbus.driver import ModbusDriver, ModbusOptions
from tests.support import machines

CLOCK = RealClock()
MS = 1_000_000
MACHINE: Machine = machines.turning_centre()
SENSORS = list(MACHINE.sensor_names)


def crc(data: bytes) -> bytes:
    """CRC-16 of MODBUS over Serial Line 1.02, appendix B, bit by bit."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")


def until(condition: Callable[[], bool], timeout_s: float = 60.0, period_ms: float = 2.0) -> bool:
    """Look again and again until something is so, or the time is over; say which."""
    deadline_ns = CLOCK.now_ns() + round(timeout_s * 1e9)
    while not condition():
        if CLOCK.now_ns() > deadline_ns:
            return False
        CLOCK.sleep_until_ns(CLOCK.now_ns() + round(period_ms * MS))
    return True


@dataclass
class FakeSlave:
    """What one slave does.

    Attributes:
        value: its register 0, by the number of the request; the following registers count up from it.
        register: of these addresses the value, each time it is read.
        last: its last address; requests beyond it are refused with error 2. Not given: it has all.
        delay_s: before it answers.
        silent: it does not answer.
        spoil: what becomes of an answer's bytes.
        asked_ns: when it was asked.
        addresses: first addresses of the requests.
    """

    value: Callable[[int], int] = lambda _: 0
    register: Mapping[int, Callable[[], int]] = field(default_factory=dict)
    last: int = 0xFFFF
    delay_s: float = 0.0
    silent: bool = False
    spoil: Callable[[int, bytes], bytes] = lambda _, data: data
    asked_ns: list[int] = field(default_factory=list)
    addresses: list[int] = field(default_factory=list)


class FakeLine:
    """The other end of a pty: a thread that answers for several slaves."""

    def __init__(self, slaves: Mapping[int, FakeSlave]) -> None:
        self.slaves = dict(slaves)
        self.master, self._slave_fd = os.openpty()
        tty.setraw(self._slave_fd)
        self.port = os.ttyname(self._slave_fd)
        self.unknown: list[bytes] = []
        self._wake, self._waker = os.pipe()
        self._due: list[tuple[int, bytes]] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def hang_up(self) -> None:
        """Pull the cable; the name of the pty stays ours until `close`."""
        if self._thread.is_alive():
            os.write(self._waker, b"x")
            self._thread.join()
            os.close(self.master)

    def close(self) -> None:
        """Pull the cable and give the pty back."""
        self.hang_up()
        for fd in (self._slave_fd, self._wake, self._waker):
            os.close(fd)

    def say(self, data: bytes) -> None:
        """Put bytes on the line unasked."""
        os.write(self.master, data)

    def _run(self) -> None:
        data = b""
        while True:
            left_s = max(0.0, (min(self._due)[0] - CLOCK.now_ns()) / 1e9) if self._due else None
            ready, _, _ = select.select([self.master, self._wake], [], [], left_s)
            if self._wake in ready:
                return
            if self.master in ready:
                data += os.read(self.master, 4096)
            while len(data) >= 8:
                self._request(data[:8])
                data = data[8:]
            now_ns = CLOCK.now_ns()
            for item in sorted(d for d in self._due if d[0] <= now_ns):
                self._due.remove(item)
                os.write(self.master, item[1])

    def _request(self, frame: bytes) -> None:
        slave = self.slaves.get(frame[0])
        if crc(frame[:6]) != frame[6:] or slave is None:
            self.unknown.append(frame)
            return
        slave.asked_ns.append(CLOCK.now_ns())
        slave.addresses.append(int.from_bytes(frame[2:4], "big"))
        if slave.silent:
            return
        k, count, first = len(slave.asked_ns), frame[5], int.from_bytes(frame[2:4], "big")
        base = slave.value(k)
        numbers = [slave.register[a]() if a in slave.register else base + a for a in range(first, first + count)]
        body = frame[:2] + bytes([2 * count]) + b"".join((n & 0xFFFF).to_bytes(2, "big") for n in numbers)
        if first + count - 1 > slave.last:
            body = bytes([frame[0], frame[1] | 0x80, 2])
        self._due.append((CLOCK.now_ns() + round(slave.delay_s * 1e9), slave.spoil(k, body + crc(body))))


@contextmanager
def line(slaves: Mapping[int, FakeSlave]) -> Iterator[FakeLine]:
    """A line with slaves, closed at the end."""
    fake = FakeLine(slaves)
    try:
        yield fake
    finally:
        fake.close()


def slave_table(number: int, sensor: str, **more: Any) -> dict[str, Any]:
    """A slave with one register, in tenths of a degree."""
    register = {"address": 0, "scale": 0.1, **more.pop("register", {})}
    return {"id": number, "period_s": 0.05, "timeout_s": 0.1, "register": {sensor: register}, **more}


def serial(port: str, **more: Any) -> dict[str, Any]:
    """A fast serial line that is tried again soon."""
    return {"port": port, "baud": 115200, "first_retry_s": 0.02, "longest_retry_s": 0.1, **more}


def driver(**options: Any) -> ModbusDriver:
    """A driver, made as a run file makes it."""
    return ModbusDriver(validated(ModbusOptions, options, "run.toml"), MACHINE, CLOCK)


class Seen:
    """The arrays that a loop keeps."""

    def __init__(self, source: ModbusDriver) -> None:
        self._source = source
        self.degc: NDArray[np.float64] = np.full(len(SENSORS), np.nan)
        self.time_ns: NDArray[np.int64] = np.zeros(len(SENSORS), np.int64)

    def __getitem__(self, sensor: str) -> float:
        with suppress(DriverFault):
            self._source.read_temperatures(self.degc, self.time_ns)
        return float(self.degc[SENSORS.index(sensor)])

    def age_ms(self, sensor: str) -> float:
        """Of the newest value."""
        with suppress(DriverFault):
            self._source.read_temperatures(self.degc, self.time_ns)
        return (CLOCK.now_ns() - int(self.time_ns[SENSORS.index(sensor)])) / MS
