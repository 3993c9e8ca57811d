"""Chooses what the figures of a comparison show: main axis, busiest temperature, bins of the map."""

import re
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.compare.bins import MOVES, REAL_DEGC, cut_into, time_unit
from rtec.diagnosis.compare.result import Compared, Comparison
from rtec.diagnosis.words import UNITS
from rtec.estimation.readings import Readings, Series
from rtec.report import compare_figures
from rtec.report import compare_figures as compare_lines
from rtec.report.compare_figures import Stack, angle_of, circle_picture, stack_along
from rtec.report.page import Figure, Section

Floats = NDArray[np.float64]

MAP_BINS, LEAST_IN_CELL = 12, 3
MOST_SENSORS = 8


def pictures(c: Comparison) -> list[Section]:
    """Sections with figures, for each reading column."""
    out: list[Section] = []
    for item, s in zip(c.items, c.traces.readings.series, strict=True):
        several = sum(i.name == item.name for i in c.items) > 1
        title = f"{item.name} {item.column}" if several else item.name
        file = re.sub(r"[^A-Za-z0-9_.-]+", "-", title.replace(" ", "-")).strip(".-") or "measurement"
        for kind, figure in _figures(c, item, s, title):
            out.append(Section(f"{title}: {kind}", [], None, Figure(f"{file}-{figure.name}", figure.png, figure.shows)))
    return out


def _figures(c: Comparison, item: Compared, s: Series, title: str) -> list[tuple[str, Figure]]:
    readings, unit = c.traces.readings, UNITS[item.unit]
    measured, predicted = c.traces.measured[s.part], c.traces.predicted[s.part]
    left = measured - predicted
    out = []
    polar = circle_picture(readings, s, title, measured, predicted)
    if polar is not None:
        shows = "Measured and predicted drawn outwards from the circle; beside it what is left."
        out.append(("measured and predicted on the circle", Figure("polar.png", polar, shows)))
    main = angle_of(readings, s) or _main_axis(readings, s)
    if main is not None:
        name, place, direction = main
        png = compare_lines.over_position(title, unit, name, place, direction, measured, predicted, item.floor)
        where = "position, each direction by itself" if polar is None else "the angle on the circle"
        shows = f"Measured and predicted over {where}; below what is left."
        out.append(("measured and predicted", Figure("position.png", png, shows)))
    cells = _map(readings, s, left, main, {b.channel for r in item.worst[:1] for b in r.bounds})
    if cells is not None:
        png = compare_figures.residual_map(title, unit, *cells, item.floor)
        out.append(("where it is left", Figure("map.png", png, "Mean of what is left, channel by channel.")))
    scale, time_name = time_unit(float(s.time_s[-1] - s.time_s[0]))
    hours = (s.time_s - s.time_s[0]) / scale
    png = compare_lines.over_time(
        title, unit, time_name, hours, left, measured if main is None else None, item.floor, _sensors(readings, s)
    )
    out.append(("what is left over time", Figure("time.png", png, "What is left over time, and the temperatures.")))
    if item.parts:
        rows = [(p.label, p.rms, p.most) for p in item.parts]
        stack = _stack(c, item, s, main)
        png = compare_figures.contributions(title, unit, rows, item.measured.rms, item.left.rms, item.floor, stack)
        out.append(("what the model says", Figure("effects.png", png, "What each effect of the model adds.")))
    return out


def _main_axis(readings: Readings, s: Series) -> tuple[str, Floats, Floats] | None:
    """Name with unit, positions and directions of the axis that moved most; None where none did."""
    state, best = readings.states[s.source], None
    for axis in readings.machine.axes:
        place = state.value(axis.channel)[s.row]
        span = float(np.ptp(place))
        if span > MOVES * (axis.travel_mm[1] - axis.travel_mm[0]) and (best is None or span > best[0]):
            best = span, f"{axis.name}, mm", place, np.sign(state.value(axis.direction_channel)[s.row])
    return None if best is None else best[1:]


