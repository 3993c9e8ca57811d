"""A plot in a page: the Plotly of NiceGUI, with a selection of points that all plots of the page share."""

from pathlib import Path
from typing import Any, Final

import nicegui
from nicegui.element import Element

PLOTLY: Final = str(Path(nicegui.__file__).parent / "elements" / "plotly" / "dist")


class Chart(Element, component="chart.js", esm={"nicegui-plotly": PLOTLY}):
    """A plot.

    It emits `brush` (numbers of the selected readings), `reading` (number of the reading under the pointer or of the
    arrow keys) and `zoom` (ends of the horizontal and of the vertical axis, None for the whole plot).

    Args:
        figure: from `rtec.studio.figures`.
        shows: description for people who cannot see it.
        keys: whether the arrow keys move from reading to reading.
    """

    def __init__(self, figure: dict[str, Any], shows: str, *, keys: bool = False) -> None:
        super().__init__()
        self._props["options"] = figure
        self._props["aria-label"] = shows
        if keys:
            self._props["role"], self._props["tabindex"] = "application", "0"
            self._props["aria-description"] = "arrow keys, Page up, Page down, Home and End walk along the readings"

    def show(self, figure: dict[str, Any]) -> None:
        """Replace the figure."""
        self._props["options"] = figure
        self.update()

    def morph(self, figure: dict[str, Any], ms: int = 1200) -> None:
        """Animate the points to those of another figure with the same number of points."""
        self.run_method("morph", figure, ms)

    def append(self, x: list[list[float]], y: list[list[float | None]], most: int) -> None:
        """Append points to each trace, and remove the oldest ones beyond `most`."""
        self.run_method("append", x, y, most)
