"""The kinematic chain against [G 2.24-2.28], [XT 1] and products of 4 × 4 matrices written out here."""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from rtec.effects import effect_class
from rtec.machine import Machine
from rtec.machine.chain import component_unit
from rtec.model import FittedEffect, Model
from tests.support.exact_chain import exact_tip_error_um
from tests.support.machines import ALL, X1, X4, Z4, axis, bridge, machine, turning_centre, vertical_mill

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]
URAD_MM = 1e-3  # µrad at 1 mm, in µm


# [G 2.24-2.26], term by term: coefficient of each error in p_E at the positions x and z. x(w) and z(w) are the
# nominal cutting point. The scan prints δx(s) for δx(x) in (2.24) and p_Ey for p_Ez in (2.26).
def g_2_24(x: float, z: float) -> dict[str, float]:
    del x
    return {
        "EX0workpiece": 1.0, "EB0spindle": (z + Z4) * URAD_MM, "EX0spindle": 1.0, "EX0tool": -1.0,
        "EBZ": -Z4 * URAD_MM, "EBX": -Z4 * URAD_MM, "EB0turret": -Z4 * URAD_MM,
        "EX0turret": -1.0, "EXX": -1.0, "EXZ": -1.0,
    }  # fmt: skip


def g_2_25(x: float, z: float) -> dict[str, float]:
    return {
        "EY0workpiece": 1.0, "EA0spindle": -(z + Z4) * URAD_MM, "EY0spindle": 1.0,
        "ECZ": (-X4 - x) * URAD_MM, "ECX": -X4 * URAD_MM, "EC0turret": -X4 * URAD_MM, "EY0tool": -1.0,
        "EAZ": Z4 * URAD_MM, "EAX": Z4 * URAD_MM, "EA0turret": Z4 * URAD_MM,
        "EY0turret": -1.0, "EYX": -1.0, "EYZ": -1.0,
    }  # fmt: skip


def g_2_26(x: float, z: float) -> dict[str, float]:
    del z
    return {
        "EZ0workpiece": 1.0, "EB0spindle": -(x + X1 + X4) * URAD_MM, "EZ0spindle": 1.0,
        "EBZ": (X4 + x) * URAD_MM, "EBX": X4 * URAD_MM, "EB0turret": X4 * URAD_MM,
        "EZ0tool": -1.0, "EZ0turret": -1.0, "EZX": -1.0, "EZZ": -1.0,
    }  # fmt: skip


# [G] sets these to zero by assumption (the workpiece does not turn, the spindle's angle has no meaning) or carries
# them inside δx(z) and δz(x) (parallelism, orthogonality; a test of its own below).
NOT_IN_G = {"EA0workpiece", "EB0workpiece", "EC0workpiece", "EC0spindle", "EA0Z", "EB0Z", "EB0X", "EC0X"}


@pytest.mark.parametrize(("x", "z"), [(0.0, 0.0), (137.0, 0.0), (0.0, 251.0), (88.5, 312.25), (200.0, 400.0)])
def test_turning_centre_has_the_coefficients_of_g_2_24_to_2_26(x: float, z: float) -> None:
    """Oracle: the three equations above, every coefficient, zeros too; e = -p_E."""
    m = turning_centre()
    jacobian = m.chain.jacobian([x, z])
    assert m.axis_names == ("X", "Z")
    equations = (g_2_24(x, z), g_2_25(x, z), g_2_26(x, z))
    for row, equation in enumerate(equations):
        for column, component in enumerate(m.components):
            if component not in NOT_IN_G:
                wanted = -equation.get(component, 0.0)
                assert jacobian[row, column] == pytest.approx(wanted, abs=1e-12), (component, row)
    named = {*NOT_IN_G}.union(*equations)
    assert {c for c in m.components if c not in named} == {"EA0tool", "EB0tool", "EC0tool"}, "all others are compared"


