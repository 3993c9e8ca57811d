"""What is measured: instrument, poses, feeds, loads and times of 20 runs to and fro over nine hours.

Designed: everything that an effect may depend on is moved, targets never fall on the same phase of a pitch, and some
lie just behind the reversals. Passive: as in production, the same line again and again at one feed and one load.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator.machine import TRAVEL_MM, Column

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

KINDS = ("laser", "angular", "straightness", "tool_tip", "drift")
RUNS = 20
RUN_S = 1620.0
USED = 0.85
"""Share of a run's time in which it is measured."""
AFTER_MM = (0.04, 0.2, 0.6, 1.5, 3.0, 6.0, 12.0, 25.0)
EVENLY = 17
POINTS = 17
FEEDS_MM_MIN = (300.0, 600.0, 1200.0, 2500.0, 5000.0, 10000.0)
LOADS_KG = (0.0, 100.0, 200.0, 400.0)


@dataclass(frozen=True)
class Campaign:
    """One measurement, without its numbers.

    Attributes:
        kind: of `KINDS`.
        instrument, setup: as in the files of the program.
        axis: line that is travelled; also given where the machine does not move.
        across: direction that a straightness probe reads, or turn that an angular laser reads; else empty.
        columns: what is read.
        passive: as in production.
        run: (n,).
        time_s: (n,).
        pose_mm: by axis, (n,).
        direction, velocity_mm_s, acceleration_mm_s2, since_mm: by axis, (n,); last direction, speed with sign, and
            distance since the last reversal.
        feed_mm_min, load_kg: (n,).
        recorded: channels that the file has beside positions, temperatures and spindle speed.
    """

    kind: str
    instrument: str
    setup: Mapping[str, Any]
    axis: str
    across: str
    columns: tuple[Column, ...]
    passive: bool
    run: Ints
    time_s: Floats
    pose_mm: Mapping[str, Floats]
    direction: Mapping[str, Floats]
    velocity_mm_s: Mapping[str, Floats]
    acceleration_mm_s2: Mapping[str, Floats]
    since_mm: Mapping[str, Floats]
    feed_mm_min: Floats
    load_kg: Floats
    recorded: tuple[str, ...]


def campaign(rng: np.random.Generator, kind: str, axis: str, passive: bool, across: str = "") -> Campaign:
    """Plan a measurement.

    Args:
        rng: source of all that is left to chance.
        kind: of `KINDS`.
        axis: of the line; drift probes and tool tip have none and keep it for the names of components.
        passive: as in production.
        across: what a straightness probe reads; empty: any.
    """
    if kind in ("tool_tip", "drift"):
        return _standing(rng, kind, axis, passive)
    return _line(rng, kind, axis, passive, across or _across(rng, kind, axis))


def _line(rng: np.random.Generator, kind: str, axis: str, passive: bool, across: str) -> Campaign:
    others = [a for a in "XYZ" if a != axis]
    forth, back = _targets(rng, axis, passive)
    per = len(forth[0])
    run = np.repeat(np.arange(1, RUNS + 1), 2 * per)
    position = np.concatenate([np.concatenate([f, b]) for f, b in zip(forth, back, strict=True)])
    way = np.tile(np.repeat([1.0, -1.0], per), RUNS)
    pose = {axis: position} | {a: np.repeat(_places(rng, a, passive), 2 * per) for a in others}
    feed = np.repeat(rng.choice(FEEDS_MM_MIN, RUNS), 2 * per) if not passive else np.full(len(run), 2500.0)
    load = np.repeat(rng.choice(LOADS_KG, RUNS), 2 * per) if not passive else np.full(len(run), 100.0)
    zero = np.zeros(len(run))
    hurry = np.zeros(len(run))
    if not passive:
        # A third of the readings are taken while the slide gains or loses speed.
        hurry = (rng.random(len(run)) < 0.35) * rng.choice([-1.0, 1.0], len(run)) * rng.uniform(500.0, 4000.0, len(run))
    instrument, setup, column = _instrument(kind, axis, across)
    still = dict.fromkeys(others, zero)
    return Campaign(
        kind,
        instrument,
        setup,
        axis,
        across,
        (column,),
        passive,
        run,
        _times(rng, run),
        pose,
        {axis: way} | _moved(pose, others),
        {axis: way * feed / 60.0, **still},
        {axis: hurry, **still},
        {axis: _since(position, way)},
        feed,
        load,
        ("direction", "velocity", "acceleration", "feed", "load"),
    )


