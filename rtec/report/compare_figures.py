"""Figures of a comparison: the map of what is left, and what each effect adds."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.report.compare_stack import Stack, colours, draw_stack
from rtec.report.figures import GREY, OFF, _figure, _png, _styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

Floats = NDArray[np.float64]
MOST_BARS = 10
STACK_IN = 4.8
LONG = 22
"""Letters; longer names stand on two lines."""


@_styled
def residual_map(
    title: str,
    unit: str,
    across: tuple[str, Floats],
    up: tuple[str, Floats],
    means: Sequence[tuple[str, Floats]],
    floor: float,
) -> bytes:
    """Mean of what is left in each cell: red above, blue below zero, hatched where there are few readings.

    Args:
        title: of the figure.
        unit: of the readings.
        across, up: name with unit, and edges of the cells, (k + 1,).
        means: what each panel shows, and the means, (up, across); NaN where there are few readings.
        floor: noise; colours are never stronger than it deserves.
    """
    figure, axes = _figure(len(means), 5.6)
    most = max(floor, *(float(np.abs(mean[np.isfinite(mean)]).max(initial=0.0)) for _, mean in means), 1e-9)
    for ax, (name, mean) in zip(axes, means, strict=True):
        _panel(figure, ax, unit, across, up, mean, most)
        ax.set_title(f"{title}{name}: mean left in each cell, {unit}")
    axes[-1].set_xlabel(f"{across[0]}   (hatched: fewer than 3 readings)")
    return _png(figure)


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
    bar.set_label(f"mean left, {unit}")
    ax.set_ylabel(up[0])


def _short(value: float) -> str:
    text = f"{value:.1f}" if abs(value) < 99.95 else f"{value:.0f}"
    return text.replace("-0.0", "0.0").replace("-", "−")


@_styled
def contributions(
    title: str,
    unit: str,
    rows: Sequence[tuple[str, float, float]],
    measured: float,
    left: float,
    floor: float,
    stack: Stack | None = None,
) -> bytes:
    """What each effect adds: bars between what was measured and what is left; below, one on top of the other.

    Args:
        title: of the figure.
        unit: of the readings.
        rows: label, root mean square, largest size; in falling order.
        measured, left, floor: root mean squares.
        stack: means along a channel, its effects in the order of `rows`.
    """
    shown = rows[:MOST_BARS]
    effects = [(name, rms, colour, "") for (name, rms, _), colour in zip(shown, colours(len(shown)), strict=True)]
    bars = [("measured", measured, GREY, ""), *effects, ("left", left, OFF, "//")]
    high = 0.7 * len(bars) + 1.6
    figure, axes = _figure(2 if stack else 1, 0.5 * (high + STACK_IN) if stack else high)
    if stack and (grid := axes[0].get_gridspec()):
        grid.set_height_ratios([high, STACK_IN])
        draw_stack(axes[1], unit, stack)
    ax = axes[0]
    most = max(b[1] for b in bars)
    for place, (name, rms, colour, hatch) in enumerate(reversed(bars)):
        ax.barh(place, rms, 0.7, color=colour, hatch=hatch, edgecolor="white")
        ax.text(rms + 0.01 * most, place, f"{rms:.2f}", va="center", fontsize=14)
        ax.text(-0.02, place, _broken(name), va="center", ha="right", transform=ax.get_yaxis_transform(),
                linespacing=1.0)  # fmt: skip
    ax.axvspan(0.0, floor, color="#BBBBBB", alpha=0.6, zorder=3, linewidth=0)
    ax.set_yticks([])
    ax.set_xlim(0, 1.15 * most)
    # Over the names too: beside them there is not always room.
    figure.suptitle(f"{title}: what each effect adds", x=0.01, ha="left", fontsize=17, fontweight="bold")
    ax.set_xlabel(f"root mean square, {unit} (grey band: noise {floor:.2g} {unit})")
    ax.grid(visible=False, axis="y")
    return _png(figure)


def _broken(name: str) -> str:
    """A long label on two lines."""
    return name.replace("(", "\n(", 1) if len(name) > LONG else name
