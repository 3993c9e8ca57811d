"""What a device that prints lines has said so far."""

from rtec.errors import DriverFault
from rtec.machine import Machine
from rtec_drivers.ascii.options import AsciiOptions
from rtec_drivers.ascii.text import LineParser
from rtec_drivers.box.options import max_counts_per_s
from rtec_drivers.count_tracker import CountTracker
from rtec_drivers.stuck import StuckWatch


class ReadingBook:
    """The newest reading of every group, and what is wrong.

    Attributes:
        values: reading and its instant, ns, by group: °C, counts, 1/min.
        faults: what is wrong now, by group; "" for lines that say nothing, "axes" for positions.

    Raises:
        ConfigError: a pattern names the axes, and their highest speeds are not all given.
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
        """Why the positions are not known any more; "" where they are."""
        return "" if self._tracker is None else self._tracker.lost

    def restart(self) -> None:
        """Forget everything."""
        self.values.clear()
        self.faults.clear()
        if self._tracker is not None:
            self._tracker.restart()

    def take(self, line: bytes, instant_ns: int, now_ns: int) -> bool:
        """Take a line in that came between two instants; say whether it held a reading."""
        said = self._parser.parse(line)
        if said is None:
            return False
        if said.values:
            self.faults.pop("", None)
        for name, value in said.values.items():
            if name not in self._axes:
                self._take_one(name, value, instant_ns, now_ns)
        if self._tracker is not None and all(name in said.values for name in self._axes):
            self._take_axes(self._tracker, [round(said.values[name]) for name in self._axes], instant_ns, now_ns)
        self.faults.update(said.faults)
        return bool(said.values)

    def _take_one(self, name: str, value: float, instant_ns: int, now_ns: int) -> None:
        stuck = self._stuck.look(name, value, now_ns)
        if stuck:
            self.faults[name] = stuck
        else:
            self.faults.pop(name, None)
            self.values[name] = (value, instant_ns)

    def _take_axes(self, tracker: CountTracker, counts: list[int], instant_ns: int, now_ns: int) -> None:
        """Positions in counts, if the machine can have moved so far. A line of text has no check sum of its own."""
        try:
            values = tracker.update(counts, instant_ns, now_ns)
        except DriverFault as e:
            self.faults["axes"] = str(e)
            return
        self.faults.pop("axes", None)
        for name, value in zip(self._axes, values, strict=True):
            self.faults.pop(name, None)
            self.values[name] = (value, instant_ns)
