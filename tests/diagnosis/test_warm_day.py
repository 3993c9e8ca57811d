"""A body grows between the day of the fit and today, and hardly today: no scale error has changed.

Oracle: the laws by which the days were made, and a third day at other temperatures.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from rtec.diagnosis.extend.add import Added, add
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.history import improved_page
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.both import both
from tests.support.machines import axis

MACHINE = machine_from(
    {
        "machine": {"name": "mill", "tool_chain": ["X", "tool"], "work_chain": ["table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 600.0], pitch_mm=10.0)},
        "link": {"tool": {}, "table": {}},
        "temperature": {"T_x_nut": {}, "T_air": {}},
    },
    "mill",
)
KNOWN = (
    "scale,component=EXX,axis=X,k=5", "backlash,component=EXX,axis=X,B=2",
    "axis_expansion,component=EXX,axis=X,sensor=T_x_nut,k=8",
)  # fmt: skip
SCALE, PLAY, SCREW, GLASS, NOISE_UM = 5.0, 2.0, 8.0, 9.0, 0.3


def day(seed: int, air_degc: float, glass: float = 0.0, scale: float = SCALE) -> Measurement:
    """Eight runs there and back in six hours; the air swings by half a kelvin, the nut warms by three.

    Args:
        seed: random numbers.
        air_degc: mean temperature of the air, to which the nut cools.
        glass: expansion of the scale by the air, µm/(m·K), from 20 °C on.
        scale: scale error at 20 °C, µm/m.
    """
    rng = np.random.default_rng(seed)
    places = np.linspace(10.0, 590.0, 15)
    x = np.tile(np.concatenate([places, places[::-1]]), 8)
    way = np.tile(np.repeat([1.0, -1.0], len(places)), 8)
    run = np.repeat(np.arange(1, 9), 2 * len(places))
    time_s = 2700.0 * (run - 1) + 8.0 * np.tile(np.arange(2 * len(places)), 8)
    air = air_degc + 0.4 * np.sin(2.0 * np.pi * (time_s / 15000.0 + rng.uniform()))
    nut = air + 3.0 * rng.uniform(0.2, 1.0, 8)[run - 1]
    error = 1e-3 * x * (scale + SCREW * (nut - 20.0) + glass * (air - 20.0)) + 0.5 * PLAY * way
    degc = {n: np.round(v + 0.03 * rng.normal(size=len(x)), 2) for n, v in (("T_x_nut", nut), ("T_air", air))}
    return Measurement(
        name=f"laser-{seed}", machine=MACHINE,
        instrument=make_instrument("laser_linear", {}, "X", "EXX", MACHINE, "laser"),
        run=run, time_s=time_s, channels={"x": x, "d_x": way, **degc},
        readings={"reading_um": error + NOISE_UM * rng.normal(size=len(x))},
    )  # fmt: skip


@cache
def fitted(air_degc: float) -> Model:
    """The model of a machine whose scale expands by the air, which nobody knows."""
    start = Model(MACHINE, tuple(effect_from_text(t, MACHINE) for t in KNOWN), name="mill")
    return add(start, [], [day(1, air_degc, GLASS)]).model


def error_um(model: Model, m: Measurement) -> float:
    return Judgement(model, clean([m], 20.0)).residual


@pytest.mark.parametrize("seed", proof.few([2, 3], 1))
@pytest.mark.parametrize("fit_degc", [20.3, 23.0])
def test_the_air_is_four_kelvin_colder_than_at_the_fit(fit_degc: float, seed: int) -> None:
    today, warm = day(seed, fit_degc - 4.0, GLASS), day(9, fit_degc + 2.5, GLASS)
    d, done = both(fitted(fit_degc), [today], changes=True, draws=50)
    assert "T_air is 4.0 K colder than in the fit" in d.sentence or d.findings[0].label.endswith("T_air)")
    assert "o effect is missing" not in d.sentence
    assert [s.labels for s in done.steps][:1] == [("axis_expansion(EXX, X, T_air)",)]
    assert done.model.effects[-1].values["k"] == pytest.approx(GLASS, abs=1.0)
    assert error_um(done.model, warm) < 0.5 * error_um(fitted(fit_degc), warm)
    assert error_um(done.model, warm) < 3.0 * NOISE_UM


def test_who_declines_the_expansion_is_asked_about_the_refit() -> None:
    asked: list[str] = []

    def ask(made: Added) -> bool:
        asked.append(made.question)
        return len(asked) > 1

    done = improve(fitted(23.0), [day(2, 19.0, GLASS)], ask=lambda _: None, ask_made=ask, draws=50)
    assert asked[0] == "Add axis_expansion(EXX, X, T_air), in place of the change of scale(EXX, X)?"
    assert asked[1] == "Refit the model's own numbers?"
    assert done.refit is not None


@pytest.mark.parametrize("seed", proof.few([4, 5], 1))
def test_a_scale_that_was_replaced_has_changed(seed: int) -> None:
    """The same air as at the fit."""
    done = improve(fitted(20.3), [day(seed, 20.3, GLASS, scale=30.0)], draws=50)
    assert not done.steps
    assert done.refit is not None
    assert done.model.effects[0].values["k"] == pytest.approx(30.0 + 0.3 * GLASS, abs=2.0)


@pytest.mark.parametrize("seed", proof.few([6, 7], 1))
def test_a_scale_that_was_replaced_on_a_colder_day_is_no_expansion(seed: int) -> None:
    """No glass that expands: the readings do not follow the air within the day."""
    plain = add(Model(MACHINE, tuple(effect_from_text(t, MACHINE) for t in KNOWN)), [], [day(1, 20.3)]).model
    done = improve(plain, [day(seed, 16.0, scale=-45.0)], draws=50)
    assert done.model.effects[0].values["k"] == pytest.approx(-45.0, abs=3.0)
    assert not done.steps


@pytest.mark.parametrize("off_k", [-2.5, 3.0])
def test_a_sensor_that_reads_too_high_is_said_beside_the_scale_that_seems_to_have_changed(off_k: float) -> None:
    """Oracle: what was added to one column of a machine that has not changed. A worn scale blames no sensor."""
    start = Model(MACHINE, tuple(effect_from_text(t, MACHINE) for t in KNOWN), name="mill")
    model, today = add(start, [], [day(1, 21.0)]).model, day(2, 21.0)
    off = replace(today, channels={**today.channels, "T_x_nut": today.channels["T_x_nut"] + off_k})
    found = diagnose(model, [off], draws=50, explain=True)
    (changed,) = found.changed
    assert changed.misread is not None
    assert changed.misread.sensor == "T_x_nut"
    assert changed.misread.by_k == pytest.approx(off_k, abs=0.3)
    assert f"if it reads {abs(changed.misread.by_k):.1f} K too {'high' if off_k > 0.0 else 'low'}" in found.sentence
    (worn,) = diagnose(model, [day(3, 21.0, scale=SCALE - SCREW * off_k)], draws=50, explain=True).changed
    assert worn.misread is None


@pytest.mark.parametrize("off_k", [-0.4, 0.3])
def test_a_sensor_may_read_a_little_otherwise_on_another_day(off_k: float) -> None:
    """Oracle: what was added to one column of a machine that has not changed."""
    start = Model(MACHINE, tuple(effect_from_text(t, MACHINE) for t in KNOWN), name="mill")
    model, today = add(start, [], [day(1, 21.0)]).model, day(2, 21.0)
    off = replace(today, channels={**today.channels, "T_x_nut": today.channels["T_x_nut"] + off_k})
    found = diagnose(model, [off], draws=50, explain=True)
    (changed,) = found.changed
    assert changed.misread is not None
    assert changed.misread.by_k == pytest.approx(off_k, abs=0.1)
    assert f"(or T_x_nut reads {abs(changed.misread.by_k):.2f} K {'more' if off_k > 0.0 else 'less'} than then)" in (
        found.sentence
    )


def still(seed: int, degc: float, scale: float = SCALE) -> Measurement:
    """A day on which no temperature changes; the screw grows as steel does."""
    m = day(seed, degc, scale=scale)
    rng, x = np.random.default_rng(seed), m.channels["x"]
    error = 1e-3 * x * (scale + 11.2 * (degc - 20.0)) + 0.5 * PLAY * m.channels["d_x"]
    degc_read = {n: np.round(degc + 0.04 * rng.normal(size=len(x)), 1) for n in ("T_x_nut", "T_air")}
    read_um = {"reading_um": error + NOISE_UM * rng.normal(size=len(x))}
    return replace(m, channels={**m.channels, **degc_read}, readings=read_um)


@pytest.mark.parametrize(("scale", "grows"), [(SCALE, True), (SCALE - 90.0, False)])
def test_what_a_warmer_day_changes_as_steel_grows_is_no_other_scale_error(scale: float, grows: bool) -> None:
    """`improve` had made the scale 57 µm/m larger: at 17 °C the model left 13.8 µm, and 5.3 before.

    Oracle: the law, on a day at a third temperature. What shrinks in the warmth is no expansion.
    """
    known = Model(MACHINE, tuple(effect_from_text(t, MACHINE) for t in KNOWN[:2]), name="mill")
    model, today = add(known, [], [still(1, 20.0)]).model, still(2, 25.0, scale)
    d, done = both(model, [today], changes=True, draws=50)
    assert ("and is likelier; a measurement at one more temperature decides" in d.sentence) is grows
    assert [s.labels for s in done.steps] == [("axis_expansion(EXX, X, T_x_nut)",)] * grows
    assert error_um(done.model, today) < 1.2 * NOISE_UM
    if grows:
        assert done.model.effects[-1].values["k"] == pytest.approx(11.2, abs=0.3)
        assert error_um(done.model, still(3, 17.0)) < 1.5 * NOISE_UM < error_um(model, still(3, 17.0))
        assert "a measurement at one more temperature decides" in improved_page(done, figures=False).lead
