"""What [BB] leaves out, worked out without anything of rtec's: how it moves the ball at the tool, for circles about 0.

Parameters: delay ms by which X leads Y; gain_x gain_y µm for each m/s²; spike_x spike_y and their `_way` mm or `_ms`;
play_x (along Y) play_y (along X) µm; cyclic_x cyclic_y µm at `pitch` mm; gamma_x gamma_y degrees; change_over ms;
slope_x slope_y µm/m; bow_x bow_y µm/m²; lift_x lift_y µm (play along Z).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from tests.support.ball_bar_examples import bar, bb_reading_um, gantry, recorded

Floats = NDArray[np.float64]
DEG = np.pi / 180.0
PITCH_MM = 10.0


@dataclass(frozen=True)
class Test:
    """A circle: height, radius, mm, sense, feed."""

    __test__ = False
    h: float
    r: float
    sense: str
    feed: float = 1000.0


THREE = (Test(0.0, 150.0, "ccw"), Test(30.0, 146.969, "cw"), Test(30.0, 146.969, "ccw"))
TWO_FEEDS = (*THREE, Test(0.0, 150.0, "cw", 3000.0))


def screw_machine() -> Machine:
    """[BB]'s machine with screws of 10 mm."""
    return gantry(pitch_mm=PITCH_MM)


def since_turn(zeta: Floats, s: int, place: int) -> Floats:
    """Angle since X (0) or Y (1) turned round: X at 0 and π, Y at π/2 and 3π/2."""
    return np.asarray((s * (zeta - place * np.pi / 2)) % np.pi)


def joint_um(position_mm: Floats, pitch_mm: float, gamma_deg: float) -> Floats:
    """[BB 21]: a universal joint out of line: out = atan(tan(in) cos γ), taken up to the turn."""
    turn = 2 * np.pi * position_mm / pitch_mm
    off = turn - np.round(turn / np.pi) * np.pi
    return np.asarray((np.arctan(np.tan(off) * np.cos(gamma_deg * DEG)) - off) * pitch_mm / (2 * np.pi) * 1e3)


def spike_of(way: Floats, omega: float, angle: Floats, p: Mapping[str, float], name: str) -> Floats:
    """A spike's shape: `u exp(1 - u)` on the way, or (`_ms`) half a sine in time."""
    if f"{name}_ms" in p:
        part = angle / omega / (p[f"{name}_ms"] * 1e-3)
        return np.where(part < 1.0, np.sin(np.pi * np.minimum(part, 1.0)), 0.0)
    u = way / p.get(f"{name}_way", 0.2)
    return np.asarray(u * np.exp(1.0 - u))


def moved_um(zeta: Floats, t: Test, p: Mapping[str, float]) -> Floats:
    """How far the ball at the tool is moved, (n, 3)."""
    s = 1 if t.sense == "ccw" else -1
    speed = t.feed / 60.0
    omega = speed / t.r
    x, y = t.r * np.cos(zeta), t.r * np.sin(zeta)
    vx, vy = -s * speed * np.sin(zeta), s * speed * np.cos(zeta)
    out = np.zeros((len(zeta), 3))
    g = {k: p.get(k, 0.0) for k in ("delay", "gain_x", "gain_y", "spike_x", "spike_y", "play_x", "play_y", "cyclic_x",
                                    "cyclic_y", "gamma_x", "gamma_y", "change_over", "slope_x", "slope_y")}  # fmt: skip
    out[:, 0] += 0.5 * g["delay"] * vx - g["gain_x"] * omega**2 * x * 1e-3
    out[:, 1] += -0.5 * g["delay"] * vy - g["gain_y"] * omega**2 * y * 1e-3
    way = [np.sign(vx), np.sign(vy)]
    for k, letter in enumerate("xy"):
        angle = since_turn(zeta, s, k)
        shape = spike_of(t.r * (1 - np.cos(angle)), omega, angle, p, f"spike_{letter}")
        out[:, k] -= way[k] * g[f"spike_{letter}"] * shape
        out[:, 1 - k] += 0.5 * g[f"play_{letter}"] * way[k]
        place = (x, y)[k]
        out[:, k] += g[f"cyclic_{letter}"] * np.sin(2 * np.pi * place / PITCH_MM + 0.7)
        out[:, k] += joint_um(place, PITCH_MM, g[f"gamma_{letter}"])
        out[:, k] -= 0.5 * way[k] * g[f"slope_{letter}"] * place * 1e-3
        out[:, k] -= 0.5 * way[k] * p.get(f"bow_{letter}", 0.0) * place**2 * 1e-6
        out[:, 2] += 0.5 * way[k] * p.get(f"lift_{letter}", 0.0)
    out[:, 0] -= np.where(np.abs(vx) < np.abs(vy), g["change_over"] * vx, 0.0)
    out[:, 1] -= np.where(np.abs(vy) < np.abs(vx), g["change_over"] * vy, 0.0)
    return out


