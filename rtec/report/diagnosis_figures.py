"""Figures of a diagnosis: the evidence of a finding, and the candidates beside each other."""

import math
from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from rtec.report.evidence import Amplitudes, Evidence
from rtec.report.figures import GREY, OFF, ON, as_png, canvas, room_above, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

MOST_DOTS, MOST_MARKERS = 4000, 120
LEVEL_COLOURS = ("#3B1C8C", "#2A6FB0", "#1FA187", "#A8A800", "#D55E00")
"""From the lowest to the highest level of a second variable: hue and lightness change together."""
ROW_IN = 5.2
LOOKS = {0: ("o", "-"), 1: ("^", "-"), -1: ("v", "--")}
WAYS = {0: "", 1: ", moving +", -1: ", moving −"}
"""Marker, line and name of both directions together, and of each."""
NO_BETTER = 0.005
"""Smallest relative fall of the mean square that is shown."""
LONG = 24
"""Largest number of letters of a name on one line; longer names are on two lines."""


@as_png
def evidence_figure(rows: Sequence[Evidence]) -> "MplFigure":
    """The residual and the part that the finding explains, one row a reading column."""
    figure = canvas(ROW_IN * len(rows))
    for part, row in zip(figure.subfigures(len(rows), 1, squeeze=False)[:, 0], rows, strict=True):
        part.suptitle(row.title, x=0.01, ha="left", fontsize=17, fontweight="bold")
        if row.amplitudes:
            shapes, sizes = part.subplots(1, 2, width_ratios=(3, 2))
            _draw_curves(shapes, row)
            _draw_amplitudes(sizes, row.unit, row.amplitudes)
        elif row.causes:
            top, *others = part.subplots(1 + len(row.causes), 1, sharex=True, height_ratios=(3, *[1] * len(row.causes)))
            _draw_curves(top, row)
            top.set_xlabel("")
            _draw_causes(others, row)
        else:
            _draw_curves(part.subplots(), row)
    return figure


