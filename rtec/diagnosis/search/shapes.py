"""Shapes without a name: the part of the residual that any smooth or periodic law of one or two variables explains.

They show whether the best effect of the catalogue is good enough (adequacy). Where none is, they show on which
variables the error depends, whether smoothly or periodically, and with which period. Shapes are curves, surfaces,
waves, and waves that grow.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.diagnosis.search.screen import ABSORBED, Projected, norms
from rtec.estimation.candidates import real
from rtec.estimation.gls import bic_cost
from rtec.estimation.readings import Readings

LEVELS = 8
"""A variable with at most this many values gets a column for each level."""
MOVED = 0.1
"""Speeds that differ by less than this, in octaves, are equal."""


@dataclass(frozen=True)
class LocalPlace:
    """Place of a hump or a step.

    Attributes:
        form: hump or step.
        centre, width: in the unit of the variable.
    """

    form: Literal["hump", "step"]
    centre: float
    width: float

    def curve(self, value: Floats) -> Floats:
        """The hump or step over a variable, (m,)."""
        return local_curve(self.form, (value - self.centre) / self.width)


def local_curve(form: Literal["hump", "step"], u: Floats) -> Floats:
    """A hump or a step about zero, of width one."""
    return np.asarray(np.exp(-np.minimum(u * u, 50.0)) if form == "hump" else np.tanh(u))


@dataclass(frozen=True)
class Shape:
    """A smooth or periodic dependence of the readings on variables.

    Attributes:
        group: reading columns that it acts on, in words for people.
        over: its variables, by their names in `Ground.known`.
        fine: number of basis functions along each; of a periodic shape, the harmonics beyond the first or the powers of
            the variable that changes its height.
        period: of a periodic shape, in the unit of its first variable; None for a smooth one.
        place: of a hump or a step; None for anything else.
        more: places of the steps after the first, where there are several; all are as sharp.
    """

    group: str
    over: tuple[str, ...]
    fine: tuple[int, ...]
    period: float | None = None
    place: LocalPlace | None = None
    more: tuple[LocalPlace, ...] = ()

    @property
    def searched(self) -> int:
        """Number of non-linear parameters that were searched."""
        if self.more:
            return 1 + len(self.places)
        return 2 if self.place is not None else int(self.period is not None)

    @property
    def places(self) -> tuple[LocalPlace, ...]:
        """The place of a hump or a step, or those of several steps; empty for anything else."""
        return () if self.place is None else (self.place, *self.more)

    @property
    def variables(self) -> tuple[str, ...]:
        """Channel names."""
        return tuple(dict.fromkeys(map(plain_name, self.over)))

    @property
    def kind(self) -> Literal["smooth", "periodic", "steps"]:
        """Smooth, periodic, or several steps."""
        if self.more:
            return "steps"
        return "smooth" if self.period is None else "periodic"


def plain_name(variable: str) -> str:
    """Channel of a variable: |v_x| is derived from v_x."""
    return variable.strip("|")


class Ground:
    """Readings with the variables that shapes depend on.

    Attributes:
        readings: the readings.
    """

    def __init__(self, readings: Readings) -> None:
        self.readings = readings
        self._curves: dict[tuple[str, int], Floats] = {}
        self._blocks: dict[tuple[Shape, ...], tuple[Floats, Ints]] = {}

    @cached_property
    def known(self) -> Mapping[str, Floats]:
        """Variables of shapes, by name, (m,) each."""
        return variables(self.readings)

    @cached_property
    def groups(self) -> Mapping[str, Bools]:
        """Readings that belong together, by name, (m,) each."""
        return groups(self.readings)

    def columns(self, shape: Shape) -> Floats:
        """Columns of a shape, (m, k)."""
        mask = self.groups[shape.group][:, None]
        if shape.period is not None:
            return self._wave(shape) * mask
        if shape.place is not None:
            return np.stack([p.curve(self.known[shape.over[0]]) for p in shape.places], axis=1) * mask
        if len(shape.over) == 1:
            return self._curve(shape.over[0], shape.fine[0]) * mask
        one, two = (self._curve(name, fine) for name, fine in zip(shape.over, shape.fine, strict=True))
        cross = (one[:, :, None] * two[:, None, :]).reshape(len(one), -1)
        return np.concatenate([one, two, cross], axis=1) * mask

    def block(self, shapes: Sequence[Shape]) -> tuple[Floats, Ints]:
        """Columns of several shapes side by side, (m, columns), and how many each has, (shapes,).

        They are kept, for every noise weighs the same shapes.
        """
        key = tuple(shapes)
        if key not in self._blocks:
            self._blocks[key] = self._made(shapes)
        return self._blocks[key]

    def _made(self, shapes: Sequence[Shape]) -> tuple[Floats, Ints]:
        """Waves along one variable, humps and steps are computed together: there are hundreds."""
        one_kind = len({(s.group, s.over, s.place and s.place.form, s.period is None, s.fine) for s in shapes}) == 1
        if one_kind and not any(s.more for s in shapes):
            value, mask = self.known[shapes[0].over[0]][:, None], self.groups[shapes[0].group][:, None]
            places = [s.place for s in shapes if s.place is not None]
            if places:
                centre, width = np.array([[p.centre, p.width] for p in places]).T
                return local_curve(places[0].form, (value - centre) / width) * mask, np.ones(
                    len(places), dtype=np.int64
                )
            if shapes[0].period is not None and shapes[0].fine == (0,):
                angle = value * (2.0 * np.pi / np.array([s.period for s in shapes]))
                wave = np.stack([np.sin(angle), np.cos(angle)], axis=2).reshape(len(value), -1)
                return wave * mask, np.full(len(shapes), 2)
        columns = [self.columns(s) for s in shapes]
        return np.concatenate(columns, axis=1), np.array([c.shape[1] for c in columns])

    def _curve(self, name: str, fine: int) -> Floats:
        if (name, fine) not in self._curves:
            raw = curve(self.known[name], fine)
            self._curves[name, fine] = raw / np.maximum(np.abs(raw).max(axis=0), 1e-12)
        return self._curves[name, fine]

    def _wave(self, shape: Shape) -> Floats:
        angle = self.known[shape.over[0]] * (2.0 * np.pi / (shape.period or 1.0))
        wave = np.stack([f(k * angle) for k in range(1, shape.fine[0] + 2) for f in (np.sin, np.cos)], axis=1)
        if len(shape.over) == 1:
            return wave
        u = _unit(self.known[shape.over[1]])
        powers = np.stack([u**k for k in range(shape.fine[1] + 1)], axis=1)
        return np.asarray((wave[:, :, None] * powers[:, None, :]).reshape(len(u), -1))


def variables(readings: Readings) -> dict[str, Floats]:
    """Channels that vary and that every measurement recorded, by name, (m,) each; speeds whatever the way beside."""
    machine = readings.machine
    out: dict[str, Floats] = {}
    names = [a.channel for a in machine.axes] + [a.direction_channel for a in machine.axes]
    velocities = [a.velocity_channel for a in machine.axes]
    names += ["feed_mm_min", *velocities, "spindle_rpm", "load_kg", "force_n", *machine.sensor_names]
    for name in names:
        value = readings.channel(name)
        if np.isfinite(value).all() and np.ptp(value) > real(machine, name):
            out[name] = value
    if any(v in out for v in velocities):
        out.pop("feed_mm_min", None)
    out["time_s"] = readings.time_s
    speeds = {f"|{n}|": _octaves(out[n]) for n in velocities if n in out}
    return {**out, **{n: v for n, v in speeds.items() if np.ptp(v) > MOVED}}


def _octaves(velocity: Floats) -> Floats:
    """Speed without direction, on a logarithmic scale: effects of speed extend over decades of it."""
    speed = np.abs(velocity)
    least = max(float(np.quantile(speed, 0.05)), 1e-3 * float(speed.max()), 1e-9)
    return np.asarray(np.log2(np.maximum(speed, least)))


def groups(readings: Readings) -> dict[str, Bools]:
    """Reading columns that belong together: the same column of the same kind of set-up."""
    out: dict[str, Bools] = {}
    for s in readings.series:
        m = readings.measurements[s.source]
        what = m.instrument.component or " ".join(filter(None, (m.instrument.name, m.instrument.axis)))
        column = s.column.removeprefix("reading_").removesuffix("um").removesuffix("urad").strip("_")
        name = f"{what} {column}".strip()
        mask = out.setdefault(name, np.zeros(len(readings), dtype=bool))
        mask[s.part] = True
    return out


def _unit(value: Floats) -> Floats:
    """Scaled to -1 … +1."""
    span = float(np.ptp(value))
    return np.asarray(2.0 * (value - value.min()) / span - 1.0 if span > 0 else np.zeros_like(value))


def curve(value: Floats, count: int) -> Floats:
    """Smooth basis over a variable, without the constant, (m, ≤ count): natural splines on its quantiles."""
    places = np.unique(value)
    if len(places) <= min(count + 1, LEVELS):
        # A few levels, as of a spindle speed: one column for each but the first.
        return np.stack([(value == p).astype(np.float64) for p in places[1:]], axis=1)
    u = (value - places[0]) / (places[-1] - places[0])
    knots = np.unique(np.quantile(u, np.linspace(0.0, 1.0, count + 1)))
    columns = [u]
    last = _ramp(u, knots[-2], knots[-1])
    columns += [_ramp(u, k, knots[-1]) - last for k in knots[:-2]]
    whole = np.stack(columns, axis=1)
    return np.asarray(whole - whole.mean(axis=0))


def _ramp(u: Floats, knot: float, end: float) -> Floats:
    span = max(end - knot, 1e-9)
    return np.asarray((np.maximum(u - knot, 0.0) ** 3 - np.maximum(u - end, 0.0) ** 3) / span)


LINE, FINE, PLANE, LEAN = 6, 14, 4, 2
"""Number of basis functions of a curve over one variable, coarse and fine, and along each side of a surface over two
variables and of a simple surface."""
PAIRS = 8
"""Number of pairs of variables, the best by their tilted planes, that get a simple surface."""
DETAIL, BEND = 9, 2
"""Number of basis functions of a fine curve along a position, and of its change with another variable."""
OWN, OTHER = 2, 1
"""Powers of a wave's own position, or of another variable, that its height changes with."""
HARMONICS, EACH = (1, 3), 4
"""Harmonics beyond the first of a wave that is no sine, such as a sawtooth; and places for each of its numbers: of
fewer places many harmonics explain anything that comes again in every run."""
PERIODS = 240
CYCLES = (2.5, 0.2)
"""Fewest periods in the span; a period is longer than this many typical steps."""
PHASES = 8
"""Halvings of the step between two periods of the grid: what stays is a hundredth of a turn at the ends of the span."""
LEADERS = 6
"""Number of variables that surfaces over two combine."""
CHUNK = 96
"""Columns that are whitened together."""


