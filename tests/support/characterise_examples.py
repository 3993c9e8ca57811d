"""Measurements for the tests of the fit: small, of instruments written here, with truths chosen here."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Ints
from rtec.effects import Effect, State, effect_class
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument, InstrumentSetup, Nuisance
from rtec.metrology.measurement import Measurement
from tests.support.machines import turning_centre

Floats = NDArray[np.float64]
MACHINE = turning_centre()


class ProbeSetup(InstrumentSetup):
    """How the zero is taken, and whether there is a slope beside it."""

    zero: Literal["run", "setup", "none"] = "run"
    slope: Literal["run", "setup", "none"] = "none"


@dataclass(frozen=True)
class Probe(Instrument):
    """Reads one component as it is."""

    name = "probe"
    title = "Probe of the tests"
    setup_model = ProbeSetup
    setup: ProbeSetup

    def columns(self) -> tuple[str, ...]:
        return ("reading_um",)

    def arms(self, machine: Machine, pose_mm: Floats) -> Floats:
        out = np.zeros((1, len(pose_mm), len(machine.components)))
        out[..., machine.components.index(self.component or "")] = 1.0
        return out

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        del run
        n, out = len(state), []
        for name, per, values in (
            ("zero", self.setup.zero, np.ones(n)),
            ("slope", self.setup.slope, state.positions_mm()[:, 0] * 1e-2),
        ):
            if per != "none":
                out.append(Nuisance(name, "um", values[None], per))
        return tuple(out)


@dataclass(frozen=True)
class Tip(Instrument):
    """Reads the tool tip along X and Z, each with its own zero."""

    name = "tip"
    title = "Tool tip of the tests"
    setup_model = ProbeSetup
    setup: ProbeSetup

    def columns(self) -> tuple[str, ...]:
        return ("reading_x_um", "reading_z_um")

    def arms(self, machine: Machine, pose_mm: Floats) -> Floats:
        return np.asarray(machine.chain.jacobian(pose_mm)[:, [0, 2]].transpose(1, 0, 2))

    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        del run
        if self.setup.zero == "none":
            return ()
        ones = np.eye(2)[:, :, None] * np.ones(len(state))
        return tuple(Nuisance(f"zero {c}", "um", ones[i], self.setup.zero) for i, c in enumerate("XZ"))


def effect(name: str, component: str, **more: Any) -> Effect:
    """An effect without numbers."""
    return effect_class(name, "test").model_validate({"effect": name, "component": component, **more})


def runs(lengths: list[int]) -> Ints:
    """Run numbers, 1 …, of given lengths."""
    return np.repeat(np.arange(1, len(lengths) + 1), lengths)


def channels(run: Ints, seed: int = 1, hours: float = 8.0) -> tuple[Floats, dict[str, Floats]]:
    """Time and channels; four temperatures that part in time.

    There and back along X in 40 rows, Z to and fro about another place in each run.
    """
    rng, n = np.random.default_rng(seed), len(run)
    time = np.linspace(0.0, hours * 3600.0, n)
    h = time / 3600.0
    start = np.concatenate([[0], np.flatnonzero(np.diff(run)) + 1])
    place = (np.arange(n) - np.repeat(start, np.diff(np.append(start, n)))) / 20.0 % 2.0
    forth = np.where(place < 1.0, 1.0, -1.0)
    x = np.where(forth > 0, place, 2.0 - place) * 180.0 + 10.0 + rng.uniform(-2.0, 2.0, n)
    return time, {
        "x": x,
        "z": 200.0 + 120.0 * np.sin(run * 1.3) + 50.0 * np.sin(0.7 * np.arange(n)),
        "d_x": forth,
        "d_z": np.where(np.cos(0.7 * np.arange(n)) > 0, 1.0, -1.0),
        "T_spindle": 22.0 + 12.0 * np.sin(h * 1.1) ** 2 + 0.01 * rng.standard_normal(n),
        "T_bed": 20.5 + 6.0 * (1.0 - np.exp(-h / 3.0)) + 0.01 * rng.standard_normal(n),
        "T_column": 21.0 + 2.5 * np.cos(0.9 * h) + 0.01 * rng.standard_normal(n),
        "T_air": 20.0 + 2.0 * np.sin(0.35 * h + 1.0) + 0.01 * rng.standard_normal(n),
    }


def measurement(
    run: Ints,
    truth: Mapping[str, Floats] | None = None,
    *,
    name: str = "m",
    instrument: Instrument | None = None,
    seed: int = 1,
    noise_um: float = 0.2,
    hours: float = 8.0,
) -> Measurement:
    """A measurement of true readings by column name, with noise and the zero of each run (or of all)."""
    rng = np.random.default_rng([seed, 7])
    instrument = instrument or Probe(ProbeSetup(), component="EXX")
    time, there = channels(run, seed, hours)
    each_run = getattr(instrument.setup, "zero", "run") == "run"
    readings = {}
    for column in instrument.columns():
        true = (truth or {}).get(column, np.zeros(len(run)))
        zeros = rng.normal(0.0, 5.0, int(run.max()) + 1)[run if each_run else np.zeros_like(run)]
        readings[column] = true + zeros + noise_um * rng.standard_normal(len(run))
    return Measurement(name, instrument, MACHINE, run, time, there, readings)