def _draw_curves(ax: "Axes", row: Evidence) -> None:
    if not row.second:
        thin = slice(None, None, max(1, len(row.dots[0]) // MOST_DOTS))
        ax.plot(row.dots[0][thin], row.dots[1][thin], linestyle="", marker=".", markersize=5, color=GREY, alpha=0.25,
                label="residual of each reading")  # fmt: skip
    for curve, colour in zip(row.curves, _colours(row), strict=True):
        marker, line = LOOKS[curve.direction]
        # White behind the line separates it from the dots.
        ax.plot(curve.place, curve.part, color="white", linewidth=6.0)
        ax.plot(curve.place, curve.part, color=colour, linestyle=line, linewidth=3.0)
        if len(curve.place) <= MOST_MARKERS:
            ax.plot(curve.place, curve.residual, linestyle="-" if row.second else "", linewidth=1.0, color=colour,
                    marker=marker, markersize=9, markeredgecolor="white")  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_xlabel(row.below)
    ax.set_ylabel(f"residual, {row.unit}")
    for way in dict.fromkeys(c.direction for c in row.curves):
        marker, line = LOOKS[way]
        colour = GREY if row.second else OFF if way < 0 else ON
        if len(row.curves[0].place) <= MOST_MARKERS:
            ax.plot([], [], linestyle="", marker=marker, markersize=9, color=colour, label=f"mean residual{WAYS[way]}")
        ax.plot([], [], linestyle=line, color=colour, linewidth=3.0, label=f"explained{WAYS[way]}")
    room_above(ax, 0.3 if len(row.curves) > 1 and not row.second else 0.2)
    ax.legend(fontsize=13, loc="upper left", ncols=3, frameon=True, facecolor="white", edgecolor="none",
              framealpha=0.9, columnspacing=1.0, handletextpad=0.4)  # fmt: skip
    if row.second:
        _name_levels(ax, row)


def _draw_causes(axes: "Sequence[Axes]", row: Evidence) -> None:
    """Draw the channels that drive the finding, over the same time."""
    order = np.argsort(row.dots[0], kind="stable")
    for ax, (name, value) in zip(axes, row.causes, strict=True):
        ax.plot(row.dots[0][order], value[order], color=GREY, drawstyle="steps-post")
        ax.set_ylabel(name.replace(", ", ",\n"))
    axes[-1].set_xlabel(row.below)


def _name_levels(ax: "Axes", row: Evidence) -> None:
    """Write the value of the second variable at the end of its curve; moved up where two would overlap."""
    last = {c.level: (c, colour) for c, colour in zip(row.curves, _colours(row), strict=True) if c.level is not None}
    ends = sorted(last.items(), key=lambda item: float(item[1][0].part[-1]))
    values = [v for v, _ in ends]
    digits = decimals(min(np.diff(np.sort(values)), default=1.0))
    low, high = ax.get_ylim()
    heights = spread_out([float(c.part[-1]) for _, (c, _) in ends], 0.075 * (high - low))
    for (value, (_, colour)), height in zip(ends, heights, strict=True):
        ax.annotate(f"{value:.{digits}f}", (1.0, height), (6, 0), xycoords=ax.get_yaxis_transform(),
                    textcoords="offset points", ha="left", va="center", color=colour, fontweight="bold", fontsize=14,
                    annotation_clip=False)  # fmt: skip
    ax.set_title(row.second, loc="right", fontsize=14, fontweight="normal")


def spread_out(heights: Sequence[float], least: float) -> list[float]:
    """Rising heights with a distance of at least `least`, as near to the given ones as possible (least squares)."""
    step = least * np.arange(len(heights))
    level = np.asarray(heights, dtype=np.float64) - step
    # The nearest rising sequence: neighbours that would cross get their mean.
    blocks: list[list[float]] = []
    for value in level:
        blocks.append([float(value)])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    flat = [float(np.mean(b)) for b in blocks for _ in b]
    return [float(v) for v in np.asarray(flat) + step]


def decimals(step: float) -> int:
    """Number of decimals that shows a difference of one step."""
    return max(0, -math.floor(math.log10(max(step, 1e-6))))


def _colours(row: Evidence) -> list[str]:
    """Colours of the curves: by level where there is a second variable, else by direction."""
    if not row.second:
        return [OFF if c.direction < 0 else ON for c in row.curves]
    levels = sorted({c.level for c in row.curves if c.level is not None})
    spread = np.linspace(0, len(LEVEL_COLOURS) - 1, len(levels)).round().astype(int)
    return [LEVEL_COLOURS[spread[levels.index(c.level)]] for c in row.curves if c.level is not None]


def _draw_amplitudes(ax: "Axes", unit: str, a: Amplitudes) -> None:
    """Draw the size of the shape over the variable that sets it: dots from the residual, the line from the finding."""
    ax.plot(a.value, a.explained, color=OFF, linewidth=3.0, label="explained")
    ax.errorbar(a.value, a.measured, 2.0 * a.error, linestyle="", marker="o", markersize=9, color=ON,
                markeredgecolor="white", capsize=4, elinewidth=1.6, label="residual, ± 2 std. errors")  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_title("Height of this shape")
    ax.set_xlabel(a.below)
    ax.set_ylabel(f"lowest to highest, {unit}")
    room_above(ax, 0.25)
    ax.legend(fontsize=13, loc="upper left", frameon=True, facecolor="white", edgecolor="none", framealpha=0.9)


@as_png
def rivals(rows: Sequence[tuple[str, float, bool, str]]) -> "MplFigure":
    """Bars of the share of the residual that each candidate explains on held-out runs, best on top.

    Args:
        rows: label, relative fall of the mean square, whether it belongs to the winner's group, and a short reason why
            it is preferred or not.
    """
    figure, (ax,) = stacked(0.74 * len(rows) + 2.0)
    groups = (("named, or confounded with what is named", ON, ""), ("not preferred", "#BBBBBB", "//"))
    for place, (name, drop, chosen, why) in enumerate(reversed(rows)):
        label, colour, hatch = groups[0 if chosen else 1]
        ax.barh(place, 100.0 * max(drop, 0.0), 0.7, color=colour, hatch=hatch, edgecolor="white", label=label)
        said = f"{100.0 * drop:.0f} %" if drop >= NO_BETTER else "no better"
        ax.text(100.0 * max(drop, 0.0), place, f" {said}", va="center", fontsize=14)
        ax.text(0.97, place, fill(why, 22), va="center", fontsize=12, color=ON if chosen else GREY,
                linespacing=1.2, transform=ax.get_yaxis_transform())  # fmt: skip
        ax.text(-0.02, place, _on_two(name), va="center", ha="right", fontsize=13, linespacing=1.2,
                transform=ax.get_yaxis_transform())  # fmt: skip
    ax.set_yticks([])
    ax.set_xlim(0, 119)
    ax.set_xticks(range(0, 101, 20))
    figure.suptitle("How much of the residual each candidate explains, and how likely it is", x=0.01, ha="left",
                    fontsize=17, fontweight="bold")  # fmt: skip
    ax.set_xlabel("fall of the mean square residual on held-out runs, %")
    ax.grid(visible=False, axis="y")
    # One entry each, in the order of the list, above the bars, where there is always room.
    handles, names = ax.get_legend_handles_labels()
    once = dict(zip(names, handles, strict=True))
    kept = [n for n, _, _ in groups if n in once]
    ax.legend([once[n] for n in kept], kept, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
              fontsize=13, borderaxespad=0.2)  # fmt: skip
    return figure


def _on_two(name: str) -> str:
    """A long label, broken into two lines at the bracket."""
    return name.replace("(", "\n(", 1) if len(name) > LONG else name
