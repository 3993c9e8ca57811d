"""Coverage: the positions of the axes at which a component was read.

A polynomial diverges beyond its readings and in gaps between them, the faster the higher its degree; therefore the
places at which a component was read limit the degree.

The travels of two axes are divided into thirds. A component of one axis that changes with the other is a candidate if
all nine cells were visited while the first axis moved. Otherwise the missing cells are reported, because a product of
polynomials is not determined there [XT 2].
"""

import itertools
from collections.abc import Sequence

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.characterise.result import Warn
from rtec.estimation.gram.source import Source, reads
from rtec.estimation.visible import moves
from rtec.machine import Axis
from rtec.metrology.instruments.grid_encoder import GridEncoder

PARTS = 3
LEAST = 5
"""Smallest number of readings for a cell to count as visited."""
SPEEDS = 1.5
"""Smallest ratio of largest to smallest speed for which an error may depend on the speed."""

GROWS = 10.0
"""Largest factor by which an error of a polynomial may grow from the readings to the ends of the travel."""
SAME_MM = 0.02
"""Readings nearer than this to each other are at one place."""


def places_mm(sources: Sequence[Source], component: str, axis: Axis) -> Floats:
    """Places of an axis at which a component was read while the axis moved, rising, mm; empty where it did not."""
    mine = [
        s.measurement.channels[axis.channel]
        for s in sources
        if reads(s, component) and moves(s.measurement, axis) and axis.channel in s.measurement.channels
    ]
    return np.asarray(np.unique(np.round(np.concatenate(mine) / SAME_MM)) * SAME_MM) if mine else np.zeros(0)


def highest_degree(places: Floats, axis: Axis) -> int:
    """Highest degree of a polynomial over the travel that readings at some places, mm, determine.

    The least of three limits. At the ends of the travel the Chebyshev polynomial, which grows fastest of all that are
    within -1 … 1 over the readings, is at most `GROWS`. Of n evenly spaced places, least squares of a degree above
    2 √n oscillates between them (Boyd and Xu 2009, Rakhmanov 2007); n counts the widest gap as the spacing. A
    polynomial has fewer degrees than there are places.
    """
    span = float(np.ptp(places)) if len(places) else 0.0
    if span <= 0.0:
        return 0
    end = max(abs(2.0 * (q - places[0]) / span - 1.0) for q in axis.travel_mm)
    by_ends = np.arccosh(GROWS) / np.arccosh(end) if end > 1.0 + 1e-9 else np.inf
    by_gaps = 2.0 * np.sqrt(span / float(np.diff(places).max()) + 1.0)
    return int(min(by_ends, by_gaps, len(places) - 1))


def visited_cells(sources: Sequence[Source], axis: Axis, other: Axis) -> Bools:
    """Whether each pair of thirds of two axes' travels was visited, (3 of the axis, 3 of the other)."""
    count = np.zeros((PARTS, PARTS), dtype=np.int64)
    for source in sources:
        if moves(source.measurement, axis):
            poses = source.state.positions_mm()
            machine = source.measurement.machine
            part = [_part(poses[:, machine.axes.index(a)], a) for a in (axis, other)]
            np.add.at(count, (part[0], part[1]), 1)
    return np.asarray(count >= LEAST)


def followed(sources: Sequence[Source], component: str, axis: Axis, other: Axis) -> bool:
    """Whether the measurements that read a component of an axis cover it together with another axis."""
    return bool(visited_cells([s for s in sources if reads(s, component)], axis, other).all())


def several_speeds(sources: Sequence[Source], component: str, axis: Axis) -> bool:
    """Whether an axis moved at several speeds, and all measurements that read its component recorded the speed."""
    mine = [s for s in sources if reads(s, component)]
    going = _known_rate(mine, axis, axis.velocity_channel)
    return bool(len(going)) and float(np.quantile(going, 0.98)) > SPEEDS * float(np.quantile(going, 0.02))


def accelerated(sources: Sequence[Source], component: str, axis: Axis) -> bool:
    """Whether an axis was read under acceleration, and all measurements that read its component recorded it."""
    return bool(len(_known_rate([s for s in sources if reads(s, component)], axis, axis.acceleration_channel)))


def _known_rate(sources: Sequence[Source], axis: Axis, channel: str) -> Floats:
    """Absolute values of a velocity or acceleration that are not zero; empty where a measurement did not record it."""
    known = [s.rate(axis, channel) for s in sources]
    whole = np.abs(np.concatenate([v for v in known if v is not None] or [np.zeros(0)]))
    return whole[whole > 0.0] if all(v is not None for v in known) else np.zeros(0)


def cover_warnings(sources: Sequence[Source]) -> list[Warn]:
    """Warnings where too few grid-plate positions cover one axis over another, and where to place further plates."""
    plates = [s for s in sources if isinstance(s.measurement.instrument, GridEncoder)]
    if not plates:
        return []
    machine, out = plates[0].measurement.machine, []
    for axis, other in itertools.permutations(machine.axes, 2):
        mine = [s for s in plates if moves(s.measurement, axis)]
        cells = visited_cells(mine, axis, other)
        if mine and not cells.all():
            said = f"{int(cells.sum())} of the {PARTS * PARTS} thirds of {axis.name} and {other.name}"
            text = (
                f"the errors of {axis.name} were not followed over {other.name}: grid set-ups were in {said}; whether "
                f"they change with {other.name} was not asked of them"
            )
            out.append(Warn("not_covered", text, _places(cells, axis, other)))
    return out


def _places(cells: Bools, axis: Axis, other: Axis) -> str:
    """Centres of plates that would visit the missing cells."""
    missing = [(float(_middle(axis, i)), float(_middle(other, j))) for i, j in np.argwhere(~cells)]
    a, b = axis.channel, other.channel
    said = "; ".join(f"{a} {p:g}, {b} {q:g}" for p, q in missing)
    return f"lay the plate in a plane of {axis.name} with its middle at ({said}) mm, or near"


def _middle(axis: Axis, part: int) -> float:
    low, high = axis.travel_mm
    return round(low + (part + 0.5) * (high - low) / PARTS, 1)


def _part(position_mm: Floats, axis: Axis) -> Ints:
    low, high = axis.travel_mm
    return np.clip(((position_mm - low) / (high - low) * PARTS).astype(np.int64), 0, PARTS - 1)
