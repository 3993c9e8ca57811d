"""The shape of an effect, its error over its driver: with braille dots for a terminal, as a PNG for a page.

The shape comes from the effect's own basis functions with usual sizes on an example machine, so that a plug-in has one,
too. Curves after the first are dashed, so that they differ without colour.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import ValidationError

from rtec.arrays import Bools, Floats
from rtec.diagnosis.words import spoken
from rtec.effects import Effect, State, all_effects
from rtec.effects.base import Surroundings
from rtec.effects.registry import instances
from rtec.errors import ConfigError, ModelError
from rtec.machine import Axis, Link, Machine, Sensor
from rtec.report.figures import GREY, LINES, OFF, ON, as_png, stacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure


POINTS = 481
REFERENCE_DEGC = 20.0
SENSORS = ("T_front", "T_back", "T_spindle", "T_air", "T_coolant")
TRAVEL_MM = (0.0, 400.0)
FIRST = ("EXX", "EYX", "EBX", "EAX", "EYZ", "EC0Y", "EA0Z", "EZ0spindle", "EB0spindle")
"""Components in the order in which the example of an effect is looked for."""


@dataclass(frozen=True)
class EffectCurve:
    """One curve: the held channels in words ("" for none), and the error, (n,)."""

    held: str
    error: Floats


@dataclass(frozen=True)
class EffectShape:
    """Curves of an effect.

    Attributes:
        component: component error of the example.
        unit: unit of the error, "µm" or "µrad".
        over: variable of the horizontal axis, with its unit.
        x: its values, (n,).
        curves: one or more curves.
        sizes: the parameters of the example, in words.
    """

    component: str
    unit: str
    over: str
    x: Floats
    curves: tuple[EffectCurve, ...]
    sizes: str


def example_machine() -> Machine:
    """A three-axis machine with a spindle and five sensors, for pictures only."""
    axes = tuple(Axis(n, n, TRAVEL_MM, 1000.0, pitch_mm=10.0) for n in ("X", "Y", "Z"))
    links = {n: Link(n) for n in ("spindle", "tool", "workpiece")}
    return Machine(
        "example", ("Z", "spindle", "tool"), ("Y", "X", "workpiece"), axes, links, tuple(Sensor(s) for s in SENSORS)
    )


def shape_of(kind: type[Effect]) -> EffectShape | None:
    """The shape of an effect; None where it has none, as the user's expression."""
    machine = example_machine()
    effect = example_of(kind, machine)
    if effect is None:
        return None
    theta = {p.name: p.start for p in effect.nonlinear(machine)}
    view = _view(effect, machine, theta)
    curves = tuple(
        EffectCurve(held, _error(effect, machine, theta, view.x, channels)) for held, channels in view.curves
    )
    if not all(np.isfinite(c.error).all() for c in curves):
        return None
    unit = "µrad" if effect.unit == "urad" else "µm"
    return EffectShape(effect.component, unit, view.over, view.x, curves, _sizes(effect, machine))


def example_of(kind: type[Effect], machine: Machine) -> Effect | None:
    """An instance on the example machine; None where its arguments have no usual values, as an expression."""
    return next(_instances(kind, machine), None)


def _instances(kind: type[Effect], machine: Machine) -> Iterator[Effect]:
    """Instances that the effect suggests if everything varies; then those with the simplest arguments."""
    everything = dict.fromkeys(machine.channel_names, TRAVEL_MM)
    for component in (*FIRST, *machine.components):
        axis = next((a for a in machine.axes if component[2:] == a.name), None)
        around = Surroundings(machine, component, axis, SENSORS, everything, 5 * 86400.0, 10.0)
        yield from (e for e in instances(kind, around) if _stands(e, machine))
    given = {"effect": kind.model_fields["effect"].default, "component": "EXX", "axis": "X"}
    given |= {"other": "Z", "sensor": SENSORS[0], "front": SENSORS[0], "back": SENSORS[1]}
    try:
        effect = kind.model_validate({k: v for k, v in given.items() if k in kind.model_fields})
    except (ValidationError, ModelError):
        return
    if _stands(effect, machine):
        yield effect


def _stands(effect: Effect, machine: Machine) -> bool:
    try:
        effect.check(machine, "shape")
    except ModelError:
        return False
    return True


@dataclass(frozen=True)
class _View:
    """Variable of the horizontal axis, and for each curve the held channels in words, and all channels, (n,)."""

    over: str
    x: Floats
    curves: tuple[tuple[str, Mapping[str, Floats]], ...]


