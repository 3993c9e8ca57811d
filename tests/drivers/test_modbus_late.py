"""Answers that come late on a Modbus line, on a virtual clock. Oracle: each answer has the number of its request."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from rtec.errors import DriverTimeout
from rtec.loop.clock import VirtualClock
from rtec_drivers.byte_line import ByteLine
from rtec_drivers.modbus.frame import RtuExchange
from rtec_drivers.modbus.map import Register, blocks_of
from rtec_drivers.modbus.poll import Poller, Slave
from rtec_drivers.reopen import Backoff, Worker
from rtec_drivers.temperatures import TemperatureReadings
from tests.support.modbus_peer import MS, crc

NS = 1_000_000_000
LATE_REQUESTS, ALL_REQUESTS = 12, 24


@dataclass
class LateLine:
    """A slave that answers one request after the other, each by its number, and for the first dozen late."""

    clock: VirtualClock
    delay_ns: int
    asked_ns: list[int] = field(default_factory=list)
    due: list[tuple[int, bytes]] = field(default_factory=list)

    def send(self, data: bytes) -> None:
        now_ns, k = self.clock.now_ns(), len(self.asked_ns) + 1
        self.asked_ns.append(now_ns)
        body = data[:2] + bytes([2]) + k.to_bytes(2, "big")
        answer_ns = now_ns + (self.delay_ns if k <= LATE_REQUESTS else MS)
        self.due.append((max([answer_ns, *(at_ns for at_ns, _ in self.due)]), body + crc(body)))

    def receive(self, until_ns: int) -> bytes:
        if self.due and self.due[0][0] <= max(until_ns, self.clock.now_ns()):
            at_ns, data = self.due.pop(0)
            self.clock.sleep_until_ns(at_ns)
            return data
        self.clock.sleep_until_ns(until_ns)
        return b""

    def close(self) -> None:
        pass


@dataclass
class Turn:
    """What a poller needs of its worker: until so many requests have been made."""

    line: LateLine
    backoff: Backoff

    @property
    def stopping(self) -> bool:
        return len(self.line.asked_ns) >= ALL_REQUESTS

    def wait_until_ns(self, instant_ns: int) -> None:
        self.line.clock.sleep_until_ns(instant_ns)


class Taken:
    """The readings that a poller believed: each number with its stamp."""

    def __init__(self) -> None:
        self.values: list[tuple[int, int]] = []

    def take(self, _: str, raw: float, time_ns: int) -> None:
        self.values.append((round(raw), time_ns))

    def silent(self, *_: Any) -> None:
        pass


def believed(delay_ns: int, late_s: float, first_retry_s: float) -> Iterator[tuple[int, int]]:
    """Of each value that was taken: the request that it answers, and the one that it was taken for."""
    clock = VirtualClock(NS)
    line, taken = LateLine(clock, delay_ns), Taken()
    backoff = Backoff(first_retry_s, 5.0)
    blocks = blocks_of(1, {"T_bed": Register(address=0)}, 0)
    slave = Slave("bed", 1, blocks, 50 * MS, 100 * MS, round(late_s * NS), backoff)
    turn = cast(Worker[ByteLine], Turn(line, Backoff(1.0, 1.0)))
    exchange = RtuExchange(clock, turn.wait_until_ns, 2 * MS)
    poller = Poller([slave], cast(TemperatureReadings, taken), clock, exchange)
    while not turn.stopping:
        with suppress(DriverTimeout):  # the line is opened again
            poller.serve(line, turn)
    for number, stamp_ns in taken.values:
        yield number, sum(at_ns - 2 * MS <= stamp_ns for at_ns in line.asked_ns)


@pytest.mark.parametrize("late_s", [0.2, 0.3, 1.0])
@pytest.mark.parametrize("first_retry_s", [0.02, 0.1, 0.35])
def test_no_answer_is_taken_for_that_of_a_later_request(late_s: float, first_retry_s: float) -> None:
    wrong = [
        (delay_ms, pair)
        for delay_ms in range(105, 4000, 35)
        for pair in believed(delay_ms * MS, late_s, first_retry_s)
        if pair[0] != pair[1]
    ]
    assert wrong == []
