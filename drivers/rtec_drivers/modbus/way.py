"""Access to a Modbus line: a serial port or TCP, each with its framing."""

from collections.abc import Callable
from typing import Annotated, Self

from pydantic import Field, model_validator

from rtec.loop.clock import Clock
from rtec.tomlfile import Strict
from rtec_drivers.byte_line import TcpPlace
from rtec_drivers.link_worker import NS
from rtec_drivers.modbus.frame import Exchange, RtuExchange, TcpExchange
from rtec_drivers.serial_line import PortOptions

TCP_PORT = 502
SILENT_CHARACTERS = 3.5
LEAST_SILENCE_NS = 1_750_000
"""MODBUS over Serial Line 1.02, 2.5.1.1: above 19200 baud the silence between frames stays 1.75 ms."""


class TcpOptions(TcpPlace):
    """A TCP connection to Modbus slaves.

    Attributes:
        rtu: the connection carries a serial line's frames, as with simple serial servers.
    """

    port: Annotated[int, Field(ge=1, le=65535)] = TCP_PORT
    rtu: bool = False


class ModbusPort(PortOptions):
    """Options of a serial port, with the default rate of Modbus modules."""

    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 9600


class ModbusLineOptions(Strict):
    """Access to a Modbus line.

    Attributes:
        serial: a serial line; either this or `tcp`.
        tcp: a connection over TCP; either this or `serial`.
    """

    serial: ModbusPort | None = None
    tcp: TcpOptions | None = None

    @model_validator(mode="after")
    def _one_line(self) -> Self:
        if (self.serial is None) == (self.tcp is None):
            raise ValueError("give either serial or tcp")
        return self

    def exchange(self, clock: Clock, wait: Callable[[int], None]) -> Exchange:
        """Requests and answers in this line's framing; `wait` waits until an instant."""
        tcp, port = self.tcp, self.serial
        if tcp is not None and not tcp.rtu:
            return TcpExchange(clock)
        silence_ns = LEAST_SILENCE_NS
        if port is not None:
            bits = 1 + port.bytesize + (port.parity != "none") + port.stopbits
            silence_ns = max(silence_ns, round(SILENT_CHARACTERS * bits * NS / port.baud))
        return RtuExchange(clock, wait, silence_ns)
