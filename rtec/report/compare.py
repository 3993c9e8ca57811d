"""Report of a comparison: one sentence, a table, where it is worst, what it is made of."""

import re
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from rtec import __version__
from rtec.diagnosis.compare.bins import MOVES, REAL_DEGC, cut_into, time_unit
from rtec.diagnosis.compare.result import Compared, Comparison, Outside
from rtec.diagnosis.words import UNITS, named, spoken
from rtec.estimation.readings import Readings, Series
from rtec.report import compare_figures as draw
from rtec.report.page import Figure, Page, Section, Table, number

Floats = NDArray[np.float64]
MOST_PARTS, MOST_SAME, MOST_SEEN, MOST_LEAD = 8, 3, 5, 4
AT_FLOOR = 1.1
SLOW = 0.5
"""Drift below this share of the noise is not worth a word."""


def compare_page(c: Comparison, figures: bool = True) -> Page:
    """The page; without figures it is what the terminal shows."""
    return Page(
        title=f"How wrong the model {c.model} is, and where",
        lead=_lead(c),
        numbers=_numbers(c),
        sections=[
            _table(c),
            _worst(c),
            *_outside(c),
            _parts(c),
            _noise(c),
            *(_pictures(c) if figures else []),
        ],
        foot=[
            "What the instruments cannot know (zero of a run, misalignment) is taken out of all numbers.",
            f"rtec {__version__}, rtec compare, seed {c.seed} of the draws of chance.",
        ],
    )


def _lead(c: Comparison) -> str:
    """A sentence for each reading column, the worst news first."""
    order = sorted(c.items, key=_badness)
    more = [f"{len(order) - MOST_LEAD} more: see the table."] if len(order) > MOST_LEAD else []
    return "\n".join([*(_said(i, c) for i in order[:MOST_LEAD]), *more])


def _badness(i: Compared) -> tuple[bool, float]:
    """Key for sorting: worse than no model first, then what is left over the noise."""
    return (i.explained or 0.0) >= 0.0, -i.left.rms / max(i.floor, 1e-9)


def _said(first: Compared, c: Comparison) -> str:
    unit = UNITS[first.unit]
    of = f"{_name(first, c)}: " if len(c.items) > 1 else ""
    worse = "the model makes it worse than no model; " if (first.explained or 0.0) < 0.0 else ""
    said = (
        f"{of}{worse}{first.left.rms:.3g} {unit} of {first.measured.rms:.3g} {unit} are left (root mean square), "
        f"noise is {first.floor:.2g} {unit}"
    )
    if first.worst and first.worst[0].apart is not None:
        return f"{said}; {first.worst[0].words}."
    if first.worst:
        w = first.worst[0]
        return f"{said}; worst at {w.words}, {w.rms:.2g} {unit} against {w.elsewhere:.2g} {unit} elsewhere."
    if first.left.rms <= AT_FLOOR * first.floor:
        return f"{said}: the model is at the noise floor."
    return f"{said}; no place stands out beyond chance. `rtec diagnose` looks for what is missing."


def _name(item: Compared, c: Comparison) -> str:
    several = sum(i.name == item.name for i in c.items) > 1
    return f"{item.name} {item.column}" if several else item.name


def _numbers(c: Comparison) -> list[tuple[str, str]]:
    first = min(c.items, key=_badness)
    unit = UNITS[first.unit]
    out = [
        (f"{first.measured.rms:.3g}\u00a0{unit}", "measured"),
        (f"{first.left.rms:.3g}\u00a0{unit}", "left by the model"),
        (f"{first.floor:.2g}\u00a0{unit}", "noise"),
    ]
    return out if first.explained is None else [*out, (_share(first), "of the explainable explained")]


def _share(item: Compared) -> str:
    if item.explained is None:
        return "–"
    if item.explained <= -1.0:
        return "worse"
    # 99.97 % is not all of it.
    return "100 %" if item.explained >= 1.0 else f"{min(100.0 * item.explained, 99.9):.3g} %"


