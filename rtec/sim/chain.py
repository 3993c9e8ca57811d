"""Where the tool tip really is: the product of homogeneous transforms along both sides of the machine, in full.

Written apart from `rtec.machine` on purpose: the simulated truth must not lean on what it is there to test.

    tool side:  T = Trans(offset + q·(d + ε0 × d)) · E(ε, δ)           work side:  Trans(offset - …) · E(-ε, -δ)
    fixed link: T = Trans(offset) · E(ε, δ), its own displacement in machine coordinates, on either side
    tip = position of T_WORK^-1 T_TOOL                                  e = tip - nominal tip   [G 2.9, 2.22-2.26]

E is [G 2.6]; lengths mm, angles rad; many poses at once along the first axis of every array.
"""

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine

Floats = NDArray[np.float64]
DIRECTIONS = {"X": (1.0, 0.0, 0.0), "Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}


class ExactChain:
    """The two sides of one machine.

    Attributes:
        links: all link names, tool side first: the order of every array of link errors.
        directions: (axes, 3) unit vectors.
    """

    def __init__(self, machine: Machine) -> None:
        self.links = (*machine.tool_chain, *machine.work_chain)
        self.directions = np.array([DIRECTIONS[a.direction] for a in machine.axes]).reshape(-1, 3)
        self._n_tool = len(machine.tool_chain)
        names = machine.axis_names
        self._axis = [names.index(name) if name in names else -1 for name in self.links]
        self._offset = np.array(
            [
                machine.axes[a].offset_mm if a >= 0 else machine.links[name].offset_mm
                for name, a in zip(self.links, self._axis, strict=True)
            ]
        )

    def nominal_mm(self, q_mm: Floats) -> Floats:
        """Tool tip relative to the workpiece, (n, 3), without any error; q_mm is (n, axes)."""
        fixed = self._offset[: self._n_tool].sum(axis=0) - self._offset[self._n_tool :].sum(axis=0)
        return np.asarray(fixed + q_mm @ self.directions)

    def tip_mm(self, q_mm: Floats, delta_mm: Floats, epsilon_rad: Floats, squareness_rad: Floats) -> Floats:
        """Tool tip relative to the workpiece, (n, 3).

        Args:
            q_mm: positions that the scales show, (n, axes).
            delta_mm: displacement of every link, (n, links, 3).
            epsilon_rad: rotation of every link, (n, links, 3).
            squareness_rad: tilt of each axis' line of travel, (axes, 3).
        """
        travel = q_mm[:, :, None] * (self.directions + _cross(squareness_rad, self.directions))
        sides = []
        for links, side in ((range(self._n_tool), 1.0), (range(self._n_tool, len(self.links)), -1.0)):
            product = np.broadcast_to(np.eye(4), (len(q_mm), 4, 4))
            for k in links:
                a = self._axis[k]
                if a >= 0:
                    place = self._offset[k] + side * (travel[:, a] + delta_mm[:, k])
                    product = product @ _link(place, side * epsilon_rad[:, k])
                else:
                    product = product @ _link(self._offset[k] + delta_mm[:, k], epsilon_rad[:, k])
            sides.append(product)
        tool, work = sides
        return np.asarray(np.linalg.solve(work, tool[:, :, 3:])[:, :3, 0])


def _cross(a: Floats, b: Floats) -> Floats:
    """`a × b` along the last axis; numpy's own takes ten times as long on a few vectors."""
    return np.asarray(a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]])


def _link(place_mm: Floats, epsilon_rad: Floats) -> Floats:
    """`Trans(place) · E(ε, 0)`, (n, 4, 4); a displacement δ is part of `place`, as `Trans(δ) · E(ε, 0) = E(ε, δ)`."""
    out = np.zeros((len(place_mm), 4, 4))
    a, b, c = epsilon_rad.T
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = out[:, 3, 3] = 1.0
    out[:, 0, 1], out[:, 1, 0] = -c, c
    out[:, 0, 2], out[:, 2, 0] = b, -b
    out[:, 1, 2], out[:, 2, 1] = -a, a
    out[:, :3, 3] = place_mm
    return out
