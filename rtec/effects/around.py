"""What a set of measurements offers to an effect that looks for its arguments, and what it lacks."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from rtec.errors import ModelError
from rtec.machine import Axis, Machine


@dataclass(frozen=True)
class Surroundings:
    """What a set of measurements offers to an effect that looks for its arguments.

    Attributes:
        machine: the machine.
        component: the component error that the effect would feed.
        axis: axis whose motion it is; None for a fixed link.
        sensors: temperatures that were recorded and vary.
        channels: every channel that was recorded and varies, by name, with its lowest and highest value.
        span_s: length of the longest measurement.
        step_s: time between readings, typically.
        moves_mm: by position channel, how far an axis that moves goes from one reading to the next, typically.
    """

    machine: Machine
    component: str
    axis: Axis | None
    sensors: tuple[str, ...]
    channels: Mapping[str, tuple[float, float]]
    span_s: float
    step_s: float
    moves_mm: Mapping[str, float] = field(default_factory=dict)

    @property
    def moved(self) -> Axis:
        """The component's own axis.

        Raises:
            ModelError: it did not move, or the component is of a fixed link.
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


DRIVES: dict[str, Callable[[Surroundings], str]] = {
    "position": lambda a: _of_axis(a, "channel", "the position"),
    "direction": lambda a: _of_axis(a, "direction_channel", "the direction"),
    "velocity": lambda a: _of_axis(a, "velocity_channel", "the velocity"),
    "acceleration": lambda a: _of_axis(a, "acceleration_channel", "the acceleration"),
    "since_reversal": lambda a: _of_axis(a, "since_reversal_channel", "the distance since a reversal"),
    "temperature": lambda a: "" if a.sensors else "no temperature varies",
    "two temperatures": lambda a: "" if len(a.sensors) > 1 else "fewer than two temperatures vary",
    "spindle_rpm": lambda a: _moved(a, "spindle_rpm", "the spindle speed"),
    "load_kg": lambda a: _moved(a, "load_kg", "the load"),
    "force_n": lambda a: _moved(a, "force_n", "the force"),
    "time_s": lambda a: _moved(a, "time_s", "the time"),
    "other axis": lambda a: "" if other_axes(a) else "no other axis was moved to three places or more",
    "pitch": lambda a: "" if a.axis is not None and a.axis.pitch_mm else "the machine file names no pitch_mm",
}
"""What an effect may need, and the reason in words where the readings do not have it."""


def other_axes(around: Surroundings) -> list[Axis]:
    """Axes beside the component's own that were moved."""
    own = around.axis.name if around.axis is not None else ""
    return [a for a in around.machine.axes if a.name != own and a.channel in around.channels]
