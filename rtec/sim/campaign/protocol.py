"""The day of a measurement: the order of its phases, the state at every instant, temperatures, noise of the readings.

The warm-up is that of [G 3.1]: five cycles cold; then the machine warms up, first switched on, then with moving slides,
with five cycles after every step, over about eight hours. The drift test is that of [G 3.5]: constant speed, a reading
every ten minutes, then off overnight; more speeds follow.

Temperatures are those of first-order bodies under each sensor, and of the air:

    τ T' = T_air + Σ rise · source - T            sources hold from one instant to the next
    air  = mean - swing · cos(2π t / 24 h) + walk  walk: Ornstein-Uhlenbeck

The air is constant between two instants, which are at most half a minute apart.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Bools, Floats, Ints
from rtec.effects.derived import lag_track
from rtec.errors import ConfigError
from rtec.jit import njit
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.quantities import DAY_S
from rtec.sim.campaign.cycle import MOST_ROWS, Cycle
from rtec.sim.campaign.settings import DayPhase, ReadingNoise, SensorBody, Sensors, Settings, Targets, Thermal
from rtec.tomlfile import nearest


def drift_noise(time_s: Floats, sigma: float, tau_s: float, rng: np.random.Generator) -> Floats:
    """Noise with the autocorrelation `σ² exp(-|Δt|/τ)` at any instants, (n,); stationary from the start."""
    fresh = rng.standard_normal(len(time_s))
    return _ornstein_uhlenbeck(fresh, np.ascontiguousarray(time_s), tau_s) * sigma


@njit
def _ornstein_uhlenbeck(fresh: Floats, time_s: Floats, tau_s: float) -> Floats:
    out = np.empty(len(fresh))
    for i in range(len(fresh)):
        if i == 0:
            out[0] = fresh[0]
        else:
            step = (time_s[i] - time_s[i - 1]) / tau_s
            out[i] = out[i - 1] * np.exp(-step) + np.sqrt(-np.expm1(-2.0 * step)) * fresh[i]
    return out


def with_noise(reading: Floats, time_s: Floats, run: Ints, noise: ReadingNoise, rng: np.random.Generator) -> Floats:
    """A reading with all its noise, (n,); every kind has its own random numbers, drawn in a fixed order."""
    n = len(reading)
    _, first = np.unique(run, return_inverse=True)
    out = reading + noise.white_um * rng.standard_normal(n)
    out = out + drift_noise(time_s, noise.drift_um, noise.drift_tau_s, rng)
    out = out + (noise.run_offset_um * rng.standard_normal(int(first.max()) + 1))[first]
    wrong = rng.random(n) < noise.outliers
    size = rng.uniform(0.5, 1.5, n) * np.where(rng.random(n) < 0.5, -1.0, 1.0)
    out = out + np.where(wrong, noise.outlier_um * size, 0.0)
    out = quantised(out, noise.resolution_um)
    return np.where(rng.random(n) < noise.lost, np.nan, out)


def quantised(values: Floats, step: float) -> Floats:
    """Values in whole steps, (n,), without the residue of binary arithmetic; a step of 0 does not change them."""
    return np.round(np.round(values / step) * step, 9) if step > 0 else values


GRID_S = 30.0
"""Largest time between two computed temperatures."""
LOAD_MM_S = 100.0
DRIFT_EVERY_S = 600.0


def phases_of(settings: Settings, instrument: Instrument) -> tuple[DayPhase, ...]:
    """Phases of the day: the user's own, or those of the protocol, or the usual ones of the instrument."""
    if settings.phase:
        return settings.phase
    usual = USUAL.get(instrument.name, "warm_up")
    return PRESETS[settings.protocol or usual](settings.cycles)


