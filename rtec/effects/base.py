"""What an effect is: arguments, parameters with units, basis functions of the state; and what readings it needs."""

import itertools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import field_validator

from rtec.arrays import Floats
from rtec.effects.state import Channels, Value
from rtec.errors import ModelError
from rtec.machine import Axis, Machine
from rtec.machine.chain import component_unit
from rtec.tomlfile import Strict, nearest

SIDES = frozenset(
    ["front", "back", "rear", "left", "right", "top", "bottom", "upper", "lower", "inner", "outer", "inside", "outside"]
)
"""Words for the sides of one part in the names of sensors."""


def of_one_part(one: str, other: str) -> bool:
    """Whether two sensors are on one part by their names: `T_col_front` and `T_col_back`, `T_left` and `T_right`."""
    mine, its = ({w for w in re.split(r"[^a-z]+", s.lower()) if len(w) > 1} for s in (one, other))
    return bool(mine & its) or bool(mine & SIDES and its & SIDES)


@dataclass(frozen=True)
class Surroundings:
    """What a set of measurements has for an effect that suggests instances of itself.

    Attributes:
        machine: the machine.
        component: the component error that the effect would feed.
        axis: the axis that has this component error; None for a fixed link.
        sensors: recorded temperatures that vary.
        channels: lowest and highest value of every recorded channel that varies, by name.
        span_s: length of the longest measurement.
        step_s: typical time between readings.
        places_mm: positions of the readings, mm, by position channel.
        still: recorded temperatures that do not vary.
        cut: whether parts were measured that the tool had cut: it wears within hours.
    """

    machine: Machine
    component: str
    axis: Axis | None
    sensors: tuple[str, ...]
    channels: Mapping[str, tuple[float, float]]
    span_s: float
    step_s: float
    places_mm: Mapping[str, Floats] = field(default_factory=dict)
    still: tuple[str, ...] = ()
    cut: bool = False

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Temperatures that may differ: two that vary, or two on one part, by their names, of which one varies."""
        part = ((one, other) for one in self.sensors for other in self.still if of_one_part(one, other))
        return [*itertools.combinations(self.sensors, 2), *part]

    @property
    def moved(self) -> Axis:
        """The component's own axis.

        Raises:
            ModelError: the axis did not move, or the component is of a fixed link.
        """
        if self.axis is None:
            raise ModelError(f"{self.component}: no axis of it moved")
        return self.axis


Kind = Literal["positioning", "straightness", "roll", "tilt", "axis_angle", "axis_shift", "link", "link_angle"]


def component_kind(component: str, machine: Machine) -> Kind:
    """What kind of error a component is.

    Positioning (`EXX`), straightness (`EYX`), roll (`EAX`), tilt (pitch or yaw: `EBX`, `ECX`), constant angle and
    shift of an axis' line (`EC0Y`, `EX0Y`), shift and angle of a fixed link (`EX0spindle`, `EA0spindle`).
    """
    letter, target = component[1], component[2:]
    axis = next((a for a in machine.axes if a.name == target.removeprefix("0")), None)
    if target.startswith("0"):
        if axis is not None:
            return "axis_angle" if letter in "ABC" else "axis_shift"
        return "link_angle" if letter in "ABC" else "link"
    if axis is None:
        return "link"
    if letter in "XYZ":
        return "positioning" if letter == axis.direction else "straightness"
    return "roll" if "ABC".index(letter) == "XYZ".index(axis.direction) else "tilt"


def _moved(around: Surroundings, channel: str, what: str) -> str:
    return "" if channel in around.channels else f"{what} never changes, or was not recorded"


def _of_axis(around: Surroundings, attribute: str, what: str) -> str:
    if around.axis is None:
        return "the axis never moves"
    return _moved(around, str(getattr(around.axis, attribute)), f"{what} of {around.axis.name}")


def _velocity(around: Surroundings) -> str:
    """As `_of_axis`, with the way on where only the feed was recorded: it does not say whether the axis moved."""
    said = _of_axis(around, "velocity_channel", "the velocity")
    if not said or around.axis is None or "feed_mm_min" not in around.channels:
        return said
    name = around.axis.name
    return (
        f"{said}; the feed changes, but does not say whether {name} was read in motion: if it was, write moves_at_feed "
        f"= true under [table] of the measurement's TOML, or add the column v{around.axis.channel}_mm_s"
    )


DRIVES: dict[str, Callable[[Surroundings], str]] = {
    "position": lambda a: _of_axis(a, "channel", "the position"),
    "direction": lambda a: _of_axis(a, "direction_channel", "the direction"),
    "velocity": _velocity,
    "acceleration": lambda a: _of_axis(a, "acceleration_channel", "the acceleration"),
    "since_reversal": lambda a: _of_axis(a, "since_reversal_channel", "the distance since a reversal"),
    "temperature": lambda a: "" if a.sensors else "no temperature varies",
    "two temperatures": lambda a: "" if a.pairs else "fewer than two temperatures vary",
    "spindle_rpm": lambda a: _moved(a, "spindle_rpm", "the spindle speed"),
    "load_kg": lambda a: _moved(a, "load_kg", "the load"),
    "force_n": lambda a: _moved(a, "force_n", "the force"),
    "time_s": lambda a: _moved(a, "time_s", "the time"),
    "other axis": lambda a: "" if other_axes(a) else "no other axis was moved to three places or more",
    "pitch": lambda a: "" if a.axis is not None and a.axis.pitch_mm else "the machine file names no pitch_mm",
}
"""What an effect may need; each gives the reason in words where the readings lack it, else an empty text."""


PLACES, APART = 3, 0.01
"""A curve along an axis takes so many places of it, apart by this share of what it moved."""


def other_axes(around: Surroundings) -> list[Axis]:
    """Axes that moved to three places or more, without the component's own."""
    own = around.axis.name if around.axis is not None else ""
    moved = [a for a in around.machine.axes if a.name != own and a.channel in around.channels]
    return [a for a in moved if a.channel not in around.places_mm or places_of(around.places_mm[a.channel]) >= PLACES]