def _view(effect: Effect, machine: Machine, theta: Mapping[str, float]) -> _View:
    """The view of an effect: over its fastest driver, with the next one held at two or three values."""
    names = effect.channels(machine)
    if "tau" in theta and not set(names) & set(machine.moving_channels) - {a.channel for a in machine.axes}:
        return _over_time(names, machine, 4.0 * theta["tau"] / 3600.0)
    own = next((a for a in machine.axes if set(names) & set(a.moving_channels)), machine.axes[0])
    if "time_s" in names:
        hours = 48.0 if not theta else 2.0 * theta.get("t0", 14400.0) / 3600.0
        return _View("time, hours", np.linspace(0.0, hours, POINTS), _both_ways(own, names) or (("", {}),))
    for over, x, channel in _runs(own, names, theta, effect):
        held = _held(own, names, machine, channel)
        return _View(over, x, tuple((words, {**_still(names, machine), **more, channel: x}) for words, more in held))
    x = np.linspace(*TRAVEL_MM, POINTS)
    return _View(f"position of {own.name}, mm", x, _both_ways(own, names) or (("", {}),))


def _runs(
    own: Axis, names: tuple[str, ...], theta: Mapping[str, float], effect: Effect
) -> Iterator[tuple[str, Floats, str]]:
    """Possible variables of the horizontal axis, best first: words, values, channel."""
    wave = theta.get("pitch") or theta.get("period") or getattr(effect, "lambda_mm", None)
    far = 3.0 * wave if wave else TRAVEL_MM[1]
    v_s = theta.get("v_s")
    speed = np.linspace(0.0, 5.0 * v_s, POINTS) if v_s else np.linspace(-200.0, 200.0, POINTS)
    temperatures = [n for n in names if n in SENSORS]
    degc = REFERENCE_DEGC + np.linspace(-5.0, 15.0, POINTS)
    what = "temperature above the reference, K" if len(temperatures) < 2 else "temperature difference, K"
    for over, x, channel in (
        (f"distance since {own.name} turned round, mm", 5.0 * theta.get("s0", 2.0) * np.linspace(0, 1, POINTS),
         own.since_reversal_channel),
        (f"velocity of {own.name}, mm/s", speed, own.velocity_channel),
        (f"acceleration of {own.name}, mm/s²", np.linspace(-5000.0, 5000.0, POINTS), own.acceleration_channel),
        (f"position of {own.name}, mm", np.linspace(0.0, far, POINTS), own.channel),
        ("spindle speed, 1/min", np.linspace(0.0, 6000.0, POINTS), "spindle_rpm"),
        ("load, kg", np.linspace(0.0, 500.0, POINTS), "load_kg"),
        ("force, N", np.linspace(-1000.0, 1000.0, POINTS), "force_n"),
        *((what, degc, t) for t in temperatures[:1]),
    ):  # fmt: skip
        if channel in names:
            yield over, x, channel


def _held(own: Axis, names: tuple[str, ...], machine: Machine, running: str) -> list[tuple[str, Mapping[str, Floats]]]:
    """Curves: the effect's other driver, held at a few values."""
    temperatures = [n for n in names if n in SENSORS and n != running]
    other = next((a for a in machine.axes if a is not own and a.channel in names), None)
    if own.direction_channel in names:
        return list(_both_ways(own, names))
    if other is not None:
        return [(f"{other.name} at {at:g} mm", {other.channel: _full(at)}) for at in (0.0, 100.0, 200.0)]
    fast = next((a for a in machine.axes if a is not own and a.velocity_channel in names), None)
    if fast is not None:
        return [(f"{fast.name} at {v:g} mm/s", {fast.velocity_channel: _full(v)}) for v in (50.0, 100.0, 150.0)]
    if temperatures and running not in SENSORS:
        word = "K warmer" if len(temperatures) == 1 else "K between the two"
        return [(f"{k:g} {word}", {temperatures[0]: _full(REFERENCE_DEGC + k)}) for k in (5.0, 10.0)]
    if "load_kg" in names and running != "load_kg":
        return [(f"{kg:g} kg", {"load_kg": _full(kg)}) for kg in (250.0, 500.0)]
    return [("", {})]


