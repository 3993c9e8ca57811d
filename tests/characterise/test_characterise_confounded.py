"""A free choice says what else makes the readings of what it chose; the oracle is the algebra of a circle."""

from dataclasses import replace

import pytest

from rtec.characterise import Characterisation, characterise
from tests.support.ball_bar_truth import THREE, Bar, TrueMachine, recordings

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
    assert abs(angle.value + 80.0) > 50.0, "else there is nothing to be said"
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
