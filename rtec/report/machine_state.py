"""Report of a model in one state: where the tool tip is, which errors make it, and what a part would measure."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rtec.diagnosis.words import titled
from rtec.errors import RtecError
from rtec.machine.chain import component_unit
from rtec.machine.links import Side, component_words, link_places
from rtec.model import Model
from rtec.model.volume import component_errors, cylinder, tip_errors
from rtec.report.machine_state_figures import Camera
from rtec.report.page import Figure, Section, Table
from rtec.wording import ERROR_UNITS, number, significant

SIDES: tuple[Side, ...] = ("tool", "work")


@dataclass(frozen=True)
class MachineState:
    """A model in one state.

    Attributes:
        model: the model, with all of its effects.
        state: positions by axis, mm; `dir_X`; temperatures, °C; spindle speed: names as for `Model.predict`.
        off: indices of the effects that are switched off.
        magnified: factor by which errors are drawn larger.
        machine_from, travel_from: cameras of the figures of the machine, and of the error over its travel.
    """

    model: Model
    state: Mapping[str, float]
    off: frozenset[int] = field(default_factory=frozenset)
    magnified: float = 1e4
    machine_from: Camera = field(default_factory=Camera)
    travel_from: Camera = field(default_factory=Camera)

    @property
    def switched(self) -> Model:
        """The model without the effects that are switched off."""
        return replace(self.model, effects=tuple(f for k, f in enumerate(self.model.effects) if k not in self.off))

    @property
    def pose_mm(self) -> dict[str, float]:
        """Position by axis."""
        return {a.name: self.state[a.name] for a in self.model.machine.axes}


def state_sentence(s: MachineState) -> str:
    """The error at the tool tip, and the errors of a cylinder of 200 mm, in words."""
    model = s.switched
    error = model.predict(dict(s.state))
    tip = ", ".join(f"{axis} {number(float(e), 2, sign=True)}" for axis, e in zip("XYZ", error, strict=True))
    return f"Here the tool tip is off by {tip} µm. {_part_sentence(model, s.state)}"


def _part_sentence(model: Model, state: Mapping[str, float]) -> str:
    try:
        c = cylinder(model, state)
    except RtecError as e:
        return f"{str(e)[0].upper()}{str(e)[1:]}."
    size = number(200.0 + 1e-3 * c.larger_um, 4)
    if c.turned:
        return (
            f"A turned cylinder of 200 mm would measure {size} mm; over {c.length_mm:.0f} mm of length its diameter "
            f"changes by {number(c.form_um, 1)} µm."
        )
    return f"A milled cylinder of 200 mm would measure {size} mm and be {number(c.form_um, 1)} µm out of round."


def fed_errors(s: MachineState) -> dict[str, float]:
    """Component errors that the effects feed, µm or µrad, by name, largest first."""
    model = s.switched
    values = component_errors(model, s.state)
    return dict(sorted(((c, values[c]) for c in model.fed), key=lambda kv: -abs(kv[1])))


def effect_words(model: Model, k: int) -> str:
    """An effect of a model in words, with its short name."""
    f = model.effects[k]
    return f"{type(f.effect).about.title}: {f.label}"


def machine_state_sections(s: MachineState, figures: bool = True) -> list[Section]:
    """Sections on a model in one state: the state, its effects, the machine, its errors, and those over the travels.

    Args:
        s: the state.
        figures: whether to draw.
    """
    machine, errors = s.model.machine, fed_errors(s)
    rows = [(c, component_words(c, machine), f"{number(v, 2, sign=True)} {ERROR_UNITS[component_unit(c)]}")
            for c, v in errors.items()]  # fmt: skip
    shown = [(effect_words(s.model, k), "off" if k in s.off else "on") for k in range(len(s.model.effects))]
    times = f"Errors are drawn {significant(s.magnified, 2)} times as large as they are."
    out = [
        Section("The state of the machine", [], Table(("", "value"), _state_rows(s))),
        Section("Effects of the model", [], Table(("effect", ""), shown, words=(0, 1))),
    ]
    drawn = _figures(s, errors) if figures else (None, None, None)
    if errors:
        table = Table(("component error", "what it is", "here"), rows, words=(0, 1))
        out.append(Section("Component errors in this state", [], table, drawn[2]))
    if figures:
        out += [
            Section("The machine, its error magnified", [times], None, drawn[0]),
            Section("Error at the tool tip over the whole travel", [times], None, drawn[1]),
        ]
    return out


def _state_rows(s: MachineState) -> list[tuple[str, str]]:
    axes = {a.name: a for a in s.model.machine.axes}
    rows = []
    for name, value in s.state.items():
        if name in axes:
            rows.append((f"{name}, mm", number(value, 1)))
        elif name.startswith("dir_"):
            if axes[name.removeprefix("dir_")].direction_channel in s.model.channels:
                rows.append((f"{name.removeprefix('dir_')} moved last", "+" if value > 0.0 else "−"))
        else:
            rows.append((titled(name, "degC" if name in s.model.machine.sensor_names else ""), number(value, 1)))
    return rows


def _figures(s: MachineState, errors: Mapping[str, float]) -> tuple[Figure, Figure, Figure | None]:
    from rtec.report import machine_state_figures as drawn

    machine, components = s.model.machine, component_errors(s.switched, s.state)
    sides = {side: link_places(machine, components, s.pose_mm, side) for side in SIDES}
    chain = drawn.links(machine, sides, s.magnified, s.machine_from)
    over = drawn.volume(tip_errors(s.switched, s.state), s.magnified, s.travel_from)
    bars = None
    if errors:
        names = {c: f"{c}\n{component_words(c, machine)}" for c in errors}
        made = drawn.bars([(names[c], v, ERROR_UNITS[component_unit(c)]) for c, v in errors.items()])
        bars = Figure("components.png", made, "component errors as bars")
    return (
        Figure("machine.png", chain, "the machine's links, nominal and moved by their errors"),
        Figure(
            "volume.png", over, "places of the tool tip relative to the workpiece over the travels, nominal and actual"
        ),
        bars,
    )
