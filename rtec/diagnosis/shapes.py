"""Shapes without a name: what any smooth or periodic dependence on one or two variables would explain.

They judge whether the best effect of the catalogue is good enough (adequacy), and where none is, they say on which
variables the error depends, whether smoothly or periodically, and with which period.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.candidates import real
from rtec.diagnosis.readings import Readings
from rtec.diagnosis.screen import ABSORBED, Projected

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

LINE, FINE, PLANE = 6, 14, 4
"""Basis functions of a curve over one variable, coarse and fine, and along each side of a surface over two."""
KEPT = 24
"""Shapes whose columns are kept."""
LEVELS = 8
DETAIL, BEND = 9, 2
"""Basis functions of a fine curve along a position, and of how it changes with another variable."""
PERIODS = 240
CYCLES = (2.5, 0.2)
"""A period must be seen so often at least; and be longer than this many typical steps."""
LEADERS = 6
"""Variables that go into surfaces over two."""


@dataclass(frozen=True)
class Shape:
    """A smooth or periodic dependence.

    Attributes:
        group: reading columns that it acts on, as told to people.
        variables: channel names.
        kind: smooth or periodic.
        period: of a periodic one, in the unit of its variable.
        raw: its columns, (m, k).
    """

    group: str
    variables: tuple[str, ...]
    kind: Literal["smooth", "periodic"]
    period: float | None
    raw: Floats


@dataclass(frozen=True)
class Weighed:
    """A shape and what it explains.

    Attributes:
        shape: which.
        count: numbers that it has, once what the base absorbs is left out.
        explained: sum of squares beyond chance, in units of the noise variance.
        log_evidence: over the base alone.
    """

    shape: Shape
    count: int
    explained: float
    log_evidence: float


def variables(readings: Readings) -> dict[str, Floats]:
    """Channels that vary and that every measurement recorded, by name, (m,) each."""
    machine = readings.machine
    out: dict[str, Floats] = {}
    names = [a.channel for a in machine.axes] + [a.direction_channel for a in machine.axes]
    names += ["feed_mm_min", *(a.velocity_channel for a in machine.axes), "spindle_rpm", "load_kg", "force_n"]
    names += [*machine.sensor_names]
    for name in names:
        value = readings.channel(name)
        if np.isfinite(value).all() and np.ptp(value) > real(machine, name):
            out[name] = value
    for name in ("feed_mm_min",):
        if name in out and any(v.startswith("v_") for v in out):
            out.pop(name)
    out["time_s"] = readings.time_s
    return out


def groups(readings: Readings) -> dict[str, NDArray[np.bool_]]:
    """Reading columns that belong together: the same column of the same kind of set-up."""
    out: dict[str, NDArray[np.bool_]] = {}
    for s in readings.series:
        m = readings.measurements[s.source]
        what = m.instrument.component or " ".join(filter(None, (m.instrument.name, m.instrument.axis)))
        column = s.column.removeprefix("reading_").removesuffix("um").removesuffix("urad").strip("_")
        name = f"{what} {column}".strip()
        mask = out.setdefault(name, np.zeros(len(readings), dtype=bool))
        mask[s.part] = True
    return out


def weigh(projected: Projected, shape: Shape) -> Weighed | None:
    """Whiten a shape, take the base out, and say what it explains; None where the base absorbs it."""
    white = projected.whitener(shape.raw)
    before = np.linalg.norm(white, axis=0)
    good = before > 0
    if not good.any():
        return None
    scaled = projected.take_out(white[:, good]) / before[good]
    value, vector = np.linalg.eigh(scaled.T @ scaled)
    keep = value > ABSORBED**2 * 25.0
    if not keep.any():
        return None
    d = scaled @ (vector[:, keep] / np.sqrt(value[keep]))
    t = d.T @ projected.left
    noise = projected.squares / projected.freedom
    return Weighed(
        shape, int(d.shape[1]), float(t @ t) - d.shape[1] * noise, _evidence(projected, float(t @ t), d.shape[1], shape)
    )


def _evidence(projected: Projected, square: float, count: int, shape: Shape) -> float:
    n, free = float(len(projected.left)), projected.freedom
    left = max(1.0 - square / max(projected.squares, 1e-300), 1e-12)
    searched = 1 if shape.kind == "periodic" else 0
    value = 0.5 * (free - count) * np.log1p(n) - 0.5 * free * np.log1p(n * left) - 0.5 * searched * np.log(n)
    return float(value)


def all_shapes(readings: Readings, projected: Projected) -> list[Weighed]:
    """Every shape: curves, surfaces, waves, and waves that grow with another variable."""
    known = variables(readings)
    out: list[Weighed] = []
    for group, mask in groups(readings).items():
        lines = _lines(projected, group, mask, known)
        leaders = list(dict.fromkeys(w.shape.variables[0] for w in lines))[:LEADERS]
        out = _best([*out, *lines])
        out = _best([*out, *_surfaces(projected, group, mask, known, leaders)])
        moving = [a.channel for a in readings.machine.axes if a.channel in known]
        out = _best([*out, *_along(projected, group, mask, known, moving, leaders)])
        out = _best([*out, *_waves(projected, group, mask, known, moving)])
    return out


def _best(weighed: list[Weighed]) -> list[Weighed]:
    """Best first; of those far behind the columns are forgotten, which may be gigabytes."""
    order = sorted(weighed, key=lambda w: -w.log_evidence)
    return [*order[:KEPT], *(replace(w, shape=replace(w.shape, raw=np.zeros((0, 0)))) for w in order[KEPT:])]


def _lines(projected: Projected, group: str, mask: Bools, known: Mapping[str, Floats]) -> list[Weighed]:
    """A curve over every variable, best first."""
    found = [
        w
        for name, value in known.items()
        for count in (LINE, FINE)
        if (w := weigh(projected, _smooth(group, (name,), curve(value, count), mask))) is not None
    ]
    return sorted(found, key=lambda w: -w.log_evidence)


def _surfaces(
    projected: Projected, group: str, mask: Bools, known: Mapping[str, Floats], leaders: Sequence[str]
) -> list[Weighed]:
    """Surfaces over pairs of those that lead, and of these with directions."""
    directions = [n for n in known if n.startswith("d_") and n not in leaders]
    made = (
        weigh(projected, _smooth(group, (a, b), surface(known[a], known[b], PLANE, PLANE), mask))
        for a, b in itertools.combinations([*leaders, *directions], 2)
    )
    return [w for w in made if w is not None]


def _along(
    projected: Projected,
    group: str,
    mask: Bools,
    known: Mapping[str, Floats],
    moving: Sequence[str],
    leaders: Sequence[str],
) -> list[Weighed]:
    """Fine curves along a position that change with another variable."""
    made = (
        weigh(projected, _smooth(group, (a, b), surface(known[a], known[b], DETAIL, BEND), mask))
        for a in moving
        if np.ptp(known[a][mask]) > 0.0
        for b in known
        if b != a and (b in leaders or b in ("load_kg", "spindle_rpm") or b in moving)
    )
    return [w for w in made if w is not None]


def _waves(
    projected: Projected, group: str, mask: Bools, known: Mapping[str, Floats], moving: Sequence[str]
) -> list[Weighed]:
    """Waves along positions; the best of each also growing with another variable."""
    out: list[Weighed] = []
    for name in moving:
        found = [
            w
            for period in periods(known[name][mask])
            if (w := weigh(projected, _wave(group, name, known[name], mask, period))) is not None
        ]
        found.sort(key=lambda w: -w.log_evidence)
        out += found[:3]
        for w in found[:1]:
            for other, value in known.items():
                if other != name:
                    grown = w.shape.raw[:, :, None] * np.stack([np.ones(len(mask)), _unit(value)], axis=1)[:, None, :]
                    shape = Shape(group, (name, other), "periodic", w.shape.period, grown.reshape(len(mask), -1))
                    more = weigh(projected, shape)
                    out += [more] if more is not None else []
    return out


def _unit(value: Floats) -> Floats:
    """Scaled to -1 … +1."""
    span = float(np.ptp(value))
    return np.asarray(2.0 * (value - value.min()) / span - 1.0 if span > 0 else np.zeros_like(value))


def _smooth(group: str, names: tuple[str, ...], columns: Floats, mask: Bools) -> Shape:
    return Shape(group, names, "smooth", None, columns * mask[:, None])


def periods(value: Floats) -> Floats:
    """Periods worth trying over a variable."""
    places = np.unique(np.round(value, 6))
    span = float(np.ptp(value))
    if len(places) < 6 or span <= 0:
        return np.zeros(0)
    step = float(np.median(np.diff(places)))
    longest = span / CYCLES[0]
    shortest = max(2.05 * step, span / (0.5 * PERIODS))
    if shortest >= longest:
        return np.zeros(0)
    # Even in frequency: as fine as the span can tell.
    count = min(int(3.0 * span * (1.0 / shortest - 1.0 / longest)) + 2, PERIODS)
    return np.asarray(1.0 / np.linspace(1.0 / longest, 1.0 / shortest, count))


def _wave(group: str, name: str, value: Floats, mask: NDArray[np.bool_], period: float) -> Shape:
    angle = 2.0 * np.pi * value / period
    raw = np.stack([np.sin(angle), np.cos(angle)], axis=1) * mask[:, None]
    return Shape(group, (name,), "periodic", float(period), raw)


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


def surface(a: Floats, b: Floats, fine_a: int, fine_b: int) -> Floats:
    """Smooth basis over two variables: curves of each and their products, (m, k)."""
    one, two = curve(a, fine_a), curve(b, fine_b)
    one, two = (c / np.maximum(np.abs(c).max(axis=0), 1e-12) for c in (one, two))
    cross = (one[:, :, None] * two[:, None, :]).reshape(len(a), -1)
    return np.concatenate([one, two, cross], axis=1)
