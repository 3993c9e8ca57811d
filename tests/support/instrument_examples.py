"""Instruments as they stand on machines, and where their optics and probes really are.

`read` works out a reading from geometry alone: true rotations and translations multiplied out, then a beam's length,
a probe's travel, a level against gravity, a turned diameter. It knows nothing of lever arms.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import make_instrument
from tests.support.machines import bridge, turning_centre, vertical_mill

Floats = NDArray[np.float64]
AXES = dict(zip("XYZABC", [*np.eye(3), *np.eye(3)], strict=True))


@dataclass(frozen=True)
class Frames:
    """Tool tip and work piece in the base's coordinates, 4 × 4, real and as they should be."""

    tool: Floats
    work: Floats
    ideal_tool: Floats
    ideal_work: Floats

    def seen(self, offset_mm: Any = (0.0, 0.0, 0.0)) -> Floats:
        """A point that goes with the tool, in the work piece's frame, real minus ideal, mm."""
        return self._relative(offset_mm, self.tool, self.work) - self._relative(
            offset_mm, self.ideal_tool, self.ideal_work
        )

    def place(self, offset_mm: Any = (0.0, 0.0, 0.0)) -> Floats:
        """The same point where it really is, in the work piece's frame, mm."""
        return self._relative(offset_mm, self.tool, self.work)

    @staticmethod
    def _relative(offset_mm: Any, tool: Floats, work: Floats) -> Floats:
        out: Floats = (np.linalg.inv(work) @ tool @ np.append(offset_mm, 1.0))[:3]
        return out


def frames(machine: Machine, pose_mm: Floats, errors: Mapping[str, float]) -> Frames:
    """Multiply the links out.

    An axis' errors are those of the tool relative to the work piece, so a slide on the work side makes the opposite
    motion itself; a fixed link's errors are its own (ADR 3).
    """

    def side(chain: tuple[str, ...], way: float, given: Mapping[str, float]) -> Floats:
        out = np.eye(4)
        for link in chain:
            axis = link in machine.axis_names
            tag, sign = (link, way) if axis else (f"0{link}", 1.0)
            step = np.eye(4)
            offset = machine.axis(link).offset_mm if axis else machine.links[link].offset_mm
            step[:3, 3] = offset
            if axis:
                line = AXES[machine.axis(link).direction]
                tilt = _turn([given.get(f"E{k}0{link}", 0.0) for k in "ABC"], 1.0)
                step[:3, 3] += way * pose_mm[machine.axis_names.index(link)] * (tilt @ line)
            real = np.eye(4)
            real[:3, :3] = _turn([given.get(f"E{k}{tag}", 0.0) for k in "ABC"], sign)
            real[:3, 3] = sign * 1e-3 * np.array([given.get(f"E{k}{tag}", 0.0) for k in "XYZ"])
            out = out @ step @ real
        return out

    return Frames(
        side(machine.tool_chain, 1.0, errors),
        side(machine.work_chain, -1.0, errors),
        side(machine.tool_chain, 1.0, {}),
        side(machine.work_chain, -1.0, {}),
    )


def _turn(urad: list[float], sign: float) -> Floats:
    """A true rotation, (3, 3)."""
    return Rotation.from_rotvec(sign * 1e-6 * np.array(urad)).as_matrix() if any(urad) else np.eye(3)


Read = Callable[[Frames], list[float]]


@dataclass(frozen=True)
class Example:
    """An instrument on a machine, and its reading by geometry."""

    name: str
    machine: Callable[[], Machine]
    read: Read
    setup: Mapping[str, Any] = field(default_factory=dict)
    axis: str | None = None
    note: str = ""

    def make(self) -> Instrument:
        return make_instrument(self.name, self.setup, self.axis, None, self.machine(), "example")

    def __str__(self) -> str:
        return f"{self.name}-{self.machine.__name__}-{self.axis or ''}{self.note}"