def _table(c: Comparison) -> Section:
    rows = [
        [
            _name(i, c), f"{i.n}", f"{number(i.measured.rms)} / {number(i.measured.most, 1)}",
            f"{number(i.predicted.rms)} / {number(i.predicted.most, 1)}",
            f"{number(i.left.rms)} / {number(i.left.most, 1)}", number(i.floor), _share(i), UNITS[i.unit],
        ]
        for i in c.items
    ]  # fmt: skip
    head = ("measurement", "readings", "measured", "predicted", "left", "noise floor", "explained", "unit")
    caption = "Root mean square / largest. Explained: share of the mean square above the noise floor."
    bad = [f"{_name(i, c)}: the model makes it worse than no model." for i in c.items if (i.explained or 0.0) < 0.0]
    none = [
        f"{_name(i, c)}: nothing to explain, what is measured is hardly more than noise."
        for i in c.items
        if i.explained is None
    ]
    return Section("How wrong", [*bad, *none, *(_sentence(n) for n in c.notes)], Table(head, rows, caption, (0, 7)))


def _sentence(text: str) -> str:
    return text + ("" if text.endswith(".") else ".")


def _worst(c: Comparison) -> Section:
    rows = [
        [
            _name(i, c),
            r.words,
            number(r.rms),
            number(r.elsewhere),
            _signed(r.mean).replace("-0.00", "+0.00"),
            f"{r.n}",
            UNITS[i.unit],
        ]
        for i in c.items
        for r in i.worst
        if r.apart is None
    ]
    apart = [
        f"{_name(i, c)}: {r.words}; with that taken out, {r.elsewhere:.2g} {UNITS[i.unit]} are left."
        for i in c.items
        for r in i.worst
        if r.apart is not None
    ]
    if not rows and apart:
        return Section("Where it is worst", apart)
    if not rows:
        return Section("Where it is worst", ["No place stands out: chance alone looks as uneven as what is left."])
    head = ("measurement", "where", "left there", "elsewhere", "mean there", "readings", "unit")
    words = [
        f"{_name(i, c)}, {r.words}: nearly the same readings as {'; '.join(r.same[:MOST_SAME])}."
        for i in c.items
        for r in i.worst
        if r.same
    ]
    if words:
        words.append("Where channels name the same readings, these data cannot say which of them it is.")
    caption = "Best evidence first; root mean squares, the mean with its sign. Elsewhere: in none of these places."
    return Section("Where it is worst", [*apart, *words], Table(head, rows, caption, (0, 1, 6)))


def _signed(value: float) -> str:
    text = f"{value:+.2f}".replace("-", "−")
    return "0.00" if text[1:] == "0.00" else text


def _outside(c: Comparison) -> list[Section]:
    rows = [
        [_name(i, c), named(o.channel), f"{o.low:.5g} to {o.high:.5g}", _beyond(o), f"{o.n} of {i.n}", spoken(o.unit)]
        for i in c.items
        for o in i.outside
    ]
    if not rows:
        return []
    words = ["There the model guesses, and in the loop the correction is held."]
    head = ("measurement", "channel", "range of the fit", "readings go to", "readings outside", "unit")
    return [Section("Outside the range that the model was fitted in", words, Table(head, rows, "", (0, 1, 5)))]


def _beyond(o: Outside) -> str:
    ends = [f"{o.lowest:.5g}"] if o.lowest < o.low else []
    return " and ".join([*ends, *([f"{o.highest:.5g}"] if o.highest > o.high else [])])


def _parts(c: Comparison) -> Section:
    rows = []
    for i in c.items:
        parts = i.parts[:MOST_PARTS]
        rows += [[_name(i, c), p.label, number(p.rms), number(p.most, 1), UNITS[i.unit]] for p in parts]
    words = [f"{_name(i, c)} sees {_seen(i.sees)}." for i in c.items]
    if not rows:
        return Section("What the model says", [*words, "The model has no effect that these readings see."])
    head = ("measurement", "effect", "root mean square", "largest", "unit")
    return Section("What the model says", words, Table(head, rows, "", (0, 1, 4)))


