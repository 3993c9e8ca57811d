"""Thermal network of first-order bodies, advanced exactly.

    C_i dT_i/dt = Σ_j G_ij (T_j - T_i) + G_i (T_air - T_i) + Q_i        (W)
    τ_k dS_k/dt = T_body(k) - S_k                                       (sensor k is on a body)

The air follows `mean - swing · cos ω(t - t_coldest) + walk`. The daily wave is two states of the same linear
system, so that one matrix exponential is the exact solution over any step with constant heat. The walk steps once a
minute; its steps depend on the seed and the minute alone, so that a run does not depend on its division into steps.
"""

import math

import numpy as np

from rtec.arrays import Floats
from rtec.quantities import DAY_S
from rtec.sim.truth import Truth

WALK_STEP_S = 60


class ThermalNetwork:
    """Temperatures of all bodies and sensors, in whole seconds of simulated time.

    Attributes:
        bodies, sensors: names, in the order of the arrays.
        sources: "spindle", then the axes: the order of every heat array, W.
        time_s: seconds since the start.
        state: bodies, sensors, wave (cos, sin), walk, 1; °C.
    """

    def __init__(self, truth: Truth, axes: tuple[str, ...], sensors: tuple[str, ...], seed: int) -> None:
        self.bodies = tuple(truth.body)
        self.sensors = sensors
        self.sources = ("spindle", *axes)
        self.time_s = 0
        self._truth, self._seed = truth, seed
        self._steps: dict[int, tuple[Floats, Floats]] = {}
        day_degc = truth.ambient.day_spread_degc * self._normal(1, 0)
        ambient = truth.ambient
        self._air_row = np.zeros(len(truth.body) + len(sensors) + 4)
        self._air_row[[-4, -2, -1]] = -ambient.swing_degc, 1.0, ambient.mean_degc + day_degc
        self._matrix, self._heat = self._system(axes)
        self._drive_j_per_mm = np.array([truth.axis[name].drive.heat_j_per_mm for name in axes])
        table = [truth.sensor[name] for name in sensors]
        self._offset = np.array([s.offset_degc for s in table])
        self._noise = np.array([s.noise_degc for s in table])
        self._resolution = np.array([s.resolution_degc for s in table])
        self.state = self._start()

    @property
    def body_degc(self) -> Floats:
        """Temperatures of the bodies, then of the air, °C, (bodies + 1,)."""
        return np.append(self.state[: len(self.bodies)], self.air_degc)

    @property
    def air_degc(self) -> float:
        """Temperature of the air, °C."""
        return float(np.dot(self._air_row, self.state))

    def advance(self, seconds: int, heat_w: Floats) -> None:
        """Advance by whole seconds with constant heat, W, (sources,)."""
        end = self.time_s + seconds
        while self.time_s < end:
            to_step = WALK_STEP_S - self.time_s % WALK_STEP_S
            step = min(to_step, end - self.time_s)
            transition, gain = self._step(step)
            self.state = transition @ self.state + gain @ heat_w
            self.time_s += step
            if step == to_step:
                self._walk()

    def readings_degc(self) -> Floats:
        """Readings of the sensors in this second, °C, with offset, noise and quantisation; equal at every call."""
        n = len(self.bodies)
        noise = np.random.default_rng([self._seed, 2, self.time_s]).standard_normal(len(self.sensors))
        out: Floats = self.state[n : n + len(self.sensors)] + self._offset + self._noise * noise
        fine = self._resolution > 0
        out[fine] = np.round(out[fine] / self._resolution[fine]) * self._resolution[fine]
        return out

    def heat_w(self, rpm: float, speed_mm_s: Floats) -> Floats:
        """Heat of spindle and axis drives, W, (sources,), at a spindle speed and axis speeds (axes,)."""
        spindle = self._truth.spindle
        turning = spindle.w_at_1000_rpm * (abs(rpm) / 1000.0) ** spindle.exponent
        return np.concatenate([[turning], speed_mm_s * self._drive_j_per_mm])

    def _normal(self, stream: int, number: int) -> float:
        return float(np.random.default_rng([self._seed, stream, number]).standard_normal())

    def _walk(self) -> None:
        sigma = self._truth.ambient.walk_degc_per_sqrt_h * math.sqrt(WALK_STEP_S / 3600.0)
        if sigma > 0:
            self.state[-2] += sigma * self._normal(3, self.time_s // WALK_STEP_S)

    def _step(self, seconds: int) -> tuple[Floats, Floats]:
        if seconds not in self._steps:
            from scipy.linalg import expm

            n, q = self._heat.shape
            both = np.zeros((n + q, n + q))
            both[:n, :n], both[:n, n:] = self._matrix, self._heat
            done = expm(both * seconds)
            self._steps[seconds] = (done[:n, :n].copy(), done[:n, n:].copy())
        return self._steps[seconds]

    def _start(self) -> Floats:
        """State after a night switched off: all bodies have the air's temperature at time zero."""
        out = np.zeros(len(self._air_row))
        phase = -2 * math.pi * self._truth.ambient.coldest_at_h * 3600.0 / DAY_S
        out[-4:] = [math.cos(phase), math.sin(phase), 0.0, 1.0]
        out[:-4] = self._air_row @ out
        return out

    def _system(self, axes: tuple[str, ...]) -> tuple[Floats, Floats]:
        """`A` (states, states) and `B` (states, sources) of `dz/dt = A z + B q`."""
        truth = self._truth
        nb, n = len(self.bodies), len(self.bodies) + len(self.sensors) + 4
        capacity = np.array([body.capacity_j_per_k for body in truth.body.values()])
        matrix, heat = np.zeros((n, n)), np.zeros((n, 1 + len(axes)))
        matrix[:nb] = self._body_rows(n) / capacity[:, None]
        for k, name in enumerate(self.sensors):
            sensor = truth.sensor[name]
            feels = self._air_row if sensor.body == "air" else np.eye(n)[self.bodies.index(sensor.body)]
            matrix[nb + k] = (feels - np.eye(n)[nb + k]) / sensor.lag_s
        omega = 2 * math.pi / DAY_S
        matrix[-4, -3], matrix[-3, -4] = -omega, omega
        matrix[-2, -2] = -1.0 / (truth.ambient.walk_return_h * 3600.0)
        shares = [truth.spindle.shares, *(truth.axis[name].drive.shares for name in axes)]
        for column, share in enumerate(shares):
            for name, part in share.items():
                body = self.bodies.index(name)
                heat[body, column] = part / sum(share.values()) / capacity[body]
        return matrix, heat

    def _body_rows(self, n: int) -> Floats:
        """Heat flow into each body per °C of each state, W/K, (bodies, n)."""
        out = np.zeros((len(self.bodies), n))
        for i, body in enumerate(self._truth.body.values()):
            out[i] = body.to_air_w_per_k * self._air_row
            out[i, i] -= body.to_air_w_per_k
        for path in self._truth.conductance:
            i, j = (self.bodies.index(name) for name in path.between)
            for a, b in ((i, j), (j, i)):
                out[a, a] -= path.w_per_k
                out[a, b] += path.w_per_k
        return out
