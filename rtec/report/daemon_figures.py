"""Figures of a running daemon, to PNG: the correction of each axis within its limits, and the last minutes or hours."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rtec.report.figures import GREY, LINES, OFF, ON, Zoom, as_png, canvas, stacked, zoomed
from rtec.wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

ROWS = ("residual", "applied", "requested")
DASHES = ("-", "--", ":")


@dataclass(frozen=True)
class AxisBars:
    """Correction of an axis.

    Attributes:
        axis: its name.
        requested, applied, residual: µm; None where it is not known.
        warning, stop: limits of a request, µm: it is flagged, it is not followed; 0 where there is none.
    """

    axis: str
    requested: float | None
    applied: float | None
    residual: float | None
    warning: float
    stop: float


@as_png
def axis_bars(rows: Sequence[AxisBars]) -> "MplFigure":
    """Requested, applied and residual correction of each axis, a panel an axis, within its limits."""
    figure = canvas(3.8)
    panels: Sequence[Axes] = figure.subplots(1, len(rows), squeeze=False)[0]
    for ax, row in zip(panels, rows, strict=True):
        values = {"requested": row.requested, "applied": row.applied, "residual": row.residual}
        stop = row.stop or max(abs(v or 0.0) for v in values.values()) or 1.0
        for place, name in enumerate(ROWS):
            value = values[name]
            ax.barh(place, value or 0.0, 0.6, color={"requested": GREY, "applied": ON, "residual": OFF}[name])
        for limit in (-row.warning, row.warning) if row.stop else ():
            ax.axvline(limit, color="black", linestyle="--", linewidth=1.2)
        ax.axvline(0.0, color="black", linewidth=1)
        ax.set_xlim(-stop, stop)
        ax.set_yticks(range(3), [f"{name}\n{_signed(values[name], sign=name != 'residual')}" for name in ROWS])
        ax.set_xlabel("µm; dashed: a request beyond is flagged" if row.stop else "µm")
        ax.set_title(f"Axis {row.axis}")
        ax.grid(visible=False, axis="y")
    return figure


def _signed(value: float | None, *, sign: bool) -> str:
    return "not known" if value is None else f"{number(value, 2, sign=sign)} µm"


@as_png
def past(
    time: Sequence[float],
    below: str,
    applied_um: Mapping[str, Sequence[float | None]],
    degc: Mapping[str, Sequence[float | None]],
    zooms: Sequence[Zoom] = (),
) -> "MplFigure":
    """Applied corrections over time, with the temperatures below.

    Args:
        time: times, (n,).
        below: title of their axis.
        applied_um: of each axis, (n,) each; None where it is not known.
        degc: °C of each sensor, (n,) each; None where it is not read.
        zooms: the visible part of either.
    """
    # Each has the time that its own plot shows.
    figure, axes = stacked(*([3.6] * (2 if degc else 1)), share=not any(zooms))
    for ax, lines, what in zip(axes, (applied_um, degc), ("applied correction, µm", "temperature, °C"), strict=False):
        for k, (name, values) in enumerate(lines.items()):
            shown = np.array([np.nan if v is None else v for v in values])
            ax.plot(time, shown, color=LINES[(1 + k) % len(LINES)], linestyle=DASHES[k // 4 % 3], label=name)
        ax.set_ylabel(what)
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize=13)
    axes[-1].set_xlabel(below)
    for ax, zoom in zip(axes, zooms, strict=False):
        zoomed(ax, zoom)
    return figure