def _noise(c: Comparison) -> Section:
    words = []
    for i in c.items:
        unit = UNITS[i.unit]
        source = "repeats" if i.noise.repeats is not None else "neighbouring readings"
        text = f"{_name(i, c)}: {i.floor:.2g} {unit} between {source}"
        if i.noise.drift > SLOW * i.floor:
            text += f"; {i.noise.drift:.2g} {unit} of slow drift that no recorded channel explains"
        words.append(f"{text}.")
    return Section("Where the noise floor comes from", words)


def _seen(sees: Sequence[str]) -> str:
    more = f" and {len(sees) - MOST_SEEN} more" if len(sees) > MOST_SEEN else ""
    return (", ".join(sees[:MOST_SEEN]) or "no component error") + more


MAP_BINS, LEAST_IN_CELL = 12, 3
MOST_SENSORS = 8


def _pictures(c: Comparison) -> list[Section]:
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
    polar = draw.circle_picture(readings, s, title, measured, predicted)
    if polar is not None:
        shows = "Measured and predicted drawn outwards from the circle; beside it what is left."
        out.append(("measured and predicted on the circle", Figure("polar.png", polar, shows)))
    main = draw.angle_of(readings, s) or _main_axis(readings, s)
    if main is not None:
        name, place, direction = main
        png = draw.over_position(title, unit, name, place, direction, measured, predicted, item.floor)
        where = "position, each direction by itself" if polar is None else "the angle on the circle"
        shows = f"Measured and predicted over {where}; below what is left."
        out.append(("measured and predicted", Figure("position.png", png, shows)))
    cells = None if polar else _map(readings, s, left, main, {b.channel for r in item.worst[:1] for b in r.bounds})
    if cells is not None:
        png = draw.residual_map(title, unit, *cells, item.floor)
        out.append(("where it is left", Figure("map.png", png, "Mean of what is left, channel by channel.")))
    scale, time_name = time_unit(float(s.time_s[-1] - s.time_s[0]))
    hours = (s.time_s - s.time_s[0]) / scale
    png = draw.over_time(
        title, unit, time_name, hours, left, measured if main is None else None, item.floor, _sensors(readings, s)
    )
    out.append(("what is left over time", Figure("time.png", png, "What is left over time, and the temperatures.")))
    if item.parts:
        rows = [(p.label, p.rms, p.most) for p in item.parts]
        stack = _stack(c, item, s, main)
        png = draw.contributions(title, unit, rows, item.measured.rms, item.left.rms, item.floor, stack)
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


def _stack(c: Comparison, item: Compared, s: Series, main: tuple[str, Floats, Floats] | None) -> draw.Stack | None:
    """The effects along position, time or a temperature: where their means show most of what is predicted."""
    parts = {p.label: c.traces.parts[p.label][s.part] for p in item.parts}
    measured = c.traces.measured[s.part]
    scale, name = time_unit(float(np.ptp(s.time_s)))
    found = [draw.stack_along((main[0], main[1]), main[2], parts, measured)] if main else []
    slow = [
        (f"{n}, °C", v) for n, v in _sensors(c.traces.readings, s) if np.isfinite(v).all() and np.ptp(v) > REAL_DEGC
    ]
    for channel in [(f"time since the first reading, {name}", (s.time_s - s.time_s[0]) / scale), *slow]:
        found.append(draw.stack_along(channel, None, parts, measured))
    return max((f for f in found if f is not None), key=lambda f: f.shows, default=None)


Cells = tuple[tuple[str, Floats], tuple[str, Floats], list[tuple[str, Floats]]]


def _map(
    readings: Readings, s: Series, left: Floats, main: tuple[str, Floats, Floats] | None, wanted: set[str]
) -> Cells | None:
    """The map that shows most: position over a temperature or time, or two channels where nothing moved."""
    scale, name = time_unit(float(np.ptp(s.time_s)))
    warm = [(f"{n}, °C", v) for n, v in _sensors(readings, s) if np.isfinite(v).all() and np.ptp(v) > REAL_DEGC]
    slow = [*warm, (f"time since the first reading, {name}", (s.time_s - s.time_s[0]) / scale)]
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
