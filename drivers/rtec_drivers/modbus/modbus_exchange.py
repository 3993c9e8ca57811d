"""One request and its answer on an open Modbus line, in either framing."""

from collections.abc import Callable
from typing import Protocol

from rtec.errors import DriverUnavailable
from rtec.loop.clock import Clock
from rtec_drivers.modbus.frame import Answer, Request, decode, find_rtu, split_tcp
from rtec_drivers.modbus.line import Line

LONGEST_NOISE = 4096
"""A babbling line fills no memory: of what is no answer no more than so many bytes are kept."""


class Exchange(Protocol):
    """One request and its answer, in one of the two framings.

    Attributes:
        numbered: an answer tells which request it belongs to.
    """

    numbered: bool

    def ask(self, line: Line, request: Request, until_ns: int) -> tuple[Answer | None, bytes]:
        """The answer or None, and what came besides."""
        ...


class RtuExchange:
    """On a serial line, or on a TCP connection that carries a serial line's frames.

    Args:
        clock: deadlines are in its time.
        worker_wait: waits until an instant, or until the worker is stopped.
        silence_ns: quiet time between frames, 3.5 characters.
    """

    numbered = False

    def __init__(self, clock: Clock, worker_wait: Callable[[int], None], silence_ns: int) -> None:
        self._clock, self._wait, self._silence_ns = clock, worker_wait, silence_ns

    def ask(self, line: Line, request: Request, until_ns: int) -> tuple[Answer | None, bytes]:
        """Send when the line has been quiet; take the frame of exactly the shape that was asked for."""
        self._wait(self._clock.now_ns() + self._silence_ns)
        line.send(request.rtu())
        data = b""
        while self._clock.now_ns() < until_ns:
            more = line.receive(until_ns)
            data = (data + more)[-LONGEST_NOISE:]
            answer = find_rtu(data, request) if more else None
            if answer is not None:
                return answer, data
        return None, data


class TcpExchange:
    """On a TCP connection: the answer carries the number of its request, so an old one is never taken."""

    numbered = True

    def __init__(self, clock: Clock) -> None:
        self._clock, self._transaction, self._rest = clock, 0, b""

    def ask(self, line: Line, request: Request, until_ns: int) -> tuple[Answer | None, bytes]:
        """Send with the next number; skip answers with any other."""
        self._transaction = self._transaction % 0xFFFF + 1
        line.send(request.tcp(self._transaction))
        seen = b""
        while self._clock.now_ns() < until_ns:
            more = line.receive(until_ns)
            seen = (seen + more)[-LONGEST_NOISE:]
            parts = split_tcp(self._rest + more)
            if parts is None:
                raise DriverUnavailable("what comes is no Modbus TCP; is it the right port?")
            messages, self._rest = parts
            for transaction, unit, content in messages:
                answer = decode(content, request)
                if transaction == self._transaction and unit == request.slave and answer is not None:
                    return answer, seen
        return None, seen
