"""A model's numbers from other readings are evidence, too. Oracle: what the readings of a third day were made of.

On the day of the fit nothing was warm. On the next, bed and head warm alike: the readings of that day alone cannot tell
which of them stretches the scale. But one of them does so beside the scale that the model knows, and the other only
beside a scale that is far from it.
"""

from functools import cache

import numpy as np
import pytest

from rtec.characterise import fitted_model
from rtec.diagnosis.extend.improve import Improved, ProposedStep, improve
from rtec.diagnosis.result import Finding
from rtec.effects.effect_list import read_wanted
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.machines import axis

NOISE_UM, REFERENCE_DEGC = 0.4, 20.0
SCALE, BACKLASH, ALPHA = 12.0, 3.0, 11.0
MACHINE = machine_from(
    {
        "machine": {"name": "mill", "tool_chain": ["head"], "work_chain": ["X", "table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 700.0])},
        "link": {"head": {}, "table": {}},
        "temperature": {"T_bed": {}, "T_head": {}},
    },
    "mill",
)


def day(name: str, seed: int, bed_degc: float, head_degc: float, cause: str, rises: float = 4.0) -> Measurement:
    """Twelve runs of a laser there and back; the bed warms by `rises` from its start, the head by twice as much."""
    rng = np.random.default_rng(seed)
    places = np.linspace(20.0, 680.0, 18)
    run, x, way = (
        np.concatenate([np.repeat(r, 36) for r in range(1, 13)]),
        np.tile(np.concatenate([places, places[::-1]]), 12),
        np.tile(np.repeat([1.0, -1.0], 18), 12),
    )
    time_s = 25.0 * np.arange(len(run)) + 600.0 * run
    warm = 1.0 - np.exp(-time_s / 6000.0)
    true = {"T_bed": bed_degc + rises * warm, "T_head": head_degc + 2.0 * rises * warm}
    rise = true[cause] - REFERENCE_DEGC if cause else np.zeros(len(run))
    reading = 1e-3 * x * (SCALE + ALPHA * rise) + 0.5 * BACKLASH * way + NOISE_UM * rng.normal(size=len(run))
    read = {k: np.round(v + 0.03 * rng.normal(size=len(run)), 1) for k, v in true.items()}
    instrument = make_instrument("laser_linear", {}, "X", "EXX", MACHINE, name)
    return Measurement(
        name=name, machine=MACHINE, instrument=instrument, run=run, time_s=time_s,
        channels={"x": x, "d_x": way, **read}, readings={"reading_um": reading},
    )  # fmt: skip


@cache
def known() -> Model:
    cold = day("cold", 1, REFERENCE_DEGC, REFERENCE_DEGC, "", rises=0.0)
    return fitted_model([cold], wanted=read_wanted("scale,backlash", MACHINE))


def improved(cause: str, **more: object) -> Improved:
    return improve(known(), [day("today", 2, 23.0, 24.0, cause)], draws=50, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("cause", ["T_bed", "T_head"])
def test_the_known_scale_tells_which_of_two_temperatures_it_is(cause: str) -> None:
    done = improved(cause)
    assert done.refit is None
    assert done.steps[0].labels == (f"axis_expansion(EXX, X, {cause})",)
    third = clean([day("third", 3, 18.0, 24.0, cause)], REFERENCE_DEGC)
    assert Judgement(done.model, third).residual < 2.0 * NOISE_UM < 0.2 * Judgement(known(), third).residual


@pytest.mark.parametrize("cause", ["T_bed", "T_head"])
def test_who_is_asked_is_asked_about_that_one_first(cause: str) -> None:
    asked: list[str] = []

    def ask(step: ProposedStep) -> Finding | None:
        asked.append(step.finding.effect.label)
        return None

    improved(cause, ask=ask, ask_made=lambda _: True)
    assert asked == [f"axis_expansion(EXX, X, {cause})"]