def _standing(rng: np.random.Generator, kind: str, axis: str, passive: bool) -> Campaign:
    n = RUNS * POINTS
    run = np.repeat(np.arange(1, RUNS + 1), POINTS)
    if kind == "drift":
        pose = {a: np.full(n, round(0.4 * TRAVEL_MM[a][1])) for a in "XYZ"}
        columns: tuple[Column, ...] = (
            Column("reading_axial_um", "point", "Z"),
            Column("reading_near_um", "point", "X"),
            Column("reading_far_um", "point", "X", (0.0, 0.0, 90.0)),
        )
        probes = {c.name.split("_")[1]: {"direction": c.letter, "offset_mm": list(c.offset_mm)} for c in columns}
        setup: dict[str, Any] = {"probe": probes}
    else:
        pose = {a: _spread(rng, a, n, passive) for a in "XYZ"}
        columns = tuple(Column(f"reading_{d.lower()}_um", "point", d) for d in "XYZ")
        setup = {}
    way = _moved(pose, list("XYZ")) if kind == "tool_tip" else {}
    zero = np.zeros(n)
    return Campaign(
        kind,
        "spindle_drift" if kind == "drift" else "tool_tip",
        setup,
        axis,
        "",
        columns,
        passive,
        run,
        _times(rng, run),
        pose,
        way,
        dict.fromkeys("XYZ", zero),
        dict.fromkeys("XYZ", zero),
        {},
        zero,
        np.repeat(rng.choice(LOADS_KG, RUNS), POINTS) if not passive else np.full(n, 100.0),
        ("direction", "load") if kind == "tool_tip" else ("load",),
    )


def _across(rng: np.random.Generator, kind: str, axis: str) -> str:
    if kind == "straightness":
        return str(rng.choice([a for a in "XYZ" if a != axis]))
    if kind == "angular":
        return str(rng.choice([t for t, a in zip("ABC", "XYZ", strict=True) if a != axis]))
    return ""


def _instrument(kind: str, axis: str, across: str) -> tuple[str, dict[str, Any], Column]:
    if kind == "laser":
        offset = (15.0, -25.0, 40.0)
        return (
            "laser_linear",
            {"beam_offset_mm": list(offset)},
            Column("reading_um", "point", axis, offset),
        )
    if kind == "angular":
        return "laser_angular", {"about": across}, Column("reading_urad", "turn", across)
    return "straightness", {"direction": across}, Column("reading_um", "point", across)


def _targets(rng: np.random.Generator, axis: str, passive: bool) -> tuple[list[Floats], list[Floats]]:
    """Targets of each run forth and back; both turning points are targets, those forth start behind the last one."""
    low, high = TRAVEL_MM[axis]
    span = high - low
    if passive:
        same = low + span * (0.03 + 0.94 * np.linspace(0.0, 1.0, len(AFTER_MM) + EVENLY + 1))
        return [same] * RUNS, [same[::-1]] * RUNS
    forth, back = [], []
    for _ in range(RUNS):
        first, last = low + span * rng.uniform(0.01, 0.06), high - span * rng.uniform(0.01, 0.06)
        forth.append(np.concatenate([_one_way(rng, first, last), [last]]))
        back.append(np.concatenate([_one_way(rng, last, first), [first]]))
    return forth, back


def _one_way(rng: np.random.Generator, start: float, end: float) -> Floats:
    """Just behind the reversal, then one target somewhere in each of many equal parts of the way."""
    sign = 1.0 if end > start else -1.0
    left = abs(end - start) - AFTER_MM[-1]
    parts = AFTER_MM[-1] + left * (np.arange(EVENLY) + rng.uniform(0.02, 0.98, EVENLY)) / EVENLY
    return start + sign * np.concatenate([AFTER_MM, parts])


def _places(rng: np.random.Generator, axis: str, passive: bool) -> Floats:
    """Where another axis stands in each run."""
    low, high = TRAVEL_MM[axis]
    if passive:
        return np.full(RUNS, low + 0.35 * (high - low))
    levels = low + (high - low) * (0.08 + 0.84 * np.linspace(0.0, 1.0, 5))
    return rng.permutation(np.resize(levels, RUNS)) + rng.uniform(-4.0, 4.0, RUNS)


def _spread(rng: np.random.Generator, axis: str, n: int, passive: bool) -> Floats:
    """Points all over the travel; in production the same few in every run."""
    low, high = TRAVEL_MM[axis]
    if passive:
        return np.tile(low + (high - low) * rng.uniform(0.2, 0.8, POINTS), RUNS)
    return np.round(low + (high - low) * rng.uniform(0.03, 0.97, n), 3)


def _times(rng: np.random.Generator, run: Ints) -> Floats:
    """Nearly even within a run, then a pause."""
    out = np.empty(len(run))
    for k in range(1, RUNS + 1):
        here = np.flatnonzero(run == k)
        step = USED * RUN_S / len(here)
        out[here] = (k - 1) * RUN_S + 30.0 + step * (np.arange(len(here)) + rng.uniform(-0.3, 0.3, len(here)))
    return np.round(out, 1)


def _moved(pose: Mapping[str, Floats], axes: list[str]) -> dict[str, Floats]:
    """Last direction of each axis from the order of its places; the first motion before the first came from below."""
    out = {}
    for a in axes:
        step = np.sign(np.diff(pose[a], prepend=pose[a][0] - 1.0))
        last = np.maximum.accumulate(np.where(step != 0, np.arange(len(step)), 0))
        out[a] = step[last]
    return out


def _since(position: Floats, way: Floats) -> Floats:
    """Distance since the reversal; it was at the further of the last target before it and the first behind it.

    Before the first reversal the slide has come from far away.
    """
    out, turn = np.empty_like(position), position[0] - 1000.0 * way[0]
    for i in range(len(position)):
        if i and way[i] != way[i - 1]:
            turn = max(position[i - 1], position[i]) if way[i] < 0 else min(position[i - 1], position[i])
        out[i] = abs(position[i] - turn)
    return out
