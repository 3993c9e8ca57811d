"""Figures of a characterisation, from arrays to PNG."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.report.figures import LINES, OFF, ON, as_png, stacked

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

Floats = NDArray[np.float64]


@as_png
def falling(inside: Floats, held_out: Floats) -> "MplFigure":
    """Error against number of terms, in sample and held out, % of that without terms, on a logarithmic scale."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    figure, (ax,) = stacked(4.6)
    terms = np.arange(len(inside))
    ax.semilogy(terms, held_out, color=OFF, marker="s", linestyle="--", label="held out")
    ax.semilogy(terms, inside, color=ON, marker="o", label="in sample")
    ax.set_title("Error as terms were added")
    ax.set_xlabel("number of terms")
    ax.set_ylabel("error, % of that with no term")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(frameon=False)
    return figure


@as_png
def residuals(panels: Sequence[tuple[str, str, Floats, Floats]]) -> "MplFigure":
    """Residuals of all readings, one panel a measurement.

    Args:
        panels: measurement, unit, hours (n,), residuals (readings, n).
    """
    figure, axes = stacked(*[3.0] * len(panels))
    for ax, (name, unit, hours, values) in zip(axes, panels, strict=True):
        for row, colour in zip(values, LINES, strict=False):
            ax.plot(hours, row, linestyle="", marker=".", markersize=3, color=colour)
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(name)
        ax.set_ylabel(f"residual, {unit}")
    axes[-1].set_xlabel("time since the first reading, hours")
    return figure
