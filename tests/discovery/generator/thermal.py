"""The true temperatures: a machine that warms up in a shop, and eight sensors that are not exactly the bodies.

Every body follows its heat through two lags one after the other. Everything warms together, so the sensors are nearly
collinear, as on real machines.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
STEP_S = 10.0
HOURS = 9.0
NOISE_DEGC, QUANTUM_DEGC = 0.03, 0.0625
SENSORS = ("T_spindle", "T_head", "T_front", "T_back", "T_bed", "T_screw", "T_coolant", "T_air")

# Body: share of spindle heat, of axis heat, of coolant, K each; two lags, min; share of the air.
BODIES: dict[str, tuple[float, float, float, float, float, float]] = {
    "T_spindle": (15.0, 0.5, 0.0, 8.0, 2.0, 0.6),
    "T_head": (8.0, 0.5, 0.0, 35.0, 9.0, 0.6),
    "T_front": (5.5, 0.3, 0.6, 75.0, 15.0, 0.6),
    "T_back": (3.2, 0.3, 0.3, 120.0, 20.0, 0.6),
    "T_bed": (1.8, 0.8, 1.5, 150.0, 25.0, 0.6),
    "T_screw": (3.0, 5.0, 0.5, 22.0, 5.0, 0.6),
    "T_coolant": (3.0, 0.5, 4.0, 14.0, 4.0, 0.6),
    "T_air": (1.2, 0.2, 0.3, 20.0, 1.0, 1.0),
}
# Each sensor also feels a neighbour a little.
NEIGHBOUR = {
    "T_spindle": "T_head",
    "T_head": "T_spindle",
    "T_front": "T_head",
    "T_back": "T_air",
    "T_bed": "T_air",
    "T_screw": "T_bed",
    "T_coolant": "T_bed",
    "T_air": "T_bed",
}
SHARE, SENSOR_LAG_S = 0.04, 40.0


@dataclass(frozen=True)
class Weather:
    """The day on a fine grid of time.

    Attributes:
        time_s: (m,).
        rpm: spindle speed, (m,).
        body: true temperatures, °C, by name, (m,) each.
        sensor: what ideal sensors would show, by name, (m,) each.
    """

    time_s: Floats
    rpm: Floats
    body: Mapping[str, Floats]
    sensor: Mapping[str, Floats]

    def at(self, values: Floats, time_s: Floats) -> Floats:
        """Values of the grid at other instants."""
        return np.interp(time_s, self.time_s, values)


def lag(values: Floats, tau_s: float) -> Floats:
    """First-order lag on the grid; settled at the first value."""
    from_before = float(np.exp(-STEP_S / tau_s))
    out = np.empty_like(values)
    here = values[0]
    for i, value in enumerate(values.tolist()):
        here = value + (here - value) * from_before
        out[i] = here
    return out


def weather(rng: np.random.Generator, passive: bool) -> Weather:
    """A day of its own for every generator."""
    time = np.arange(0.0, HOURS * 3600.0 + STEP_S, STEP_S)
    rpm = _production(rng, time) if passive else _programme(rng, time, (0.0, 2000.0, 4000.0, 6000.0, 8000.0, 10000.0))
    axis_heat = _blocks(rng, time, (0.1, 0.4, 0.7, 1.0), (30.0, 90.0))
    coolant = _blocks(rng, time, (0.0, 1.0), (25.0, 70.0))
    if passive:
        axis_heat, coolant = np.full_like(time, 0.6), np.ones_like(time)
    axis_heat[time < 1500.0], coolant[time < 1500.0] = 0.0, 0.0
    air = _air(rng, time)
    spindle_heat = (rpm / 10000.0) ** 1.2
    body = {}
    for name, (spindle, axis, wet, slow_min, fast_min, out) in BODIES.items():
        heat = spindle * spindle_heat + axis * axis_heat + wet * coolant
        body[name] = 20.0 + lag(lag(heat, 60.0 * slow_min), 60.0 * fast_min) + out * lag(air, 60.0 * slow_min)
    sensor = {name: lag((1.0 - SHARE) * body[name] + SHARE * body[NEIGHBOUR[name]], SENSOR_LAG_S) for name in SENSORS}
    return Weather(time, rpm, body, sensor)


def read_sensor(rng: np.random.Generator, clean_degc: Floats) -> Floats:
    """A sensor with noise and a coarse converter."""
    noisy = clean_degc + NOISE_DEGC * rng.standard_normal(len(clean_degc))
    return np.round(noisy / QUANTUM_DEGC) * QUANTUM_DEGC


def _programme(rng: np.random.Generator, time: Floats, speeds: tuple[float, ...]) -> Floats:
    """Steps up and down with rests; the first run is cold."""
    rpm = _blocks(rng, time, speeds, (15.0, 50.0))
    rpm[time < 1600.0] = 0.0
    return rpm


def _production(rng: np.random.Generator, time: Floats) -> Floats:
    """One speed, with short stops for the next piece and a break."""
    rpm = np.full_like(time, float(rng.choice([5000.0, 6000.0, 8000.0])))
    at = 0.0
    while at < time[-1]:
        at += rng.uniform(1200.0, 2400.0)
        rpm[(time > at) & (time < at + rng.uniform(90.0, 240.0))] = 0.0
    noon = rng.uniform(3.5, 5.0) * 3600.0
    rpm[(time > noon) & (time < noon + 1800.0)] = 0.0
    rpm[time < 1600.0] = 0.0
    return rpm


def _blocks(rng: np.random.Generator, time: Floats, levels: tuple[float, ...], minutes: tuple[float, float]) -> Floats:
    """Another level for every block of time."""
    out, at, last = np.zeros_like(time), 0.0, levels[0]
    while at < time[-1]:
        last = float(rng.choice([v for v in levels if v != last]))
        out[time >= at] = last
        at += 60.0 * rng.uniform(*minutes)
    return out


def _air(rng: np.random.Generator, time: Floats) -> Floats:
    """Air above 20 °C: the day, doors and heaters."""
    day = rng.uniform(0.5, 1.5) * np.sin(2.0 * np.pi * (time / 3600.0 - rng.uniform(0.0, 24.0)) / 24.0)
    shop = rng.uniform(0.4, 0.9) * np.sin(2.0 * np.pi * time / 3600.0 / rng.uniform(2.5, 5.0) + rng.uniform(0.0, 6.28))
    doors = lag(_blocks(rng, time, (-1.0, 0.0, 0.5, 1.5), (40.0, 120.0)), 900.0)
    return np.asarray(day + shop + 0.8 * doors)