def test_parallelism_and_orthogonality_are_straightness_that_grows_with_travel() -> None:
    """Oracle: [G 2.16] δx(z) = δ'x(z) + α_p Δz, [G 2.17] δz(x) = δ'z(x) + α_o Δx.

    A positive turn about Y tips Z towards +X and X towards -Z, so α_p is +EB0Z and α_o is -EB0X.
    """
    m = turning_centre()
    jacobian = dict(zip(m.components, m.chain.jacobian([60.0, 250.0]).T, strict=True))
    np.testing.assert_allclose(jacobian["EB0Z"], jacobian["EXZ"] * 250.0 * URAD_MM, atol=1e-15)
    np.testing.assert_allclose(jacobian["EB0X"], -jacobian["EZX"] * 60.0 * URAD_MM, atol=1e-15)
    np.testing.assert_allclose(jacobian["EA0Z"], -jacobian["EYZ"] * 250.0 * URAD_MM, atol=1e-15)
    np.testing.assert_allclose(jacobian["EC0X"], jacobian["EYX"] * 60.0 * URAD_MM, atol=1e-15)
    assert "EC0Z" not in m.components, "an axis' line of travel has no turn about itself"
    assert "EA0X" not in m.components


# [XT 1] with ε × p: e_x = EB z - EC y, e_y = EC x - EA z, e_z = EA y - EB x, each with what its axis carries.
def xt_1(x: float, y: float, z: float) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    mx, my, mz = x * URAD_MM, y * URAD_MM, z * URAD_MM
    return (
        {"EXX": 1, "EXY": 1, "EXZ": 1, "ECX": -my, "EC0Y": -my, "EBX": mz, "EBY": mz, "EB0Z": mz},
        {"EYX": 1, "EYY": 1, "EYZ": 1, "ECX": mx, "EC0X": mx, "EAX": -mz, "EAY": -mz, "EA0Z": -mz},
        {"EZX": 1, "EZY": 1, "EZZ": 1, "EBX": -mx, "EB0X": -mx, "EAX": my, "EA0Y": my},
    )


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (-362.0, 1977.0, 593.0), (281.0, -200.0, -759.0)])
def test_bridge_machine_has_the_coefficients_of_xt_1(pose: tuple[float, float, float]) -> None:
    """Oracle: the table above. [XT] takes X as the reference of the angles, so it has no EC0X, EB0X, EA0Y."""
    m = bridge()
    jacobian = m.chain.jacobian(pose)
    for row, equation in enumerate(xt_1(*pose)):
        for column, component in enumerate(m.components):
            wanted = equation.get(component, 0.0)
            assert jacobian[row, column] == pytest.approx(wanted, abs=1e-12), (component, row)


def test_the_printed_signs_of_xt_1_cannot_both_hold() -> None:
    """[XT 1] prints -EBX z in e_x beside -EBX x in e_z, and -EBY z in e_x.

    Oracle: a rotation moves no point along its own position vector, (ε × p) · p = 0. The printed pair gives
    -2 EBX x z there; with +EBX z in e_x it gives 0, and that is what the chain has.
    """
    x, y, z = -362.0, 0.0, 593.0
    printed = np.array([-z, 0.0, -x])
    assert printed @ [x, y, z] == pytest.approx(-2 * x * z)
    m = bridge()
    chain = m.chain.jacobian([x, y, z])[:, m.components.index("EBX")]
    assert chain @ [x, y, z] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(chain, np.array([z, 0.0, -x]) * URAD_MM, atol=1e-12)


# An independent chain: complex numbers, so that a derivative is exact (the step is 1e-30 and nothing is subtracted).
STEP = 1e-30j


def shift(offset: ArrayLike) -> Complex:
    out = np.eye(4, dtype=np.complex128)
    out[:3, 3] = offset
    return out


def body(turn: Complex, move: Complex) -> Complex:
    """[G 2.6], entry by entry."""
    ex, ey, ez = turn
    dx, dy, dz = move
    return np.array([[1, -ez, ey, dx], [ez, 1, -ex, dy], [-ey, ex, 1, dz], [0, 0, 0, 1]])


