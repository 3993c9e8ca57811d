"""Explore: the machine from its chain with its error magnified, effect by effect, and what a part would measure."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from nicegui import events, ui

from rtec.errors import RtecError
from rtec.model import Model
from rtec.model.at import state_at
from rtec.studio import actions, figures
from rtec.studio.chart import Chart
from rtec.studio.geometry import ChainNodes, cylinder, nodes
from rtec.studio.parts import Words, heading, label, lacking, number, trouble
from rtec.studio.session import TabSession
from rtec.wording import number as shown
from rtec.wording import significant

PLACES: Final = 5
"""Of each axis on the volumetric map."""
SPEED_RPM, DEGC = 6000.0, 25.0
MAGNIFIED: Final = (0.0, 5.0)
"""Powers of ten."""


def build(session: TabSession) -> None:
    """The page."""
    heading("Explore")
    trouble(session)
    if lacking(session):
        return
    step = session.step
    if step is None:
        Words("p", "The model is being read.", "lead")
        if not session.trouble:
            ui.timer(0.05, partial(_read, session), once=True)
        return
    if not step.model.effects:
        Words("p", "The model has no effect yet: the machine has no error that could be drawn.", "lead")
        return
    _Explorer(session, step.model).build()


async def _read(session: TabSession) -> None:
    if await actions.read_model(session):
        session.on_change()


class _Explorer:
    """The controls, and what they move."""

    def __init__(self, session: TabSession, model: Model) -> None:
        self._session, self._model = session, model
        machine = model.machine
        self._state: dict[str, float] = {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes}
        self._state |= {f"dir_{a.name}": 1.0 for a in machine.axes}
        self._state |= {s: model.reference_degc for s in machine.sensor_names if s in model.channels}
        self._others = [c for c in ("spindle_rpm", "load_kg", "force_n") if c in model.channels]
        self._state |= dict.fromkeys(self._others, 0.0)
        self._off: set[int] = set()
        self._power = 4.0
        self._words: dict[str, Words] = {}

    def build(self) -> None:
        self._headline = Words("p", "", "lead").props('role="status" aria-live="polite"')
        with ui.element("div").classes("split"):
            with ui.element("div").style("display: grid; gap: 1rem; min-width: 0"):
                with ui.element("div").classes("card"):
                    Words("h2", "The machine, its error magnified")
                    self._scene = Chart(_scene({}, 1.0, 0), "The machine's links: nominal, and moved by their errors")
                    self._scene.classes("tall")
                with ui.element("div").classes("card"):
                    Words("h2", "Error at the tool tip over the whole travel")
                    self._map = Chart(_scene({}, 1.0, 0), "Nominal places and where the tool tip really is, magnified")
                    self._map.classes("tall")
            with ui.element("div").style("display: grid; gap: 1rem; min-width: 0"):
                self._controls()
                with ui.element("div").classes("card"):
                    Words("h2", "Component errors here")
                    empty = {"data": [], "layout": figures.layout()}
                    self._bars = Chart(empty, "Component errors at this place")
        self._redraw()

    def _controls(self) -> None:
        machine, model = self._model.machine, self._model
        with ui.element("div").classes("card"):
            Words("h2", "Where, and in what state")
            self._slider("magnified", *MAGNIFIED, self._power, lambda v: f"{significant(10.0**v, 2)} times", "magnify")
            for a in machine.axes:
                self._slider(a.name, *a.travel_mm, self._state[a.name], lambda v: f"{shown(v, 1)} mm", a.name)
            for a in machine.axes:
                if a.direction_channel in model.channels:
                    with ui.element("div").classes("row"):
                        Words("span", f"{a.name} last moved")
                        signs = {1: "+", -1: "−"}
                        toggle = ui.toggle(signs, value=1, on_change=partial(self._set, f"dir_{a.name}"))
                        label(toggle.props("no-caps unelevated toggle-color=primary"), f"direction of {a.name}")
            for sensor in (s for s in machine.sensor_names if s in model.channels):
                low, high = model.valid_range.get(sensor, (model.reference_degc - DEGC, model.reference_degc + DEGC))
                start = min(max(model.reference_degc, low), high)
                self._state[sensor] = start
                self._slider(sensor, low, high, start, lambda v: f"{shown(v, 1)} °C", sensor)
            for name in self._others:
                low, high = model.valid_range.get(name, (0.0, SPEED_RPM if name == "spindle_rpm" else 1000.0))
                self._slider(name, min(low, 0.0), high, 0.0, lambda v: shown(v, 0), name)
        with ui.element("div").classes("card"):
            Words("h2", "Effects")
            for k, f in enumerate(model.effects):
                ui.checkbox(f.label, value=True, on_change=partial(self._toggle, k))

    def _slider(self, key: str, low: float, high: float, value: float, say: Any, name: str) -> None:
        """A slider with a field beside it that takes numbers in German and in English."""
        with ui.element("div").classes("setting"):
            Words("span", name)
            slider = ui.slider(min=low, max=high, step=(high - low) / 200.0 or 1.0, value=value)
            label(slider.props("throttle=0.15"), name)
            words = Words("span", say(value), "small")
            field = ui.input(value=shown(value if key != "magnified" else 10.0**value, 1))
            label(field, f"{name}, number")
            field.props("dense outlined").style("width: 6.5rem")

        def moved(event: events.ValueChangeEventArguments[float | None]) -> None:
            now = float(event.value or 0.0)
            words.set_text(say(now))
            if key == "magnified":
                self._power = now
            else:
                self._state[key] = now
            self._redraw()

        def typed() -> None:
            try:
                given = number(field.value or "")
                inner = float(np.log10(given)) if key == "magnified" and given > 0.0 else given
                if not low - 1e-9 <= inner <= high + 1e-9:
                    ends = (10.0**low, 10.0**high) if key == "magnified" else (low, high)
                    raise RtecError(f"from {significant(ends[0])} to {significant(ends[1])}")
            except RtecError as e:
                field.error = str(e)
                return
            field.error = None
            slider.value = inner

        slider.on_value_change(moved)
        field.on("keydown.enter", typed).on("blur", typed)

    def _set(self, key: str, event: events.ValueChangeEventArguments[Any]) -> None:
        self._state[key] = float(event.value)
        self._redraw()

    def _toggle(self, k: int, event: events.ValueChangeEventArguments[bool | None]) -> None:
        (self._off.discard if event.value else self._off.add)(k)
        self._redraw()

    def _redraw(self) -> None:
        model = replace(self._model, effects=tuple(f for k, f in enumerate(self._model.effects) if k not in self._off))
        error = model.predict(dict(self._state))
        state, _ = state_at(model, dict(self._state), {})
        values = model.components(state)[0]
        components = dict(zip(model.machine.components, values.tolist(), strict=True))
        tip = ", ".join(f"{axis} {shown(float(e), 2, sign=True)}" for axis, e in zip("XYZ", error, strict=True))
        self._headline.set_text(f"Here the tool tip is off by {tip} µm. {_part(model, self._state)}")
        pose = {a.name: self._state[a.name] for a in model.machine.axes}
        sides = {side: nodes(model.machine, components, pose, side) for side in ("tool", "work")}
        magnified = 10.0**self._power
        self._scene.show(_scene(sides, magnified, 1))
        self._map.show(_volume(model, self._state, magnified))
        fed = {c: components[c] for c in model.fed}
        self._bars.show(_bars(fed) if fed else {"data": [], "layout": figures.layout()})


def _part(model: Model, state: Mapping[str, float]) -> str:
    """What a cylinder of 200 mm would measure, in a sentence."""
    try:
        c = cylinder(model, state)
    except RtecError as e:
        return f"{str(e)[0].upper()}{str(e)[1:]}."
    size = shown(200.0 + 1e-3 * c.larger_um, 4)
    if c.turned:
        return (
            f"A turned cylinder of 200 mm would measure {size} mm; over {c.length_mm:.0f} mm of length its diameter "
            f"changes by {shown(c.form_um, 1)} µm."
        )
    return f"A milled cylinder of 200 mm would measure {size} mm and be {shown(c.form_um, 1)} µm out of round."


def _bars(fed: Mapping[str, float]) -> dict[str, Any]:
    ordered = dict(sorted(fed.items(), key=lambda kv: -abs(kv[1])))
    figure = figures.bars(ordered, "µm or µrad", "component error")
    figure["layout"]["xaxis"]["zeroline"] = True
    return figure


def _axis3(title: str) -> dict[str, Any]:
    return {"title": {"text": title}, "gridcolor": "@grid", "color": "@ink", "backgroundcolor": "@paper"}


def _layout3() -> dict[str, Any]:
    scene = {"xaxis": _axis3("X, mm"), "yaxis": _axis3("Y, mm"), "zaxis": _axis3("Z, mm"), "aspectmode": "data",
             "uirevision": "kept"}  # fmt: skip
    return figures.layout(scene=scene, dragmode="orbit", margin={"l": 0, "r": 0, "t": 40, "b": 0})


def _scene(sides: Mapping[str, ChainNodes], magnified: float, tip: int) -> dict[str, Any]:
    data = []
    for side, n in sides.items():
        for moved, tint in ((0.0, "@muted"), (magnified, {"tool": "@c2", "work": "@c3"}[side])):
            at = n.place_mm + 1e-3 * moved * n.moved_um
            name = f"{side} side, {'with its errors' if moved else 'nominal'}"
            data.append({
                "type": "scatter3d", "mode": "lines+markers+text" if moved else "lines", "name": name,
                "x": figures.numbers(at[:, 0]), "y": figures.numbers(at[:, 1]), "z": figures.numbers(at[:, 2]),
                "text": [figures.text(v) for v in n.names], "line": {"color": tint, "width": 10 if moved else 4},
                "marker": {"size": 5, "color": tint}, "textfont": {"size": 13, "color": "@ink"},
                "hoverinfo": "text",
            })  # fmt: skip
    del tip
    return {"data": data, "layout": _layout3()}


def _volume(model: Model, state: Mapping[str, float], magnified: float) -> dict[str, Any]:
    """Nominal places of the tool tip over the travels, and where it really is, joined by lines."""
    machine = model.machine
    grid = np.array(list(product(*(np.linspace(*a.travel_mm, PLACES) for a in machine.axes))))
    at: dict[str, Any] = {k: np.full(len(grid), v) for k, v in state.items()}
    at |= {a.name: grid[:, i] for i, a in enumerate(machine.axes)}
    error = model.predict(at)
    chain = machine.chain
    place = np.einsum("ij,nj->ni", chain.tip, np.concatenate([np.ones((len(grid), 1)), grid], axis=1))
    real = place + 1e-3 * magnified * error
    size = np.linalg.norm(error, axis=1)
    joined = np.stack([place, real, np.full_like(place, np.nan)], axis=1).reshape(-1, 3)
    bar = {"title": {"text": "error, µm"}, "thickness": 14, "tickfont": {"color": "@ink"}}
    marker = {"size": 5, "color": figures.numbers(size), "colorscale": "Viridis", "showscale": True, "colorbar": bar}
    data = [
        {"type": "scatter3d", "mode": "lines", "name": "error, magnified", "x": figures.numbers(joined[:, 0]),
         "y": figures.numbers(joined[:, 1]), "z": figures.numbers(joined[:, 2]), "line": {"color": "@c2", "width": 4},
         "hoverinfo": "skip"},
        {"type": "scatter3d", "mode": "markers", "name": "tool tip", "x": figures.numbers(real[:, 0]),
         "y": figures.numbers(real[:, 1]), "z": figures.numbers(real[:, 2]), "marker": marker,
         "text": [f"{v:.2f} µm" for v in size], "hoverinfo": "text"},
    ]  # fmt: skip
    return {"data": data, "layout": _layout3()}
