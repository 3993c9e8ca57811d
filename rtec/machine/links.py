"""Where the links of a machine are, nominally and with their errors: the chain as it is drawn.

Symbols as in `rtec.machine.chain`: `δ` µm, `ε` µrad. An axis' errors are of the tool relative to the workpiece: they
move a slide on the work side by their negative.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtec.arrays import Floats
from rtec.machine.chain import MM_URAD_TO_UM, UNITS
from rtec.machine.machine import Machine

Side = Literal["tool", "work"]


@dataclass(frozen=True)
class LinkPlaces:
    """The links of one side, from the base on.

    Attributes:
        names: names of the links, "base" first.
        place_mm: nominal origins in machine coordinates, (n, 3).
        moved_um: displacement by the errors, (n, 3).
    """

    names: tuple[str, ...]
    place_mm: Floats
    moved_um: Floats


def link_places(
    machine: Machine, components: Mapping[str, float], pose_mm: Mapping[str, float], side: Side
) -> LinkPlaces:
    """The links of one side of a machine at one pose.

    Args:
        machine: the machine.
        components: component errors, µm or µrad, by name; missing ones are zero.
        pose_mm: position by axis.
        side: of the tool or of the workpiece.
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
    return LinkPlaces(("base", *names), place, moved)


def component_words(component: str, machine: Machine) -> str:
    """A component error in words, as in ISO 230-1: `EXX` is "positioning of X", `EBX` "tilt of X about Y".

    Args:
        component: its name.
        machine: the machine; its axes' directions tell roll from tilt, and positioning from straightness.
    """
    letter, target = component[1], component[2:]
    along = "XYZ"["ABC".index(letter)] if letter in "ABC" else letter
    of = target.removeprefix("0")
    axis = next((a for a in machine.axes if a.name == of), None)
    if axis is None or (target != of and letter in "XYZ"):
        return f"{'tilt' if letter in 'ABC' else 'shift'} of {of} {'about' if letter in 'ABC' else 'along'} {along}"
    if target != of:
        return f"line of travel of {of} turned about {along}"
    if letter in "XYZ":
        return f"positioning of {of}" if along == axis.direction else f"straightness of {of} along {along}"
    return f"roll of {of}" if along == axis.direction else f"tilt of {of} about {along}"


BOTH: tuple[Side, Side] = ("tool", "work")
THIN, ROOM = 0.3, 0.58
"""Smallest extent of the room as a share of its largest; half of its width over that of the machine."""


def tool_at_work(machine: Machine, positions_mm: Floats) -> Floats:
    """Nominal places of the tool tip relative to the workpiece, mm, (n, 3).

    Args:
        machine: the machine.
        positions_mm: positions of its axes, (n, axes).
    """

    def place(position: Floats) -> Floats:
        pose = dict(zip((a.name for a in machine.axes), position.tolist(), strict=True))
        tool, work = (link_places(machine, {}, pose, side).place_mm[-1] for side in BOTH)
        return np.asarray(tool - work)

    n = len(machine.axes)
    zero = place(np.zeros(n))  # each axis moves along a straight line
    steps = np.array([place(unit) - zero for unit in np.eye(n)]).reshape(n, 3)
    return np.asarray(zero + positions_mm @ steps)


def room_mm(machine: Machine) -> Floats:
    """Lowest and highest coordinate, (3, 2), of a room in which the machine moves: the same at every pose."""
    ends = [{a.name: a.travel_mm[end] for a in machine.axes} for end in (0, 1)]
    places = np.concatenate([link_places(machine, {}, pose, side).place_mm for pose in ends for side in BOTH])
    return room_around(places)


def room_around(place_mm: Floats) -> Floats:
    """Lowest and highest coordinate, (3, 2), of a room with space around some places, (n, 3)."""
    low, high = place_mm.min(axis=0), place_mm.max(axis=0)
    size = np.maximum(high - low, THIN * float((high - low).max()))
    middle = 0.5 * (low + high)
    return np.stack([middle - ROOM * size, middle + ROOM * size], axis=1)
