"""Figures of a comparison, from arrays to PNG.

Residuals over position with both directions, over time with the temperatures, on the circle of a ball bar, and as a
map of two channels; and the contribution of each effect, as bars and stacked along the channel that shows most.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.diagnosis.compare.bins import cut_into
from rtec.estimation.readings import Readings, Series
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.report.ball_bar_figures import MIDDLE, ROOM, CircleTrace, around, arrow, frame
from rtec.report.figures import GREY, LINES, OFF, ON, WHOLE, WIDTH_IN, Png, Zoom, as_png, canvas, stacked, zoomed
from rtec.report.thinning import is_position
from rtec.wording import significant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure


COLOURS, OTHERS = LINES[2:], "#A6A6A6"
BINS, LEAST = 12, 3
WIDE = 0.9
"""Share of a bin's width that its bars fill."""
MOST_BARS = 10
STACK_IN = 4.8
LONG = 22
"""Largest number of letters of a name on one line; longer names are on two lines."""
PLACES = 48
MOST_DOTS = 6000


@as_png
def over_position(
    title: str,
    unit: str,
    below: str,
    place: Floats,
    direction: Floats,
    measured: Floats,
    predicted: Floats,
    floor: float,
) -> "MplFigure":
    """Measured and predicted over position, both directions; below the residual, with the noise floor as a band.

    Args:
        title: title of the figure.
        unit: unit of the readings, for people.
        below: title of the lower axis.
        place: positions, mm, (n,).
        direction: -1, 0 or +1, (n,).
        measured, predicted: (n,).
        floor: noise, root mean square.
    """
    figure, (top, low) = stacked(4.4, 4.4, share=True)
    low.axhspan(-floor, floor, color="#E4E4E4", zorder=0, label="noise of one reading")
    drawn: list[tuple[Floats, Floats]] = []
    for name, mask, colour, marker, _ in _ways(direction):
        at, mean, spread = _by_place(place[mask], measured[mask])
        top.errorbar(at, mean, spread, color=colour, marker=marker, linestyle="", markersize=8, elinewidth=1.4,
                     label=f"measured{name}")  # fmt: skip
        drawn.append(_by_place(place[mask], predicted[mask])[:2])
        at, mean, spread = _by_place(place[mask], (measured - predicted)[mask])
        # Shifted, so that the bars of one direction do not hide those of the other.
        aside = 0.004 * float(np.ptp(place)) * (1.0 if marker == "^" else -1.0)
        low.errorbar(at + aside, mean, spread, color=colour, marker=marker, linestyle=":", linewidth=1.2, markersize=8,
                     elinewidth=1.4, label=f"residual{name}")  # fmt: skip
    if len(drawn) == 2 and _alike(*drawn):
        top.plot(*drawn[0], color="black", linewidth=2.6, label="predicted, both directions")
    else:
        for (name, _, colour, _, line), points in zip(_ways(direction), drawn, strict=True):
            top.plot(*points, color=colour, linestyle=line, linewidth=2.6, label=f"predicted{name}")
    top.set_title(title)
    for ax, what in ((top, "error"), (low, "residual")):
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_ylabel(f"{what}, {unit}")
        _legend_above(ax)
    low.set_xlabel(f"{below}; mean of all runs, bars: standard deviation between them")
    return figure


