"""One or more instances of every effect, each with its own equation written out once more.

`EXAMPLES` is what the laws in test_effects_laws.py run over; an effect of the registry that has no instance here or in
effect_examples_motion.py fails a law of its own.
"""

from typing import Any

import numpy as np
from numpy.polynomial import legendre

from rtec.effects.state import State
from rtec.model import Model
from tests.support.effect_example import (  # fmt: skip
    MACHINE,
    REFERENCE_DEGC,
    Example,
    Theta,
    example,
    fixed_theta,
    krpm,
    lag,
    rise,
    scaled,
    states,
)
from tests.support.effect_examples_motion import OF_MOTION, OF_TIME_AND_LOAD

__all__ = ["EXAMPLES", "MACHINE", "Example", "everything", "states"]


def hats(s: State) -> list[Any]:
    knots = [20.0, 50.0, 120.0, 180.0]
    return [np.interp(s.value("x"), knots, row) for row in np.eye(4)]


def waves(s: State, theta: Theta) -> list[Any]:
    turn = 2 * np.pi * s.value("x") / theta["pitch"]
    return [f(k * turn) for k in (1, 2, 3) for f in (np.sin, np.cos)]


def turns(s: State, theta: Theta, channel: str = "x") -> list[Any]:
    wave = np.exp(2j * np.pi * s.value(channel) / theta["period"])
    return [wave.imag, wave.real]


def bow(s: State) -> list[Any]:
    return [legendre.legval(scaled(s, "X"), row) for row in ([0, 0, 1], [0, 0, 0, 1])]


OF_PLACE_AND_HEAT: tuple[Example, ...] = (
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
    example(
        "coupling_misalignment", "EXX", {"s": "um", "c": "um"}, turns, {"period": 2.51}, axis="X",
    ),
    example(
        "interpolation_error", "EZZ", {"s": "um", "c": "um"},
        fixed_theta(lambda s: turns(s, {"period": 0.04}, "z")), axis="Z", lambda_mm=0.04,
    ),
    example("cyclic_pole", "EXX", {"s": "um", "c": "um"}, turns, {"period": 16.3}, axis="X"),
    example(
        "cyclic_pole", "EXX", {"s": "um_per_degc", "c": "um_per_degc"},
        lambda s, t: [w * rise(s, "T_bed") for w in turns(s, t)], {"period": 16.3}, axis="X", grows_with="T_bed",
    ),
    example(
        "cyclic_screw", "EXX", {f"{k}{i}": "um_per_100kg" for i in (1, 2, 3) for k in "sc"},
        lambda s, t: [w * s.value("load_kg") / 100 for w in waves(s, t)], {"pitch": 5.01},
        axis="X", harmonics=3, grows_with="load_kg",
    ),
    example(
        "coupling_misalignment", "EXX", {"s": "um_per_krpm", "c": "um_per_krpm"},
        lambda s, t: [w * krpm(s) for w in turns(s, t)], {"period": 2.51}, axis="X", grows_with="spindle_rpm",
    ),
    example("straightness", "EYX", {"c2": "um", "c3": "um"}, fixed_theta(bow), axis="X"),
    example("angular_motion", "ECX", {"c2": "urad", "c3": "urad"}, fixed_theta(bow), axis="X"),
    example("guide_curvature", "EBX", {"k": "urad_per_m"}, fixed_theta(lambda s: [s.value("x") / 1000]), axis="X"),
    example("guide_twist", "EAX", {"k": "urad_per_m"}, fixed_theta(lambda s: [s.value("x") / 1000]), axis="X"),
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
        "axis_expansion", "EXX", {"k": "um_per_m_degc"},
        lambda s, t: [s.value("x") / 1000 * np.clip(s.value("T_bed") - t["T0"], 0.0, None)], {"T0": 23.5},
        axis="X", sensor="T_bed", stretched=True,
    ),
    example(
        "axis_expansion", "EZZ", {"k": "um_per_m_degc"},
        lambda s, t: [s.value("z") / 1000 * np.clip(lag(s.value("T_bed"), t["tau"]) - t["T0"], 0.0, None)],
        {"tau": 900.0, "T0": 22.0}, axis="Z", sensor="T_bed", lag=True, stretched=True,
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
        "column_tilt", "EB0turret", {"k": "urad_per_degc"},
        lambda s, t: [lag(s.value("T_column") - s.value("T_air"), t["tau"])], {"tau": 2400.0},
        front="T_column", back="T_air", lag=True,
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
        "spindle_speed_shift", "EZ0spindle", {"c": "um_per_krpm2"}, fixed_theta(lambda s: [krpm(s) ** 2]),
    ),
    example(
        "bed_bending", "EYZ", {"k": "um_per_degc"},
        fixed_theta(lambda s: [(s.value("T_bed") - s.value("T_air")) * scaled(s, "Z") ** 2]),
        axis="Z", front="T_bed", back="T_air",
    ),
    example(
        "bed_bending", "EXZ", {"k": "um_per_degc"},
        lambda s, t: [lag(s.value("T_bed") - s.value("T_air"), t["tau"]) * scaled(s, "Z") ** 2], {"tau": 900.0},
        axis="Z", front="T_bed", back="T_air", lag=True,
    ),
    example(
        "bed_bending", "EBX", {"k": "urad_per_degc"},
        fixed_theta(lambda s: [(s.value("T_bed") - s.value("T_air")) * scaled(s, "X")]),
        axis="X", front="T_bed", back="T_air",
    ),
    example(
        "coolant_expansion", "EX0workpiece", {"k": "um_per_degc"}, fixed_theta(lambda s: [rise(s, "T_air")]),
        sensor="T_air",
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

EXAMPLES = (*OF_PLACE_AND_HEAT, *OF_MOTION, *OF_TIME_AND_LOAD)


def everything() -> Model:
    """One model of all examples."""
    return Model(MACHINE, tuple(e.fitted for e in EXAMPLES), reference_degc=REFERENCE_DEGC)
