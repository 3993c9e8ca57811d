"""A small travelling-column mill: positions of its parts, what their motion does to a point, and its temperatures.

Rotations are exact matrices (Rodrigues), not arms times angles. Temperatures are those of a network of bodies and a
screw of finite elements, most of them without a sensor. Heat flow is `C dT/dt = Σ G (T' - T) + P`, integrated by
implicit Euler; sensors have lag, noise and resolution.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TRAVEL_MM = {"X": (0.0, 600.0), "Y": (0.0, 300.0), "Z": (0.0, 350.0)}
PITCH_MM = {"X": 10.0, "Y": 10.0, "Z": 5.0}
SENSORS = ("T_spindle", "T_front", "T_back", "T_bed", "T_nut", "T_cool", "T_air")
TOOL_CHAIN, WORK_CHAIN = ("column", "Z", "spindle", "tool"), ("Y", "X", "table")
OFFSET_MM: dict[str, tuple[float, float, float]] = {
    "column": (0.0, 220.0, 0.0),
    "Z": (0.0, -160.0, 520.0),
    "spindle": (0.0, -40.0, -180.0),
    "tool": (0.0, 0.0, -120.0),
    "Y": (0.0, 0.0, 80.0),
    "X": (0.0, 0.0, 70.0),
    "table": (0.0, 0.0, 50.0),
}


def description(pitch_mm: Mapping[str, float] | None = None) -> dict[str, Any]:
    """Content of the machine's file.

    Args:
        pitch_mm: wrong pitches of screws in the file, by axis.
    """
    pitch = {**PITCH_MM, **(pitch_mm or {})}
    return {
        "machine": {"name": "rig", "tool_chain": list(TOOL_CHAIN), "work_chain": list(WORK_CHAIN)},
        "axis": {
            a: {
                "direction": a,
                "travel_mm": list(TRAVEL_MM[a]),
                "pitch_mm": pitch[a],
                "counts_per_mm": 1000.0,
                "offset_mm": list(OFFSET_MM[a]),
            }
            for a in TRAVEL_MM
        },
        "link": {n: {"offset_mm": list(o)} for n, o in OFFSET_MM.items() if n not in TRAVEL_MM},
        "temperature": {s: {} for s in SENSORS},
    }


def _origins(pose_mm: Mapping[str, Floats]) -> dict[str, Floats]:
    """Origin of each part, (n, 3) mm; a part that carries the work moves in the opposite direction."""
    n = len(pose_mm["X"])
    out: dict[str, Floats] = {}
    for chain, way in ((TOOL_CHAIN, 1.0), (WORK_CHAIN, -1.0)):
        here = np.zeros((n, 3))
        for part in chain:
            here = here + np.asarray(OFFSET_MM[part])
            if part in TRAVEL_MM:
                here[:, "XYZ".index(part)] += way * pose_mm[part]
            out[part] = here.copy()
    return out


def rotation(axis: int, angle_rad: Floats) -> Floats:
    """Exact rotation matrices about a main axis, (n, 3, 3)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    out = np.zeros((len(angle_rad), 3, 3))
    out[:, axis, axis] = 1.0
    a, b = (axis + 1) % 3, (axis + 2) % 3
    out[:, a, a], out[:, b, b] = c, c
    out[:, a, b], out[:, b, a] = -s, s
    return out


def displaced(
    errors: Mapping[str, Floats], pose_mm: Mapping[str, Floats], offset_mm: Sequence[float] = (0.0, 0.0, 0.0)
) -> Floats:
    """Displacement of a point beside the tool tip relative to the work, (n, 3) µm.

    Args:
        errors: component errors of the tool relative to the work, µm or µrad, (n,) each.
        pose_mm: axis positions.
        offset_mm: vector from the tool tip to the point.
    """
    where = _origins(pose_mm)
    tip = where["tool"] + np.asarray(offset_mm)
    out: Floats = np.zeros_like(tip)
    for component, error in errors.items():
        letter, part = component[1], component[2:]
        if letter in "XYZ":
            out[:, "XYZ".index(letter)] += error
            continue
        if part[0] == "0" and part[1:] in TRAVEL_MM:
            # Squareness: only the direction of travel is rotated.
            arm = np.zeros_like(tip)
            arm[:, "XYZ".index(part[1:])] = pose_mm[part[1:]]
        else:
            arm = tip - where[part.removeprefix("0")]
        moved: Floats = np.einsum("nij,nj->ni", rotation("ABC".index(letter), 1e-6 * error), arm)
        out += 1e3 * (moved - arm)
    return out


