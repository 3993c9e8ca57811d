"""A compensation table in no maker's format: errors at points along an axis, both directions; and formats' limits."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Final, Literal, NamedTuple, Protocol

import numpy as np

from rtec.arrays import Floats
from rtec.errors import ConfigError

NO_PLACES: Floats = np.zeros(0)
LARGEST_FILE: Final = 4 << 20
"""Bytes; four times the largest table of any format."""
UNTRIED = "not tried on a control"
"""In the first line of every file of a format that no control has read from rtec."""
Grid = Literal["travel", "steps", "origin", "powers"]
"""Where a format has its points, at a distance d: even over the travel, d at most; from the low end in steps of d;
at the multiples of d, with position 0; from the low end in steps of 1 µm times a power of two, d at most."""


@dataclass(frozen=True)
class HeatLine:
    """Effect of one °C of one sensor on the errors along an axis, as a straight line.

    Attributes:
        sensor: its name.
        reference_mm: position of `offset_um`.
        offset_um: at that position, µm/°C.
        slope_um_per_m: µm/m·°C.
        residual_um: largest difference between the model and the line, µm/°C.
    """

    sensor: str
    reference_mm: float
    offset_um: float
    slope_um_per_m: float
    residual_um: float


@dataclass(frozen=True)
class CompensationTable:
    """Position errors along one axis, or over the plane of two, actual minus nominal.

    Where the corrected axis does not move itself, the errors are relative to those at the middle of the travel of the
    axes that move: the table adds to one of the corrected axis, which has those.

    Attributes:
        axis: axis that moves.
        corrects: axis whose position is wrong; the same axis, except in a table between axes (straightness,
            squareness).
        positions_mm: (n,), rising.
        forward_um, backward_um: (n,), error after arrival in positive and in negative direction; in a plane (m, n), one
            row for each position of the second axis.
        at: conditions of the prediction: temperatures by sensor, °C, positions of other axes, mm; empty where unknown.
        second: in a plane the other axis that moves; else "".
        second_mm: (m,), rising; empty where there is none.
        heat: effect of the temperatures, for controls that add it themselves.
        others: other tables in the file that it was read from.
        zero_um: constant that is not in the values, as a format with a zero has none.
    """

    axis: str
    corrects: str
    positions_mm: Floats
    forward_um: Floats
    backward_um: Floats
    at: Mapping[str, float] = field(default_factory=dict)
    second: str = ""
    second_mm: Floats = field(default_factory=lambda: NO_PLACES)
    heat: tuple[HeatLine, ...] = ()
    others: int = 0
    zero_um: float = 0.0

    def error_um(self, positions_mm: Floats, direction: float, second_mm: float = 0.0) -> Floats:
        """Error at any positions, µm: linear between the points, constant beyond the ends.

        Args:
            positions_mm: (k,).
            direction: above 0: after arrival in positive direction.
            second_mm: position of the second axis, in a plane.
        """
        values = self.forward_um if direction > 0 else self.backward_um
        if self.second:
            values = np.array([np.interp(second_mm, self.second_mm, column) for column in values.T])
        return np.interp(positions_mm, self.positions_mm, values)

    def at_points_of(self, other: "CompensationTable", direction: float) -> Floats:
        """Error at the points of another table, µm, in its shape."""
        if not other.second:
            return self.error_um(other.positions_mm, direction)
        return np.stack([self.error_um(other.positions_mm, direction, y) for y in other.second_mm.tolist()])

    @property
    def largest_um(self) -> float:
        """Largest error of either direction, µm."""
        return float(max(np.abs(self.forward_um).max(), np.abs(self.backward_um).max()))

    @property
    def what(self) -> str:
        """The axis, or the error and the axis along which it is, for people."""
        if self.second:
            return f"{self.corrects} over {self.axis} and {self.second}"
        return self.axis if self.axis == self.corrects else f"{self.corrects} along {self.axis}"

    @property
    def made_for(self) -> str:
        """Temperatures and positions of the prediction, in one line; "" where they are unknown."""
        return ", ".join(f"{name} = {value:g}" for name, value in self.at.items())


@dataclass(frozen=True)
class TableLimits:
    """Limits of a format.

    Attributes:
        most_points: largest number of points of a table; of a plane the product.
        both_directions: has it a value for each direction?
        takes: only one axis, only two different axes, both of these, or a plane of two.
        even_steps: must the points be at even distances?
        quantum_um: smallest step of a value, µm.
        largest_um: largest value, µm; None: no limit is known.
        grid: where its points are.
        zero: a value that must be 0: that of position 0, that of the first point, or none.
        typed: is it a list that a person types in, not a file that a control reads?
        adds_heat: can the control add a straight line for each temperature itself?
    """

    most_points: int
    both_directions: bool
    takes: Literal["own", "between", "either", "plane"]
    even_steps: bool
    quantum_um: float
    largest_um: float | None = None
    grid: Grid = "travel"
    zero: Literal["", "origin", "first"] = ""
    typed: bool = False
    adds_heat: bool = False

    def refuses(self, table: CompensationTable) -> str:
        """Why a table cannot be written; "" where it can."""
        n, m = len(table.positions_mm), len(table.second_mm) if table.second else 2
        points = n * m if table.second else n
        if min(n, m) < 2 or points > self.most_points:
            return f"takes 2 to {self.most_points} points, the table has {points}: choose another --grid"
        if self.takes == "plane" and not table.second:
            return "has tables over two axes only: write --cross EZXY for the error of Z over X and Y"
        if self.takes != "plane" and table.second:
            return f"has no tables over two axes: {table.corrects} cannot be corrected over {table.axis}{table.second}"
        if self.takes == "own" and table.axis != table.corrects:
            return f"has no tables between axes: {table.corrects} cannot be corrected along {table.axis}"
        if self.takes == "between" and table.axis == table.corrects:
            return f"has tables between two axes only: write --cross, as EY{table.axis} for the error of Y"
        for places in (table.positions_mm, table.second_mm):
            steps = [b - a for a, b in pairwise(places.tolist())]
            if self.even_steps and steps and max(steps) - min(steps) > 1e-6 * max(steps):
                return "takes points at even distances only"
        if self.largest_um is not None and table.largest_um > self.largest_um:
            return f"takes values up to {self.largest_um:g} µm, the table has {table.largest_um:.1f} µm"
        return ""

    def held(self, table: CompensationTable, quantum_um: float | None = None) -> CompensationTable:
        """The table as the format holds it: rounded, with its zero, with one value where both directions share it.

        Args:
            table: any table.
            quantum_um: step of this table, where it differs from the format's.
        """
        step = quantum_um or self.quantum_um
        forward, backward = table.forward_um, table.backward_um
        if not self.both_directions:
            forward = backward = 0.5 * (forward + backward)
        plain = self.zeroed(replace(table, forward_um=forward, backward_um=backward))
        forward, backward = (np.rint(values / step) * step for values in (plain.forward_um, plain.backward_um))
        return replace(plain, forward_um=forward, backward_um=backward)

    def zeroed(self, table: CompensationTable) -> CompensationTable:
        """The table without the constant that the format cannot hold."""
        if not self.zero:
            return table
        place = 0.0 if self.zero == "origin" else float(table.positions_mm[0])
        directions = (1.0,) if self.both_directions else (1.0, -1.0)
        shift = float(np.mean([table.error_um(np.array([place]), d) for d in directions]))
        forward, backward = table.forward_um - shift, table.backward_um - shift
        return replace(table, forward_um=forward, backward_um=backward, zero_um=table.zero_um + shift)


class TableAxes(NamedTuple):
    """Names: axis that moves, axis whose position is wrong, and in a plane the other axis that moves (else "")."""

    moves: str
    corrects: str
    second: str = ""


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
        """How the controller learns of the file."""
        ...

    @property
    def limits(self) -> TableLimits:
        """Limits of the format."""
        ...

    def refuses(self, table: CompensationTable) -> str:
        """Why a table cannot be written; "" where it can."""
        return self.limits.refuses(table)

    def held(self, table: CompensationTable) -> CompensationTable:
        """The table as the format holds it."""
        return self.limits.held(table)

    def text(self, table: CompensationTable) -> str:
        """Write a table as it is held; `refuses` must accept it."""
        ...

    def read(self, text: str, source: str, axes: TableAxes) -> CompensationTable:
        """Read a table.

        Args:
            text: content of the file.
            source: path of the file, for messages.
            axes: axes of the table; a file that names others is refused.

        Raises:
            ConfigError: what is wrong, with the line.
        """
        ...


def rising(positions_mm: Floats, source: str) -> Floats:
    """Check that positions rise, and return them.

    Raises:
        ConfigError: they do not rise, or there are fewer than two.
    """
    if len(positions_mm) < 2:
        raise ConfigError(f"{source}: {len(positions_mm)} points; a table has at least two")
    falls = np.flatnonzero(np.diff(positions_mm) <= 0)
    if len(falls):
        k = int(falls[0]) + 1
        raise ConfigError(f"{source}: point {k + 1}, {positions_mm[k]:g} mm, does not lie beyond the one before")
    return positions_mm


def end(comment: str) -> str:
    """The last line of a file that rtec writes, so that a truncated file is recognised."""
    return f"{comment} end"


def whole(text: str, source: str, comment: str) -> None:
    """Check that a file which rtec wrote has its last line.

    Raises:
        ConfigError: it is missing.
    """
    ours = any(line.startswith(comment) and UNTRIED in line for line in text.splitlines()[:5])
    if ours and text.rstrip().rpartition("\n")[2] != end(comment):
        raise ConfigError(f"{source}: without its last line {end(comment)!r}: is the file cut off?")


def table_text(path: Path) -> str:
    """Read a file of a control: UTF-8, or the Latin-1 letters that older controls write.

    Raises:
        FileNotFoundError: the file does not exist.
        ConfigError: it is no plain file, is too large for a table, or cannot be read.
    """
    if path.exists() and not path.is_file():  # opening a FIFO would wait for a writer
        raise ConfigError(f"{path}: cannot be read as a table: it is no plain file")
    try:
        with path.open("rb") as file:
            data = file.read(LARGEST_FILE + 1)
    except FileNotFoundError:
        raise
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read as a table: {e.strerror}") from e
    if len(data) > LARGEST_FILE:
        raise ConfigError(f"{path}: cannot be read as a table: it has more than {LARGEST_FILE >> 20} MB")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def number(text: str, source: str, line: int) -> float:
    """A finite number of a table.

    Raises:
        ConfigError: it is not a number, or beyond 100 m (in mm), which no table has.
    """
    try:
        value = float(text.replace("\N{MINUS SIGN}", "-").replace("\N{EN DASH}", "-"))
    except ValueError:
        value = np.nan
    if not abs(value) < 1e5:
        raise ConfigError(f"{source}: line {line}: {text[:30]!r} is no number of a table")
    return value


def same_axis(name: str, axis: str, source: str, line: int) -> None:
    """Check that a name in a file, as X1 or "Y-ACHSE", can be that of an axis.

    Raises:
        ConfigError: it is the letter of another axis.
    """
    letter = re.match(r"([XYZUVWABC])(?![A-Za-z])", name.strip("() ").upper())
    if letter and letter[1] != axis[:1].upper():
        raise ConfigError(
            f"{source}: line {line}: {name[:30]!r} is another axis than {axis}: is it the table of {axis}?"
        )
