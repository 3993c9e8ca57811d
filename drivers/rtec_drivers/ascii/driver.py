"""Readouts and thermocouple boards that print lines of text on a serial port: counts, temperatures, spindle speed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rtec.errors import DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import Clock
from rtec.loop.ports import Scanner
from rtec.machine import Machine
from rtec.tomlfile import validated
from rtec_drivers.ascii.scan import AsciiScanner
from rtec_drivers.ascii.text import SPINDLE, AsciiOptions, LineParser, LineReader
from rtec_drivers.count_tracker import CountTracker, max_counts_per_s
from rtec_drivers.reopen import Reopener
from rtec_drivers.serial_line import PortFinder, PortOptions, Ports, SerialLine
from rtec_drivers.temperatures import StuckWatch


class ReadingBook:
    """The newest reading of every group, and the present faults.

    Attributes:
        values: reading and its instant, ns, by group: °C, counts, 1/min.
        faults: present faults by group; "" for malformed lines, "axes" for positions.

    Raises:
        ConfigError: a pattern names the axes, but not every axis has its highest speed.
    """

    def __init__(self, parser: LineParser, options: AsciiOptions, machine: Machine) -> None:
        self.values: dict[str, tuple[float, int]] = {}
        self.faults: dict[str, str] = {}
        self._parser, self._axes = parser, machine.axis_names
        self._stuck = StuckWatch(options.stuck_after_s)
        self._tracker: CountTracker | None = None
        if self._axes[0] in parser.groups:
            self._tracker = CountTracker(self._axes, 64, max_counts_per_s(options.max_speed_mm_s, machine))

    @property
    def has_axes(self) -> bool:
        """Do the patterns name the axes?"""
        return self._tracker is not None

    @property
    def lost(self) -> str:
        """Why the positions are unknown; "" where they are known."""
        return "" if self._tracker is None else self._tracker.lost

    def restart(self) -> None:
        """Forget everything."""
        self.values.clear()
        self.faults.clear()
        if self._tracker is not None:
            self._tracker.restart()

    def take(self, line: bytes, instant_ns: int, now_ns: int) -> bool:
        """Process a line that arrived between two instants; return whether it held a reading."""
        printed = self._parser.parse(line)
        if printed is None:
            return False
        if printed.values:
            self.faults.pop("", None)
        for name, value in printed.values.items():
            if name not in self._axes:
                self._take_one(name, value, instant_ns, now_ns)
        if self._tracker is not None and all(name in printed.values for name in self._axes):
            self._take_axes(self._tracker, [round(printed.values[name]) for name in self._axes], instant_ns, now_ns)
        self.faults.update(printed.faults)
        return bool(printed.values)

    def _take_one(self, name: str, value: float, instant_ns: int, now_ns: int) -> None:
        stuck = self._stuck.look(name, value, now_ns)
        if stuck:
            self.faults[name] = stuck
        else:
            self.faults.pop(name, None)
            self.values[name] = (value, instant_ns)

    def _take_axes(self, tracker: CountTracker, counts: list[int], instant_ns: int, now_ns: int) -> None:
        """Accept positions in counts that the machine can have reached: a line of text has no check sum of its own."""
        try:
            values = tracker.update(counts, instant_ns, now_ns)
        except DriverFault as e:
            self.faults["axes"] = str(e)
            return
        self.faults.pop("axes", None)
        for name, value in zip(self._axes, values, strict=True):
            self.faults.pop(name, None)
            self.values[name] = (value, instant_ns)


IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]
READS_PER_POLL = 4
"""Reads of up to 4 kB; a device that floods the line is read on at the next call."""


class AsciiLinesDriver:
    """Readout or thermocouple board that prints lines.

    Never waits: each call processes the bytes that have arrived. A reading's instant is that of the call before, after
    which it arrived: so it is never younger than its instant. Calls fill in the good readings before they raise a
    fault.

    Args:
        options: options of the run file.
        machine: machine with the axes and sensors of the arrays.
        clock: clock of the instants.
        base: not used, as there are no files.
        ports: lists the serial ports; None: pyserial's list.

    Raises:
        ConfigError: patterns or units do not fit the machine.
    """

    options_model = AsciiOptions
    EXAMPLE = """\
