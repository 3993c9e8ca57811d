"""A free choice says what else makes the readings of what it chose; the oracle is the algebra of a circle."""

from dataclasses import replace
from typing import Any

import pytest

from rtec.characterise import Characterisation, characterise
from rtec.characterise.warnings import _confounded
from rtec.effects import effect_class
from rtec.estimation.gram.stream import Term
from tests.characterise.joint_proof import MILL, Truth, laser
from tests.support.ball_bar_truth import THREE, Bar, TrueMachine, recordings
from tests.support.joint_truth import measured

UNKNOWN = [replace(b, longer_um=um) for b, um in zip(THREE, (-46.8, 12.0, 30.0), strict=True)]
SCALES = TrueMachine("tool", "XY", {"scale_a": 30.0, "scale_b": 10.0})
LATE = TrueMachine("tool", "XY", {"lean": 80.0, "lead_ms": 1.0})


def said(found: Characterisation) -> list[str]:
    return [w.text for w in found.warnings if w.code == "confounded"]


def test_bars_of_unknown_length_show_a_difference_of_scales() -> None:
    """Oracle: cos² + sin² = 1: of a circle less its mean, one scale is the other turned in sign."""
    found = characterise(recordings(SCALES, UNKNOWN, zero="setup"))
    scale = next(c for c in found.coefficients if c.effect.startswith("scale(EYY"))
    assert abs(scale.value - (10.0 - 30.0)) < 4 * scale.se  # type: ignore[operator]
    assert said(found) == [
        "scale(EYY, Y) is not determined alone: scale(EXX, X) makes the same readings; its number is that of "
        "scale(EYY, Y) - scale(EXX, X)"
    ]


def test_one_test_shows_squareness_and_servo_mismatch_as_one() -> None:
    """Oracle: a lag τ at feed v is τ v cos θ of an axis, so τ v sin θ cos θ of the bar; an angle α is α r of that."""
    found = characterise(recordings(LATE, [Bar(0.0, 150.0, "cw", 1000.0)]))
    angle = next(c for c in found.coefficients if c.effect.startswith("squareness"))
    assert abs(angle.value + 80.0) > 50.0, "else the fit has separated them"
    assert any("squareness(EC0Y) + 111 · servo_lag(EYY, Y) - 111 · servo_lag(EXX, X)" in text for text in said(found))
    assert pytest.approx(111.1, abs=0.1) == 1000.0 / 60.0 / 0.150


def test_both_senses_tell_them_apart() -> None:
    """Oracle: what was made true: with both senses squareness is found, and only the servos stay a difference."""
    found = characterise(recordings(LATE, THREE))
    angle = next(c for c in found.coefficients if c.effect.startswith("squareness"))
    assert abs(angle.value + 80.0) < 4 * angle.se  # type: ignore[operator]
    assert all(text.startswith("servo_lag") for text in said(found))


def test_known_lengths_tell_scales_apart() -> None:
    """Oracle: a bar whose length is known shows each scale; nothing is left to say of them."""
    assert not any("scale" in text for text in said(characterise(recordings(SCALES, THREE))))


def test_a_laser_tells_scales_from_servo_gains_at_one_feed() -> None:
    """Oracle: what was made true; a first-order loop with time constant τ turns short by ½ τ² for each unit of
    acceleration, which a laser at its targets does not see. Ball heights are off by what nobody knows."""
    late = TrueMachine("tool", "XY", {"scale_a": 10.0, "play_a": 3.0, "lag_ms": 20.0})
    bars = [replace(b, feed=3000.0, height_um=40.0 if b.h else 0.0) for b in THREE]
    found = {c.effect: c for c in characterise(measured(late, bars, 0.2, 1)).coefficients}
    for name, true in (("scale(EXX, X)", 10.0), ("inertia(EXX, X)", 200.0), ("inertia(EYY, Y)", 200.0)):
        assert abs(found[name].value - true) < 4 * found[name].se  # type: ignore[operator]
    assert set(found) == {"scale(EXX, X)", "inertia(EXX, X)", "inertia(EYY, Y)", "backlash(EXX, X)"}


