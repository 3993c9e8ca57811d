"""A plot in a page: Plotly as it comes with NiceGUI, with points that light up in all plots of the page."""

from pathlib import Path
from typing import Any, Final

import nicegui
from nicegui.element import Element

PLOTLY: Final = str(Path(nicegui.__file__).parent / "elements" / "plotly" / "dist")


class Chart(Element, component="chart.js", esm={"nicegui-plotly": PLOTLY}):
    """A plot.

    It emits `brush` (numbers of the readings that were selected), `reading` (number of the one under the pointer) and
    `zoom` (range of the horizontal axis, None for all of it).

    Args:
        figure: from `rtec.studio.figures`.
        shows: what it shows, in words for those who cannot see it.
    """

    def __init__(self, figure: dict[str, Any], shows: str) -> None:
        super().__init__()
        self._props["options"] = figure
        self._props["aria-label"] = shows

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