@as_png
def over_channel(
    title: str,
    unit: str,
    below: str,
    value: Floats,
    residual: Floats,
    direction: Floats,
    floor: float,
    shade: tuple[str, Floats] | None = None,
    *,
    predicted: Floats | None = None,
    marked: Ints | None,
    zoom: Zoom,
) -> "MplFigure":
    """The residual of each reading over any channel, coloured by direction or by another channel.

    Args:
        title: title of the figure.
        unit: unit of the readings, for people.
        below: title of the channel.
        value: its values, (n,).
        residual: measured minus predicted, (n,); with `predicted` the readings themselves.
        direction: -1, 0 or +1, (n,).
        floor: noise, root mean square; NaN where it is unknown.
        shade: title and values, (n,), of the channel for the colours; None: by direction.
        predicted: predictions, (n,): a line over a position, else a mark for each reading; None: without.
        marked: rows of readings that stand out, (k,); None: none.
        zoom: the visible part.
    """
    figure = canvas(5.4)
    ax = figure.subplots()
    if np.isfinite(floor):
        ax.axhspan(-floor, floor, color="#E4E4E4", zorder=0, label="noise of one reading")
    thin, what = _thin(value, residual, zoom), "residual" if predicted is None else "measured"
    pale = 0.35 if marked is not None and len(marked) else 1.0
    if shade is not None:
        dots = ax.scatter(value[thin], residual[thin], c=shade[1][thin], cmap="plasma", s=26, alpha=0.8 * pale)
        figure.colorbar(dots, ax=ax).set_label(shade[0])
    else:
        for name, mask, colour, marker, _ in _ways(direction):
            some = thin[mask[thin]]
            ax.plot(value[some], residual[some], color=colour, marker=marker, linestyle="", markersize=6,
                    alpha=0.7 * pale, label=f"{what}{name}")  # fmt: skip
    if predicted is not None:
        for name, mask, colour, marker, line in _ways(direction):
            known = mask & np.isfinite(value)
            if is_position(below):
                at, mean, _ = _by_place(value[known], predicted[known])
                ax.plot(at, mean, color=colour, linestyle=line, label=f"predicted{name}")
                continue
            some = thin[known[thin]]
            ax.plot(value[some], predicted[some], color=colour, marker=marker, linestyle="", markersize=6,
                    markerfacecolor="none", label=f"predicted{name}")  # fmt: skip
    _mark(ax, value, residual, marked)
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_title(title)
    ax.set_xlabel(below)
    ax.set_ylabel(f"{'residual' if predicted is None else 'error'}, {unit}")
    _legend_above(ax)
    zoomed(ax, zoom)
    return figure


