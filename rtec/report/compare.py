"""Report of a comparison: the residual against the noise floor, where it is largest, what the model predicts."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.compare.bins import REAL_DEGC, cut_into, time_unit
from rtec.diagnosis.compare.compare import SLOW, SURELY
from rtec.diagnosis.compare.result import Compared, Comparison, Outside
from rtec.diagnosis.compare.shape import AGAIN
from rtec.diagnosis.doubts.not_read import unread_beside
from rtec.diagnosis.words import named, sentence, spoken
from rtec.estimation.outliers import left_out
from rtec.estimation.readings import Readings, Series
from rtec.estimation.visible import moves
from rtec.report import compare_figures as draw
from rtec.report.page import Figure, Page, Section, Table, name_of_file, shell_command
from rtec.version import __version__
from rtec.wording import ERROR_UNITS, decimals, number, percent, significant, sizes

MOST_PARTS, MOST_SAME, MOST_SEEN = 8, 3, 5
AT_FLOOR = 1.1
WORSE = "with the model the error is larger than without one"
MEASURED = "Measured: less the zero of the instrument."
EXPLAINED = "Explained: share of its mean square, without the noise."


def compare_page(c: Comparison, figures: bool = True) -> Page:
    """The page.

    Args:
        c: the comparison.
        figures: whether to draw.
    """
    return Page(
        title=f"Residual of the model {c.model}",
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
            "What the instruments cannot know (zero of a run, misalignment) is removed from all numbers.",
            f"rtec {__version__}, rtec compare, seed {c.seed} of the random draws.",
        ],
        brief=Section("", [], _brief(c)),
        next=_next(c),
    )


def _brief(c: Comparison) -> Table:
    digits = _digits(c)
    rows = [
        [
            _name(i, c),
            *(number(v, digits) for v in (i.measured.rms, i.left.rms, i.floor)),
            _share(i),
            ERROR_UNITS[i.unit],
        ]
        for i in c.items
    ]
    head = ("measurement", "measured", "residual", "noise floor", "explained", "unit")
    return Table(head, rows, f"Root mean squares. {MEASURED} {EXPLAINED}", (0, 5))


def _digits(c: Comparison) -> int:
    """Decimals of errors in tables."""
    return decimals(*(i.floor for i in c.items))


def _next(c: Comparison) -> list[str]:
    """A diagnosis, unless the model is at the noise floor."""
    if not c.files or all(i.left.rms <= AT_FLOOR * i.floor for i in c.items):
        return []
    return [shell_command("rtec", "diagnose", *c.files, *c.machine_option)]


def _lead(c: Comparison) -> str:
    """The verdict on the worst reading column, and the number of others."""
    first = min(c.items, key=_badness)
    others = len(c.items) - 1
    more = f" The other {'residual is' if others == 1 else f'{others} residuals are'} in the table." if others else ""
    asked = next((f" {sentence(d.words)}" for d in c.doubts if d.blames_no_effect), "")
    unread = unread_beside(c.judged.readings.measurements, c.doubts)
    warm = "".join(f" {d.words}" for d in c.doubts if d.kind in ("warm_start", "changed_delay"))
    return _verdict(first, c) + asked + more + warm + left_out(c.judged.given.wrong) + unread


def _badness(i: Compared) -> tuple[bool, float]:
    """Key for sorting: worse than no model first, then residual over noise."""
    return not _worse(i), -i.left.rms / max(i.floor, 1e-9)


def _worse(i: Compared) -> bool:
    """Whether the error is larger than without a model, by more than noise makes it."""
    return (i.explained or 0.0) < 0.0 and i.left.rms > SURELY * i.floor


def _verdict(first: Compared, c: Comparison) -> str:
    unit = ERROR_UNITS[first.unit]
    of = f"{_name(first, c)}: the" if len(c.items) > 1 else "The"
    worse = f" {sentence(WORSE)}" if _worse(first) else ""
    left, measured, floor = sizes(first.left.rms, first.measured.rms, first.floor)
    said = (
        f"{of} residual is {left} {unit} of {measured} {unit} measured (root mean square); the noise floor is "
        f"{floor} {unit}.{worse}"
    )
    if first.worst and first.worst[0].apart is not None:
        return f"{said} {sentence(first.worst[0].words)}"
    if first.worst:
        w = first.worst[0]
        there, elsewhere = sizes(w.rms, w.elsewhere)
        return f"{said} It is largest at {w.words}: {there} {unit}, elsewhere {elsewhere} {unit}."
    if first.left.rms <= AT_FLOOR * first.floor:
        return f"{said} The model is at the noise floor."
    if first.shape is not None:
        return f"{said} It {first.shape.words}."
    return f"{said} {_nowhere(first)}"


def _nowhere(i: Compared) -> str:
    """Sentence where no region has a larger residual than the others."""
    if i.left.rms <= SURELY * i.floor:
        return "No place stands out from noise."
    if i.noise.drift <= SLOW * i.floor:
        return "No single place or line stands out, yet it is no noise: it follows the recorded channels."
    if i.drift_goes_with:
        return f"No single place stands out, but most of it {i.drift_goes_with}."
    return "No place stands out: it is slow drift, and no single recorded channel explains most of it."


def _name(item: Compared, c: Comparison) -> str:
    several = sum(i.name == item.name for i in c.items) > 1
    return f"{item.name} {item.column}" if several else item.name


def _numbers(c: Comparison) -> list[tuple[str, str]]:
    first = min(c.items, key=_badness)
    (value, meaning), *others = numbers_of(first)
    return [(value, f"{meaning} in {_name(first, c)}" if len(c.items) > 1 else meaning), *others]


def numbers_of(first: Compared) -> list[tuple[str, str]]:
    """The large numbers of one reading column, each with its meaning."""
    named = zip(
        ("measured", "residual", "noise floor"), sizes(first.measured.rms, first.left.rms, first.floor), strict=True
    )
    out = [(f"{size}\u00a0{ERROR_UNITS[first.unit]}", name) for name, size in named]
    if first.explained is None:
        return out
    share = _share(first) if first.explained > 0.0 else "nothing"
    return [*out, (share, "of the mean square error is explained")]


def _share(item: Compared) -> str:
    if item.explained is None:
        return "–"
    if item.explained <= -1.0:
        return "worse"
    return percent(min(item.explained, 1.0))


def _table(c: Comparison) -> Section:
    digits = _digits(c)
    rows = [
        [
            _name(i, c),
            f"{i.n}",
            *(f"{number(v.rms, digits)} / {number(v.most, digits - 1)}" for v in (i.measured, i.predicted, i.left)),
            number(i.floor, digits),
            _share(i),
            ERROR_UNITS[i.unit],
        ]
        for i in c.items
    ]
    head = ("measurement", "readings", "measured", "predicted", "residual", "noise floor", "explained", "unit")
    caption = f"Root mean square / largest. {MEASURED} {EXPLAINED}"
    bad = [f"{_name(i, c)}: {WORSE}." for i in c.items if _worse(i)]
    none = [
        f"{_name(i, c)}: nothing to explain; the readings are hardly more than noise."
        for i in c.items
        if i.explained is None
    ]
    words = [*bad, *none, *(_sentence(n) for n in c.notes)]
    return Section("Residual and noise floor", words, Table(head, rows, caption, (0, 7)))


def _sentence(text: str) -> str:
    return text + ("" if text.endswith(".") else ".")


def _worst(c: Comparison) -> Section:
    digits = _digits(c)
    rows = [
        [
            _name(i, c),
            r.words,
            number(r.rms, digits),
            number(r.elsewhere, digits),
            number(r.mean, digits, sign=True),
            f"{r.n}",
            ERROR_UNITS[i.unit],
        ]
        for i in c.items
        for r in i.worst
        if r.apart is None
    ]
    apart = [
        f"{_name(i, c)}: {r.words}; without that the residual is {number(r.elsewhere, digits)} {ERROR_UNITS[i.unit]}."
        for i in c.items
        for r in i.worst
        if r.apart is not None
    ]
    shapes = [
        f"{_name(i, c)}: the residual {i.shape.words}; that is {percent(i.shape.share)} of its mean square."
        for i in c.items
        if i.shape is not None
    ]
    if not rows and (apart or shapes):
        return Section("Where the residual is largest", [*apart, *shapes])
    if not rows:
        several = len(c.items) > 1
        return Section(
            "Where the residual is largest",
            [f"{_name(i, c)}: {_nowhere(i)}" if several else _nowhere(i) for i in c.items],
        )
    head = ("measurement", "where", "residual there", "elsewhere", "mean there", "readings", "unit")
    words = [
        f"{_name(i, c)}, {r.words}: nearly the same readings as {'; '.join(r.same[:MOST_SAME])}."
        for i in c.items
        for r in i.worst
        if r.same
    ]
    if words:
        words.append("Places with the same readings cannot be distinguished from these data.")
    caption = "Strongest evidence first; root mean squares, mean with its sign. Elsewhere: in none of these places."
    return Section("Where the residual is largest", [*apart, *shapes, *words], Table(head, rows, caption, (0, 1, 6)))


def _outside(c: Comparison) -> list[Section]:
    rows = [
        [
            _name(i, c),
            named(o.channel),
            f"{_place(o.low)} to {_place(o.high)}",
            _beyond(o),
            f"{o.n} of {i.n}",
            spoken(o.unit),
        ]
        for i in c.items
        for o in i.outside
    ]
    if not rows:
        return []
    words = ["The valid range is that of the fit, with a margin. Outside it the loop holds the correction."]
    head = ("measurement", "channel", "valid range", "readings go to", "readings outside", "unit")
    return [Section("Outside the valid range of the model", words, Table(head, rows, "", (0, 1, 5)))]


def _place(value: float) -> str:
    """A position, a temperature or a speed."""
    return significant(value, 5)


def _beyond(o: Outside) -> str:
    ends = [_place(o.lowest)] if o.lowest < o.low else []
    return " and ".join([*ends, *([_place(o.highest)] if o.highest > o.high else [])])


def _parts(c: Comparison) -> Section:
    rows = []
    for i in c.items:
        parts = i.parts[:MOST_PARTS]
        rows += [[_name(i, c), p.label, number(p.rms), number(p.most, 1), ERROR_UNITS[i.unit]] for p in parts]
    words = [f"{_name(i, c)} reads {_components_read(i.sees)}." for i in c.items]
    if not rows:
        return Section("What the model predicts", [*words, "No effect of the model enters these readings."])
    head = ("measurement", "effect", "root mean square", "largest", "unit")
    return Section("What the model predicts", words, Table(head, rows, "", (0, 1, 4)))


def _noise(c: Comparison) -> Section:
    words = []
    for i in c.items:
        unit = ERROR_UNITS[i.unit]
        source = "repeats" if i.noise.repeats is not None else "neighbouring readings"
        text = f"{_name(i, c)}: {number(i.floor)} {unit} between {source}"
        if i.noise.drift > SLOW * i.floor:
            text += f"; {_drift(i, f'{number(i.noise.drift)} {unit} of slow drift')}"
        words.append(f"{text}.")
    return Section("Where the noise floor comes from", words)


def _drift(i: Compared, drift: str) -> str:
    if i.drift_goes_with == AGAIN:
        return f"no drift: most of the residual {AGAIN}"
    return (
        f"{drift}, most of which {i.drift_goes_with}"
        if i.drift_goes_with
        else f"{drift} that no recorded channel explains"
    )


def _components_read(sees: Sequence[str]) -> str:
    more = f" and {len(sees) - MOST_SEEN} more" if len(sees) > MOST_SEEN else ""
    return (", ".join(sees[:MOST_SEEN]) or "no component error") + more


MAP_BINS, LEAST_IN_CELL = 12, 3
MOST_SENSORS = 8


def _pictures(c: Comparison) -> list[Section]:
    """Sections with figures, for each reading column; that of the verdict comes first."""
    out: list[Section] = []
    for item, s in sorted(zip(c.items, c.traces.readings.series, strict=True), key=lambda pair: _badness(pair[0])):
        several = sum(i.name == item.name for i in c.items) > 1
        title = f"{item.name} {item.column}" if several else item.name
        for kind, figure in _figures(c, item, s, title):
            out.append(
                Section(
                    f"{title}: {kind}",
                    [],
                    None,
                    Figure(f"{name_of_file(title)}-{figure.name}", figure.png, figure.shows),
                )
            )
    return out


def _figures(c: Comparison, item: Compared, s: Series, title: str) -> list[tuple[str, Figure]]:
    readings, unit = c.traces.readings, ERROR_UNITS[item.unit]
    measured, predicted = c.traces.measured[s.part], c.traces.predicted[s.part]
    left = measured - predicted
    out = []
    polar = draw.circle_picture(readings, s, title, measured, predicted)
    if polar is not None:
        shows = "Measured and predicted drawn outwards from the circle; beside it the residual."
        out.append(("measured and predicted on the circle", Figure("polar.png", polar, shows)))
    main = draw.angle_of(readings, s) or _main_axis(readings, s)
    if main is not None:
        name, place, direction = main
        png = draw.over_position(title, unit, name, place, direction, measured, predicted, item.floor)
        where = "position, each direction by itself" if polar is None else "the angle on the circle"
        shows = f"Measured and predicted over {where}; below it the residual."
        out.append(("measured and predicted", Figure("position.png", png, shows)))
    cells = None if polar else _map(readings, s, left, main, {b.channel for r in item.worst[:1] for b in r.bounds})
    if cells is not None:
        png = draw.residual_map(title, unit, *cells, item.floor)
        out.append(("residual by place", Figure("map.png", png, "Mean residual, channel by channel.")))
    scale, time_name = time_unit(float(s.time_s[-1] - s.time_s[0]))
    hours = (s.time_s - s.time_s[0]) / scale
    png = draw.over_time(
        title, unit, time_name, hours, left, measured if main is None else None, item.floor, _sensors(readings, s)
    )
    out.append(("residual over time", Figure("time.png", png, "Residual over time, and the temperatures.")))
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
        if moves(readings.measurements[s.source], axis, s.row) and (best is None or span > best[0]):
            best = span, f"{axis.name}, mm", place, np.sign(state.value(axis.direction_channel)[s.row])
    return None if best is None else best[1:]


def _sensors(readings: Readings, s: Series) -> list[tuple[str, Floats]]:
    """Temperatures, those that vary most first."""
    state = readings.states[s.source]
    found = [(n, state.channels[n][s.row]) for n in readings.machine.sensor_names if n in state.channels]
    found = [(n, v) for n, v in found if np.isfinite(v).any()]
    return sorted(found, key=lambda one: -float(np.nanmax(one[1]) - np.nanmin(one[1])))[:MOST_SENSORS]


def _stack(c: Comparison, item: Compared, s: Series, main: tuple[str, Floats, Floats] | None) -> draw.Stack | None:
    """The effects along position, time or a temperature: the channel whose means show most of the prediction."""
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
    readings: Readings, s: Series, residual: Floats, main: tuple[str, Floats, Floats] | None, preferred: set[str]
) -> Cells | None:
    """The map that shows most of the residual: position over a temperature or time, or two channels at rest."""
    scale, name = time_unit(float(np.ptp(s.time_s)))
    warm = [(f"{n}, °C", v) for n, v in _sensors(readings, s) if np.isfinite(v).all() and np.ptp(v) > REAL_DEGC]
    slow = [*warm, (f"time since the first reading, {name}", (s.time_s - s.time_s[0]) / scale)]
    pairs = [((main[0], main[1]), up) for up in slow] if main else list(combinations(slow, 2))
    # If possible, the map has a channel that defines the worst region.
    pairs = [p for p in pairs if any(name.split(",")[0] in preferred for name, _ in p[1 if main else 0 :])] or pairs
    ways = _ways(main[2] if main else np.zeros(len(residual)))
    maps = [m for one, two in pairs if (m := _cells(one, two, residual, ways)) is not None]
    return max(maps, key=lambda m: m[0])[1] if maps else None


def _ways(direction: Floats) -> list[tuple[str, Floats]]:
    """Both directions separately, so that their means do not cancel; name and 1 or 0, (n,)."""
    if len(np.unique(direction)) < 2:
        return [("", np.ones(len(direction)))]
    return [(", moving +", (direction > 0).astype(float)), (", moving −", (direction < 0).astype(float))]


def _cells(
    across: tuple[str, Floats], up: tuple[str, Floats], residual: Floats, ways: Sequence[tuple[str, Floats]]
) -> tuple[float, Cells] | None:
    """Share of the mean square in the means of the cells, minus that of noise alone; and the cells."""
    x, y = (cut_into("T_", v, MAP_BINS) for _, v in (across, up))
    if x is None or y is None:
        return None
    code, size = y.code * len(x) + x.code, len(x) * len(y)
    shown, filled, means = 0.0, 0.0, []
    for name, weight in ways:
        counts = np.bincount(code, weights=weight, minlength=size)
        sums = np.bincount(code, weights=residual * weight, minlength=size)
        full = counts >= LEAST_IN_CELL
        means.append((name, np.where(full, sums / np.maximum(counts, 1.0), np.nan).reshape(len(y), len(x))))
        squares = max(float(residual @ residual), 1e-30)
        shown += float(np.sum(sums[full] ** 2 / counts[full])) / squares - full.sum() / len(residual)
        filled += float(full.mean()) / len(ways)
    # A thin diagonal, as from two sensors on one body, shows no more than one sensor: such a map counts less.
    edges = [np.append(v.low, v.high[-1]) for v in (x, y)]
    return shown * min(1.0, 2.0 * filled), ((across[0], edges[0]), (up[0], edges[1]), means)
