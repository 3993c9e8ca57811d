"""Sample and command: the two records that drivers and the loop exchange, and that fill a log.

Both are held as blocks of n rows, one array a field (structure of arrays), so that the loop (n = 1), a replay
(n = many), the shared-memory ring and the Arrow log use the same memory layout without conversion.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Floats, Ints
from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON

NEVER_NS: Final = -(2**62)
"""Instant of counts that no device has given yet; stale on any clock."""
MODES_BY_NAME = {"off": MODE_OFF, "on": MODE_ON, "hold": MODE_HOLD}


@dataclass(frozen=True)
class Layout:
    """The axes and sensors behind the columns, in the machine's order."""

    axes: tuple[str, ...]
    sensors: tuple[str, ...]


@dataclass(frozen=True)
class Field:
    """One field of a record. `width` None: one number a row; else a vector of that length a row."""

    name: str
    dtype: type[np.generic]
    width: int | None

    def shape(self, n: int) -> tuple[int, ...]:
        """Shape of the array that holds this field for n rows."""
        return (n,) if self.width is None else (n, self.width)

    @property
    def bytes_per_row(self) -> int:
        """Bytes that this field takes in one row."""
        return int(np.dtype(self.dtype).itemsize) * (1 if self.width is None else self.width)


class _Block:
    """Rows of a record; every dataclass field is an array whose first axis is the row."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays by field name, in the order of the record."""
        return dict(vars(self))

    def rows(self, start: int, stop: int) -> Self:
        """A view of some rows; nothing is copied."""
        return type(self)(*[array[start:stop] for array in vars(self).values()])

    def singles(self) -> Iterator[Self]:
        """Each row as a block of one."""
        return (self.rows(i, i + 1) for i in range(len(self)))

    def copy(self) -> Self:
        """A block with memory of its own."""
        return type(self)(**{name: array.copy() for name, array in self.arrays().items()})


@dataclass(frozen=True)
class Samples(_Block):
    """What was read: n rows.

    Attributes:
        time_ns: the loop's instant, monotonic clock.
        mode: the ordered MODE_OFF, MODE_ON or MODE_HOLD of this cycle; MODE_TAKEN_OVER where the ledger was taken over.
        counts_time_ns: instant at which the counts were latched.
        counts: raw counts after x4, (n, axes).
        degc: temperatures, °C, (n, sensors); NaN where a sensor has given none yet.
        degc_time_ns: their instants of acquisition, (n, sensors).
        spindle_rpm: spindle speed, 1/min, signed; NaN where not known.
    """

    time_ns: Ints
    mode: NDArray[np.int8]
    counts_time_ns: Ints
    counts: Ints
    degc: Floats
    degc_time_ns: Ints
    spindle_rpm: Floats

    @staticmethod
    def fields_of(layout: Layout) -> tuple[Field, ...]:
        """The fields of a sample on a machine with these axes and sensors."""
        a, s = len(layout.axes), len(layout.sensors)
        return (
            Field("time_ns", np.int64, None),
            Field("mode", np.int8, None),
            Field("counts_time_ns", np.int64, None),
            Field("counts", np.int64, a),
            Field("degc", np.float64, s),
            Field("degc_time_ns", np.int64, s),
            Field("spindle_rpm", np.float64, None),
        )

    @classmethod
    def empty(cls, layout: Layout, n: int) -> Self:
        """N rows of zeros."""
        return cls(**{f.name: np.zeros(f.shape(n), f.dtype) for f in cls.fields_of(layout)})


@dataclass(frozen=True)
class Commands(_Block):
    """What was sent: n rows, one for each sample.

    Attributes:
        requested_um: correction that the model asks for, µm along each axis, (n, axes).
        applied_um: correction after the guard, µm, (n, axes).
        output: absolute output in the sink's integer units (for pulses: inserted counts), (n, axes).
        flags: bits of `rtec.correction.flags.Flag`.
    """

    requested_um: Floats
    applied_um: Floats
    output: Ints
    flags: Ints

    @staticmethod
    def fields_of(layout: Layout) -> tuple[Field, ...]:
        """The fields of a command on a machine with these axes."""
        a = len(layout.axes)
        return (
            Field("requested_um", np.float64, a),
            Field("applied_um", np.float64, a),
            Field("output", np.int64, a),
            Field("flags", np.int64, None),
        )

    @classmethod
    def empty(cls, layout: Layout, n: int) -> Self:
        """N rows of zeros."""
        return cls(**{f.name: np.zeros(f.shape(n), f.dtype) for f in cls.fields_of(layout)})


@dataclass(frozen=True)
class StepState:
    """Memory of a step: plain numbers, safe to copy and to keep."""

    floats: Floats
    ints: Ints

    def copy(self) -> "StepState":
        """A state with memory of its own."""
        return StepState(self.floats.copy(), self.ints.copy())
