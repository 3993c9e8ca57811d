"""The thermal network against conservation of energy, a linear solve and an independent integrator."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from rtec.sim.thermal import ThermalNetwork
from rtec.sim.truth import Truth
from tests.support.sim_example import shipped

Floats = NDArray[np.float64]


def network(**ambient: float) -> tuple[ThermalNetwork, Truth]:
    machine, truth = shipped()
    uneven = truth.spindle.model_copy(update={"shares": {"spindle_front": 3.0, "spindle_rear": 1.0}})
    truth = truth.model_copy(update={"ambient": truth.ambient.model_copy(update=ambient), "spindle": uneven})
    return ThermalNetwork(truth, machine.axis_names, machine.sensor_names, 3), truth


def watts(truth: Truth, degc: Floats, air_degc: float, heat_w: Floats, axes: tuple[str, ...]) -> Floats:
    """Heat flow into every body, written body by body from the truth: the tests' own physics."""
    names = list(truth.body)
    out = np.array(
        [b.to_air_w_per_k * (air_degc - t) for b, t in zip(truth.body.values(), degc, strict=True)], dtype=float
    )
    for path in truth.conductance:
        i, j = names.index(path.between[0]), names.index(path.between[1])
        flow = path.w_per_k * (degc[i] - degc[j])
        out[i] -= flow
        out[j] += flow
    for share, q in zip([truth.spindle.shares, *(truth.axis[a].drive.shares for a in axes)], heat_w, strict=True):
        for name, part in share.items():
            out[names.index(name)] += q * part / sum(share.values())
    return out


QUIET = {"swing_degc": 0.0, "walk_degc_per_sqrt_h": 0.0, "day_spread_degc": 0.0}


def test_energy_is_conserved() -> None:
    """Oracle: heat put in = heat stored + heat lost to the air, the loss integrated by Simpson's rule."""
    net, truth = network(**QUIET)
    heat = np.array([350.0, 12.0, 20.0])
    capacity = np.array([b.capacity_j_per_k for b in truth.body.values()])
    to_air = np.array([b.to_air_w_per_k for b in truth.body.values()])
    before, losses, n = net.body_degc[:-1], [], 720
    for _ in range(n):
        losses.append(to_air @ (net.body_degc[:-1] - net.air_degc))
        net.advance(10, heat)
    losses.append(to_air @ (net.body_degc[:-1] - net.air_degc))
    weights = np.ones(n + 1)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    lost = float(weights @ np.array(losses)) * 10.0 / 3.0
    stored = float(capacity @ (net.body_degc[:-1] - before))
    given = heat.sum() * 7200.0
    assert lost > 0.05 * given
    assert abs(stored + lost - given) < 1e-6 * given


def test_steady_state_is_the_linear_solve() -> None:
    """Oracle: the temperatures at which the tests' own heat balance is zero, by a linear solve."""
    net, truth = network(**QUIET)
    heat = np.array([350.0, 12.0, 20.0])
    n, axes = len(truth.body), ("X", "Z")
    base = watts(truth, np.zeros(n), net.air_degc, heat, axes)
    columns = [watts(truth, row, net.air_degc, heat, axes) - base for row in np.eye(n)]
    settled = np.linalg.solve(np.array(columns).T, -base)
    for _ in range(20):
        net.advance(86400, heat)
    np.testing.assert_allclose(net.body_degc[:-1], settled, atol=1e-6)
    sensed = [settled[list(truth.body).index(s.body)] for s in truth.sensor.values() if s.body != "air"]
    np.testing.assert_allclose(net.state[n : n + len(sensed)], sensed, atol=1e-6)


def test_exponential_agrees_with_an_ode_integrator() -> None:
    """Oracle: scipy's DOP853 on the tests' own heat balance, with daily wave and sensor lags."""
    net, truth = network(walk_degc_per_sqrt_h=0.0, day_spread_degc=0.0)
    heat, axes = np.array([350.0, 12.0, 20.0]), ("X", "Z")
    capacity = np.array([b.capacity_j_per_k for b in truth.body.values()])
    names, n, amb = list(truth.body), len(truth.body), truth.ambient

    def air(t: float) -> float:
        return amb.mean_degc - amb.swing_degc * math.cos(2 * math.pi * (t / 3600 - amb.coldest_at_h) / 24)

    def slope(t: float, y: Floats) -> Floats:
        bodies = watts(truth, y[:n], air(t), heat, axes) / capacity
        felt = [air(t) if s.body == "air" else y[names.index(s.body)] for s in truth.sensor.values()]
        lags = np.array([s.lag_s for s in truth.sensor.values()])
        return np.concatenate([bodies, (np.array(felt) - y[n:]) / lags])

    start = np.full(n + len(truth.sensor), air(0.0))
    np.testing.assert_allclose(net.state[: len(start)], start, atol=1e-12)
    done = solve_ivp(slope, (0.0, 7207.0), start, method="DOP853", rtol=1e-10, atol=1e-9)
    net.advance(7207, heat)
    np.testing.assert_allclose(net.state[: len(start)], done.y[:, -1], atol=1e-6)


def test_how_time_is_cut_up_does_not_matter() -> None:
    """Oracle: the same hours in one piece."""
    (one, _), (many, _) = network(), network()
    heat = np.array([200.0, 5.0, 5.0])
    one.advance(4000, heat)
    for step in (1, 7, 59, 60, 61, 3000, 812):
        many.advance(step, heat)
    assert one.time_s == many.time_s
    np.testing.assert_allclose(one.state, many.state, atol=1e-9)


def test_sensors_have_their_own_faults() -> None:
    """Oracle: body temperature + offset in the truth, within five noise widths and half a step."""
    net, truth = network(**QUIET)
    for _ in range(5):
        net.advance(86400, np.array([350.0, 12.0, 20.0]))
    read, names = net.readings_degc(), list(truth.body)
    for k, sensor in enumerate(truth.sensor.values()):
        body = net.air_degc if sensor.body == "air" else net.body_degc[names.index(sensor.body)]
        width = 5 * sensor.noise_degc + sensor.resolution_degc / 2
        assert abs(read[k] - sensor.offset_degc - body) <= width
        assert abs(read[k] / sensor.resolution_degc - round(read[k] / sensor.resolution_degc)) < 1e-9
    np.testing.assert_array_equal(read, net.readings_degc())
    net.advance(1, np.zeros(3))
    assert np.any(read != net.readings_degc())


def test_sensor_noise_has_the_width_in_the_truth() -> None:
    """Oracle: the standard deviation in the truth, from 400 readings of a body that stands still."""
    machine, truth = shipped()
    table = {k: s.model_copy(update={"resolution_degc": 0.0}) for k, s in truth.sensor.items()}
    still = truth.model_copy(update={"sensor": table, "ambient": truth.ambient.model_copy(update=QUIET)})
    net = ThermalNetwork(still, machine.axis_names, machine.sensor_names, 1)
    rows = []
    for _ in range(400):
        net.advance(1, np.zeros(3))
        rows.append(net.readings_degc())
    wanted = np.array([s.noise_degc for s in table.values()])
    np.testing.assert_allclose(np.std(rows, axis=0), wanted, rtol=0.15)
