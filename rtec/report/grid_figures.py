"""Contour figure of a grid encoder: paths with the deviation drawn normal to them, magnified [XT Fig. 12-17]."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rtec.report.figures import GREY, LINES, OFF, ON, WIDTH_IN, as_png, canvas

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

Floats = NDArray[np.float64]
COLOURS = (ON, OFF, LINES[3], LINES[4], LINES[5])
SMOOTH = 30
"""Half-width of the moving mean that is drawn bold over the readings, as a share of the piece."""
SCALES_UM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True)
class Piece:
    """A straight piece.

    Attributes:
        along: 0 to the right, 1 upwards.
        way: -1, +1.
        place_mm: positions along it, in order, (n,).
        beside_mm: its position across.
        deviation_um: deviation across it, positive to the right or upwards, (n,).
        family: index in the list of names; pieces of one family have one colour.
    """

    along: int
    way: int
    place_mm: Floats
    beside_mm: float
    deviation_um: Floats
    family: int


@as_png
def contour(
    title: str,
    letters: tuple[str, str],
    pieces: Sequence[Piece],
    names: Sequence[str],
    magnification: float,
    how: str = "",
) -> "MplFigure":
    """Commanded path in grey, actual path beside it; arrows along the feed, a bar for the size of an error.

    Args:
        title: title of the figure.
        letters: directions to the right and upwards.
        pieces: pieces of all families (set-ups, feeds or directions in one overlay).
        names: names of the families.
        magnification: magnification of the deviation relative to the path.
        how: parts that were subtracted before, in words.
    """
    figure = canvas(WIDTH_IN * 0.95)
    ax = figure.subplots()
    named: set[int] = set()
    for piece in pieces:
        colour = COLOURS[piece.family % len(COLOURS)]
        label = names[piece.family] if piece.family not in named else ""
        named.add(piece.family)
        _draw(ax, piece, colour, magnification, label)
    _size(ax, pieces, magnification)
    ax.set_aspect("equal")
    ax.set_xlabel(f"{letters[0]}, mm; {how}" if how else f"{letters[0]}, mm")
    ax.set_ylabel(f"{letters[1]}, mm")
    ax.set_title(f"{title}; deviation drawn {f'{magnification:,.0f}'.replace(',', chr(0x2009))} times as large")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=min(3, len(names)), frameon=False)
    return figure


def usual_magnification(pieces: Sequence[Piece]) -> float:
    """A round one at which the largest deviation takes an eighth of the path."""
    span = max(float(np.ptp(p.place_mm)) for p in pieces)
    largest = max(float(np.abs(p.deviation_um).max()) for p in pieces)
    wanted = span * 1e3 / 8.0 / max(largest, 1e-3)
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(max(s * decade for s in (1.0, 2.0, 5.0) if s * decade <= wanted * (1 + 1e-9)))


def _draw(ax: "Axes", piece: Piece, colour: str, magnification: float, label: str) -> None:
    away = piece.beside_mm + piece.deviation_um * 1e-3 * magnification
    inner, smooth = _smoothed(away)
    place = piece.place_mm[inner]
    straight = np.full(len(away), piece.beside_mm)
    line: dict[str, Any] = {"color": colour, "linewidth": 2.4, "linestyle": "-" if piece.way > 0 else (0, (5, 2))}
    if piece.along == 0:
        ax.plot(piece.place_mm, straight, color=GREY, linewidth=1.0)
        ax.plot(piece.place_mm, away, color=colour, linewidth=0.8, alpha=0.35)
        ax.plot(place, smooth, label=label, **line)
    else:
        ax.plot(straight, piece.place_mm, color=GREY, linewidth=1.0)
        ax.plot(away, piece.place_mm, color=colour, linewidth=0.8, alpha=0.35)
        ax.plot(smooth, place, label=label, **line)
    n = len(smooth)
    at = int(n * (0.62 if piece.way > 0 else 0.38)) + 4 * piece.family
    step = max(n // 30, 1) * piece.way
    ends = [min(max(at, 0), n - 1), min(max(at + step, 0), n - 1)]
    points = [(place[k], smooth[k]) if piece.along == 0 else (smooth[k], place[k]) for k in ends]
    ax.annotate("", points[1], points[0], arrowprops={"arrowstyle": "-|>", "color": colour, "mutation_scale": 28})


def _smoothed(value: Floats) -> tuple[slice, Floats]:
    """Places with a complete window around them, and the mean over it."""
    reach = min(max(1, len(value) // SMOOTH), (len(value) - 1) // 2)
    size = 2 * reach + 1
    return slice(reach, len(value) - reach), np.convolve(value, np.full(size, 1.0 / size), mode="valid")


def _size(ax: "Axes", pieces: Sequence[Piece], magnification: float) -> None:
    """Error-scale bar."""
    span = max(float(np.ptp(p.place_mm)) for p in pieces)
    wanted_um = span / 8.0 / magnification * 1e3
    scale = min(SCALES_UM, key=lambda s: abs(np.log(s / wanted_um)))
    length = scale * 1e-3 * magnification
    x = 0.5 * sum(ax.get_xlim())
    y = 0.5 * sum(ax.get_ylim()) + 0.06 * span
    if any(p.along == 1 and abs(p.beside_mm - x) < 0.2 * span for p in pieces):
        x -= 0.28 * span
    if any(p.along == 0 and abs(p.beside_mm - y) < 0.15 * span for p in pieces):
        y += 0.15 * span
    ax.plot([x - 0.5 * length, x + 0.5 * length], [y, y], color="black", linewidth=3)
    for end in (-0.5, 0.5):
        ax.plot([x + end * length] * 2, [y - 0.012 * span, y + 0.012 * span], color="black", linewidth=3)
    ax.text(x, y + 0.02 * span, f"error {scale:g} µm", ha="center", va="bottom", fontweight="bold", fontsize=14)
