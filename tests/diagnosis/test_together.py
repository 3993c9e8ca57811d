"""Several effects that are missing together on a ball bar; oracle: the mechanism of [BB], written down by hand."""

import functools
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from rtec.diagnosis.extend.improve import Improved
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.words import AMONG
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.ball_bar_dynamic import Test, moved_um, screw_machine
from tests.support.ball_bar_examples import bar, bb_reading_um, recorded
from tests.support.both import both
from tests.support.diagnosis_examples import effects, laser, small_machine

CIRCLES = (
    Test(0.0, 150.0, "ccw"),
    Test(60.0, 150.0, "cw"),
    Test(60.0, 150.0, "ccw"),
    Test(0.0, 150.0, "cw", 3000.0),
)
SQUARE = {"squareness", "guide_twist", "angular_motion"}
"""A roll that grows evenly along X is a squareness at every height of the ball."""
LAG = {"servo_lag"}
CAUSES: dict[str, tuple[dict[str, float], dict[str, float], list[set[str]]]] = {
    "two clearances": ({"dx": 3.0, "dy": 5.0}, {}, [{"backlash EXX"}, {"backlash EYY"}]),
    "a clearance and a squareness": ({"dx": 3.0, "thetax": 12e-6}, {}, [{"backlash EXX"}, SQUARE]),
    "a clearance and a delay": ({"dx": 3.0}, {"delay": 0.2}, [{"backlash EXX"}, LAG]),
    "four": (
        {"dx": 3.0, "dy": 6.0, "thetax": 18e-6},
        {"delay": 0.2},
        [{"backlash EXX"}, {"backlash EYY"}, SQUARE, LAG],
    ),
}


def circles(static: Mapping[str, float], dynamic: Mapping[str, float]) -> list[Measurement]:
    m, rng, out = screw_machine(), np.random.default_rng(4), []
    for i, t in enumerate(CIRCLES):
        instrument = bar(m, height_mm=t.h, radius_mm=t.r, direction=t.sense, feed_mm_min=t.feed)
        angle = instrument.setup.sense * np.arange(0.375, 360.0, 0.75)
        moved = moved_um(np.radians(angle), t, dynamic)
        reading = bb_reading_um(np.radians(angle), t.r, t.h, instrument.setup.sense, moved, ex=5.0, ey=5.0, **static)
        out.append(recorded(m, instrument, angle, reading + 0.2 * rng.standard_normal(len(angle)), f"test{i}"))
    return out


def base() -> Model:
    machine = screw_machine()
    return Model(machine, tuple(effect_from_text(f"scale,component=E{a}{a},axis={a},k=0", machine) for a in "XY"))


@functools.cache
def of_four() -> tuple[Diagnosis, Improved]:
    static, dynamic, _ = CAUSES["four"]
    return both(base(), circles(static, dynamic), draws=100)


@functools.cache
def answer(what: str) -> Diagnosis:
    static, dynamic, _ = CAUSES[what]
    return of_four()[0] if what == "four" else diagnose(base(), circles(static, dynamic), draws=100)


@pytest.mark.xdist_group("together")
@pytest.mark.parametrize("what", proof.few([*CAUSES][::-1], 2))
def test_each_of_several_is_named_and_nothing_that_stands_for_several(what: str) -> None:
    """A fading reversal error of one axis explains part of the clearance of the other, while that is missing."""
    causes, found = CAUSES[what][2], answer(what)
    assert len(found.together) == len(causes), found.sentence
    for cause in causes:
        assert any(is_one(m.label, cause) for m in found.together), found.sentence


@pytest.mark.xdist_group("together")
@pytest.mark.parametrize("what", ["two clearances", "four"])
def test_words_and_probabilities_of_candidates_agree(what: str) -> None:
    """Each by itself: the first of several is often less likely than what stands for several. Oracle: the odds."""
    found = answer(what)
    first, said = found.findings[0].log_evidence, set[str]()
    for f in found.findings[1:]:
        said.add(f.why_not.split(";")[0])
        if f.why_not == AMONG:
            assert f.label in {m.label for m in found.together}
        elif "as likely as rank 1" in f.why_not:
            assert abs(f.log_evidence - first) < np.log(20.0)
        elif f.why_not.startswith("likelier"):
            assert f.log_evidence - first > np.log(20.0)
    assert "likelier than rank 1 by itself" in said


def is_one(label: str, cause: set[str]) -> bool:
    """Whether a label as `backlash(EXX, X)` is of a cause."""
    effect, rest = label.split("(")
    return effect in cause or f"{effect} {rest[:3]}" in cause


@pytest.mark.xdist_group("together")
def test_improve_adds_each_and_no_other() -> None:
    causes, (_, done) = CAUSES["four"][2], of_four()
    assert done.reason == "at_floor"
    for cause in causes:
        assert any(
            f.effect.effect in cause or f"{f.effect.effect} {f.effect.component}" in cause for f in done.model.effects
        )


@pytest.mark.parametrize("seed", proof.few([63, 65], 1))
def test_a_scale_and_an_expansion_are_no_surface_without_a_name(seed: int) -> None:
    """Oracle: what was put in; position times temperature and position make a surface over both."""
    known, k = "backlash,component=EXX,axis=X,B=3", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11,fixed_mm=100"
    m = laser([known, k, "scale,component=EXX,axis=X,k=-20"], seed)
    d = diagnose(Model(small_machine(), effects(known), name="known"), [m], draws=50)
    assert d.unknown is None
    assert {x.label for x in d.together} == {"scale(EXX, X)", "axis_expansion(EXX, X, T_bed)"}


@pytest.mark.parametrize("noise_um", [0.3, 0.4])
@pytest.mark.parametrize("seed", proof.few([1, 2, 3, 4, 5], 1))
def test_a_wave_that_drowns_in_a_growth_is_named_beside_it(seed: int, noise_um: float) -> None:
    """A wave is beyond doubt, and a hundredth of the error; the growth, a drift otherwise, is nearly all of it."""
    m, rng = laser(["scale,component=EXX,axis=X,k=10"], seed), np.random.default_rng(seed)
    part = m.time_s / m.time_s[-1]
    warm = 1.5 * (np.sin(3.0 * part + 0.3 * seed) + 0.3 * np.sin(11.0 * part + seed))
    slow = np.zeros(len(m))
    for i, w in enumerate(rng.normal(0.0, noise_um * math.sqrt(1.0 - 0.9**2), len(m))):
        slow[i] = 0.9 * slow[i - 1] + w
    um = 2.0 * warm + 0.7 * np.sin(2.0 * np.pi * m.channels["x"] / 5.0 + 1.0) + slow
    channels = {**m.channels, "T_bed": np.round(16.0 * (20.0 + warm)) / 16.0}
    m = replace(m, readings={k: v + um for k, v in m.readings.items()}, channels=channels)
    found = diagnose(Model(small_machine(), effects("scale,component=EXX,axis=X,k=10"), name="m"), [m])
    assert [t.label for t in found.together] == ["mount_expansion(EXX, T_bed)", "cyclic_screw(EXX, X)"]
