"""Ball-bar readings of whole machines by exact transforms, for the proofs; shares no code with the program.

Each joint is a true rigid motion: nominal travel, then an error of its carriage as a rotation matrix and a shift, on
the tool's or on the workpiece's side. The servo is a first-order loop in its steady state, worked out as a complex
number; the play between drive and slide is the hysteresis operator run over a finely divided turn; the table-side ball
stands where it really is, and the bar is as long as it really is.

All parameters are those of the motion of the tool relative to the workpiece. For a plane with letters a, b and third
direction n, `hand` is +1 where (a, b, n) is right-handed, -1 in plane XZ.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from tests.support.ball_bar_examples import bar, recorded
from tests.support.machines import axis, machine

Floats = NDArray[np.float64]
SIDES: dict[str, tuple[str, str]] = {"tool": ("YXZ", ""), "table": ("Z", "YX"), "bridge": ("YZ", "X")}
"""Axes on the tool's side and on the workpiece's side, each from the base outwards."""
FINE = 16
"""Steps of the play's hysteresis between two readings."""


@dataclass(frozen=True)
class Bar:
    """One test: nominal height and radius, mm, sense, feed, mm/min; and what nobody knows of it.

    Attributes:
        height_um: the table-side ball is so much higher than it is said to be.
        longer_um: the bar is so much longer than its nominal length.
    """

    h: float
    r: float
    sense: str
    feed: float = 1000.0
    height_um: float = 0.0
    longer_um: float = 0.0


@dataclass(frozen=True)
class TrueMachine:
    """A machine, seen in one plane.

    Attributes:
        kind: of `SIDES`.
        plane: its letters.
        size: parameters by name; a missing one is zero. `ex ey` µm, table-side ball off the centre; `scale_a scale_b`
            µm/m; `curve_a curve_b` µm/m², positioning errors that grow with the square; `lean` of a towards b, `rise_a
            rise_b` of the lines along n, µrad; `play_a play_b` µm; `bend_a bend_b` in the plane, `arch_a arch_b` along
            n, 1/km, slides that shift along the arc without turning; `turn_b` 1/km,
            a carriage that turns with its arc; `roll` µrad/m, of the axis nearer to the workpiece, which carries the
            other; `lag_ms`, of both servo loops; `lead_ms`, time by which a leads b; `side_a side_b` µm, lateral play
            in the plane; `wave_a` µm at 10 mm; `stick_a stick_b` µm with its top `stick_mm` after the reversal.
    """

    kind: str
    plane: str
    size: Mapping[str, float] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        return float(self.size.get(name, 0.0))

    @property
    def letters(self) -> tuple[str, str, str]:
        """a, b, n."""
        return self.plane[0], self.plane[1], next(d for d in "XYZ" if d not in self.plane)

    @property
    def hand(self) -> float:
        """+1 where a, b, n is right-handed."""
        return 1.0 if "".join(self.letters) in "XYZXYZ" else -1.0

    @property
    def carrier(self) -> int:
        """0 or 1: which axis of the plane is nearer to the workpiece: its carriage's turns have an arm on the other."""
        tool, work = SIDES[self.kind]
        order = work[::-1] + tool
        return 0 if order.index(self.plane[0]) < order.index(self.plane[1]) else 1


def moved_mm(m: TrueMachine, bar: Bar, angle_rad: Floats) -> Floats:
    """Places of the two slides of the plane, mm from the centre, (n, 2): servo loop, then play, then stick-slip."""
    sense = 1.0 if bar.sense == "ccw" else -1.0
    omega = bar.feed / 60.0 / bar.r
    fine = np.linspace(0.0, 4.0 * np.pi, 2 * FINE * len(angle_rad) + 1) * sense + angle_rad[0] - sense * 4.0 * np.pi
    out = np.zeros((len(angle_rad), 2))
    for k, letter in enumerate("ab"):
        tau = 1e-3 * (m["lag_ms"] - (0.5 if k == 0 else -0.5) * m["lead_ms"])
        loop = 1.0 / (1.0 + 1j * omega * tau)
        gain, late = abs(loop), -float(np.angle(loop))
        clearance = 1e-3 * m[f"play_{letter}"]

        def drive(angle: Floats, k: int = k, gain: float = gain, late: float = late) -> Floats:
            return np.asarray(bar.r * gain * np.cos(angle - sense * late - 0.5 * np.pi * k))

        driven = drive(fine)
        slide = driven if clearance == 0.0 else _dragged(driven, clearance)
        # The last turn is periodic: every reading is in it, whatever its angle.
        turn = np.interp(
            np.mod((angle_rad - fine[-1]) * sense, 2 * np.pi) - 2 * np.pi, (fine - fine[-1]) * sense, slide
        )
        if m[f"stick_{letter}"]:
            since = np.mod(sense * (angle_rad - sense * late - 0.5 * np.pi * k), np.pi)
            way = bar.r * (1.0 - np.cos(since)) / m["stick_mm"]
            ahead = np.sign(drive(angle_rad + sense * 1e-4) - drive(angle_rad))
            turn = turn - ahead * 1e-3 * m[f"stick_{letter}"] * way * np.exp(1.0 - way)
        out[:, k] = turn
    return out


