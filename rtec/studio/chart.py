"""A plot in a page: Plotly as it comes with NiceGUI, with points that light up in all plots of the page."""

from pathlib import Path
from typing import Any, Final

import nicegui
from nicegui.element import Element

PLOTLY: Final = str(Path(nicegui.__file__).parent / "elements" / "plotly" / "dist")


class Chart(Element, component="chart.js", esm={"nicegui-plotly": PLOTLY}):
    """A plot.

    It emits `brush` (numbers of the readings that were selected), `reading` (number of the one under the pointer, or
    that the arrow keys lead to) and `zoom` (ends of the horizontal and of the vertical axis, None for all of both).

    Args:
        figure: from `rtec.studio.figures`.
        shows: what it shows, in words for those who cannot see it.
        keys: whether its readings are walked along by keys.
    """

    def __init__(self, figure: dict[str, Any], shows: str, *, keys: bool = False) -> None:
        super().__init__()
        self._props["options"] = figure
        self._props["aria-label"] = shows
        if keys:
            self._props["role"], self._props["tabindex"] = "application", "0"
            self._props["aria-description"] = "arrow keys, Page up, Page down, Home and End walk along the readings"

    def show(self, figure: dict[str, Any]) -> None:
        """Draw another figure in its place."""
        self._props["options"] = figure
        self.update()

    def morph(self, figure: dict[str, Any], ms: int = 1200) -> None:
        """Move the points to those of another figure with as many of them."""
        self.run_method("morph", figure, ms)

    def append(self, x: list[list[float]], y: list[list[float | None]], most: int) -> None:
        """Add points at the end of each trace, and take off the oldest beyond so many."""
        self.run_method("append", x, y, most)
