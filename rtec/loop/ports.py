"""What a driver can be: a few small capabilities (seam 1 of the architecture).

A device is one object with one or more of these. Its construction validates the options and touches no hardware.
Entering it (`with`) opens it; leaving holds, then closes. No call here blocks for longer than the device's own
configured timeout.
"""

from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Final, Protocol, Self, runtime_checkable

from rtec.arrays import Floats, Ints
from rtec.correction.sinks import Sink
from rtec.wording import TO_RESUME

HOLDS: Final = f"the correction holds until it is ordered to resume ({TO_RESUME})"
"""What a device adds to the reason why it waits, as `Resumable.must_resume` gives it."""


class Device(Protocol):
    """Opens on entry, holds and closes on exit."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class AlwaysOpen:
    """For a device with nothing to open and nothing to hold, such as a file that is read again each time."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass


@runtime_checkable
class CountSource(Protocol):
    """Reads the axes' raw encoder counts (x4, before any insertion), all latched at one instant."""

    def read_counts(self, counts: Ints) -> int:
        """Fill `counts` (one element an axis, in the machine's axis order); give the instant of latching, ns.

        Raises:
            DriverTimeout, DriverFault: no fresh value; `counts` is then unchanged.
        """
        ...


@runtime_checkable
class Incremental(Protocol):
    """A count source that counts from where the axes stand when it gets its supply, and that tells its starts."""

    @property
    def supply(self) -> int:
        """Number of its start: differs after every start; -1 where it is not known yet. Reads memory only."""
        ...


@runtime_checkable
class TemperatureSource(Protocol):
    """Reads temperature sensors."""

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill `degc` (°C) and `time_ns` (instant of acquisition), one element a sensor, in the machine's order.

        A sensor without a new reading keeps its old value and its old time; the guard judges the age. Good values are
        filled in before an error is raised: the arrays are valid after an error, too.

        Raises:
            DriverError: what is wrong with some of the sensors, or with the device.
        """
        ...


@runtime_checkable
class SpindleSource(Protocol):
    """Reads the spindle speed."""

    def read_spindle(self) -> float:
        """Give the spindle speed, 1/min, signed."""
        ...


@runtime_checkable
class Actuator(Protocol):
    """Puts the correction into the machine: an encoder box, a controller's offset register, a D/A converter."""

    def refuses(self, sink: Sink) -> str:
        """Why it does not accept this kind of output, or outputs of this unit; "" where it does.

        Counts in an offset register, or units of another size, would increase the error: this is checked before a run.
        """
        ...

    def apply(self, output: Ints) -> None:
        """Command the absolute output of every axis in the actuator's own units (for pulses: inserted counts).

        Absolute and idempotent: a lost or repeated call loses nothing.
        """
        ...

    def read_output(self, output: Ints) -> None:
        """Fill `output` with the output that the device itself reports (its own ledger), in the same units.

        A device that cannot report it fills in the last command, and is a `OneWay` too.

        Raises:
            DriverUnavailable: it has not reported yet.
        """
        ...

    def hold(self) -> None:
        """Keep the last output until the next command; called when the loop ends, however it ends."""
        ...


class NoActuator:
    """No actuator: tables alone correct (`[table]`). Accepts every call and does nothing; its output is zero."""

    def refuses(self, sink: Sink) -> str:
        """Refuse nothing."""
        del sink
        return ""

    def apply(self, output: Ints) -> None:
        """Do nothing: the loop's correction is off."""

    def read_output(self, output: Ints) -> None:
        """Leave `output` at zero: nothing is inserted."""
        output[:] = 0

    def hold(self) -> None:
        """Do nothing."""


@runtime_checkable
class OneWay(Protocol):
    """An actuator that cannot report its output, and keeps it between runs: an offset register, a D/A converter."""

    def was_told(self, output: Ints) -> None:
        """Take over an earlier run's last command at the start; `read_output` gives it from then on. Sends nothing."""
        ...


@runtime_checkable
class Ranged(Protocol):
    """An actuator that knows, once it is open, how much it takes: a run that could ask for more is refused."""

    @property
    def most_um(self) -> Sequence[float]:
        """The largest output of each axis, in the machine's order, µm."""
        ...


@runtime_checkable
class Resumable(Protocol):
    """Stops by itself after a fault, such as a box that restarted or a lost position; goes on when ordered."""

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not. Reads memory only."""
        ...

    def resume(self) -> None:
        """Accept the next reading as it is: counts and ledger. Does not wait.

        The caller takes over the ledger (`Actuator.read_output`) before the next command.
        """
        ...


class Scanner(Protocol):
    """Scans a port or bus for numbers, before a file says where they are. It reads, and commands nothing.

    A driver's class that can scan has a class method `scanner(table, clock)`; `table` has the known keys of the
    device's table: port, or interface and channel. Entering opens, leaving closes.

    Attributes:
        duration: of `search`, in words that follow "takes".
    """

    duration: str

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def search(self) -> Iterator[tuple[float, str]]:
        """Scan step by step; yield the fraction done, 0 to 1, and the newest match in plain words, or "".

        Matches stay valid when the caller stops early.

        Raises:
            DriverUnavailable: the port or bus is gone.
        """
        ...

    def read(self) -> dict[str, float]:
        """The newest numbers as the device reports them, by place; a place is in words that a person can look up."""
        ...

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """A guess at the place of each of these axes or sensors; empty where the matches allow none."""
        ...

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """The keys of the device's table that read each axis or sensor at its place.

        Args:
            places: by axis or sensor.
            unit: °C per count of a temperature; axes ignore it.
        """
        ...