def _sensors(readings: Readings, s: Series) -> list[tuple[str, Floats]]:
    """Temperatures, those that vary most first."""
    state = readings.states[s.source]
    found = [(n, state.channels[n][s.row]) for n in readings.machine.sensor_names if n in state.channels]
    found = [(n, v) for n, v in found if np.isfinite(v).any()]
    return sorted(found, key=lambda one: -float(np.nanmax(one[1]) - np.nanmin(one[1])))[:MOST_SENSORS]


def _stack(c: Comparison, item: Compared, s: Series, main: tuple[str, Floats, Floats] | None) -> Stack | None:
    """The effects along position, time or a temperature: where their means show most of what is predicted."""
    parts = {p.label: c.traces.parts[p.label][s.part] for p in item.parts}
    measured = c.traces.measured[s.part]
    scale, name = time_unit(float(np.ptp(s.time_s)))
    found = [stack_along((main[0], main[1]), main[2], parts, measured)] if main else []
    slow = [
        (f"{n}, °C", v) for n, v in _sensors(c.traces.readings, s) if np.isfinite(v).all() and np.ptp(v) > REAL_DEGC
    ]
    for channel in [(f"{name} since the first reading", (s.time_s - s.time_s[0]) / scale), *slow]:
        found.append(stack_along(channel, None, parts, measured))
    return max((f for f in found if f is not None), key=lambda f: f.shows, default=None)


Cells = tuple[tuple[str, Floats], tuple[str, Floats], list[tuple[str, Floats]]]


def _map(
    readings: Readings, s: Series, left: Floats, main: tuple[str, Floats, Floats] | None, wanted: set[str]
) -> Cells | None:
    """The map that shows most: position over a temperature or time, or two channels where nothing moved."""
    scale, name = time_unit(float(np.ptp(s.time_s)))
    warm = [(f"{n}, °C", v) for n, v in _sensors(readings, s) if np.isfinite(v).all() and np.ptp(v) > REAL_DEGC]
    slow = [*warm, (f"time, {name} since the first reading", (s.time_s - s.time_s[0]) / scale)]
    pairs = [((main[0], main[1]), up) for up in slow] if main else list(combinations(slow, 2))
    # What the worst region is told by is shown, where it can be.
    pairs = [p for p in pairs if any(name.split(",")[0] in wanted for name, _ in p[1 if main else 0 :])] or pairs
    ways = _ways(main[2] if main else np.zeros(len(left)))
    maps = [m for one, two in pairs if (m := _cells(one, two, left, ways)) is not None]
    return max(maps, key=lambda m: m[0])[1] if maps else None


def _ways(direction: Floats) -> list[tuple[str, Floats]]:
    """Both directions by themselves, so that their means do not cancel; name and 1 or 0, (n,)."""
    if len(np.unique(direction)) < 2:
        return [("", np.ones(len(direction)))]
    return [(", moving +", (direction > 0).astype(float)), (", moving −", (direction < 0).astype(float))]


def _cells(
    across: tuple[str, Floats], up: tuple[str, Floats], left: Floats, ways: Sequence[tuple[str, Floats]]
) -> tuple[float, Cells] | None:
    """How much of the mean square is in the means of the cells, less what chance puts there; and the cells."""
    x, y = (cut_into("T_", v, MAP_BINS) for _, v in (across, up))
    if x is None or y is None:
        return None
    code, size = y.code * len(x) + x.code, len(x) * len(y)
    shown, filled, means = 0.0, 0.0, []
    for name, weight in ways:
        counts = np.bincount(code, weights=weight, minlength=size)
        sums = np.bincount(code, weights=left * weight, minlength=size)
        full = counts >= LEAST_IN_CELL
        means.append((name, np.where(full, sums / np.maximum(counts, 1.0), np.nan).reshape(len(y), len(x))))
        shown += float(np.sum(sums[full] ** 2 / counts[full])) / max(float(left @ left), 1e-30) - full.sum() / len(left)
        filled += float(full.mean()) / len(ways)
    # A thin diagonal, as two sensors on one body make it, shows no more than one of them does.
    edges = [np.append(v.low, v.high[-1]) for v in (x, y)]
    return shown * min(1.0, 2.0 * filled), ((across[0], edges[0]), (up[0], edges[1]), means)
