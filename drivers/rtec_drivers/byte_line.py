"""Bytes to a device and back, over a serial port or a TCP connection. Reading waits in the kernel, up to a deadline."""

import os
import select
import socket
from collections.abc import Callable
from typing import Annotated, Literal, Protocol

from pydantic import Field

from rtec.errors import ConfigError, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.tomlfile import Strict
from rtec_drivers.reopen import FirstRetry, LongestRetry
from rtec_drivers.serial_line import PortFinder, PortOptions, SerialLine

NS = 1_000_000_000
CHUNK = 4096
CONNECT_TIMEOUT_S = 2.0


class TcpPlace(Strict):
    """A TCP connection.

    Attributes:
        host, port: where the device, or the gateway to a serial line, listens.
        at_start: "required": the run does not begin without the connection; "later": it may come at any time.
        first_retry_s, longest_retry_s: wait between two attempts; doubled from the first up to the longest.
    """

    host: str
    port: Annotated[int, Field(ge=1, le=65535)]
    at_start: Literal["required", "later"] = "required"
    first_retry_s: FirstRetry = 0.1
    longest_retry_s: LongestRetry = 5.0


class ByteLine(Protocol):
    """Bytes to a device and back."""

    def send(self, data: bytes) -> None:
        """Put bytes on the line; raises DriverUnavailable where it is gone."""
        ...

    def receive(self, until_ns: int) -> bytes:
        """Some bytes, or none at the deadline; raises DriverUnavailable where the line is gone."""
        ...

    def close(self) -> None:
        """Close it; never raises."""
        ...


class PortLine:
    """A serial port, for this process alone.

    Args:
        options: port and its settings.
        finder: finds the port's present name.
        clock: clock of the deadlines.

    Raises:
        DriverUnavailable: the port does not exist, is busy, or may not be opened.
    """

    def __init__(self, options: PortOptions, finder: PortFinder, clock: Clock) -> None:
        device = finder.find()
        self._line, self._clock = SerialLine(options, device), clock
        finder.remember(device)

    def send(self, data: bytes) -> None:
        """Put bytes on the line."""
        try:
            self._line.write(data)
        except DriverTimeout as e:  # a port that accepts nothing more has hung
            raise DriverUnavailable(str(e)) from e

    def receive(self, until_ns: int) -> bytes:
        """Wait for bytes until the deadline."""
        self._line.wait((until_ns - self._clock.now_ns()) / NS)
        return self._line.read()

    def close(self) -> None:
        """Close the port."""
        self._line.close()


class TcpLine:
    """A TCP connection.

    Raises:
        DriverUnavailable: nothing listens there, or it cannot be reached.
    """

    def __init__(self, options: TcpPlace, clock: Clock) -> None:
        self.name, self._clock = f"{options.host}:{options.port}", clock
        try:
            self._socket = socket.create_connection((options.host, options.port), CONNECT_TIMEOUT_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as e:
            raise DriverUnavailable(f"{self.name}: no connection: {e.strerror or e}") from e

    def send(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._socket.sendall(data)
        except OSError as e:
            raise self._lost(e) from e

    def receive(self, until_ns: int) -> bytes:
        """Wait for bytes until the deadline."""
        left_s = max(0.0, (until_ns - self._clock.now_ns()) / NS)
        try:
            if not select.select((self._socket,), (), (), left_s)[0]:
                return b""
            data = os.read(self._socket.fileno(), CHUNK)
        except (OSError, ValueError) as e:
            raise self._lost(e) from e
        if not data:
            raise DriverUnavailable(f"{self.name}: connection closed by the other end")
        return data

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def _lost(self, error: Exception) -> DriverUnavailable:
        return DriverUnavailable(f"{self.name}: connection lost: {getattr(error, 'strerror', '') or error}")


def way_of(
    serial: PortOptions | None, tcp: TcpPlace | None, clock: Clock
) -> tuple[Callable[[], ByteLine], PortOptions | TcpPlace]:
    """The function that opens a line, and the options that say when to try again.

    Raises:
        ConfigError: neither is given, or both.
    """
    if tcp is not None and serial is None:
        return (lambda: TcpLine(tcp, clock)), tcp
    if serial is None or tcp is not None:
        raise ConfigError("give either serial or tcp")
    finder = PortFinder(serial)
    return (lambda: PortLine(serial, finder, clock)), serial
