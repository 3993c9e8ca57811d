"""Figures of a comparison that are lines: over position with both directions, and over time with temperatures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.report.figures import GREY, LINES, OFF, ON, _figure, _png, _styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
PLACES = 48
MOST_DOTS = 6000


@_styled
def over_position(
    title: str,
    unit: str,
    below: str,
    place: Floats,
    direction: Floats,
    measured: Floats,
    predicted: Floats,
    floor: float,
) -> bytes:
    """Measured and predicted over position, both directions; below what is left, with the noise floor as a band.

    Args:
        title: of the figure.
        unit: of the readings, for people.
        below: name of the axis.
        place: mm, (n,).
        direction: -1, 0 or +1, (n,).
        measured, predicted: (n,).
        floor: noise, root mean square.
    """
    figure, (top, low) = _figure(2, 4.4)
    low.axhspan(-floor, floor, color="#E4E4E4", zorder=0, label="noise of one reading")
    for name, mask, colour, marker, line in _ways(direction):
        at, mean, spread = _by_place(place[mask], measured[mask])
        top.errorbar(at, mean, spread, color=colour, marker=marker, linestyle="", markersize=8, elinewidth=1.4,
                     label=f"measured{name}")  # fmt: skip
        there, said, _ = _by_place(place[mask], predicted[mask])
        top.plot(there, said, color=colour, linestyle=line, linewidth=2.6, label=f"predicted{name}")
        at, mean, spread = _by_place(place[mask], (measured - predicted)[mask])
        # Beside each other, so that the bars of one direction do not hide those of the other.
        aside = 0.004 * float(np.ptp(place)) * (1.0 if marker == "^" else -1.0)
        low.errorbar(at + aside, mean, spread, color=colour, marker=marker, linestyle=":", linewidth=1.2, markersize=8,
                     elinewidth=1.4, label=f"left{name}")  # fmt: skip
    top.set_title(title)
    for ax, what in ((top, "error"), (low, "left")):
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_ylabel(f"{what}, {unit}")
        _legend_above(ax)
    low.set_xlabel(f"{below}; mean of all runs, bars: standard deviation between them")
    return _png(figure)


def _ways(direction: Floats) -> list[tuple[str, NDArray[np.bool_], str, str, str]]:
    ways = [(", moving +", direction > 0, ON, "^", "-"), (", moving −", direction < 0, OFF, "v", "--")]
    there = [w for w in ways if w[1].any()]
    return there or [("", np.ones(len(direction), dtype=bool), ON, "o", "-")]


def _by_place(place: Floats, value: Floats) -> tuple[Floats, Floats, Floats]:
    """Place, mean and standard deviation at each target, or over stretches where there are too many, (k,) each."""
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


@_styled
def over_time(
    title: str,
    unit: str,
    time_unit: str,
    time: Floats,
    left: Floats,
    measured: Floats | None,
    floor: float,
    sensors: Sequence[tuple[str, Floats]],
) -> bytes:
    """What is left over time, with the temperatures below.

    Args:
        title: of the figure.
        unit: of the readings; `time_unit` that of the times.
        time: since the first reading, (n,).
        left: measured minus predicted, (n,).
        measured: drawn, too, where given, (n,): for an instrument at one place.
        floor: noise, root mean square.
        sensors: name and temperature, °C, (n,).
    """
    figure, axes = _figure(2 if sensors else 1, 4.2)
    ax = axes[0]
    ax.axhspan(-floor, floor, color="#E4E4E4", zorder=0, label="noise of one reading")
    thin = slice(None, None, max(1, len(left) // MOST_DOTS))
    if measured is not None:
        ax.plot(time[thin], measured[thin], color=GREY, linestyle="", marker="+", markersize=5, label="measured")
    ax.plot(time[thin], left[thin], color=ON, linestyle="", marker="o", markersize=3.5, alpha=0.5, label="left")
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_title(title)
    ax.set_ylabel(f"left, {unit}")
    _legend_above(ax)
    if sensors:
        for place, (name, value) in enumerate(sensors):
            axes[1].plot(*_with_gaps(time, value), color=LINES[place % len(LINES)], label=name, linewidth=2.2)
        axes[1].set_title("Temperatures")
        axes[1].set_ylabel("°C")
        axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=13)
        axes[1].set_xlim(axes[0].get_xlim())
    axes[-1].set_xlabel(f"{time_unit} since the first reading")
    return _png(figure)


def _with_gaps(time: Floats, value: Floats) -> tuple[Floats, Floats]:
    """A line is not drawn over a time in which nothing was read."""
    if len(time) < 3:
        return time, value
    wide = np.flatnonzero(np.diff(time) > max(20.0 * float(np.median(np.diff(time))), 0.02 * float(np.ptp(time)))) + 1
    return np.insert(time, wide, np.nan), np.insert(value, wide, np.nan)
