"""Examples of effects of reversal, motion, load and time; `OF_MOTION` and `OF_TIME_AND_LOAD` are in EXAMPLES.

Oracles by other means: exponentials as distributions of scipy, powers by logarithms, a day's swing by complex numbers.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.polynomial import legendre
from scipy import stats

from rtec.effects.state import State
from tests.support.effect_example import Example, Floats, Theta, example, fixed_theta, lag, rise, scaled


def turned(s: State, value: Any) -> list[Any]:
    """Plus half of it moving positive, minus half of it moving negative."""
    return [np.where(s.value("d_x") > 0, 0.5, -0.5) * value]


def swelling(off: Any, p: float) -> Any:
    """The generalised normal distribution of scipy, one in the middle."""
    return stats.gennorm.pdf(off, p) / stats.gennorm.pdf(0.0, p)


def hours(s: State) -> Floats:
    return np.asarray(s.time_s / 3600.0)


def day(s: State) -> list[Any]:
    hand = np.exp(2j * np.pi * hours(s) / 24.0)
    return [hand.imag, hand.real]


def slipped(s: State, theta: Theta) -> list[Any]:
    return [np.interp(s.time_s, [theta["t0"] - 0.5, theta["t0"] + 0.5], [0.0, 1.0])]


def crossed(*degrees: tuple[int, int]) -> Callable[[State], list[Any]]:
    def products(s: State) -> list[Any]:
        weights = np.zeros((len(degrees), 3, 3))
        for c, (along, across) in zip(weights, degrees, strict=True):
            c[along, across] = 1.0
        return [legendre.legval2d(scaled(s, "X"), scaled(s, "Z"), c) for c in weights]

    return products


OF_MOTION: tuple[Example, ...] = (
    example(
        "backlash_temperature", "EXX", {"k": "um_per_degc"}, fixed_theta(lambda s: turned(s, rise(s, "T_bed"))),
        axis="X", sensor="T_bed",
    ),
    example(
        "backlash_temperature", "EZZ", {"k": "um_per_degc"},
        lambda s, t: [np.where(s.value("d_z") > 0, 0.5, -0.5) * lag(rise(s, "T_bed"), t["tau"])], {"tau": 400.0},
        axis="Z", sensor="T_bed", lag=True,
    ),
    example(
        "backlash_zone", "EXX", {"B": "um"},
        lambda s, t: turned(s, swelling((s.value("x") - t["q0"]) / t["w"], t["p"])),
        {"q0": 130.0, "w": 45.0, "p": 2.7}, axis="X",
    ),
    example("backlash_load", "EXX", {"k": "um_per_100kg"},
            fixed_theta(lambda s: turned(s, s.value("load_kg") / 100.0)), axis="X"),
    example("backlash_wear", "EXX", {"w": "um_per_h"}, fixed_theta(lambda s: turned(s, hours(s))), axis="X"),
    example("angular_reversal", "EBX", {"theta": "urad"}, fixed_theta(lambda s: turned(s, 1.0)), axis="X"),
    example(
        "lost_motion", "EXX", {"A": "um"}, lambda s, t: turned(s, stats.expon.sf(s.value("s_x"), scale=t["s0"])),
        {"s0": 1.7}, axis="X",
    ),
    example(  # the density of a gamma distribution of shape 2 has its top, 1/(e s0), at s0
        "reversal_spike", "EXX", {"A": "um"},
        lambda s, t: turned(s, stats.gamma.pdf(s.value("s_x"), 2, scale=t["s0"]) * t["s0"] * np.e),
        {"s0": 0.8}, axis="X",
    ),
    example(
        "stribeck", "EXX", {"A": "um"},
        lambda s, t: turned(s, stats.expon.sf(np.abs(s.value("v_x")), scale=t["v_s"])), {"v_s": 25.0}, axis="X",
    ),
    example("servo_lag", "EZZ", {"tau": "um_s_per_mm"}, fixed_theta(lambda s: [s.value("v_z")]), axis="Z"),
    example(
        "servo_lag", "EXX", {"tau": "um_s_per_mm"},
        lambda s, t: [s.value("v_x") * stats.expon.cdf(s.value("s_x"), scale=np.abs(s.value("v_x")) * t["T"])],
        {"T": 0.04}, axis="X", builds_up=True,
    ),
    example("servo_phase", "EZZ", {"tau": "um_s_per_mm"}, fixed_theta(lambda s: [s.value("v_z") / 2]), axis="Z"),
    example(
        "change_over", "EXX", {"tau": "um_s_per_mm"},
        fixed_theta(lambda s: [np.where(s.value("v_x") ** 2 < s.value("v_z") ** 2, s.value("v_x"), 0.0)]),
        axis="X", other="Z",
    ),
    example(
        "guide_lift", "EYX", {"A": "um"},
        lambda s, t: [np.exp(t["q"] * np.log(np.abs(s.value("v_x")) / 100.0))], {"q": 0.6}, axis="X",
    ),
    example(
        "inertia", "EBX", {"k": "urad_s2_per_m"}, fixed_theta(lambda s: [s.value("a_x") / 1000.0]), axis="X",
    ),
)  # fmt: skip

OF_TIME_AND_LOAD: tuple[Example, ...] = (
    example(
        "ram_sag", "EXZ", {"c1": "um", "c2": "um"},
        fixed_theta(lambda s: [np.polyval(p, s.value("z") / 400.0) for p in ([1, 0, 0], [1, 0, 0, 0])]), axis="Z",
    ),
    example(
        "cross_talk", "EBX", dict.fromkeys(("c11", "c21", "c12", "c22"), "urad"),
        fixed_theta(crossed((1, 1), (2, 1), (1, 2), (2, 2))), axis="X", other="Z",
    ),
    example(
        "cross_talk", "EZX", dict.fromkeys(("c12", "c22"), "um"), fixed_theta(crossed((1, 2), (2, 2))),
        axis="X", other="Z",
    ),
    example(
        "load_deformation", "EYX", dict.fromkeys("abc", "um_per_100kg"),
        fixed_theta(lambda s: list((np.vander(scaled(s, "X"), 3, increasing=True).T * s.value("load_kg")) / 100.0)),
        axis="X",
    ),
    example("force_deflection", "EX0tool", {"k": "um_per_kn"}, fixed_theta(lambda s: [s.value("force_n") / 1000.0])),
    example("daily_drift", "EY0workpiece", {"s": "um", "c": "um"}, fixed_theta(day)),
    example("wear_drift", "EX0tool", {"w": "um_per_h"}, fixed_theta(lambda s: [hours(s)])),
    # 450.2 s: one of the instants, which are 45 s apart, falls into the second that the step takes
    example("missed_counts", "EXX", {"q": "um"}, slipped, {"t0": 450.2}, axis="X"),
)  # fmt: skip
