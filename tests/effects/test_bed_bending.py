"""One bend of a bed is a bow and a slope: what `bed_bending` makes of the straightness and of the angle of one axis.

Oracles: the closed form of the slope; differences of the straightness by numpy; and a rigid body carried along an arc,
multiplied out by exact_chain.py's product of transforms.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.effects import EFFECTS, Effect, State
from rtec.machine import Machine
from rtec.machine.machine import Sensor
from tests.support.exact_chain import error_matrix
from tests.support.machines import vertical_mill

Floats = NDArray[np.float64]
MILL: Machine = replace(vertical_mill(), sensors=(Sensor("T_top"), Sensor("T_foot")))
K_UM, WARM_K = 3.0, 4.0
"""The bow at the ends of the travel, µm/K, and the difference of the sides."""
PAIRS = {
    ("EYX", "ECX"): 1.0, ("EZX", "EBX"): -1.0, ("EZY", "EAY"): 1.0,
    ("EXY", "ECY"): -1.0, ("EXZ", "EBZ"): 1.0, ("EYZ", "EAZ"): -1.0,
}  # fmt: skip
"""Straightness and angle of one bend, with the sign that the docstring of the effect gives for a tool-side slide."""
every_pair = pytest.mark.parametrize("pair", PAIRS, ids="-".join)


def bending(component: str) -> Effect:
    text = {"effect": "bed_bending", "component": component, "axis": component[2], "front": "T_top", "back": "T_foot"}
    return EFFECTS["bed_bending"].model_validate(text)


def along(axis: str, q: Floats) -> State:
    channels = {a.channel: np.full(len(q), 100.0) for a in MILL.axes} | {axis.lower(): q}
    warm = {"T_top": np.full(len(q), 20.0 + WARM_K), "T_foot": np.full(len(q), 20.0)}
    return State(MILL, np.arange(len(q), dtype=np.float64), channels | warm)


def half_mm(axis: str) -> float:
    low, high = MILL.axis(axis).travel_mm
    return 0.5 * (high - low)


def places(axis: str) -> Floats:
    low, high = MILL.axis(axis).travel_mm
    return np.linspace(low, high, 41)


def bow_um(component: str, q: Floats) -> Floats:
    (basis,) = bending(component).basis(MILL, along(component[2], q), {})
    return np.asarray(K_UM * basis)


def slope_urad(pair: tuple[str, str], q: Floats) -> Floats:
    """By the effect, with the coefficient that its docstring derives from the bow's."""
    (basis,) = bending(pair[1]).basis(MILL, along(pair[1][2], q), {})
    return np.asarray(PAIRS[pair] * 2000.0 * K_UM / half_mm(pair[1][2]) * basis)


@every_pair
def test_the_angle_is_the_slope_in_closed_form(pair: tuple[str, str]) -> None:
    """Oracle: the derivative of `k ΔT u²`, worked out by hand, in µm/m = µrad."""
    axis = pair[0][2]
    q, middle, half_m = places(axis), float(np.mean(MILL.axis(axis).travel_mm)), half_mm(axis) / 1000.0
    by_hand = PAIRS[pair] * 2.0 * K_UM * WARM_K * ((q - middle) / 1000.0) / half_m**2
    assert slope_urad(pair, q) == pytest.approx(by_hand, abs=1e-9)


@every_pair
def test_the_angle_is_the_difference_of_the_straightness(pair: tuple[str, str]) -> None:
    """Oracle: central differences of the bow, turned into an angle by the right-hand rule: δ' = ε × direction."""
    axis, q, d = pair[0][2], places(pair[0][2]), 1e-3
    rise = (bow_um(pair[0], q + d) - bow_um(pair[0], q - d)) / (2.0 * d) * 1000.0
    line = np.eye(3)["XYZ".index(axis)]
    turned = np.cross(np.eye(3)["ABC".index(pair[1][1])], line)["XYZ".index(pair[0][1])]
    assert slope_urad(pair, q) == pytest.approx(turned * rise, abs=1e-6)


@every_pair
@pytest.mark.parametrize("work", [False, True], ids=["tool", "work"])
def test_both_together_carry_a_body_along_an_arc(pair: tuple[str, str], *, work: bool) -> None:
    """Oracle: a rigid turn about the centre of the bed's curvature, as a product of transforms.

    A work-side slide is at -q, and its own errors are the opposite of the components (chain.py). The two differ by
    second order: the arc is shorter than its tangent, by the cube of the travel over six times the radius squared.
    """
    axis, q = pair[0][2], places(pair[0][2])
    line, off = np.eye(3)["XYZ".index(axis)], np.eye(3)["XYZ".index(pair[0][1])]
    middle = float(np.mean(MILL.axis(axis).travel_mm))
    flip = -1.0 if work else 1.0
    bow, angle = bow_um(pair[0], q), slope_urad(pair, q) * flip  # the opposite sign on the work side
    shifts = flip * bow[:, None] * off * 1e-3
    turns = flip * angle[:, None] * np.eye(3)["ABC".index(pair[1][1])] * 1e-6
    carried = error_matrix(turns, shifts)
    radius = half_mm(axis) ** 2 / (2.0 * flip * K_UM * 1e-3 * WARM_K)
    arm = np.array([70.0, -110.0, 250.0])
    for i, at in enumerate(q):
        s = flip * (at - middle)
        phi = s / radius
        # Turned in the plane of line and off: the line leans towards off.
        turn = np.eye(3) + np.sin(phi) * (np.outer(off, line) - np.outer(line, off))
        turn += (np.cos(phi) - 1.0) * (np.outer(line, line) + np.outer(off, off))
        centre = radius * off
        exact = turn @ (arm - centre) + centre
        by_effect = (carried[i] @ [*arm, 1.0])[:3] + s * line
        assert by_effect == pytest.approx(exact, abs=1e-5), "10 nm"
