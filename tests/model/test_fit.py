"""The fit, against truths chosen here and designs written out by hand."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.effects import Effect, State, effect_class
from rtec.errors import ModelError
from rtec.model import FittedEffect, Model
from rtec.model.fit import Margin
from tests.support.machines import turning_centre
from tests.support.tip_fit import fit_model

Floats = NDArray[np.float64]
MACHINE = turning_centre()
NOISE_UM = 0.3


def effect(name: str, component: str, **more: Any) -> Effect:
    return effect_class(name, "test").model_validate({"effect": name, "component": component, **more})


def state(n: int = 400, seed: int = 5) -> State:
    """Random poses, both directions, temperatures that wander apart."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, 20000.0, n)
    channels = {
        "x": rng.uniform(0.0, 200.0, n),
        "z": rng.uniform(0.0, 400.0, n),
        "d_x": rng.choice([-1.0, 1.0], n),
        "d_z": rng.choice([-1.0, 1.0], n),
        "T_spindle": 20.0 + 15.0 * np.sin(time / 3000.0) ** 2 + rng.uniform(0.0, 0.5, n),
        "T_bed": 20.0 + time / 4000.0 + rng.uniform(0.0, 0.5, n),
    }
    return State(MACHINE, time, channels)


LINEAR = [
    effect("scale", "EXX", axis="X"),
    effect("backlash", "EXX", axis="X"),
    effect("axis_expansion", "EZZ", axis="Z", sensor="T_bed", fixed_mm=50.0),
    effect("spindle_growth", "EZ0spindle", sensor="T_spindle"),
    effect("squareness", "EB0X"),
]
TRUE = np.array([12.0, -3.0, 11.5, 0.7, 25.0])


def by_hand(s: State) -> Floats:
    """Design of `LINEAR`, (n, 3, 5), from the equations of the effects and of the chain, written out.

    EXX and EZZ move the tip along X and Z; a fixed link on the work side counts with the other sign; squareness
    tilts the travel of X about Y, so it lowers Z by the angle times x.
    """
    c = s.channels
    x, zero = c["x"], np.zeros(len(s))
    return np.stack(
        [
            np.stack([x * 1e-3, zero, zero], axis=1),
            np.stack([0.5 * c["d_x"], zero, zero], axis=1),
            np.stack([zero, zero, (c["z"] - 50.0) * 1e-3 * (c["T_bed"] - 20.0)], axis=1),
            np.stack([zero, zero, -(c["T_spindle"] - 20.0)], axis=1),
            np.stack([zero, zero, -x * 1e-3], axis=1),
        ],
        axis=2,
    )


def numbers(model: Model) -> Floats:
    return np.array([v for f in model.effects for v in f.values.values()])


def errors(model: Model) -> Floats:
    return np.array([f.errors[k] for f in model.effects for k in f.values])


def read(s: State, seed: int, noise_um: float = NOISE_UM) -> Floats:
    rng = np.random.default_rng(seed)
    tip = by_hand(s) @ TRUE + noise_um * rng.standard_normal((len(s), 3))
    tip[:, 1] = np.nan
    return np.asarray(np.where(rng.uniform(size=tip.shape) < 0.2, np.nan, tip))


def test_closed_form() -> None:
    """Oracle: numpy's least squares on the hand-written design, with its own covariance formula."""
    s = state()
    tip = read(s, 1)
    model = fit_model(LINEAR, s, tip)
    here = np.isfinite(tip)
    design = by_hand(s)[here]
    values, squares, _, _ = np.linalg.lstsq(design, tip[here], rcond=None)
    variance = squares[0] / (here.sum() - len(values))
    spread = np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    np.testing.assert_allclose(numbers(model), values, rtol=1e-9)
    np.testing.assert_allclose(errors(model), spread, rtol=1e-7)
    assert model.noise_um == pytest.approx(np.sqrt(variance), rel=1e-9)
    model.check()


def test_truth_within_its_standard_errors() -> None:
    """Oracle: the truth; of 60 × 5 coefficients 68 % lie within one standard error, 95 % within two."""
    s = state()
    off = []
    for seed in range(60):
        model = fit_model(LINEAR, s, read(s, seed))
        off.append(np.abs(numbers(model) - TRUE) / errors(model))
    assert 0.60 < np.mean(np.array(off) < 1.0) < 0.76
    assert np.mean(np.array(off) < 2.0) > 0.91
    assert np.mean(np.array(off) < 3.0) > 0.98


NON_LINEAR = [
    effect("mount_expansion", "EXX", sensor="T_spindle", lag=True),
    effect("cyclic_screw", "EZZ", axis="Z", harmonics=1),
    effect("polynomial_position", "EXZ", axis="Z", degrees=[0, 1, 2]),
]


def non_linear_truth(s: State) -> Model:
    parts: tuple[tuple[dict[str, float], dict[str, float]], ...] = (
        ({"k": 1.4}, {"tau": 900.0}),
        ({"s1": 1.1, "c1": -0.6}, {"pitch": 10.004}),
        ({"c0": 3.0, "c1": 2.0, "c2": -4.0}, {}),
    )
    fitted = tuple(FittedEffect(e, v, t) for e, (v, t) in zip(NON_LINEAR, parts, strict=True))
    return Model(s.machine, fitted)


def pitched() -> State:
    from dataclasses import replace

    s = state(900)
    axes = tuple(replace(a, pitch_mm=10.0) if a.name == "Z" else a for a in MACHINE.axes)
    return State(replace(MACHINE, axes=axes), s.time_s, s.channels)