@dataclass(frozen=True)
class Weighed:
    """A shape and the part of the readings that it explains.

    Attributes:
        shape: the shape.
        count: its numbers that the base does not absorb.
        explained: sum of squares beyond noise alone, in units of the noise variance.
        log_evidence: over the base alone.
    """

    shape: Shape
    count: int
    explained: float
    log_evidence: float


def all_shapes(ground: Ground, projected: Projected) -> list[Weighed]:
    """All shapes: curves, surfaces, waves, and waves that grow with another variable; best first."""
    out: list[Weighed] = []
    for group, mask in ground.groups.items():
        lines = weigh_all(ground, projected, _lines(group, ground))
        leaders = list(dict.fromkeys(w.shape.over[0] for w in lines))[:LEADERS]
        moving = [
            a.channel
            for a in ground.readings.machine.axes
            if a.channel in ground.known and np.ptp(ground.known[a.channel][mask]) > 0.0
        ]
        fine = [name for name in moving if _places(ground.known[name][mask]) >= FEWEST_PLACES]
        plain = weigh_all(ground, projected, _pairs(group, itertools.combinations(ground.known, 2), 1, 1))
        rich = [
            *_pairs(group, (w.shape.over for w in plain[:PAIRS]), LEAN, LEAN),
            *_pairs(group, _leading(ground, leaders), PLANE, PLANE),
            *_pairs(group, _along(ground, moving, leaders), DETAIL, BEND),
            *_pairs(group, itertools.combinations(fine, 2), DETAIL, DETAIL),
        ]
        out += [*lines, *plain, *weigh_all(ground, projected, rich), *_waves(ground, projected, group, moving)]
        for name in fine:
            out += [*_local(ground, projected, group, name), *_steps(ground, projected, group, name)]
    return sorted(out, key=lambda w: -w.log_evidence)