def places_of(at_mm: Floats) -> int:
    """Number of places among positions."""
    steps = np.diff(np.unique(at_mm))
    return 1 + int((steps > APART * steps.sum()).sum())


__all__ = [
    "About",
    "AxisEffect",
    "Confusion",
    "Effect",
    "Kind",
    "Parameter",
    "Surroundings",
    "check_sensor",
    "component_kind",
    "other_axes",
]


@dataclass(frozen=True)
class Parameter:
    """A parameter of an effect.

    Attributes:
        name: as in model files.
        unit: as in model files and JSON, for example `um_per_m_degc`.
        start: where a search begins (non-linear parameters).
        low, high: bounds of the search.
        typical: usual size, in its unit; decides whether a measurement could have shown the effect.
        grid: values that a search tries first (non-linear parameters); if empty, logarithmically even from low to high.
    """

    name: str
    unit: str
    start: float = 0.0
    low: float = -float("inf")
    high: float = float("inf")
    typical: float = 1.0
    grid: tuple[float, ...] = ()


@dataclass(frozen=True)
class Confusion:
    """Another cause with which an effect may be confounded.

    Attributes:
        effect: its name in the registry; a description where it is no effect.
        why: what the two have in common.
        separate_by: the experiment that separates them.
    """

    effect: str
    why: str
    separate_by: str


@dataclass(frozen=True)
class About:
    """The description of an effect on its page.

    Attributes:
        title: in the field's words.
        equation: as text; `e` is the component error.
        typical: usual size.
        seen_by: instruments that show it, by their names in measurement files.
        source: where the equation comes from.
        confusions: causes with which it may be confounded, each with the experiment that separates them.
        reveal: the measurement that would show it, in words.
    """

    title: str
    equation: str
    typical: str
    seen_by: tuple[str, ...]
    source: str
    confusions: tuple[Confusion, ...] = ()
    reveal: str = ""


