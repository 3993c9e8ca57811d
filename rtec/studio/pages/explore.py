"""Explore: the machine's chain with its magnified error, effect by effect, and the errors of a part."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from nicegui import events, ui

from rtec.arrays import Floats
from rtec.diagnosis.words import titled
from rtec.errors import RtecError
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.machine.links import LinkPlaces, Side, component_words, link_places, room_around
from rtec.model import Model
from rtec.model.volume import component_errors, tip_errors
from rtec.report.machine_state import SIDES, MachineState, effect_words, fed_errors, state_sentence
from rtec.report.machine_state_figures import Camera, longest, names_at, room_of
from rtec.studio.parts import actions, figures
from rtec.studio.parts.chart import Chart
from rtec.studio.parts.controls import Words, heading, label, lacking, number, waiting
from rtec.studio.parts.session import TabSession
from rtec.wording import ERROR_UNITS, significant
from rtec.wording import number as shown

SPEED_RPM, DEGC = 6000.0, 25.0
MAGNIFIED: Final = (0.0, 5.0)
"""Range of the magnification, as powers of ten."""
POSITIONS: Final = {
    (across, up): f"{high} {wide}"
    for up, high in ((-1, "bottom"), (0, "middle"), (1, "top"))
    for across, wide in ((-1, "left"), (0, "center"), (1, "right"))
}
"""Plotly's words for where a name is."""
TINTS: Final[Mapping[Side, str]] = {"tool": "@c2", "work": "@c3"}


def build(session: TabSession) -> None:
    """The page."""
    heading("Explore", session, "explore")
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
        self._others = [c for c in ("spindle_rpm", "load_kg", "force_n") if c in model.channels]
        kept = session.explored
        first = _first(model, self._others)
        if kept is None or kept.model is not model:
            known = {} if kept is None else kept.state
            state = {k: float(known.get(k, v)) for k, v in first.items()}
            kept = (
                MachineState(model, state) if kept is None else replace(kept, model=model, state=state, off=frozenset())
            )
        self._keep(kept)

    def _keep(self, now: MachineState) -> None:
        """Store what is shown; the session keeps it for later visits of the page and for the report."""
        self._now = self._session.explored = now

    def build(self) -> None:
        self._headline = Words("p", "", "lead").props('role="status" aria-live="polite"')
        scene, volume, bars = self._figures()
        with ui.element("div").classes("split"):
            with ui.element("div").style("display: grid; gap: 1rem; min-width: 0"):
                with ui.element("div").classes("card"):
                    Words("h2", "The machine, its error magnified")
                    words = "The machine's links: nominal, and moved by their errors"
                    self._scene = self._room(scene, words, "machine_from")
                with ui.element("div").classes("card"):
                    Words("h2", "Error at the tool tip over the whole travel")
                    Words("p", "Places of the tool tip relative to the workpiece.", "small")
                    words = "Nominal places and where the tool tip is, magnified"
                    self._map = self._room(volume, words, "travel_from")
            with ui.element("div").classes("controls"):
                self._controls()
                with ui.element("div").classes("card"):
                    Words("h2", "Component errors here")
                    self._bars = Chart(bars, "Component errors at this place")
                    self._size_bars()

    def _room(self, figure: dict[str, Any], shows: str, camera: str) -> Chart:
        """A plot in 3D, whose camera is a part of the state."""
        now: Camera = getattr(self._now, camera)
        made = Chart(figure, shows, view={"scene.camera": _plotly(now)} if now != Camera() else None).classes("room")

        def look(event: events.GenericEventArguments) -> None:
            eye, centre, up = ((float(x), float(y), float(z)) for x, y, z in event.args)
            seen: Any = {camera: Camera(eye, centre, up)}
            self._keep(replace(self._now, **seen))

        return made.on("camera", look)

    def _controls(self) -> None:
        machine, model = self._model.machine, self._model
        with ui.element("div").classes("card"):
            Words("h2", "Where, and in what state")
            self._slider("", "magnified, times", *MAGNIFIED, float(np.log10(self._now.magnified)))
            for a in machine.axes:
                self._slider(a.name, f"{a.name}, mm", *a.travel_mm, self._now.state[a.name])
            for a in machine.axes:
                if a.direction_channel in model.channels:
                    with ui.element("div").classes("row"):
                        Words("span", f"{a.name} moved last")
                        signs = {1: "+", -1: "−"}
                        way = int(self._now.state[f"dir_{a.name}"])
                        toggle = ui.toggle(signs, value=way, on_change=partial(self._set, f"dir_{a.name}"))
                        label(toggle.props("no-caps unelevated toggle-color=primary"), f"direction of {a.name}")
            for sensor in (s for s in machine.sensor_names if s in model.channels):
                low, high = model.valid_range.get(sensor, (model.reference_degc - DEGC, model.reference_degc + DEGC))
                self._slider(sensor, f"{sensor}, °C", low, high, self._now.state[sensor])
            for name in self._others:
                low, high = model.valid_range.get(name, (0.0, SPEED_RPM if name == "spindle_rpm" else 1000.0))
                self._slider(name, titled(name), min(low, 0.0), high, self._now.state[name])
        with ui.element("div").classes("card"):
            Words("h2", "Effects")
            for k in range(len(model.effects)):
                words, on = effect_words(model, k), k not in self._now.off
                label(ui.checkbox(words, value=on, on_change=partial(self._toggle, k)), words)

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
                self._put(key, now)
            else:
                self._keep(replace(self._now, magnified=10.0**now))
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
        self._put(key, float(event.value))

    def _put(self, key: str, value: float) -> None:
        self._keep(replace(self._now, state={**self._now.state, key: value}))
        self._redraw()

    def _toggle(self, k: int, event: events.ValueChangeEventArguments[bool | None]) -> None:
        self._keep(replace(self._now, off=self._now.off - {k} if event.value else self._now.off | {k}))
        self._redraw()

    def _size_bars(self) -> None:
        units = [component_unit(c) for c in fed_errors(self._now)]
        self._bars.style(f"height: {figures.bars_px(units)}px")

    def _redraw(self) -> None:
        self._size_bars()
        for chart, figure in zip((self._scene, self._map, self._bars), self._figures(), strict=True):
            chart.show(figure)

    def _figures(self) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Figures of machine, volumetric map and bars; updates the headline."""
        now, machine = self._now, self._model.machine
        self._headline.set_text(state_sentence(now))
        components = component_errors(now.switched, now.state)
        sides = {side: link_places(machine, components, now.pose_mm, side) for side in SIDES}
        fed = fed_errors(now)
        bars = _bars(fed, machine) if fed else {"data": [], "layout": figures.layout()}
        return _scene(machine, sides, now.magnified, now.machine_from), _volume(now), bars


def _first(model: Model, others: Sequence[str]) -> dict[str, float]:
    """The state with which the page begins: the middle of the travels, at the reference temperature."""
    machine = model.machine
    out: dict[str, float] = {a.name: 0.5 * sum(a.travel_mm) for a in machine.axes}
    out |= {f"dir_{a.name}": 1.0 for a in machine.axes}
    for sensor in (s for s in machine.sensor_names if s in model.channels):
        low, high = model.valid_range.get(sensor, (model.reference_degc,) * 2)
        out[sensor] = min(max(model.reference_degc, low), high)
    return out | dict.fromkeys(others, 0.0)


def _bars(fed: Mapping[str, float], machine: Machine) -> dict[str, Any]:
    units = {c: ERROR_UNITS[component_unit(c)] for c in fed}
    words = {c: component_words(c, machine) for c in fed}
    return figures.bars(fed, units, "component error", words)


def _axis3(title: str) -> dict[str, Any]:
    small = {"title": {"text": title, "font": {"size": 13}}, "tickfont": {"size": 11}, "nticks": 6}
    return small | {"gridcolor": "@grid", "color": "@ink", "backgroundcolor": "@paper"}


def _layout3(ranges: Floats) -> dict[str, Any]:
    """Layout of a room, (3, 2), that is the same during motion."""
    size = np.ptp(ranges, axis=1)
    ratio = size / float(size.max())
    scene: dict[str, Any] = {
        f"{axis}axis": _axis3(f"{axis.upper()}, mm") | {"range": ranges[k].tolist()} for k, axis in enumerate("xyz")
    }
    scene |= {"aspectmode": "manual", "aspectratio": dict(zip("xyz", (longest(ranges) * ratio).tolist(), strict=True))}
    scene |= {"uirevision": "kept", "camera": _plotly(Camera())}
    return figures.layout(scene=scene, dragmode="orbit", margin={"l": 0, "r": 0, "t": 40, "b": 0})


def _plotly(camera: Camera) -> dict[str, dict[str, float]]:
    """A camera in Plotly's words."""
    given = {"eye": camera.eye, "center": camera.centre, "up": camera.up}
    return {name: dict(zip("xyz", v, strict=True)) for name, v in given.items()}