def weigh(projected: Projected, columns: Floats, searched: int = 0) -> tuple[int, float, float] | None:
    """Numbers, explained squares and log evidence of columns, (m, k); None where the base absorbs them.

    Args:
        projected: the readings, less the base.
        columns: in the unit of the readings, (m, k).
        searched: number of non-linear parameters that were searched.
    """
    white = projected.whitener(columns)
    found = _weigh(projected, norms(white)[None], projected.take_out(white).T[None])
    return found[0] and (found[0][0], found[0][1], found[0][2] - bic_cost(searched, len(white)))


def weigh_all(ground: Ground, projected: Projected, shapes: Iterable[Shape]) -> list[Weighed]:
    """Weigh shapes, several whitened at a time and those of equal width together; best first."""
    out: list[Weighed] = []
    for chunk in _chunks(shapes):
        columns, widths = ground.block(chunk)
        white = projected.whitener(columns)
        # Column-major memory: the columns of one shape are sliced together.
        before, left = norms(white), np.ascontiguousarray(projected.take_out(white).T)
        first = np.cumsum(widths) - widths
        for width in np.unique(widths):
            which = np.flatnonzero(widths == width)
            at = first[which][:, None] + np.arange(width)
            found = _weigh(projected, before[at], left[at])
            out += (_weighed(projected, chunk[i], f) for i, f in zip(which, found, strict=True) if f is not None)
    return sorted(out, key=lambda w: -w.log_evidence)


