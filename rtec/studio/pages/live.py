"""Live: requested and applied corrections of a running daemon, whether it follows the model, and if not, why."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from nicegui import ui

from rtec.control.facts import (
    AXIS_COLUMNS,
    axis_rows,
    footer,
    input_rows,
    reasons_not_ordered,
    state_word,
    troubles,
    um_text,
    waits_for_resume,
)
from rtec.errors import RtecError
from rtec.studio.parts.controls import Area, Words, button, from_home, heading, table
from rtec.studio.parts.session import TabSession
from rtec.text import clean_lines

if TYPE_CHECKING:
    from collections import deque

    from rtec.report.daemon import Moment
    from rtec.studio.parts.chart import Chart
    from rtec.tasks.daemon import LiveLink

ORDERS: Final = {
    "enable": ("Enable", "Let the correction follow the model, from its present value, within its limits?"),
    "hold": ("Hold", "Hold the correction at its present value? It is no emergency stop."),
    "fade": ("Fade", "Fade the correction to zero at its slew limit?"),
    "resume": ("Resume", "Let the devices go on from where they are? Do first what the reason asks for, such as the "
                         "check of a known position."),
}  # fmt: skip
BARS: Final = (("requested", "requested_um"), ("applied", "applied_um"))
DASHES: Final = ("solid", "dash", "dot")
"""Of each four lines: colours alone are hard to distinguish."""
EVERY: Final = 10
"""Tables are redrawn once for this many answers, bars at each."""


def build(session: TabSession) -> None:
    """The page."""
    heading("Live", session, "live")
    if session.live is None:
        Words("p", "No daemon is attached. Start the studio with `rtec studio --attach CONFIG`; CONFIG is the run file "
                   "of the daemon.", "lead")  # fmt: skip
        return
    _LivePage(session, session.live).build()


def state_of(found: dict[str, Any] | None, trouble: str) -> tuple[str, str, str]:
    """The state in one word, its reason, and the CSS class of its colour."""
    if found is None:
        return "no answer", trouble, "off"
    word, why = state_word(found["status"])
    return word, why, "on" if word == "on" else "held"


@dataclass
class _Spark:
    """A plot of what was kept over time.

    Attributes:
        chart: on the page.
        kept: what it draws.
        unit_s: of its time, in seconds.
        temperatures: whether it draws them, not the corrections.
        names: names of its lines.
        newest_s: time of the last point that it has.
    """

    chart: "Chart"
    kept: "deque[Moment]"
    unit_s: float
    temperatures: bool
    names: list[str]
    newest_s: float


class _LivePage:
    def __init__(self, session: TabSession, link: "LiveLink") -> None:
        self._session, self._link = session, link
        self._count = 0
        self._sparks: list[_Spark] = []
        self._tracks: dict[tuple[str, str], tuple[ui.element, Words]] = {}
        self._axes: tuple[str, ...] = ()
        self._resume: ui.button | None = None
        self._limits: dict[str, tuple[float, float]] = {}

    def build(self) -> None:
        link = self._link
        with ui.element("div").classes("row").props('role="status" aria-live="polite"'):
            Words("span", "Correction:", "lead")
            self._state = Words("p", "", "state")
            self._why = Words("p", "", "lead")
        self._lead = Words("p", "", "small")
        if link.role == "operate":
            with ui.element("div").classes("row"):
                made = {
                    name: button(text, partial(self._ask, name, text, question), main=name == "resume")
                    for name, (text, question) in ORDERS.items()
                }
                self._resume = made["resume"]
                self._resume.set_visibility(False)
                self._mark = ui.input("Text beside the log", placeholder="new tool").props("outlined dense")
                button("Mark", self._set_mark)
        else:
            Words("p", "This studio only looks: start it with --role operate for the buttons.", "small")
        self._message = Words("p", "", "lead").props('role="status" aria-live="polite"')
        self._make_bars()
        self._plots = Area(self._make_plots)
        self._tables = Area(self._make_tables)
        key = id(self)
        link.look(key, self._changed)
        self._key = key
        self._changed()

    def _changed(self) -> None:
        if self._state.is_deleted:
            self._link.leave(self._key)
            return
        found = self._link.status
        text, why, kind = state_of(found, self._link.trouble)
        self._state.set_text(text)
        self._why.set_text(clean_lines(why))
        self._state.classes(add=kind, remove=" ".join({"on", "held", "off"} - {kind}))
        if found is None:
            self._offer_resume(False)
            self._lead.set_text("It is asked again every second.")
            return
        self._lead.set_text(f"{found['machine']}, model {found['model']}, {from_home(found['config'])}")
        axes = tuple(found["status"]["applied_um"])  # none before the first row of a daemon
        if axes != self._axes:
            if axes:
                self._session.on_change()  # first answer, or another machine's daemon
            return
        self._offer_resume(waits_for_resume(found["status"]))
        self._move_bars(found)
        self._count += 1
        if self._count % EVERY == 1:
            self._tables.redo()
            self._append()

    def _offer_resume(self, offered: bool) -> None:
        if self._resume is not None:
            self._resume.set_visibility(offered)

    def _make_bars(self) -> None:
        found = self._link.status
        self._tracks = {}
        self._axes = tuple(found["status"]["applied_um"]) if found is not None else ()
        self._limits = dict(self._link.limits_um)
        with ui.element("div").classes("pair"):
            for axis in self._axes:
                warning, stop = self._limits.get(axis, (0.0, 0.0))
                with ui.element("div").classes("card"):
                    Words("h2", f"Axis {axis}")
                    for name, _ in (*BARS, ("residual", "")):
                        self._bar(axis, name, warning, stop)
                    if stop:
                        beyond = f"A request beyond ±{warning:g} µm (dashed) is flagged, one beyond ±{stop:g} µm"
                        Words("p", f"{beyond} is not followed.", "small")

    def _bar(self, axis: str, name: str, warning: float, stop: float) -> None:
        with ui.element("div").classes("bar"):
            Words("span", name)
            with ui.element("div").classes("track"):
                fill = ui.element("div").classes(f"fill {name}")
                ui.element("div").classes("zero")
                for side in (-1.0, 1.0) if stop else ():
                    ui.element("div").classes("limit").style(f"left: {50.0 * (1.0 + side * warning / stop):.2f}%")
            self._tracks[axis, name] = fill, Words("b", "")

    def _move_bars(self, found: dict[str, Any]) -> None:
        status = found["status"]
        for axis in self._axes:
            residual = found["left"]["axes"].get(axis, {}).get("rms_um")
            values = {name: status[key][axis] for name, key in BARS} | {"residual": residual}
            stop = self._limits.get(axis, (0.0, 0.0))[1] or max(abs(v or 0.0) for v in values.values()) or 1.0
            for name, value in values.items():
                fill, words = self._tracks[axis, name]
                share = max(min((value or 0.0) / stop, 1.0), -1.0)
                fill.style(f"left: {50.0 + min(50.0 * share, 0.0):.2f}%; width: {50.0 * abs(share):.2f}%")
                unit = "" if value is None else " µm"
                words.set_text(f"{um_text(value)}{unit}" if name != "residual" or value is None else f"{value:.2f} µm")

    def _make_plots(self) -> None:
        link = self._link
        self._sparks = []
        with ui.element("div").classes("plots"):
            self._spark("Applied correction, last 10 minutes", link.minutes, temperatures=False)
            self._spark("Temperatures, last 10 minutes", link.minutes, temperatures=True)
            self._spark("Applied correction, last 24 hours", link.hours, temperatures=False)
            self._spark("Temperatures, last 24 hours", link.hours, temperatures=True)

    def _spark(self, title: str, kept: "deque[Moment]", *, temperatures: bool) -> None:
        from rtec.report.daemon import since
        from rtec.studio.parts import figures
        from rtec.studio.parts.chart import zoomable

        names = self._names(kept, temperatures)
        unit_s, unit = (60.0, "minutes") if kept is self._link.minutes else (3600.0, "hours")
        data = [
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": figures.text(n),
                "x": [m.time_s / unit_s for m in kept],
                "y": [_of(m, n, temperatures) for m in kept],
                "line": {"color": figures.PALETTE[(2 + k) % 8], "width": 2, "dash": DASHES[k // 4 % 3]},
                "marker": {"size": 4},
            }
            for k, n in enumerate(names)
        ]
        up = figures.axis("temperature, °C" if temperatures else "correction, µm")
        layout = figures.layout(
            xaxis=figures.axis(f"{unit} {since(self._link.runs)}", nticks=6, rangemode="nonnegative"),
            yaxis=up,
            dragmode="zoom",
            showlegend=True,
            legend={"x": 1.01, "y": 1.0, "yanchor": "top", "font": {"size": 13}},
        )
        with ui.element("div").classes("card"):
            Words("h2", title)
            name = f"live {unit} {'degc' if temperatures else 'applied'}"
            chart = zoomable(self._session, name, {"data": data, "layout": layout}, title).classes("low")
        self._sparks.append(_Spark(chart, kept, unit_s, temperatures, names, kept[-1].time_s if kept else -1.0))

    def _names(self, kept: "deque[Moment]", temperatures: bool) -> list[str]:
        from rtec.report.daemon import named

        found = self._link.status
        now = found["status"]["degc" if temperatures else "applied_um"] if found is not None else ()
        return list(dict.fromkeys([*named(kept, temperatures=temperatures), *now]))

    def _append(self) -> None:
        for spark in self._sparks:
            if spark.names != self._names(spark.kept, spark.temperatures) or _begins_anew(spark):
                self._plots.redo()  # a restarted daemon, maybe with other sensors
                return
            new = [m for m in spark.kept if m.time_s > spark.newest_s]
            if not new:
                continue
            spark.newest_s = new[-1].time_s
            across = [[m.time_s / spark.unit_s for m in new]] * len(spark.names)
            up = [[_of(m, n, spark.temperatures) for m in new] for n in spark.names]
            spark.chart.append(across, up, spark.kept.maxlen or 0)

    def _make_tables(self) -> None:
        from rtec.report.page import Table

        found = self._link.status
        if found is None:
            return
        with ui.element("div").classes("cards"):
            wrong = troubles(found) + [f"why: {r}" for r in reasons_not_ordered(found["status"])]
            if wrong:
                with ui.element("div").classes("card bad").props('role="alert"'):
                    Words("h2", "What is wrong")
                    for line in wrong:
                        Words("p", line, "trouble")
            with ui.element("div").classes("card whole"):
                Words("h2", "Axes")
                table(Table(AXIS_COLUMNS, axis_rows(found)))
                for line in footer(found):
                    Words("p", line, "small")
            with ui.element("div").classes("card"):
                Words("h2", "Inputs and their ages")
                table(Table(("input", "value", "age"), input_rows(found) if found["status"]["cycles"] else []))
            with ui.element("div").classes("card whole"):
                Words("h2", "Events, newest first")
                rows = [
                    [e["utc"][:19].replace("T", " "), e["what"], e["text"], e["who"]]
                    for e in reversed(self._link.events)
                ]
                if rows:
                    table(Table(("UTC", "what", "text", "by"), rows, words=(0, 1, 2, 3)))
                else:
                    Words("p", "None yet.", "small")

    def _ask(self, name: str, text: str, question: str) -> None:
        with ui.dialog() as dialog, ui.element("div").classes("card").props('role="alertdialog"'):
            Words("h2", question)

            async def go() -> None:
                dialog.close()
                await self._give(name, "")

            with ui.element("div").classes("row"):
                button(text, go, main=True)
                button("Cancel", dialog.close)
        dialog.open()

    async def _set_mark(self) -> None:
        if not (self._mark.value or "").strip():
            self._mark.error = "write a text first, for example: new tool"
            return
        await self._give("mark", self._mark.value.strip())
        self._mark.value = ""

    async def _give(self, name: str, text: str) -> None:
        try:
            outcome = await self._link.order(name, text)
            self._message.set_text(outcome.text)
        except RtecError as e:
            self._message.set_text(str(e))


def _begins_anew(spark: _Spark) -> bool:
    """Whether a daemon was restarted since the last point that a plot has."""
    return any(m.is_gap and m.time_s >= spark.newest_s for m in spark.kept)


def _of(moment: "Moment", name: str, temperatures: bool) -> float | None:
    value = (moment.degc if temperatures else moment.applied_um).get(name)
    return None if value is None else round(value, 3)
