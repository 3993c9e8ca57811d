"""Add and watch: adds effects, moves the residual, and shows the staircase of errors down to the noise floor."""

from functools import partial
from typing import Any, Final

import numpy as np
from nicegui import ui

from rtec.diagnosis.words import labels
from rtec.errors import RtecError
from rtec.model.history import steps_of
from rtec.report.history import Present, stairs_to
from rtec.report.thinning import drawn
from rtec.studio.pages.compare import worst_first
from rtec.studio.parts import actions, figures
from rtec.studio.parts.chart import Chart, zoomable
from rtec.studio.parts.controls import (
    Area,
    Named,
    Words,
    at_fault,
    button,
    command,
    draft,
    heading,
    lacking,
    number,
    section,
    shell,
    soon,
    trouble,
    waiting,
)
from rtec.studio.parts.session import ModelStep, TabSession, blamed
from rtec.tasks import model as model_tasks
from rtec.tasks.jobs import Cancelled, Job
from rtec.tasks.model import CompareView, EffectRequest, RefitQuestion, StepQuestion
from rtec.tasks.report import ShownResidual, marked_rows
from rtec.wording import percent, probability, significant

HELP: Final = (
    "Positions x, y, z in mm; d_x is the direction of motion, -1 or +1; v_x velocity in mm/s; s_x distance since X "
    "turned round, mm; temperatures by their names, in K above the reference; spindle_rpm, load_kg, time_s.",
    "Names that are neither channels nor parameters are fitted: A*x, A*sin(2*pi*x/p + phi), B*d_x*T_bed.",
    "sin, cos, exp, log, sqrt, abs, tanh, min, max; lag(T_bed, tau) is T_bed through a lag of tau seconds.",
    "A parameter with a range is searched: a start, and from where to where. It gets a slider below.",
)
NOTHING_WRITTEN: Final = "Its curve through the residual appears here while you type."
STEPS: Final = 200
FIELDS: Final = {"--expr": "own", "--component": "feeds", "--param": "params"}
"""Field of the page for each option of `rtec add`."""
MOST_RESIDUALS = 3
"""Largest number of reading columns whose residual is drawn; more would move too slowly."""


def build(session: TabSession) -> None:
    """The page."""
    heading("Add and watch", session, "add")
    if lacking(session):
        return
    step = session.step
    if step is None or step.compared is None:
        waiting(session, "The model is being compared with the measurements.", actions.compare)
        return
    if session.question is not None:
        _question(session, session.question[0])
    if session.improved:
        with ui.element("div").classes("card good").props('role="status"'):
            Words("p", session.improved, "lead")
    if step.added is not None:
        Words("p", step.added.page.lead, "lead")
    else:
        Words("p", step.compared.page.lead, "lead")
    _toolbar(session)
    with ui.element("div").classes("plots"):
        _stairs(session, step)
        _residuals(session, step.compared)
    _own_expression(session)
    if step.added is not None:
        for part in step.added.page.sections[:1]:
            section(part)
    _save(session)


def _toolbar(session: TabSession) -> None:
    busy = "other work is not finished" if session.job is not None else ""
    with ui.element("div").classes("row"):
        button("Undo", lambda: _move(session, -1), off=busy or ("" if session.at > 0 else "nothing to undo"))
        button(
            "Redo",
            lambda: _move(session, +1),
            off=busy or ("" if session.at + 1 < len(session.steps) else "nothing to redo"),
        )
        button("Find the next effect", lambda: session.go("diagnose"), main=True)
        button("Improve step by step", lambda: actions.improve(session), off=busy)
        button("Refit the numbers", lambda: _refit(session), off=busy)
    trouble(session, "improve")


def _move(session: TabSession, by: int) -> None:
    session.move(by)
    session.on_change()


async def _refit(session: TabSession) -> None:
    if await actions.add(session, None, "improve"):
        session.moving = True
        session.on_change()


def _question(session: TabSession, question: Any) -> None:
    with ui.element("div").classes("card chosen").props('role="alertdialog" aria-label="Question"'):
        if isinstance(question, RefitQuestion):
            Words("h2", question.question)
            Words("p", f"The residual on held-out runs {question.fell}.")
            with ui.element("div").classes("row"):
                button("Add" if question.adds else "Refit", lambda: session.answer(True), main=True)
                button("Leave it out" if question.adds else "Keep the numbers", lambda: session.answer(False))
        elif isinstance(question, StepQuestion):
            _ask_step(session, question)