def _both_ways(own: Axis, names: tuple[str, ...]) -> tuple[tuple[str, Mapping[str, Floats]], ...]:
    if own.direction_channel not in names:
        return ()
    warm = {n: _full(REFERENCE_DEGC + 10.0) for n in names if n in SENSORS}
    loaded = {"load_kg": _full(250.0)} if "load_kg" in names else {}
    return tuple(
        (f"moving {sign}", {own.direction_channel: _full(d), **warm, **loaded}) for sign, d in (("+", 1.0), ("-", -1.0))
    )


def _over_time(names: tuple[str, ...], machine: Machine, hours: float) -> _View:
    """A view over time: the driver is on from a tenth of the time to the half, so that a lag shows."""
    x = np.linspace(0.0, 2.0 * hours, POINTS)
    on = np.where((x > 0.1 * x[-1]) & (x < 0.55 * x[-1]), 1.0, 0.0)
    channels = {**_still(names, machine), "spindle_rpm": 3000.0 * on}
    channels |= {n: REFERENCE_DEGC + 10.0 * on for n in names if n in SENSORS}
    channels |= {a.channel: _full(TRAVEL_MM[1]) for a in machine.axes}
    on_off = "10 K warmer" if any(n in SENSORS for n in names) else "3000 1/min"
    return _View("time, hours", x, ((f"{on_off} from {x[-1] * 0.1:.1f} to {x[-1] * 0.55:.1f} h", channels),))


def _still(names: tuple[str, ...], machine: Machine) -> dict[str, Floats]:
    """Every channel that the effect reads, at rest."""
    return {n: _full(REFERENCE_DEGC if n in machine.sensor_names else 0.0) for n in names if n != "time_s"}


def _full(value: float) -> Floats:
    return np.full(POINTS, value)


def _factors(n: int) -> Floats:
    """Sizes of several coefficients relative to the usual one: similar but different, so that no two cancel."""
    return np.asarray(np.cos(2.4 * np.arange(n)))


def _error(
    effect: Effect, machine: Machine, theta: Mapping[str, float], x: Floats, channels: Mapping[str, Floats]
) -> Floats:
    hours = x * 3600.0
    state = State(machine, hours, dict(channels), REFERENCE_DEGC)
    usual = np.array([p.typical for p in effect.coefficients(machine)])
    basis = effect.basis(machine, state, theta)
    sizes = usual * _factors(len(usual))
    out: Floats = np.zeros(POINTS)
    for size, value in zip(sizes, basis, strict=True):
        out += float(size) * np.asarray(value)
    return out


def _sizes(effect: Effect, machine: Machine) -> str:
    coefficients = effect.coefficients(machine)
    parts = [f"{p.name} = {p.start:g} {spoken(p.unit)}".rstrip() for p in effect.nonlinear(machine)]
    if len(coefficients) == 1:
        parts.insert(0, f"{coefficients[0].name} = {coefficients[0].typical:g} {spoken(coefficients[0].unit)}")
    elif coefficients:
        parts.insert(0, f"{', '.join(p.name for p in coefficients)} of the usual size")
    return ", ".join(parts)


DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of a braille character's dots, by row and column."""
BLANK = 0x2800
DASHES = ((1, 0), (4, 3), (1, 2))
"""Dot columns on and off of each curve's line, in order."""
SAMPLES = ("⠤⠤⠤⠤", "⠤⠤⠀⠤", "⠄⠄⠄⠄")
PLOT_LINES = ("-", "--", ":")