def crossing_um(zeta: Floats, t: Test, dx: float, dy: float) -> Floats:
    """What real clearance has beside a step: at a reversal the slide stands until the drive has crossed it, (n, 3)."""
    s = 1 if t.sense == "ccw" else -1
    out = np.zeros((len(zeta), 3))
    for k, (clearance, speed) in enumerate(((dx, -s * np.sin(zeta)), (dy, s * np.cos(zeta)))):
        way_um = 1e3 * t.r * (1.0 - np.cos(since_turn(zeta, s, k)))
        out[:, k] = np.sign(speed) * np.maximum(clearance - way_um, 0.0)
    return out


def wander(rng: np.random.Generator, count: int, step_rad: float, way_rad: float) -> Floats:
    """Noise of unit size that forgets itself within a way on the circle, (count,)."""
    keep = float(np.exp(-step_rad / way_rad))
    out = rng.standard_normal(count)
    for i in range(1, count):
        out[i] = keep * out[i - 1] + np.sqrt(1.0 - keep * keep) * out[i]
    return out


def run_tests(
    tests: Sequence[Test],
    static: Mapping[str, float],
    dynamic: Mapping[str, float],
    noise_um: float = 0.0,
    seed: int = 1,
    step_deg: float = 0.5,
    machine: Machine | None = None,
    wander_um: float = 0.0,
    start_deg: float = 0.0,
    arc_deg: float = 360.0,
) -> tuple[list[Measurement], list[Floats]]:
    """Recordings, and their readings without noise; `wander_um` is a noise that goes on for 0.3 rad."""
    m, rng = machine or screw_machine(), np.random.default_rng(seed)
    out, clean = [], []
    for i, t in enumerate(tests):
        instrument = bar(m, height_mm=t.h, radius_mm=t.r, direction=t.sense, feed_mm_min=t.feed, start_deg=start_deg,
                         arc_deg=arc_deg, overshoot_deg=180.0 if arc_deg < 360.0 else 0.0)  # fmt: skip
        s = instrument.setup.sense
        angle = start_deg + s * (np.arange(0.0, arc_deg, step_deg) + 0.5 * step_deg)
        zeta = angle * DEG
        moved = moved_um(zeta, t, dynamic) + crossing_um(zeta, t, static.get("dx", 0.0), static.get("dy", 0.0))
        reading = bb_reading_um(zeta, t.r, t.h, s, moved, **static)
        clean.append(reading)
        noisy = reading + noise_um * rng.standard_normal(len(angle))
        noisy += wander_um * wander(rng, len(angle), step_deg * DEG, 0.3)
        out.append(recorded(m, instrument, angle, noisy, f"test{i + 1}"))
    return out, clean


def random_static(rng: np.random.Generator, *, bent: bool = True) -> dict[str, float]:
    """[BB]'s parameters of a machine in use; radii of curvature from 5 km up, either way."""
    out = {k: float(rng.uniform(-10.0, 10.0)) for k in ("ex", "ey")}
    out |= {k: float(rng.uniform(0.0, 5.0)) for k in ("dx", "dy")}
    out |= {k: 1.0 + 1e-6 * float(rng.uniform(-20.0, 20.0)) for k in ("Sx", "Sy")}
    out |= {k: 1e-6 * float(rng.uniform(-40.0, 40.0)) for k in ("psi", "thetax", "phix", "phiy")}
    if bent:
        names = ("rho_yaw_x", "rho_yaw_y", "rho_pitch_x", "rho_pitch_y")
        out |= {k: float(rng.choice([-1.0, 1.0]) * 1e3 / rng.uniform(0.02, 0.2)) for k in names}
        out["kappa"] = 1e-6 * float(rng.uniform(-100.0, 100.0))
    return out