def _weighed(projected: Projected, shape: Shape, found: tuple[int, float, float]) -> Weighed:
    return Weighed(shape, found[0], found[1], found[2] - bic_cost(shape.searched, len(projected.left)))


def _chunks(shapes: Iterable[Shape]) -> Iterator[list[Shape]]:
    waiting: list[Shape] = []
    width = 0
    for shape in shapes:
        waiting.append(shape)
        width += math.prod(f + 1 for f in shape.fine) * (1 if shape.period is None else 2)
        if width >= CHUNK:
            yield waiting
            waiting, width = [], 0
    if waiting:
        yield waiting


def _weigh(projected: Projected, before: Floats, left: Floats) -> list[tuple[int, float, float] | None]:
    """Numbers, explained squares and log evidence of shapes of one width.

    Args:
        projected: the readings, less the base.
        before: norms of the whitened columns, (shapes, k).
        left: the same columns less the base, (shapes, k, m).
    """
    scaled = left / np.where(before > 0, before, 1.0)[:, :, None]
    value, vector = np.linalg.eigh(scaled @ scaled.transpose(0, 2, 1))
    keep = value > ABSORBED**2 * 25.0
    along = (vector.transpose(0, 2, 1) @ (scaled @ projected.left)[:, :, None])[:, :, 0]
    square = np.sum(np.where(keep, along**2 / np.where(keep, value, 1.0), 0.0), axis=1)
    count = keep.sum(axis=1)
    noise = projected.squares / projected.freedom
    n, free = float(len(projected.left)), projected.freedom
    share = np.maximum(1.0 - square / max(projected.squares, 1e-300), 1e-12)
    found = 0.5 * (free - count) * np.log1p(n) - 0.5 * free * np.log1p(n * share)
    return [
        (int(c), float(q - c * noise), float(e)) if c else None for c, q, e in zip(count, square, found, strict=True)
    ]