def reflector_on_tool(direction: str, offset: tuple[float, float, float]) -> Read:
    """The interferometer stands on the work piece's side, its beam along `direction`."""
    return lambda f: [float(f.seen(offset) @ AXES[direction]) * 1e3]


def along_diagonal(direction: tuple[float, float, float], offset: tuple[float, float, float]) -> Read:
    """The interferometer stands on the work piece's side, its beam along a diagonal."""
    beam = np.array(direction) / np.linalg.norm(direction)
    return lambda f: [float(f.seen(offset) @ beam) * 1e3]


def reflector_on_work(direction: str, offset: tuple[float, float, float]) -> Read:
    """The interferometer sits at the tool; the reflector is where the tool's point ideally is, fixed to the work."""

    def read(f: Frames) -> list[float]:
        where = np.linalg.inv(f.ideal_work) @ f.ideal_tool @ np.append(offset, 1.0)
        away = np.linalg.inv(f.tool) @ f.work @ where
        return [-float((away[:3] - np.array(offset)) @ AXES[direction]) * 1e3]

    return read


def two_reflectors(about: str, direction: str) -> Read:
    """Two reflectors on an arm across the beam: difference of paths over their distance."""

    def read(f: Frames) -> list[float]:
        arm = np.cross(AXES[about], AXES[direction])
        paths = [f.seen(sign * 15.0 * arm) @ AXES[direction] for sign in (1.0, -1.0)]
        return [-(paths[0] - paths[1]) / 30.0 * 1e6]

    return read


def level(about: str, on: str, vertical: str = "Z") -> Read:
    """How far the level's long side rises against gravity."""

    def read(f: Frames) -> list[float]:
        up, side = AXES[vertical], np.cross(AXES[vertical], AXES[about])
        tool, work = (float((frame[:3, :3] @ side) @ up) * 1e6 for frame in (f.tool, f.work))
        return [{"tool": tool, "work": work, "both": tool - work}[on]]

    return read


def probes(*where: tuple[str, tuple[float, float, float], float]) -> Read:
    """Probes on the work piece's side, touching points that go with the tool."""
    return lambda f: [sign * float(f.seen(offset) @ AXES[direction]) * 1e3 for direction, offset, sign in where]


def diameter(f: Frames) -> list[float]:
    """The work piece turns about Z of its frame: the tool cuts at its distance from that line."""
    ideal = Frames(f.ideal_tool, f.ideal_work, f.ideal_tool, f.ideal_work)
    radius, wanted = (float(np.hypot(*g.place()[:2])) for g in (f, ideal))
    return [2.0 * (radius - wanted) * 1e3]


def two_balls(machine: Machine, centre: tuple[float, float, float], height: float, third: str) -> Read:
    """One ball at the tool, the other fixed in the work piece's frame: their distance."""
    table = frames(machine, np.zeros(len(machine.axes)), {}).place() + np.array(centre) + height * AXES[third]

    def read(f: Frames) -> list[float]:
        ideal = Frames(f.ideal_tool, f.ideal_work, f.ideal_tool, f.ideal_work)
        lengths = [float(np.linalg.norm(g.place() - table)) for g in (f, ideal)]
        return [(lengths[0] - lengths[1]) * 1e3]

    return read


BEAM = (0.0, 150.0, 80.0)
SPOT = (-20.0, 30.0, -45.0)
TIP = (0.0, 0.0, 0.0)
MACHINES = (turning_centre, vertical_mill, bridge)


