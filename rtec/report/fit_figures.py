"""Figures of a characterisation; style and colours as in `figures`. Only arrays come in, PNG goes out."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.report.figures import LINES, OFF, ON, STYLE, WIDTH_IN, png_of

Floats = NDArray[np.float64]


def falling(inside: Floats, held_out: Floats) -> bytes:
    """Error against number of terms, in sample and held out, % of that of nothing, on a logarithmic scale."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 4.6), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        ax = figure.subplots()
        terms = np.arange(len(inside))
        ax.semilogy(terms, held_out, color=OFF, marker="s", linestyle="--", label="held out")
        ax.semilogy(terms, inside, color=ON, marker="o", label="in sample")
        ax.set_title("Error as terms were added")
        ax.set_xlabel("terms")
        ax.set_ylabel("% of that of nothing")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.legend(frameon=False)
        return png_of(figure)


def residuals(panels: Sequence[tuple[str, str, Floats, Floats]]) -> bytes:
    """What the fit leaves, reading by reading, one panel a measurement.

    Args:
        panels: measurement, unit, hours (n,), residuals (readings, n).
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 3.0 * len(panels)), layout="constrained", facecolor="white")
        FigureCanvasAgg(figure)
        axes = figure.subplots(len(panels), 1, squeeze=False)[:, 0]
        for ax, (name, unit, hours, values) in zip(axes, panels, strict=True):
            for row, colour in zip(values, LINES, strict=False):
                ax.plot(hours, row, linestyle="", marker=".", markersize=3, color=colour)
            ax.axhline(0.0, color="black", linewidth=1)
            ax.set_title(name)
            ax.set_ylabel(f"left, {unit}")
        axes[-1].set_xlabel("hours")
        return png_of(figure)
