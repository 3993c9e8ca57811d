"""What an example of an effect is, and the states that the laws are tried on."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lsim

from rtec.effects import Effect, effect_class
from rtec.effects.state import State
from rtec.model import FittedEffect, Model
from tests.support.machines import turning_centre

Floats = NDArray[np.float64]
Theta = Mapping[str, float]
MACHINE = turning_centre()
REFERENCE_DEGC = 20.0
DT_S = 45.0


def states(n: int = 60, seed: int = 7) -> State:
    """A warm-up of n instants, DT_S apart: everything that an effect may read varies."""
    rng, rng_more = np.random.default_rng(seed), np.random.default_rng(seed + 1000)
    axes = {
        f"{kind}_{axis}": rng_more.uniform(low, high, n)
        for axis in "xz"
        for kind, low, high in (("v", -250.0, 250.0), ("a", -4000.0, 4000.0), ("s", 0.0, 12.0))
    }
    channels = {
        "x": rng.uniform(0.0, 200.0, n),
        "z": rng.uniform(0.0, 400.0, n),
        "d_x": np.where(rng.random(n) < 0.5, -1.0, 1.0),
        "d_z": np.where(rng.random(n) < 0.5, -1.0, 1.0),
        "spindle_rpm": np.repeat(rng.uniform(300.0, 4000.0, n // 6 + 1), 6)[:n],
        "load_kg": np.repeat([0.0, 120.0, 350.0], n // 3 + 1)[:n],
        "force_n": rng_more.uniform(-900.0, 900.0, n),
        **axes,
        **{name: 20.5 + np.cumsum(rng.uniform(-0.2, 0.5, n)) for name in MACHINE.sensor_names},
    }
    return State(MACHINE, np.arange(n, dtype=np.float64) * DT_S, channels, REFERENCE_DEGC)


def lag(value: Floats, tau_s: float) -> Floats:
    """First-order lag of evenly spaced values by scipy's solver for linear systems; settled at the first."""
    time_s = np.arange(len(value)) * DT_S
    return np.asarray(lsim(([1.0], [tau_s, 1.0]), value - value[0], time_s, interp=True)[1] + value[0])


def scaled(s: State, name: str) -> Floats:
    """Position over the travel as -1 … +1."""
    low, high = MACHINE.axis(name).travel_mm
    return np.interp(s.value(name.lower()), [low, high], [-1.0, 1.0])


@dataclass(frozen=True)
class Example:
    """An effect's arguments, its coefficients' names and units, and its basis by other means."""

    arguments: Mapping[str, Any]
    units: Mapping[str, str]
    basis: Callable[[State, Theta], list[Floats | float]]
    theta: Theta = field(default_factory=dict)

    @property
    def effect(self) -> Effect:
        """The effect itself."""
        return effect_class(self.arguments["effect"], "example").model_validate(dict(self.arguments))

    @property
    def fitted(self) -> FittedEffect:
        """The effect with numbers, all different and none zero."""
        values = {name: 1.5 - 0.7 * i for i, name in enumerate(self.units)}
        return FittedEffect(self.effect, values, dict(self.theta), dict.fromkeys(self.units, 0.01))

    @property
    def model(self) -> Model:
        """A model of this effect alone."""
        return Model(MACHINE, (self.fitted,), reference_degc=REFERENCE_DEGC)

    def __str__(self) -> str:
        extra = [str(v) for k, v in self.arguments.items() if k not in ("effect", "linear", "free")]
        return "-".join([self.arguments["effect"], *extra])[:70]


def example(
    effect: str, component: str, units: Mapping[str, str], basis: Callable[[State, Theta], list[Any]],
    theta: Theta | None = None, **arguments: Any,
) -> Example:  # fmt: skip
    """Give an example; `basis` takes the state and the non-linear parameters."""
    return Example({"effect": effect, "component": component, **arguments}, units, basis, theta or {})


def fixed_theta(basis: Callable[[State], list[Any]]) -> Callable[[State, Theta], list[Any]]:
    """A basis without non-linear parameters."""

    def whole(s: State, theta: Theta) -> list[Any]:
        assert not theta
        return basis(s)

    return whole


def krpm(s: State) -> Floats:
    return np.asarray(s.value("spindle_rpm") / 1000.0)


def rise(s: State, name: str) -> Floats:
    return np.asarray(s.value(name) - REFERENCE_DEGC)