class Effect(Strict, ABC):
    """One physical cause that feeds one component error.

    A subclass names its arguments as fields, its coefficients and non-linear parameters, and gives one basis
    function per coefficient in plain numpy arithmetic. The component error is `Σ coefficient · basis`, in µm for
    translations and µrad for rotations. The same arithmetic runs on arrays and is traced into the compiled kernel.
    """

    about: ClassVar[About]
    feeds: ClassVar[tuple[Kind, ...]] = ()
    """Kinds of component errors for which a search suggests the effect."""
    driven_by: ClassVar[tuple[str, ...]] = ()
    """What must vary in the readings for the effect to show; keys of `DRIVES`."""

    effect: str
    component: str

    @abstractmethod
    def coefficients(self, machine: Machine) -> tuple[Parameter, ...]:
        """Linear parameters, in the order of `basis`."""

    def nonlinear(self, machine: Machine) -> tuple[Parameter, ...]:
        """Non-linear parameters of the basis functions; none by default."""
        del machine
        return ()

    @abstractmethod
    def channels(self, machine: Machine) -> tuple[str, ...]:
        """Names of the channels that the effect reads."""

    @abstractmethod
    def basis(self, machine: Machine, channels: Channels, theta: Mapping[str, Value]) -> Sequence[Value]:
        """One value per coefficient: what one unit of it adds to the component error.

        Args:
            machine: whose travel and pitch the effect may use.
            channels: the state, as arrays or as symbols.
            theta: the non-linear parameters by name.
        """

    @classmethod
    def suggest(cls, around: Surroundings) -> Iterator["Effect"]:
        """Instances that a search tries for a component error; none where this effect does not feed such a component.

        By default one for each combination of its sensors, along the component's own axis.
        """
        if component_kind(around.component, around.machine) not in cls.feeds or cls.missing(around):
            return
        for arguments in cls.arguments(around):
            yield cls.model_validate(
                {"effect": cls.model_fields["effect"].default, "component": around.component, **arguments}
            )

    @classmethod
    def arguments(cls, around: Surroundings) -> Iterator[dict[str, Any]]:
        """Arguments of the instances that `suggest` gives."""
        fields = cls.model_fields
        along = {"axis": around.axis.name} if "axis" in fields and around.axis is not None else {}
        if "front" in fields:
            for front, back in around.pairs:
                yield {**along, "front": front, "back": back}
        elif "sensor" in fields:
            for sensor in around.sensors:
                yield {**along, "sensor": sensor}
        else:
            yield along

    @classmethod
    def missing(cls, around: Surroundings) -> str:
        """What did not move or was not recorded, in words, so that the effect could not show; empty where it could."""
        if component_kind(around.component, around.machine) not in cls.feeds:
            return ""
        return next((w for w in (DRIVES[d](around) for d in cls.driven_by) if w), "")

    @property
    def label(self) -> str:
        """Short name for tables: effect, component, and what it depends on."""
        extra = [str(getattr(self, k)) for k in ("axis", "sensor", "front", "back") if getattr(self, k, None)]
        return f"{self.effect}({', '.join([self.component, *extra])})"

    @property
    def unit(self) -> Literal["um", "urad"]:
        """Unit of the component error."""
        return "urad" if component_unit(self.component) == "urad" else "um"

    def check(self, machine: Machine, where: str) -> None:
        """Raise ModelError where an argument names something that this machine does not have."""
        if self.component not in machine.components:
            hint = nearest(self.component, machine.components)
            raise ModelError(f"{where}: component {self.component!r} is none of machine {machine.name!r}{hint}")

    @field_validator("component")
    @classmethod
    def _form(cls, value: str) -> str:
        if len(value) < 3 or value[0] != "E" or value[1] not in "XYZABC":
            raise ValueError(
                "a component is E, then X Y Z A B or C, then the axis (EXX) or 0 and the link (EZ0spindle)"
            )
        return value


class AxisEffect(Effect):
    """An effect along one axis."""

    axis: str

    def the_axis(self, machine: Machine) -> Axis:
        """The axis that `axis` names."""
        return machine.axis(self.axis)

    def channels(self, machine: Machine) -> tuple[str, ...]:
        """The axis' position."""
        return (self.the_axis(machine).channel,)

    def check(self, machine: Machine, where: str) -> None:
        """Check component and axis."""
        super().check(machine, where)
        if self.axis not in machine.axis_names:
            hint = nearest(self.axis, machine.axis_names)
            raise ModelError(f"{where}: axis {self.axis!r} is none of machine {machine.name!r}{hint}")


def check_sensor(machine: Machine, sensor: str, where: str) -> None:
    """Raise ModelError where the machine has no such temperature sensor."""
    if sensor not in machine.sensor_names:
        hint = nearest(sensor, machine.sensor_names)
        raise ModelError(f"{where}: sensor {sensor!r} is none of machine {machine.name!r}{hint}")