def _scene(machine: Machine, sides: Mapping[Side, LinkPlaces], magnified: float, camera: Camera) -> dict[str, Any]:
    data = []
    names = {(n.side, n.index): n for n in names_at(machine, sides, magnified, camera)}
    for side, n in sides.items():
        for moved, tint in ((0.0, "@muted"), (magnified, TINTS[side])):
            at = n.place_mm + 1e-3 * moved * n.moved_um
            name = f"{side} side, with its errors" if moved else "nominal"
            own = [names.get((side, k)) for k in range(len(at))]
            data.append({
                "type": "scatter3d", "mode": "lines+markers+text" if moved else "lines", "name": name,
                "showlegend": bool(moved) or side == "tool",
                "x": figures.numbers(at[:, 0]), "y": figures.numbers(at[:, 1]), "z": figures.numbers(at[:, 2]),
                "text": [figures.text(o.words) if o else "" for o in own],
                "line": {"color": tint, "width": 10 if moved else 4},
                "marker": {"size": 5, "color": tint}, "textfont": {"size": 15, "color": "@ink"}, "hoverinfo": "text",
                "textposition": [POSITIONS[o.beside] if o else "middle right" for o in own],
            })  # fmt: skip
    return {"data": data, "layout": _layout3(room_of(machine, sides, magnified))}


def _volume(now: MachineState) -> dict[str, Any]:
    """Nominal and predicted places of the tool tip relative to the workpiece, joined by lines."""
    found = tip_errors(now.switched, now.state)
    place, size = found.place_mm, found.size_um
    real = place + 1e-3 * now.magnified * found.error_um
    joined = np.stack([place, real, np.full_like(place, np.nan)], axis=1).reshape(-1, 3)
    bar = {"title": {"text": "error, µm"}, "thickness": 14, "tickfont": {"color": "@ink"}}
    bar |= {"orientation": "h", "y": 0.0, "yanchor": "top"}  # beside the plot it would take its width
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
    return {"data": data, "layout": _layout3(room_around(np.concatenate([place, real])))}