def _ask_step(session: TabSession, question: StepQuestion) -> None:
    d = question.diagnosis.found
    Words("h2", f"Step {question.number}: add {d.findings[0].label}?")
    Words("p", question.diagnosis.page.lead)
    if 1 in question.diagnosis.curves:
        Chart(figures.evidence_figure(question.diagnosis.curves[1][0]), "Residual and the proposed effect")
    with ui.element("div").classes("row"):
        offered = d.findings[:4]
        for f, label in zip(offered, labels(offered), strict=True):
            fall = percent(max(f.heldout_drop, 0.0))
            shown = f"Add {label} (probability {probability(f.confidence)}, held-out error falls by {fall})"
            button(shown, partial(session.answer, f.rank), main=f.rank == 1)
        button("Stop here", lambda: session.answer(0))


def _stairs(session: TabSession, step: ModelStep) -> None:
    steps, own = steps_of(session.steps[-1].model), steps_of(step.model)
    found = stairs_to(present(step.compared) if step.compared else None, steps, len(steps) - len(own))
    with ui.element("div").classes("card"):
        Words("h2", "The error falling")
        if found is None:
            Words("p", "Add an effect; then the error before and after is drawn here.")
            return
        shows = "The residual on held-out runs after each step, and the noise floor"
        Chart(figures.staircase(found), shows).classes("tall")


def present(view: CompareView) -> Present | None:
    """The residual of the measurements that the model is compared with."""
    together = view.facts["together"]
    if not together["rms_residual"]:
        return None
    return Present(together["rms_residual"], together["noise_floor"] or None, together["unit"])


def _residuals(session: TabSession, view: CompareView) -> None:
    """The residuals of the worst reading columns, animated from those of the step before."""
    before = _before(session)
    moved, session.moving = session.moving and before is not None, False
    source = before if before is not None else view
    for k in _shown(view, source):
        _residual(session, view, source, k, moved=moved)


def _shown(view: CompareView, source: CompareView) -> list[int]:
    """Indices of the reading columns that are drawn."""
    return [k for k in worst_first(source.series) if k < len(view.series)][:MOST_RESIDUALS]


def shown_residuals(session: TabSession, view: CompareView) -> tuple[ShownResidual, ...]:
    """The residuals that the page draws, with their scale."""
    source = _before(session) or view
    series = [(view.series[k], _most(view, source, k)) for k in _shown(view, source)]
    return tuple(ShownResidual(s, most, marked_rows(s, session.plots.marked)) for s, most in series)


def _residual(session: TabSession, view: CompareView, source: CompareView, k: int, *, moved: bool) -> None:
    """The residual of a reading column, moved from that of `source` if `moved`, on the scale of the larger one."""
    s, began, most = view.series[k], source.series[k], _most(view, source, k)
    over = next(iter(s.channels))
    with ui.element("div").classes("card"):
        Words("h2", f"The residual of {s.name}")
        after = _fixed(figures.residual_over(s, over), most)
        name, shows = f"add {s.name}", "The residual over position"
        brushed = session.plots.marked
        if not moved or len(began) != len(s):
            chart = zoomable(session, name, after, shows, brushed=brushed).classes("tall")
            chart.on("brush", lambda e: session.mark(e.args)).props["data-moved"] = "yes"
            return
        rows = drawn(began.residuals, began.channels[over], began.residuals)
        before = _fixed(figures.residual_over(began, over, "", rows), most)
        chart = zoomable(session, name, before, shows, brushed=brushed).classes("tall")
        chart.on("brush", lambda e: session.mark(e.args))
        target = _fixed(figures.residual_over(s, over, "", rows), most)
        ui.timer(0.6, lambda: chart.morph(target), once=True)


def _before(session: TabSession) -> CompareView | None:
    at = session.at - 1 if session.came_from is None else session.came_from
    return session.steps[at].compared if 0 <= at < len(session.steps) else None


def _fixed(figure: dict[str, Any], most: float) -> dict[str, Any]:
    """The figure with the end of its scale, so that the fall is visible."""
    figure["layout"]["yaxis"]["range"] = [-most, most]
    return figure


def _most(view: CompareView, source: CompareView, k: int) -> float:
    """End of the scale that shows a reading column before and after a step: the better model may be either."""
    return 1.08 * max(float(np.abs(v.series[k].residuals).max()) for v in (view, source))


