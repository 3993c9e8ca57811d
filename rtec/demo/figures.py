"""Figures of the demo's report: the day over time, part by part, and the uncorrected rest.

Uncorrected and corrected differ in colour, marker and line.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from rtec.arrays import Floats
from rtec.report.figures import GREY, KINDS, LINES, OFF, ON, as_png, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure


@as_png
def over_time(hours: Floats, panels: Sequence[tuple[str, Floats, Floats]], night_from_h: float) -> "MplFigure":
    """Errors over the day, one panel a kind, uncorrected and corrected.

    Args:
        hours: (n,).
        panels: title, then uncorrected and corrected error, µm, (n,) or (n, places): the mean as a line, the range
            over the places as a band.
        night_from_h: time from which the machine is at rest and cools.
    """
    figure, axes = stacked(*[3.9] * len(panels))
    for ax, (title, *both) in zip(axes, panels, strict=True):
        _night(ax, hours, night_from_h)
        for values, style in zip(both, KINDS, strict=True):
            rows = values.reshape(len(hours), -1)
            ax.fill_between(hours, rows.min(axis=1), rows.max(axis=1), color=style["color"], alpha=0.25, linewidth=0)
            ax.plot(hours, rows.mean(axis=1), **style)
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(title)
        ax.set_ylabel("error, µm")
        _names(ax, hours, [v.reshape(len(hours), -1).mean(axis=1) for v in both])
    axes[-1].set_xlabel("time since the cold start, hours")
    return figure


@as_png
def straightness_bars(hours: Floats, panels: Sequence[tuple[str, Floats, Floats]]) -> "MplFigure":
    """One bar a part, uncorrected and corrected side by side.

    Args:
        hours: time of the cut, (n,).
        panels: title, then uncorrected and corrected, µm, (n,).
    """
    figure, axes = stacked(*[3.6] * len(panels))
    place = np.arange(len(hours))
    for ax, (title, *both) in zip(axes, panels, strict=True):
        for shift, values, style, name in zip((-0.2, 0.2), both, KINDS, ("uncorrected", "corrected"), strict=True):
            hatch = "//" if name == "uncorrected" else ""
            ax.bar(place + shift, values, 0.4, color=style["color"], hatch=hatch, edgecolor="white", label=name)
        ax.set_title(title)
        ax.set_ylabel("straightness, µm")
        ax.set_xticks(place[::2], [f"{h:.0f}" for h in hours[::2]])
        ax.grid(visible=False, axis="x")
        ax.set_ylim(0, 1.25 * max(float(v.max()) for v in both))
        ax.legend(ncols=2, frameon=False, loc="upper right", borderaxespad=0.0)
    axes[-1].set_xlabel("part cut at, time since the cold start, hours")
    return figure


@as_png
def profiles(panels: Sequence[tuple[str, str, Floats, Floats, Floats]]) -> "MplFigure":
    """The line of a surface, uncorrected and corrected, about its best-fit line.

    Args:
        panels: title, title of the lower axis, place, mm, (n,), uncorrected and corrected, µm, (n,).
    """
    figure, axes = stacked(*[3.6] * len(panels))
    for ax, (title, below, place, *both) in zip(axes, panels, strict=True):
        for values, style in zip(both, KINDS, strict=True):
            ax.plot(place, values, color=style["color"], linestyle=style["linestyle"])
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(title)
        ax.set_xlabel(below)
        ax.set_ylabel("error, µm")
        _names(ax, place, both)
    return figure


@as_png
def temperatures(hours: Floats, degc: Mapping[str, Floats], night_from_h: float) -> "MplFigure":
    """Temperatures over the day, °C, (n,) by name; names in the order of the maxima."""
    figure, (ax,) = stacked(5.5)
    _night(ax, hours, night_from_h)
    hottest_first = sorted(enumerate(degc.items()), key=lambda item: -float(item[1][1].max()))
    for place, (name, values) in hottest_first:
        ax.plot(hours, values, color=LINES[place % len(LINES)], label=name)
    ax.legend(loc="upper right", title="hottest first", frameon=True, facecolor="white", framealpha=1.0)
    ax.set_title("Temperatures that the sensors read")
    ax.set_ylabel("temperature, °C")
    ax.set_xlabel("time since the cold start, hours")
    return figure


@as_png
def shares(title: str, rows: Sequence[tuple[str, float, float]]) -> "MplFigure":
    """Horizontal bars, largest on top: name, root mean square and largest size, µm."""
    figure, (ax,) = stacked(0.62 * len(rows) + 1.4)
    for place, (name, rms, largest) in enumerate(reversed(rows)):
        ax.barh(place, largest, 0.72, color="#9FC5E8")
        ax.barh(place, rms, 0.36, color=ON)
        ax.text(largest, place, f"  {rms:.2f} µm, at most {largest:.1f}", va="center", fontsize=14)
        ax.text(-0.02, place, name, va="center", ha="right", transform=ax.get_yaxis_transform())
    ax.set_yticks([])
    ax.set_xlim(0, 1.45 * max(largest for _, _, largest in rows))
    ax.set_title(title)
    ax.set_xlabel("error at the tool tip, µm: dark bar root mean square, light bar largest")
    ax.grid(visible=False, axis="y")
    return figure


@as_png
def tip_by_part(title: str, rows: Sequence[tuple[str, Floats]]) -> "MplFigure":
    """Tip error part by part with several models, side by side.

    Args:
        title: title of the figure.
        rows: name, root mean square of each part, µm, (parts,); drawn in grey, orange, blue.
    """
    figure, (ax,) = stacked(4.4)
    wide = 0.8 / len(rows)
    styles = (("#999999", ""), (OFF, "//"), (ON, ""))
    for k, ((name, values), (colour, hatch)) in enumerate(zip(rows, styles, strict=False)):
        place = np.arange(len(values)) + (k - 0.5 * (len(rows) - 1)) * wide
        ax.bar(place, values, wide, color=colour, hatch=hatch, edgecolor="white", label=name)
    ax.set_xticks(np.arange(len(rows[0][1])), [str(i + 1) for i in range(len(rows[0][1]))])
    ax.set_ylim(0.0, 1.35 * max(float(v.max()) for _, v in rows))
    ax.grid(visible=False, axis="x")
    ax.set_title(title)
    ax.set_xlabel("part, the first cut cold")
    ax.set_ylabel("error at the tool tip, µm rms")
    ax.legend(ncols=len(rows), frameon=False, loc="upper left", fontsize=13)
    return figure


def _night(ax: "Axes", hours: Floats, from_h: float) -> None:
    if hours[-1] <= from_h:
        return
    ax.axvspan(from_h, float(hours[-1]), color="#ECECEC", zorder=0)
    ax.text(
        0.5 * (from_h + float(hours[-1])), 0.03, "night: machine stands and cools", color=GREY, ha="center",
        va="bottom", transform=ax.get_xaxis_transform(), fontsize=13,
    )  # fmt: skip


def _names(ax: "Axes", place: Floats, both: Sequence[Floats]) -> None:
    """Write the name of each line at the largest distance of the two, on the outer side."""
    low, high = min(float(v.min()) for v in both), max(float(v.max()) for v in both)
    room = max(high - low, 1e-9)
    ax.set_ylim(*_with_room(ax.get_ylim(), 0.16 * room))
    inner = slice(len(place) // 6, len(place) - len(place) // 6)
    at = inner.start + int(np.argmax(np.abs(both[0] - both[1])[inner]))
    above = both[0][at] > both[1][at]
    for values, style, name, up in zip(both, KINDS, ("uncorrected", "corrected"), (above, not above), strict=True):
        edge = float(values.max() if name == "uncorrected" and up else values[at])
        ax.annotate(
            name, (place[at], edge), (0, 12 if up else -12), textcoords="offset points", color=style["color"],
            fontweight="bold", ha="center", va="bottom" if up else "top",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8},
        )  # fmt: skip


def _with_room(limits: tuple[float, float], room: float) -> tuple[float, float]:
    return limits[0] - room, limits[1] + room
