"""Temperatures and spindle speed from frames on a CAN bus, named in a DBC file or mapped in CANopen PDOs."""

import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from rtec.arrays import Floats, Ints
from rtec.errors import ConfigError, DriverFault, DriverTimeout, DriverUnavailable, RtecError
from rtec.files import beside
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Machine
from rtec.quantities import Factor
from rtec.tomlfile import validated
from rtec_drivers.can.bus import CanOptions, CanPort
from rtec_drivers.can.scan import CanScanner
from rtec_drivers.can.signals import NMT, Dbc, NodeOptions, NodeWatch, SignalOptions, SignalSource
from rtec_drivers.temperatures import Conversion, TemperatureReadings, open_code_faults

Timeout = Annotated[float, Field(ge=1e-3, le=3600)]


class TemperatureSignal(SignalOptions, Conversion):
    """A temperature in a frame.

    Attributes:
        timeout_s: longest time between two of its frames. `scale` and `offset` apply after the DBC file's own.
    """

    timeout_s: Timeout = 5.0

    @model_validator(mode="after")
    def _codes_can_come(self) -> Self:
        kind = self.map[self.item - 1] if self.node is not None else "f64"
        if kind[0] != "f" and (fault := open_code_faults(self.open_codes, int(kind[1:]), kind[0] == "i", kind)):
            raise ValueError(fault)
        return self


class SpindleSignal(SignalOptions):
    """The spindle speed in a frame.

    Attributes:
        scale: 1/min for one unit.
        timeout_s: longest time between two of its frames.
    """

    scale: Factor = 1.0
    timeout_s: Timeout = 1.0


class CanTemperatureOptions(CanOptions):
    """Options of temperatures on a CAN bus.

    Attributes:
        dbc: file with messages and signals; a relative path starts at the run file's folder.
        temperature: signals by sensor.
        spindle: signal of the spindle speed.
        node: CANopen devices to watch, by a name of your choice.
    """

    dbc: Path | None = None
    temperature: dict[str, TemperatureSignal] = Field(default_factory=dict)
    spindle: SpindleSignal | None = None
    node: dict[str, NodeOptions] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _reads_something(self) -> Self:
        if not self.temperature and self.spindle is None:
            raise ValueError("nothing is read: give temperature or spindle")
        return self


