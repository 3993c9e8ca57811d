"""Circles of one feed: the speed of an axis is a function of its place, and no effect of the speed is the only answer.

Oracle: what was made: a scale of Z with a kink at the centre, a guide that lifts with the speed.
"""

from collections.abc import Sequence
from functools import cache

import pytest

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.one_feed import by_speed, of_places, speed_of_place
from rtec.diagnosis.words import indistinguishable
from rtec.effects.expression import expression_from_text
from rtec.estimation.readings import read
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from tests.support.diagnosis_examples import QUICK, effects, laser, small_machine

BASE = ("scale,component=EXX,axis=X,k=12", "scale,component=EZZ,axis=Z,k=-8", "squareness,component=EB0Z,alpha=25",
        "backlash,component=EXX,axis=X,B=2")  # fmt: skip
LIFT = "guide_lift,component=EBX,axis=X,A=300,q=1"
KINK = "A*(0.06*max(z - 100, 0))"
"""Of 60 µm/m beyond the centre of the circle: with the scale that is refitted, |z - 100|, as the speed of X."""
TEST = "the same circle at another feed"


def circles(
    hidden: Sequence[FittedEffect], feeds: Sequence[float], radii: Sequence[float] = (80.0,)
) -> list[Measurement]:
    truth = Model(small_machine(), (*effects(*BASE), *hidden), name="truth")
    settings = Settings.model_validate({**QUICK, "noise": {"white_um": 0.15}, "protocol": "cold"})
    out: list[Measurement] = []
    for feed in feeds:
        for radius in radii:
            for sense in ("cw", "ccw"):
                setup = {"plane": "XZ", "centre_mm": [100.0, 0.0, 100.0], "radius_mm": radius, "direction": sense,
                         "feed_mm_min": feed}  # fmt: skip
                bar = make_instrument("ball_bar", setup, None, None, small_machine(), "test")
                name = f"circle-{sense}-{feed:g}-{radius:g}"
                out.append(simulate(truth, bar, settings, 1 + len(out), name))
    return out


@cache
def found(what: str, *feeds: float) -> Diagnosis:
    kink = expression_from_text(KINK, [], "EZZ", small_machine())
    hidden = effects(LIFT) if what == "lift" else (FittedEffect(kink, {"A": 1.0}, {}),)
    return diagnose(Model(small_machine(), effects(*BASE), name="base"), circles(hidden, feeds), draws=50, explain=True)


def test_an_error_of_the_place_is_no_effect_of_the_speed() -> None:
    """Its curve of the speed had been the only one that was asserted, with more than 99.9 %."""
    d = found("kink", 1000.0)
    assert d.verdict == "ambiguous"
    assert d.findings[0].effect.component == "EZZ"
    assert of_places(d.findings[0].effect, read(circles((), (1000.0,)), smooth=False))
    assert "guide_lift(EZX, X)" in indistinguishable(d)
    assert TEST in d.sentence
    lift = next(f for f in d.findings if f.label == "guide_lift(EZX, X)")
    assert lift.confidence <= d.findings[0].confidence


def test_an_effect_of_the_speed_is_not_asserted_at_one_feed() -> None:
    d = found("lift", 1000.0)
    assert d.verdict == "ambiguous"
    assert indistinguishable(d) == ["guide_lift(EBX, X)", "an error along X"]
    assert TEST in d.sentence


def test_two_feeds_tell_a_lift_from_an_error_of_the_place() -> None:
    d = found("lift", 1000.0, 3000.0)
    assert d.verdict == "missing_effect"
    assert d.findings[0].label == "guide_lift(EBX, X)"
    assert d.findings[0].parameters["q"].value == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("feeds", "radii", "one"),
    [((1000.0,), (80.0,), True), ((1000.0, 2000.0), (80.0,), False), ((1000.0,), (80.0, 50.0), False)],
)
def test_the_speed_is_a_function_of_the_place_at_one_feed_and_radius(
    feeds: tuple[float, ...], radii: tuple[float, ...], one: bool
) -> None:
    """Oracle: |v| is the feed times the sine of the angle."""
    readings = read(circles((), feeds, radii), smooth=False)
    assert [speed_of_place(readings, a) for a in small_machine().axes] == [one, one]


def test_a_laser_stands_still_at_its_targets() -> None:
    readings = read([laser([BASE[0]], 1)], smooth=False)
    assert not any(speed_of_place(readings, a) for a in readings.machine.axes)
    (lag, lift) = effects("servo_lag,component=EXX,axis=X,tau=1", LIFT)
    assert by_speed(lift.effect)
    assert not by_speed(lag.effect)  # it changes its sign with the sense of rotation