def sketch(shape: EffectShape, columns: int = 60, rows: int = 10) -> list[str]:
    """Lines of a drawing for the terminal.

    Args:
        shape: what to draw.
        columns, rows: size of the drawing in characters, without the scale beside it.
    """
    low, high = _ends(shape)
    dots = np.zeros((4 * rows, 2 * columns), dtype=bool)
    for curve, (on, off) in zip(shape.curves, DASHES, strict=False):
        _draw(dots, curve, low, high, on, off)
    marks = {0: f"{high:g}", rows - 1: f"{low:g}"}
    if low < 0.0 < high:
        marks.setdefault(_row(0.0, low, high, 4 * rows) // 4, "0")
    wide = max(len(m) for m in marks.values())
    body = [f"{marks.get(i, ''):>{wide}} ┤{line}" for i, line in enumerate(_characters(dots))]
    ends = f"{_short(shape.x[0])}{shape.over:^{max(columns - len(_short(shape.x[0])) - len(_short(shape.x[-1])), 0)}}"
    below = " " * (wide + 1) + "└" + "─" * columns
    return [
        f"{' ' * (wide + 1)}{shape.component}, {shape.unit}",
        *body,
        below,
        f"{' ' * (wide + 2)}{ends}{_short(shape.x[-1])}",
        *(f"{' ' * (wide + 2)}{line}" for line in _legend(shape.curves)),
    ]


@as_png
def figure(title: str, equation: str, shape: EffectShape) -> "MplFigure":
    """The shape as a PNG.

    Args:
        title: the effect in words.
        equation: equation as text.
        shape: what to draw.
    """
    canvas, (ax,) = stacked(5.0)
    _plot(ax, shape)
    ax.set_title(title, pad=52)
    below = f"{equation}\ndrawn with {shape.sizes}"
    ax.text(0.0, 1.03, below, transform=ax.transAxes, fontsize=14, color=GREY, va="bottom", linespacing=1.4)
    ax.set_xlabel(shape.over)
    ax.set_ylabel(f"error {shape.component}, {shape.unit}")
    return canvas


def sketch_of(name: str) -> list[str]:
    """The drawing for the terminal of an effect by its name; empty where it has no shape."""
    kind = all_effects().get(name)
    shape = shape_of(kind) if kind is not None else None
    if shape is None:
        return []
    return [f"Its shape, drawn with {shape.sizes}:", "", *sketch(shape)]


def write_figure(name: str, path: Path) -> None:
    """Write the picture of an effect as a PNG.

    Raises:
        ConfigError: the effect has no shape, or the file cannot be written.
    """
    kind = all_effects().get(name)
    shape = shape_of(kind) if kind is not None else None
    if kind is None or shape is None:
        raise ConfigError(f"effect {name!r} has no shape of its own to draw")
    try:
        path.write_bytes(figure(kind.about.title, kind.about.equation, shape))
    except OSError as e:
        raise ConfigError(f"{path}: cannot be written: {e.strerror}") from e


def _plot(ax: "Axes", shape: EffectShape) -> None:
    for curve, colour, line in zip(shape.curves, (ON, OFF, LINES[3]), PLOT_LINES, strict=False):
        ax.plot(shape.x, curve.error, color=colour, linestyle=line, label=curve.held)
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_xlim(float(shape.x[0]), float(shape.x[-1]))
    low, high = _ends(shape)
    ax.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low))
    if any(c.held for c in shape.curves):
        ax.legend(frameon=True, facecolor="white", framealpha=0.9, edgecolor="none", loc="best")


def _ends(shape: EffectShape) -> tuple[float, float]:
    """Ends of the scale, with two digits: include every value and zero; different even where all values are zero."""
    low = min(0.0, *(float(c.error.min()) for c in shape.curves))
    high = max(0.0, *(float(c.error.max()) for c in shape.curves))
    size = max(high - low, 1e-12)
    step = 10.0 ** np.floor(np.log10(size)) / 10.0
    low, high = float(np.floor(low / step + 1e-9) * step), float(np.ceil(high / step - 1e-9) * step)
    return (round(low, 12), round(high, 12)) if high > low else (-1.0, 1.0)


def _row(value: float, low: float, high: float, rows: int) -> int:
    return round((high - value) / (high - low) * (rows - 1))


def _draw(dots: Bools, curve: EffectCurve, low: float, high: float, on: int, off: int) -> None:
    """Set the dots of a curve; vertical lines join steps."""
    rows, columns = dots.shape
    place = np.linspace(0.0, len(curve.error) - 1.0, columns)
    values = np.interp(place, np.arange(len(curve.error)), curve.error)
    before = None
    for column, value in enumerate(values):
        row = _row(float(value), low, high, rows)
        first, last = (row, row) if before is None else sorted((before + (row > before) - (row < before), row))
        if column % (on + off) < on:
            dots[first : last + 1, column] = True
        before = row


def _characters(dots: Bools) -> list[str]:
    rows, columns = dots.shape[0] // 4, dots.shape[1] // 2
    codes = np.full((rows, columns), BLANK)
    for i, bits in enumerate(DOTS):
        for k, bit in enumerate(bits):
            codes += bit * dots[i::4, k::2]
    return ["".join(map(chr, line)) for line in codes]


def _legend(curves: Sequence[EffectCurve]) -> list[str]:
    named = [(s, c.held) for s, c in zip(SAMPLES, curves, strict=False) if c.held]
    if len(named) == 1:
        return [named[0][1]]
    return ["   ".join(f"{s} {held}" for s, held in named)] if named else []


def _short(value: float) -> str:
    return f"{float(value):.4g}"
