"""Compare: the model and the measurements, and where the model fails."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from nicegui import events, ui

from rtec.arrays import Floats, Ints
from rtec.report.figures import Zoom
from rtec.report.thinning import MOST, drawn
from rtec.studio.parts import actions, figures
from rtec.studio.parts.chart import Chart, zoomable
from rtec.studio.parts.controls import Area, Words, button, heading, lacking, section, table, tiles, waiting
from rtec.studio.parts.session import TabSession
from rtec.tasks.model import DIRECTION, CompareView, OutlierView, SeriesView
from rtec.tasks.report import DrawnPlot, marked_rows, marked_words
from rtec.text import clean
from rtec.wording import counted, decimals, number, sizes

MOST_OUTLIERS = 50
NONE: Final[Ints] = np.zeros(0, dtype=np.int64)


def build(session: TabSession) -> None:
    """The page."""
    heading("Compare", session, "compare")
    if lacking(session):
        return
    step = session.step
    if step is None or (step.compared is None and (not step.residual or session.job is None)):
        waiting(session, "The model is being compared with the measurements.", actions.compare)
        return
    view = step.compared
    head = Area(lambda: _head(session))
    plots = _Plots(session, step.residual if view is None else view.series)
    plots.build()
    tail = Area(lambda: _tail(session))

    def compared() -> bool:
        view = session.step.compared if session.step is not None else None
        if head.is_gone or view is None:
            return False
        for area in (head, tail):
            area.redo()
        plots.know(view)
        return True

    session.on_compared = compared
    if view is not None:
        plots.know(view)


def _head(session: TabSession) -> None:
    step = session.step
    if step is None:
        return
    if step.compared is not None:
        Words("p", step.compared.page.lead, "lead")
        view = step.compared
        k = _chosen_number(session, view.series)
        _tiles(view.series, view.series[k], view.tiles[k])
        return
    s = _chosen(session, step.residual)
    Words("p", "The residual is drawn. Its noise floor and where it is worst are being worked out.", "lead")
    measured, residual = (f"{v}\u00a0{s.unit}" for v in sizes(_rms(s.measured), _rms(s.residuals)))
    _tiles(step.residual, s, [(measured, "measured"), (residual, "residual"), ("…", "noise floor")])


def _tiles(series: Sequence[SeriesView], shown: SeriesView, numbers: Sequence[tuple[str, str]]) -> None:
    """Large numbers of the chosen reading column; the first names it where there are several."""
    (first, meaning), *others = numbers
    tiles([(first, f"{meaning} in {clean(shown.name)}" if len(series) > 1 else meaning), *others])


def _tail(session: TabSession) -> None:
    view = session.step.compared if session.step is not None else None
    if view is None:
        return
    _outliers(view)
    for part in view.page.sections:
        section(part)
    with ui.element("div").classes("row"):
        button("Diagnose: which effect is missing?", lambda: session.go("diagnose"), main=True)


def worst(series: Sequence[SeriesView]) -> int:
    """Index of the reading column with the largest residual, relative to its noise where that is known."""
    return worst_first(series)[0]


def worst_first(series: Sequence[SeriesView]) -> list[int]:
    """Indices of the reading columns, those with the largest residual first, as for `worst`."""
    badness = [s.residual / (max(s.floor, 1e-9) if s.floor >= 0.0 else 1.0) for s in series]
    return sorted(range(len(series)), key=lambda k: -badness[k])


def shown_plot(session: TabSession, series: Sequence[SeriesView]) -> DrawnPlot:
    """What the first plot draws: the chosen reading column, and the channels for its axis and its colours."""
    s = _chosen(session, series)
    over, colour = session.plots.over, session.plots.colour
    marked = marked_rows(s, session.plots.marked)
    zooms = {k.removeprefix("compare "): zoom for k, zoom in session.zooms.items() if k.startswith("compare ")}
    first = next(iter(s.channels))
    return DrawnPlot(s, over if over in s.channels else first, colour if colour in s.channels else "", marked, zooms)


def _chosen(session: TabSession, series: Sequence[SeriesView]) -> SeriesView:
    """The chosen reading column; at first the one with the largest residual."""
    return series[_chosen_number(session, series)]


def _chosen_number(session: TabSession, series: Sequence[SeriesView]) -> int:
    kept, names = session.plots.series, [s.name for s in series]
    return names.index(kept) if kept in names else worst(series)


def colours(s: SeriesView) -> dict[str, str]:
    """Choices of the channel for the colours, by title; the empty one is the direction of motion, with its markers."""
    return {"": DIRECTION, **{t: clean(t) for t in s.channels if t != DIRECTION}}


@dataclass
class _Plot:
    """A plot and its readings.

    Attributes:
        chart: the plot on the page.
        make: makes its figure from rows of readings.
        rows: rows of its readings; None for a plot without single readings.
    """

    chart: Chart
    make: Callable[[Ints], dict[str, Any]]
    rows: Ints | None


class _Plots:
    """The linked plots of one reading column."""

    def __init__(self, session: TabSession, series: tuple[SeriesView, ...]) -> None:
        self._session, self._all = session, series
        self._series = _chosen(session, series)
        self._plots: dict[str, _Plot] = {}
        self._wrong: tuple[OutlierView, ...] = ()

    @property
    def _over(self) -> str:
        return shown_plot(self._session, (self._series,)).over

    @property
    def _colour(self) -> str:
        return shown_plot(self._session, (self._series,)).colour

    def build(self) -> None:
        s = self._series
        channels = {t: clean(t) for t in s.channels}
        with ui.element("div").classes("row choices"):
            names = {v.name: clean(v.name) for v in self._all}
            self._choice("series", "Measurement", names, s.name, rebuild=True)
            self._choice("over", "Draw over", channels, self._over)
            self._choice("colour", "Colour by", colours(s), self._colour)
            self._detail = Words(
                "div",
                self._marked_now()
                or "Point at a reading to see its row, or walk along the readings of a plot with the arrow keys. Drag "
                "over readings to mark them in every plot.",
                "reading card",
            ).props('role="status" aria-live="polite"')
        with ui.element("div").classes("plots"):
            self._add("residual", "The residual", self._residual, self._over_channel("residual"))
            self._add("measured", "Measured and predicted", self._measured, self._over_channel("measured"))
            time = next(t for t in s.channels if t.startswith("time "))
            self._add(
                "time",
                "The residual over time, with the temperatures",
                lambda rows: figures.over_time(self._series, rows),
                lambda zoom: drawn(s.residuals, s.channels[time], s.residuals, zoom),
            )
            places = [t for t in s.channels if t.endswith(", mm")]
            if len(places) > 1:
                self._add(
                    "map", "The residual over two positions", lambda _: figures.residual_map(s, places[0], places[1])
                )
            angle = s.angle_rad
            if angle is not None:
                self._add(
                    "polar",
                    "Deviation from the circle, magnified",
                    lambda rows: figures.polar(s, angle, rows),
                    lambda _: drawn(s.residuals, angle, s.residuals),
                )
        if len(s) > MOST:
            Words(
                "p",
                f"Of {len(s)} readings so many are drawn that none stands apart unseen; zoom in to see more of those "
                "that are there. All of them count in the numbers.",
                "small",
            )

    def know(self, view: CompareView) -> None:
        """Add the noise floor and the outliers to the existing plots."""
        new = next((s for s in view.series if s.name == self._series.name), None)
        own = self._series.name.partition(", ")[0]
        wrong = tuple(o for o in view.outliers if o.measurement == own)
        if new is None or (new.floor == self._series.floor and wrong == self._wrong):
            return
        self._all, self._series, self._wrong = view.series, new, wrong
        self._show("residual", "measured", "time")

    def _residual(self, rows: Ints) -> dict[str, Any]:
        return figures.residual_over(self._series, self._over, self._colour, rows, wrong=self._wrong)

    def _measured(self, rows: Ints) -> dict[str, Any]:
        return figures.residual_over(self._series, self._over, "", rows, "measured")

    def _over_channel(self, what: str) -> Callable[[Zoom], Ints]:
        s = self._series
        up = s.residuals if what == "residual" else s.measured
        return lambda zoom: drawn(s.residuals, s.channels[self._over], up, zoom)

    def _choice(self, key: str, label: str, options: dict[str, str], value: str, *, rebuild: bool = False) -> None:
        def choose(event: events.ValueChangeEventArguments[str]) -> None:
            session = self._session
            chosen: Any = {key: event.value}
            session.plots = replace(session.plots, **chosen)
            if rebuild:
                session.plots = replace(session.plots, marked=())
                session.unzoom("compare")
                session.on_change()
                return
            names = ("residual", "measured") if key == "over" else ("residual",)
            if key == "over":
                session.unzoom(*(f"compare {name}" for name in names))
            for name in names:
                self._plots[name].rows = self._rows(name, self._over_channel(name))
                self._show(name)

        ui.select(options, value=value, label=label, on_change=choose).props("outlined")

    def _add(
        self,
        key: str,
        title: str,
        make: Callable[[Ints], dict[str, Any]],
        drawn: Callable[[Zoom], Ints] | None = None,
    ) -> None:
        session = self._session
        rows = None if drawn is None else self._rows(key, drawn)
        with ui.element("div").classes("card"):
            Words("h2", title)
            shown = make(NONE if rows is None else rows)
            chart = zoomable(
                session, f"compare {key}", shown, title, keys=drawn is not None, brushed=session.plots.marked
            ).classes("tall" if key == "time" else "")
        self._plots[key] = _Plot(chart, make, rows)
        chart.on("reading", lambda e: self._point(int(e.args)))
        chart.on("brush", lambda e: self._brush(e.args))
        if drawn is not None and key != "polar" and len(self._series) > MOST:
            chart.on("zoom", lambda _: self._zoom(key, drawn))

    def _rows(self, key: str, drawn: Callable[[Zoom], Ints]) -> Ints:
        """Rows of the readings that a plot draws: of those in sight, and all that are marked."""
        marked = shown_plot(self._session, (self._series,)).marked
        return np.union1d(drawn(self._session.zooms.get(f"compare {key}", {})), marked)

    def _zoom(self, key: str, drawn: Callable[[Zoom], Ints]) -> None:
        rows, now = self._rows(key, drawn), self._plots[key].rows
        if now is None or not np.array_equal(rows, now):
            self._plots[key].rows = rows
            self._show(key)

    def _show(self, *keys: str) -> None:
        for plot in (self._plots[k] for k in keys):
            plot.chart.show(plot.make(NONE if plot.rows is None else plot.rows))

    def _point(self, number_of_all: int) -> None:
        i = number_of_all - self._series.first
        if 0 <= i < len(self._series):
            marked = self._marked_now().partition(":")[0]
            self._detail.set_text(clean(_row_words(self._series, i)) + (f" {marked}." if marked else ""))

    def _brush(self, numbers: list[float]) -> None:
        self._session.mark(numbers)
        self._detail.set_text(self._marked_now() or "No readings marked.")
        self._draw_also(shown_plot(self._session, (self._series,)).marked)

    def _marked_now(self) -> str:
        """The marked readings in words; empty where there are none."""
        return clean(marked_words(shown_plot(self._session, (self._series,))))

    def _draw_also(self, rows: Ints) -> None:
        """Draw the readings that are marked in one plot in all plots."""
        for key, plot in self._plots.items():
            if plot.rows is not None and not np.isin(rows, plot.rows).all():
                plot.rows = np.union1d(plot.rows, rows)
                self._show(key)


def _row_words(s: SeriesView, i: int) -> str:
    channels = [f"{t.partition(', ')[0]} {v[i]:.5g} {t.partition(', ')[2]}".strip() for t, v in s.channels.items()]
    digits = decimals(_rms(s.residuals))
    measured, predicted, residual = (number(v[i], digits) for v in (s.measured, s.predicted, s.residuals))
    return (
        f"{s.name}, row {s.row[i]}, run {s.run[i]}: measured {measured}, predicted {predicted}, residual {residual} "
        f"{s.unit}. {'; '.join(channels)}."
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


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
