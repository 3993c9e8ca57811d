"""What the effects of a model add, one on top of the other, along the channel that shows most of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.compare.bins import cut_into
from rtec.report.figures import LINES

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

COLOURS, OTHERS = LINES[2:], "#A6A6A6"
BINS, LEAST = 12, 3
WIDE = 0.9
"""Of a bin that its bars fill."""


@dataclass(frozen=True)
class Stack:
    """Means in stretches of a channel; where both directions were moved, each has bars of its own.

    Attributes:
        along: name of the channel, with its unit.
        place, width: middle and width of each bar, (k,).
        parts: mean of each effect there, largest effect first, µm or µrad, (k,) each.
        measured: mean measured there, (k,).
        shows: share of the mean square of what is predicted that these means hold.
        ways: whether bars of both directions stand beside each other.
    """

    along: str
    place: Floats
    width: Floats
    parts: Mapping[str, Floats]
    measured: Floats
    shows: float
    ways: bool


def stack_along(
    channel: tuple[str, Floats], direction: Floats | None, parts: Mapping[str, Floats], measured: Floats
) -> Stack | None:
    """Means along one channel; None where it does not vary.

    Args:
        channel: name with unit, and value at each reading, (n,).
        direction: -1 or +1, (n,), where bars of both are wanted.
        parts: what each effect adds, (n,) each.
        measured: (n,).
    """
    cut = cut_into("T_", channel[1], BINS)
    if cut is None:
        return None
    ways = direction is not None and len(np.unique(direction)) == 2
    side = (np.asarray(direction) > 0).astype(np.int64) if ways else np.zeros(len(measured), dtype=np.int64)
    bars = 2 if ways else 1
    code, size = bars * cut.code + side, bars * len(cut)
    count = np.bincount(code, minlength=size)
    full = count >= LEAST
    if not full.any():
        return None

    def mean(values: Floats) -> Floats:
        return np.asarray(np.bincount(code, weights=values, minlength=size)[full] / count[full])

    predicted = np.sum(list(parts.values()), axis=0)
    held = float(np.sum(mean(predicted) ** 2 * count[full])) / max(float(predicted @ predicted), 1e-30)
    wide = np.repeat(cut.high - cut.low, bars) * WIDE / bars
    middle = np.repeat(0.5 * (cut.low + cut.high), bars) + wide * (
        np.tile(np.arange(bars), len(cut)) - 0.5 * (bars - 1)
    )
    return Stack(
        channel[0], middle[full], wide[full], {k: mean(v) for k, v in parts.items()}, mean(measured),
        held - full.sum() / len(measured), ways,
    )  # fmt: skip


def draw_stack(ax: "Axes", unit: str, stack: Stack) -> None:
    """Stack the effects, those above and those below zero by themselves; dots are what was measured."""
    above, below = np.zeros(len(stack.place)), np.zeros(len(stack.place))
    for colour, values in zip(colours(len(stack.parts)), stack.parts.values(), strict=True):
        foot = np.where(values > 0.0, above, below)
        ax.bar(stack.place, values, stack.width, foot, color=colour, edgecolor="white", linewidth=0.5)
        above, below = above + np.maximum(values, 0.0), below + np.minimum(values, 0.0)
    ax.hlines(above + below, stack.place - 0.5 * stack.width, stack.place + 0.5 * stack.width, color="black",
              linewidth=2.4, label="predicted: the bars' sum")  # fmt: skip
    ax.plot(stack.place, stack.measured, linestyle="", marker="o", color="black", markersize=8, markeredgecolor="white",
            label="measured")  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    pairs = "; of two bars the left one moving −, the right one +" if stack.ways else ""
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.18 * (high - low))
    ax.legend(loc="upper center", ncols=2, facecolor="white", edgecolor="none", framealpha=0.9, fontsize=13)
    ax.set_ylabel(f"effects stacked,\nmean, {unit}")
    ax.set_xlabel(f"{stack.along}{pairs}")


def colours(count: int) -> Sequence[str]:
    """A colour for each effect; grey where there are more than can be told apart."""
    return [*COLOURS, *[OTHERS] * count][:count]