def turned(errors: Mapping[str, Floats], about: str, n: int) -> Floats:
    """Reading of an angular instrument about a main axis, (n,) µrad."""
    parts = [e for c, e in errors.items() if c[1] == about and not (c[2] == "0" and c[3:] in TRAVEL_MM)]
    return np.asarray(np.sum(parts, axis=0) if parts else np.zeros(n))


Rng = np.random.Generator

STEP_S = 30.0
ELEMENTS = 24
STEEL_PER_K = 11.5e-6
# Heat capacity, kJ/K, and conductance to the air, W/K.
BODIES = {
    "bearing": (2.0, 0.8),
    "spindle": (9.0, 2.5),
    "head": (35.0, 6.0),
    "front": (60.0, 8.0),
    "back": (75.0, 9.0),
    "bed": (160.0, 14.0),
    "nut": (1.6, 0.6),
    "cool": (30.0, 9.0),
}
# Conductance between bodies, W/K.
TOUCH = {
    ("bearing", "spindle"): 9.0,
    ("spindle", "head"): 7.0,
    ("head", "front"): 11.0,
    ("front", "back"): 5.0,
    ("back", "bed"): 4.0,
    ("bed", "cool"): 3.0,
    ("nut", "bed"): 0.7,
}
AT_NUT, ALONG, TO_AIR, OF_ELEMENT = 1.1, 6.0, 0.12, 0.45
"""Conductances of the screw's elements, W/K, and the heat capacity of one, kJ/K."""


@dataclass(frozen=True)
class Day:
    """A day of the machine, on a grid of time.

    Attributes:
        time_s: (m,).
        rpm: spindle speed, (m,).
        body: temperature of each body and of the air minus 20 °C, (m,) each.
        screw: temperature of each element of X's screw minus 20 °C, (m, elements).
    """

    time_s: Floats
    rpm: Floats
    body: Mapping[str, Floats]
    screw: Floats

    def at(self, values: Floats, time_s: Floats) -> Floats:
        """Values of the grid at other instants."""
        return np.interp(time_s, self.time_s, values)

    def of(self, body: str, time_s: Floats) -> Floats:
        """Temperature of a body minus 20 °C, (n,)."""
        return self.at(self.body[body], time_s)

    def sensor(self, name: str, rng: Rng, time_s: Floats) -> Floats:
        """Readings of a sensor, °C: with a lag of half a minute, noise, and steps of 0.1 K."""
        late = rng.uniform(15.0, 60.0)
        true = 20.0 + self.of(name.removeprefix("T_"), np.maximum(time_s - late, 0.0))
        return np.round((true + 0.03 * rng.standard_normal(len(time_s))) / 0.1) * 0.1

    def growth(self, q_mm: Floats, time_s: Floats) -> Floats:
        """Growth of X's screw from its fixed bearing to a position, (n,) µm."""
        edges = np.linspace(*TRAVEL_MM["X"], ELEMENTS + 1)
        whole = np.concatenate([np.zeros((len(self.time_s), 1)), np.cumsum(self.screw, axis=1)], axis=1)
        whole *= STEEL_PER_K * 1e3 * (edges[1] - edges[0])
        now = np.stack([np.interp(time_s, self.time_s, column) for column in whole.T], axis=1)
        place = np.clip((q_mm - edges[0]) / (edges[1] - edges[0]), 0.0, ELEMENTS - 1e-9)
        k = place.astype(int)
        rows = np.arange(len(q_mm))
        return np.asarray(now[rows, k] + (place - k) * (now[rows, k + 1] - now[rows, k]))


def day(rng: Rng, hours: float) -> Day:
    """A random day: spindle programme, jogging, coolant, temperature of the shop."""
    time = np.arange(0.0, hours * 3600.0 + STEP_S, STEP_S)
    rpm = _blocks(rng, time, (0.0, 1500.0, 3000.0, 5000.0, 7000.0, 9000.0), (20.0, 60.0))
    jog = _blocks(rng, time, (0.0, 0.3, 0.6, 1.0), (25.0, 80.0))
    wet = _blocks(rng, time, (-1.0, 0.0, 1.0), (40.0, 100.0))
    rpm[time < 1200.0], jog[time < 1200.0], wet[time < 1200.0] = 0.0, 0.0, 0.0
    air = rng.uniform(0.5, 1.6) * np.sin(2 * np.pi * (time / 3600.0 - rng.uniform(0, 24)) / 24.0)
    air += rng.uniform(0.3, 0.8) * np.sin(2 * np.pi * time / 3600.0 / rng.uniform(2.0, 4.5) + rng.uniform(0, 6.28))
    power = {
        "bearing": 95.0 * (rpm / 9000.0) ** 1.3,
        "spindle": 40.0 * (rpm / 9000.0) ** 2,
        "nut": 12.0 * jog,
        "cool": 60.0 * wet,
        "bed": 15.0 * jog,
    }
    body, screw = _integrate(time, air, power, jog)
    return Day(time, rpm, {**body, "air": air}, screw)


