"""Seeded measurements by any instrument on a machine whose true effects are chosen.

A reading is `arms · true component errors + nuisances`, then noise; for a ball bar it is the exact length. The true
effects depend on the true temperatures; the measurement has the sensors' readings of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.effects import State
from rtec.metrology.instruments.base import Instrument, Nuisance
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.result import Kind, Result
from rtec.sim.campaign.cycle import Cycle, make_cycle, make_path, readings_um
from rtec.sim.campaign.protocol import (
    Timeline,
    make_timeline,
    phases_of,
    sensor_readings_degc,
    temperatures_degc,
    with_noise,
)
from rtec.sim.campaign.settings import Settings

USUAL_NUISANCE = {"um": 5.0, "urad": 20.0, "um_per_m": 10.0, "um_per_m_degc": 0.95}


@dataclass(frozen=True)
class Simulated(Result):
    """A measurement and the truth behind it.

    Attributes:
        measurement: as an instrument would have recorded it.
        components: true component errors by name, µm or µrad, (n,) at the rows of the measurement; without those that
            no effect feeds.
        nuisance_um: contribution of the instrument, (readings, n), in the unit of each reading.
        nuisance: drawn coefficients by name and run (0: the whole set-up).
        clean: readings without noise, (readings, n); NaN where nothing is read.
        true_degc: true temperatures by sensor, (n,).
        phase: name of the phase of each row.
    """

    page_maker: ClassVar[str] = "rtec.report.overview:recorded_page"

    measurement: Measurement
    components: Mapping[str, Floats] = field(repr=False)
    nuisance_um: Floats = field(repr=False)
    nuisance: Mapping[tuple[str, int], float] = field(repr=False)
    clean: Floats = field(repr=False)
    true_degc: Mapping[str, Floats] = field(repr=False)
    phase: tuple[str, ...] = field(repr=False)

    def to_frame(self, kind: Kind | None = None) -> Any:
        """The rows of the measurement; `kind` as for `rtec.result.Shown.to_frame`."""
        return self.measurement.to_frame(kind)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        m, order = self.measurement, dict.fromkeys(self.phase)
        return {
            "rows": len(m),
            "runs": len(np.unique(m.run)),
            "hours": float(m.time_s[-1] - m.time_s[0]) / 3600.0,
            "phases": [{"name": name, "rows": self.phase.count(name)} for name in order],
            "rms_true": {c: float(np.sqrt(np.mean(v**2))) for c, v in self.components.items()},
            "nuisance": [{"name": n, "run": run, "value": v} for (n, run), v in self.nuisance.items()],
            "notes": list(m.notes),
        }


def simulate(
    truth: Model, instrument: Instrument, settings: Settings | None = None, seed: int = 1, name: str = "simulated"
) -> Measurement:
    """Simulate a measurement; the same arguments give the same numbers, bit for bit.

    Args:
        truth: machine and its true effects.
        instrument: instrument with its set-up on that machine.
        settings: targets, protocol, temperatures, noise.
        seed: seed of noise, nuisance parameters and weather.
        name: name of the measurement.

    Raises:
        ConfigError: the settings do not fit machine or instrument.
    """
    return simulate_with_truth(truth, instrument, settings, seed, name).measurement


def simulate_with_truth(
    truth: Model, instrument: Instrument, settings: Settings | None = None, seed: int = 1, name: str = "simulated"
) -> Simulated:
    """As `simulate`, with the truth."""
    settings, machine = settings or Settings(), truth.machine
    # One stream each: more noise of one kind does not change the others.
    weather, sensing, hidden, noise = (np.random.default_rng([seed, 40, i]) for i in range(4))
    cycle = make_path(machine, instrument, settings) or make_cycle(machine, instrument, settings.targets)
    cycle = replace(cycle, more={**_at_rest(truth, cycle), **cycle.more})
    whole = make_timeline(machine, settings, phases_of(settings, instrument), cycle)
    true_degc = temperatures_degc(machine, settings.thermal, whole, weather)
    rows = np.flatnonzero(whole.run > 0)
    run, time_s = whole.run[rows], whole.time_s[rows]
    # Lags need every instant, including those between the rows.
    everywhere = _components(truth, _state(truth, whole, true_degc, np.arange(len(whole))))
    components = {name: values[rows] for name, values in everywhere.items()}
    here = _state(truth, whole, true_degc, rows)
    clean = readings_um(instrument, machine, whole.pose_mm[rows], components)
    added, drawn = _nuisances(instrument.nuisance(here, run), len(clean), run, settings, hidden)
    clean = np.where(_read(instrument, machine.axis_names, whole, rows), clean + added, np.nan)
    shown = {
        column: with_noise(clean[i], time_s, run, settings.noise, noise)
        for i, column in enumerate(instrument.columns())
    }
    sensed = {
        s: sensor_readings_degc(true_degc[s], whole.time_s, settings.thermal.sensors, sensing)[rows] for s in true_degc
    }
    return Simulated(
        measurement=Measurement(
            name=name,
            instrument=instrument,
            machine=machine,
            run=run,
            time_s=time_s,
            channels=_channels(here, sensed) | {name: values[rows] for name, values in whole.more.items()},
            readings=shown,
            notes=(f"simulated, seed {seed}", *cycle.notes),
        ),
        components=components,
        nuisance_um=added,
        nuisance=drawn,
        clean=clean,
        true_degc={s: v[rows] for s, v in true_degc.items()},
        phase=tuple(whole.phases[i] for i in whole.phase[rows]),
    )


def _at_rest(truth: Model, cycle: Cycle) -> dict[str, Floats]:
    """Zero velocities and accelerations for the true effects that need them: the cycle reads at rest."""
    needed = {c for f in truth.effects for c in f.effect.channels(truth.machine)}
    motion = {c for a in truth.machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
    return {c: np.zeros(len(cycle.after_s)) for c in sorted(needed & motion)}


def _state(truth: Model, whole: Timeline, true_degc: Mapping[str, Floats], rows: Ints) -> State:
    channels: dict[str, Floats] = {"spindle_rpm": whole.rpm[rows]}
    channels |= {name: values[rows] for name, values in whole.more.items()}
    for i, axis in enumerate(truth.machine.axes):
        channels[axis.channel] = whole.pose_mm[rows, i]
        channels[axis.direction_channel] = whole.direction[rows, i]
    return truth.state(whole.time_s[rows], {**channels, **{s: v[rows] for s, v in true_degc.items()}})


def _components(truth: Model, state: State) -> dict[str, Floats]:
    """Component errors that any effect feeds, (n,) each."""
    out: dict[str, Floats] = {}
    for fitted, value in zip(truth.effects, truth.effect_components(state), strict=True):
        name = fitted.effect.component
        out[name] = out[name] + value if name in out else value
    return out


def _nuisances(
    nuisances: tuple[Nuisance, ...],
    readings: int,
    run: Ints,
    settings: Settings,
    rng: np.random.Generator,
) -> tuple[Floats, dict[tuple[str, int], float]]:
    """Draw a coefficient for each, or for each and run; give their sum, (readings, n), and the coefficients."""
    total: Floats = np.zeros((readings, len(run)))
    drawn: dict[tuple[str, int], float] = {}
    for nuisance in nuisances:
        sigma = settings.nuisance.get(nuisance.name, settings.nuisance.get(nuisance.name.split()[0]))
        sigma = USUAL_NUISANCE[nuisance.unit] if sigma is None else sigma
        numbers, place = np.unique(run if nuisance.per == "run" else np.zeros_like(run), return_inverse=True)
        values = sigma * rng.standard_normal(len(numbers))
        drawn |= {(nuisance.name, int(k)): float(v) for k, v in zip(numbers, values, strict=True)}
        total = total + nuisance.values * values[place]
    return total, drawn


def _read(instrument: Instrument, axes: tuple[str, ...], whole: Timeline, rows: Ints) -> Bools:
    """Whether each reading is taken in each row, (readings, n)."""
    taken = np.array([instrument.reads_while(name) for name in (*axes, None)])  # index -1: no axis travels
    return np.asarray(taken[whole.travelling[rows]].T & whole.read[rows])


def _channels(here: State, sensed: Mapping[str, Floats]) -> dict[str, Floats]:
    """Positions of all axes, directions of those that ever move, spindle speed, temperatures from the sensors."""
    axes = here.machine.axes
    out = {a.channel: here.value(a.channel) for a in axes}
    directions = {a.direction_channel: here.value(a.direction_channel) for a in axes}
    out |= {name: values for name, values in directions.items() if values.any()}
    return {**out, "spindle_rpm": here.value("spindle_rpm"), **sensed}