def _warm_up(cycles: int) -> tuple[DayPhase, ...]:
    def then(*steps: DayPhase) -> list[DayPhase]:
        return [p for b in steps for p in (b, DayPhase(name=f"measure after {b.name}", cycles=cycles))]

    return (
        DayPhase(name="measure cold", cycles=cycles),
        *then(
            DayPhase(name="idle 1", hours=1.0),
            DayPhase(name="move 1", hours=0.25, moving=0.8),
            DayPhase(name="move 2", hours=0.5, moving=0.8),
            DayPhase(name="spindle 1", hours=0.75, rpm=1500.0),
            DayPhase(name="move 3", hours=1.0, moving=0.8, rpm=2500.0),
            DayPhase(name="idle 2", hours=1.0),
            DayPhase(name="move 4", hours=1.5, moving=0.5, rpm=3000.0),
            DayPhase(name="off", hours=1.5, on=False),
        ),
    )


def _cold(cycles: int) -> tuple[DayPhase, ...]:
    return (DayPhase(name="measure cold", cycles=cycles),)


def _drift(cycles: int) -> tuple[DayPhase, ...]:
    del cycles
    out = [DayPhase(name="cold", hours=0.5, on=False, read_every_s=DRIFT_EVERY_S)]
    for rpm in (1000.0, 2000.0, 3000.0):
        out.append(DayPhase(name=f"{rpm:.0f} 1/min", hours=8.0, rpm=rpm, read_every_s=DRIFT_EVERY_S))
        out.append(DayPhase(name=f"off after {rpm:.0f} 1/min", hours=15.5, on=False, read_every_s=DRIFT_EVERY_S))
    return tuple(out)


