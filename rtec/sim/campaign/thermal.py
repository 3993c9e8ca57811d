"""Temperatures of the day: first-order bodies under each sensor, the air, and the sensors' readings.

    τ T' = T_air + Σ rise · source - T            sources hold from one instant to the next
    air  = mean - swing · cos(2π t / 24 h) + walk  walk: Ornstein-Uhlenbeck

The air is constant between two instants, which are at most half a minute apart.
"""

import re

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import lag_track
from rtec.errors import ConfigError
from rtec.jit import njit
from rtec.machine import Machine
from rtec.sim.campaign.noise import drift_noise, quantised
from rtec.sim.campaign.protocol import Timeline
from rtec.sim.campaign.settings import SensorBody, Sensors, Thermal
from rtec.tomlfile import nearest

Floats = NDArray[np.float64]
DAY_S = 86400.0
SPINDLE_POWER = 1.2


def temperatures_degc(
    machine: Machine, thermal: Thermal, timeline: Timeline, rng: np.random.Generator
) -> dict[str, Floats]:
    """True temperature at the place of each sensor, by sensor name, (n,).

    Raises:
        ConfigError: a body's sensor does not exist, or a body follows a sensor that does not exist.
    """
    bodies = bodies_of(machine, thermal)
    air = _air(thermal, timeline.time_s, rng)
    out: dict[str, Floats] = {}
    for name in sorted(bodies, key=lambda n: bodies[n].follows is not None):
        body = bodies[name]
        if body.follows is not None:
            out[name] = air + body.share * (out[body.follows] - air)
        else:
            out[name] = relax(air[0], air + _rise(machine, body, timeline), timeline.time_s, body.tau_s)
    return {name: out[name] for name in machine.sensor_names}


def sensor_readings_degc(true_degc: Floats, time_s: Floats, sensors: Sensors, rng: np.random.Generator) -> Floats:
    """Readings of a sensor, (n,): with lag, offset, noise, resolution."""
    out = lag_track(np.ascontiguousarray(true_degc), time_s, sensors.lag_s) if sensors.lag_s > 0 else true_degc.copy()
    out = out + sensors.offset_degc * rng.standard_normal() + sensors.noise_degc * rng.standard_normal(len(out))
    return quantised(out, sensors.resolution_degc)


def bodies_of(machine: Machine, thermal: Thermal) -> dict[str, SensorBody]:
    """Body of every sensor; by default it follows from the sensor's name."""
    for name, body in thermal.body.items():
        if name not in machine.sensor_names:
            hint = nearest(name, machine.sensor_names)
            raise ConfigError(f"[thermal.body.{name}] is no sensor of machine {machine.name!r}{hint}")
        other = body.follows
        if other is not None and (other not in machine.sensor_names or other == name):
            raise ConfigError(f"[thermal.body.{name}] follows {other!r}{nearest(other, machine.sensor_names)}")
        if other is not None and other in thermal.body and thermal.body[other].follows is not None:
            raise ConfigError(f"[thermal.body.{name}] follows {other!r}, which follows another one itself")
        for axis in set(body.axis_degc) - set(machine.axis_names):
            hint = nearest(axis, machine.axis_names)
            raise ConfigError(f"[thermal.body.{name}] axis_degc: {axis!r} is none of the machine{hint}")
    return {
        name: thermal.body[name] if name in thermal.body else usual_body(machine, name, i)
        for i, name in enumerate(machine.sensor_names)
    }


def usual_body(machine: Machine, sensor: str, number: int) -> SensorBody:
    """Body of a sensor by the words in its name; time constants differ slightly by `number`."""
    words = set(re.split(r"[_\d]+", sensor.lower()))
    slower = 1.0 + 0.13 * number
    if words & {"air", "ambient", "room"}:
        return SensorBody(tau_s=120.0 * slower)
    near = [a.name for a in machine.axes if a.name.lower() in words]
    if near:
        return SensorBody(tau_s=2000.0 * slower, on_degc=1.0, axis_degc=dict.fromkeys(near, 20.0))
    if words & {"spindle", "head", "headstock", "bearing", "quill"}:
        return SensorBody(tau_s=2500.0 * slower, on_degc=1.0, spindle_degc=5.0)
    axes = dict.fromkeys(machine.axis_names, 4.0)
    return SensorBody(tau_s=9000.0 * slower, on_degc=2.0, axis_degc=axes, spindle_degc=1.0)


@njit
def relax(start: float, towards: Floats, time_s: Floats, tau_s: float) -> Floats:
    """`τ T' = towards - T` with `towards` held from each instant to the next, from `start`, (n,)."""
    out = np.empty(len(towards))
    out[0] = start
    for i in range(1, len(towards)):
        out[i] = towards[i - 1] + (out[i - 1] - towards[i - 1]) * np.exp(-(time_s[i] - time_s[i - 1]) / tau_s)
    return out


def _rise(machine: Machine, body: SensorBody, timeline: Timeline) -> Floats:
    out = body.on_degc * timeline.on + body.spindle_degc * (np.abs(timeline.rpm) * 1e-3) ** SPINDLE_POWER
    for i, name in enumerate(machine.axis_names):
        out = out + body.axis_degc.get(name, 0.0) * timeline.load[:, i]
    return out


def _air(thermal: Thermal, time_s: Floats, rng: np.random.Generator) -> Floats:
    wave = -thermal.swing_degc * np.cos(2.0 * np.pi * time_s / DAY_S)
    return thermal.air_degc + wave + drift_noise(time_s, thermal.walk_degc, thermal.walk_tau_s, rng)
