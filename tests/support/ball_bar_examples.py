# ruff: noqa: ARG005 - every row has the same arguments, as in the table
"""Ball-bar tests for the tests, and [BB]'s machine worked out without anything of rtec's.

`bb_reading_um` is [BB 6-7, 14, 16, 20, 23] without any series: where the moving ball really is, and how far from the
fixed one. The table of characteristic functions is in `ROWS`, as printed on the page of mathematics.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine
from rtec.metrology.files.columns import on_circle
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.machines import axis, machine

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def gantry(**more: Any) -> Machine:
    """[BB]'s machine: X rides on Y; nothing between the axes and the ball. `more` goes into every axis' table."""
    return machine("gantry", ["Y", "X", "Z"], [], {k: axis(k, travel_mm=[-400.0, 400.0], **more) for k in "XYZ"})


def bar(m: Machine, **setup: Any) -> BallBar:
    """A ball bar about the origin of `m`."""
    usual = {"plane": "XY", "centre_mm": [0, 0, 0], "radius_mm": 150.0, "direction": "ccw", "feed_mm_min": 1000.0}
    out = make_instrument("ball_bar", {**usual, **setup}, None, None, m, "test")
    assert isinstance(out, BallBar)
    return out


def recorded(
    m: Machine, instrument: BallBar, angle_deg: Floats, reading_um: Floats, name: str = "test", run: Ints | None = None
) -> Measurement:
    """A recording as a file with angles would give it; of one run where none are given."""
    n = len(angle_deg)
    run = np.ones(n, dtype=np.int64) if run is None else run
    channels = on_circle(instrument, m, {"angle_deg": np.asarray(angle_deg, dtype=np.float64)}, run, name)
    return Measurement(name, instrument, m, run, np.arange(float(n)), channels, {"reading_um": reading_um})


def bb_reading_um(zeta: Floats, r0: float, h: float, s: int, moved_um: Floats | None = None, **p: float) -> Floats:
    """[BB]'s moving ball, exactly. r0, h mm; ex ey dx dy µm; psi and angles rad; rho m; kappa rad/m.

    Clearance is the mechanism: the axis lags half of it behind on either flank. `moved_um`, (n, 3), is added to the
    ball's place.
    """
    g = {"ex": 0.0, "ey": 0.0, "dx": 0.0, "dy": 0.0, "Sx": 1.0, "Sy": 1.0, "psi": 0.0, "phix": 0.0, "phiy": 0.0} | p
    x, y = r0 * np.cos(zeta + s * g["psi"]) - g["ex"] * 1e-3, r0 * np.sin(zeta) - g["ey"] * 1e-3
    x, y = g["Sx"] * x, g["Sy"] * y
    x = x - 0.5e-3 * g["dx"] * np.sign(-s * np.sin(zeta))
    y = y - 0.5e-3 * g["dy"] * np.sign(s * np.cos(zeta))
    along_x, along_y = x.copy(), y.copy()
    z = np.full_like(zeta, -h)
    z += -g["phix"] * along_x + g["phiy"] * along_y
    y = y + g.get("thetax", 0.0) * along_x
    if "rho_yaw_x" in g:
        rho = g["rho_yaw_x"] * 1e3
        x, y = rho * np.sin(along_x / rho), y - rho * (1.0 - np.cos(along_x / rho))
    if "rho_yaw_y" in g:
        rho = g["rho_yaw_y"] * 1e3
        x, y = x - rho * (1.0 - np.cos(along_y / rho)), y - along_y + rho * np.sin(along_y / rho)
    if "rho_pitch_x" in g:
        z += g["rho_pitch_x"] * 1e3 * (1.0 - np.cos(along_x / (g["rho_pitch_x"] * 1e3)))
    if "rho_pitch_y" in g:
        z -= g["rho_pitch_y"] * 1e3 * (1.0 - np.cos(along_y / (g["rho_pitch_y"] * 1e3)))
    z += np.sin(g.get("kappa", 0.0) * along_y * 1e-3) * along_x
    if moved_um is not None:
        x, y, z = x + moved_um[:, 0] * 1e-3, y + moved_um[:, 1] * 1e-3, z + moved_um[:, 2] * 1e-3
    return np.asarray((np.sqrt(x**2 + y**2 + z**2) - np.hypot(r0, h)) * 1e3, dtype=np.float64)


Row = Callable[[Floats, float, float, float, int], Floats]
"""ζ, λ, r0 mm, h mm, s -> µm for one unit of the parameter (µm, µrad, 1/km, µrad/m)."""
Shape = Callable[[Floats, float, int], Mapping[str, Floats]]
"""ζ, r0 mm, s -> the component errors that one unit is on [BB]'s machine, µm or µrad."""
ROWS: dict[str, tuple[Row, Shape, float]] = {
    # parameter: row of the table, the component errors that it is on [BB]'s machine, a size
    "scale_x": (
        lambda z, lam, r, h, s: lam * r * 1e-3 * np.cos(z) ** 2,
        lambda z, r, s: {"EXX": r * np.cos(z) * 1e-3},
        20.0,
    ),
    "scale_y": (
        lambda z, lam, r, h, s: lam * r * 1e-3 * np.sin(z) ** 2,
        lambda z, r, s: {"EYY": r * np.sin(z) * 1e-3},
        -15.0,
    ),
    "squareness": (
        lambda z, lam, r, h, s: lam * r * 1e-3 * np.sin(2 * z) / 2,
        lambda z, r, s: {"EC0X": np.ones_like(z)},
        30.0,
    ),
    "perpendicularity_x": (
        lambda z, lam, r, h, s: lam * h * 1e-3 * np.cos(z),
        lambda z, r, s: {"EB0X": np.ones_like(z)},
        25.0,
    ),
    "perpendicularity_y": (
        lambda z, lam, r, h, s: -lam * h * 1e-3 * np.sin(z),
        lambda z, r, s: {"EA0Y": np.ones_like(z)},
        25.0,
    ),
    "phase": (
        lambda z, lam, r, h, s: -lam * s * r * 1e-3 * np.sin(2 * z) / 2,
        lambda z, r, s: {"EXX": -s * r * 1e-3 * np.sin(z)},
        40.0,
    ),
    "yaw_x": (
        lambda z, lam, r, h, s: -lam * r**2 * 1e-3 * np.sin(z) * np.cos(z) ** 2 / 2,
        lambda z, r, s: {"EYX": -((r * np.cos(z)) ** 2) / 2 * 1e-3},
        0.2,
    ),
    "yaw_y": (
        lambda z, lam, r, h, s: -lam * r**2 * 1e-3 * np.sin(z) ** 2 * np.cos(z) / 2,
        lambda z, r, s: {"EXY": -((r * np.sin(z)) ** 2) / 2 * 1e-3},
        0.2,
    ),
    "pitch_x": (
        lambda z, lam, r, h, s: -lam * h * r * 1e-3 * np.cos(z) ** 2 / 2,
        lambda z, r, s: {"EZX": (r * np.cos(z)) ** 2 / 2 * 1e-3},
        -0.3,
    ),
    "pitch_y": (
        lambda z, lam, r, h, s: lam * h * r * 1e-3 * np.sin(z) ** 2 / 2,
        lambda z, r, s: {"EZY": -((r * np.sin(z)) ** 2) / 2 * 1e-3},
        0.3,
    ),
    "twist": (
        lambda z, lam, r, h, s: -lam * h * r * 1e-6 * np.sin(2 * z) / 2,
        lambda z, r, s: {"EBY": -r * np.sin(z) * 1e-3},
        150.0,
    ),
    "clearance_x": (  # the flank of motion to minus has no error, and the fixed ball is moved by half of it
        lambda z, lam, r, h, s: np.where(np.sin(z) * s > 0, 0.0, -lam * np.cos(z)) + lam * np.cos(z) / 2,
        lambda z, r, s: {"EXX": -0.5 * np.sign(-s * np.sin(z))},
        6.0,
    ),
    "clearance_y": (
        lambda z, lam, r, h, s: np.where(-np.cos(z) * s > 0, 0.0, -lam * np.sin(z)) + lam * np.sin(z) / 2,
        lambda z, r, s: {"EYY": -0.5 * np.sign(s * np.cos(z))},
        6.0,
    ),
}
