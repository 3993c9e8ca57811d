"""Explore: the machine's chain with its magnified error, effect by effect, and the errors of a part."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from nicegui import events, ui

from rtec.diagnosis.words import UNITS
from rtec.errors import RtecError
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.model import Model
from rtec.model.at import state_at
from rtec.studio import actions, figures
from rtec.studio.chart import Chart
from rtec.studio.geometry import ChainNodes, cylinder, nodes
from rtec.studio.parts import Words, heading, label, lacking, number, waiting
from rtec.studio.session import TabSession
from rtec.wording import number as shown
from rtec.wording import significant

PLACES: Final = 5
"""Number of places of each axis on the volumetric map."""
SPEED_RPM, DEGC = 6000.0, 25.0
THIN, ROOM = 0.3, 0.65
"""Smallest extent of the room as a share of its largest; half of its width over that of the machine."""
MAGNIFIED: Final = (0.0, 5.0)
"""Range of the magnification, as powers of ten."""


def build(session: TabSession) -> None:
    """The page."""
    heading("Explore")
    if lacking(session):
        return
    step = session.step
    if step is None:
        waiting(session, "The model is being read.", _read)
        return
    if not step.model.effects:
        Words("p", "The model has no effect yet: the machine has no error that could be drawn.", "lead")
        return
    _Explorer(session, step.model).build()


async def _read(session: TabSession) -> None:
    if await actions.read_model(session):
        session.on_change()


class _Explorer:
    """The controls and the plots that they change."""

    def __init__(self, session: TabSession, model: Model) -> None:
        self._session, self._model = session, model
        machine = model.machine
        self._state: dict[str, float] = {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes}
        self._state |= {f"dir_{a.name}": 1.0 for a in machine.axes}
        for sensor in (s for s in machine.sensor_names if s in model.channels):
            low, high = model.valid_range.get(sensor, (model.reference_degc,) * 2)
            self._state[sensor] = min(max(model.reference_degc, low), high)
        self._others = [c for c in ("spindle_rpm", "load_kg", "force_n") if c in model.channels]
        self._state |= dict.fromkeys(self._others, 0.0)
        self._off: set[int] = set()
        self._power = 4.0

    def build(self) -> None:
        self._headline = Words("p", "", "lead").props('role="status" aria-live="polite"')
        scene, volume, bars = self._figures()
        with ui.element("div").classes("split"):
            with ui.element("div").style("display: grid; gap: 1rem; min-width: 0"):
                with ui.element("div").classes("card"):
                    Words("h2", "The machine, its error magnified")
                    self._scene = Chart(scene, "The machine's links: nominal, and moved by their errors").classes(
                        "tall"
                    )
                with ui.element("div").classes("card"):
                    Words("h2", "Error at the tool tip over the whole travel")
                    self._map = Chart(volume, "Nominal places and where the tool tip is, magnified").classes("tall")
            with ui.element("div").classes("controls"):
                self._controls()
                with ui.element("div").classes("card"):
                    Words("h2", "Component errors here")
                    self._bars = Chart(bars, "Component errors at this place")

    def _controls(self) -> None:
        machine, model = self._model.machine, self._model
        with ui.element("div").classes("card"):
            Words("h2", "Where, and in what state")
            self._slider("", "magnified, times", *MAGNIFIED, self._power)
            for a in machine.axes:
                self._slider(a.name, f"{a.name}, mm", *a.travel_mm, self._state[a.name])
            for a in machine.axes:
                if a.direction_channel in model.channels:
                    with ui.element("div").classes("row"):
                        Words("span", f"{a.name} moved last")
                        signs = {1: "+", -1: "−"}
                        toggle = ui.toggle(signs, value=1, on_change=partial(self._set, f"dir_{a.name}"))
                        label(toggle.props("no-caps unelevated toggle-color=primary"), f"direction of {a.name}")
            for sensor in (s for s in machine.sensor_names if s in model.channels):
                low, high = model.valid_range.get(sensor, (model.reference_degc - DEGC, model.reference_degc + DEGC))
                self._slider(sensor, f"{sensor}, °C", low, high, self._state[sensor])
            for name in self._others:
                low, high = model.valid_range.get(name, (0.0, SPEED_RPM if name == "spindle_rpm" else 1000.0))
                self._slider(name, name, min(low, 0.0), high, 0.0)
        with ui.element("div").classes("card"):
            Words("h2", "Effects")
            for k, f in enumerate(model.effects):
                words = f"{type(f.effect).about.title}: {f.label}"
                label(ui.checkbox(words, value=True, on_change=partial(self._toggle, k)), words)

    def _slider(self, key: str, name: str, low: float, high: float, value: float) -> None:
        """A slider with a field for numbers in German and in English; without a key it is the magnification."""

        def as_text(v: float) -> str:
            return shown(v, 1) if key else significant(10.0**v, 2)

        with ui.element("div").classes("setting"):
            Words("span", name)
            slider = ui.slider(min=low, max=high, step=(high - low) / 200.0 or 1.0, value=value)
            label(slider.props("throttle=0.15"), name)
            field = ui.input(value=as_text(value)).props("dense outlined")
            label(field, f"{name}, number")

        written, focused = as_text(value), False

        def focus(now: bool) -> None:
            nonlocal focused
            focused = now

        def moved(event: events.ValueChangeEventArguments[float | None]) -> None:
            nonlocal written
            now = float(event.value or 0.0)
            if not (focused and field.value != written):  # else the text that the user is typing would be lost
                written = field.value = as_text(now)
                field.error = None
            if key:
                self._state[key] = now
            else:
                self._power = now
            self._redraw()

        def apply() -> None:
            nonlocal written
            if field.value == written:  # the text is rounded, the value is not
                field.error = None
                return
            try:
                given = number(field.value or "")
                inner = given if key else float(np.log10(max(given, 1e-9)))
                if not low - 1e-9 <= inner <= high + 1e-9:
                    ends = (low, high) if key else (10.0**low, 10.0**high)
                    raise RtecError(f"from {significant(ends[0])} to {significant(ends[1])}")
            except RtecError as e:
                field.error = str(e)
                return
            field.error = None
            written = field.value or ""
            slider.value = inner

        slider.on_value_change(moved)
        field.on("focus", lambda: focus(True)).on("blur", lambda: focus(False))
        field.on("keydown.enter", apply).on("blur", apply)

    def _set(self, key: str, event: events.ValueChangeEventArguments[Any]) -> None:
        self._state[key] = float(event.value)
        self._redraw()

    def _toggle(self, k: int, event: events.ValueChangeEventArguments[bool | None]) -> None:
        (self._off.discard if event.value else self._off.add)(k)
        self._redraw()

    def _redraw(self) -> None:
        for chart, figure in zip((self._scene, self._map, self._bars), self._figures(), strict=True):
            chart.show(figure)

    def _figures(self) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Figures of machine, volumetric map and bars; updates the headline."""
        model = replace(self._model, effects=tuple(f for k, f in enumerate(self._model.effects) if k not in self._off))
        machine = model.machine
        error = model.predict(dict(self._state))
        values = model.components(state_at(model, dict(self._state), {})[0])[0]
        components = dict(zip(machine.components, values.tolist(), strict=True))
        tip = ", ".join(f"{axis} {shown(float(e), 2, sign=True)}" for axis, e in zip("XYZ", error, strict=True))
        self._headline.set_text(f"Here the tool tip is off by {tip} µm. {_part(model, self._state)}")
        pose = {a.name: self._state[a.name] for a in machine.axes}
        sides = {side: nodes(machine, components, pose, side) for side in ("tool", "work")}
        magnified = 10.0**self._power
        fed = {c: components[c] for c in model.fed}
        bars = _bars(fed) if fed else {"data": [], "layout": figures.layout()}
        return _scene(machine, sides, magnified), _volume(model, self._state, magnified), bars


