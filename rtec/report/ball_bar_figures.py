"""Figures of ball-bar tests, from arrays to PNG.

On the circle; against the angle with the residual; each cause alone; harmonics.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rtec.arrays import Floats
from rtec.report.figures import GREY, LINES, MOST_DOTS, OFF, ON, WIDTH_IN, as_png, canvas, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure


LOOKS = ((ON, "-"), (OFF, "--"), (LINES[3], "-."), (LINES[4], ":"))
SCALES_UM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
MIDDLE = 1.0
ARROW_RAD = 0.3
ROOM = 0.3
"""Size of the largest deviation as a share of the circle's radius."""


@dataclass(frozen=True)
class CircleTrace:
    """One test: name, sense (+1, -1), angles, rad, and readings measured and fitted, µm, (n,) each."""

    name: str
    sense: int
    angle_rad: Floats
    measured_um: Floats
    fitted_um: Floats


@as_png
def polar(title: str, letters: tuple[str, str], traces: Sequence[CircleTrace]) -> "MplFigure":
    """Deviations drawn outwards from the circle, magnified, with a bar as scale.

    Args:
        title: title of the figure.
        letters: directions of the plane, to the right and upwards.
        traces: the tests; all have the same magnification.
    """
    figure = canvas(WIDTH_IN * 0.92)
    ax = figure.subplots()
    gain = frame(ax, letters, max(float(np.abs(t.measured_um).max()) for t in traces))
    for i, (trace, (colour, line)) in enumerate(zip(traces, _looks(len(traces)), strict=True)):
        around(ax, trace.angle_rad, MIDDLE + gain * trace.measured_um, colour, "-", 1.4, 0.55)
        label = f"{trace.name}, {'ccw' if trace.sense > 0 else 'cw'}"
        around(ax, trace.angle_rad, MIDDLE + gain * trace.fitted_um, colour, line, 2.6, 1.0, label)
        arrow(ax, trace, MIDDLE + (1.06 + 0.07 * (i % len(LOOKS))) * ROOM, colour)
    ax.text(0, -0.16, "thin: measured\nthick: fitted", ha="center", va="top", fontsize=13, color=GREY)
    ax.set_title(title)
    ax.legend(loc="upper left", frameon=False, fontsize=12)
    return figure


def frame(ax: "Axes", letters: tuple[str, str], largest: float) -> float:
    """The circle, rings at a round deviation, the plane's directions and an error bar; gives the magnification.

    Args:
        ax: an empty panel; its own axes are removed.
        letters: directions of the plane, to the right and upwards.
        largest: largest deviation, µm, for which there must be room.
    """
    gain = ROOM / max(largest, 1e-6)
    round_rad = np.linspace(0.0, 2.0 * np.pi, 361)
    ax.plot(np.cos(round_rad), np.sin(round_rad), color=GREY, linewidth=1.2)
    scale = _scale(largest)
    for ring in (-scale, scale):
        r = MIDDLE + gain * ring
        ax.plot(r * np.cos(round_rad), r * np.sin(round_rad), color="#CCCCCC", linewidth=0.8, linestyle=":")
    reach = MIDDLE + 1.45 * ROOM
    for letter, end in zip(letters, ((reach, 0.0), (0.0, reach)), strict=True):
        start = (0.45 * end[0], 0.45 * end[1])
        ax.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": GREY, "linewidth": 1.5})
        ax.text(end[0] + 0.02, end[1] + 0.02, f"+{letter}", color=GREY, fontsize=15)
    ax.set_xlim(-reach, reach + 0.15)
    ax.set_ylim(-reach, reach + 0.12)
    _bar(ax, gain * scale, f"{scale:g} µm")
    ax.set_aspect("equal")
    ax.set_axis_off()
    return gain


@as_png
def spectra(tests: Sequence[tuple[str, Floats, Floats]]) -> "MplFigure":
    """Harmonics of each test, measured and fitted.

    Args:
        tests: name, amplitudes measured and fitted, µm, (orders,), from order 1.
    """
    figure, axes = stacked(*[3.4] * len(tests))
    for ax, (name, measured, fitted) in zip(axes, tests, strict=True):
        order = np.arange(1, len(measured) + 1)
        ax.bar(order - 0.2, measured, 0.4, color=ON, label="measured")
        ax.bar(order + 0.2, fitted, 0.4, color=OFF, hatch="//", edgecolor="white", label="fitted")
        ax.set_xticks(order)
        ax.set_title(name)
        ax.set_ylabel("amplitude, µm")
        ax.grid(visible=False, axis="x")
        ax.legend(frameon=False, ncols=2, loc="upper right")
        _cut_first(ax, measured, fitted)
    axes[-1].set_xlabel("waves in one turn (one wave: mostly where the ball was set up)")
    return figure