def commands(session: TabSession, out: str) -> list[str]:
    """Equivalent commands of the command line, up to the current step.

    Args:
        session: the tab.
        out: file of the resulting model.
    """
    lines: list[list[str]] = []
    source = session.model
    for k in range(1, session.at + 1):
        kind, *rest = session.steps[k].words
        last = k == session.at
        target = out if last else session.saved.get(k, f"step-{k}.toml")
        if kind == "improve":
            if not last and session.steps[k + 1].words[0] == "improve":
                continue  # one command for all of its steps
            lines.append(["rtec", "improve", Named(source), *map(Named, session.chosen), "-o", Named(target)])
        else:
            given = ["--data", *map(Named, session.chosen), "-o", Named(target)]
            lines.append(["rtec", "add", Named(source), *rest, *given])
        source = target
    return [shell(line) for line in lines]


def _own_expression(session: TabSession) -> None:
    """The form."""
    form = _Form(session)
    begun = session.drafts.get("own") or any(session.trouble_at(place) for place in ("own_add", *FIELDS.values()))
    with ui.element("details").classes("card").props("open" if begun else ""):
        Words("summary", "An effect of your own")
        form.build()


def _empty_figure() -> dict[str, Any]:
    return {"data": [], "layout": figures.layout(xaxis=figures.axis(""), yaxis=figures.axis(""))}


class _Form:
    """An expression, its curve during typing, and sliders for its parameters."""

    def __init__(self, session: TabSession) -> None:
        self._session = session
        self._preview: Job | None = None
        self._below = ""
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
        self._message = Words("p", NOTHING_WRITTEN, "small").props('role="status"')
        first = _empty_figure()
        if s.previewed is not None:
            first, self._below = figures.evidence_figure(s.previewed[1].evidence), s.previewed[1].evidence.below
        self._chart = zoomable(s, "add own", first, "Residual and the expression")
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
        self._ranges, self._session.previewed = {}, None
        self._text.error = self._component.error = self._params.error = None
        try:
            request = self._request()
        except RtecError as e:
            self._params.error = str(e)
            self._draw_nothing("")
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
        if self._preview is not None:
            self._preview.cancel()
        if not request.expression or step is None:
            self._draw_nothing(NOTHING_WRITTEN)
            return
        job = self._preview = Job("Preview", lambda: None)
        try:
            shown = await job.run(model_tasks.preview, step.model, request, self._session.files)
        except Cancelled:
            return
        except RtecError as e:
            message, key = blamed(str(e), FIELDS, "own")
            {"own": self._text, "feeds": self._component, "params": self._params}[key].error = message
            self._draw_nothing("")
            return
        if not self._chart.is_deleted:
            self._text.error = None
            self._message.set_text(shown.words)
            if shown.evidence.below != self._below:
                self._session.unzoom("add own")
            self._below = shown.evidence.below
            self._chart.show(figures.evidence_figure(shown.evidence))
            self._session.previewed = request.expression, shown

    def _draw_nothing(self, message: str) -> None:
        """Take the last curve and its numbers away; a preview that is still being computed is not shown."""
        if self._preview is not None:
            self._preview.cancel()
        self._session.previewed = None
        if not self._chart.is_deleted:
            self._message.set_text(message)
            self._chart.show(_empty_figure())

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


def _save(session: TabSession) -> None:
    if session.at == 0:
        return
    with ui.element("div").classes("card"):
        Words("h2", "Save the model")
        kept = session.saved.get(session.at)
        if kept:
            Words("p", f"Saved as {kept}.", "lead").props('role="status"')
        name = draft(session, f"save_{session.at}", "File for the model", kept or _free_name(session))

        def show() -> None:
            Words("p", "The same on the command line, in this folder:", "small")
            for line in commands(session, name.value or "better.toml"):
                command(line)

        def save() -> None:
            try:
                keep(session, name.value or "")
            except RtecError as e:
                name.error = str(e)

        # Above the parts whose height depends on the name, so that nothing moves under the pointer.
        button("Save", save, main=True)
        name.on_value_change(Area(show).redo)


def keep(session: TabSession, name: str) -> None:
    """Save the model of the current step, as the command line saves it.

    Raises:
        RtecError: the name is not possible, the file belongs to another tab or program, or it cannot be written.
    """
    known = session.written.get(name) if name in session.saved.values() else None
    session.written[name] = session.folder.save_model(session.steps[session.at].model, name, known)
    session.saved = {k: n for k, n in session.saved.items() if n != name} | {session.at: name}
    session.fail("")
    session.look()
    session.on_change()


def _free_name(session: TabSession) -> str:
    taken = {p.name for p in session.folder.root.glob("*.toml")}
    return next(n for n in ("better.toml", *(f"better-{k}.toml" for k in range(2, 999))) if n not in taken)