def _integrate(time: Floats, air: Floats, power: Mapping[str, Floats], jog: Floats) -> tuple[dict[str, Floats], Floats]:
    names = list(BODIES)
    b, n = len(names), len(names) + ELEMENTS
    capacity = np.array([1e3 * BODIES[k][0] for k in names] + [1e3 * OF_ELEMENT] * ELEMENTS)
    out_air = np.array([BODIES[k][1] for k in names] + [TO_AIR] * ELEMENTS)
    link = np.zeros((n, n))
    pairs = [(names.index(a), names.index(c), g) for (a, c), g in TOUCH.items()]
    pairs += [(b + i, b + i + 1, ALONG) for i in range(ELEMENTS - 1)]
    pairs += [(names.index("nut"), b + i, AT_NUT / ELEMENTS * 4.0) for i in range(4, ELEMENTS - 4)]
    pairs += [(names.index("bed"), b, 2.0)]
    for i, j, g in pairs:
        link[i, j] += g
        link[j, i] += g
    flow = np.diag(link.sum(axis=1) + out_air) - link
    step = np.linalg.inv(np.diag(capacity / STEP_S) + flow)
    heat = np.zeros((len(time), n))
    for k, p in power.items():
        heat[:, names.index(k)] = p
    heat[:, b + 8 : b + 16] += 0.8 * jog[:, None]
    now, states = np.full(n, air[0]), np.empty((len(time), n))
    for i in range(len(time)):
        now = step @ (capacity / STEP_S * now + out_air * air[i] + heat[i])
        states[i] = now
    return {name: states[:, i] for i, name in enumerate(names)}, states[:, b:]


def _blocks(rng: Rng, time: Floats, levels: tuple[float, ...], minutes: tuple[float, float]) -> Floats:
    out, at, last = np.zeros_like(time), 0.0, levels[0]
    while at < time[-1]:
        last = float(rng.choice([v for v in levels if v != last]))
        out[time >= at] = last
        at += 60.0 * rng.uniform(*minutes)
    return out


def sensors(of: Day, rng: Rng, time_s: Floats, names: tuple[str, ...] = SENSORS) -> dict[str, Floats]:
    """Readings of sensors, °C, (n,) each."""
    return {name: of.sensor(name, rng, time_s) for name in names}


def growth_seen(q_mm: Floats, time_s: Floats, channels: Mapping[str, Floats]) -> Floats:
    """Growth of X's screw as far as sensors show it, (n, 8): columns of its law on the recorded channels.

    The nut heats the screw, directly and with the lag of an element, more in the middle than at the ends; bed and air
    cool it.
    """
    nut = channels["T_nut"] - 20.0
    late = _late(nut, time_s, 1e3 * OF_ELEMENT / (AT_NUT / ELEMENTS * 4.0 + TO_AIR))
    u = q_mm / TRAVEL_MM["X"][1]
    others = [u * (channels[name] - 20.0) for name in ("T_bed", "T_air")]
    return np.stack([*(u**k * t for k in (1, 2, 3) for t in (nut, late)), *others], axis=1)


def bearing_seen(time_s: Floats, channels: Mapping[str, Floats]) -> Floats:
    """Temperature of the bearing as far as speed and sensors show it, (n, 3): columns of its law on recorded channels.

    Friction heats the bearing, spindle and air cool it, all with the lag of its heat capacity.
    """
    capacity, to_air = BODIES["bearing"]
    tau_s = 1e3 * capacity / (TOUCH["bearing", "spindle"] + to_air)
    sources = ((channels["spindle_rpm"] / 9000.0) ** 1.3, channels["T_spindle"] - 20.0, channels["T_air"] - 20.0)
    return np.stack([_late(v, time_s, tau_s) for v in sources], axis=1)


def _late(values: Floats, time_s: Floats, tau_s: float) -> Floats:
    """First-order lag of values, (n,)."""
    out = np.empty(len(values))
    out[0] = values[0]
    for i, keep in enumerate(np.exp(-np.diff(time_s) / tau_s).tolist(), 1):
        out[i] = keep * out[i - 1] + (1.0 - keep) * values[i]
    return out