[device.thermocouples]
driver = "ascii_lines"
usb_serial = "AB0JQ2X7"                       # found by it, whatever its port is called today
baud = 9600
parity = "even"
bytesize = 7
decimal = ","
patterns = ['T1=(?P<T_bed>\\S+) T2=(?P<T_air>\\S+)']   # T1= 21,4 is then T_bed, by the machine's names
units = {T_air = "degf"}
"""

    @classmethod
    def scanner(cls, table: Mapping[str, Any], clock: Clock) -> Scanner:
        """A scanner that listens at the port."""
        way = {key: value for key, value in table.items() if key in PortOptions.model_fields}
        return AsciiScanner(validated(PortOptions, way, "ascii_lines"), clock)

    def __init__(
        self, options: AsciiOptions, machine: Machine, clock: Clock, base: Path = Path(), ports: Ports | None = None
    ) -> None:
        del base
        self.options, self._machine, self._clock = options, machine, clock
        self._parser = LineParser(options, machine)
        self._book = ReadingBook(self._parser, options, machine)
        self._finder = PortFinder(options, ports)
        self._reopener = Reopener(self._connect, _close, clock, options.first_retry_s, options.longest_retry_s)
        self._line: SerialLine | None = None
        self._entered = False
        self._reader: LineReader = self._parser.reader()
        self._polled_ns = self._heard_ns = self._requested_ns = 0

    def __enter__(self) -> Self:
        """Open the port.

        Raises:
            DriverUnavailable: it does not exist, and the options have `at_start = "required"`.
        """
        self.resume()
        self._entered = True
        self._reopener.start()
        try:
            self._adopt(self._connect())
        except DriverError as e:
            if self.options.at_start == "required":
                self._leave()
                raise
            self._lose(str(e))
        return self

    def __exit__(self, *error: object) -> None:
        """Close."""
        self._leave()

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not."""
        return self._book.lost

    def resume(self) -> None:
        """Go on after a lost position: the next printed position is accepted as it is."""
        self._book.restart()

    def read_temperatures(self, degc: FloatArray, time_ns: IntArray) -> None:
        """Fill in what was printed since, °C and instants; then raise the faults.

        Raises:
            DriverFault: text that is no number, garbage, a stuck reading.
            DriverTimeout: the device is silent.
            DriverUnavailable: the port is gone; it is being reopened.
        """
        trouble = self._poll()
        for i, name in enumerate(self._machine.sensor_names):
            if name in self._book.values:
                degc[i], time_ns[i] = self._book.values[name]
        self._tell(trouble)

    def read_counts(self, counts: IntArray) -> int:
        """Fill in the newest printed positions, in counts; give their instant, ns.

        Raises:
            DriverFault, DriverTimeout, DriverUnavailable: as `read_temperatures`; or no pattern names the axes.
        """
        self._tell(self._poll())
        names = self._machine.axis_names
        if not self._book.has_axes:
            raise DriverFault(f"{self.options.place}: no pattern names the axes {', '.join(names)}")
        if names[0] not in self._book.values:
            raise DriverTimeout(f"{self.options.place}: no line with the axes' positions yet")
        for i, name in enumerate(names):
            counts[i] = int(self._book.values[name][0])
        return self._book.values[names[0]][1]

    def read_spindle(self) -> float:
        """The newest printed spindle speed, 1/min.

        Raises:
            DriverFault, DriverTimeout, DriverUnavailable: as `read_temperatures`; or it is older than the silence after
                which the port is reopened.
        """
        self._tell(self._poll())
        value, instant_ns = self._book.values.get(SPINDLE, (0.0, -(2**62)))
        if self._clock.now_ns() - instant_ns > self.options.silent_reopen_s * 1e9:
            raise DriverTimeout(f"{self.options.place}: no spindle speed was printed")
        return value

    def _connect(self) -> SerialLine:
        device = self._finder.find()
        line = SerialLine(self.options, device)
        self._finder.remember(device)
        return line

    def _adopt(self, line: SerialLine) -> SerialLine:
        self._line, self._reader = line, self._parser.reader()
        now_ns = self._clock.now_ns()
        self._polled_ns = self._heard_ns = now_ns
        self._requested_ns = now_ns - round(self.options.request_period_s * 1e9)
        return line

    def _live(self) -> SerialLine:
        if not self._entered:
            raise DriverUnavailable("ascii_lines: not entered, so its port is not open")
        if self._line is not None:
            return self._line
        line = self._reopener.poll()
        if line is None:
            raise DriverUnavailable(f"{self._reopener.error}; trying again")
        return self._adopt(line)

    def _poll(self) -> DriverError | None:
        """Process the bytes that have arrived; give the error that prevents it. Raises if the driver is not entered."""
        if not self._entered:
            raise DriverUnavailable("ascii_lines: not entered, so its port is not open")
        try:
            line = self._live()
            try:
                self._listen(line)
            except DriverUnavailable as e:
                self._lose(str(e))
                raise
        except DriverError as e:
            return e
        return None

    def _listen(self, line: SerialLine) -> None:
        now_ns, before_ns = self._clock.now_ns(), self._polled_ns
        for _ in range(READS_PER_POLL):
            received = line.read()
            if not received:
                break
            for text in self._reader.feed(received):
                if self._book.take(text, before_ns, now_ns):
                    self._heard_ns = now_ns
        self._polled_ns = now_ns
        self._request(line, now_ns)
        silent_s = (now_ns - self._heard_ns) * 1e-9
        if silent_s > self.options.silent_reopen_s:
            raise DriverUnavailable(f"{line.device}: nothing to be understood for {silent_s:.1f} s")

    def _request(self, line: SerialLine, now_ns: int) -> None:
        if self.options.request is None or now_ns - self._requested_ns < self.options.request_period_s * 1e9:
            return
        self._requested_ns = now_ns
        line.write(self.options.request.encode(self.options.encoding))

    def _tell(self, trouble: DriverError | None) -> None:
        if trouble is not None:
            raise trouble
        if self._book.faults:
            raise DriverFault(f"{self.options.place}: {'; '.join(self._book.faults.values())}")

    def _lose(self, error: str) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None
        self._reopener.lost(error)

    def _leave(self) -> None:
        self._entered = False
        self._reopener.close()
        if self._line is not None:
            self._line.close()
            self._line = None


def _close(line: SerialLine) -> None:
    line.close()
