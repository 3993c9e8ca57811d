"""The user's own effect on the page Add and watch: an expression, its curve during typing, and sliders."""

from typing import Any, Final

from nicegui import ui

from rtec.errors import RtecError
from rtec.studio import actions, figures, tasks
from rtec.studio.chart import Chart
from rtec.studio.jobs import Cancelled, Job
from rtec.studio.parts import Words, at_fault, button, number, soon, trouble
from rtec.studio.session import TabSession, blamed
from rtec.studio.tasks import EffectRequest
from rtec.wording import significant

HELP: Final = (
    "Positions x, y, z in mm; d_x is the direction of motion, -1 or +1; v_x velocity in mm/s; s_x distance since X "
    "turned round, mm; temperatures by their names, in K above the reference; spindle_rpm, load_kg, time_s.",
    "Names that are neither channels nor parameters are fitted: A*x, A*sin(2*pi*x/p + phi), B*d_x*T_bed.",
    "sin, cos, exp, log, sqrt, abs, tanh, min, max; lag(T_bed, tau) is T_bed through a lag of tau seconds.",
    "A parameter with a range is searched: a start, and from where to where. It gets a slider below.",
)
STEPS: Final = 200
FIELDS: Final = {"--expr": "own", "--component": "feeds", "--param": "params"}
"""Field of the page for each option of `rtec add`."""


def own_expression(session: TabSession) -> None:
    """The form."""
    form = _Form(session)
    begun = session.drafts.get("own") or any(session.trouble_at(place) for place in ("own_add", *FIELDS.values()))
    with ui.element("details").classes("card").props("open" if begun else ""):
        Words("summary", "An effect of your own")
        form.build()


class _Form:
    def __init__(self, session: TabSession) -> None:
        self._session = session
        self._preview: Job | None = None
        self._ranges: dict[str, tuple[float, float, float]] = {}

    def build(self) -> None:
        s, drafts = self._session, self._session.drafts
        step = s.step
        if step is None:
            return
        seen = list(
            dict.fromkeys(
                c for item in (step.compared.facts["measurements"] if step.compared else []) for c in item["components"]
            )
        )
        with ui.element("div").classes("row start"):
            self._text = (
                ui.input("Expression, µm or µrad", placeholder="A*sin(2*pi*x/p + phi)", value=drafts.get("own", ""))
                .props("outlined debounce=400")
                .style("flex: 2; min-width: 20rem")
            )
            self._component = (
                ui.select(seen, label="Feeds component", value=drafts.get("feeds") or (seen[0] if seen else None))
                .props("outlined")
                .style("min-width: 12rem")
            )
            self._params = (
                ui.input("Parameters with a range", placeholder="p=37:3..200", value=drafts.get("params", ""))
                .props("outlined debounce=400")
                .style("flex: 1; min-width: 14rem")
            )
        with ui.element("details"):
            Words("summary", "How to write it")
            for line in HELP:
                Words("p", line)
        self._sliders = ui.element("div").style("display: grid; gap: .3rem")
        self._message = Words("p", "Its curve through the residual appears here while you type.", "small").props(
            'role="status"'
        )
        self._chart = Chart(
            {"data": [], "layout": figures.layout(xaxis=figures.axis(""), yaxis=figures.axis(""))},
            "Residual and the expression",
        )
        button("Add this effect", self._add)
        trouble(s, "own_add")
        for key, field in (("own", self._text), ("feeds", self._component), ("params", self._params)):
            at_fault(s, key, field)
            field.on_value_change(self._changed)
        if drafts.get("own"):
            soon(self._changed)

    def _request(self, theta: dict[str, float] | None = None) -> EffectRequest:
        params = []
        for part in (self._params.value or "").split():
            name, _, rest = part.partition("=")
            start, _, ends = rest.partition(":")
            low, _, high = ends.partition("..")
            try:
                numbers = [number(v) for v in (start, low, high)]
            except RtecError as e:
                raise RtecError(f"{part!r}: write a parameter as NAME=START:LOW..HIGH, for example p=37:3..200") from e
            self._ranges[name] = (numbers[0], numbers[1], numbers[2])
            begin = (theta or {}).get(name, numbers[0])
            params.append(f"{name}={begin:.10g}:{numbers[1]:.10g}..{numbers[2]:.10g}")
        return EffectRequest("", self._component.value or "", (), (self._text.value or "").strip(), tuple(params))

    async def _changed(self) -> None:
        self._session.drafts |= {
            "own": self._text.value or "",
            "feeds": self._component.value or "",
            "params": self._params.value or "",
        }
        self._ranges = {}
        self._text.error = self._component.error = self._params.error = None
        try:
            request = self._request()
        except RtecError as e:
            self._params.error = str(e)
            return
        self._make_sliders()
        await self._draw(request)

    def _make_sliders(self) -> None:
        self._sliders.clear()
        values = {name: start for name, (start, _, _) in self._ranges.items()}

        def move(name: str, label: Any) -> Any:
            async def moved(event: Any) -> None:
                values[name] = float(event.value)
                label.set_text(f"{name} = {significant(values[name], 4)}")
                await self._draw(self._request(values))

            return moved

        with self._sliders:
            for name, (start, low, high) in self._ranges.items():
                with ui.element("div").classes("row"):
                    label = Words("span", f"{name} = {significant(start, 4)}").style("min-width: 9rem")
                    slider = ui.slider(
                        min=low, max=high, step=(high - low) / STEPS, value=start, on_change=move(name, label)
                    )
                    slider.props("throttle=0.3").style("flex: 1; max-width: 40rem")
                    slider.props["aria-label"] = f"parameter {name}"

    async def _draw(self, request: EffectRequest) -> None:
        step = self._session.step
        if not request.expression or step is None:
            return
        if self._preview is not None:
            self._preview.cancel()
        job = self._preview = Job("Preview", lambda: None)
        try:
            shown = await job.run(tasks.preview, step.model, request, self._session.files)
        except Cancelled:
            return
        except RtecError as e:
            message, key = blamed(str(e), FIELDS, "own")
            {"own": self._text, "feeds": self._component, "params": self._params}[key].error = message
            return
        if not self._chart.is_deleted:
            self._text.error = None
            self._message.set_text(shown.words)
            self._chart.show(figures.evidence_figure(shown.evidence))

    async def _add(self) -> None:
        try:
            request = self._request()
        except RtecError as e:
            self._params.error = str(e)
            return
        if not request.expression:
            self._text.error = "Write an expression, for example A*sin(2*pi*x/p + phi)"
            return
        if await actions.add(self._session, request, "own_add", FIELDS):
            self._session.drafts |= {"own": "", "params": ""}
            self._session.moving = True
            self._session.on_change()
