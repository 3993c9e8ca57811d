"""One or more instances of every effect, each with its own equation written out once more.

`EXAMPLES` is what the laws in test_effects_laws.py run over; an effect of the registry that has no instance here
fails a law of its own.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.signal import lsim

from rtec.effects import Effect, effect_class
from rtec.effects.state import State
from rtec.model import FittedEffect, Model
from tests.machines import turning_centre

Floats = NDArray[np.float64]
Theta = Mapping[str, float]
MACHINE = turning_centre()
REFERENCE_DEGC = 20.0
DT_S = 45.0


def states(n: int = 60, seed: int = 7) -> State:
    """A warm-up of n instants, DT_S apart: positions, directions, speeds and temperatures all vary."""
    rng = np.random.default_rng(seed)
    channels = {
        "x": rng.uniform(0.0, 200.0, n),
        "z": rng.uniform(0.0, 400.0, n),
        "d_x": np.where(rng.random(n) < 0.5, -1.0, 1.0),
        "d_z": np.where(rng.random(n) < 0.5, -1.0, 1.0),
        "spindle_rpm": np.repeat(rng.uniform(300.0, 4000.0, n // 6 + 1), 6)[:n],
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


def hats(s: State) -> list[Any]:
    knots = [20.0, 50.0, 120.0, 180.0]
    return [np.interp(s.value("x"), knots, row) for row in np.eye(4)]


def waves(s: State, theta: Theta) -> list[Any]:
    turn = 2 * np.pi * s.value("x") / theta["pitch"]
    return [f(k * turn) for k in (1, 2, 3) for f in (np.sin, np.cos)]


def krpm(s: State) -> Floats:
    return np.asarray(s.value("spindle_rpm") / 1000.0)


def rise(s: State, name: str) -> Floats:
    return np.asarray(s.value(name) - REFERENCE_DEGC)


EXAMPLES: tuple[Example, ...] = (
    example("scale", "EXX", {"k": "um_per_m"}, fixed_theta(lambda s: [s.value("x") / 1000]), axis="X"),
    example("scale", "EBX", {"k": "urad_per_m"}, fixed_theta(lambda s: [s.value("x") / 1000]), axis="X"),
    example(
        "polynomial_position", "EZX", {"c1": "um", "c2": "um"},
        fixed_theta(lambda s: [legendre.legval(scaled(s, "X"), row) for row in ([0, 1], [0, 0, 1])]), axis="X",
    ),
    example(
        "polynomial_position", "EAZ", {"c0": "urad", "c7": "urad", "c4": "urad"},
        fixed_theta(lambda s: [legendre.legval(scaled(s, "Z"), np.eye(9)[i]) for i in (0, 7, 4)]),
        axis="Z", degrees=[0, 7, 4],
    ),
    example(
        "polynomial_position", "EYX", {"c0": "um"}, fixed_theta(lambda _: [1.0]), axis="X", degrees=[0],
    ),
    example(
        "piecewise_position", "EXZ", {f"at{i}": "um" for i in range(4)}, fixed_theta(hats),
        axis="X", knots_mm=[20.0, 50.0, 120.0, 180.0],
    ),
    example("squareness", "EB0X", {"alpha": "urad"}, fixed_theta(lambda _: [1.0])),
    example("parallelism", "EB0Z", {"alpha": "urad"}, fixed_theta(lambda _: [1.0])),
    example(
        "cyclic_screw", "EXX", {f"{k}{i}": "um" for i in (1, 2, 3) for k in "sc"}, waves, {"pitch": 5.01},
        axis="X", harmonics=3,
    ),
    example("backlash", "EZZ", {"B": "um"}, fixed_theta(lambda s: [s.value("d_z") / 2]), axis="Z"),
    example(
        "backlash_position", "EBZ", {"b0": "urad", "b1": "urad", "b2": "urad"},
        fixed_theta(lambda s: [s.value("d_z") * scaled(s, "Z") ** i for i in range(3)]), axis="Z",
    ),
    example(
        "backlash_position", "EYZ", {"b0": "um"}, fixed_theta(lambda s: [s.value("d_z")]), axis="Z", degree=0,
    ),
    example(
        "axis_expansion", "EXX", {"k": "um_per_m_degc"},
        fixed_theta(lambda s: [(s.value("x") + 30.0) / 1000 * rise(s, "T_bed")]),
        axis="X", sensor="T_bed", fixed_mm=-30.0,
    ),
    example(
        "axis_expansion", "ECZ", {"k": "urad_per_m_degc"},
        lambda s, t: [s.value("z") / 1000 * lag(rise(s, "T_bed"), t["tau"])], {"tau": 600.0},
        axis="Z", sensor="T_bed", lag=True,
    ),
    example(
        "axis_expansion_nonuniform", "EZZ", {"k": "um_per_degc"},
        fixed_theta(lambda s: [scaled(s, "Z") ** 2 * rise(s, "T_column")]), axis="Z", sensor="T_column",
    ),
    example(
        "mount_expansion", "EX0turret", {"k": "um_per_degc"}, fixed_theta(lambda s: [rise(s, "T_column")]),
        sensor="T_column",
    ),
    example(
        "mount_expansion", "EX0tool", {"k": "um_per_degc"}, lambda s, t: [lag(rise(s, "T_air"), t["tau"])],
        {"tau": 90.0}, sensor="T_air", lag=True,
    ),
    example(
        "ambient_drift", "EZ0workpiece", {"k": "um_per_degc"}, lambda s, t: [lag(rise(s, "T_air"), t["tau"])],
        {"tau": 5000.0}, sensor="T_air",
    ),
    example(
        "column_tilt", "EA0turret", {"k": "urad_per_degc"},
        fixed_theta(lambda s: [s.value("T_column") - s.value("T_air")]), front="T_column", back="T_air",
    ),
    example(
        "spindle_growth", "EZ0spindle", {"k": "um_per_degc"}, fixed_theta(lambda s: [rise(s, "T_spindle")]),
        sensor="T_spindle",
    ),
    example(
        "spindle_growth", "EX0spindle", {"k": "um_per_degc"}, lambda s, t: [lag(rise(s, "T_spindle"), t["tau"])],
        {"tau": 700.0}, sensor="T_spindle", lag=True,
    ),
    example(
        "spindle_growth", "EY0spindle", {"k": "um_per_krpm_to_p"}, lambda s, t: [lag(krpm(s) ** t["p"], t["tau"])],
        {"tau": 800.0, "p": 1.4},
    ),
    example(
        "spindle_tilt", "EB0spindle", {"k": "urad_per_degc"}, fixed_theta(lambda s: [rise(s, "T_spindle")]),
        sensor="T_spindle",
    ),
    example(
        "spindle_tilt", "EA0spindle", {"k": "urad_per_krpm_to_p"}, lambda s, t: [lag(krpm(s) ** t["p"], t["tau"])],
        {"tau": 1200.0, "p": 0.8},
    ),
    example(
        "expression", "ECX", {"a": "urad_per_mm", "b": "urad_per_degc"},
        lambda s, t: [s.value("x") * np.sin(s.value("z") / t["w"]), s.value("d_x") * lag(rise(s, "T_bed"), t["tau"])],
        {"w": 70.0, "tau": 333.0},
        expression="a*x*sin(z/w) + b*d_x*lag(T_bed, tau)", linear={"a": "urad_per_mm", "b": "urad_per_degc"},
        free={"w": {"start": 50.0, "low": 1.0, "high": 500.0, "unit": "mm"},
              "tau": {"start": 300.0, "low": 10.0, "high": 5000.0, "unit": "s"}},
    ),
)  # fmt: skip


def everything() -> Model:
    """One model of all examples."""
    return Model(MACHINE, tuple(e.fitted for e in EXAMPLES), reference_degc=REFERENCE_DEGC)