def _lasers() -> list[Example]:
    out = []
    for make in MACHINES:
        for axis in make().axes:
            d = axis.direction
            setup: dict[str, Any] = {"beam_offset_mm": BEAM}
            out.append(
                Example("laser_linear", make, reflector_on_tool(d, BEAM), setup, axis.name, "-reflector-on-tool")
            )
            out.append(
                Example("laser_linear", make, reflector_on_work(d, BEAM), setup, axis.name, "-reflector-on-work")
            )
            for about, letter in zip("ABC", "XYZ", strict=True):
                if letter != d:
                    read = two_reflectors(about, d)
                    out.append(Example("laser_angular", make, read, {"about": about}, axis.name, f"-{about}"))
                    across = probes((letter, SPOT, 1.0))
                    setup = {"direction": letter, "probe_offset_mm": SPOT}
                    out.append(Example("straightness", make, across, setup, axis.name, f"-{letter}"))
    return out


def _others() -> list[Example]:
    drift: dict[str, Any] = {
        "radial1": {"direction": "X"},
        "radial2": {"direction": "X", "offset_mm": (0.0, 0.0, -60.0)},
        "axial": {"direction": "Z", "offset_mm": SPOT, "sign": -1},
        "y1": {"direction": "Y"},
    }
    where = probes(("X", TIP, 1.0), ("X", (0.0, 0.0, -60.0), 1.0), ("Z", SPOT, -1.0), ("Y", TIP, 1.0))
    out = []
    for make in MACHINES:
        out.append(Example("spindle_drift", make, where, {"probe": drift}))
        out.append(Example("tool_tip", make, probes(*((d, BEAM, 1.0) for d in "XYZ")), {"offset_mm": BEAM}))
        there = {a.direction for a in make().axes}
        whole = (500.0, 400.0 if "Y" in there else 0.0, 300.0)
        for way in (whole, (-500.0, 0.0, 300.0)):
            slant: dict[str, Any] = {"direction": way, "beam_offset_mm": BEAM}
            out.append(
                Example("laser_diagonal", make, along_diagonal(way, BEAM), slant, note=f"-{way[0]:g},{way[1]:g}")
            )
        some = {"directions": ("Z", "X")}
        out.append(Example("tool_tip", make, probes(("Z", TIP, 1.0), ("X", TIP, 1.0)), some, note="-some"))
        both = {"reference_axis": "Z", "probe_offset_mm": SPOT}
        out.append(Example("squareness", make, probes(("X", SPOT, 1.0), ("Z", SPOT, 1.0)), both, "X"))
        length = {"feature": "length", "sign": -1}
        out.append(Example("work_piece", make, probes(("Z", TIP, -1.0)), length, "Z", "-length"))
        out += [
            Example("level", make, level(about, on), {"about": about, "on": on}, None, f"-{about}-{on}")
            for about in "AB"
            for on in ("tool", "work", "both")
        ]
        tilted = {"about": "C", "vertical": "X", "sign": -1}
        out.append(
            Example("level", make, lambda f: [-v for v in level("C", "both", "X")(f)], tilted, None, "-vertical-X")
        )
    for make, plane, centre, third in (
        (turning_centre, "ZX", (100.0, 0.0, 200.0), "Y"),
        (vertical_mill, "XY", (200.0, 190.0, 210.0), "Z"),
        (bridge, "YZ", (30.0, 190.0, 210.0), "X"),
    ):
        ball_bar = {"plane": plane, "centre_mm": centre, "radius_mm": 80.0, "height_mm": 170.0, "direction": "cw"}
        read = two_balls(make(), centre, 170.0, third)
        out.append(Example("ball_bar", make, read, {**ball_bar, "feed_mm_min": 1000.0, "zero": "run"}, None, plane))
        first, second = {"ZX": ("X", "Z"), "XY": ("X", "Y"), "YZ": ("Y", "Z")}[plane]
        grid = {"plane": first + second, "origin_mm": centre, "offset_mm": SPOT}
        out.append(Example("grid_encoder", make, probes((first, SPOT, 1.0), (second, SPOT, 1.0)), grid, None, plane))
    out.append(Example("work_piece", turning_centre, diameter, {"feature": "diameter"}, "X", "-diameter"))
    return out


EXAMPLES = [*_lasers(), *_others()]