class CanDriver:
    """Temperatures and spindle speed from a CAN bus: signals of a DBC file, or CANopen PDOs.

    Frames are processed as they arrive; nothing that the loop calls waits for the bus.

    Args:
        options: options of the run file.
        machine: machine with the sensors of the arrays.
        clock: clock of the frames' instants of arrival.
        base: folder at which relative paths start.

    Raises:
        ConfigError: sensors, messages or signals that do not exist; all of them.
        DriverUnavailable: a required package is not installed.
    """

    options_model = CanTemperatureOptions
    EXAMPLE = """\
[device.can]
driver = "can"
interface = "socketcan"            # or "slcan" with channel = "/dev/ttyACM0" and bitrate = 500000
channel = "can0"

# A CANopen measuring device (CiA 404): four temperatures in tenths of a degree in its first PDO.
[device.can.temperature.T_bed]
node = 5
pdo = 1
map = ["i16", "i16", "i16", "i16"]
item = 1
scale = 0.1
open_codes = [32767]

[device.can.node.thermometer]
id = 5
heartbeat_s = 2.0

# With dbc = "machine.dbc" a signal may be named instead: message = "Spindle", signal = "Speed".
[device.can.spindle]
node = 8
pdo = 2
map = ["i32"]
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that lists the received frames and the bytes that change."""
        way = {key: value for key, value in table.items() if key in CanOptions.model_fields}
        return CanScanner(validated(CanOptions, way, "can"), clock, "temperature")

    def __init__(self, options: CanTemperatureOptions, machine: Machine, clock: Clock, base: Path = Path()) -> None:
        self._options, self._clock = options, clock
        dbc = Dbc(None if options.dbc is None else beside(base, options.dbc))
        self._readings = TemperatureReadings(machine.sensor_names, options.temperature)
        faults: list[str] = []
        self._sources = {n: _source(dbc, t, f"temperature {n!r}", faults) for n, t in options.temperature.items()}
        self._spindle = _source(dbc, options.spindle, "spindle", faults) if options.spindle else None
        if faults:
            raise ConfigError("\n".join(faults))
        self._nodes = NodeWatch(list(options.node.values()))
        self._heard_ns = dict.fromkeys(options.temperature, 0)
        self._rpm, self._rpm_ns = math.nan, -(2**62)
        sources = [s for s in (*self._sources.values(), self._spindle) if s is not None]
        filters = {(s.identifier, s.extended) for s in sources} | set(self._nodes.identifiers())
        self._port = CanPort(options, clock, sorted(filters), self._frame, self._look)

    def __enter__(self) -> Self:
        """Open the interface and start listening."""
        now_ns = self._clock.now_ns()
        self._heard_ns = dict.fromkeys(self._heard_ns, now_ns)
        self._port.open()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop listening and close."""
        self._port.close()

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in the newest values, °C, and their instants of arrival, ns; then raise the faults.

        Raises:
            DriverFault: some sensors have no valid new value, or a device has a fault; all other values are filled in.
            DriverUnavailable: the interface is not open; it is being reopened.
        """
        self._readings.fill(degc, time_ns)
        self._port.check()
        faults = self.faults()
        if faults:
            raise DriverFault("; ".join(faults))

    def read_spindle(self) -> float:
        """The newest spindle speed, 1/min.

        Raises:
            DriverFault: the run file names no spindle.
            DriverTimeout: it is older than its timeout.
            DriverUnavailable: the interface is not open.
        """
        self._port.check()
        spindle = self._options.spindle
        if spindle is None:
            raise DriverFault("can: the table spindle is missing, so there is no spindle speed")
        if self._clock.now_ns() - self._rpm_ns > spindle.timeout_s * 1e9:
            raise DriverTimeout(f"can: no spindle speed for {spindle.timeout_s:g} s")
        return self._rpm

    def faults(self) -> list[str]:
        """Present faults, one line each: of the bus, of devices, of sensors."""
        bus = [text for text in (self._port.trouble, self._port.warning) if text]
        return [*bus, *self._nodes.faults(self._clock.now_ns()), *self._readings.faults()]

    @property
    def attempts(self) -> int:
        """Number of attempts to open the interface in the background."""
        return self._port.attempts

    def _frame(self, identifier: int, extended: bool, data: bytes, now_ns: int) -> None:
        order = None if extended else self._nodes.frame(identifier, data, now_ns)
        if order is not None:
            self._start(order)
        for name, source in self._sources.items():
            if source is not None and (source.identifier, source.extended) == (identifier, extended):
                self._take(name, source, data, now_ns)
        spindle = self._spindle
        if spindle is not None and (spindle.identifier, spindle.extended) == (identifier, extended):
            self._take_speed(spindle, data, now_ns)
        self._look(now_ns)

    def _take(self, name: str, source: SignalSource, data: bytes, now_ns: int) -> None:
        try:
            number = source.number(data)
        except DriverFault as e:
            self._readings.silent([name], str(e))
            return
        self._heard_ns[name] = now_ns
        self._readings.take(name, number, now_ns)

    def _take_speed(self, source: SignalSource, data: bytes, now_ns: int) -> None:
        """Store the speed; a value that is no number is skipped, so that the speed ages and times out."""
        scale = self._options.spindle.scale if self._options.spindle else 1.0
        with suppress(DriverFault):
            rpm = source.number(data) * scale
            if math.isfinite(rpm):
                self._rpm, self._rpm_ns = rpm, now_ns

    def _look(self, now_ns: int) -> None:
        for name, table in self._options.temperature.items():
            silent_s = (now_ns - self._heard_ns[name]) * 1e-9
            if silent_s > table.timeout_s:
                self._readings.silent([name], f"no frame for {silent_s:.1f} s")

    def _start(self, order: bytes) -> None:
        try:
            self._port.send(NMT, order)
        except (DriverTimeout, DriverUnavailable):  # tried again at the next heartbeat
            return


def _source(dbc: Dbc, options: SignalOptions, what: str, faults: list[str]) -> SignalSource | None:
    try:
        return dbc.source(options, scaled=True)
    except DriverUnavailable:
        raise
    except RtecError as e:
        faults.append(f"{what}: {e}")
        return None
