"""Compare: the model beside the measurements, and where it fails."""

from typing import Any

import numpy as np
from nicegui import events, ui

from rtec.studio import actions, figures
from rtec.studio.chart import Chart
from rtec.studio.parts import Words, button, heading, lacking, section, table, tiles, waiting
from rtec.studio.session import TabSession
from rtec.studio.tasks import CompareView, SeriesView
from rtec.text import clean
from rtec.wording import counted, number

MOST_OUTLIERS = 50


def build(session: TabSession) -> None:
    """The page."""
    heading("Compare")
    if lacking(session):
        return
    step = session.step
    view = step.compared if step is not None else None
    if view is None:
        waiting(session, "The model is being compared with the measurements.", actions.compare)
        return
    Words("p", view.page.lead, "lead")
    tiles(view.page.numbers)
    _plots(session, view)
    _outliers(view)
    for part in view.page.sections:
        section(part)
    with ui.element("div").classes("row"):
        button("Diagnose: which effect is missing?", lambda: session.go("diagnose"), main=True)


def worst(view: CompareView) -> int:
    """The reading column that the model fails most on, against its noise."""
    return int(np.argmax([s.residual / max(s.floor, 1e-9) for s in view.series]))


class _Plots:
    """The linked plots of one reading column."""

    def __init__(self, session: TabSession, view: CompareView) -> None:
        self._session, self._view = session, view
        kept = session.view.get("series", "")
        names = [s.name for s in view.series]
        self._series = view.series[names.index(kept) if kept in names else worst(view)]
        self._charts: dict[str, Chart] = {}

    @property
    def _over(self) -> str:
        wanted = self._session.view.get("over", "")
        return wanted if wanted in self._series.channels else next(iter(self._series.channels))

    @property
    def _colour(self) -> str:
        wanted = self._session.view.get("colour", "")
        return wanted if wanted in self._series.channels else ""

    def build(self) -> None:
        s = self._series
        channels = {t: clean(t) for t in s.channels}
        with ui.element("div").classes("row"):
            names = {v.name: clean(v.name) for v in self._view.series}
            self._choice("series", "Measurement", names, s.name, rebuild=True)
            self._choice("over", "Draw over", channels, self._over)
            self._choice("colour", "Colour by", {"": "direction of motion", **channels}, self._colour)
        self._detail = Words(
            "div", "Point at a reading to see its row. Drag over readings to mark them in every plot.", "reading card"
        ).props('role="status" aria-live="polite"')
        with ui.element("div").classes("plots"):
            self._add("residual", "The residual", self._residual)
            self._add(
                "measured", "Measured and predicted", lambda w: figures.residual_over(s, self._over, "", w, "measured")
            )
            self._add("time", "The residual over time, with the temperatures", lambda _: figures.over_time(s))
            places = [t for t in s.channels if t.endswith(", mm")]
            if len(places) > 1:
                self._add(
                    "map", "The residual over two positions", lambda _: figures.residual_map(s, places[0], places[1])
                )
            angle = s.angle_rad
            if angle is not None:
                self._add("polar", "Deviation from the circle, magnified", lambda _: figures.polar(s, angle))
        if len(s) > figures.MOST:
            Words(
                "p",
                f"{figures.MOST} of {len(s)} readings are drawn, among them those with the largest residual; zoom in "
                "to see those that are there. All of them count in the numbers.",
                "small",
            )

    def _residual(self, rows: Any) -> dict[str, Any]:
        own = self._series.name.partition(", ")[0]
        wrong = [o for o in self._view.outliers if o.measurement == own]
        return figures.residual_over(self._series, self._over, self._colour, rows, wrong=wrong)

    def _choice(self, key: str, label: str, options: dict[str, str], value: str, *, rebuild: bool = False) -> None:
        def choose(event: events.ValueChangeEventArguments[str]) -> None:
            self._session.view[key] = event.value
            if rebuild:
                self._session.on_change()
            else:
                self._redraw()

        ui.select(options, value=value, label=label, on_change=choose).props("outlined").style("min-width: 15rem")

    def _add(self, key: str, title: str, make: Any) -> None:
        with ui.element("div").classes("card"):
            Words("h2", title)
            chart = Chart(make(None), title).classes("tall" if key == "time" else "")
        chart.on("reading", lambda e: self._point(int(e.args)))
        chart.on("brush", lambda e: self._brush([int(v) for v in e.args]))
        if key in ("residual", "measured") and len(self._series) > figures.MOST:
            chart.on("zoom", lambda e: self._zoom(chart, make, e.args))
        self._charts[key] = chart

    def _zoom(self, chart: Chart, make: Any, within: list[float] | None) -> None:
        span = (float(within[0]), float(within[1])) if within else None
        chart.show(make(figures.drawn(self._series, self._series.channels[self._over], span)))

    def _redraw(self) -> None:
        s = self._series
        self._charts["residual"].show(self._residual(None))
        self._charts["measured"].show(figures.residual_over(s, self._over, "", None, "measured"))

    def _point(self, number_of_all: int) -> None:
        i = number_of_all - self._series.first
        if 0 <= i < len(self._series):
            self._detail.set_text(clean(_row_words(self._series, i)))

    def _brush(self, numbers: list[int]) -> None:
        s = self._series
        rows = np.array([n - s.first for n in numbers if 0 <= n - s.first < len(s)], dtype=np.int64)
        self._detail.set_text(clean(_marked_words(s, rows)) if len(rows) else "No readings marked.")


def _row_words(s: SeriesView, i: int) -> str:
    channels = [f"{t.partition(', ')[0]} {v[i]:.5g} {t.partition(', ')[2]}".strip() for t, v in s.channels.items()]
    return (
        f"{s.name}, row {s.row[i]}, run {s.run[i]}: measured {number(s.measured[i])}, "
        f"predicted {number(s.predicted[i])}, residual {number(s.left[i])} {s.unit}. {'; '.join(channels)}."
    )


def _marked_words(s: SeriesView, rows: Any) -> str:
    left = s.left[rows]
    spans = [
        f"{t.partition(', ')[0]} {v[rows].min():.5g} to {v[rows].max():.5g} {t.partition(', ')[2]}".strip()
        for t, v in list(s.channels.items())[:4]
    ]
    rms = float(np.sqrt(np.mean(left**2)))
    return (
        f"{counted(len(rows), 'reading')} marked: residual {number(rms)} {s.unit} root mean square, mean "
        f"{number(float(left.mean()), sign=True)} {s.unit}; {'; '.join(spans)}."
    )


def _plots(session: TabSession, view: CompareView) -> None:
    _Plots(session, view).build()


def _outliers(view: CompareView) -> None:
    if not view.outliers:
        return
    from rtec.report.page import Table

    with ui.element("details").classes("card"):
        Words("summary", f"{counted(len(view.outliers), 'wrong reading')} excluded")
        Words(
            "p",
            "Each is more than 7 robust standard deviations from a smooth dependence on the channels, from other "
            "visits to the same place, and from its neighbours, and does not come again. They count nowhere.",
        )
        rows = [
            [o.measurement, o.column, str(o.row), str(o.run), number(o.off, sign=True)]
            for o in view.outliers[:MOST_OUTLIERS]
        ]
        more = len(view.outliers) - MOST_OUTLIERS
        table(
            Table(
                ("measurement", "column", "row", "run", "off by, µm or µrad"),
                rows,
                f"{more} more." if more > 0 else "",
                words=(0, 1),
            )
        )
