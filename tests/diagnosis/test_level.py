"""What a level along a bed shows. Oracle: what was put in, written in numpy; least squares where a number is asked."""

import numpy as np
import pytest

from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, small_machine

RUNS, TARGETS, NOISE_URAD = 8, 21, 0.8


def level(bend: float, lean: float, seed: int) -> Measurement:
    """A level along X, there and back in eight runs over four hours, while bed and air go their own ways.

    Args:
        bend: µrad/K at the ends of the travel, by the difference of bed and air.
        lean: µrad/K everywhere, by the same difference.
        seed: of the noise and the temperatures.
    """
    machine, rng = small_machine(), np.random.default_rng(seed)
    at = np.linspace(8.0, 192.0, TARGETS)
    x = np.tile(np.concatenate([at, at[::-1]]), RUNS)
    ways = np.tile(np.repeat([1.0, -1.0], TARGETS), RUNS)
    time_s = np.linspace(0.0, 4.0 * 3600.0, len(x))
    hours = time_s / 3600.0
    air = 20.0 + 1.5 * np.sin(hours + rng.uniform(0.0, 6.0)) + 0.02 * rng.standard_normal(len(x))
    bed = 20.0 + 4.0 * (1.0 - np.exp(-hours / 1.2)) + 0.02 * rng.standard_normal(len(x))
    u = x / 100.0 - 1.0
    values = (bend * u + lean) * (bed - air) + 2.0 * u**2 + NOISE_URAD * rng.standard_normal(len(x))
    made = make_instrument("level", {"about": "B"}, "X", None, machine, "test")
    channels = {"x": x, "d_x": ways, "T_bed": bed, "T_air": air}
    return Measurement("level", made, machine, np.repeat(np.arange(1, RUNS + 1), 2 * TARGETS), time_s, channels,
                       {"reading_urad": values})  # fmt: skip


def found(m: Measurement) -> Diagnosis:
    known = effects("angular_motion,component=EBX,axis=X,c2=0,c3=0")
    return diagnose(Model(small_machine(), known, name="known"), [m], draws=50, explain=True)


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_a_bed_that_bends_by_two_temperatures_is_named(seed: int) -> None:
    m = level(1.4, 0.0, seed)
    d = found(m)
    first = d.findings[0]
    assert d.sentence.startswith("bed_bending(EBX, X, T_bed, T_air) is missing"), d.sentence
    assert first.accepted
    assert first.label == "bed_bending(EBX, X, T_bed, T_air)"
    x, warm = m.channels["x"], m.channels["T_bed"] - m.channels["T_air"]
    u = x / 100.0 - 1.0
    columns = np.stack([np.ones_like(u), u**2, u**3, u * warm], axis=1)
    by_hand = np.linalg.lstsq(columns, m.readings["reading_urad"], rcond=None)[0][-1]
    assert first.parameters["k"].value == pytest.approx(by_hand, abs=0.1)
    assert first.parameters["k"].value == pytest.approx(1.4, abs=0.15)


@pytest.mark.parametrize("seed", proof.few(range(2), 1))
def test_a_part_that_leans_is_not_said_to_bend(seed: int) -> None:
    d = found(level(0.0, 1.4, seed))
    assert d.findings[0].accepted, d.sentence
    assert d.findings[0].effect.effect == "column_tilt", d.sentence


def test_a_bed_that_stays_as_it_is_gets_no_name() -> None:
    d = found(level(0.0, 0.0, 3))
    assert not d.findings or not d.findings[0].accepted, d.sentence
