"""Draws the shape of an effect: with braille dots for a terminal, as a PNG in the house style for a page.

Curves after the first are dashed, so that they are told apart without colour.
"""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.effects import all_effects
from rtec.errors import ConfigError
from rtec.report.effects_shape import Curve, Shape, shape_of
from rtec.report.figures import GREY, LINES, STYLE, WIDTH_IN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a braille character's dots, by row and column."""
BLANK = 0x2800
DASHES = ((1, 0), (4, 3), (1, 2))
"""Dot columns on and off of each curve's line, in order."""
SAMPLES = ("⠤⠤⠤⠤", "⠤⠤⠀⠤", "⠄⠄⠄⠄")
PLOT_LINES = ("-", "--", ":")


def sketch(shape: Shape, columns: int = 60, rows: int = 10) -> list[str]:
    """Lines of a drawing for the terminal.

    Args:
        shape: what to draw.
        columns, rows: size of the drawing in characters; the scale beside it comes on top.
    """
    low, high = _ends(shape)
    dots = np.zeros((4 * rows, 2 * columns), dtype=bool)
    for curve, (on, off) in zip(shape.curves, DASHES, strict=False):
        _draw(dots, curve, low, high, on, off)
    marks = {0: f"{high:g}", rows - 1: f"{low:g}"}
    if low < 0.0 < high:
        marks.setdefault(_row(0.0, low, high, 4 * rows) // 4, "0")
    wide = max(len(m) for m in marks.values())
    body = [f"{marks.get(i, ''):>{wide}} ┤{line}" for i, line in enumerate(_characters(dots))]
    ends = f"{_short(shape.x[0])}{shape.over:^{max(columns - len(_short(shape.x[0])) - len(_short(shape.x[-1])), 0)}}"
    below = " " * (wide + 1) + "└" + "─" * columns
    return [
        f"{' ' * (wide + 1)}{shape.component}, {shape.unit}",
        *body,
        below,
        f"{' ' * (wide + 2)}{ends}{_short(shape.x[-1])}",
        *(f"{' ' * (wide + 2)}{line}" for line in _legend(shape.curves)),
    ]


def figure(title: str, equation: str, shape: Shape) -> bytes:
    """Give the shape as a PNG.

    Args:
        title: what the effect is called in words.
        equation: as text.
        shape: what to draw.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        canvas = Figure(figsize=(WIDTH_IN, 5.0), layout="constrained", facecolor="white")
        FigureCanvasAgg(canvas)
        ax = canvas.subplots()
        _plot(ax, shape)
        ax.set_title(title, pad=52)
        below = f"{equation}\ndrawn with {shape.sizes}"
        ax.text(0.0, 1.03, below, transform=ax.transAxes, fontsize=14, color=GREY, va="bottom", linespacing=1.4)
        ax.set_xlabel(shape.over)
        ax.set_ylabel(f"error {shape.component}, {shape.unit}")
        out = BytesIO()
        canvas.savefig(out, format="png", dpi=100, metadata={"Software": None})
    return out.getvalue()


def sketch_of(name: str) -> list[str]:
    """The drawing for the terminal of an effect by its name; nothing where it has no shape of its own."""
    kind = all_effects().get(name)
    shape = shape_of(kind) if kind is not None else None
    if shape is None:
        return []
    return [f"Its shape, drawn with {shape.sizes}:", "", *sketch(shape)]


def write_figure(name: str, path: Path) -> None:
    """Write the picture of an effect as a PNG.

    Raises:
        ConfigError: it has no shape of its own, or the file cannot be written.
    """
    kind = all_effects().get(name)
    shape = shape_of(kind) if kind is not None else None
    if kind is None or shape is None:
        raise ConfigError(f"effect {name!r} has no shape of its own to draw")
    try:
        path.write_bytes(figure(kind.about.title, kind.about.equation, shape))
    except OSError as e:
        raise ConfigError(f"{path}: cannot be written: {e.strerror}") from e


def _plot(ax: "Axes", shape: Shape) -> None:
    for curve, colour, line in zip(shape.curves, LINES[1:], PLOT_LINES, strict=False):
        ax.plot(shape.x, curve.error, color=colour, linestyle=line, label=curve.held)
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_xlim(float(shape.x[0]), float(shape.x[-1]))
    low, high = _ends(shape)
    ax.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low))
    if any(c.held for c in shape.curves):
        ax.legend(frameon=True, facecolor="white", framealpha=0.9, edgecolor="none", loc="best")


def _ends(shape: Shape) -> tuple[float, float]:
    """Ends of the scale: hold every value and zero, with two digits; a little apart where all is zero."""
    low = min(0.0, *(float(c.error.min()) for c in shape.curves))
    high = max(0.0, *(float(c.error.max()) for c in shape.curves))
    size = max(high - low, 1e-12)
    step = 10.0 ** np.floor(np.log10(size)) / 10.0
    low, high = float(np.floor(low / step + 1e-9) * step), float(np.ceil(high / step - 1e-9) * step)
    return (round(low, 12), round(high, 12)) if high > low else (-1.0, 1.0)


def _row(value: float, low: float, high: float, rows: int) -> int:
    return round((high - value) / (high - low) * (rows - 1))


def _draw(dots: NDArray[np.bool_], curve: Curve, low: float, high: float, on: int, off: int) -> None:
    """Set the dots of a curve; steps are joined by a vertical line."""
    rows, columns = dots.shape
    place = np.linspace(0.0, len(curve.error) - 1.0, columns)
    values = np.interp(place, np.arange(len(curve.error)), curve.error)
    before = None
    for column, value in enumerate(values):
        row = _row(float(value), low, high, rows)
        first, last = (row, row) if before is None else sorted((before + (row > before) - (row < before), row))
        if column % (on + off) < on:
            dots[first : last + 1, column] = True
        before = row


def _characters(dots: NDArray[np.bool_]) -> list[str]:
    rows, columns = dots.shape[0] // 4, dots.shape[1] // 2
    codes = np.full((rows, columns), BLANK)
    for i, bits in enumerate(DOTS):
        for k, bit in enumerate(bits):
            codes += bit * dots[i::4, k::2]
    return ["".join(map(chr, line)) for line in codes]


def _legend(curves: Sequence[Curve]) -> list[str]:
    named = [(s, c.held) for s, c in zip(SAMPLES, curves, strict=False) if c.held]
    if len(named) == 1:
        return [named[0][1]]
    return ["   ".join(f"{s} {held}" for s, held in named)] if named else []


def _short(value: float) -> str:
    return f"{float(value):.4g}"
