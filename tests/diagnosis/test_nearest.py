"""Errors that no effect of the catalogue describes: `improve` adds the nearest one, or the shape, if it removes most.

Oracle: what the readings were made of, on another day.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import fitted_model
from rtec.diagnosis.extend.improve import improve
from rtec.effects.effect_list import read_wanted
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.history import improved_page
from tests.support import proof
from tests.support.machines import axis
from tests.support.warming import delayed

Floats = NDArray[np.float64]
NOISE_UM, LENGTH_MM = 0.4, 600.0
MACHINE = machine_from(
    {
        "machine": {"name": "lathe", "tool_chain": ["X", "tool"], "work_chain": ["spindle"]},
        "axis": {"X": axis("X", travel_mm=[0.0, LENGTH_MM])},
        "link": {"tool": {}, "spindle": {}},
        "temperature": {"T_nut": {}, "T_air": {}},
    },
    "lathe",
)


def half_warm(x: Floats, nut: Floats, time_s: Floats) -> Floats:
    """A screw of steel that is warm behind its nut, between 90 and 360 mm only."""
    warm = delayed(nut, time_s, 1200.0)
    return 11.5e-3 * np.clip(x - 90.0, 0.0, 270.0) * warm


def worn(x: Floats, nut: Floats, time_s: Floats) -> Floats:
    """A screw that is worn where it is used most."""
    del nut, time_s
    return np.asarray(-6.0 * np.exp(-(((x - 250.0) / 70.0) ** 2)), dtype=np.float64)


def ridge(x: Floats, nut: Floats, time_s: Floats) -> Floats:
    """What no effect comes near: a ridge that walks along the axis as it warms."""
    del time_s
    return np.asarray(6.0 * np.exp(-(((x - 100.0 - 50.0 * nut) / 60.0) ** 2)), dtype=np.float64)


def bump(x: Floats, nut: Floats, time_s: Floats) -> Floats:
    """A dent in a guideway."""
    del nut, time_s
    return np.asarray(8.0 * np.exp(-(((x - 330.0) / 40.0) ** 2)), dtype=np.float64)


def joints(x: Floats, nut: Floats, time_s: Floats) -> Floats:
    """A rack in three pieces."""
    del nut, time_s
    return np.asarray(14.0 * (x > 200.0) - 22.0 * (x > 410.0), dtype=np.float64)


def day(law: object, seed: int, duty: float) -> Measurement:
    """Fourteen runs there and back in five hours; the nut is warmed three hours by `duty` times 8 °C."""
    rng = np.random.default_rng(seed)
    places = np.linspace(15.0, 585.0, 20)
    x = np.tile(np.concatenate([places, places[::-1]]), 14)
    run = np.repeat(np.arange(1, 15), 40)
    time_s = 20.0 * np.arange(len(x)) + 500.0 * run
    nut = 8.0 * duty * delayed(np.where(time_s < 10000.0, 1.0, 0.0), time_s, 900.0)
    reading = law(x, nut, time_s) + NOISE_UM * rng.normal(size=len(x))  # type: ignore[operator]
    way = np.tile(np.repeat([1.0, -1.0], 20), 14)
    degc = {"T_nut": np.round(20.0 + nut + 0.03 * rng.normal(size=len(x)), 1), "T_air": np.full(len(x), 20.0)}
    instrument = make_instrument("laser_linear", {}, "X", "EXX", MACHINE, "day")
    return Measurement(
        name=f"day-{seed}", machine=MACHINE, instrument=instrument, run=run, time_s=time_s,
        channels={"x": x, "d_x": way, **degc}, readings={"reading_um": reading},
    )  # fmt: skip


def nothing(x: Floats, nut: Floats, time_s: Floats) -> Floats:
    """No error."""
    del nut, time_s
    return np.zeros(len(x))


@cache
def start(fitted: bool) -> Model:
    """An empty model, or one that was fitted before the error was there."""
    if not fitted:
        return Model(MACHINE, (), name="empty")
    return fitted_model([day(nothing, 9, 1.0)], wanted=read_wanted("scale,backlash", MACHINE))


@pytest.mark.parametrize(
    ("law", "most", "fitted"),
    proof.few([(half_warm, 0.35, True), (worn, 0.3, False), (half_warm, 0.35, False), (worn, 0.3, True)], 2),
)
def test_the_nearest_is_added_where_it_removes_most(law: object, most: float, fitted: bool) -> None:
    done = improve(start(fitted), [day(law, 1, 1.0)], draws=50)
    assert done.diagnoses[0].verdict == "unknown_effect"
    assert "this is the nearest" in " ".join(done.steps[0].notes)
    assert f"{done.steps[0].labels[0]}: only the nearest of the catalogue" in improved_page(done, figures=False).lead
    other = clean([day(law, 2, 0.5)], 20.0)
    assert Judgement(done.model, other).residual < most * Judgement(start(fitted), other).residual


def test_what_has_no_near_effect_gets_none() -> None:
    done = improve(Model(MACHINE, (), name="empty"), [day(ridge, 3, 1.0)], draws=50)
    assert (done.reason, done.steps) == ("unknown_effect", ())
    page = improved_page(replace(done, files=(Path("model.toml"), Path("day.csv"))), figures=False)
    assert page.next[0].startswith("rtec add model.toml --expr ")


@pytest.mark.parametrize("law", [bump, joints])
def test_the_shape_is_added_where_no_effect_is_as_good(law: object) -> None:
    done = improve(Model(MACHINE, (), name="empty"), [day(law, 1, 1.0)], draws=50)
    assert done.diagnoses[0].verdict == "unknown_effect"
    assert [f.effect.effect for f in done.model.effects] == ["expression"]
    assert "names no cause" in done.steps[0].notes[0]
    assert "expression(EXX) is the shape of what no effect of the catalogue" in improved_page(done, figures=False).lead
    other = clean([day(law, 2, 0.5)], 20.0)
    assert Judgement(done.model, other).residual < 1.1 * NOISE_UM


@pytest.mark.parametrize("law", [half_warm, ridge])
def test_no_shape_over_a_temperature_is_added(law: object) -> None:
    """On another day it would be another one."""
    done = improve(Model(MACHINE, (), name="empty"), [day(law, 1, 1.0)], draws=50)
    assert not any(f.effect.effect == "expression" for f in done.model.effects)
