"""Figures of a diagnosis; style and colours as in `figures`. Only arrays come in, PNG goes out."""

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.report.figures import GREY, OFF, ON, as_png, stacked

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

Floats = NDArray[np.float64]
BINS, MOST_PLACES = 24, 120
"""Stretches that a line is drawn over; where there are not too many places, each is its own."""
MOST_DOTS = 4000
NO_BETTER = 0.005
"""Share of the mean square; falls of less are none."""
LONG = 24
"""Letters; longer names stand on two lines."""


@dataclass(frozen=True)
class Panel:
    """What is left of one reading column against one thing that drives it.

    Attributes:
        title: of the panel; empty where it goes on from the one above.
        unit: of the readings, for people.
        residual, part: what is left, and what the finding says of it, (n,).
        below: title of the lower axis.
        value: of the driver, (n,).
        direction: -1 or +1, (n,), where the driver is a position that was gone along both ways.
    """

    title: str
    unit: str
    residual: Floats
    part: Floats
    below: str
    value: Floats
    direction: Floats | None


@as_png
def against_drivers(panels: Sequence[Panel]) -> "MplFigure":
    """What is left against what drives it, and what the finding says of it."""
    figure, axes = stacked(*[4.4] * len(panels))
    for ax, panel in zip(axes, panels, strict=True):
        value = panel.value
        for label, mask, colour, marker in _ways(panel.direction, len(value)):
            thin = slice(None, None, max(1, int(mask.sum()) // MOST_DOTS))
            ax.plot(value[mask][thin], panel.residual[mask][thin], linestyle="", marker=marker, markersize=3.5,
                    color=colour, alpha=0.35)  # fmt: skip
            middle, height = binned(value[mask], panel.part[mask])
            # White behind the line keeps it apart from the dots.
            ax.plot(middle, height, color="white", linewidth=5.5)
            ax.plot(middle, height, color=colour, linewidth=2.8, label=f"{label}: dots are left, line is the finding")
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(panel.title)
        ax.set_xlabel(panel.below)
        ax.set_ylabel(f"left, {panel.unit}")
        ax.legend(frameon=True, facecolor="white", framealpha=0.9, fontsize=12, loc="best")
    return figure


def _ways(direction: Floats | None, n: int) -> list[tuple[str, NDArray[np.bool_], str, str]]:
    if direction is None:
        return [("all readings", np.ones(n, dtype=bool), ON, "o")]
    return [("moving +", direction > 0, ON, "^"), ("moving −", direction < 0, OFF, "v")]


def binned(value: Floats, height: Floats) -> tuple[Floats, Floats]:
    """Mean height over stretches of a value that hold equally many readings, (k,) each."""
    order = np.argsort(value, kind="stable")
    places = len(np.unique(value))
    if places <= MOST_PLACES:
        edges = np.flatnonzero(np.diff(value[order])) + 1
        parts = np.split(order, edges)
    else:
        parts = np.array_split(order, max(1, min(BINS, len(value))))
    return (
        np.array([float(value[p].mean()) for p in parts if len(p)]),
        np.array([float(height[p].mean()) for p in parts if len(p)]),
    )


@as_png
def rivals(rows: Sequence[tuple[str, float, bool, str]]) -> "MplFigure":
    """How much of the error goes with each candidate, on runs that were not used: bars, best on top.

    Args:
        rows: label, relative fall of the mean square, whether it is of the winner's group, and why it is preferred or
            not, in few words.
    """
    figure, (ax,) = stacked(0.74 * len(rows) + 2.0)
    groups = (("found, or not to be told from it", ON, ""), ("not preferred", "#BBBBBB", "//"))
    for place, (name, drop, chosen, why) in enumerate(reversed(rows)):
        label, colour, hatch = groups[0 if chosen else 1]
        ax.barh(place, 100.0 * max(drop, 0.0), 0.7, color=colour, hatch=hatch, edgecolor="white", label=label)
        said = f"{100.0 * drop:.0f} %" if drop >= NO_BETTER else "no better"
        ax.text(100.0 * max(drop, 0.0), place, f" {said}", va="center", fontsize=14)
        ax.text(0.97, place, fill(why, 22), va="center", fontsize=12, color=ON if chosen else GREY,
                linespacing=1.0, transform=ax.get_yaxis_transform())  # fmt: skip
        ax.text(-0.02, place, _on_two(name), va="center", ha="right", fontsize=13, linespacing=1.0,
                transform=ax.get_yaxis_transform())  # fmt: skip
    ax.set_yticks([])
    ax.set_xlim(0, 119)
    ax.set_xticks(range(0, 101, 20))
    figure.suptitle("How much of the error would go, and how likely each is beside the first", x=0.01, ha="left",
                    fontsize=17, fontweight="bold")  # fmt: skip
    ax.set_xlabel("% of the mean square on runs that were not used")
    ax.grid(visible=False, axis="y")
    # Once each, in the order of the list, above the bars: there is always room.
    handles, names = ax.get_legend_handles_labels()
    once = dict(zip(names, handles, strict=True))
    kept = [n for n, _, _ in groups if n in once]
    ax.legend([once[n] for n in kept], kept, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
              fontsize=13, borderaxespad=0.2)  # fmt: skip
    return figure


def _on_two(name: str) -> str:
    """A long label on two lines: at the bracket."""
    return name.replace("(", "\n(", 1) if len(name) > LONG else name


@as_png
def staircase(unit: str, names: Sequence[str], errors: Sequence[float], floor: float | None) -> "MplFigure":
    """The error falling, change by change, down to the noise floor.

    Args:
        unit: for people.
        names: what each step was; the first is the model as it began.
        errors: root mean square on runs left out after each.
        floor: what noise alone leaves; None where it is not known.
    """
    figure, (ax,) = stacked(5.6)
    x = np.arange(len(names) + 1)
    ax.step(x, [*errors, errors[-1]], where="post", color=ON, linewidth=3.4)
    for place, value in enumerate(errors):
        ax.text(place + 0.5, value, f"{value:.2f}", ha="center", va="bottom", fontweight="bold", color=ON)
        if place and value < errors[place - 1]:
            ax.annotate("", (place, value), (place, errors[place - 1]),
                        arrowprops={"arrowstyle": "-|>", "color": OFF, "linewidth": 2.5})  # fmt: skip
    top = 1.22 * max([*errors, floor or 0.0])
    if floor is not None:
        ax.axhspan(0.0, floor, color="#E4E4E4", zorder=0)
        ax.text(len(names) - 0.02, 0.5 * floor, f"noise of the measurement, {floor:.2f}", color=GREY, ha="right",
                va="center", fontsize=13)  # fmt: skip
    ax.set_ylim(0.0, top)
    ax.set_xlim(0.0, len(names))
    ax.set_xticks(np.arange(len(names)) + 0.5, [_broken(n) for n in names], fontsize=12)
    ax.grid(visible=False, axis="x")
    ax.set_title("The error falls as the model learns")
    ax.set_ylabel(f"left on runs not used, {unit}")
    return figure


def _broken(name: str) -> str:
    """A label on several lines: at the bracket; words where they are many; long names at an underscore too."""
    head, mark, rest = name.partition("(")
    if len(head) > 18 and "_" in head:
        at = head.rindex("_") + 1
        head = f"{head[:at]}\n{head[at:]}"
    return f"{head}\n{mark}{rest}" if mark else name.replace(" the ", " the\n", 1)