def side(m: Machine, work: bool, pose: Mapping[str, float], error: Mapping[str, complex]) -> Complex:
    """One side of the machine as bodies that really move.

    A table under the workpiece moves by -q, and what it does wrong appears between tool and workpiece with the
    opposite sign; ISO 230-1 names what appears. A fixed link simply moves.
    """
    out = shift([0, 0, 0])
    for name in m.work_chain if work else m.tool_chain:
        moving = name in m.axis_names
        sense = -1.0 if moving and work else 1.0
        tag = name if moving else f"0{name}"
        turn = np.array([sense * error.get(f"E{k}{tag}", 0j) for k in "ABC"], dtype=np.complex128)
        move = np.array([sense * error.get(f"E{k}{tag}", 0j) for k in "XYZ"], dtype=np.complex128)
        if moving:
            line = np.array([complex(m.axis(name).direction == k) for k in "XYZ"])
            ax, ay, az = (error.get(f"E{k}0{name}", 0j) for k in "ABC")
            tilted = line + np.array(
                [ay * line[2] - az * line[1], az * line[0] - ax * line[2], ax * line[1] - ay * line[0]]
            )
            place = shift(np.array(m.axis(name).offset_mm) + sense * pose[name] * tilted)
        else:
            place = shift(m.links[name].offset_mm)
        out = np.asarray(out @ place @ body(turn, move), dtype=np.complex128)
    return out


def arms_by_complex_step(m: Machine, pose: Floats) -> Floats:
    """What one µm or µrad of each component does to the tip as seen from the workpiece, µm: (3, components)."""
    at = dict(zip(m.axis_names, pose, strict=True))
    columns = []
    for name in m.components:
        scale = 1e-6 if component_unit(name) == "urad" else 1e-3
        error = {name: STEP * scale}
        tool = side(m, False, at, error)
        work = side(m, True, at, error)
        columns.append((np.linalg.inv(work) @ tool)[:3, 3].imag / STEP.imag * 1e3)
    return np.array(columns).T


POSES = {
    "turning-centre": [[0.0, 0.0], [120.0, 333.0]],
    "vertical-mill": [[0.0, 0.0, 0.0, 0.0], [55.0, 210.0, 301.0, 222.0], [400.0, 13.0, 17.0, 399.0]],
    "bridge": [[0.0, 0.0, 0.0], [-362.0, 1977.0, 593.0]],
}


def test_vertical_mill_has_the_links_of_g_2_27_and_2_28() -> None:
    """T_TOOL = W Z S C, T_WORK = Y X P; 4 axes with 6 errors and 2 directions each, 3 links with 6."""
    m = vertical_mill()
    assert m.tool_chain == ("W", "Z", "S", "C")
    assert m.work_chain == ("Y", "X", "P")
    assert len(m.components) == 4 * (6 + 2) + 3 * 6
    assert m.axis_names == ("W", "Z", "Y", "X")


def test_vertical_mill_by_hand() -> None:
    """Oracle: arms of a few errors worked out by hand from the offsets in tests/support/machines.py.

    X slide (work side) at x = 100, y = 0: frame at (1-4-100, 2+6, 110+90); tip at (8.5, 304.75, 635 + w + z).
    """
    m = vertical_mill()
    w, z, x = 10.0, 20.0, 100.0
    jacobian = dict(zip(m.components, m.chain.jacobian([w, z, 0.0, x]).T, strict=True))
    tip = np.array([3 + 5 + 0.5, -20 + 310 + 15 - 0.25, 900 - 40 - 130 - 95 + w + z])
    from_x = tip - np.array([1 - 4 - x, 2 + 6, 110 + 90])
    np.testing.assert_allclose(jacobian["EBX"], np.array([from_x[2], 0.0, -from_x[0]]) * URAD_MM, rtol=1e-12)
    np.testing.assert_allclose(jacobian["EBW"], np.array([-40 + z - 130 - 95, 0.0, -5.5]) * URAD_MM, rtol=1e-12)
    np.testing.assert_allclose(jacobian["EZ0P"], [0.0, 0.0, -1.0])
    np.testing.assert_allclose(jacobian["EZ0C"], [0.0, 0.0, 1.0])
    from_pallet = from_x - np.array([40.0, 25.0, 60.0])
    np.testing.assert_allclose(jacobian["EA0P"], np.array([0.0, from_pallet[2], -from_pallet[1]]) * URAD_MM, rtol=1e-12)


