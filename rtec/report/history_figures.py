"""Figure of a model's history: the error falling, change by change, to the noise floor."""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from rtec.report.figures import OFF, ON, as_png, stacked
from rtec.wording import number, significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure


LONG, MANY = 18, 5
"""Largest number of letters of a name on one line; number of steps above which names are slanted for lack of room."""
CROWD, WIDE = 9, 1000.0
"""Number of steps above which names are upright; range above which sizes have digits of their own."""


@as_png
def staircase(unit: str, names: Sequence[str], errors: Sequence[float], floor: float | None) -> "MplFigure":
    """The error on a logarithmic scale, change by change, down to the noise floor.

    Args:
        unit: unit of the error, for people.
        names: names of the steps; the first is the initial model.
        errors: root mean square residual on held-out runs after each step.
        floor: noise floor; None where it is unknown.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    many, crowd = len(names) > MANY, len(names) > CROWD
    figure, (ax,) = stacked(8.6 if crowd else 7.4 if many else 5.8)
    known = [*errors, *([floor] if floor else [])]
    range_ = max(known) / min(known)
    digits = max(0, 1 - math.floor(math.log10(min(known))))
    write = significant if crowd or range_ > WIDE else partial(number, digits=digits)
    low, high = min(known) / 1.5, max(known) * 1.5 * range_**0.1
    ax.set_yscale("log")
    for place, value in enumerate(errors):
        ax.fill_between([place, place + 1], low, value, color=ON, alpha=0.14, linewidth=0, zorder=1)
        ax.plot([place, place + 1], [value, value], color=ON, linewidth=4.0, solid_capstyle="butt")
        ax.annotate(write(value), (place + 0.5, value), (0, 6), textcoords="offset points", ha="center",
                    va="bottom", fontsize=10 if crowd else 17, fontweight="bold", color=ON)  # fmt: skip
        if place and value < errors[place - 1]:
            ax.annotate("", (place, value), (place, errors[place - 1]), zorder=3,
                        arrowprops={"arrowstyle": "-|>", "color": OFF, "linewidth": 1.5 if crowd else 3.0,
                                    "mutation_scale": 9 if crowd else 22,
                                    "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    if floor:
        ax.axhline(floor, color="black", linestyle="--", linewidth=2.0)
        ax.annotate(f"noise floor\n{write(floor)} {unit}", (1.0, floor), (8, 0), xycoords=ax.get_yaxis_transform(),
                    textcoords="offset points", ha="left", va="center", fontsize=14, annotation_clip=False)  # fmt: skip
    ax.set_ylim(low, high)
    ax.set_xlim(0.0, len(names))
    shown = [n.replace("(", "\n(", 1) for n in names] if crowd else names if many else [_broken(n) for n in names]
    ax.set_xticks(np.arange(len(names)) + 0.5, shown, fontsize=9 if crowd else 13)
    for label in ax.get_xticklabels() if crowd else []:
        label.set(rotation=90, va="top")
    for label in ax.get_xticklabels() if many and not crowd else []:
        label.set(rotation=30, ha="right", rotation_mode="anchor")
    ax.tick_params(axis="x", length=0)
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.grid(visible=False, axis="x")
    ax.set_title("The error falls as the model learns")
    ax.set_ylabel(f"residual on held-out runs, rms, {unit}")
    return figure


def _broken(name: str) -> str:
    """A label with line breaks at the bracket and the commas; in long names at an underscore, too."""
    head, mark, rest = name.partition("(")
    if len(head) > LONG and "_" in head:
        at = head.rindex("_") + 1
        head = f"{head[:at]}\n{head[at:]}"
    return f"{head}\n{mark}{rest}" if mark else name.replace(", ", ",\n", 1)
