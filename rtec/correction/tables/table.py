"""A compensation table without a format: errors at points along an axis, both directions; and what a format takes."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class CompensationTable:
    """Position errors along one axis, actual minus nominal.

    Attributes:
        axis: that moves.
        corrects: axis whose position is wrong; the same, but in a table between two axes (straightness, squareness).
        positions_mm: (n,), rising.
        forward_um, backward_um: (n,), error where the axis arrived in positive and in negative direction.
        at: what it was made for: temperatures by sensor, °C, positions of other axes, mm; empty where not known.
    """

    axis: str
    corrects: str
    positions_mm: Floats
    forward_um: Floats
    backward_um: Floats
    at: Mapping[str, float] = field(default_factory=dict)

    def error_um(self, positions_mm: Floats, direction: float) -> Floats:
        """Error at any positions, µm: straight between the points, constant beyond the ends."""
        return np.interp(positions_mm, self.positions_mm, self.forward_um if direction > 0 else self.backward_um)

    @property
    def largest_um(self) -> float:
        """Largest error of either direction, µm."""
        return float(max(np.abs(self.forward_um).max(), np.abs(self.backward_um).max()))


@dataclass(frozen=True)
class TableLimits:
    """What a format can hold.

    Attributes:
        most_points: of one table.
        both_directions: has it a value for each direction?
        between_axes: can the axis that moves and the one that is corrected differ?
        even_steps: must the points be at even distances?
        quantum_um: smallest step of a value, µm.
        largest_um: largest value, µm; None: no limit is known.
    """

    most_points: int
    both_directions: bool
    between_axes: bool
    even_steps: bool
    quantum_um: float
    largest_um: float | None = None

    def refuses(self, table: CompensationTable) -> str:
        """Say why a table cannot be written; "" where it can."""
        n = len(table.positions_mm)
        if not 2 <= n <= self.most_points:
            return f"takes 2 to {self.most_points} points, the table has {n}: choose another --grid"
        if table.axis != table.corrects and not self.between_axes:
            return f"has no tables between axes: {table.corrects} cannot be corrected along {table.axis}"
        steps = [b - a for a, b in pairwise(table.positions_mm.tolist())]
        if self.even_steps and max(steps) - min(steps) > 1e-6 * max(steps):
            return "takes points at even distances only"
        if self.largest_um is not None and table.largest_um > self.largest_um:
            return f"takes values up to {self.largest_um:g} µm, the table has {table.largest_um:.1f} µm"
        return ""

    def held(self, table: CompensationTable) -> CompensationTable:
        """Give the table as the format holds it: rounded, and the mean of both directions where it has one value."""

        def rounded(values: Floats) -> Floats:
            return np.rint(values / self.quantum_um) * self.quantum_um

        forward, backward = table.forward_um, table.backward_um
        if not self.both_directions:
            forward = backward = 0.5 * (forward + backward)
        return CompensationTable(
            table.axis, table.corrects, table.positions_mm, rounded(forward), rounded(backward), table.at
        )


class TableFormat(Protocol):
    """A maker's format: its limits, a writer and a reader."""

    @property
    def title(self) -> str:
        """Controller and file, for people."""
        ...

    @property
    def sign(self) -> str:
        """The sign of its values, in words."""
        ...

    @property
    def use(self) -> str:
        """How the controller is told of the file."""
        ...

    @property
    def limits(self) -> TableLimits:
        """What it can hold."""
        ...

    def text(self, table: CompensationTable) -> str:
        """Write a table that `limits` does not refuse."""
        ...

    def read(self, text: str, source: str, axis: str) -> CompensationTable:
        """Read a table of an axis.

        Raises:
            ConfigError: what is wrong, with the line.
        """
        ...


def rising(positions_mm: Floats, source: str) -> Floats:
    """Give positions that rise.

    Raises:
        ConfigError: they do not, or there are fewer than two.
    """
    if len(positions_mm) < 2:
        raise ConfigError(f"{source}: {len(positions_mm)} points; a table has at least two")
    falls = np.flatnonzero(np.diff(positions_mm) <= 0)
    if len(falls):
        k = int(falls[0]) + 1
        raise ConfigError(f"{source}: point {k + 1}, {positions_mm[k]:g} mm, does not lie beyond the one before")
    return positions_mm
