"""Evaluation of grid-encoder set-ups: each alone, and paths compared with each other.

Compared are set-ups (roll [XT 3], cross-talk [XT 4]), directions [XT 5] and feeds.

A difference between two paths of one set-up is free of the plate's zero, rotation and own errors, which are the same in
both. Between set-ups the plate was moved, so that only squareness is compared, which does not depend on its rotation.

An item's `chance` is its false-positive rate; `certain` corrects for all items of a list together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from rtec.errors import MeasurementError
from rtec.metrology.grid.paths import SAME_MM, TRIM_MM, Edge
from rtec.metrology.grid.setup import (
    COVERAGE,
    GridSetup,
    Item,
    analyse,
    angle_moving,
    arm_on,
    at_corner,
    curve_of,
    plate_um,
    range_of,
    same_feed,
    squareness_of,
)
from rtec.metrology.instruments.ball_bar import axis_along
from rtec.metrology.measurement import Measurement
from rtec.result import Result

SURE = 0.02
BESIDE = 0.05
"""A plate counts as moved along one direction if it moved in the others by less than this share."""
SAME_PART_MM = 2.0
"""Edges nearer than this cross the same part of the plate, as its own error changes slowly."""


def certain(items: Sequence[Item]) -> tuple[Item, ...]:
    """Significant items; the false-positive rate of a whole list is about 1 in 50."""
    tested = [i for i in items if np.isfinite(i.chance)]
    return tuple(i for i in tested if i.chance < SURE / len(tested))


def places(one: GridSetup, other: GridSetup) -> tuple[Item, ...]:
    """Differences between two places of the plate, first minus second.

    Moved along the normal: rotation of that axis about its own direction (roll). Moved in the plane: rotation of the
    moved axis where the chain gives it an arm on the other one (rigid body); else how the other axis' rotation depends
    on the position of the moved one (cross-talk). The moved axis' straightness between the two places is included.
    """
    squares = [squareness_of(s) for s in (one, other)]
    moved = moved_along(one, other)
    if one.setup.plane != other.setup.plane or squares[0] is None or squares[1] is None or len(moved) != 1:
        return ()
    name, means, unit, rigid = _named(one, moved[0])
    value, se = (squares[0][0] - squares[1][0]) / unit, float(np.hypot(squares[0][1], squares[1][1]))
    length_m = min(e.length_mm for s in (one, other) for k in (0, 1) for e in at_corner(s, k)) * 1e-3
    plate = [0.0 if _same_plate(one, other) else plate_um(s) * np.sqrt(2.0) / length_m for s in (one, other)]
    place = "XYZ".index(moved[0])
    where = f"{moved[0].lower()} {one.setup.origin_mm[place]:g} and {other.setup.origin_mm[place]:g}"
    u = COVERAGE * float(np.sqrt(se**2 + plate[0] ** 2 + plate[1] ** 2))
    return (Item(name, means, where, value, "µm/m", u, _chance(value, 0.5 * u), rigid),)


def moved_along(one: GridSetup, other: GridSetup) -> tuple[str, ...]:
    """Directions in which the plate was moved; small unintended moves in the others do not count."""
    apart = {d: abs(x - y) for d, x, y in zip("XYZ", one.setup.origin_mm, other.setup.origin_mm, strict=True)}
    least = max(SAME_MM, BESIDE * max(apart.values()))
    return tuple(d for d, way in apart.items() if way > least)


def not_compared(setups: Sequence[GridSetup]) -> tuple[str, ...]:
    """Pairs of set-ups in one plane that are not compared, and why, in words."""
    out = []
    for i, one in enumerate(setups):
        for other in setups[i + 1 :]:
            moved = moved_along(one, other)
            if one.setup.plane != other.setup.plane or len(moved) == 1:
                continue
            ways = f"moved along {' and '.join(moved)} at once, so no one axis' turn tells" if moved else "not moved"
            out.append(f"{one.name} and {other.name} are not compared: between them the plate was {ways}")
    return tuple(out)


def _same_plate(one: GridSetup, other: GridSetup) -> bool:
    """Whether both cross the same part of the same plate: then both contain its own error."""
    if not one.setup.plate or one.setup.plate != other.setup.plate:
        return False
    spans = []
    for s in (one, other):
        middle = [s.setup.origin_mm["XYZ".index(d)] for d in s.lean.letters]
        ends = [x - middle[k] for k in (0, 1) for e in at_corner(s, k)[:1] for x in (e.low_mm, e.high_mm)]
        beside = [e.beside_mm - middle[1 - k] for k in (0, 1) for e in at_corner(s, k)[:1]]
        spans.append(np.array([*ends, *beside]))
    return spans[0].shape == spans[1].shape and bool(np.abs(spans[0] - spans[1]).max() < SAME_PART_MM)


def directions(setup: GridSetup) -> tuple[Item, ...]:
    """Differences between the directions of motion: rotation [XT 5] from Ls, straightness and reversal from lines."""
    out = []
    for along in (0, 1):
        both = _two_ways(setup, along)
        if both is not None:
            out += _way_items(setup, along, *both)
        out += _turned_by_coming(setup, along)
    return tuple(out)


def feeds(setup: GridSetup, slow_mm_min: float | None = None, fast_mm_min: float | None = None) -> tuple[Item, ...]:
    """Differences between two feeds, fast minus slow; by default the fastest and the slowest feed."""
    known = sorted({round(e.feed_mm_min, 6) for e in setup.edges if np.isfinite(e.feed_mm_min)})
    slow, fast = slow_mm_min or (known[0] if known else 0.0), fast_mm_min or (known[-1] if known else 0.0)
    if same_feed(slow, fast):
        return ()
    out = []
    for along in (0, 1):
        pair = [at_corner(setup, along, f) for f in (fast, slow)]
        if not all(pair):
            continue
        out += _feed_items(setup, along, pair[0], pair[1], f"{fast:g} against {slow:g} mm/min")
        turned = [angle_moving(setup, along, f) for f in (fast, slow)]
        if turned[0] is not None and turned[1] is not None and arm_on(setup, along) != 0.0:
            value, se = turned[0][0] - turned[1][0], float(np.hypot(turned[0][1], turned[1][1]))
            name = f"E{setup.lean.turn}{setup.lean.axes[along]}(fast) - (slow)"
            means = f"the feed turns {setup.lean.axes[along]} about {setup.lean.normal} over its travel"
            where = range_of(setup, along, pair[0])
            out.append(Item(name, means, where, value, "µm/m", COVERAGE * se, _chance(value, se)))
    return tuple(out)


def _named(setup: GridSetup, moved: str) -> tuple[str, str, float, bool]:
    """The cause of a squareness difference: name, sentence, squareness per unit, and whether it is rigid."""
    lean = setup.lean
    if moved == lean.normal:
        axis = getattr(axis_along(setup.machine, moved), "name", moved)
        rigid = _square_of_turn(setup, axis)
        if abs(rigid) > 0.5:
            return f"E{lean.turn}{axis}", f"roll of {axis} between the two places", rigid, True
    else:
        along = lean.letters.index(moved)
        axis, other = lean.axes[along], lean.axes[1 - along]
        if arm_on(setup, along) != 0.0:
            means = f"{axis} turns about {lean.normal} between the two places"
            return f"E{lean.turn}{axis}", means, 1.0 if along == 0 else -1.0, True
        if arm_on(setup, 1 - along) != 0.0:
            means = (
                f"cross-talk: where {axis} stands turns {other} about {lean.normal} (no rigid body does that, unless "
                f"{axis}'s own line bends between the two places)"
            )
            return f"E{lean.turn}{other}({other.lower()}, {axis.lower()})", means, -1.0 if along == 0 else 1.0, False
    return (
        f"E{lean.turn}0{lean.axes[1]}({moved.lower()})",
        f"squareness of {lean.axes[1]} to {lean.axes[0]} changes with {moved}; no rigid body of this chain does that",
        1.0,
        False,
    )


def _square_of_turn(setup: GridSetup, axis: str) -> float:
    """Squareness in the plane for one unit of an axis' rotation about the normal, from the machine's chain."""
    lean, chain = setup.lean, setup.machine.chain
    name = f"E{lean.turn}{axis}"
    if name not in chain.components:
        return 0.0
    rows = ["XYZ".index(d) for d in lean.letters]
    columns = [1 + setup.machine.axis_names.index(a) for a in lean.axes]
    arms = chain.terms[:, chain.components.index(name)] * 1e3
    second = lean.signs[1] * float(arms[rows[0], columns[1]])
    return second - lean.signs[0] * float(arms[rows[1], columns[0]])


def _two_ways(setup: GridSetup, along: int) -> tuple[list[Edge], list[Edge]] | None:
    """Pieces with the same place, feed and length in both directions: positive ones, negative ones."""
    here = [e for e in setup.edges if e.along == along]
    for edge in here:
        alike = [e for e in here if _same_line(e, edge)]
        plus, minus = ([e for e in alike if e.way == w] for w in (1, -1))
        # Single lines first: the sides of a square have the other axis' corners at their ends.
        if plus and minus and not any(e.came for e in alike):
            return plus, minus
    for edge in here:
        alike = [e for e in here if _same_line(e, edge)]
        plus, minus = ([e for e in alike if e.way == w] for w in (1, -1))
        if plus and minus:
            return plus, minus
    return None


def _same_line(one: Edge, other: Edge) -> bool:
    return (
        abs(one.beside_mm - other.beside_mm) < SAME_MM
        and abs(one.low_mm - other.low_mm) < SAME_MM
        and abs(one.high_mm - other.high_mm) < SAME_MM
        and same_feed(one.feed_mm_min, other.feed_mm_min)
    )


def _way_items(setup: GridSetup, along: int, plus: list[Edge], minus: list[Edge]) -> list[Item]:
    axis, letter, other = setup.lean.axes[along], setup.lean.letters[along], setup.lean.letters[1 - along]
    where, plate, out = range_of(setup, along, plus), plate_um(setup), []
    for way, edges in (("+", plus), ("-", minus)):
        bow, se = curve_of(edges, across=True).bow_um
        means = f"straightness of {axis} going {way}, positive where the middle lies towards +{other}"
        u = COVERAGE * float(np.hypot(se, plate))
        out.append(Item(f"E{other}{axis}({axis.lower()}, {way})", means, where, bow, "µm", u))
    apart = curve_of(plus, across=True) - curve_of(minus, across=True)
    bow, se = apart.bow_um
    means = f"straightness of {axis} going + minus going -"
    chance = apart.chance(2, 3, 4, 5)
    out.append(Item(f"E{other}{axis}(+) - (-)", means, where, bow, "µm", COVERAGE * se, chance))
    level, se = (curve_of(plus, across=False) - curve_of(minus, across=False)).level_um
    means = f"reversal (backlash) of {axis}, mean over this travel"
    out.append(Item(f"E{letter}{axis}(+) - (-)", means, where, level, "µm", COVERAGE * se, _chance(level, se)))
    return out


def _turned_by_coming(setup: GridSetup, along: int) -> list[Item]:
    """[XT 5]: an L from both sides. The slope of the line after the corner depends on the approach before it.

    The plate does not move, so that the two lines are compared directly. [XT] aligns both by the lines before the
    corner, which removes the rotation where those lines rotate, too (with a table-side axis).
    """
    after = [e for e in setup.edges if e.along == along and e.came != 0]
    for edge in after:
        alike = [e for e in after if _same_line(e, edge) and e.way == edge.way]
        right, left = ([e for e in alike if e.came == w] for w in (1, -1))
        if right and left:
            line, se = (curve_of(right, across=True) - curve_of(left, across=True)).line_um
            factor = setup.lean.signs[along] * 1e3 / edge.length_mm
            before, value = setup.lean.axes[1 - along], line * factor
            name = f"E{setup.lean.turn}{before}(+) - (-)"
            means = f"{before} turns about {setup.lean.normal} with the direction in which it came"
            where = f"{setup.lean.letters[1 - along].lower()} {edge.beside_mm:g}"
            return [Item(name, means, where, value, "µm/m", COVERAGE * se * abs(factor), _chance(line, se))]
    return []


def _feed_items(setup: GridSetup, along: int, fast: list[Edge], slow: list[Edge], what: str) -> list[Item]:
    axis, letter, other = setup.lean.axes[along], setup.lean.letters[along], setup.lean.letters[1 - along]
    where, out = f"{range_of(setup, along, fast)}; {what}", []
    line, se = (curve_of(fast, across=False) - curve_of(slow, across=False)).line_um
    means = f"the feed changes how far {axis} goes"
    out.append(Item(f"E{letter}{axis}(fast) - (slow)", means, where, line, "µm", COVERAGE * se, _chance(line, se)))
    apart = curve_of(fast, across=True) - curve_of(slow, across=True)
    bow, se = apart.bow_um
    means = f"the feed bends the path of {axis} in {other}"
    name, chance = f"E{other}{axis}(fast) - (slow)", apart.chance(2, 3, 4, 5)
    out.append(Item(name, means, where, bow, "µm", COVERAGE * se, chance))
    level, se = apart.level_um
    means = f"the feed lifts the path of {axis} in {other}, mean over this travel"
    out.append(Item(f"{name}, mean", means, where, level, "µm", COVERAGE * se, _chance(level, se)))
    return out


def _chance(value: float, se: float) -> float:
    """Probability that noise alone gives as much, of either sign."""
    from scipy.special import erfc

    return float(erfc(abs(value) / max(se, 1e-15) / np.sqrt(2.0)))


@dataclass(frozen=True)
class GridComparison:
    """One comparison: heading, what was compared, and the items."""

    heading: str
    items: tuple[Item, ...]


@dataclass(frozen=True)
class GridEvaluation(Result):
    """Result of the evaluation of some set-ups.

    Attributes:
        setups: the set-ups, each with its own report.
        comparisons: between directions, feeds, and set-ups.
        found: significant items.
        magnification: magnification of the figures; None: a round number for each.
    """

    page_maker: ClassVar[str] = "rtec.report.grid:grid_page"

    setups: tuple[GridSetup, ...]
    comparisons: tuple[GridComparison, ...]
    found: tuple[Item, ...]
    magnification: float | None = None

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return {
            "setups": [
                {"name": s.name, "plane": s.setup.plane, "origin_mm": s.setup.origin_mm, "corner_mm": s.corner_mm,
                 "pieces": len(s.edges), "items": s.items}
                for s in self.setups
            ],
            "not_compared": not_compared(self.setups),
            "comparisons": [
                {"heading": c.heading, "items": c.items, "certain": [i.name for i in c.items if i in self.found]}
                for c in self.comparisons
            ],
        }  # fmt: skip

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """Every error of each set-up, then every difference, each with its significance."""
        own = [{"of": s.name, **asdict(i), "certain": None} for s in self.setups for i in s.items]
        compared = [(c.heading, i) for c in self.comparisons for i in c.items]
        return own + [{"of": heading, **asdict(i), "certain": i in self.found} for heading, i in compared]


def evaluate(
    measurements: Sequence[Measurement],
    corner_mm: tuple[float, float] | None = None,
    trim_mm: float = TRIM_MM,
    magnification: float | None = None,
) -> GridEvaluation:
    """Analyse set-ups and compare them.

    Raises:
        MeasurementError: as `analyse`, or set-ups on different machines.
    """
    setups = tuple(analyse(m, corner_mm, trim_mm) for m in measurements)
    for other in setups[1:]:
        if other.machine.hash != setups[0].machine.hash:
            raise MeasurementError(f"{other.name} and {setups[0].name} were made on different machines")
    compared = []
    for setup in setups:
        compared.append(GridComparison(f"{setup.name}: direction", directions(setup)))
        compared.append(GridComparison(f"{setup.name}: feed", feeds(setup)))
    for i, one in enumerate(setups):
        compared += [GridComparison(f"{one.name} minus {two.name}", places(one, two)) for two in setups[i + 1 :]]
    kept = tuple(c for c in compared if c.items)
    found = certain([item for c in kept for item in c.items])
    return GridEvaluation(setups, kept, found, magnification)
