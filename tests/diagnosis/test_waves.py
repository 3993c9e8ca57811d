"""A wave along an axis whose period nobody gave. Oracle: the period and the height that were put into the readings."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.extend.add import add, new_effect
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.candidates import library
from rtec.estimation.outliers import clean
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support import proof
from tests.support.diagnosis_examples import TABLE
from tests.support.machines import axis

Floats = NDArray[np.float64]
TRAVEL_MM, RUNS, NOISE_UM = 600.0, 9, 0.2
KNOWN = ("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")


def long_machine() -> Machine:
    """The small machine with a longer X."""
    axes = {**TABLE["axis"], "X": axis("X", travel_mm=[0.0, TRAVEL_MM], pitch_mm=10.0)}
    return machine_from({**TABLE, "axis": axes}, "long")


def read_there_and_back(error_um: Floats, x_mm: Floats, seed: int) -> Measurement:
    """Each target there and back in each run; one temperature rises with time, the other falls."""
    machine, rng = long_machine(), np.random.default_rng(seed)
    x = np.tile(np.concatenate([x_mm, x_mm[::-1]]), RUNS)
    error = np.tile(np.concatenate([error_um, error_um[::-1]]), RUNS)
    n = len(x)
    day = np.linspace(0.0, 1.0, n)
    channels = {"x": x, "d_x": np.tile(np.repeat([1.0, -1.0], len(x_mm)), RUNS)}
    channels |= {"T_bed": 20.0 + 2.0 * day + 0.3 * np.sin(9.0 * day), "T_air": 22.0 - 1.5 * day**2}
    readings = {"reading_um": error + NOISE_UM * rng.standard_normal(n)}
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    run = np.repeat(np.arange(1, RUNS + 1), 2 * len(x_mm))
    return Measurement("laser", made, machine, run, np.linspace(0.0, 9.0 * n, n), channels, readings)


def targets_mm(count: int, seed: int) -> Floats:
    """Targets at unequal steps over the whole travel."""
    rng = np.random.default_rng(seed)
    step = TRAVEL_MM / count
    return np.asarray((np.arange(count) + 0.5) * step + rng.uniform(-0.25, 0.25, count) * step)


def found_in(error_um: Floats, x_mm: Floats, seed: int, only: list[str] | None = None) -> Diagnosis:
    model = Model(long_machine(), tuple(effect_from_text(t, long_machine()) for t in KNOWN), name="known")
    return diagnose(model, [read_there_and_back(error_um, x_mm, seed)], draws=50, only=only, explain=True)


def diagnosed(period_mm: float, seed: int, only: list[str] | None = None, height_um: float = 4.0) -> Diagnosis:
    x = targets_mm(53, seed)
    return found_in(height_um * np.sin(2.0 * math.pi * x / period_mm + seed), x, seed, only)


PERIODS_MM = [43.1, 44.1, 57.3, 118.0, 187.0]


@pytest.mark.parametrize("period_mm", PERIODS_MM)
def test_a_gear_of_any_circumference_that_turns_three_times_is_named(period_mm: float) -> None:
    d = diagnosed(period_mm, 5)
    best = d.findings[0]
    assert best.effect.effect == "cyclic_pole"
    assert best.accepted
    assert best.parameters["period"].value == pytest.approx(period_mm, rel=1e-3)
    assert best.heldout_drop > 0.5


@pytest.mark.parametrize("period_mm", PERIODS_MM)
def test_a_wave_outside_the_catalogue_is_said_plainly_and_with_its_period(period_mm: float) -> None:
    d = diagnosed(period_mm, 6, only=["straightness", "servo_lag", "axis_expansion"])
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)
    assert d.unknown.period is not None
    assert d.unknown.period.value == pytest.approx(period_mm, rel=1e-3)
    assert d.unknown.where == ""
    assert d.unknown.expression == "A*sin(2*pi*x/period) + B*cos(2*pi*x/period)"


def test_a_sawtooth_is_said_with_its_period_and_harmonics_and_is_no_gear() -> None:
    """Its first harmonic makes six tenths of its mean square; a jump may be anywhere between two targets."""
    count, period_mm = 61, 97.0
    x = targets_mm(count, 7)
    d = found_in(4.0 * np.mod(x / period_mm + 0.2, 1.0), x, 7)
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert d.unknown.period is not None
    assert d.unknown.period.value == pytest.approx(period_mm, abs=(TRAVEL_MM / count) / (TRAVEL_MM / period_mm))
    assert "sin(4*pi*x/period)" in d.unknown.expression


def test_a_long_wave_at_equal_steps_is_no_gear() -> None:
    """Each 12 mm it is the same as one near the step."""
    step_mm, period_mm = 12.0, 150.0
    x = np.arange(0.5 * step_mm, TRAVEL_MM, step_mm)
    d = found_in(4.0 * np.sin(2.0 * math.pi * x / period_mm), x, 8)
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    short_mm = 1.0 / (1.0 / step_mm - 1.0 / period_mm)
    assert any(a == pytest.approx(short_mm, rel=1e-3) for a in d.unknown.aliases_mm)


def test_no_screw_has_the_pitch_of_a_pinion() -> None:
    x = targets_mm(53, 8)
    d = found_in(4.0 * np.sin(2.0 * math.pi * x / 150.0), x, 8)
    assert d.verdict == "missing_effect"
    assert d.findings[0].effect.effect == "cyclic_pole"


@pytest.mark.parametrize(("channel", "per_degc"), proof.few([("T_air", -0.9), ("T_bed", 1.3)], 1))
def test_a_wave_that_grows_with_a_temperature_is_named_after_the_wave(channel: str, per_degc: float) -> None:
    """A wave has a constant part and one that grows; the second is a candidate as soon as the model has the first."""
    m, constant = growing(channel, per_degc, 3)
    model = Model(long_machine(), tuple(effect_from_text(t, long_machine()) for t in KNOWN), name="known")
    done = improve(model, [m], draws=50)
    assert [s.labels for s in done.steps] == [
        ("cyclic_pole(EXX, X)",),
        (f"cyclic_pole(EXX, X, grows with {channel})",),
    ]
    assert done.reason == "nothing_missing"
    steady, grown = done.model.effects[-2:]
    for fitted, height in ((steady, constant), (grown, per_degc)):
        error = math.hypot(*(fitted.errors[k] for k in "sc"))
        assert math.hypot(*(fitted.values[k] for k in "sc")) == pytest.approx(abs(height), abs=4.0 * error)
    assert done.steps[-1].after.held_out < 1.05 * NOISE_UM


def test_a_wave_of_constant_size_grows_with_nothing() -> None:
    """Oracle: nothing but noise is hidden beside the wave; every temperature is tried and none is named."""
    m, _ = growing("T_bed", 0.0, 4)
    wave = f"cyclic_pole,component=EXX,axis=X,s=4,c=0,period={GEAR_MM}"
    model = Model(long_machine(), tuple(effect_from_text(t, long_machine()) for t in (*KNOWN, wave)), name="known")
    d = diagnose(model, [m], draws=50)
    assert d.verdict == "nothing_missing"
    tried = [c.effect for c in library(clean([m]).readings, ["cyclic_pole"], model.effects)[0]]
    assert {getattr(e, "grows_with", None) for e in tried} == {None, "T_bed", "T_air"}


def test_a_wave_that_grows_is_added_with_the_period_of_the_wave() -> None:
    m, _ = growing("T_bed", 1.3, 5)
    wave = f"cyclic_pole,component=EXX,axis=X,s=4,c=0,period={GEAR_MM}"
    model = Model(long_machine(), tuple(effect_from_text(t, long_machine()) for t in (*KNOWN, wave)), name="known")
    grown = model.effects[-1].effect.model_copy(update={"grows_with": "T_bed"})
    done = add(model, [new_effect(grown, model)], [m])
    assert done.better
    assert math.hypot(*(done.model.effects[-1].values[k] for k in "sc")) == pytest.approx(1.3, abs=0.1)


GEAR_MM = 57.3


def growing(channel: str, per_degc: float, seed: int) -> tuple[Measurement, float]:
    """A wave of 4 µm that changes by so many µm for each kelvin from 20 °C, and its height at 20 °C."""
    x = targets_mm(53, seed)
    m = read_there_and_back(np.zeros_like(x), x, seed)
    height = 4.0 + per_degc * (m.channels[channel] - 20.0)
    wave = height * np.sin(2.0 * math.pi * m.channels["x"] / GEAR_MM)
    return replace(m, readings={"reading_um": m.readings["reading_um"] + wave}), 4.0


@pytest.mark.parametrize("period_mm", proof.few([31.416, 11.3, 62.83], 1))
def test_a_wave_along_a_long_axis_is_named_with_its_period(period_mm: float) -> None:
    """Six metres are hundreds of turns: neighbours in the grid of periods must not be a turn apart at the ends."""
    axes = {**TABLE["axis"], "X": axis("X", travel_mm=[0.0, 6000.0])}
    machine = machine_from({**TABLE, "axis": axes}, "rack")
    rng = np.random.default_rng(int(period_mm))
    places = np.sort(rng.uniform(100.0, 5900.0, 100))
    x = np.tile(np.concatenate([places, places[::-1]]), 5)
    reading = 4.0 * np.sin(2.0 * math.pi * x / period_mm) + NOISE_UM * rng.standard_normal(len(x))
    channels = {"x": x, "d_x": np.tile(np.repeat([1.0, -1.0], len(places)), 5)}
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    run, time_s = np.repeat(np.arange(5), 2 * len(places)), np.linspace(0.0, 4.0 * len(x), len(x))
    m = Measurement("laser", made, machine, run, time_s, channels, {"reading_um": reading})
    d = diagnose(Model(machine, tuple(effect_from_text(t, machine) for t in KNOWN), name="known"), [m], draws=50)
    assert d.verdict == "missing_effect"
    assert d.findings[0].effect.effect == "cyclic_pole"
    assert d.findings[0].parameters["period"].value == pytest.approx(period_mm, rel=1e-3)
