"""What an instrument reads is a curve in its own direction, never an angle behind the arm that comes with it.

Oracle: what was added to the readings, a profile along X. A pitch of as much would move the tool along Z as well.
"""

from dataclasses import replace
from typing import Any

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


def offered(*measurements: Measurement) -> set[tuple[str, str]]:
    """Effects and components that a free choice is offered."""
    sources = [Source.of(m, b) for m, b in zip(measurements, cuts(measurements), strict=True)]
    return {(c.effect, c.component) for c in screen(sources).candidates if c.offered}


def test_an_angle_is_a_choice_only_where_two_arms_show_it() -> None:
    """Oracle: geometry. At one height a pitch is a shift times a constant; a second name had been free of the limits of
    the first, and the two grew against each other."""
    assert not {c for _, c in offered(at_height(80.0, 1)) if c[1] in "ABC"}
    assert {"EXX", "EBX"} <= {c for _, c in offered(at_height(80.0, 1), at_height(200.0, 2))}


ROUTER = machine_from(
    {
        "machine": {"name": "router", "tool_chain": ["Y", "X", "Z", "tool"], "work_chain": ["table"]},
        "axis": {
            name: {"direction": name, "travel_mm": [0.0, travel], "counts_per_mm": 1000.0, "pitch_mm": 10.0}
            for name, travel in (("X", 600.0), ("Y", 900.0), ("Z", 200.0))
        },
        "link": {"tool": {"offset_mm": [0.0, 0.0, -80.0]}, "table": {"offset_mm": [0.0, 0.0, 0.0]}},
        "temperature": {name: {"range_degc": [0.0, 80.0]} for name in ("T_x_screw", "T_y_screw", "T_gantry", "T_room")},
    },
    "router",
)
WARMING = Model(
    ROUTER,
    tuple(
        effect_from_text(text, ROUTER)
        for text in (
            "scale,component=EXX,axis=X,k=35", "backlash,component=EXX,axis=X,B=6",
            "axis_expansion,component=EXX,axis=X,sensor=T_x_screw,k=11.5",
            "scale,component=EYY,axis=Y,k=-28", "backlash,component=EYY,axis=Y,B=4",
            "axis_expansion,component=EYY,axis=Y,sensor=T_y_screw,k=11.5", "squareness,component=EC0Y,alpha=25",
        )
    ),
    name="truth",
)  # fmt: skip
BAR: dict[str, Any] = {"plane": "XY", "direction": "ccw", "centre_mm": [300.0, 400.0, 100.0], "radius_mm": 150.0}


def read(name: str, seed: int, axis: str | None = None, **setup: Any) -> Measurement:
    """A measurement of the router: lasers read it while it warms up, a ball bar takes minutes."""
    instrument = make_instrument(name, setup, axis, None, ROUTER, "test")
    settings = Settings.model_validate({} if name == "ball_bar" else {"targets": {"step_mm": 61.3}})
    return simulate(WARMING, instrument, settings, seed, f"{name}-{axis or ''}-{seed}")


def usual(seed: int) -> list[Measurement]:
    """The usual set: two lasers and one circle."""
    bar = read("ball_bar", seed + 4, feed_mm_min=1000.0, **BAR)
    return [read("laser_linear", seed, "X"), read("laser_linear", seed + 1, "Y"), bar]


@pytest.mark.parametrize("seed", proof.few([1, 11, 21], 1))
def test_a_circle_at_one_temperature_shows_no_expansion_of_an_angle(seed: int) -> None:
    """Oracle: the machine. Elsewhere the angle's second name for the shift of Y had been worse than no model."""
    found = characterise(usual(seed)).model.effects
    assert {f.effect.component for f in found if f.effect.effect == "axis_expansion"} == {"EXX", "EYY"}
    assert not {f.effect.effect for f in found} & {"bed_bending", "axis_expansion_nonuniform"}


def test_a_temperature_drives_only_what_was_seen_while_it_varied() -> None:
    """Oracle: geometry. The circle has all arms at one temperature: it shows constant angles and no growth of
    them. A second laser at another arm, which warms up as well, shows that."""
    once = offered(*usual(1))
    twice = offered(*usual(1), read("laser_linear", 7, "Y", beam_offset_mm=[200.0, 0.0, 0.0]))
    assert ("polynomial_position", "ECY") in once
    assert not {("axis_expansion", "ECY"), ("mount_expansion", "ECY"), ("axis_expansion", "EXY")} & once
    assert not {e for e, _ in once} & {"bed_bending"}
    assert ("axis_expansion", "ECY") in twice
