"""Figures of ball-bar tests against angle: measured, fitted and left over; and each cause by itself."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.report.ball_bar_figures import LOOKS, Trace
from rtec.report.figures import GREY, OFF, ON, WIDTH_IN, _figure, _png, _styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]
ACROSS = 2
"""Panels beside each other."""
PANEL_IN = 2.7
SHADE = "#ECECEC"


@_styled
def linear(traces: Sequence[Trace], window_deg: float, *, used: bool = False) -> bytes:
    """Deviation against angle, one panel a test: measured, fitted, and what is left over.

    Args:
        traces: the tests.
        window_deg: about each quadrant, shaded.
        used: readings there are used in the fit.
    """
    figure, axes = _figure(len(traces), 4.6)
    for ax, trace in zip(axes, traces, strict=True):
        deg = shown_deg(trace.angle_rad)
        order = np.argsort(deg, kind="stable")
        _ground(ax, deg, window_deg)
        # What is measured lies wide and pale under what is fitted, so that neither hides the other.
        ax.plot(deg[order], trace.measured_um[order], color=GREY, linewidth=4.0, alpha=0.45, label="measured")
        ax.plot(deg[order], trace.fitted_um[order], color=OFF, linewidth=2.2, label="fitted")
        left = (trace.measured_um - trace.fitted_um)[order]
        ax.plot(deg[order], left, color=ON, linewidth=0.8, label="left over")
        ax.set_title(f"{trace.name}, {'ccw' if trace.sense > 0 else 'cw'}")
        ax.set_ylabel("bar longer, µm")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=13)
    axes[-1].set_xlabel(f"angle on the circle, degrees; grey: near a quadrant{'' if used else ', not used in the fit'}")
    return _png(figure)


@_styled
def causes(traces: Sequence[Trace], curves: Sequence[tuple[str, Sequence[Floats]]], window_deg: float) -> bytes:
    """Each cause by itself against angle, one small panel a cause with all tests in it; all panels have one scale.

    Args:
        traces: the tests.
        curves: name of the cause, and its curve in every test, µm.
        window_deg: about each quadrant, shaded.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-len(curves) // ACROSS)
    figure = Figure(figsize=(WIDTH_IN, PANEL_IN * rows + 1.0), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, ACROSS, sharex=True, sharey=True, squeeze=False)
    for ax in panels.flat[len(curves) :]:
        ax.set_axis_off()
    degrees = [shown_deg(t.angle_rad) for t in traces]
    for place, (name, of) in enumerate(curves):
        ax = panels.flat[place]
        _ground(ax, np.concatenate(degrees), window_deg)
        for i, (trace, deg, curve) in enumerate(zip(traces, degrees, of, strict=True)):
            colour, line = LOOKS[i % len(LOOKS)]
            order = np.argsort(deg, kind="stable")
            label = f"{trace.name}, {'ccw' if trace.sense > 0 else 'cw'}" if place == 0 else ""
            ax.plot(deg[order], curve[order], color=colour, linestyle=line, linewidth=2.0, label=label)
        ax.set_title(name, fontsize=15)
        if place % ACROSS == 0:
            ax.set_ylabel("µm")
        if place >= len(curves) - ACROSS:
            ax.set_xlabel("angle on the circle, degrees")
            ax.tick_params(labelbottom=True)
    figure.legend(loc="outside upper left", frameon=False, ncols=min(2, len(traces)), fontsize=13)
    return _png(figure)


def shown_deg(angle_rad: Floats) -> Floats:
    """Angles in degrees, by whole turns so that the middle of the arc lies between 0 and 360."""
    deg = np.rad2deg(angle_rad)
    middle = 0.5 * float(deg.min() + deg.max())
    return np.asarray(deg - 360.0 * np.floor(middle / 360.0 + 1e-9), dtype=np.float64)


def _ground(ax: "Axes", deg: Floats, window_deg: float) -> None:
    """Quadrants, zero line, and an axis with a number at each quadrant."""
    low, high = float(deg.min()), float(deg.max())
    for quadrant in np.arange(90.0 * np.floor(low / 90.0), high + 90.0, 90.0):
        ax.axvspan(quadrant - window_deg, quadrant + window_deg, color=SHADE, zorder=0, linewidth=0)
    ax.axhline(0.0, color="black", linewidth=0.8)
    ax.set_xlim(low, high)
    ax.set_xticks(np.arange(90.0 * np.ceil(low / 90.0 - 1e-6), high + 1.0, 90.0))
