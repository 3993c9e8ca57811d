"""What a run file may say of a Modbus line and of the slaves on it."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from rtec.tomlfile import Strict
from rtec_drivers.modbus.line import TcpOptions
from rtec_drivers.modbus.map import Register
from rtec_drivers.serial_line import PortOptions


class ModbusPort(PortOptions):
    """As every serial port, at the rate that Modbus modules are delivered with."""

    baud: Annotated[int, Field(ge=300, le=4_000_000)] = 9600


class SlaveOptions(Strict):
    """One slave on the line.

    Attributes:
        id: its number.
        profile: name of a shipped register map.
        channels: which of the machine's sensors is on which channel of the profile.
        register: registers by sensor, for a module without a profile, or besides it.
        period_s: how often it is asked.
        timeout_s: how long it may take to answer.
        late_s: how long after a request without answer an answer may still come.
        max_gap: unused registers that may be read along, so that one request fetches more.
    """

    id: Annotated[int, Field(ge=1, le=247)]
    profile: str | None = None
    channels: dict[str, str] = Field(default_factory=dict)
    register_: dict[str, Register] = Field(default_factory=dict, alias="register")
    period_s: Annotated[float, Field(ge=0.01, le=3600)] = 1.0
    timeout_s: Annotated[float, Field(ge=0.005, le=10)] = 0.3
    late_s: Annotated[float, Field(ge=0.0, le=10)] = 1.0
    max_gap: Annotated[int, Field(ge=0, le=120)] = 0

    @model_validator(mode="after")
    def _reads_something(self) -> Self:
        if bool(self.profile) != bool(self.channels):
            raise ValueError("profile and channels go together")
        if not self.channels and not self.register_:
            raise ValueError("nothing is read: give profile and channels, or register")
        if self.channels.keys() & self.register_.keys():
            raise ValueError("the same sensor stands in channels and in register")
        return self


class ModbusOptions(Strict):
    """What a run file may say of a Modbus line.

    Attributes:
        serial: a serial line; either this
        tcp: or a connection over TCP.
        slave: the slaves by a name of your choice.
    """

    serial: ModbusPort | None = None
    tcp: TcpOptions | None = None
    slave: Annotated[dict[str, SlaveOptions], Field(min_length=1)]

    @model_validator(mode="after")
    def _one_line(self) -> Self:
        if (self.serial is None) == (self.tcp is None):
            raise ValueError("give either serial or tcp")
        return self