def test_variable_projection_finds_time_constant_and_pitch() -> None:
    """Oracle: the truth that made the readings, with standard errors as the yardstick, over 20 seeds."""
    s = pitched()
    truth = non_linear_truth(s)
    exact = truth.predict(s)
    off = []
    for seed in range(20):
        noise = NOISE_UM * np.random.default_rng(seed).standard_normal(exact.shape)
        model = fit_model(NON_LINEAR, s, exact + noise)
        for found, true in zip(model.effects, truth.effects, strict=True):
            both, real = {**found.values, **found.theta}, {**true.values, **true.theta}
            off += [abs(both[k] - real[k]) / found.errors[k] for k in real]
    assert np.mean(np.array(off) < 1.0) > 0.55
    assert np.mean(np.array(off) < 3.0) >= 0.95


def test_variable_projection_without_noise_is_exact() -> None:
    """Oracle: readings made by the model itself are met."""
    s = pitched()
    truth = non_linear_truth(s)
    model = fit_model(NON_LINEAR, s, truth.predict(s))
    assert model.effects[0].theta["tau"] == pytest.approx(900.0, rel=1e-3)
    assert model.effects[1].theta["pitch"] == pytest.approx(10.004, abs=1e-4)
    assert np.abs(model.predict(s) - truth.predict(s)).max() < 1e-3


def test_lag_uses_instants_between_readings() -> None:
    """Oracle: thinning the readings, not the temperatures, leaves a noise-free fit exact."""
    s = pitched()
    truth = non_linear_truth(s)
    tip = truth.predict(s)
    tip[np.arange(len(s)) % 6 != 0] = np.nan
    model = fit_model(NON_LINEAR, s, tip)
    assert model.effects[0].theta["tau"] == pytest.approx(900.0, rel=2e-3)


@pytest.mark.parametrize(
    ("more", "named"),
    [
        (effect("polynomial_position", "EXX", axis="X", degrees=[1]), None),
        (effect("polynomial_position", "EXX", axis="X", degrees=[0, 1]), ["scale(EXX)", "polynomial_position(EXX)"]),
        (effect("mount_expansion", "EZ0spindle", sensor="T_spindle"), ["spindle_growth", "mount_expansion"]),
    ],
)
def test_alias_is_told_by_name(more: Effect, named: list[str] | None) -> None:
    """Oracle: algebra. A slope about the middle is no multiple of one about zero, until a constant joins them."""
    s = state()
    if named is None:
        fit_model([*LINEAR, more], s, read(s, 1))
        return
    with pytest.raises(ModelError, match="cannot be distinguished") as caught:
        fit_model([*LINEAR, more], s, read(s, 1))
    assert all(name in str(caught.value) for name in named)
    assert "backlash" not in str(caught.value)


def test_effect_that_no_reading_shows() -> None:
    """Oracle: only X was read, and spindle growth acts along Z."""
    s = state()
    tip = read(s, 1)
    tip[:, 2] = np.nan
    with pytest.raises(ModelError, match=r"no reading shows .*spindle_growth\(EZ0spindle\)"):
        fit_model(LINEAR, s, tip)


def test_too_few_readings() -> None:
    s = state(3)
    with pytest.raises(ModelError, match="take more"):
        fit_model(LINEAR, s, read(s, 1))


def test_nothing_to_fit() -> None:
    s = state()
    with pytest.raises(ModelError, match="no readings"):
        fit_model(LINEAR, s, np.full((len(s), 3), np.nan))
    with pytest.raises(ModelError, match="shape"):
        fit_model(LINEAR, s, np.zeros((3, 3)))


def test_valid_range_is_that_of_the_readings() -> None:
    """Oracle: smallest and largest value at instants with a reading, widened by hand."""
    s = state()
    tip = read(s, 1)
    tip[s.channels["x"] > 150.0] = np.nan
    model = fit_model(LINEAR, s, tip, margin=Margin(share=0.1, least_degc=1.0))
    rows = np.isfinite(tip).any(axis=1)
    x, degc = s.channels["x"][rows], s.channels["T_spindle"][rows]
    low, high = model.valid_range["x"]
    assert (low, high) == pytest.approx((x.min() - 0.1 * np.ptp(x), x.max() + 0.1 * np.ptp(x)))
    assert high < 170.0
    assert model.valid_range["T_spindle"] == pytest.approx(
        (degc.min() - 0.1 * np.ptp(degc), degc.max() + 0.1 * np.ptp(degc))
    )
    assert model.valid_range["d_x"] == (-1.0, 1.0)
    assert set(model.valid_range) == {"x", "d_x", "z", "T_bed", "T_spindle"}


def test_parameter_on_its_bound_has_no_standard_error() -> None:
    """Oracle: a lag of two seconds is below the least that the search allows, ten."""
    s = pitched()
    parts = list(non_linear_truth(s).effects)
    parts[0] = FittedEffect(parts[0].effect, {"k": 1.4}, {"tau": 2.0})
    tip = Model(s.machine, tuple(parts)).predict(s)
    model = fit_model(NON_LINEAR, s, tip + 1e-3 * np.random.default_rng(3).standard_normal(tip.shape))
    assert model.effects[0].theta["tau"] == pytest.approx(10.0, abs=0.1)
    assert "tau" not in model.effects[0].errors
