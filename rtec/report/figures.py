"""Size and style of all figures, for reading at arm's length: large type, names at the lines, units on every axis.

Colours are those of Okabe and Ito, which everybody can distinguish; markers and lines differ, too, so that a print
without colour is enough. The input is arrays only: this module does not depend on its callers.
"""

import functools
import math
import warnings
from collections.abc import Callable, Mapping
from io import BytesIO
from textwrap import fill
from typing import TYPE_CHECKING, Any, ParamSpec

from rtec.text import clean_lines

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure
    from matplotlib.text import Text

OFF, ON, GREY = "#D55E00", "#0072B2", "#595959"
LINES = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#B8860B", "#3A9BD9", "#6B4E9B")
STYLE: Any = {
    "font.size": 15,
    "axes.titlesize": 17,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#DDDDDD",
    "lines.linewidth": 2.4,
    "lines.markersize": 7,
    "axes.formatter.limits": (-9, 9),
    "axes.formatter.useoffset": False,
}
KINDS: tuple[dict[str, Any], ...] = (
    {"color": OFF, "linestyle": "--", "marker": "s"},
    {"color": ON, "linestyle": "-", "marker": "o"},
)
WIDTH_IN = 11.0
LETTER, MIN_LETTERS, LABELS_IN = 0.62, 12, 1.3
"""Width of a bold letter in its size; fewest letters in a line of a title; room for the labels of a scale."""
P = ParamSpec("P")
Zoom = Mapping[str, tuple[float, float]]
"""Ends of a part of a figure, by axis: "x", "y", and "y2" of a second panel below; an axis without ends is whole."""
MOST_DOTS = 4000
"""Of more readings, evenly chosen ones are drawn."""
WHOLE: Zoom = {}


class Png(bytes):
    """A figure as PNG; `figure` is matplotlib's figure, for changes."""

    figure: "MplFigure"


def as_png(draw: "Callable[P, MplFigure]") -> Callable[P, Png]:
    """Decorate a function that draws a figure, so that it gives a PNG in this module's style.

    matplotlib's global style does not change. `inspect.unwrap` gives the original function.
    """

    @functools.wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> Png:
        from matplotlib import rc_context
        from matplotlib.text import Text

        out = BytesIO()
        with rc_context(STYLE):
            figure = draw(*args, **kwargs)
            for text in figure.findobj(Text):
                if words := text.get_text():  # no formulas; may have characters that no font has
                    text.set_text(clean_lines(words))
                    text.set_parse_math(False)
                    if text.get_fontweight() == "bold":
                        text.set_text(_wrapped_title(text))
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Glyph .* missing")  # it is drawn as a box
                figure.savefig(out, format="png", dpi=100, metadata={"Software": None})
        png = Png(out.getvalue())
        png.figure = figure
        return png

    return drawn


def _wrapped_title(title: "Text") -> str:
    """A title with line breaks; its panel has the width of the figure, or a share of it."""
    spec = title.axes.get_subplotspec() if title.axes else None
    room_pt = 72.0 * (WIDTH_IN / (spec.get_geometry()[1] if spec else 1) - LABELS_IN)
    return fill(title.get_text(), max(MIN_LETTERS, int(room_pt / (LETTER * float(title.get_fontsize())))))


@functools.cache
def _shown_figure() -> "type[MplFigure]":
    """The figure of matplotlib with a PNG for the cell of a notebook, which pyplot need not be imported for."""
    from matplotlib.figure import Figure

    class ShownFigure(Figure):
        def _repr_png_(self) -> bytes:
            out = BytesIO()
            self.savefig(out, format="png", dpi=72)
            return out.getvalue()

    return ShownFigure


def canvas(height_in: float) -> "MplFigure":
    """An empty figure as wide as all others."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _shown_figure()(figsize=(WIDTH_IN, height_in), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def stacked(*heights_in: float, share: bool = False) -> "tuple[MplFigure, Sequence[Axes]]":
    """A figure with panels of these heights, one below the other; they may share the horizontal axis."""
    figure = canvas(sum(heights_in))
    axes = figure.subplots(len(heights_in), 1, squeeze=False, sharex=share, height_ratios=heights_in)
    return figure, list(axes[:, 0])


def room_above(ax: "Axes", share: float, below: float = 0.0) -> None:
    """Extend the vertical scale by shares of itself, so that names have room above and below the curves."""
    low, high = ax.get_ylim()
    ax.set_ylim(low - below * (high - low), high + share * (high - low))


TICKS: tuple[tuple[float, ...], ...] = ((1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0))
"""Numbers of a decade that a logarithmic axis names; the more, the shorter the axis is."""


def log_ticks(low: float, high: float) -> list[float]:
    """Round numbers from `low` to `high` for a logarithmic axis; at least two where the ends are twofold apart."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    all_ticks = ([float(f"{sub * 10.0**d:.3g}") for d in decades for sub in subs] for subs in TICKS)
    few, many = ([v for v in ticks if low <= v <= high] for ticks in all_ticks)
    return few if len(few) > 1 else many


def zoomed(ax: "Axes", zoom: Zoom, up: str = "y") -> None:
    """Show a part of a panel only; `up` names its vertical axis in the zoom."""
    if "x" in zoom:
        ax.set_xlim(*zoom["x"])
    if up in zoom:
        ax.set_ylim(*zoom[up])


def zoom_words(zoom: Zoom) -> str:
    """The part that a figure shows, in words; empty where it is whole."""
    names = {"x": "the horizontal axis", "y": "the vertical axis", "y2": "the temperatures"}
    parts = [f"{name} from {zoom[k][0]:.4g} to {zoom[k][1]:.4g}" for k, name in names.items() if k in zoom]
    return f"Zoomed in: {', '.join(parts)}.".replace("-", "−") if parts else ""
