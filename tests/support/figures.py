"""The figure behind a PNG, for tests that ask what is drawn."""

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from rtec.report.figures import STYLE


def drawn(draw: Callable[..., bytes], *args: Any, **kwargs: Any) -> Figure:
    """The figure that a function of the reports draws, laid out."""
    with rc_context(STYLE):
        figure = inspect.unwrap(draw)(*args, **kwargs)
        assert isinstance(figure, Figure)
        figure.draw_without_rendering()
    return figure


def lines(ax: Axes) -> list[np.ndarray]:
    """Points, (n, 2), of every line that joins more than two of them."""
    joined = [line for line in ax.get_lines() if line.get_linestyle() not in ("None", "", " ")]
    return [points for line in joined if len(points := np.asarray(line.get_xydata())) > 2]


def overlapping(texts: list[Text]) -> list[tuple[str, str]]:
    """Pairs of texts that lie on each other."""
    boxes = [(t.get_text(), t.get_window_extent()) for t in texts if t.get_text().strip() and t.get_visible()]
    return [(a, b) for i, (a, one) in enumerate(boxes) for b, two in boxes[i + 1 :] if one.overlaps(two)]
