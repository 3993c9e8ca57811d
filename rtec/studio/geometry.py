"""Geometry of the page Explore: place and displacement of every link of the chain, and the errors of a part.

Symbols as in `rtec.machine.chain`: `δ` µm, `ε` µrad. An axis' errors are of the tool relative to the workpiece: they
move a slide on the work side by their negative.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import RtecError
from rtec.machine import Machine
from rtec.machine.chain import MM_URAD_TO_UM, UNITS
from rtec.model import Model

Floats = NDArray[np.float64]
RADIUS_MM, LENGTH_MM = 100.0, 200.0
AROUND, ALONG = 360, 21


@dataclass(frozen=True)
class ChainNodes:
    """The links of one side, from the base on.

    Attributes:
        names: names of the links, "base" first.
        place_mm: nominal origins, (n, 3).
        moved_um: displacement by the errors, (n, 3).
    """

    names: tuple[str, ...]
    place_mm: Floats
    moved_um: Floats


@dataclass(frozen=True)
class Cylinder:
    """Errors of a cylinder of 200 mm.

    Attributes:
        larger_um: mean diameter minus 200 mm.
        form_um: roundness of a milled cylinder; change of the diameter along the length of a turned one.
        turned: whether it is turned.
        length_mm: length of a turned cylinder; 0 for a milled one.
    """

    larger_um: float
    form_um: float
    turned: bool
    length_mm: float = 0.0


def nodes(machine: Machine, components: Mapping[str, float], pose_mm: Mapping[str, float], side: str) -> ChainNodes:
    """The links of one side of a machine.

    Args:
        machine: the machine.
        components: µm or µrad by name; missing ones are zero.
        pose_mm: position by axis.
        side: "tool" or "work".
    """
    axes = {a.name: a for a in machine.axes}
    names, work = (machine.work_chain, True) if side == "work" else (machine.tool_chain, False)
    here, origins = np.zeros(3), [np.zeros(3)]
    for name in names:
        here = here + np.asarray((axes.get(name) or machine.links[name]).offset_mm)
        if name in axes:
            here = here + (-1.0 if work else 1.0) * pose_mm[name] * UNITS[axes[name].direction]
        origins.append(here)
    place = np.array(origins)
    moved = np.zeros_like(place)
    for k, name in enumerate(names, start=1):
        tag, sign = (name, -1.0 if work else 1.0) if name in axes else (f"0{name}", 1.0)
        shift, turn = (np.array([components.get(f"E{c}{tag}", 0.0) for c in letters]) for letters in ("XYZ", "ABC"))
        moved[k:] += sign * (shift + MM_URAD_TO_UM * np.cross(turn, place[k:] - place[k]))
        if name in axes:
            square = np.array([components.get(f"E{c}0{name}", 0.0) for c in "ABC"])
            moved[k:] += sign * MM_URAD_TO_UM * np.cross(square, pose_mm[name] * UNITS[axes[name].direction])
    return ChainNodes(("base", *names), place, moved)


def cylinder(model: Model, state: Mapping[str, float]) -> Cylinder:
    """Errors of a cylinder of 200 mm that this machine cuts uncorrected.

    Turned, where the spindle carries the workpiece: the axis across the spindle is at a radius of 100 mm, and the tool
    moves negative along the other over at most 200 mm. Milled otherwise: once around a circle of 100 mm about the
    middle of the travels of X and Y (or the first two axes), counter-clockwise.

    Args:
        model: model of the machine.
        state: temperatures, spindle speed, positions of the other axes; names as for `Model.predict`.

    Raises:
        RtecError: the cylinder does not fit into the travels.
    """
    machine = model.machine
    return _turned(model, state) if any("spindle" in n for n in machine.work_chain) else _milled(model, state)


def _turned(model: Model, state: Mapping[str, float]) -> Cylinder:
    across = next((a for a in model.machine.axes if a.direction == "X"), None)
    along = next((a for a in model.machine.axes if a.direction == "Z"), None)
    if across is None or along is None or not across.travel_mm[0] <= RADIUS_MM <= across.travel_mm[1]:
        raise RtecError("a radius of 100 mm is outside the travel of this machine")
    low, high = along.travel_mm
    start = min(max(state.get(along.name, low) + 0.5 * LENGTH_MM, low + LENGTH_MM), high)
    places = np.linspace(start, max(start - LENGTH_MM, low), ALONG)
    n = np.ones(ALONG)
    at = {k: v * n for k, v in state.items() if k not in (across.name, along.name)}
    at |= {across.name: RADIUS_MM * n, along.name: places, f"dir_{along.name}": -n}
    diameter = 2.0 * model.predict(at)[:, "XYZ".index(across.direction)]
    return Cylinder(float(diameter.mean()), float(np.ptp(diameter)), True, float(np.ptp(places)))


def _milled(model: Model, state: Mapping[str, float]) -> Cylinder:
    if len(model.machine.axes) < 2:
        raise RtecError("a cylinder needs two axes")
    first, second = sorted(model.machine.axes, key=lambda a: a.direction)[:2]
    for axis in (first, second):
        if axis.travel_mm[1] - axis.travel_mm[0] < 2.0 * RADIUS_MM:
            raise RtecError(f"a cylinder of 200 mm is larger than the travel of {axis.name}")
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    middle = [0.5 * (a.travel_mm[0] + a.travel_mm[1]) for a in (first, second)]
    at = {k: np.full(AROUND, v) for k, v in state.items() if k not in (first.name, second.name)}
    at |= {first.name: middle[0] + RADIUS_MM * cos, second.name: middle[1] + RADIUS_MM * sin}
    at |= {f"dir_{first.name}": np.where(sin > 0.0, -1.0, 1.0), f"dir_{second.name}": np.where(cos >= 0.0, 1.0, -1.0)}
    error = model.predict(at)
    outward = error[:, "XYZ".index(first.direction)] * cos + error[:, "XYZ".index(second.direction)] * sin
    # The position of the circle is no error of its form.
    fit = np.stack([np.ones(AROUND), cos, sin], axis=1)
    values = np.linalg.lstsq(fit, outward, rcond=None)[0]
    return Cylinder(2.0 * float(values[0]), float(np.ptp(outward - fit @ values)), False)
