"""What a run file may say of a connection to Modbus slaves over TCP."""

from typing import Annotated

from pydantic import Field

from rtec_drivers.byte_line import TcpPlace

TCP_PORT = 502


class TcpOptions(TcpPlace):
    """A TCP connection to Modbus slaves.

    Attributes:
        rtu: the connection carries a serial line's frames, as simple serial servers do.
    """

    port: Annotated[int, Field(ge=1, le=65535)] = TCP_PORT
    rtu: bool = False