def _thin(x: Floats, y: Floats, zoom: Zoom) -> Ints:
    """Rows of the drawn readings, rising: evenly chosen from those in the visible part."""
    inside = np.ones(len(x), dtype=bool)
    for axis, values in (("x", x), ("y", y)):
        low, high = sorted(zoom.get(axis, (-np.inf, np.inf)))
        inside &= (values >= low) & (values <= high)
    rows = np.flatnonzero(inside)
    return rows[:: max(1, len(rows) // MOST_DOTS)]


def _mark(ax: "Axes", x: Floats, y: Floats, marked: Ints | None) -> None:
    if marked is not None and len(marked):
        ax.plot(x[marked], y[marked], linestyle="", marker="o", markersize=8, color="#F0C000", markeredgecolor="black",
                label=f"marked: {len(marked)}")  # fmt: skip


@as_png
def around_circle(
    title: str, unit: str, angle_rad: Floats, measured: Floats, predicted: Floats, marked: Ints
) -> "MplFigure":
    """Readings of a ball bar around its circle, magnified, some of them marked.

    Args:
        title: title of the figure.
        unit: unit of the readings.
        angle_rad: angle of each reading, (n,).
        measured, predicted: (n,).
        marked: rows of the marked readings, (k,).
    """
    figure = canvas(7.6)
    ax: Any = figure.add_subplot(projection="polar")
    most = max(float(np.abs(measured).max()), float(np.abs(predicted).max()), 1e-9)
    thin = np.arange(0, len(measured), max(1, len(measured) // MOST_DOTS))
    ax.plot(
        angle_rad[thin], measured[thin] + 2.0 * most, linestyle="", marker=".", color=OFF, alpha=0.3, label="measured"
    )
    ax.plot(
        angle_rad[thin],
        predicted[thin] + 2.0 * most,
        linestyle="",
        marker=".",
        color=ON,
        markersize=3,
        label="predicted",
    )
    _mark(ax, angle_rad, measured + 2.0 * most, marked)
    ax.set_ylim(0.0, 3.2 * most)
    ax.set_yticks([most, 2.0 * most, 3.0 * most], [f"{v:+.1f} {unit}" for v in (-most, 0.0, most)])
    ax.set_title(title)
    ax.legend(loc="center left", bbox_to_anchor=(1.1, 0.5), frameon=False, fontsize=13)
    return figure


@as_png
def preview(below: str, unit: str, place: Floats, readings: Mapping[str, Floats], zoom: Zoom = WHOLE) -> "MplFigure":
    """Readings of a table that is being imported, over the axis that moved most.

    Args:
        below: title of that axis.
        unit: unit of the readings.
        place: its values, (n,).
        readings: reading columns, by name, (n,) each.
        zoom: the visible part.
    """
    figure = canvas(4.8)
    ax = figure.subplots()
    for k, (name, values) in enumerate(readings.items()):
        ax.plot(place, values, linestyle="", marker="os^v"[k % 4], markersize=5, color=LINES[(2 + k) % len(LINES)],
                label=name)  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_xlabel(below)
    ax.set_ylabel(f"reading, {unit}")
    _legend_above(ax)
    zoomed(ax, zoom)
    return figure


def _ways(direction: Floats) -> list[tuple[str, Bools, str, str, str]]:
    ways = [(", moving +", direction > 0, ON, "^", "-"), (", moving −", direction < 0, OFF, "v", "--")]
    there = [w for w in ways if w[1].any()]
    return there or [("", np.ones(len(direction), dtype=bool), ON, "o", "-")]


def _alike(one: tuple[Floats, Floats], two: tuple[Floats, Floats]) -> bool:
    """Whether two lines visibly coincide."""
    seen = 0.005 * max(float(np.ptp(np.concatenate([one[1], two[1]]))), 1e-9)
    return one[0].shape == two[0].shape and bool(np.allclose(one[1], two[1], atol=seen))


def _by_place(place: Floats, value: Floats) -> tuple[Floats, Floats, Floats]:
    """Place, mean and standard deviation at each target, or in intervals if there are too many targets, (k,) each."""
    targets = np.round(place, 1)
    levels = np.unique(targets)
    if len(levels) > PLACES:
        edges = np.linspace(float(place.min()), float(place.max()), PLACES + 1)
        code = np.clip(np.searchsorted(edges, place, side="right") - 1, 0, PLACES - 1)
    else:
        code = np.searchsorted(levels, targets)
    parts = [np.flatnonzero(code == k) for k in np.unique(code)]
    return (
        np.array([float(place[p].mean()) for p in parts]),
        np.array([float(value[p].mean()) for p in parts]),
        np.array([float(value[p].std()) for p in parts]),
    )


def _legend_above(ax: "Axes") -> None:
    handles, names = ax.get_legend_handles_labels()
    room = ax.get_ylim()
    ax.set_ylim(room[0], room[1] + 0.28 * (room[1] - room[0]))
    ax.legend(handles, names, ncols=min(len(names), 4), loc="upper center", facecolor="white", edgecolor="none",
              framealpha=0.9, fontsize=12, columnspacing=1.1, handlelength=1.5, handletextpad=0.5)  # fmt: skip


@as_png
def over_time(
    title: str,
    unit: str,
    time_unit: str,
    time: Floats,
    residual: Floats,
    measured: Floats | None,
    floor: float,
    sensors: Sequence[tuple[str, Floats]],
    *,
    marked: Ints | None = None,
    zoom: Zoom = WHOLE,
) -> "MplFigure":
    """The residual over time, with the temperatures below.

    Args:
        title: title of the figure.
        unit: unit of the readings.
        time_unit: unit of the times.
        time: time since the first reading, (n,).
        residual: measured minus predicted, (n,).
        measured: readings that are drawn, too, (n,), for an instrument at one place; or None.
        floor: noise, root mean square.
        sensors: name and temperature, °C, (n,).
        marked: rows of readings that stand out, (k,); None: none.
        zoom: the visible part.
    """
    figure, axes = stacked(*[4.2] * (2 if sensors else 1))
    ax = axes[0]
    ax.axhspan(-floor, floor, color="#E4E4E4", zorder=0, label="noise of one reading")
    thin = _thin(time, residual, zoom)
    if measured is not None:
        ax.plot(time[thin], measured[thin], color=GREY, linestyle="", marker="+", markersize=5, label="measured")
    ax.plot(time[thin], residual[thin], color=ON, linestyle="", marker="o", markersize=3.5, label="residual",
            alpha=0.2 if marked is not None and len(marked) else 0.5)  # fmt: skip
    _mark(ax, time, residual, marked)
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_title(title)
    ax.set_ylabel(f"{'residual' if measured is None else 'error'}, {unit}")
    _legend_above(ax)
    zoomed(ax, zoom)
    if sensors:
        for place, (name, value) in enumerate(sensors):
            axes[1].plot(*_with_gaps(time, value), color=LINES[place % len(LINES)], label=name, linewidth=2.2)
        axes[1].set_title("Temperatures")
        axes[1].set_ylabel("temperature, °C")
        axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=13)
        axes[1].set_xlim(axes[0].get_xlim())
        zoomed(axes[1], zoom, "y2")
    axes[-1].set_xlabel(f"time since the first reading, {time_unit}")
    return figure


def _with_gaps(time: Floats, value: Floats) -> tuple[Floats, Floats]:
    """Times and values with NaN in gaps of the readings, so that no line is drawn there."""
    if len(time) < 3:
        return time, value
    wide = np.flatnonzero(np.diff(time) > max(20.0 * float(np.median(np.diff(time))), 0.02 * float(np.ptp(time)))) + 1
    return np.insert(time, wide, np.nan), np.insert(value, wide, np.nan)


def angle_of(readings: Readings, s: Series) -> tuple[str, Floats, Floats] | None:
    """Name, angle, degrees about the middle of the arc, and no direction, of a ball bar's readings; None for others."""
    bar, angle = _bar(readings, s), readings.states[s.source].channels.get("angle_deg")
    if bar is None or angle is None:
        return None
    turned = bar.on_arc_deg(angle[s.row])
    return "angle on the circle, degrees", turned, np.zeros(len(turned))


def circle_picture(readings: Readings, s: Series, title: str, measured: Floats, predicted: Floats) -> Png | None:
    """Measured and predicted drawn outwards from the circle, beside it the residual; None for other instruments.

    Args:
        readings: all readings.
        s: the series of the ball bar.
        title: title of the figure.
        measured, predicted: µm, (n,), without the nuisance parameters (position of the ball on the table).
    """
    bar, angle = _bar(readings, s), readings.states[s.source].channels.get("angle_deg")
    if bar is None or angle is None:
        return None
    turned = np.deg2rad(angle[s.row])
    trace = CircleTrace("", bar.setup.sense, turned, measured, predicted)
    return polar_pair(title, bar.setup.letters[:2], trace, ("measured", "predicted", "residual"))


@as_png
def polar_pair(title: str, letters: tuple[str, str], trace: CircleTrace, names: tuple[str, str, str]) -> "MplFigure":
    """Two deviations drawn outwards from a circle, their difference beside it.

    Args:
        title: title of the figure.
        letters: directions of the plane, to the right and upwards.
        trace: both deviations.
        names: names of both, and of their difference.
    """
    figure = canvas(0.56 * WIDTH_IN)
    both, rest = figure.subplots(1, 2)
    gain = frame(both, letters, max(float(np.abs(v).max()) for v in (trace.measured_um, trace.fitted_um)))
    around(both, trace.angle_rad, MIDDLE + gain * trace.measured_um, GREY, "-", 3.0, 0.5, names[0])
    around(both, trace.angle_rad, MIDDLE + gain * trace.fitted_um, ON, "-", 2.0, 1.0, names[1])
    arrow(both, trace, MIDDLE + 1.1 * ROOM, GREY)
    residual = trace.measured_um - trace.fitted_um
    gain = frame(rest, letters, float(np.abs(residual).max()))
    around(rest, trace.angle_rad, MIDDLE + gain * residual, OFF, "-", 1.4, 1.0, names[2])
    for ax in (both, rest):
        ax.legend(loc="upper left", frameon=False, fontsize=13)
    figure.suptitle(f"{title}: deviation from the circle, magnified", x=0.01, ha="left", fontweight="bold")
    return figure


def _bar(readings: Readings, s: Series) -> BallBar | None:
    instrument = readings.measurements[s.source].instrument
    return instrument if isinstance(instrument, BallBar) else None


@as_png
def residual_map(
    title: str,
    unit: str,
    across: tuple[str, Floats],
    up: tuple[str, Floats],
    means: Sequence[tuple[str, Floats]],
    floor: float,
    zoom: Zoom = WHOLE,
) -> "MplFigure":
    """Mean residual in each cell: red above, blue below zero, hatched where there are few readings.

    Args:
        title: title of the figure.
        unit: unit of the readings.
        across, up: name with unit, and edges of the cells, (k + 1,).
        means: name of each panel, and the means, (up, across); NaN where there are few readings.
        floor: noise floor; limits the strength of the colours.
        zoom: the visible part.
    """
    figure, axes = stacked(*[5.6] * len(means))
    most = max(floor, *(float(np.abs(mean[np.isfinite(mean)]).max(initial=0.0)) for _, mean in means), 1e-9)
    for ax, (name, mean) in zip(axes, means, strict=True):
        _panel(figure, ax, unit, across, up, mean, most)
        ax.set_title(f"{title}{name}: mean residual in each cell, {unit}")
        zoomed(ax, zoom)
    axes[-1].set_xlabel(f"{across[0]}   (hatched: fewer than 3 readings)")
    return figure


def _panel(
    figure: "MplFigure",
    ax: "Axes",
    unit: str,
    across: tuple[str, Floats],
    up: tuple[str, Floats],
    mean: Floats,
    most: float,
) -> None:
    ax.set_facecolor("#F2F2F2")
    ax.patch.set_hatch("///")
    ax.patch.set_edgecolor("#CCCCCC")
    ax.grid(visible=False)
    shown = ax.pcolormesh(across[1], up[1], np.ma.masked_invalid(mean), cmap="RdBu_r", vmin=-most, vmax=most,
                          edgecolors="white", linewidth=0.6)  # fmt: skip
    x, y = (0.5 * (e[1:] + e[:-1]) for e in (across[1], up[1]))
    for i, j in zip(*np.nonzero(np.isfinite(mean)), strict=True):
        value = float(mean[i, j])
        ax.text(x[j], y[i], _short(value), ha="center", va="center", fontsize=11,
                color="white" if abs(value) > 0.6 * most else "black")  # fmt: skip
    bar = figure.colorbar(shown, ax=ax, pad=0.02)
    bar.set_label(f"mean residual, {unit}")
    ax.set_ylabel(up[0])


def _short(value: float) -> str:
    text = f"{value:.1f}" if abs(value) < 99.95 else f"{value:.0f}"
    return text.replace("-0.0", "0.0").replace("-", "−")


@dataclass(frozen=True)
class Stack:
    """Means in intervals of a channel; with motion in both directions, each has bars of its own.

    Attributes:
        along: name of the channel, with its unit.
        place, width: middle and width of each bar, (k,).
        parts: mean of each effect there, largest effect first, µm or µrad, (k,) each.
        measured: mean of the readings there, (k,).
        shows: share of the prediction's mean square in these means.
        ways: whether bars of both directions are beside each other.
    """

    along: str
    place: Floats
    width: Floats
    parts: Mapping[str, Floats]
    measured: Floats
    shows: float
    ways: bool


def stack_along(
    channel: tuple[str, Floats], direction: Floats | None, parts: Mapping[str, Floats], measured: Floats
) -> Stack | None:
    """Means along one channel; None where it does not vary.

    Args:
        channel: name with unit, and value at each reading, (n,).
        direction: -1 or +1, (n,), for bars of both directions; else None.
        parts: contribution of each effect, (n,) each.
        measured: readings, (n,).
    """
    cut = cut_into("T_", channel[1], BINS)
    if cut is None:
        return None
    ways = direction is not None and len(np.unique(direction)) == 2
    side = (np.asarray(direction) > 0).astype(np.int64) if ways else np.zeros(len(measured), dtype=np.int64)
    bars = 2 if ways else 1
    code, size = bars * cut.code + side, bars * len(cut)
    count = np.bincount(code, minlength=size)
    full = count >= LEAST
    if not full.any():
        return None

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(code, weights=values, minlength=size)[full] / count[full])

    predicted = np.sum(list(parts.values()), axis=0)
    held = float(np.sum(mean(predicted) ** 2 * count[full])) / max(float(predicted @ predicted), 1e-30)
    wide = np.repeat(cut.high - cut.low, bars) * WIDE / bars
    middle = np.repeat(0.5 * (cut.low + cut.high), bars) + wide * (
        np.tile(np.arange(bars), len(cut)) - 0.5 * (bars - 1)
    )
    return Stack(
        channel[0], middle[full], wide[full], {k: mean(v) for k, v in parts.items()}, mean(measured),
        held - full.sum() / len(measured), ways,
    )  # fmt: skip


def draw_stack(ax: "Axes", unit: str, stack: Stack) -> None:
    """Stack the effects, positive and negative ones separately; dots are the readings."""
    above, below = np.zeros(len(stack.place)), np.zeros(len(stack.place))
    for colour, values in zip(colours(len(stack.parts)), stack.parts.values(), strict=True):
        foot = np.where(values > 0.0, above, below)
        ax.bar(stack.place, values, stack.width, foot, color=colour, edgecolor="white", linewidth=0.5)
        above, below = above + np.maximum(values, 0.0), below + np.minimum(values, 0.0)
    ax.hlines(above + below, stack.place - 0.5 * stack.width, stack.place + 0.5 * stack.width, color="black",
              linewidth=2.4, label="predicted: the bars' sum")  # fmt: skip
    ax.plot(stack.place, stack.measured, linestyle="", marker="o", color="black", markersize=8, markeredgecolor="white",
            label="measured")  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    pairs = "; of two bars the left one moving −, the right one +" if stack.ways else ""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.18 * (high - low))
    ax.legend(loc="upper center", ncols=2, facecolor="white", edgecolor="none", framealpha=0.9, fontsize=13)
    ax.set_ylabel(f"effects stacked,\nmean, {unit}")
    ax.set_xlabel(f"{stack.along}{pairs}")


def colours(count: int) -> Sequence[str]:
    """A colour for each effect; grey for those beyond the number of distinguishable colours."""
    return [*COLOURS, *[OTHERS] * count][:count]


@as_png
def contributions(
    title: str,
    unit: str,
    rows: Sequence[tuple[str, float, float]],
    measured: float,
    residual: float,
    floor: float,
    stack: Stack | None = None,
) -> "MplFigure":
    """Contributions of the effects: bars between those of readings and residual; below, stacked along a channel.

    Args:
        title: title of the figure.
        unit: unit of the readings.
        rows: label, root mean square, largest size; in falling order.
        measured, residual, floor: root mean squares.
        stack: means along a channel, its effects in the order of `rows`.
    """
    shown = rows[:MOST_BARS]
    effects = [(name, rms, colour, "") for (name, rms, _), colour in zip(shown, colours(len(shown)), strict=True)]
    bars = [("measured", measured, GREY, ""), *effects, ("residual", residual, OFF, "//")]
    high = 0.7 * len(bars) + 1.6
    figure, axes = stacked(high, STACK_IN) if stack else stacked(high)
    if stack:
        draw_stack(axes[1], unit, stack)
    ax = axes[0]
    most = max(b[1] for b in bars)
    for place, (name, rms, colour, hatch) in enumerate(reversed(bars)):
        ax.barh(place, rms, 0.7, color=colour, hatch=hatch, edgecolor="white")
        ax.text(rms + 0.01 * most, place, f"{rms:.2f}", va="center", fontsize=14)
        ax.text(-0.02, place, _broken(name), va="center", ha="right", transform=ax.get_yaxis_transform(),
                linespacing=1.2)  # fmt: skip
    ax.axvspan(0.0, floor, color="#BBBBBB", alpha=0.6, zorder=3, linewidth=0)
    ax.set_yticks([])
    ax.set_xlim(0, 1.15 * most)
    # Across the names too: there is not always room beside them.
    figure.suptitle(f"{title}: what each effect adds", x=0.01, ha="left", fontsize=17, fontweight="bold")
    ax.set_xlabel(f"root mean square, {unit} (grey band: noise {significant(floor, 2)} {unit})")
    ax.grid(visible=False, axis="y")
    return figure


def _broken(name: str) -> str:
    """A long label on two lines."""
    return name.replace("(", "\n(", 1) if len(name) > LONG else name
