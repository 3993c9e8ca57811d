"""What a driver can be: a few small capabilities (seam 1 of the architecture).

A device is one object with one or more of these. Constructing it validates its options and touches no
hardware; entering it (`with`) opens; leaving holds, then closes. Nothing here blocks for longer than the
device's own configured timeout.
"""

from collections.abc import Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rtec.correction.sinks import Sink

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]


class Device(Protocol):
    """Opens on entry, holds and closes on exit."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class AlwaysOpen:
    """For a device with nothing to open and nothing to hold, such as a file that is read anew each time."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass


@runtime_checkable
class CountSource(Protocol):
    """Reads the axes' raw encoder counts (x4, before any insertion), all latched at one instant."""

    def read_counts(self, counts: IntArray) -> int:
        """Fill `counts` (one entry an axis, in the machine's axis order); give the instant of latching, ns.

        Raises:
            DriverTimeout, DriverFault: no fresh value; `counts` is then left as it was.
        """
        ...


@runtime_checkable
class TemperatureSource(Protocol):
    """Reads temperature sensors."""

    def read_temperatures(self, degc: FloatArray, time_ns: IntArray) -> None:
        """Fill `degc` (°C) and `time_ns` (instant of acquisition), one entry a sensor, in the machine's order.

        A sensor without a new reading keeps its old value and its old time; the guard judges the age. What is good is
        filled in first, then what is wrong is raised: the arrays hold after an error too.

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
    """Puts the correction into the machine: an encoder box, a controller's offset register, a D/A."""

    def refuses(self, sink: Sink) -> str:
        """Say why it cannot take this kind of output, or outputs of this unit; "" where it can.

        Counts put into a register, or units of another size, would make the error larger: asked before anything runs.
        """
        ...

    def apply(self, output: IntArray) -> None:
        """Command the absolute output of every axis in the actuator's own units (for pulses: inserted counts).

        Absolute and idempotent: a lost or repeated call loses nothing.
        """
        ...

    def read_output(self, output: IntArray) -> None:
        """Fill `output` with what the device itself says is applied (its own ledger), in the same units.

        A device that cannot say fills in what it was last told, and is a `OneWay` too.

        Raises:
            DriverUnavailable: it has not said yet.
        """
        ...

    def hold(self) -> None:
        """Keep the last output until told otherwise; called when the loop ends, however it ends."""
        ...


class NoActuator:
    """In place of an actuator where tables alone correct (`[table]`): the loop commands nothing, and has nothing."""

    def refuses(self, sink: Sink) -> str:
        """Refuse nothing."""
        del sink
        return ""

    def apply(self, output: IntArray) -> None:
        """Do nothing: the loop's correction is off."""

    def read_output(self, output: IntArray) -> None:
        """Nothing is inserted."""
        output[:] = 0

    def hold(self) -> None:
        """Do nothing."""


@runtime_checkable
class OneWay(Protocol):
    """An actuator that cannot say what it has, and keeps it while nobody is there: an offset register, a D/A."""

    def was_told(self, output: IntArray) -> None:
        """Learn at the start what an earlier run told it last; `read_output` says so from then on. Sends nothing."""
        ...


@runtime_checkable
class Resumable(Protocol):
    """Stops by itself where it would guess: a box that started anew, a position that was lost. Goes on when ordered."""

    @property
    def must_resume(self) -> str:
        """Why it waits for an order to resume; "" where it does not. Looks at nothing but memory."""
        ...

    def resume(self) -> None:
        """Take what the device says next as it stands: its counts, its ledger. Waits for nothing.

        Whoever orders it takes over the ledger (`Actuator.read_output`) before the next command.
        """
        ...


class Scanner(Protocol):
    """Looks on a port or bus for numbers, before a file says where they are. It reads, and commands nothing.

    A driver's class that can look has a class method `scanner(table, clock)`; `table` is what is known of the device's
    table by then: its port, or interface and channel. Entering opens, leaving closes.

    Attributes:
        duration: of `search`, in words that follow "takes".
    """

    duration: str

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def search(self) -> Iterator[tuple[float, str]]:
        """Look step by step; give the share that is done, and what was found just now in plain words, or "".

        What was found stays found when nobody asks for the next step.

        Raises:
            DriverUnavailable: the port or bus is gone.
        """
        ...

    def read(self) -> dict[str, float]:
        """The newest numbers as the device has them, by their places: in words that a person can look up."""
        ...

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """A guess at the place of each of these axes or sensors; empty where what was found allows none."""
        ...

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """The keys of the device's table that read each axis or sensor at its place.

        Args:
            places: by axis or sensor.
            unit: °C that a temperature's number 1 is worth; axes take no notice.
        """
        ...