def _dragged(driven: Floats, clearance: float) -> Floats:
    """Places of a slide that is dragged with this clearance, (n,)."""
    place, half, out = float(driven[0]), 0.5 * clearance, []
    for d in driven.tolist():
        if d - place > half:
            place = d - half
        elif place - d > half:
            place = d + half
        out.append(place)
    return np.array(out)


def direction(bar: Bar, angle_rad: Floats, k: int) -> Floats:
    """Commanded way of an axis, -1 or +1, (n,)."""
    sense = 1.0 if bar.sense == "ccw" else -1.0
    return np.where(sense * (-np.sin(angle_rad) if k == 0 else np.cos(angle_rad)) > 0.0, 1.0, -1.0)


def reading_um(m: TrueMachine, bar: Bar, angle_rad: Floats) -> Floats:
    """What the bar reads without noise, (n,)."""
    a, b, n = ("XYZ".index(d) for d in m.letters)
    ball = np.zeros((len(angle_rad), 3))
    ball[:, a], ball[:, b], ball[:, n] = 1e-3 * m["ex"], 1e-3 * m["ey"], bar.h + 1e-3 * bar.height_um
    way = np.stack([direction(bar, angle_rad, k) for k in (0, 1)], axis=1)
    length = np.linalg.norm(apart_mm(m, moved_mm(m, bar, angle_rad), way, ball), axis=1)
    return np.asarray((length - np.hypot(bar.r, bar.h)) * 1e3 - bar.longer_um, dtype=np.float64)


def resting_um(m: TrueMachine, commanded_mm: Floats, way: Floats) -> Floats:
    """Error of the tool against the workpiece where both slides rest, in machine coordinates, (n, 3).

    Args:
        m: the machine.
        commanded_mm: of both axes of the plane, from the centre, (n, 2).
        way: commanded way by which each came, -1 or +1, (n, 2).
    """
    play = np.array([m["play_a"], m["play_b"]])
    point = np.zeros((len(way), 3))
    for k, letter in enumerate(m.plane):
        point[:, "XYZ".index(letter)] = commanded_mm[:, k]
    return 1e3 * apart_mm(m, commanded_mm - 0.5e-3 * play * way, way, point)


def apart_mm(m: TrueMachine, place: Floats, way: Floats, ball: Floats) -> Floats:
    """From a point of the workpiece to the tool's tip, (n, 3), mm.

    Args:
        m: the machine.
        place: of the two slides of the plane, mm from the centre, (n, 2).
        way: commanded way of each, -1 or +1, (n, 2).
        ball: the point on the workpiece, (n, 3), mm.
    """
    a, b, n = ("XYZ".index(d) for d in m.letters)
    unit = np.eye(3)
    side_a, side_b = (way[:, k, None] * 0.5e-3 * m[f"side_{'ab'[k]}"] for k in (0, 1))
    p, q = place[:, :1], place[:, 1:]
    # Travel, mm, and turn, rad, of each axis' carriage, as the tool against the workpiece, (n, 3).
    travel = {d: np.zeros_like(ball) for d in "XYZ"}
    turn = {d: np.zeros_like(ball) for d in "XYZ"}
    along_a = unit[a] + 1e-6 * (m["lean"] * unit[b] + m["rise_a"] * unit[n])
    along_b = unit[b] + 1e-6 * m["rise_b"] * unit[n]
    wave = 1e-3 * m["wave_a"] * np.sin(2 * np.pi * p / 10.0)
    travel[m.plane[0]] += along_a * (p * (1.0 + 1e-6 * m["scale_a"]) + 1e-9 * m["curve_a"] * p**2 + wave)
    travel[m.plane[0]] += 0.5e-6 * p**2 * (-m["bend_a"] * unit[b] + m["arch_a"] * unit[n]) + side_a * unit[b]
    travel[m.plane[1]] += along_b * (q * (1.0 + 1e-6 * m["scale_b"]) + 1e-9 * m["curve_b"] * q**2)
    travel[m.plane[1]] += 0.5e-6 * q**2 * (-m["bend_b"] * unit[a] - m["arch_b"] * unit[n]) + side_b * unit[a]
    own, along = (m.plane[0], p) if m.carrier == 0 else (m.plane[1], -q)
    turn[own] += unit["XYZ".index(own)] * 1e-9 * m["roll"] * along
    # A slide that follows its arc turns by the arc's slope: its own line stays along the tangent.
    travel[m.plane[1]] += -0.5e-6 * q**2 * m["turn_b"] * unit[a]
    turn[m.plane[1]] += unit[n] * m.hand * 1e-6 * m["turn_b"] * q
    tool, work = SIDES[m.kind]
    return _point(tool, travel, turn, 1.0, np.zeros_like(ball)) - _point(work, travel, turn, -1.0, ball)


