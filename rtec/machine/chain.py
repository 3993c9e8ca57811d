"""The kinematic chain: which lever arm each component error has at the tool tip.

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

[XT eq. 1] prints `-EBX z` in e_x beside `-EBX x` in e_z, which no one rotation gives; this file follows `ε × p`.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from rtec.machine.machine import Machine

UNITS = {d: np.eye(3)[i] for i, d in enumerate("XYZ")}
MM_URAD_TO_UM = 1e-3
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Chain:
    """The lever arms of one machine.

    Attributes:
        components: names of the component errors; translations (`EXX`, µm) and rotations (`EAX`, µrad).
        terms: (3, components, 1 + axes): constant part and factor of each axis position; µm per µm, and
            µm per µrad (arms in m) for rotations.
        turns: (3, components): how each component turns the tool relative to the workpiece, µrad per µrad.
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
            extra_tool_mm: where the point of interest sits beside the tool tip, for a beam or a probe.
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


def derive_chain(machine: "Machine") -> Chain:
    """Work out the lever arms of every component error from the two chains of a machine."""
    origins, tip = _frame_origins(machine)
    names: list[str] = []
    terms: list[Floats] = []
    turns: list[Floats] = []

    def add(name: str, term: Floats, turn: Floats) -> None:
        names.append(name)
        terms.append(term)
        turns.append(turn)

    n = 1 + len(machine.axes)
    for link in (*machine.work_chain, *machine.tool_chain):
        is_axis = link in machine.axis_names
        sign = -1.0 if link in machine.work_chain and not is_axis else 1.0
        arm = tip - origins[link]
        tag = link if is_axis else f"0{link}"
        for letter, unit in zip("XYZ", np.eye(3), strict=True):
            add(f"E{letter}{tag}", sign * _constant(unit, n), np.zeros(3))
        for letter, unit in zip("ABC", np.eye(3), strict=True):
            add(f"E{letter}{tag}", sign * MM_URAD_TO_UM * _cross(unit, arm), sign * unit)
        if is_axis:
            travel = _travel(machine, link)
            for letter, direction, unit in zip("ABC", "XYZ", np.eye(3), strict=True):
                if direction != machine.axis(link).direction:
                    add(f"E{letter}0{link}", MM_URAD_TO_UM * _cross(unit, travel), np.zeros(3))
    return Chain(tuple(names), np.stack(terms, axis=1), np.stack(turns, axis=1), tip)


def _frame_origins(machine: "Machine") -> tuple[dict[str, Floats], Floats]:
    """Origin of each link's frame and of the tool tip, (3, 1 + axes), affine in the axis positions."""
    origins: dict[str, Floats] = {}
    for names, side in ((machine.work_chain, -1.0), (machine.tool_chain, 1.0)):
        here = np.zeros((3, 1 + len(machine.axes)))
        for name in names:
            is_axis = name in machine.axis_names
            offset = machine.axis(name).offset_mm if is_axis else machine.links[name].offset_mm
            here = here + _constant(np.asarray(offset, dtype=np.float64), here.shape[1])
            if is_axis:
                here = here + side * _travel(machine, name)
            origins[name] = here
    tip = origins[machine.tool_chain[-1]] if machine.tool_chain else np.zeros((3, 1 + len(machine.axes)))
    return origins, tip


def _travel(machine: "Machine", name: str) -> Floats:
    out = np.zeros((3, 1 + len(machine.axes)))
    out[:, 1 + machine.axis_names.index(name)] = UNITS[machine.axis(name).direction]
    return out


def _constant(vector: Floats, n: int) -> Floats:
    out = np.zeros((3, n))
    out[:, 0] = vector
    return out


def _cross(unit: Floats, arm: Floats) -> Floats:
    return np.cross(unit, arm.T).T
