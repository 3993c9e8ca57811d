"""What is known of the machine already: errors that the current model has, and that are exactly as it has them.

These are no secret, so their shapes are the plain ones of the textbook. Each has the table that a model file would
hold and its columns as readings.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator.campaign import Campaign
from tests.discovery.generator.world import World

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """An error that the model has.

    Attributes:
        key: by which a truth says that it takes its place.
        effect: its table: name, component, arguments.
        size: standard deviation of its coefficient.
        shape: its basis, (n,).
    """

    key: str
    effect: Mapping[str, Any]
    size: float
    shape: Callable[[World], Floats]

    def columns(self, world: World) -> Floats:
        """What one unit adds to every column, (columns, n)."""
        return world.readings(self.effect["component"], self.shape(world))


def known(campaign: Campaign) -> tuple[Known, ...]:
    """All of a campaign."""
    make = {
        "laser": _laser,
        "angular": _angular,
        "straightness": _straightness,
        "tool_tip": _tool_tip,
        "drift": _drift,
    }
    return make[campaign.kind](campaign)


def _table(effect: str, component: str, **arguments: Any) -> dict[str, Any]:
    return {"effect": effect, "component": component, **arguments}


def _curve(w: World) -> Floats:
    return w.u**2 - 1.0 / 3.0


def _laser(c: Campaign) -> tuple[Known, ...]:
    a = c.axis
    e = f"E{a}{a}"
    return (
        Known("scale", _table("scale", e, axis=a), 15.0, lambda w: w.q * 1e-3),
        Known("curve", _table("polynomial_position", e, axis=a, degrees=(2,)), 3.0, _curve),
        Known("backlash", _table("backlash", e, axis=a), 4.0, lambda w: 0.5 * w.d),
        Known(
            "expansion",
            _table("axis_expansion", e, axis=a, sensor="T_screw"),
            5.0,
            lambda w: w.q * 1e-3 * w.shown("T_screw"),
        ),
    )


def _angular(c: Campaign) -> tuple[Known, ...]:
    a, e = c.axis, f"E{c.across}{c.axis}"
    return (
        Known("slope", _table("polynomial_position", e, axis=a, degrees=(1,)), 5.0, lambda w: w.u),
        Known("curve", _table("polynomial_position", e, axis=a, degrees=(2,)), 3.0, _curve),
    )


def _straightness(c: Campaign) -> tuple[Known, ...]:
    a, e = c.axis, f"E{c.across}{c.axis}"
    return (
        Known("curve", _table("polynomial_position", e, axis=a, degrees=(2,)), 3.0, _curve),
        Known("mount", _table("mount_expansion", e, sensor="T_head"), 0.5, lambda w: w.shown("T_head")),
    )


def _place(axis: str) -> Callable[[World], Floats]:
    return lambda w: w.campaign.pose_mm[axis] * 1e-3


def _way(axis: str) -> Callable[[World], Floats]:
    return lambda w: 0.5 * w.campaign.direction[axis]


def _tool_tip(_: Campaign) -> tuple[Known, ...]:
    out = []
    for a in "XYZ":
        out.append(Known(f"scale {a}", _table("scale", f"E{a}{a}", axis=a), 15.0, _place(a)))
        out.append(Known(f"backlash {a}", _table("backlash", f"E{a}{a}", axis=a), 3.0, _way(a)))
    growth = _table("spindle_growth", "EZ0spindle", sensor="T_spindle")
    for component in ("EC0X", "EB0X", "EC0Y", "EA0Y", "EA0Z", "EB0Z"):
        out.append(Known(component, _table("squareness", component), 15.0, lambda w: np.ones_like(w.q)))
    return (
        *out,
        Known("growth", growth, 1.0, lambda w: w.shown("T_spindle")),
    )


def _drift(_: Campaign) -> tuple[Known, ...]:
    growth = _table("spindle_growth", "EZ0spindle", sensor="T_spindle")
    radial = _table("mount_expansion", "EX0spindle", sensor="T_head")
    return (
        Known("growth", growth, 1.0, lambda w: w.shown("T_spindle")),
        Known("radial", radial, 0.6, lambda w: w.shown("T_head")),
    )