def _part(model: Model, state: Mapping[str, float]) -> str:
    """Sentence on the errors of a cylinder of 200 mm."""
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
    units = {c: UNITS[component_unit(c)] for c in ordered}
    figure = figures.bars(ordered, units, f"component error, {' or '.join(sorted(set(units.values())))}")
    figure["layout"]["xaxis"]["zeroline"] = True
    figure["layout"]["margin"] = {"l": 70, "r": 70, "t": 44, "b": 56}  # numbers are at the ends of the bars
    return figure


def _axis3(title: str) -> dict[str, Any]:
    return {"title": {"text": title}, "gridcolor": "@grid", "color": "@ink", "backgroundcolor": "@paper"}


def _layout3(machine: Machine) -> dict[str, Any]:
    """Layout of a room with space for the machine at both ends of its travels, so that it is constant during motion."""
    zero = np.zeros((1, 3))
    ends = [{a.name: a.travel_mm[end] for a in machine.axes} for end in (0, 1)]
    places = [zero, *(nodes(machine, {}, pose, side).place_mm for pose in ends for side in ("tool", "work"))]
    low, high = (f(np.concatenate(places), axis=0) for f in (np.min, np.max))
    size = np.maximum(high - low, THIN * float((high - low).max()))
    middle = 0.5 * (low + high)
    ranges = np.stack([middle - ROOM * size, middle + ROOM * size], axis=1)
    ratio = size / float(size.max())
    scene: dict[str, Any] = {
        f"{axis}axis": _axis3(f"{axis.upper()}, mm") | {"range": ranges[k].tolist()} for k, axis in enumerate("xyz")
    }
    scene |= {"aspectmode": "manual", "aspectratio": dict(zip("xyz", (1.2 * ratio).tolist(), strict=True))}
    scene |= {
        "uirevision": "kept",
        "camera": {"eye": {"x": 0.98, "y": -1.49, "z": 0.6}, "center": {"x": 0, "y": 0, "z": -0.1}},
    }
    return figures.layout(scene=scene, dragmode="orbit", margin={"l": 0, "r": 0, "t": 40, "b": 0})


