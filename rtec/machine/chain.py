"""The kinematic chain: the lever arm of each component error at the tool tip.

Equations [G 2.6-2.9, 2.22-2.28]. A link's real transform is its nominal translation times `E(ε, δ)`, a small
rotation and displacement in the frame that the link carries. To first order the tip error is linear in the
component errors, `e = J(pose) · components`, and every lever arm is linear in the axis positions, so the whole
chain is one array of numbers, `J(q) = J0 + Σ_a J_a q_a`.

Symbols: `q` axis positions, mm; `p` tool tip and `o` frame origin of a link, mm, in machine coordinates;
`ε` µrad, `δ` µm; `e` µm, the actual tool position relative to the workpiece minus the nominal one.

- axis, on either side: `e = δ + ε × (p - o)`. Its component errors are those of the tool relative to the
  workpiece, as ISO 230-1 measures them. A work-side slide moves by -q itself, hence its frame at `-q`.
- axis, squareness and parallelism (`EC0Y` …): tilts the line of travel only, `e = ε0 × (q · direction)`.
- fixed link, tool side: `e = δ + ε × (p - o)`; work side: `e = -(δ + ε × (p - o))`, because a fixed link's errors
  are its own displacement in machine coordinates ([G 2.24-2.26], `e = -p_E`).

[XT eq. 1] prints `-EBX z` in e_x beside `-EBX x` in e_z, which no rotation gives; this file follows `ε × p`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from rtec.arrays import Floats

UNITS = {d: np.eye(3)[i] for i, d in enumerate("XYZ")}
MM_URAD_TO_UM = 1e-3
Direction = Literal["X", "Y", "Z"]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Axis:
    """One moving link.

    Attributes:
        name: name on the machine's panel, for example "X"; its position channel is the lower-case name.
        kind: "linear"; rotary axes will be another value.
        direction: machine coordinate that grows when the axis moves positive. For an axis on the work side this
            is the tool's motion relative to the workpiece (the slide itself moves the other way).
        travel_mm: lowest and highest position.
        counts_per_mm: encoder counts after x4.
        pitch_mm: screw or scale pitch; None where there is none.
        offset_mm: frame origin at position zero, relative to the previous link.
        compensate: may rtec correct this axis?
        dead_band_counts: motion back by at most this much does not count as a reversal.
    """

    name: str
    direction: Direction
    travel_mm: tuple[float, float]
    counts_per_mm: float
    pitch_mm: float | None = None
    offset_mm: Vector = (0.0, 0.0, 0.0)
    compensate: bool = True
    dead_band_counts: int = 2
    kind: Literal["linear"] = "linear"

    @property
    def channel(self) -> str:
        """Name of the position channel, mm."""
        return self.name.lower()

    @property
    def dead_band_mm(self) -> float:
        """The dead band of direction, mm."""
        return self.dead_band_counts / self.counts_per_mm

    @property
    def direction_channel(self) -> str:
        """Name of the channel of the last direction of motion: -1, +1, or 0 before the first motion."""
        return f"d_{self.channel}"

    @property
    def velocity_channel(self) -> str:
        """Name of the velocity channel, mm/s, signed."""
        return f"v_{self.channel}"

    @property
    def acceleration_channel(self) -> str:
        """Name of the acceleration channel, mm/s², signed."""
        return f"a_{self.channel}"

    @property
    def since_reversal_channel(self) -> str:
        """Name of the channel of the distance travelled since the last reversal, mm."""
        return f"s_{self.channel}"

    @property
    def moving_channels(self) -> tuple[str, ...]:
        """Names of all its channels: position, direction, velocity, acceleration, distance since reversal."""
        return (
            self.channel,
            self.direction_channel,
            self.velocity_channel,
            self.acceleration_channel,
            self.since_reversal_channel,
        )


@dataclass(frozen=True)
class Link:
    """A fixed link: spindle, turret, tool, workpiece; `offset_mm` from the previous link."""

    name: str
    offset_mm: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Chain:
    """The lever arms of one machine.

    Attributes:
        components: names of the component errors; translations (`EXX`, µm) and rotations (`EAX`, µrad).
        terms: (3, components, 1 + axes): constant part and factor of each axis position; µm per µm, and
            µm per µrad (arms in m) for rotations.
        turns: (3, components): rotation of the tool relative to the workpiece, µrad per µrad of each component.
        tip: (3, 1 + axes): the nominal tool tip, mm, affine in the axis positions.
    """

    components: tuple[str, ...]
    terms: Floats
    turns: Floats
    tip: Floats

    def jacobian(self, pose_mm: ArrayLike, extra_tool_mm: ArrayLike = (0.0, 0.0, 0.0)) -> Floats:
        """Lever arms at one pose (axes,) or many (n, axes): (3, components) or (n, 3, components).

        Args:
            pose_mm: axis positions in the machine's axis order.
            extra_tool_mm: offset of the point of interest from the tool tip, for a beam or a probe.
        """
        pose = np.asarray(pose_mm, dtype=np.float64)
        affine = np.concatenate([np.ones((*pose.shape[:-1], 1)), pose], axis=-1)
        out = np.einsum("ijk,...k->...ij", self.terms, affine)
        extra = np.cross(self.turns.T, np.asarray(extra_tool_mm, dtype=np.float64)).T * MM_URAD_TO_UM
        return np.asarray(out + extra, dtype=np.float64)

    def tip_error_um(self, pose_mm: ArrayLike, errors: ArrayLike) -> Floats:
        """Tool-tip error, µm, (3,) or (n, 3), for component errors (components,) or (n, components)."""
        out = np.einsum("...ij,...j->...i", self.jacobian(pose_mm), np.asarray(errors, dtype=np.float64))
        return np.asarray(out, dtype=np.float64)

    def unit(self, component: str) -> str:
        """'urad' for a rotation, 'um' for a translation."""
        return component_unit(component)


def component_unit(component: str) -> str:
    """'urad' for `EA…`, `EB…`, `EC…`; 'um' for `EX…`, `EY…`, `EZ…`."""
    return "urad" if component[1] in "ABC" else "um"


def derive_chain(
    tool_chain: Sequence[str], work_chain: Sequence[str], axes: Sequence[Axis], links: Mapping[str, Link]
) -> Chain:
    """The lever arms of every component error, from the two chains of a machine.

    Args:
        tool_chain: names of its links and axes from the base to the tool tip.
        work_chain: the same from the base to the cutting point.
        axes: in the order of the poses.
        links: the fixed links by name.
    """
    moving, n = {axis.name: axis for axis in axes}, 1 + len(axes)
    travels = {axis.name: _travel(k, axis, n) for k, axis in enumerate(axes)}
    origins: dict[str, Floats] = {}
    for chain, side in ((work_chain, -1.0), (tool_chain, 1.0)):
        here = np.zeros((3, n))
        for name in chain:
            here = here + _constant(np.asarray((moving.get(name) or links[name]).offset_mm, dtype=np.float64), n)
            if name in moving:
                here = here + side * travels[name]
            origins[name] = here
    tip = origins[tool_chain[-1]] if tool_chain else np.zeros((3, n))
    names: list[str] = []
    terms: list[Floats] = []
    turns: list[Floats] = []

    def add(name: str, term: Floats, turn: Floats) -> None:
        names.append(name)
        terms.append(term)
        turns.append(turn)

    for link in (*work_chain, *tool_chain):
        sign = -1.0 if link in work_chain and link not in moving else 1.0
        arm = tip - origins[link]
        tag = link if link in moving else f"0{link}"
        for letter, unit in zip("XYZ", np.eye(3), strict=True):
            add(f"E{letter}{tag}", sign * _constant(unit, n), np.zeros(3))
        for letter, unit in zip("ABC", np.eye(3), strict=True):
            add(f"E{letter}{tag}", sign * MM_URAD_TO_UM * _cross(unit, arm), sign * unit)
        if link in moving:
            for letter, direction, unit in zip("ABC", "XYZ", np.eye(3), strict=True):
                if direction != moving[link].direction:
                    add(f"E{letter}0{link}", MM_URAD_TO_UM * _cross(unit, travels[link]), np.zeros(3))
    return Chain(tuple(names), np.stack(terms, axis=1), np.stack(turns, axis=1), tip)


def _travel(k: int, axis: Axis, n: int) -> Floats:
    """Motion of the k-th axis, (3, n), affine in the axis positions."""
    out = np.zeros((3, n))
    out[:, 1 + k] = UNITS[axis.direction]
    return out


def _constant(vector: Floats, n: int) -> Floats:
    out = np.zeros((3, n))
    out[:, 0] = vector
    return out


def _cross(unit: Floats, arm: Floats) -> Floats:
    return np.cross(unit, arm.T).T
