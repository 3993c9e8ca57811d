"""A plot in a page: the Plotly of NiceGUI, with a selection of points that all plots of the page share."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import nicegui
from nicegui.element import Element

if TYPE_CHECKING:
    from rtec.studio.parts.session import TabSession

MORPH_MS: Final = 1200
PLOTLY: Final = str(Path(nicegui.__file__).parent / "elements" / "plotly" / "dist")


class Chart(Element, component="chart.js", esm={"nicegui-plotly": PLOTLY}):
    """A plot.

    It emits `brush` (numbers of the selected readings), `reading` (number of the reading under the pointer or of the
    arrow keys), `zoom` (visible ends of each axis that is not whole, by "x", "y", "y2") and `camera` (eye, centre and
    upward direction of a plot in 3D, in Plotly's units).

    Args:
        figure: from `rtec.studio.parts.figures`.
        shows: description for people who cannot see it.
        keys: whether the arrow keys move from reading to reading.
        view: what the user changed of its layout before.
        brushed: numbers of the readings that were marked before.
    """

    def __init__(
        self,
        figure: dict[str, Any],
        shows: str,
        *,
        keys: bool = False,
        view: dict[str, Any] | None = None,
        brushed: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self._props["options"] = figure
        if view:
            self._props["view"] = view
        if brushed:
            self._props["brushed"] = list(brushed)
        self._props["aria-label"] = shows
        if keys:
            self._props["role"], self._props["tabindex"] = "application", "0"
            self._props["aria-description"] = "arrow keys, Page up, Page down, Home and End walk along the readings"

    def show(self, figure: dict[str, Any]) -> None:
        """Replace the figure."""
        self._props["options"] = figure
        self.update()

    def morph(self, figure: dict[str, Any]) -> None:
        """Animate the points to those of another figure with the same number of points."""
        self.run_method("morph", figure, MORPH_MS)

    def append(self, x: list[list[float]], y: list[list[float | None]], most: int) -> None:
        """Append points to each trace, and remove the oldest ones beyond `most`."""
        self.run_method("append", x, y, most)


def zoomable(
    session: "TabSession",
    name: str,
    figure: dict[str, Any],
    shows: str,
    *,
    keys: bool = False,
    brushed: Sequence[int] = (),
) -> Chart:
    """A plot whose zoom the session keeps for later visits of the page and for the report.

    Args:
        session: the tab.
        name: name of the plot in the session.
        figure, shows, keys, brushed: as for `Chart`.
    """
    ends = session.zooms.get(name, {})
    view = {f"{axis[0]}axis{axis[1:]}.range": list(both) for axis, both in ends.items()}
    made = Chart(figure, shows, keys=keys, view=view, brushed=brushed)
    made.on("zoom", lambda e: session.zoom(name, e.args))
    return made