def _scene(machine: Machine, sides: Mapping[str, ChainNodes], magnified: float) -> dict[str, Any]:
    data = []
    for side, n in sides.items():
        for moved, tint in ((0.0, "@muted"), (magnified, {"tool": "@c2", "work": "@c3"}[side])):
            at = n.place_mm + 1e-3 * moved * n.moved_um
            name = f"{side} side, with its errors" if moved else "nominal"
            data.append({
                "type": "scatter3d", "mode": "lines+markers+text" if moved else "lines", "name": name,
                "showlegend": bool(moved) or side == "tool",
                "x": figures.numbers(at[:, 0]), "y": figures.numbers(at[:, 1]), "z": figures.numbers(at[:, 2]),
                "text": _names_at(n, base=side == "work"), "line": {"color": tint, "width": 10 if moved else 4},
                "marker": {"size": 5, "color": tint}, "textfont": {"size": 13, "color": "@ink"}, "hoverinfo": "text",
                "textposition": "middle right" if side == "work" else "top center",
            })  # fmt: skip
    return {"data": data, "layout": _layout3(machine)}


def _names_at(n: ChainNodes, *, base: bool) -> list[str]:
    """Names of the links, joined for links at one place; with the base, which both sides have, if `base`."""
    out = [""] * len(n.names)
    first = 0 if base else 1
    for k in range(first, len(n.names)):
        here = [m for m in range(first, len(n.names)) if np.allclose(n.place_mm[m], n.place_mm[k])]
        if here[0] == k:
            out[k] = figures.text(", ".join(n.names[m] for m in here))
    return out


def _volume(model: Model, state: Mapping[str, float], magnified: float) -> dict[str, Any]:
    """Nominal and predicted places of the tool tip over the travels, joined by lines."""
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
    marker = {
        "size": 5,
        "color": figures.numbers(size),
        "colorscale": figures.SCALE,
        "showscale": True,
        "colorbar": bar,
    }
    data = [
        {"type": "scatter3d", "mode": "lines", "name": "error, magnified", "x": figures.numbers(joined[:, 0]),
         "y": figures.numbers(joined[:, 1]), "z": figures.numbers(joined[:, 2]), "line": {"color": "@c2", "width": 4},
         "hoverinfo": "skip"},
        {"type": "scatter3d", "mode": "markers", "name": "tool tip", "x": figures.numbers(real[:, 0]),
         "y": figures.numbers(real[:, 1]), "z": figures.numbers(real[:, 2]), "marker": marker,
         "text": [f"{v:.2f} µm" for v in size], "hoverinfo": "text"},
    ]  # fmt: skip
    return {"data": data, "layout": _layout3(machine)}
