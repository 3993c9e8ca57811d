"""One set-up of a grid encoder: squareness, linear deviation, straightness and pitch as in [XT Table 4].

Signs are those of `e = ε × p`. [XT 1] prints `-EB z` in e_x beside `-EB x` in e_z, which no rotation gives; here
`e_x = +EB z`. For a plane with letters a, b and the rotation R about its normal, an axis along b is inclined by
`σ_b · de_a/db`, one along a by `σ_a · de_b/da`, with `r × b = σ_b a` and `r × a = σ_a b`. The difference is the
squareness `ER0b`; the plate's own rotation is in both and cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.grid.paths import SAME_MM, TRIM_MM, Edge, EdgeCurve, edges_of, mean_curve
from rtec.metrology.instruments.ball_bar import axis_along
from rtec.metrology.instruments.grid_encoder import GridEncoder, GridEncoderSetup
from rtec.metrology.measurement import Measurement

COVERAGE = 2.0
FEED = 0.02
"""Feeds that differ by less than this share count as the same."""


@dataclass(frozen=True)
class Item:
    """One line of a report.

    Attributes:
        name: component error, with its dependence.
        means: explanation in a plain sentence.
        where: measured range.
        value: in `unit`.
        unit: in the spelling of reports.
        u: expanded uncertainty, coverage factor 2: repeatability of the readings, and the plate's own accuracy where
            that does not cancel.
        chance: probability that noise alone gives as much; NaN where it is not tested.
        rigid: whether it is a component error of the rigid-body model [XT 4.1].
    """

    name: str
    means: str
    where: str
    value: float
    unit: str
    u: float
    chance: float = float("nan")
    rigid: bool = False


@dataclass(frozen=True)
class Lean:
    """Names and signs of a plane.

    Attributes:
        letters: its two directions.
        normal: the third direction.
        turn: letter of the rotation about the normal.
        signs: σ_a, σ_b.
        axes: names of the axes along the two directions.
    """

    letters: tuple[str, str]
    normal: str
    turn: str
    signs: tuple[float, float]
    axes: tuple[str, str]


def lean_of(machine: Machine, setup: GridEncoderSetup) -> Lean:
    """Names and signs of a plane on a machine."""
    a, b = setup.letters
    unit = {d: np.eye(3)[i] for i, d in enumerate("XYZ")}
    normal = unit[setup.normal]
    signs = (float(np.cross(normal, unit[a]) @ unit[b]), float(np.cross(normal, unit[b]) @ unit[a]))
    names = tuple(getattr(axis_along(machine, d), "name", d) for d in (a, b))
    turn = dict(zip("XYZ", "ABC", strict=True))[setup.normal]
    return Lean((a, b), setup.normal, turn, signs, (names[0], names[1]))


def slowest(edges: Sequence[Edge]) -> float:
    """Lowest feed, NaN where none is recorded."""
    known = [e.feed_mm_min for e in edges if np.isfinite(e.feed_mm_min)]
    return min(known) if known else float("nan")


def same_feed(one: float, other: float) -> bool:
    """Whether two feeds are the same; feeds that are not recorded are."""
    return not (np.isfinite(one) and np.isfinite(other)) or abs(one - other) <= FEED * max(abs(one), abs(other))


@dataclass(frozen=True)
class GridSetup:
    """A set-up with its straight pieces.

    Attributes:
        name: name of the measurement.
        machine: the measured machine.
        setup: set-up of the instrument.
        lean: names and signs of the plane.
        edges: all straight pieces.
        corner_mm: corner at which the report's edges meet.
        items: the report.
    """

    name: str
    machine: Machine
    setup: GridEncoderSetup
    lean: Lean
    edges: tuple[Edge, ...]
    corner_mm: tuple[float, float]
    items: tuple[Item, ...]


def analyse(
    measurement: Measurement, corner_mm: tuple[float, float] | None = None, trim_mm: float = TRIM_MM
) -> GridSetup:
    """Report on one set-up.

    Args:
        measurement: a measurement with instrument grid_encoder.
        corner_mm: corner whose edges are reported; by default the start of the first edge.
        trim_mm: length that is trimmed at both ends of every straight piece.

    Raises:
        MeasurementError: the instrument is not a grid encoder, or there is no straight piece, or none at that corner.
    """
    edges = edges_of(measurement, trim_mm)
    instrument = measurement.instrument
    if not isinstance(instrument, GridEncoder):
        raise MeasurementError(f"{measurement.name}: this needs grid_encoder")
    lean = lean_of(measurement.machine, instrument.setup)
    corner = corner_mm or _first_corner(edges)
    out = GridSetup(measurement.name, measurement.machine, instrument.setup, lean, edges, corner, ())
    if not any(at_corner(out, along) for along in (0, 1)):
        raise MeasurementError(f"{measurement.name}: no edges meet at {corner[0]:g}, {corner[1]:g} mm")
    return replace(out, items=tuple(_items(out)))


def squareness_of(setup: GridSetup) -> tuple[float, float] | None:
    """`ER0b` at the corner, µrad, and its standard error; None where an edge is missing."""
    slopes = []
    for along in (0, 1):
        chosen = at_corner(setup, along)
        if not chosen:
            return None
        slopes.append(_slope(chosen, setup.lean.signs[along]))
    (first, first_se), (second, second_se) = slopes
    return second - first, float(np.hypot(first_se, second_se))


def at_corner(setup: GridSetup, along: int, feed_mm_min: float | None = None) -> list[Edge]:
    """Edges along one direction through the corner, both ways, at the lowest feed (or a given one)."""
    feed = slowest(setup.edges) if feed_mm_min is None else feed_mm_min
    here = [e for e in setup.edges if e.along == along and same_feed(e.feed_mm_min, feed)]
    longest = max((e.length_mm for e in here), default=0.0)
    place = setup.corner_mm[1 - along]
    return [e for e in here if abs(e.beside_mm - place) < SAME_MM and e.length_mm > longest - SAME_MM]


def plate_um(setup: GridSetup) -> float:
    """Standard uncertainty of a length on the plate, µm: its accuracy as a rectangular distribution."""
    return setup.setup.accuracy_um / float(np.sqrt(3.0))


def angle_of(setup: GridSetup, along: int) -> tuple[float, float] | None:
    """Rotation of the axis of one direction about the normal over its travel, µrad, and its standard error.

    A rotation by ε moves the place by `σ ε` times the distance along the other direction. A square shows it twice: the
    axis travels further on one side than on the other, and the sides across it have different slopes at its two ends.
    The result is the mean of both, weighted by their noise; where they differ by more than the noise, half of the
    excess is added to the standard error.
    """
    ways = (angle_moving(setup, along, slowest(setup.edges)), _by_lean(setup, along, slowest(setup.edges)))
    found = [w for w in ways if w is not None]
    if not found:
        return None
    weight = np.array([1.0 / max(se, 1e-12) ** 2 for _, se in found])
    values = np.array([v for v, _ in found])
    noise = float(np.sqrt(np.sum(1.0 / weight)))
    beyond = max(float(np.ptp(values)) - COVERAGE * noise, 0.0)
    return float(weight @ values / weight.sum()), float(np.hypot(1.0 / np.sqrt(weight.sum()), 0.5 * beyond))


def angle_moving(setup: GridSetup, along: int, feed: float) -> tuple[float, float] | None:
    """As `angle_of`, from the travel on both sides of a square alone.

    Nothing else shows a rotation that depends on the feed: on the sides across it this axis is at rest.
    """
    here = _longest([e for e in setup.edges if e.along == along and same_feed(e.feed_mm_min, feed)])
    low, high = min((e.beside_mm for e in here), default=0.0), max((e.beside_mm for e in here), default=0.0)
    if high - low < 10.0 * SAME_MM:
        return None
    sides = [mean_curve([e.own for e in here if abs(e.beside_mm - side) < SAME_MM]) for side in (low, high)]
    apart, se = (sides[1] - sides[0]).line_um
    factor = setup.lean.signs[1 - along] * 1e3 / (high - low)
    return apart * factor, se * abs(factor)


def _by_lean(setup: GridSetup, along: int, feed: float) -> tuple[float, float] | None:
    """As `angle_of`, from the slopes of the sides across it at both ends of its travel."""
    mine = _longest([e for e in setup.edges if e.along == along and same_feed(e.feed_mm_min, feed)])
    across = _longest([e for e in setup.edges if e.along != along and same_feed(e.feed_mm_min, feed)])
    if not mine:
        return None
    ends = [[e for e in across if abs(e.beside_mm - end) < SAME_MM] for end in (mine[0].low_mm, mine[0].high_mm)]
    if not all(ends):
        return None
    (first, first_se), (last, last_se) = (_slope(end, setup.lean.signs[1 - along]) for end in ends)
    return last - first, float(np.hypot(first_se, last_se))


def _longest(edges: Sequence[Edge]) -> list[Edge]:
    longest = max((e.length_mm for e in edges), default=0.0)
    return [e for e in edges if e.length_mm > longest - SAME_MM]


def range_of(setup: GridSetup, along: int, edges: Sequence[Edge]) -> str:
    """Measured range in words."""
    return f"{setup.lean.letters[along].lower()} {min(e.low_mm for e in edges):g} … {max(e.high_mm for e in edges):g}"


def _items(setup: GridSetup) -> list[Item]:
    lean, plate = setup.lean, plate_um(setup)
    a, b = lean.letters
    out = []
    square = squareness_of(setup)
    if square is not None:
        length_m = min(e.length_mm for k in (0, 1) for e in at_corner(setup, k)) * 1e-3
        u = COVERAGE * float(np.hypot(square[1], plate * np.sqrt(2.0) / length_m))
        where = f"at {a.lower()} {setup.corner_mm[0]:g}, {b.lower()} {setup.corner_mm[1]:g}"
        means = f"squareness of {lean.axes[1]} to {lean.axes[0]}"
        out.append(Item(f"E{lean.turn}0{lean.axes[1]}", means, where, square[0], "µm/m", u))
    for along, letter in enumerate((a, b)):
        edges = at_corner(setup, along)
        if edges:
            out += _edge_items(setup, along, letter, edges)
    for along in (0, 1):
        turned = angle_of(setup, along)
        if turned is not None and arm_on(setup, along) != 0.0:
            edges = [e for e in setup.edges if e.along == along]
            length_m = edges[0].length_mm * 1e-3
            u = COVERAGE * float(np.hypot(turned[1], plate * np.sqrt(2.0) / length_m))
            name, where = f"E{lean.turn}{lean.axes[along]}", range_of(setup, along, edges)
            means = f"{lean.axes[along]} turns about {lean.normal} over this travel"
            out.append(Item(name, means, where, turned[0], "µm/m", u))
    return out


def _edge_items(setup: GridSetup, along: int, letter: str, edges: Sequence[Edge]) -> list[Item]:
    lean, plate, axis = setup.lean, plate_um(setup), setup.lean.axes[along]
    other = lean.letters[1 - along]
    where = range_of(setup, along, edges)
    line, line_se = mean_curve([e.own for e in edges]).line_um
    out = [
        Item(
            f"E{letter}{axis}", f"linear deviation of {axis}, positive where it moves too far", where, line, "µm",
            COVERAGE * float(np.hypot(line_se, plate)),
        )
    ]  # fmt: skip
    bow, bow_se = mean_curve([e.across for e in edges]).bow_um
    means = f"straightness of {axis}, positive where the middle lies towards +{other}"
    out.append(Item(f"E{other}{axis}", means, where, bow, "µm", COVERAGE * float(np.hypot(bow_se, plate))))
    return out


def arm_on(setup: GridSetup, along: int) -> float:
    """Displacement along this axis for a unit rotation about the normal, per metre of the other axis' travel.

    From the machine's chain; 0 where the other axis is not part of the arm: then a rigid rotation does not show.
    """
    lean, chain = setup.lean, setup.machine.chain
    name = f"E{lean.turn}{lean.axes[along]}"
    if name not in chain.components or lean.axes[1 - along] not in setup.machine.axis_names:
        return 0.0
    row = "XYZ".index(lean.letters[along])
    column = 1 + setup.machine.axis_names.index(lean.axes[1 - along])
    return float(chain.terms[row, chain.components.index(name), column]) * 1e3


def _slope(edges: Sequence[Edge], sign: float) -> tuple[float, float]:
    """Slope of some edges, µrad, as a rotation about the normal, and its standard error."""
    line, se = mean_curve([e.across for e in edges]).line_um
    length_m = edges[0].length_mm * 1e-3
    return sign * line / length_m, se / length_m


def _first_corner(edges: Sequence[Edge]) -> tuple[float, float]:
    first = edges[0]
    own = first.low_mm if first.way > 0 else first.high_mm
    return (own, first.beside_mm) if first.along == 0 else (first.beside_mm, own)


def curve_of(edges: Sequence[Edge], *, across: bool) -> EdgeCurve:
    """Mean curve of some edges along or across them."""
    return mean_curve([e.across if across else e.own for e in edges])
