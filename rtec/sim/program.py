"""A small reader of part programs, and the table of moves for the controller's interpolator.

Supported are G0 G1 G2 G3 G4, G17-G19, S, M3 M4 M5. One block a line. Axis words are absolute, mm (X is a radius, not a
diameter); F is mm/min; arcs have their centre by I J K relative to the start; G4 waits P seconds. Comments: `( … )` and
`; …`. `M2` and `M30` end the program.

Every move starts and ends at rest with constant acceleration between (trapezoidal speed along the path). A row's
columns are named below; the last `2 · axes` are start and displacement of every axis. Times are in servo ticks, whole
numbers, so that a program repeats without a remainder.
"""

import math
import re
from dataclasses import dataclass, field

import numpy as np

from rtec.arrays import Floats
from rtec.errors import ConfigError

(
    START,
    END,
    LENGTH,
    SPEED,
    ACCELERATION,
    RPM,
    ARC,
    AXIS_I,
    AXIS_J,
    CENTRE_I,
    CENTRE_J,
    RADIUS,
    ANGLE,
    SWEEP,
    POSITIONS,
) = range(15)


@dataclass(frozen=True)
class Arc:
    """Turn about a centre in the plane of two axes: from axis i towards axis j is positive."""

    axis_i: int
    axis_j: int
    centre_mm: tuple[float, float]
    radius_mm: float
    angle_rad: float
    sweep_rad: float


@dataclass(frozen=True)
class Move:
    """One block of a program: a line, an arc (with straight motion of other axes) or a wait.

    Attributes:
        start_mm, end_mm: (axes,).
        feed_mm_s: highest speed along the path.
        wait_s: duration of a dwell.
        rpm: spindle speed from here on, signed, 1/min.
    """

    start_mm: tuple[float, ...]
    end_mm: tuple[float, ...]
    feed_mm_s: float
    wait_s: float
    rpm: float
    arc: Arc | None = None

    @property
    def length_mm(self) -> float:
        """Length of the path."""
        step = [b - a for a, b in zip(self.start_mm, self.end_mm, strict=True)]
        if self.arc is None:
            return math.hypot(*step)
        step = [d for k, d in enumerate(step) if k not in (self.arc.axis_i, self.arc.axis_j)]
        return math.hypot(self.arc.radius_mm * self.arc.sweep_rad, *step)


def table_of(moves: list[Move], axes: int, acceleration_mm_s2: float, period_s: float) -> Floats:
    """Rows for the interpolator, (moves, 15 + 2·axes)."""
    out = np.zeros((len(moves), POSITIONS + 2 * axes))
    tick = 0
    for row, move in zip(out, moves, strict=True):
        length = move.length_mm
        speed = min(move.feed_mm_s, math.sqrt(length * acceleration_mm_s2))
        seconds = length / speed + speed / acceleration_mm_s2 if length > 0 else move.wait_s
        row[START], tick = tick, tick + math.ceil(seconds / period_s - 1e-9)
        row[END:ARC] = tick, length, speed, acceleration_mm_s2, move.rpm
        if move.arc is not None:
            a = move.arc
            row[ARC:POSITIONS] = 1, a.axis_i, a.axis_j, *a.centre_mm, a.radius_mm, a.angle_rad, a.sweep_rad
        row[POSITIONS : POSITIONS + axes] = move.start_mm
        row[POSITIONS + axes :] = np.subtract(move.end_mm, move.start_mm)
    return out


WORD = re.compile(r"([A-Z])\s*([-+]?(?:\d+\.?\d*|\.\d+))")
COMMENT = re.compile(r"\([^)]*\)|;.*")
PLANES = {17: "XY", 18: "ZX", 19: "YZ"}
MOTIONS = (0, 1, 2, 3)
ALLOWED = "G0 G1 G2 G3 G4 G17 G18 G19 M2 M3 M4 M5 M30 S F P I J K"
RADIUS_TOLERANCE_MM = 0.002


