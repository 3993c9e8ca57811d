"""What a driver can be: three small capabilities (seam 1 of the architecture).

A device is one object with one or more of these. Constructing it validates its options and touches no
hardware; entering it (`with`) opens; leaving holds, then closes. Nothing here blocks for longer than the
device's own configured timeout.
"""

from types import TracebackType
from typing import Protocol, Self, runtime_checkable

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

        A sensor without a new reading keeps its old value and its old time; the guard judges the age.
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

        A device that cannot say fills in what it was last told.
        """
        ...

    def hold(self) -> None:
        """Keep the last output until told otherwise; called when the loop ends, however it ends."""
        ...
