"""Straight pieces of a path on a grid plate, each with the smooth curves of its two readings.

The positions may be rounded, jitter, or be closer together than both. Along a piece, `u` from -1 to +1, each reading is
a sum of Legendre polynomials. The reported numbers follow from the coefficients: twice the first one is the deviation
of the best-fit line over the piece, the higher ones give the straightness, and one matrix gives the standard errors.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.errors import MeasurementError
from rtec.metrology.instruments.grid_encoder import GridEncoder, GridEncoderSetup
from rtec.metrology.measurement import Measurement
from rtec.metrology.procedures.fitting import correlation_time

EXACT_MM = 1e-6
STEP_MM = 0.1
"""Distance between the points at which the direction of a path is determined: far above the rounding and jitter of a
display or an encoder, far below the trimmed length."""
STRAIGHT = 5.0
"""A path is straight along a direction if it moves this many times farther along it than along the other one."""


def straight_pieces(place: Floats) -> Iterator[tuple[int, int, int, int]]:
    """Letter, direction of motion, first and last row of each straight piece with one direction of motion.

    The path is sampled every `STEP_MM`, or at every reading where those are farther apart.
    """
    looks = _looks(place)
    if len(looks) < 2:
        return
    step = np.diff(place[:, looks], axis=1)
    far = np.abs(step)
    which = np.where(far[0] > STRAIGHT * far[1], 0, np.where(far[1] > STRAIGHT * far[0], 1, -1))
    way = np.where(np.where(which == 1, step[1], step[0]) > 0.0, 1, -1)
    label = np.where(which >= 0, 3 * which + way, -9)
    starts = np.flatnonzero(np.diff(label, prepend=-8) != 0)
    for first, last in zip(starts, [*starts[1:], len(label)], strict=True):
        along = int(which[first])
        if along < 0:
            continue
        across = place[1 - along]
        begin, end = _to_corners(across, looks, int(first), int(last))
        if np.ptp(across[begin : end + 1]) < STEP_MM:
            yield along, int(way[first]), begin, end


def _looks(place: Floats) -> Ints:
    """Rows that are `STEP_MM` along the path after the previous one in the list."""
    out = [0]
    first, second = (p.tolist() for p in place)
    for row, (u, v) in enumerate(zip(first, second, strict=True)):
        here = out[-1]
        if abs(u - first[here]) > STEP_MM - EXACT_MM or abs(v - second[here]) > STEP_MM - EXACT_MM:
            out.append(row)
    return np.array(out, dtype=np.int64)


def _to_corners(across: Floats, looks: Ints, first: int, last: int) -> tuple[int, int]:
    """First and last row of a piece, extended to the corners, which may be between two samples."""
    begin, end = int(looks[first]), int(looks[last])
    beside = float(np.median(across[begin : end + 1]))
    lowest = int(looks[first - 1]) if first else 0
    highest = int(looks[last + 1]) if last + 1 < len(looks) else len(across)
    while begin - 1 > lowest and abs(across[begin - 1] - beside) < STEP_MM / STRAIGHT:
        begin -= 1
    while end + 1 < highest and abs(across[end + 1] - beside) < STEP_MM / STRAIGHT:
        end += 1
    return begin, end


DEGREE = 5
TRIM_MM = 2.0
"""Trimmed at both ends: braking and vibration at a corner are not geometry."""
LEAST = 12
SAME_MM = 0.5


@dataclass(frozen=True)
class EdgeCurve:
    """A smooth curve over a piece, µm: coefficients of Legendre polynomials, (6,), and their covariance, µm²."""

    coefficients: Floats
    covariance: Floats

    def __sub__(self, other: "EdgeCurve") -> "EdgeCurve":
        return EdgeCurve(self.coefficients - other.coefficients, self.covariance + other.covariance)

    @property
    def line_um(self) -> tuple[float, float]:
        """Deviation of the best-fit line over the piece, end minus start, and its standard error."""
        return 2.0 * float(self.coefficients[1]), 2.0 * float(np.sqrt(self.covariance[1, 1]))

    @property
    def level_um(self) -> tuple[float, float]:
        """Mean, and its standard error."""
        return float(self.coefficients[0]), float(np.sqrt(self.covariance[0, 0]))

    def at(self, u: Floats) -> Floats:
        """Values, µm, at places -1 … +1."""
        return np.asarray(_legendre(u) @ self.coefficients, dtype=np.float64)

    @property
    def bow_um(self) -> tuple[float, float]:
        """Straightness: range about the best-fit line, and its standard error.

        Positive where the middle lies further in the positive direction than the ends.
        """
        u = np.linspace(-1.0, 1.0, 201)
        basis = _legendre(u)[:, 2:]
        curve = basis @ self.coefficients[2:]
        high, low = int(np.argmax(curve)), int(np.argmin(curve))
        middle = np.abs(u) < 0.5
        sign = 1.0 if curve[middle].mean() >= curve[~middle].mean() else -1.0
        away = basis[high] - basis[low]
        return sign * float(curve[high] - curve[low]), float(np.sqrt(away @ self.covariance[2:, 2:] @ away))

    def chance(self, *orders: int) -> float:
        """Probability that noise alone gives coefficients as large as these (chi-squared)."""
        from scipy.special import chdtrc

        c = self.coefficients[list(orders)]
        size = float(c @ np.linalg.solve(self.covariance[np.ix_(orders, orders)], c))
        return float(chdtrc(len(orders), size))


@dataclass(frozen=True)
class Edge:
    """One straight piece; its places rise from the low to the high end.

    Attributes:
        along: 0: along the plane's first letter, 1: the second.
        way: direction of motion, -1 or +1.
        low_mm, high_mm: ends of the piece.
        beside_mm: position of the other axis.
        came: direction of the other axis' last motion in the same run, 0 where there was none.
        feed_mm_min: feed; NaN where it is not recorded.
        run: run number.
        place_mm, readings_um: raw, (n,) and (2, n): the plane's first and second reading.
        curves: curves of the first and second reading.
    """

    along: int
    way: int
    low_mm: float
    high_mm: float
    beside_mm: float
    came: int
    feed_mm_min: float
    run: int
    place_mm: Floats
    readings_um: Floats
    curves: tuple[EdgeCurve, EdgeCurve]

    @property
    def length_mm(self) -> float:
        """Length of the piece."""
        return self.high_mm - self.low_mm

    @property
    def own(self) -> EdgeCurve:
        """Positioning: the reading along it."""
        return self.curves[self.along]

    @property
    def across(self) -> EdgeCurve:
        """The reading across it."""
        return self.curves[1 - self.along]


def edges_of(measurement: Measurement, trim_mm: float = TRIM_MM) -> tuple[Edge, ...]:
    """Every straight piece along one of the plane's directions, in order of time.

    Raises:
        MeasurementError: the instrument is not a grid encoder, positions are missing, or there is no such piece.
    """
    name, instrument = measurement.name, measurement.instrument
    if not isinstance(instrument, GridEncoder):
        raise MeasurementError(f"{name}: instrument is {instrument.name}; this needs grid_encoder")
    place = places_mm(measurement, instrument.setup)
    out: list[Edge] = []
    for number in np.unique(measurement.run):
        rows = np.flatnonzero(measurement.run == number)
        came = [0, 0]
        for along, way, first, last in straight_pieces(place[:, rows]):
            edge = _edge(measurement, place, rows[first : last + 1], along, way, came[1 - along], trim_mm)
            came[along] = way
            if edge is not None:
                out.append(edge)
    if not out:
        a, b = instrument.setup.letters
        raise MeasurementError(
            f"{name}: no straight piece along {a} or {b} with {LEAST} readings and {4.0 * trim_mm:g} mm; the positions "
            f"go over {np.ptp(place[0]):.4g} mm along {a} and {np.ptp(place[1]):.4g} mm along {b}. Are they those of "
            f"the path, in mm?"
        )
    return tuple(out)


def places_mm(measurement: Measurement, setup: GridEncoderSetup) -> Floats:
    """Commanded place in the plane, (2, n).

    Raises:
        MeasurementError: no axis along one of its directions is recorded.
    """
    out = []
    for letter in setup.letters:
        moved = [a.channel for a in measurement.machine.axes if a.direction == letter]
        found = [measurement.channels[c] for c in moved if c in measurement.channels]
        if not found:
            columns = " or ".join(f"{c}_mm" for c in moved) or f"an axis along {letter}"
            raise MeasurementError(f"{measurement.name}: {columns} is missing; a grid needs where it was commanded")
        out.append(np.sum(found, axis=0))
    return np.stack(out)


def mean_curve(curves: Sequence[EdgeCurve]) -> EdgeCurve:
    """Mean of several curves."""
    n = len(curves)
    whole = np.sum([c.coefficients for c in curves], axis=0) / n
    return EdgeCurve(whole, np.sum([c.covariance for c in curves], axis=0) / n**2)


def _edge(
    measurement: Measurement, place: Floats, rows: Ints, along: int, way: int, came: int, trim_mm: float
) -> Edge | None:
    own = place[along, rows]
    low, high = float(own.min()), float(own.max())
    readings = np.stack([measurement.readings[c][rows] for c in measurement.instrument.columns()])
    inside = (own > low + trim_mm - EXACT_MM) & (own < high - trim_mm + EXACT_MM)
    keep = inside & np.isfinite(readings).all(axis=0)
    if keep.sum() < LEAST or high - low < 4.0 * trim_mm:
        return None
    u = (2.0 * own[keep] - low - high) / (high - low)
    feed = measurement.channels.get("feed_mm_min")
    order = np.argsort(u)
    curves = tuple(_curve(u[order], r[order]) for r in readings[:, keep])
    beside = float(np.median(place[1 - along, rows]))
    return Edge(
        along, way, low, high, beside, came, float("nan") if feed is None else float(np.median(feed[rows])),
        int(measurement.run[rows[0]]), own[keep], readings[:, keep], (curves[0], curves[1]),
    )  # fmt: skip


def _curve(u: Floats, reading: Floats) -> EdgeCurve:
    """Least-squares curve; the readings are in the order of `u`."""
    basis = _legendre(u)
    found = np.asarray(np.linalg.lstsq(basis, reading, rcond=None)[0], dtype=np.float64)
    left = reading - basis @ found
    free = max(len(u) - basis.shape[1], 1)
    power = float(left @ left) / free * correlation_time(left)
    # Even constant readings have noise: that of the resolution.
    inverse = np.asarray(np.linalg.inv(basis.T @ basis), dtype=np.float64)
    return EdgeCurve(found, max(power, 1e-12) * inverse)


def _legendre(u: Floats) -> Floats:
    return np.asarray(np.polynomial.legendre.legvander(u, DEGREE), dtype=np.float64)
