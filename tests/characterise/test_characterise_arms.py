"""What an instrument reads is a curve in its own direction, never an angle behind the arm that comes with it.

Oracle: what was added to the readings, a profile along X. A pitch of as much would move the tool along Z as well.
"""

from dataclasses import replace

import numpy as np
import pytest

from rtec.characterise.run import characterise
from rtec.characterise.screen import screen
from rtec.estimation.gram.source import Source
from rtec.estimation.held_out import cuts
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.diagnosis_examples import QUICK, TABLE

PLAIN = (
    "scale,component=EXX,axis=X,k=20", "backlash,component=EXX,axis=X,B=2",
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9",
)  # fmt: skip
MILL = machine_from(
    {
        **TABLE,
        "machine": {"name": "mill", "tool_chain": ["Z", "tool"], "work_chain": ["X", "workpiece"]},
        "link": {"tool": {"offset_mm": [0.0, 0.0, -120.0]}, "workpiece": {"offset_mm": [0.0, 0.0, 0.0]}},
    },
    "mill",
)


@pytest.mark.parametrize("seed", proof.few([1, 2, 3], 1))
def test_a_rough_profile_over_few_targets_is_no_pitch(seed: int) -> None:
    """Nine numbers and a scale are too many for eighteen targets, by whichever name."""
    instrument = make_instrument("laser_linear", {"beam_offset_mm": [0.0, 0.0, 0.0]}, "X", None, MILL, "test")
    truth = Model(MILL, tuple(effect_from_text(t, MILL) for t in PLAIN), name="truth")
    m = simulate(truth, instrument, Settings.model_validate({**QUICK, "targets": {"step_mm": 10.7}}), seed, "laser")
    knots = np.linspace(5.0, 195.0, 9)
    rough = np.interp(m.channels["x"], knots, 3.0 * np.random.default_rng(seed).normal(size=len(knots)))
    m = replace(m, readings={"reading_um": m.readings["reading_um"] + rough})
    assert {f.effect.component for f in characterise([m]).model.effects} == {"EXX"}


def at_height(up_mm: float, seed: int) -> Measurement:
    """A laser along X of the plain machine, its beam that far above the tool tip."""
    beam = make_instrument("laser_linear", {"beam_offset_mm": [0.0, 0.0, up_mm]}, "X", None, MILL, "test")
    truth = Model(MILL, tuple(effect_from_text(t, MILL) for t in PLAIN), name="truth")
    return simulate(truth, beam, Settings.model_validate(QUICK), seed, f"laser-{up_mm:g}")


def test_an_angle_is_a_choice_only_where_two_arms_show_it() -> None:
    """Oracle: geometry. At one height a pitch is a shift times a constant; a second name had been free of the limits of
    the first, and the two grew against each other."""

    def offered(*measurements: Measurement) -> set[str]:
        sources = [Source.of(m, b) for m, b in zip(measurements, cuts(measurements), strict=True)]
        return {c.component for c in screen(sources).candidates if c.offered}

    assert not {c for c in offered(at_height(80.0, 1)) if c[1] in "ABC"}
    assert {"EXX", "EBX"} <= offered(at_height(80.0, 1), at_height(200.0, 2))
