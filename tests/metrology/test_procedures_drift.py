"""Drift, cyclic error and lag against closed forms with known constants."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.drift import approach, phases_of, spindle_drift, tilt_urad
from rtec.metrology.procedures.fitting import correlation_time
from tests.support.cyclic_turns import cyclic_error
from tests.support.lag_fit import lag_model

Floats = NDArray[np.float64]
EVERY_S = 600.0  # [G 3.5]: every 10 min
DAY_S = np.arange(0.0, 48 * 3600.0, EVERY_S)


def ar1(rng: np.random.Generator, n: int, rho: float, sigma: float) -> Floats:
    """Autocorrelated noise of standard deviation sigma."""
    out = np.empty(n)
    value = rng.normal(0, sigma)
    for i in range(n):
        value = rho * value + np.sqrt(1 - rho**2) * rng.normal(0, sigma)
        out[i] = value
    return out


def two_days() -> tuple[Floats, Floats]:
    """8 h on, 16 h off, at two speeds: speeds and the closed form of the growth, τ 50 min on and 90 min off."""
    rpm, growth = np.zeros(len(DAY_S)), np.zeros(len(DAY_S))
    value = 0.0
    first = 0
    for hours, speed, end_um, tau_s in (
        (8, 1500.0, 20.0, 3000.0),
        (16, 0.0, 0.0, 5400.0),
        (8, 3000.0, 55.0, 3000.0),
        (16, 0.0, 0.0, 5400.0),
    ):
        rows = slice(first, first + hours * 6)
        since = DAY_S[rows] - DAY_S[first]
        first += hours * 6
        rpm[rows] = speed
        growth[rows] = end_um + (value - end_um) * np.exp(-since / tau_s)
        value = end_um + (value - end_um) * np.exp(-hours * 3600 / tau_s)
    return rpm, growth


def test_the_day_of_the_guidelines() -> None:
    """Oracle: the constants of the closed form, and tilt = (radial 1 - radial 2) / distance."""
    rpm, growth = two_days()
    rng = np.random.default_rng(2)
    noise = rng.normal(0, 0.1, (3, len(DAY_S)))
    probes = {"radial1": 0.6 * growth + noise[0], "radial2": 0.2 * growth + noise[1], "axial": -growth + noise[2]}
    r = spindle_drift("s", DAY_S, rpm, probes, 200.0)
    assert [p.rpm for p in r.phases] == [1500, 0, 3000, 0]
    assert [t.name for t in r.traces] == ["radial1", "radial2", "axial", "tilt"]
    axial = r.traces[2]
    for fit, tau, change in zip(axial.fits, (3000, 5400, 3000, 5400), (-20, 20, -55, 55), strict=True):
        assert fit.approach
        assert fit.approach.pair is None
        assert fit.approach.tau_low_s < tau < fit.approach.tau_high_s
        assert fit.approach.tau_s == pytest.approx(tau, rel=0.06)
        assert fit.approach.change == pytest.approx(change, abs=0.8)
        assert not fit.approach.words
    np.testing.assert_allclose(r.traces[3].values, (probes["radial1"] - probes["radial2"]) / 0.2)
    assert r.words == ()


def test_a_shift_at_once_is_no_drift() -> None:
    """Oracle: 7 µm put in at the change of speed, beside 30 µm of growth."""
    time = np.arange(0.0, 8 * 3600.0, 60.0)
    on = time >= 4 * 3600
    since = np.where(on, time - 4 * 3600, 0.0)
    growth = np.where(on, 7 + 30 * (1 - np.exp(-since / 2400)), 0.0)
    growth += np.random.default_rng(0).normal(0, 0.05, len(time))
    fit = spindle_drift("s", time, np.where(on, 4000.0, 0.0), {"axial": growth}).traces[0].fits[1]
    assert fit.instant == pytest.approx(7, abs=0.2)
    assert fit.measured == pytest.approx(7 + 30 * (1 - np.exp(-4 * 3600 / 2400)), abs=0.3)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_the_interval_holds_the_time_constant(rho: float) -> None:
    """Oracle: 200 seeded records of known τ; a 95 % interval that holds it in 90 to 100 % of them."""
    time = np.arange(0.0, 4 * 3600.0, 120.0)
    inside = 0
    for seed in range(200):
        noise = ar1(np.random.default_rng(seed), len(time), rho, 0.5)
        found = approach(time, 3 + 20 * (1 - np.exp(-time / 3600)) + noise)
        inside += found.tau_low_s <= 3600 <= found.tau_high_s
    assert 180 <= inside <= 200


def test_what_cannot_be_told_is_not_told() -> None:
    """Oracle: a straight line has a lower bound only, noise has nothing, a step an upper bound only."""
    time = np.arange(0.0, 4 * 3600.0, 60.0)
    rng = np.random.default_rng(4)
    noise = rng.normal(0, 0.1, len(time))
    line = approach(time, 1e-3 * time + noise)
    assert np.isinf(line.tau_high_s)
    assert line.tau_low_s > 4 * 3600
    assert line.words == "not settled"
    assert approach(time, noise).words == "only noise"
    assert approach(time, np.where(time > 0, 5.0, 0.0) + noise).tau_high_s < 120


def test_two_time_constants_are_found_where_they_are() -> None:
    """Oracle: τ 10 min and 2 h of opposite sign put in; one alone is not split."""
    time = np.arange(0.0, 8 * 3600.0, 60.0)
    noise = np.random.default_rng(5).normal(0, 0.1, len(time))
    two = approach(time, -15 * (1 - np.exp(-time / 600)) + 40 * (1 - np.exp(-time / 7200)) + noise)
    assert two.pair
    assert two.pair.taus_s == pytest.approx((600, 7200), rel=0.1)
    assert two.pair.changes == pytest.approx((-15, 40), rel=0.05)
    np.testing.assert_allclose(
        two.values(time), -15 * (1 - np.exp(-time / 600)) + 40 * (1 - np.exp(-time / 7200)), atol=0.2
    )
    assert approach(time, 40 * (1 - np.exp(-time / 7200)) + noise).pair is None


def test_phases_and_wrong_input() -> None:
    time = np.arange(0.0, 3600.0, 60.0)
    rpm = np.where(time < 1200, 1000.0, 2000.0)
    rpm[3] = 1010.0
    rpm[5] = np.nan
    assert [(p.first, p.end, p.rpm) for p in phases_of(time, rpm)] == [(0, 20, 1000.0), (20, 60, 2000.0)]
    short = spindle_drift("s", time, rpm, {"axial": time}).traces[0].fits[0]
    assert (short.approach, short.why) == (None, "too short")
    with pytest.raises(MeasurementError, match="rising time"):
        spindle_drift("s", time[::-1], rpm, {"axial": time})
    with pytest.raises(MeasurementError, match="rising time"):
        spindle_drift("s", np.where(time == 600, np.nan, time), rpm, {"axial": time})
    with pytest.raises(MeasurementError, match="no probe"):
        spindle_drift("s", time, rpm, {})
    with pytest.raises(MeasurementError, match="must be positive"):
        tilt_urad(time, time, 0.0)
    with pytest.raises(MeasurementError, match="spindle_rpm is empty"):
        phases_of(time, np.full(60, np.nan))


def test_correlation_time() -> None:
    """Oracle: (1 + ρ) / (1 - ρ) for autocorrelated noise of that form; 1 for white noise."""
    rng = np.random.default_rng(6)
    assert correlation_time(ar1(rng, 20_000, 0.8, 1.0)) == pytest.approx(9.0, rel=0.25)
    assert correlation_time(rng.normal(size=20_000)) == pytest.approx(1.0, abs=0.1)
    assert correlation_time(np.zeros(5)) == 1.0
    white = [correlation_time(rng.normal(size=320)) for _ in range(100)]
    assert np.mean(white) < 1.05, "white readings are not widened"


def turn(delay_s: float, reversal_deg: float, seed: int = 0, noise: float = 0.005) -> tuple[Floats, Floats, Floats]:
    """One turn forward and back at changing speed; readings at the delayed true position."""
    time = np.arange(0.0, 50.0, 0.01)
    speed = np.interp(time, [0, 5, 6, 18, 19, 26, 27, 39, 40, 50], [0, 0, 30, 30, 0, 0, -30, -30, 0, 0])
    position = np.cumsum(speed) * 0.01 * 360 / (np.sum(speed[:2500]) * 0.01)
    late = np.interp(time - delay_s, time, position)
    direction = np.where(time < 5, 0.0, np.where(time < 26, 1.0, -1.0))
    phi = np.radians(late)
    error = 8 * np.cos(4 * phi + 0.4) + 0.6 * np.sin(8 * phi) + 0.3 * np.cos(phi)
    rng = np.random.default_rng(seed)
    return time, position, late + error + reversal_deg / 2 * direction + rng.normal(0, noise, len(time))


@pytest.mark.parametrize(("delay_s", "reversal_deg"), [(0.035, 0.0), (0.0, 0.2), (0.02, -0.1), (-0.01, 0.05)])
def test_delay_and_reversal_are_told_apart(delay_s: float, reversal_deg: float) -> None:
    """Oracle: what was put in, to within four of the standard errors that are told."""
    r = cyclic_error(*turn(delay_s, reversal_deg), orders=12)
    assert abs(r.delay_s.value - delay_s) < 4 * r.delay_s.se + 2e-5
    assert abs(r.reversal_deg.value - reversal_deg) < 4 * r.reversal_deg.se + 1e-3
    assert r.reversal_deg.is_real == (abs(reversal_deg) > 0)
    assert {h.order for h in r.harmonics if h.amplitude.value > 0.02} == {1, 4, 8}
    assert r.strongest.order == 4
    assert r.strongest.amplitude.value == pytest.approx(8, abs=0.01)
    assert r.strongest.phase_deg == pytest.approx(360 - np.degrees(0.4), abs=0.2)
    # A reversal put in at the instant and one seen after 0.01° of motion differ for some readings.
    assert r.rms_deg == pytest.approx(0.005, rel=0.1 + 3 * abs(reversal_deg))


def test_what_cyclic_cannot_do() -> None:
    time, position, reading = turn(0.01, 0.0)
    with pytest.raises(MeasurementError, match="covers"):
        cyclic_error(time, position / 2, reading)
    with pytest.raises(MeasurementError, match="only one direction"):
        cyclic_error(time[:2500], position[:2500] * 1.001, reading[:2500])
    with pytest.raises(MeasurementError, match="bound"):
        cyclic_error(*turn(0.05, 0.0), orders=8, longest_delay_s=0.02)


def test_lag_model() -> None:
    """Oracle: the differential equation τ L' + L = u solved for a ramp with a hold, by hand."""
    time = np.arange(0.0, 7200.0, 5.0)
    slope, tau, stop = 0.02, 700.0, 2500.0
    u = 20 + slope * np.minimum(time, stop)
    rise = slope * (np.minimum(time, stop) - tau * (1 - np.exp(-np.minimum(time, stop) / tau)))
    lagged = 20 + np.where(time < stop, rise, slope * stop - (slope * stop - rise) * np.exp(-(time - stop) / tau))
    y = 3 + 1.5 * u - 2.0 * lagged + np.random.default_rng(1).normal(0, 0.2, len(time))
    y[10:20] = np.nan
    m = lag_model(time, y, {"bed": u}, ["bed"], ["bed"])
    assert m.tau_s["bed"].value == pytest.approx(tau, abs=4 * m.tau_s["bed"].se)
    assert m.direct_um_per_degc["bed"].value == pytest.approx(1.5, abs=4 * m.direct_um_per_degc["bed"].se)
    assert m.lagged_um_per_degc["bed"].value == pytest.approx(-2.0, abs=4 * m.lagged_um_per_degc["bed"].se)
    assert m.rms_um == pytest.approx(0.2, rel=0.05)
    assert m.tau_s["bed"].se < 40
    with pytest.raises(MeasurementError, match="no temperature 'air'"):
        lag_model(time, y, {"bed": u}, ["air"], [])


def test_a_time_constant_beyond_the_record_is_said() -> None:
    time = np.arange(0.0, 600.0, 5.0)
    u = 20 + 0.02 * time
    m = lag_model(time, u + np.random.default_rng(2).normal(0, 0.3, len(time)), {"bed": u}, [], ["bed"])
    assert [words.startswith("The time constant of bed is") for words in m.words] == [True]
