"""Temperatures over Modbus RTU and TCP, from modules with a shipped register map or one written in the run file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Machine
from rtec.tomlfile import Strict, nearest, validated
from rtec_drivers.byte_line import ByteLine, way_of
from rtec_drivers.modbus.frame import ModbusLineOptions
from rtec_drivers.modbus.map import Register, blocks_of, load_profile
from rtec_drivers.modbus.poll import Poller, Slave
from rtec_drivers.modbus.scan import ModbusScanner
from rtec_drivers.reopen import NS, Backoff, Worker
from rtec_drivers.temperatures import TemperatureReadings


class SlaveOptions(Strict):
    """One slave on the line.

    Attributes:
        id: number of the slave.
        profile: name of a shipped register map.
        channels: channel of the profile by sensor.
        register: registers by sensor, for a module without a profile, or in addition to it.
        period_s: period of asking it.
        timeout_s: longest wait for its answer.
        late_s: time after an unanswered request within which the answer may still come.
        max_gap: unused registers that may be read, too, so that one request fetches more.
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
            raise ValueError("the same sensor is in channels and in register")
        return self


class ModbusOptions(ModbusLineOptions):
    """Options of a Modbus line.

    Attributes:
        slave: the slaves by a name of your choice.
    """

    slave: Annotated[dict[str, SlaveOptions], Field(min_length=1)]


class ModbusDriver:
    """Temperatures from Modbus modules on a serial line or over TCP, several on one line.

    Polls in a thread of its own and gives the newest valid values. A lost line is reopened, with growing waits; silent
    slaves are reported, and slow no other. Nothing that the loop calls waits for the line.

    Args:
        options: options of the run file.
        machine: machine with the sensors of the arrays.
        clock: clock of instants and deadlines.
        base: not used.

    Attributes:
        poller: poller of the open line, with its figures.

    Raises:
        ConfigError: sensors, profiles or channels that do not exist; all of them.
        DriverUnavailable: voltages need a package that is not installed.
    """

    options_model = ModbusOptions
    EXAMPLE = """\
[device.thermocouples]
driver = "modbus"
serial = { port = "/dev/serial/by-id/usb-FTDI_USB-RS485_Cable_FT0ABCDE-if00-port0", baud = 19200, parity = "even" }
# or: tcp = { host = "192.168.1.50" }

# A module with a shipped register map: which of the machine's sensors is on which terminal.
[device.thermocouples.slave.bed]
id = 1
profile = "isma-sfar-s-6ti"
channels = { T_bed = "1", T_column = "2" }

# A module of your own: addresses as they go over the line, from 0.
[device.thermocouples.slave.spindle]
id = 2
period_s = 0.5
timeout_s = 0.1

[device.thermocouples.slave.spindle.register.T_spindle]
address = 0
function = "input"
type = "int16"
scale = 0.1
open_codes = [32767, -32768]
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that lists the slaves that answer, and their registers."""
        way = {key: table[key] for key in ("serial", "tcp") if key in table}
        return ModbusScanner(validated(ModbusLineOptions, way, "modbus"), clock)

    def __init__(self, options: ModbusOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        del base
        self._options, self._clock = options, clock
        maps = _register_maps(options)
        self._readings = TemperatureReadings(machine.sensor_names, {n: r for m in maps.values() for n, r in m.items()})
        self._maps = maps
        self._connect, self._retry = way_of(options.serial, options.tcp, clock)
        self._worker: Worker[ByteLine] | None = None
        self._slaves: list[Slave] = []
        self.poller: Poller | None = None

    def __enter__(self) -> Self:
        """Open the line and start polling.

        Raises:
            DriverUnavailable: it cannot be opened, and the options have `at_start = "required"`.
        """
        line = None
        try:
            line = self._connect()
        except DriverUnavailable as e:
            if self._retry.at_start == "required":
                raise
            self._tell(str(e))
        self._slaves = [self._slave(name, table) for name, table in self._options.slave.items()]
        self._worker = Worker("rtec-modbus", self._clock, self._connect, self._serve, self._tell, self._backoff())
        self._worker.start(line)
        return self

    def __exit__(self, *error: object) -> None:
        """Stop polling and close the line."""
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.stop()

    def read_temperatures(self, degc: NDArray[np.float64], time_ns: NDArray[np.int64]) -> None:
        """Fill in the newest valid values, °C, and the instants of their requests, ns; then raise the faults.

        Raises:
            DriverFault: some sensors have no valid new value; all others are filled in.
            DriverUnavailable: not entered.
        """
        if self._worker is None:
            raise DriverUnavailable("modbus: not entered, so nothing is read")
        self._readings.fill(degc, time_ns)
        self._readings.tell()

    @property
    def attempts(self) -> int:
        """Number of attempts to open the line in the background."""
        return self._worker.attempts if self._worker is not None else 0

    def faults(self) -> list[str]:
        """Present faults, one line a sensor."""
        return self._readings.faults()

    def _backoff(self) -> Backoff:
        return Backoff(self._retry.first_retry_s, self._retry.longest_retry_s)

    def _serve(self, line: ByteLine) -> None:
        worker = self._worker
        if worker is not None:
            self.poller = Poller(
                self._slaves, self._readings, self._clock, self._options.exchange(self._clock, worker.wait_until_ns)
            )
            self.poller.serve(line, worker)

    def _slave(self, name: str, table: SlaveOptions) -> Slave:
        tcp = self._options.tcp
        numbered = tcp is not None and not tcp.rtu  # then the number distinguishes a late answer from a new one
        late_s = 0.0 if numbered else max(table.late_s, table.timeout_s)
        return Slave(
            name,
            table.id,
            blocks_of(table.id, self._maps[name], table.max_gap),
            round(table.period_s * NS),
            round(table.timeout_s * NS),
            round(late_s * NS),
            self._backoff(),
        )

    def _tell(self, why: str) -> None:
        if why:
            self._readings.silent([n for m in self._maps.values() for n in m], why)


def _register_maps(options: ModbusOptions) -> dict[str, Mapping[str, Register]]:
    out: dict[str, Mapping[str, Register]] = {}
    faults: list[str] = []
    slave_of: dict[str, str] = {}
    for name, table in options.slave.items():
        out[name] = {**_from_profile(name, table, faults), **table.register_}
        for sensor in out[name]:
            if sensor in slave_of:
                faults.append(f"sensor {sensor!r} is in slave {slave_of[sensor]!r} and in slave {name!r}")
            slave_of[sensor] = name
    numbers = [t.id for t in options.slave.values()]
    faults += [f"two slaves have id {n}" for n in sorted(set(numbers)) if numbers.count(n) > 1]
    if faults:
        raise ConfigError("\n".join(faults))
    return out


def _from_profile(name: str, table: SlaveOptions, faults: list[str]) -> dict[str, Register]:
    if table.profile is None:
        return {}
    try:
        profile = load_profile(table.profile)
    except ConfigError as e:
        faults.append(f"slave {name!r}: {e}")
        return {}
    faults += [
        f"slave {name!r}: profile {table.profile} has no channel {c!r}{nearest(c, profile.channel)}"
        for c in table.channels.values()
        if c not in profile.channel
    ]
    return {s: profile.channel[c] for s, c in table.channels.items() if c in profile.channel}
