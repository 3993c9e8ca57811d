"""What may be missing besides the first effect is fitted and judged beside it, not alone.

Oracle: what was made: a scale error of X and a backlash of Y, on circles of a machine whose model has no effect yet.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import pytest

import rtec
from rtec.diagnosis.result import Diagnosis, Finding
from rtec.estimation.readings import looked_at, read
from rtec.metrology.measurement import Measurement
from tests.support.setups import CONFIGS

MILL = CONFIGS / "machines" / "vertical-mill.toml"
SCALE, BACKLASH = "scale,component=EXX,axis=X,k=60", "backlash,component=EYY,axis=Y,B=6"
ORDERS = (("ccw", "cw"), ("cw", "ccw"))

pytestmark = pytest.mark.xdist_group("beside")


def circle(direction: str) -> Measurement:
    setup = {"plane": "XY", "centre_mm": [250.0, 200.0, 100.0], "radius_mm": 150.0, "direction": direction,
             "feed_mm_min": 1000.0}  # fmt: skip
    few = {"cycles": 2}
    made = rtec.simulate(MILL, "ball_bar", setup=setup, effects=[SCALE, BACKLASH], changes=few, seed=4)
    return replace(made.measurement, name=direction)


@cache
def found(order: Sequence[str] = ORDERS[0]) -> Diagnosis:
    return rtec.diagnose(MILL, [circle(d) for d in order])


def besides(of: Diagnosis) -> list[Finding]:
    return [f for f in of.findings if "may be missing too" in f.why_not]


@pytest.mark.parametrize("order", ORDERS)
def test_the_likeliest_besides_is_so_beside_the_first(order: Sequence[str]) -> None:
    """A lost motion over 86 mm, which takes up a part of the scale, had more than 99.9 %."""
    d = found(order)
    first, *others = besides(d)
    assert d.findings[0].label == "scale(EXX, X)"
    assert first.label == "backlash(EYY, Y)"
    assert "lost_motion(EYY, Y)" not in [f.label for f in others]
    assert "backlash(EYY, Y)" in d.sentence


def test_the_order_of_the_files_changes_nothing() -> None:
    """The verdict, and the first name with it, had turned."""
    one, other = (found(order) for order in ORDERS)
    assert one.sentence == other.sentence
    assert [f.label for f in one.findings] == [f.label for f in other.findings]
    assert [f.log_evidence for f in one.findings] == pytest.approx([f.log_evidence for f in other.findings], abs=0.01)


def test_the_first_look_draws_the_same_readings_in_any_order() -> None:
    """Oracle: what it draws of each file, by name."""
    drawn = []
    for order in ORDERS:
        readings = read([circle(d) for d in order])
        keep = looked_at(readings)
        assert not keep.all()
        drawn.append({readings.measurements[s.source].name: keep[s.part].tobytes() for s in readings.series})
    assert drawn[0] == drawn[1]


def test_its_number_and_its_share_are_those_beside_the_first() -> None:
    """Of what a scale and a backlash make together, the first leaves noise and the backlash: 0.3 and 2.12 µm."""
    first = besides(found())[0]
    number = first.parameters["B"]
    assert number.se is not None
    assert number.value == pytest.approx(6.0, abs=3.0 * number.se)
    reversal = 6.0 * math.sqrt(0.125)
    assert first.heldout_drop == pytest.approx(1.0 - 0.3**2 / (0.3**2 + reversal**2), abs=0.02)


def test_each_is_said_to_be_missing_only_where_it_predicts_better_beside_the_first() -> None:
    d = found()
    assert all(f.heldout_drop > 0.0 for f in besides(d))
    assert {a.label for a in d.findings[0].confused_with if a.apart} == {f.label for f in besides(d)}


def test_a_size_that_no_machine_has_is_no_rival() -> None:
    """Oracle: arithmetic. On a circle of one feed a scale of 60 µm/m is a deflection by 4850 µm per m/s²."""
    d = found()
    inertia = next(f for f in d.findings if f.label == "inertia(EXX, X)")
    assert abs(inertia.parameters["k"].value) == pytest.approx(60.0 / (1000.0 / 60.0 / 150.0) ** 2, rel=0.01)
    assert "no machine has" in inertia.why_not
    assert "inertia" not in d.sentence