def _lines(group: str, ground: Ground) -> Iterator[Shape]:
    """A curve over every variable."""
    return (Shape(group, (name,), (count,)) for name in ground.known for count in (LINE, FINE))


def _pairs(group: str, pairs: Iterable[Sequence[str]], one: int, two: int) -> Iterator[Shape]:
    """Surfaces over pairs of different channels."""
    return (Shape(group, (a, b), (one, two)) for a, b in pairs if plain_name(a) != plain_name(b))


def _leading(ground: Ground, leaders: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Pairs of leading variables, and of these with directions."""
    directions = [n for n in ground.known if n.startswith("d_") and n not in leaders]
    return itertools.combinations([*leaders, *directions], 2)


def _along(ground: Ground, moving: Sequence[str], leaders: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Positions, each with a variable that may change a fine curve along it, such as the axis's own direction."""
    with_it = {*leaders, "load_kg", "spindle_rpm", *moving, *(n for n in ground.known if n.startswith("|"))}
    own = {a.channel: a.direction_channel for a in ground.readings.machine.axes}
    return ((a, b) for a in moving for b in ground.known if b in with_it or b == own[a])


def _waves(ground: Ground, projected: Projected, group: str, moving: Sequence[str]) -> list[Weighed]:
    """Waves along positions; the best of each also with harmonics, and with a height that grows with a variable."""
    out: list[Weighed] = []
    mask = ground.groups[group]
    for name in moving:
        waves = (Shape(group, (name,), (0,), float(p)) for p in periods(ground.known[name][mask]))
        found = weigh_all(ground, projected, waves)[:3]
        found[:1] = [_refined(ground, projected, w) for w in found[:1]]
        grown = [
            Shape(group, (name, other), (0, OWN if other == name else OTHER), w.shape.period)
            for w in found[:1]
            for other in ground.known
        ]
        places = _places(ground.known[name][mask])
        most = [more for more in HARMONICS if EACH * 2 * (more + 1) <= places]
        pointed = [replace(w.shape, fine=(more,)) for w in found[:1] for more in most]
        sharp = [_refined(ground, projected, w) for w in weigh_all(ground, projected, pointed)]
        out += [*found, *sharp, *weigh_all(ground, projected, grown)]
    return out


def _refined(ground: Ground, projected: Projected, best: Weighed) -> Weighed:
    """A wave with its period refined between the neighbours in the grid, by steps that halve.

    Between two periods of the grid a wave is out of phase at the ends of the span; one whose height changes along the
    span would make up for that.
    """
    value = ground.known[best.shape.over[0]][ground.groups[best.shape.group]]
    grid = 1.0 / periods(value)
    step = float(grid[1] - grid[0]) if len(grid) > 1 else 0.0
    for _ in range(PHASES):
        step *= 0.5
        middle = 1.0 / (best.shape.period or 1.0)
        beside = (replace(best.shape, period=1.0 / f) for f in (middle - step, middle + step))
        best = max([best, *weigh_all(ground, projected, beside)], key=lambda w: w.log_evidence)
    return best


CENTRES, WIDTHS, NARROWEST, WIDEST = 24, 6, 0.01, 0.3
"""Number of centres and widths of humps and steps in the grid, and the limits of the widths as shares of the span."""
FEWEST_PLACES, LOCAL, STEEP = 10, 0.15, 0.075
"""With fewer different places a hump or a step is one or two of them. Up to `CENTRES` places, the largest widths of a
hump and of a step, as shares of the span: a quarter of it at half of the height, and a sixth for most of the rise."""
HALVINGS = 3


def _local(ground: Ground, projected: Projected, group: str, name: str) -> list[Weighed]:
    """The best hump and the best step along a position.

    Beside a curve of the model only the place itself explains a step: a sharp one is tried in every gap.
    """
    mine = ground.known[name][ground.groups[group]]
    span = float(np.ptp(mine))
    apart = span / CENTRES
    centres = float(mine.min()) + apart * (np.arange(CENTRES) + 0.5)
    forms: tuple[Literal["hump", "step"], ...] = ("hump", "step")

    def weighed(places: Iterable[LocalPlace]) -> list[Weighed]:
        return weigh_all(ground, projected, (Shape(group, (name,), (0,), place=p) for p in places))[:1]

    out: list[Weighed] = []
    for form in forms:
        narrowest, widest = NARROWEST, WIDEST
        if _places(mine) < CENTRES:
            # Among few places a narrower hump would be a single one; a step divides them however narrow it is. A wider
            # one is a bow.
            narrowest, widest = (max(NARROWEST, 1.0 / _places(mine)), LOCAL) if form == "hump" else (NARROWEST, STEEP)
        ratio = (widest / narrowest) ** (1.0 / (WIDTHS - 1))
        grid = [LocalPlace(form, float(c), narrowest * span * ratio**k) for c in centres for k in range(WIDTHS)]
        best = weighed([*grid, *(_sharp(mine)[0] if form == "step" else [])])
        step, factor = apart, ratio
        for _ in range(HALVINGS):
            step, factor = 0.5 * step, factor**0.5
            places = [w.shape.place for w in best if w.shape.place is not None]
            best = weighed(
                LocalPlace(form, at.centre + i * step, at.width * factor**k)
                for at in places
                for i in (-1, 0, 1)
                for k in (-1, 0, 1)
            )
        for found in best:
            # Of places that are close together none may be left to weigh.
            sharp = weigh_all(ground, projected, [_in_gap(found.shape, mine)])
            out += sharp if sharp and _as_sharp(found, sharp[0]) else [found]
    return out


def _in_gap(shape: Shape, value: Floats) -> Shape:
    """A step as a sharp one in the middle of the two places beside it: often that is all that the readings show."""
    if shape.place is None or shape.place.form != "step":
        return shape
    places = np.unique(np.round(value, 3))
    at = min(max(int(np.searchsorted(places, shape.place.centre)), 1), len(places) - 1)
    low, high = float(places[at - 1]), float(places[at])
    return replace(shape, place=LocalPlace("step", 0.5 * (low + high), SHARP * (high - low)))


def _as_sharp(found: Weighed, sharp: Weighed) -> bool:
    """Whether a step is as likely sharp between two places as it is where it was found."""
    if found.shape.place is None or sharp.shape.place is None:
        return False
    narrow = found.shape.place.width < NARROW * sharp.shape.place.width / SHARP
    return sharp.log_evidence > found.log_evidence - (ALIKE_NARROW if narrow else ALIKE)


def in_gap(place: LocalPlace, places: Floats) -> bool:
    """Whether a step is a sharp one in the middle between two places, (p,)."""
    at = int(np.searchsorted(places, place.centre))
    if not 0 < at < len(places):
        return False
    low, high = float(places[at - 1]), float(places[at])
    middle, width = 0.5 * (low + high), SHARP * (high - low)
    return abs(place.centre - middle) < CLOSE * width and abs(place.width / width - 1.0) < CLOSE


MOST_STEPS, EDGES, BETWEEN, SHARP = 4, 64, 3, 0.1
"""Most steps in one curve, and most places where one is looked for: the widest gaps between places. Fewest places of a
level between two steps; the width of a step as a share of its gap."""
SWEEPS = 3
ALIKE, ALIKE_NARROW, NARROW, CLOSE = 2.0, 8.0, 0.25, 0.02
"""A step is as likely sharp between two targets as anywhere where the log evidence of both differs by less; of one that
is narrower than this share of the gap, where it differs by less than the second. Places are rounded."""


def _steps(ground: Ground, projected: Projected, group: str, name: str) -> list[Weighed]:
    """The best curve of sharp steps along a position, as of a rack in pieces; none where a single one is likelier.

    The best two are found together, for each alone may be none beside a scale error; then each further one beside them.
    """
    value, mask = ground.known[name], ground.groups[group]
    places, edges = _sharp(value[mask])
    if len(places) < BETWEEN + 1:
        return []
    white = projected.whitener(np.stack([p.curve(value) for p in places], axis=1) * mask[:, None])
    left = projected.take_out(white)
    gram, along = left.T @ left, left.T @ projected.left
    apart = np.abs(edges[:, None] - edges) >= BETWEEN

    def best_beside(fixed: Sequence[int]) -> list[int] | None:
        """The fixed steps and the one that explains most beside them; None where there is no room."""
        have = np.array(fixed, dtype=np.int64)
        free = np.flatnonzero(apart[have].all(axis=0))
        if not len(free):
            return None
        cross = gram[np.ix_(free, have)]
        beside = cross @ np.linalg.pinv(gram[np.ix_(have, have)], rcond=ABSORBED**2, hermitian=True)
        rest = np.diag(gram)[free] - np.einsum("ij,ij->i", beside, cross)
        clear = rest > ABSORBED**2 * np.diag(gram)[free]
        gain = (along[free] - beside @ along[have]) ** 2 / np.where(clear, rest, np.inf)
        return [*fixed, int(free[np.argmax(gain)])]

    single = best_beside([]) or [0]
    shapes = [Shape(group, (name,), (0,), place=places[single[0]])]
    most = min(MOST_STEPS, _places(value[mask]) // (2 * EACH))
    chosen = _best_two(gram, along, apart) if most > 1 else None
    while chosen is not None:
        for _ in range(SWEEPS):
            before = sorted(chosen)
            for one in before:
                chosen = best_beside([i for i in chosen if i != one]) or chosen
            if sorted(chosen) == before:
                break
        first, *more = (places[i] for i in sorted(chosen))
        shapes.append(Shape(group, (name,), (0,), place=first, more=tuple(more)))
        chosen = best_beside(chosen) if len(chosen) < most else None
    return [w for w in weigh_all(ground, projected, shapes)[:1] if w.shape.more]


def _sharp(value: Floats) -> tuple[list[LocalPlace], Ints]:
    """A sharp step in each of the widest gaps between places, and the numbers of these gaps."""
    at = np.unique(np.round(value, 3))
    gaps = np.diff(at)[1:-1]  # the first and the last place alone are no level
    edges = np.sort(np.argsort(-gaps, kind="stable")[:EDGES]) + 1
    places = [LocalPlace("step", 0.5 * float(at[i] + at[i + 1]), SHARP * float(at[i + 1] - at[i])) for i in edges]
    return places, edges


def _best_two(gram: Floats, along: Floats, apart: Bools) -> list[int] | None:
    """Two columns that explain most together, of those that may be together; None where none may.

    Args:
        gram, along: of columns, (k, k), and with the readings, (k,).
        apart: which may be together, (k, k).
    """
    size = np.diag(gram)
    rest = size[:, None] * size - gram**2
    clear = apart & (rest > ABSORBED**2 * size[:, None] * size)
    if not clear.any():
        return None
    square = along[:, None] ** 2 * size - 2.0 * np.outer(along, along) * gram + along**2 * size[:, None]
    found = np.where(clear, square / np.where(clear, rest, 1.0), -np.inf)
    return [int(i) for i in np.unravel_index(int(np.argmax(found)), found.shape)]


def _places(value: Floats) -> int:
    """Number of different places."""
    return len(np.unique(np.round(value, 3)))


def periods(value: Floats) -> Floats:
    """Grid of periods over a variable, in its unit."""
    places = np.unique(np.round(value, 6))
    span = float(np.ptp(value))
    if len(places) < 6 or span <= 0:
        return np.zeros(0)
    step = float(np.median(np.diff(places)))
    longest = span / CYCLES[0]
    shortest = max(2.05 * step, span / (0.5 * PERIODS))
    if shortest >= longest:
        return np.zeros(0)
    # Even in frequency: as fine as the span can resolve.
    count = min(int(3.0 * span * (1.0 / shortest - 1.0 / longest)) + 2, PERIODS)
    return np.asarray(1.0 / np.linspace(1.0 / longest, 1.0 / shortest, count))
