"""Draws docs/figures/encoder-box-wiring.png: one axis from encoder to controller, through box and relay."""

import sys
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

OUT = Path(__file__).parents[3] / "docs" / "figures" / "encoder-box-wiring.png"
LINE, BYPASS, LINK = "#1b3a5c", "#b4530a", "#3a7d44"
Place = tuple[float, float]


def part(ax: Axes, at: Place, size: Place, words: str, *, colour: str = "#f3f6fa") -> None:
    """A box with words in it."""
    ax.add_patch(Rectangle(at, *size, facecolor=colour, edgecolor=LINE, linewidth=1.6, zorder=2))
    ax.text(at[0] + size[0] / 2, at[1] + size[1] / 2, words, ha="center", va="center", fontsize=11, zorder=3)


def wire(ax: Axes, *places: Place, words: str = "", colour: str = LINE, style: str = "-") -> None:
    """A line through these places, an arrow at its end, words above its first stretch."""
    for start, end in pairwise(places[:-1]):
        ax.plot(*zip(start, end, strict=True), color=colour, linewidth=2, linestyle=style, zorder=1)
    arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 2, "linestyle": style}
    ax.annotate("", places[-1], places[-2], arrowprops=arrow, zorder=1)
    (x0, y0), (x1, y1) = places[:2]
    ax.text((x0 + x1) / 2, max(y0, y1) + 0.12, words, ha="center", va="bottom", fontsize=11, color=colour)


def main() -> int:
    """Draw the figure."""
    fig, ax = plt.subplots(figsize=(16.5, 6.6))
    part(ax, (0, 2.0), (1.7, 1.6), "encoder\n5 V, RS-422\nA  B  Z")
    part(ax, (3.6, 2.0), (1.9, 1.6), "receiver\nRS-422 to 3.3 V\n120 Ω across\neach pair")
    part(ax, (6.2, 2.0), (1.7, 1.6), "FPGA board\n(the box)", colour="#e3edf7")
    part(ax, (8.6, 2.0), (1.7, 1.6), "driver\n3.3 V to RS-422")
    part(ax, (11.0, 2.0), (1.7, 1.6), "relay\n2 contacts\na pair", colour="#fdf0e3")
    part(ax, (14.4, 2.0), (1.9, 1.6), "controller\n120 Ω across\neach pair")
    wire(ax, (1.7, 2.8), (3.6, 2.8), words="3 pairs,\nshielded")
    wire(ax, (5.5, 2.8), (6.2, 2.8), words="3")
    wire(ax, (7.9, 2.8), (8.6, 2.8), words="3")
    wire(ax, (10.3, 2.8), (11.0, 2.8))
    wire(ax, (12.7, 2.8), (14.4, 2.8), words="3 pairs,\nshielded")
    ax.plot([3.35], [2.8], "o", color=BYPASS, markersize=8, zorder=4)
    wire(ax, (3.35, 2.8), (3.35, 4.6), (11.85, 4.6), (11.85, 3.6), colour=BYPASS)
    ax.text(
        7.2, 4.7, "bypass: box without supply, in reset, or in its first 5 ms", ha="center", fontsize=12, color=BYPASS
    )
    wire(ax, (7.3, 3.6), (7.3, 4.1), (11.4, 4.1), (11.4, 3.6), colour=BYPASS, style=":")
    ax.text(9.4, 4.17, "coil: 1 = the box's signals", ha="center", fontsize=10, color=BYPASS)
    part(ax, (6.2, -0.2), (1.7, 1.0), "digital isolator\n2 channels", colour="#e9f4ea")
    part(ax, (9.4, -0.2), (2.2, 1.0), "PC with rtec\nUSB serial port", colour="#e9f4ea")
    wire(ax, (7.05, 2.0), (7.05, 0.8), colour=LINK)
    ax.text(7.2, 1.35, "link, 3 Mbaud", fontsize=11, color=LINK)
    wire(ax, (7.9, 0.3), (9.4, 0.3), colour=LINK)
    wire(ax, (14.9, 2.0), (14.9, -1.0), (0.85, -1.0), (0.85, 2.0), colour="#666666")
    ax.text(7.9, -0.92, "5 V and 0 V of the encoder, from the controller; the receiver and the driver share this 0 V",
            ha="center", va="bottom", fontsize=11, color="#444444")  # fmt: skip
    ax.set_xlim(-0.2, 16.5)
    ax.set_ylim(-1.4, 5.2)
    ax.set_axis_off()
    fig.savefig(sys.argv[1] if len(sys.argv) > 1 else OUT, dpi=100, bbox_inches="tight")
    return 0


if __name__ == "__main__":
    sys.exit(main())
