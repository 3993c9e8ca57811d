"""An axis that is read by a laser while the machine warms up, and on another day; shares no code with the program.

Heat flows between nut, screw, motor, bed and air in small steps. The law of the errors is written out here, so least
squares with its columns tells how well the other day can be predicted.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement

Floats = NDArray[np.float64]
Rng = np.random.Generator
STEP_S = 30.0
BODIES = ("T_nut", "T_motor", "T_bed", "T_screw", "T_air")


@dataclass(frozen=True)
class Warming:
    """A record, another day, and the truth of both.

    Attributes:
        given, other: what is fitted, and the day that is predicted.
        true_um: errors of both without noise, (readings,) each.
        law: columns of the truth of both, (readings, n) each.
    """

    given: Measurement
    other: Measurement
    true_um: tuple[Floats, Floats]
    law: tuple[Floats, Floats]

    def missed_um(self, predicted: Floats) -> float:
        """Root mean square error of a prediction of the other day, the zero of the display removed."""
        return _rms(self.true_um[1] - predicted)

    @property
    def lawful_um(self) -> float:
        """The same of least squares with the columns of the truth."""
        inner, outer = (c - c.mean(axis=0) for c in self.law)
        reading = self.given.matrix()[0]
        return self.missed_um(outer @ np.linalg.lstsq(inner, reading - reading.mean(), rcond=None)[0])


def warming(seed: int, runs: int, *, source: str = "T_bed", lag_s: float = 0.0, grows: bool = True) -> Warming:
    """A machine drawn at random.

    Args:
        seed: of everything.
        runs: there and back, of the record; the other day has eight.
        source: body that the axis grows with; the screw has no sensor.
        lag_s: delay behind it.
        grows: whether it grows at all.
    """
    rng = np.random.default_rng([seed, 41])
    low, travel = float(rng.choice([0.0, -300.0])), float(rng.choice([500.0, 1000.0, 2000.0]))
    machine = _machine(low, travel)
    count = int(rng.choice([41, 81]) if runs == 1 else rng.choice([11, 15, 21]))
    targets = low + travel * (0.04 + 0.92 * (np.arange(count) + rng.uniform(0.2, 0.8, count)) / count)
    size = np.array([rng.uniform(-15.0, 15.0), rng.uniform(0.5, 4.0), rng.uniform(6.0, 12.0) if grows else 0.0])
    flow = dict(zip(("heat", "nut", "screw", "air", "bed"), rng.uniform(
        [0.002, 1500.0, 800.0, 4000.0, 15000.0], [0.005, 4000.0, 2500.0, 9000.0, 40000.0]), strict=True))  # fmt: skip
    noise, pause = float(rng.uniform(0.15, 0.6)), 0.0 if runs == 1 else float(rng.choice([120.0, 600.0, 1500.0]))
    step = float(rng.choice([60.0, 120.0])) if runs == 1 else 15.0
    days: list[tuple[Measurement, Floats]] = []
    for n in (runs, 8):
        place = np.tile(np.concatenate([targets, targets[::-1]]), n)
        way = np.tile(np.repeat([1.0, -1.0], count), n)
        run = np.repeat(np.arange(1, n + 1), 2 * count)
        time = step * np.arange(len(place)) + pause * (run - 1)
        degc = _degc(rng, time, flow)
        drive = _late(time, degc[source], lag_s) - 20.0
        law = np.stack([1e-3 * place, 0.5 * way, 1e-3 * place * drive], axis=1)
        channels = {"x": place, "d_x": way}
        channels |= {s: degc[s] + 0.02 * rng.standard_normal(len(place)) for s in machine.sensor_names}
        made = make_instrument("laser_linear", {"zero": "setup"}, "X", "EXX", machine, "test")
        read = law @ size + noise * rng.standard_normal(len(place))
        days.append(
            (Measurement(f"day{len(days)}", made, machine, run, time, channels, {made.columns()[0]: read}), law)
        )
    (given, inner), (other, outer) = days
    used = [0, 1, 2] if grows else [0, 1]
    return Warming(given, other, (inner @ size, outer @ size), (inner[:, used], outer[:, used]))


def delayed(rise: Floats, time_s: Floats, tau_s: float) -> Floats:
    """First-order lag in small steps."""
    fine = np.arange(0.0, time_s[-1] + 10.0, 10.0)
    given, out = np.interp(fine, time_s, rise), np.empty(len(fine))
    out[0] = given[0]
    for i in range(1, len(fine)):
        out[i] = out[i - 1] + (1.0 - math.exp(-10.0 / tau_s)) * (given[i] - out[i - 1])
    return np.asarray(np.interp(time_s, fine, out))


def _machine(low: float, travel: float) -> Machine:
    axis = {"direction": "X", "travel_mm": [low, low + travel], "counts_per_mm": 1000.0, "pitch_mm": 10.0}
    sensors: dict[str, dict[str, object]] = {"T_nut": {}, "T_bed": {}, "T_air": {}}
    chain = {"name": "warming", "tool_chain": ["X"], "work_chain": ["bed"]}
    return machine_from({"machine": chain, "axis": {"X": axis}, "link": {"bed": {}}, "temperature": sensors}, "test")


def _degc(rng: Rng, time_s: Floats, flow: Mapping[str, float]) -> dict[str, Floats]:
    """Temperatures of the bodies at the times of the readings."""
    clock = np.arange(0.0, time_s[-1] + 2 * STEP_S, STEP_S)
    busy = rng.uniform(0.2, 1.0) * (rng.random(int(clock[-1] // 1800) + 1) < 0.8)
    air = 20.0 + rng.uniform(-2.0, 4.0) + rng.uniform(-1.0, 3.0) * clock / clock[-1]
    air += rng.uniform(0.3, 2.0) * np.sin(2.0 * np.pi * clock / 86400.0 + rng.uniform(0.0, 6.0))
    nut = motor = bed = screw = air[0]
    out = np.empty((len(clock), len(BODIES)))
    for i, a in enumerate(air):
        heat = flow["heat"] * busy[int(clock[i] // 1800)]
        to_bed, to_screw = (nut - bed) / flow["nut"], (nut - screw) / flow["screw"]
        motor += STEP_S * (2.0 * heat - (motor - bed) / 3000.0)
        screw += STEP_S * (0.5 * to_screw - (screw - a) / flow["air"])
        bed += STEP_S * (to_bed / 6.0 - (bed - a) / flow["bed"])
        nut += STEP_S * (heat - to_bed - to_screw)
        out[i] = nut, motor, bed, screw, a
    return {b: np.interp(time_s, clock, row) for b, row in zip(BODIES, out.T, strict=True)}


def _late(time_s: Floats, degc: Floats, lag_s: float) -> Floats:
    """A temperature behind a first-order delay, settled at the first reading."""
    if not lag_s:
        return degc
    clock = np.arange(0.0, time_s[-1] + STEP_S, STEP_S)
    fine, late, keep = np.interp(clock, time_s, degc), np.empty(len(clock)), np.exp(-STEP_S / lag_s)
    now = fine[0]
    for i, value in enumerate(fine):
        now = keep * now + (1.0 - keep) * value
        late[i] = now
    return np.interp(time_s, clock, late)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean((values - values.mean()) ** 2)))
