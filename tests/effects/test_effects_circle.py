"""What effects of single axes draw in a ball bar: the table of the ball-bar literature comes out, it is not put in.

Oracles: the closed forms of [BB], written here for a circle in X and Y about the centre, radius R, bar length R,
angle ζ, sense ω: radial error = e_x cos ζ + e_y sin ζ.
"""

from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.effects import EFFECTS, State
from rtec.machine import Machine
from tests.support.machines import bridge

Floats = NDArray[np.float64]
MACHINE: Machine = bridge()
RADIUS_MM = 150.0
ZETA = np.linspace(0.0, 2 * np.pi, 721)


def circle(rad_s: float) -> State:
    """A circle; anticlockwise for a positive speed."""
    x, y = RADIUS_MM * np.cos(ZETA), RADIUS_MM * np.sin(ZETA)
    channels: Mapping[str, Floats] = {
        "x": x, "y": y, "v_x": -rad_s * y, "v_y": rad_s * x, "a_x": -(rad_s**2) * x, "a_y": -(rad_s**2) * y,
        "d_x": -np.sign(rad_s * y), "d_y": np.sign(rad_s * x),
    }  # fmt: skip
    return State(MACHINE, np.linspace(0.0, 2 * np.pi / abs(rad_s), len(ZETA)), channels)


def radial(s: State, effect: str, x: float, y: float) -> Floats:
    """Radial error of an effect in both axes with these coefficients."""
    out = np.zeros(len(s))
    for axis, size, arm in (("X", x, np.cos(ZETA)), ("Y", y, np.sin(ZETA))):
        given = {"effect": effect, "component": f"E{axis}{axis}", "axis": axis}
        (value,) = EFFECTS[effect].model_validate(given).basis(MACHINE, s, {})
        out += size * value * arm
    return out


@pytest.mark.parametrize("rad_s", [0.2, -0.2, 1.5])
def test_servo_phase_is_sin_2_zeta_and_turns_over_with_the_sense(rad_s: float) -> None:
    """[BB]: -sgn(ω) r² ψ sin 2ζ / 2L with r = L; a lag of τ is a phase of ψ = |ω| τ."""
    tau_um_s_per_mm = 0.04
    psi = abs(rad_s) * tau_um_s_per_mm * 1e-3
    wanted_um = -np.sign(rad_s) * RADIUS_MM * psi * np.sin(2 * ZETA) / 2 * 1e3
    np.testing.assert_allclose(
        radial(circle(rad_s), "servo_phase", tau_um_s_per_mm, -tau_um_s_per_mm), wanted_um, atol=1e-9
    )


@pytest.mark.parametrize("rad_s", [0.2, -1.5])
def test_change_over_steps_at_45_degrees_and_turns_over_with_the_sense(rad_s: float) -> None:
    """The slower axis comes late by τ < 0: `-½ τ ω R sin 2ζ` while X is slower, its opposite while Y is."""
    tau_um_s_per_mm = -0.05
    error = np.zeros(len(ZETA))
    for axis, other, arm in (("X", "Y", np.cos(ZETA)), ("Y", "X", np.sin(ZETA))):
        given = {"effect": "change_over", "component": f"E{axis}{axis}", "axis": axis, "other": other}
        (value,) = EFFECTS["change_over"].model_validate(given).basis(MACHINE, circle(rad_s), {})
        error += tau_um_s_per_mm * value * arm
    wanted_um = -0.5 * tau_um_s_per_mm * rad_s * RADIUS_MM * np.sin(2 * ZETA) * np.sign(np.cos(2 * ZETA))
    away = np.abs(np.cos(2 * ZETA)) > 1e-6
    np.testing.assert_allclose(error[away], wanted_um[away], atol=1e-9)


def test_the_same_lag_in_both_axes_draws_nothing() -> None:
    """Both axes late by the same time: the circle is drawn late, and is a circle (to first order)."""
    assert np.abs(radial(circle(0.7), "servo_lag", 0.04, 0.04)).max() < 1e-9


def test_a_pair_of_phases_is_a_pair_of_half_lags() -> None:
    one = radial(circle(0.7), "servo_phase", 0.04, -0.04)
    np.testing.assert_allclose(one, radial(circle(0.7), "servo_lag", 0.02, -0.02), atol=1e-12)


def test_scale_mismatch_is_an_oval_that_does_not_turn_over() -> None:
    """`½ (k_x + k_y) R + ½ (k_x - k_y) R cos 2ζ`, whatever the sense."""
    wanted_um = (0.5 * 30.0 + 0.5 * 10.0 * np.cos(2 * ZETA)) * RADIUS_MM * 1e-3
    for rad_s in (0.2, -0.2):
        np.testing.assert_allclose(radial(circle(rad_s), "scale", 20.0, 10.0), wanted_um, atol=1e-9)


def test_inertia_grows_with_the_square_of_the_speed_at_one_radius() -> None:
    """A circle under its own acceleration is smaller or larger by `k ω² R`."""
    for rad_s in (0.5, 2.0):
        wanted_um = -3.0 * rad_s**2 * RADIUS_MM * 1e-3
        np.testing.assert_allclose(radial(circle(rad_s), "inertia", 3.0, 3.0), wanted_um, atol=1e-9)


def test_backlash_steps_at_the_quadrants() -> None:
    """`½ B_x sgn(v_x) cos ζ + …`: steps of B where an axis turns round, at 0°, 90°, 180°, 270°."""
    error = radial(circle(0.2), "backlash", 4.0, 0.0)
    away = np.abs(np.sin(ZETA)) > 1e-9
    np.testing.assert_allclose(error[away], (-2.0 * np.sign(np.sin(ZETA)) * np.cos(ZETA))[away], atol=1e-9)
