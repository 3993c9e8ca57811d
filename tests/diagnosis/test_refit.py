"""A refit never makes a model worse. Oracle: ordinary least squares, written out here."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.extend.add import add, no_worse
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.refit import Refitted
from rtec.estimation.floor import cleaned
from rtec.estimation.joint import joint_fit
from rtec.estimation.outliers import clean
from rtec.estimation.readings import Readings, read
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.support.characterise_examples import Probe, ProbeSetup, effect, measurement, runs

Floats = NDArray[np.float64]
SENSORS = ("T_spindle", "T_bed", "T_column", "T_air")


def drifting(rng: np.random.Generator, n: int, form: str) -> Floats:
    """Slow changes of several forms, of standard deviation one."""
    t = np.linspace(0.0, 1.0, n)
    if form == "memory":
        steps, tau = rng.standard_normal(n), n * rng.uniform(0.01, 0.3)
        out = np.zeros(n)
        for i in range(1, n):
            out[i] = out[i - 1] * np.exp(-1.0 / tau) + steps[i]
    elif form == "warm-up":
        out = 1.0 - np.exp(-t / rng.uniform(0.1, 0.5))
    elif form == "walk":
        out = np.cumsum(rng.standard_normal(n))
    elif form == "wave":
        out = np.sin(2 * np.pi * (rng.uniform(0.5, 4.0) * t + rng.uniform()))
    else:
        out = np.zeros(n)
    return np.asarray((out - out.mean()) / max(float(np.std(out)), 1.0 if form == "none" else 1e-12))


def least_squares(readings: Readings, effects: list[FittedEffect]) -> tuple[list[FittedEffect], Floats]:
    """The optimum by ordinary least squares, one zero for the set-up; and the columns, centred."""
    columns = np.concatenate([readings.columns(f.effect, f.theta) for f in effects], axis=1)
    columns = columns - columns.mean(axis=0)
    values = np.linalg.lstsq(columns, readings.values - readings.values.mean(), rcond=None)[0]
    filled = [
        FittedEffect(f.effect, {next(iter(f.values)): float(v)}, {}, {next(iter(f.values)): abs(float(v)) + 1.0})
        for f, v in zip(effects, values, strict=True)
    ]
    return filled, columns


@pytest.mark.parametrize("form", ["none", "memory", "warm-up", "walk", "wave"])
def test_a_refit_of_an_optimum_changes_no_prediction_by_more_than_its_error(form: str) -> None:
    """Forty machines for each form of drift, up to twenty times the noise."""
    rng = np.random.default_rng([15, len(form)])
    for seed in range(40):
        m = measurement(
            runs([40] * 4), seed=seed, noise_um=0.3, instrument=Probe(ProbeSetup(zero="setup"), component="EXX")
        )
        chosen = [
            effect("scale", "EXX", axis="X"),
            effect("backlash", "EXX", axis="X"),
            *(effect("mount_expansion", "EXX", sensor=s) for s in rng.choice(SENSORS, rng.integers(1, 3), False)),
        ]
        slow = drifting(rng, len(m), form) * rng.uniform(0.3, 6.0)
        values = m.readings["reading_um"] + 2e-2 * m.channels["x"] + m.channels["T_bed"] + slow
        readings = read([replace(m, readings={"reading_um": values})], smooth=False)
        names = [next(iter(e.coefficients(m.machine))).name for e in chosen]
        start = [FittedEffect(e, {n: 0.0}) for e, n in zip(chosen, names, strict=True)]
        optimum, columns = least_squares(readings, start)
        fit = no_worse(Model(m.machine, tuple(optimum)), joint_fit(optimum, readings))
        step = np.array([a.values[n] - b.values[n] for a, b, n in zip(fit.effects, optimum, names, strict=True)])
        error = np.array([a.errors[n] for a, n in zip(fit.effects, names, strict=True)])
        assert np.all(np.abs(step) <= error), (seed, step, error)
        assert np.mean((columns @ step) ** 2) <= np.mean(np.sum((columns * error) ** 2, axis=1))


def heated() -> Measurement:
    """A frame that grows with its own temperature and late with its bed's; models here know of no delay.

    The bed is heated for four hours and cools for three; three readings a minute, in steps of 2.5 µm.
    """
    rng = np.random.default_rng(4)
    n, hot = 1260, 720
    time = 20.0 * np.arange(n, dtype=np.float64)
    drive = np.where(np.arange(n) < hot, 80.0, 0.0)
    state = replace(measurement(runs([n])), time_s=time).state()
    bed = 20.0 + state.lagged(drive, 300.0)
    frame = 20.0 + 0.25 * state.lagged(drive, 9000.0)
    values = -34.0 * state.lagged(frame, 120.0) + 2.0 * state.lagged(bed, 720.0) + 1.5 * rng.standard_normal(n)
    probe = Probe(ProbeSetup(zero="setup"), component="EX0spindle")
    table = {"T_spindle": frame + 0.03 * rng.standard_normal(n), "T_bed": bed + 0.03 * rng.standard_normal(n)}
    return replace(
        measurement(runs([n]), instrument=probe), time_s=time, channels=table,
        readings={"reading_um": 2.5 * np.round(values / 2.5)}, sha256="a" * 64,
    )  # fmt: skip


def start_of(m: Measurement) -> Model:
    """Both temperatures at once, by ordinary least squares."""
    pair = [FittedEffect(effect("mount_expansion", "EX0spindle", sensor=s), {"k": 0.0}) for s in ("T_spindle", "T_bed")]
    optimum, _ = least_squares(read([m], smooth=False), pair)
    return Model(m.machine, tuple(optimum), measurements={m.name: m.sha256})


def left_rms(model: Model, m: Measurement) -> float:
    readings = read([m], smooth=False)
    said = sum(
        readings.columns(f.effect, f.theta) @ np.array([f.values[c.name] for c in f.effect.coefficients(m.machine)])
        for f in model.effects
    )
    return float(np.sqrt(np.mean(cleaned(readings, readings.values - said) ** 2)))


def test_a_refit_is_no_worse_on_its_own_readings() -> None:
    m = heated()
    model = start_of(m)
    made = add(model, [], [m])
    assert left_rms(made.model, m) <= 1.001 * left_rms(model, m)
    assert made.before.as_given == pytest.approx(left_rms(model, m), rel=1e-6)
    assert any("weighted least squares" in n for n in made.notes)


def test_improve_never_ends_worse_than_it_began() -> None:
    """Two bad end points of a stage's calibration: what is left out is the same in each step, and so is the measure."""
    rng = np.random.default_rng(5)
    base = measurement(runs([60] * 2), noise_um=0.5, instrument=Probe(ProbeSetup(zero="setup"), component="EXX"))
    x = np.concatenate([np.linspace(0.0, 180.0, 60), np.linspace(180.0, 0.0, 60)])
    values = 0.08 * x + 3.0 * np.sin(x / 17.0) + rng.standard_normal(120)
    values[[0, 1, 118, 119]] += [90.0, 60.0, 55.0, 95.0]
    m = replace(
        base, channels={"x": x, "d_x": np.repeat([1.0, -1.0], 60)}, readings={"reading_um": values},
        time_s=30.0 * np.arange(120, dtype=np.float64),
    )  # fmt: skip
    scale = FittedEffect(effect("scale", "EXX", axis="X"), {"k": 0.0})
    optimum, _ = least_squares(read([m], smooth=False), [scale])
    model = Model(m.machine, tuple(optimum), measurements={m.name: m.sha256})
    sizes = [left_rms(model, m)]
    result = improve(model, [m], step=lambda a: sizes.append(left_rms(a.model, m)))
    assert left_rms(result.model, m) <= 1.001 * sizes[0]
    kept = clean([m])
    rms = [float(np.sqrt(np.mean(s**2))) for s in (residual(mo, m)[kept.kept] for mo in (model, result.model))]
    assert rms[1] <= 1.001 * rms[0]


def residual(model: Model, m: Measurement) -> Floats:
    readings = read([m], smooth=False)
    out = readings.values.copy()
    for f in model.effects:
        out -= readings.columns(f.effect, f.theta) @ np.array(
            [f.values[c.name] for c in f.effect.coefficients(m.machine)]
        )
    return np.asarray(out - np.median(out))


def test_what_is_named_together_is_found_among_others() -> None:
    """Oracle: identity. Two fits may hold the same number and arrays that look alike, and are two."""
    one, two = (Refitted(k, {}, np.ones((4, 1)), cast("Any", None), 1.0, 1.0, 1.0) for k in (1, 1))
    assert two in [one, two]
    assert two not in [one]