@pytest.mark.parametrize("build", ALL)
def test_each_component_alone_appears_where_the_chain_says_and_only_there(build: Callable[[], Machine]) -> None:
    """Oracle: complex-step derivative of the bodies' product, every component, several poses; zeros are zero."""
    m = build()
    for pose in POSES[m.name]:
        wanted = arms_by_complex_step(m, np.array(pose))
        got = m.chain.jacobian(pose)
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-15)
        assert np.all(wanted[got == 0.0] == 0.0)


@pytest.mark.parametrize("build", ALL)
def test_each_component_alone_through_a_model(build: Callable[[], Machine]) -> None:
    """A constant effect on one component: that component alone, and the tip error of `exact_tip_error_um`.

    Oracle: the odd part of the exact product, which has no second-order terms.
    """
    m = build()
    pose = np.array(POSES[m.name][-1])
    for column, name in enumerate(m.components):
        effect = effect_class("squareness", "test").model_validate({"effect": "squareness", "component": name})
        model = Model(m, (FittedEffect(effect, {"alpha": 7.0}),))
        state = model.state(np.zeros(1), {a.channel: np.array([q]) for a, q in zip(m.axes, pose, strict=True)})
        wanted = np.zeros(len(m.components))
        wanted[column] = 7.0
        np.testing.assert_array_equal(model.components(state)[0], wanted)
        exact = (exact_tip_error_um(m, pose, {name: 7.0}) - exact_tip_error_um(m, pose, {name: -7.0})) / 2
        np.testing.assert_allclose(model.predict(state)[0], exact, rtol=1e-6, atol=1e-8)


@st.composite
def machines(draw: st.DrawFn) -> tuple[Machine, Floats]:
    """Serial machine of 1-5 axes with up to 5 fixed links, in any order on both sides, and a pose; arms below 1 m."""
    n_axes = draw(st.integers(1, 5))
    names = [*(f"A{i}" for i in range(n_axes)), *(f"L{i}" for i in range(draw(st.integers(0, 5))))]
    order = draw(st.permutations(names))
    cut = draw(st.integers(1, len(order)))
    offset = st.lists(st.floats(-40, 40), min_size=3, max_size=3)
    directions = draw(st.lists(st.sampled_from("XYZ"), min_size=n_axes, max_size=n_axes))
    m = machine(
        "random",
        order[:cut],
        order[cut:],
        {f"A{i}": axis(d, draw(offset), compensate=False) for i, d in enumerate(directions)},
        {name: draw(offset) for name in names[n_axes:]},
    )
    return m, np.array(draw(st.lists(st.floats(-100, 100), min_size=n_axes, max_size=n_axes)))


@settings(max_examples=60, deadline=None)
@given(machines())
def test_chain_is_the_derivative_of_any_serial_machine(case: tuple[Machine, Floats]) -> None:
    """Oracle: complex-step derivative of the independent product."""
    m, pose = case
    np.testing.assert_allclose(m.chain.jacobian(pose), arms_by_complex_step(m, pose), rtol=1e-9, atol=1e-13)


def second_order_bound_um(m: Machine, errors: Mapping[str, float], pose: Floats) -> float:
    """Most that all pairs ε₁ × (ε₂ × arm) and ε × δ can come to; the third order adds less than 1 %."""
    links = {f"0{n}" for n in m.links}
    turns = {k: abs(v) for k, v in errors.items() if k[1] in "ABC"}
    turn = sum(v for k, v in turns.items() if k[2] != "0" or k[2:] in links)
    tilt = sum(v for k, v in turns.items() if k[2] == "0" and k[2:] not in links)
    move = sum(abs(v) for k, v in errors.items() if k[1] in "XYZ")
    offsets = [*(a.offset_mm for a in m.axes), *(link.offset_mm for link in m.links.values())]
    reach_mm = float(sum(np.linalg.norm(o) for o in offsets) + np.abs(pose).sum())
    most = float(np.abs(pose).max(initial=0.0))
    return float(1.01 * turn * 1e-6 * (turn * 1e-3 * reach_mm + move + tilt * 1e-3 * most) + 1e-9)