def _point(axes: str, travel: Mapping[str, Floats], turn: Mapping[str, Floats], sign: float, point: Floats) -> Floats:
    """Points that sit on the outermost carriage of a side, in the base's frame, (n, 3)."""
    for d in reversed(axes):
        point = _turned(sign * turn[d], point) + sign * travel[d]
    return point


def _turned(vector: Floats, point: Floats) -> Floats:
    """Rodrigues' rotation, (n, 3)."""
    angle = np.linalg.norm(vector, axis=1, keepdims=True)
    axis = vector / np.where(angle > 0.0, angle, 1.0)
    along = (axis * point).sum(axis=1, keepdims=True)
    turned = point * np.cos(angle) + np.cross(axis, point) * np.sin(angle) + axis * along * (1.0 - np.cos(angle))
    return np.asarray(turned, dtype=np.float64)


def truth_of(m: TrueMachine, bars: Sequence[Bar]) -> dict[str, float]:
    """The truth by the program's names and in its units; the servo's are those of the first order."""
    a, b, _ = (letter.lower() for letter in m.letters)
    hand, tau = m.hand, 1e-3 * m["lag_ms"]
    first = bars[0].feed / 60.0 / bars[0].r
    return {
        f"centre_{a}": m["ex"], f"centre_{b}": m["ey"],
        f"clearance_{a}": m["play_a"], f"clearance_{b}": m["play_b"],
        f"scale_{a}": m["scale_a"], f"scale_{b}": m["scale_b"],
        "squareness": hand * m["lean"],
        f"perpendicularity_{a}": -hand * m["rise_a"], f"perpendicularity_{b}": hand * m["rise_b"],
        "phase": 1e3 * m["lead_ms"] * first if not m["lag_ms"] else float("nan"),
        f"yaw_{a}": m["bend_a"], f"yaw_{b}": m["bend_b"], f"pitch_{a}": m["arch_a"], f"pitch_{b}": m["arch_b"],
        f"curve_{a}": m["curve_a"], f"curve_{b}": m["curve_b"],
        "twist": m["roll"], f"gain_{a}": 0.5e6 * tau**2, f"gain_{b}": 0.5e6 * tau**2,
        f"play_{a}_{b}": m["side_a"], f"play_{b}_{a}": m["side_b"],
        f"cyclic_{a}_amplitude": m["wave_a"],
    }  # fmt: skip


THREE = (Bar(0.0, 150.0, "ccw"), Bar(60.0, 137.477, "cw"), Bar(60.0, 137.477, "ccw"))
"""Tests that separate all of [BB]'s parameters; radius and height of one bar of 150 mm."""


def machine_of(kind: str, half_mm: float = 400.0) -> Machine:
    """The program's machine: the same axes on the same sides, each with so much travel on either side."""
    tool, work = SIDES[kind]
    axes = {d: axis(d, travel_mm=[-half_mm, half_mm], pitch_mm=10.0) for d in "XYZ"}
    return machine(kind, list(tool), list(work), axes)


def recordings(
    m: TrueMachine, bars: Sequence[Bar], noise_um: float = 0.1, seed: int = 1, step_deg: float = 1.0,
    given: Machine | None = None, **setup: Any,
) -> list[Measurement]:  # fmt: skip
    """What the program is given: angles commanded, readings with white noise."""
    rng, given, out = np.random.default_rng(seed), given or machine_of(m.kind), []
    for i, one in enumerate(bars):
        instrument = bar(given, plane=m.plane, height_mm=one.h, radius_mm=one.r, direction=one.sense,
                         feed_mm_min=one.feed, **setup)  # fmt: skip
        angle = (np.arange(0.0, 360.0, step_deg) + 0.5 * step_deg) * instrument.setup.sense
        reading = reading_um(m, one, np.deg2rad(angle)) + noise_um * rng.standard_normal(len(angle))
        out.append(recorded(given, instrument, angle, reading, f"test{i + 1}"))
    return out