@dataclass
class ProgramReader:
    """Reads a program for axes of these names; modal words hold until another block changes them.

    Attributes:
        axes: names; a program can use those of one letter.
        travel_mm: lowest and highest position of each axis.
        position_mm: position of the tool after the blocks read so far.
        rapid_mm_s: speed of G0.
        rpm: spindle speed at the start, signed.
    """

    axes: tuple[str, ...]
    travel_mm: tuple[tuple[float, float], ...]
    position_mm: tuple[float, ...]
    rapid_mm_s: float
    rpm: float = 0.0
    moves: list[Move] = field(default_factory=list)
    _motion: int | None = None
    _plane: str = ""
    _feed_mm_s: float = 0.0
    _speed_rpm: float = 0.0
    _sense: int = 0

    def __post_init__(self) -> None:
        self._plane = next(p for p in ("XY", "ZX", "YZ", "") if set(p) <= set(self.axes))
        self._speed_rpm = abs(self.rpm)
        self._sense = (self.rpm > 0) - (self.rpm < 0)

    def read(self, text: str) -> list[Move]:
        """The moves of a program.

        Raises:
            ConfigError: a line is wrong; the message has its number, its text and what is allowed.
        """
        for number, line in enumerate(text.splitlines(), 1):
            try:
                if self._block(_words(line)):
                    break
            except ValueError as e:
                raise ConfigError(f"program line {number} {line.strip()!r}: {e}") from e
        return self.moves

    def go_back(self, to_mm: tuple[float, ...]) -> list[Move]:
        """All moves so far, followed by a rapid move to a position."""
        self.moves.append(Move(self.position_mm, to_mm, self.rapid_mm_s, 0.0, self.rpm))
        self.position_mm = to_mm
        return self.moves

    def _block(self, words: list[tuple[str, float]]) -> bool:
        """Execute one block; True at the end of the program."""
        values = {letter: value for letter, value in words if letter not in "GM"}
        unknown = sorted(set(values) - set("SFPIJK") - set(self.axes))
        if unknown:
            raise ValueError(f"unknown word {unknown[0]}; allowed: {ALLOWED} and axes {' '.join(self.axes)}")
        dwell = False
        for number in (_whole(v) for letter, v in words if letter == "G"):
            dwell |= number == 4
            self._preparatory(number)
        if values.get("F", 1.0) <= 0:
            raise ValueError("F must be above zero, mm/min")
        self._feed_mm_s = values["F"] / 60.0 if "F" in values else self._feed_mm_s
        ends = self._spindle(words, values)
        if dwell:
            self._wait(values.get("P", 0.0))
        elif set(values) & {*self.axes, *"IJK"}:
            self._move(values)
        return ends

    def _preparatory(self, number: int) -> None:
        if number in MOTIONS:
            self._motion = number
        elif number in PLANES:
            if not set(PLANES[number]) <= set(self.axes):
                raise ValueError(f"G{number} is the plane {PLANES[number]}; this machine has {' '.join(self.axes)}")
            self._plane = PLANES[number]
        elif number != 4:
            raise ValueError(f"unknown word G{number}; allowed: {ALLOWED}")

    def _spindle(self, words: list[tuple[str, float]], values: dict[str, float]) -> bool:
        self._speed_rpm = values.get("S", self._speed_rpm)
        ends = False
        for number in (_whole(v) for letter, v in words if letter == "M"):
            if number in (3, 4, 5):
                self._sense = {3: 1, 4: -1, 5: 0}[number]
            elif number in (2, 30):
                ends = True
            else:
                raise ValueError(f"unknown word M{number}; allowed: {ALLOWED}")
        if self.rpm != self._sense * self._speed_rpm:
            self.rpm = self._sense * self._speed_rpm
            self._wait(0.0)
        return ends

    def _wait(self, seconds: float) -> None:
        if seconds < 0:
            raise ValueError("P must not be below zero, s")
        self.moves.append(Move(self.position_mm, self.position_mm, 1.0, seconds, self.rpm))

    def _move(self, values: dict[str, float]) -> None:
        if self._motion is None:
            raise ValueError("an axis word without G0, G1, G2 or G3")
        end = tuple(values.get(name, here) for name, here in zip(self.axes, self.position_mm, strict=True))
        for k, value in enumerate(end):
            self._check_travel(k, value)
        feed = self.rapid_mm_s if self._motion == 0 else self._feed_mm_s
        if feed <= 0:
            raise ValueError("no feed yet; F gives mm/min")
        arc = self._arc(end, values) if self._motion in (2, 3) else None
        self.moves.append(Move(self.position_mm, end, feed, 0.0, self.rpm, arc))
        self.position_mm = end

    def _check_travel(self, axis: int, value_mm: float) -> None:
        low, high = self.travel_mm[axis]
        if not low <= value_mm <= high:
            raise ValueError(f"{self.axes[axis]} {value_mm:g} mm is outside the travel, {low:g} to {high:g} mm")

    def _arc(self, end: tuple[float, ...], values: dict[str, float]) -> Arc:
        if not self._plane:
            raise ValueError("an arc needs two axes of X Y Z")
        i, j = (self.axes.index(letter) for letter in self._plane)
        to_centre = [values.get("IJK"["XYZ".index(letter)], 0.0) for letter in self._plane]
        start = self.position_mm
        centre = (start[i] + to_centre[0], start[j] + to_centre[1])
        radius = math.hypot(*to_centre)
        other = math.hypot(end[i] - centre[0], end[j] - centre[1])
        if radius == 0 or abs(radius - other) > RADIUS_TOLERANCE_MM:
            raise ValueError(f"radius is {radius:g} mm at the start and {other:g} mm at the end of the arc")
        first = math.atan2(start[j] - centre[1], start[i] - centre[0])
        last = math.atan2(end[j] - centre[1], end[i] - centre[0])
        sense = 1.0 if self._motion == 3 else -1.0
        sweep = sense * ((sense * (last - first) - 1e-9) % (2 * math.pi) + 1e-9)
        for axis, ends in zip((i, j), _reach(centre, radius, first, sweep), strict=True):
            for value in ends:
                self._check_travel(axis, value)
        return Arc(i, j, centre, radius, first, sweep)


def _reach(
    centre: tuple[float, float], radius: float, first: float, sweep: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lowest and highest position of both axes along an arc."""
    low, high = min(first, first + sweep), max(first, first + sweep)
    quarters = range(math.ceil(low / (math.pi / 2)), math.floor(high / (math.pi / 2)) + 1)
    angles = [low, high, *(q * math.pi / 2 for q in quarters)]
    firsts = [centre[0] + radius * math.cos(a) for a in angles]
    seconds = [centre[1] + radius * math.sin(a) for a in angles]
    digits = 9  # rounds, as the sine of π is not quite zero
    return (round(min(firsts), digits), round(max(firsts), digits)), (
        round(min(seconds), digits),
        round(max(seconds), digits),
    )


def _words(line: str) -> list[tuple[str, float]]:
    text = COMMENT.sub(" ", line.upper()).strip()
    if WORD.sub("", text).strip():
        raise ValueError(f"{WORD.sub('', text).strip()!r} is no word; a word is a letter and a number")
    return [(letter, float(number)) for letter, number in WORD.findall(text)]


def _whole(value: float) -> int:
    if value != int(value):
        raise ValueError(f"G and M words are whole numbers, found {value:g}")
    return int(value)