@settings(max_examples=60, deadline=None)
@given(machines(), st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_chain_equals_the_exact_product_to_second_order(case: tuple[Machine, Floats], seed: int, count: int) -> None:
    """Errors to 50 µm and 50 µrad. Oracle: `exact_tip_error_um`; what is left is within the second-order bound.

    And it is of second order: the odd part of the exact product has no squares and meets the chain to 0.01 nm.
    """
    m, pose = case
    rng = np.random.default_rng(seed)
    names = [str(n) for n in rng.choice(m.components, count)]
    errors = {name: float(rng.uniform(-50, 50)) for name in names}
    linear = m.chain.tip_error_um(pose, [errors.get(c, 0.0) for c in m.components])
    plus = exact_tip_error_um(m, pose, errors)
    minus = exact_tip_error_um(m, pose, {k: -v for k, v in errors.items()})
    assert np.abs(plus - linear).max() <= second_order_bound_um(m, errors, pose)
    np.testing.assert_allclose((plus - minus) / 2, linear, rtol=0, atol=1e-5)


def test_one_pair_of_errors_at_one_metre_is_a_few_nanometres_off() -> None:
    """50 µrad twice at 1 m: 2.5 nm by hand (ε² · arm), and one rotation alone on the tool side: nothing."""
    m = machine("arm", ["X", "Y", "tool"], [], {"X": axis("X"), "Y": axis("Y")}, {"tool": [1000.0, 0.0, 0.0]})
    pose = np.zeros(2)

    def left_over_nm(errors: dict[str, float]) -> Floats:
        linear = m.chain.tip_error_um(pose, [errors.get(c, 0.0) for c in m.components])
        return np.asarray((exact_tip_error_um(m, pose, errors) - linear) * 1e3)

    np.testing.assert_allclose(left_over_nm({"EBX": 50.0}), 0.0, atol=1e-6)
    np.testing.assert_allclose(left_over_nm({"EBX": 50.0, "EBY": 50.0}), [-2.5, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("extra", [(0.0, 0.0, 0.0), (0.0, 150.0, 80.0), (-33.0, 7.0, -250.0)])
def test_a_point_beside_the_tool_tip_is_a_longer_tool(extra: tuple[float, float, float]) -> None:
    """Oracle: odd part of the exact product of a machine with one more fixed link of that length at the tip."""
    longer, m = turning_centre(probe_mm=extra), turning_centre()
    pose = np.array([77.0, 301.0])
    got = m.chain.jacobian(pose, extra_tool_mm=extra)
    for column, name in enumerate(m.components):
        exact = exact_tip_error_um(longer, pose, {name: 1.0}) - exact_tip_error_um(longer, pose, {name: -1.0})
        np.testing.assert_allclose(got[:, column], exact / 2, rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("build", ALL)
def test_lever_arms_are_affine_in_the_positions(build: Callable[[], Machine]) -> None:
    """Oracle: the definition, on random pairs of poses; and many poses at once are the same as one by one."""
    m = build()
    rng = np.random.default_rng(3)
    a, b = rng.uniform(-500, 500, (2, 20, len(m.axes)))
    t = rng.uniform(-2, 3, (20, 1))
    mixed = m.chain.jacobian(t * a + (1 - t) * b)
    np.testing.assert_allclose(
        mixed, t[..., None] * m.chain.jacobian(a) + (1 - t[..., None]) * m.chain.jacobian(b), atol=1e-12
    )
    np.testing.assert_array_equal(m.chain.jacobian(a), np.stack([m.chain.jacobian(pose) for pose in a]))
    errors = rng.uniform(-50, 50, (20, len(m.components)))
    singles = np.stack([m.chain.tip_error_um(pose, e) for pose, e in zip(a, errors, strict=True)])
    np.testing.assert_allclose(m.chain.tip_error_um(a, errors), singles, rtol=1e-12)


def test_units_follow_the_second_letter() -> None:
    chain = turning_centre().chain
    assert {c: chain.unit(c) for c in ("EXX", "EAX", "EC0X", "EZ0spindle", "EB0spindle")} == {
        "EXX": "um", "EAX": "urad", "EC0X": "urad", "EZ0spindle": "um", "EB0spindle": "urad",
    }  # fmt: skip