def _cut_first(ax: "Axes", measured: Floats, fitted: Floats) -> None:
    """Cut the bar of order 1 where it is far larger than the others, and write its size at it."""
    others = float(max(measured[1:].max(), fitted[1:].max()))
    if measured[0] > 2.0 * others > 0.0:
        ax.set_ylim(0.0, 1.5 * others)
        ax.text(1.5, 1.42 * others, f"{measured[0]:.1f} µm", va="top", fontsize=13, color=GREY)


def _looks(count: int) -> list[tuple[str, str]]:
    return [LOOKS[i % len(LOOKS)] for i in range(count)]


def around(
    ax: "Axes", angle: Floats, radius: Floats, colour: str, line: str, width: float, alpha: float, label: str = ""
) -> None:
    """Draw a curve around the circle, with gaps where the angles jump."""
    jumps = np.flatnonzero(np.abs(np.diff(angle)) > np.pi / 2) + 1
    for k, part in enumerate(np.split(np.arange(len(angle)), jumps)):
        ax.plot(radius[part] * np.cos(angle[part]), radius[part] * np.sin(angle[part]), color=colour, linestyle=line,
                linewidth=width, alpha=alpha, label=label if k == 0 else "")  # fmt: skip


def arrow(ax: "Axes", trace: CircleTrace, radius: float, colour: str) -> None:
    """Draw an arrow at the start of a test, in its sense, outside of all curves."""
    start = float(trace.angle_rad[0])
    angle = start + trace.sense * np.linspace(0.0, ARROW_RAD, 12)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    ax.plot(x, y, color=colour, linewidth=2.4)
    ax.annotate("", (x[-1], y[-1]), (x[-2], y[-2]),
                arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2.4, "mutation_scale": 18})  # fmt: skip


def _bar(ax: "Axes", length: float, text: str) -> None:
    ax.plot([-0.5 * length, 0.5 * length], [0.12, 0.12], color="black", linewidth=3)
    for end in (-0.5, 0.5):
        ax.plot([end * length] * 2, [0.1, 0.14], color="black", linewidth=3)
    ax.text(0, 0.16, text, ha="center", va="bottom", fontsize=14, fontweight="bold")


def _scale(largest: float) -> float:
    """A round number near half the largest deviation."""
    return min(SCALES_UM, key=lambda s: abs(np.log(s / max(0.5 * largest, 1e-6))))


ACROSS = 2
"""Number of panels beside each other."""
PANEL_IN = 2.7
SHADE = "#ECECEC"


@as_png
def linear(traces: Sequence[CircleTrace], window_deg: float, *, used: bool = False) -> "MplFigure":
    """Deviation against angle, one panel a test: measured, fitted, and the residual.

    Args:
        traces: the tests.
        window_deg: half-width of the shaded zone about each quadrant.
        used: whether the fit uses the readings there.
    """
    figure, axes = stacked(*[4.6] * len(traces))
    for ax, trace in zip(axes, traces, strict=True):
        deg = shown_deg(trace.angle_rad)
        order = np.argsort(deg, kind="stable")
        _ground(ax, deg, window_deg)
        thin = slice(None, None, max(1, len(deg) // MOST_DOTS))
        for values, colour, name in (
            (trace.measured_um, GREY, "measured"),
            (trace.measured_um - trace.fitted_um, ON, "residual"),
        ):
            ax.plot(deg[thin], values[thin], color=colour, linestyle="", marker=".", markersize=4, alpha=0.35)
            ax.plot([], [], color=colour, linestyle="", marker="o", markersize=9, label=name)
        ax.plot(deg[order], trace.fitted_um[order], color=OFF, linewidth=2.6, label="fitted")
        ax.set_title(f"{trace.name}, {'ccw' if trace.sense > 0 else 'cw'}")
        ax.set_ylabel("bar longer, µm")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=13)
    axes[-1].set_xlabel(f"angle on the circle, degrees; grey: near a quadrant{'' if used else ', not used in the fit'}")
    return figure


@as_png
def causes(
    traces: Sequence[CircleTrace], curves: Sequence[tuple[str, Sequence[Floats]]], window_deg: float
) -> "MplFigure":
    """Each cause alone against angle, one small panel a cause with all tests; all panels have one scale.

    Args:
        traces: the tests.
        curves: name of the cause, and its curve in every test, µm.
        window_deg: half-width of the shaded zone about each quadrant.
    """
    rows = -(-len(curves) // ACROSS)
    figure = canvas(PANEL_IN * rows + 1.0)
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
            ax.set_ylabel("bar longer, µm")
        if place >= len(curves) - ACROSS:
            ax.set_xlabel("angle on the circle, degrees")
            ax.tick_params(labelbottom=True)
    figure.legend(loc="outside upper left", frameon=False, ncols=min(2, len(traces)), fontsize=13)
    return figure


def shown_deg(angle_rad: Floats) -> Floats:
    """Angles in degrees, shifted by whole turns so that the middle of the arc is between 0 and 360."""
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
