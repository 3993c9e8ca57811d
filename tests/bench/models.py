"""The model that speed is measured with: three axes, 21 component errors, about 200 terms, 16 sensors."""

import numpy as np

from rtec.correction.flags import MODE_ON, Limits
from rtec.effects import EFFECTS
from rtec.loop.records import Samples
from rtec.loop.step import Step, StepSettings
from rtec.machine import Machine, machine_from
from rtec.model import FittedEffect, Model
from rtec.model.model import names_of

SENSORS = tuple(f"T{i}" for i in range(16))
LIMITS = Limits(warning_um=5000, stop_um=10000, slew_um_s=20000, acceleration_um_s2=500000)


def machine() -> Machine:
    """A bridge machine: table X, then Y and Z on the tool side."""
    axis = {"travel_mm": [0, 500], "counts_per_mm": 1000, "pitch_mm": 10.0}
    return machine_from(
        {
            "machine": {"name": "bridge", "tool_chain": ["Y", "Z", "tool"], "work_chain": ["X"]},
            "axis": {name: {"direction": name, **axis} for name in "XYZ"},
            "link": {"tool": {"offset_mm": [0, 0, -100]}},
            "temperature": {name: {} for name in SENSORS},
        },
        "bench",
    )


def model() -> Model:
    """All 18 motions and 3 squarenesses, each with position, direction and temperature terms."""
    m, rng, effects = machine(), np.random.default_rng(0), []

    def add(name: str, theta: list[float] | None = None, **arguments: object) -> None:
        effect = EFFECTS[name].model_validate({"effect": name, **arguments})
        linear, free = names_of(effect, m)
        values = {n: float(rng.normal()) for n in linear}
        effects.append(FittedEffect(effect, values, dict(zip(free, theta or [], strict=True))))

    k = 0
    for axis in "XYZ":
        for letter in "XYZABC":
            component = f"E{letter}{axis}"
            add("polynomial_position", component=component, axis=axis, degrees=(0, 1, 2, 3))
            add("backlash", component=component, axis=axis)
            for lag in (False, False, True):
                tau = [600.0 + k] if lag else None
                add("axis_expansion", tau, component=component, axis=axis, sensor=SENSORS[k % 16], lag=lag)
                k += 1
            for lag in (False, True):
                tau = [900.0 + k] if lag else None
                add("mount_expansion", tau, component=component, sensor=SENSORS[k % 16], lag=lag)
                k += 1
        add("cyclic_screw", [10.0], component=f"E{axis}{axis}", axis=axis, harmonics=2)
    for component in ("EC0Y", "EB0Z", "EA0Z"):
        add("squareness", component=component)
        add("column_tilt", component=component, front="T0", back="T3")
    return Model(m, tuple(effects))


def terms(m: Model) -> int:
    """Number of coefficients."""
    return sum(len(f.values) for f in m.effects)


def settings() -> StepSettings:
    """The step of that model."""
    return StepSettings(model(), dict.fromkeys("XYZ", LIMITS))


def samples(step: Step, n: int) -> Samples:
    """A machine that moves in all axes at 1 kHz, with new temperatures once a second."""
    out = Samples.empty(step.layout, n)
    out.time_ns[:] = 10**9 + np.arange(n) * 1_000_000
    out.mode[:] = MODE_ON
    out.counts_time_ns[:] = out.time_ns
    for j in range(3):
        out.counts[:, j] = 250_000 + 240_000 * np.sin(np.arange(n) / (3000.0 + 1000 * j))
    second = np.arange(n) // 1000
    out.degc[:] = 25.0 + 5.0 * np.sin(second / 1000.0)[:, None]
    out.degc_time_ns[:] = (10**9 + second * 10**9)[:, None]
    out.spindle_rpm[:] = 1000.0
    return out