def _parts(cycles: int) -> tuple[DayPhase, ...]:
    out = []
    for i in range(3 * cycles):
        out.append(DayPhase(name=f"part {i + 1}", cycles=1))
        out.append(DayPhase(name=f"cutting {i + 1}", hours=0.5, moving=0.5, rpm=(2500.0, 1200.0, 0.0)[i // 5 % 3]))
    return tuple(out)


USUAL = {
    "spindle_drift": "drift",
    "work_piece": "parts",
    "ball_bar": "cold",
    "grid_encoder": "cold",
    "laser_diagonal": "cold",
}
"""Protocol of an instrument, where it is not the warm-up."""
PRESETS = {"warm_up": _warm_up, "cold": _cold, "drift": _drift, "parts": _parts}


@dataclass(frozen=True)
class Timeline:
    """Every computed instant, in order of time.

    Attributes:
        time_s, rpm: (n,).
        on: (n,), 0 or 1; as `load` and `rpm` it holds until the next instant.
        load: mean speed of each axis over 100 mm/s, (n, axes).
        pose_mm, direction: (n, axes).
        travelling: index of the axis that travels, -1 for none, (n,).
        run: (n,); 0 where no row is written.
        read: whether there is a reading, (n,).
        phase: index of the phase, (n,).
        phases: names.
        more: other channels by name, (n,); see `Cycle.more`.
    """

    time_s: Floats
    on: Floats
    rpm: Floats
    load: Floats
    pose_mm: Floats
    direction: Floats
    travelling: Ints
    run: Ints
    read: Bools
    phase: Ints
    phases: tuple[str, ...]
    more: Mapping[str, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_s)


def make_timeline(machine: Machine, settings: Settings, phases: tuple[DayPhase, ...], cycle: Cycle) -> Timeline:
    """Join the phases.

    Raises:
        ConfigError: there is no reading in any of them, or far too many.
    """
    rows = sum(p.cycles * len(cycle.after_s) + p.hours * 3600.0 / _least_s(p, settings) for p in phases)
    if rows > MOST_ROWS:
        raise ConfigError(f"[[phase]] the day has {rows:.3g} rows; at most {MOST_ROWS} are made")
    book = _Book(machine, settings, cycle)
    for i, phase in enumerate(phases):
        if phase.cycles:
            book.measure(i, phase)
        else:
            book.wait(i, phase)
    if not book.reads:
        raise ConfigError("[[phase]] nothing is read: no phase has cycles or read_every_s")
    return book.close(tuple(p.name for p in phases))


def _least_s(phase: DayPhase, settings: Settings) -> float:
    return min(GRID_S, phase.read_every_s or settings.log_every_s or GRID_S)


class _Book:
    """Collects the instants of the day, phase by phase."""

    def __init__(self, machine: Machine, settings: Settings, cycle: Cycle) -> None:
        self._axes, self._cycle, self._log_every_s = len(machine.axes), cycle, settings.log_every_s
        self._targets: Targets = settings.targets
        self._pieces: list[Mapping[str, NDArray[np.generic]]] = []
        self._time_s, self._run, self.reads = 0.0, 0, 0

    def measure(self, index: int, phase: DayPhase) -> None:
        cycle = self._cycle
        load = cycle.path_mm / cycle.seconds / LOAD_MM_S
        for _ in range(phase.cycles):
            self._add(index, phase, np.array([0.0]), load, run=0, read=False)
            part = np.zeros(len(cycle.after_s), dtype=np.int64) if cycle.part is None else cycle.part
            self._add(index, phase, cycle.after_s, load, run=self._run + 1 + part, read=True, cycle=cycle)
            self._run += 1 + int(part.max())
            self._time_s += cycle.seconds

    def wait(self, index: int, phase: DayPhase) -> None:
        seconds = phase.hours * 3600.0
        feed_mm_s = self._targets.feed_mm_min / 60.0
        moves = np.zeros(self._axes)
        moves[sorted({int(k) for k in self._cycle.travelling if k >= 0})] = 1.0
        load = moves * phase.moving * feed_mm_s / LOAD_MM_S
        every = phase.read_every_s or self._log_every_s
        after = np.arange(0.0, seconds, GRID_S)
        if every is None:
            self._add(index, phase, after, load, run=0, read=False)
        else:
            self._run += 1
            written = np.arange(every, seconds + 1e-6, every)
            fill = np.setdiff1d(after, written)
            self._add(index, phase, fill, load, run=0, read=False)
            self._add(index, phase, written, load, run=self._run, read=phase.read_every_s is not None)
        self._time_s += seconds

    def _add(
        self,
        index: int,
        phase: DayPhase,
        after_s: Floats,
        load: Floats,
        *,
        run: "int | Ints",
        read: bool,
        cycle: Cycle | None = None,
    ) -> None:
        n, here = len(after_s), self._cycle
        full = np.ones(n)
        self.reads += n if read else 0
        self._pieces.append(
            {
                "time_s": self._time_s + after_s,
                "on": full * phase.on,
                "rpm": full * phase.rpm,
                "load": np.tile(load, (n, 1)),
                "pose_mm": here.pose_mm if cycle else np.tile(here.pose_mm[-1], (n, 1)),
                "direction": here.direction if cycle else np.tile(here.direction[-1], (n, 1)),
                "travelling": here.travelling if cycle else np.full(n, -1),
                "run": np.full(n, run),
                "read": np.full(n, read),
                "phase": np.full(n, index),
                **{
                    f"more {name}": values if cycle else _resting(name, values, n) for name, values in here.more.items()
                },
            }
        )

    def close(self, names: tuple[str, ...]) -> Timeline:
        joined = {key: np.concatenate([p[key] for p in self._pieces]) for key in self._pieces[0]}
        order = np.argsort(joined["time_s"], kind="stable")
        ordered = {k: v[order] for k, v in joined.items()}
        more = {k.removeprefix("more "): ordered.pop(k) for k in list(ordered) if k.startswith("more ")}
        return Timeline(**ordered, phases=names, more=more)


def _resting(name: str, values: Floats, n: int) -> Floats:
    """A channel while the machine is at rest after a cycle, (n,)."""
    return np.zeros(n) if name.startswith(("v_", "a_")) else np.full(n, values[-1])


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