def test_a_common_lag_is_in_the_errors_of_servo_gains() -> None:
    """Oracle: the circle of two first-order loops, `τ` and a difference `δ`, to the second order: beside ½ τ² of each
    its shape holds `τ δ` of the acceleration, one more and one less. A lag of both makes that, which no bar shows."""
    lag, lead = 22.0, 0.5
    late = TrueMachine("tool", "XY", {"lead_ms": lead, "lag_ms": lag})
    bars = [replace(b, feed=3000.0) for b in THREE]
    found = {c.effect: c for c in characterise(measured(late, bars, 0.1, 1)).coefficients}
    for name, sign in (("inertia(EXX, X)", -0.5), ("inertia(EYY, Y)", 0.5)):
        gain, true = found[name], 0.5 * (lag + sign * lead) ** 2
        assert gain.value - true == pytest.approx(2 * sign * lag * lead, rel=0.15), "else no error need hold it"
        assert gain.se == pytest.approx(lag * lead, rel=0.1)
    assert found["servo_lag(EXX, X)"].se < 0.01  # type: ignore[operator]


def test_one_radius_and_feed_leave_a_scale_open_to_a_servo_gain() -> None:
    """Oracle: `a = -v²/r² (x - x_c)` on a circle: a unit of gain is -v²/r² of scale, 0.111 (1/s)² at 3000 mm/min."""
    pair = [Bar(0.0, 150.0, sense, 3000.0) for sense in ("ccw", "cw")]
    texts = said(characterise(recordings(TrueMachine("tool", "XY", {"scale_a": 12.0}), pair)))
    assert any("scale(EXX, X) is not determined alone: inertia(EXX, X)" in text for text in texts)
    assert any("- 0.111 · inertia(EXX, X)" in text for text in texts)


def test_a_turn_that_grows_along_an_axis_is_not_told_from_a_bend() -> None:
    """Oracle: a carriage that carries the other ball and pitches by c x moves it by ½ c x² less: the reading of a bend.

    The bars cover too little of the travel to correct a bend, which is no reason to call it a pitch.
    """
    arched = TrueMachine("bridge", "XY", {"arch_a": -0.7, "play_b": 2.0})
    found = characterise(recordings(arched, THREE, 0.1, 3, 2.0))
    pitch = next(c for c in found.coefficients if c.component == "EBX")
    assert any(t.startswith(f"{pitch.effect} is not") and "polynomial_position(EZX, X)" in t for t in said(found))


def test_sensors_that_rise_together_leave_the_cause_open() -> None:
    """Oracle: a laser reads tool against workpiece: a mount that grows and a spindle that grows are one to it."""
    true = Truth(MILL, {"mount_expansion:EYY:sensor=T_column": 1.2, "scale:EYY": 12.0})
    found = characterise([laser(true, "Y", 3, False)])
    assert any(w.code == "which_part" and "mount_expansion(EYY)" in w.text for w in found.warnings)


def test_terms_of_one_effect_are_told_apart() -> None:
    """Oracle: the texts by hand: a curve by knots and a polynomial; each pair of numbers is named once."""

    def term(name: str, component: str, only: tuple[int, ...] | None = None, **more: Any) -> Term:
        table = {"effect": name, "component": component, "axis": "Y", **more}
        return Term(effect_class(name, "test").model_validate(table), only=only)

    bend = [term("polynomial_position", "EYY", degrees=(d,)) for d in (2, 3)]
    knots = [term("piecewise_position", "EAY", (i,), knots_mm=(0.0, 100.0, 200.0, 300.0)) for i in (2, 3)]
    (one,) = _confounded([(k, bend[0], share) for k, share in zip(knots, (-1.0, -1.7), strict=True)], MILL)
    assert one.text == (
        "piecewise_position(EAY, Y) is not determined alone: polynomial_position(EYY, Y) c2 makes the same readings; "
        "its numbers are those of at2 - polynomial_position(EYY, Y) c2, at3 - 1.70 · polynomial_position(EYY, Y) c2"
    )
    (one,) = _confounded([(term("scale", "EYY"), b, 2.0) for b in bend], MILL)
    assert one.text == (
        "scale(EYY, Y) is not determined alone: polynomial_position(EYY, Y) c2 and polynomial_position(EYY, Y) c3 make "
        "the same readings; its number is that of scale(EYY, Y) + 2.00 · polynomial_position(EYY, Y) c2 + "
        "2.00 · polynomial_position(EYY, Y) c3"
    )
