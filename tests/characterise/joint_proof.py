"""Laser, ball bar and grid plates fitted together, on machines of exact transforms; run it for the whole proof.

`python -m tests.characterise.joint_proof 300` draws machines at random and prints how far the numbers of a fit are from
the truth, in their standard errors; with `--to FILE` it goes on where it was stopped. Tip errors are the exact product
of transforms of both chains, the shapes of the errors are written out here, the bar's length is a distance between two
points: no code is shared with the fit.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.characterise import characterise, read_wanted
from rtec.machine import Machine, load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.exact_chain import exact_tip_errors_um

Floats = NDArray[np.float64]
State = Mapping[str, Floats]
MILL = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "vertical-mill.toml")
TARGETS, TURN, PLATE = 11, 60, 7
"""Targets of a laser, readings of a turn of the bar, lines of a plate."""


def _u(state: State, axis: str, machine: Machine) -> Floats:
    low, high = machine.axis(axis.upper()).travel_mm
    return np.asarray((state[axis] - 0.5 * (low + high)) / (0.5 * (high - low)))


Shape = Callable[[State, Machine], Floats]
SHAPES: Mapping[str, tuple[str, str, float, Shape]] = {
    "scale:EXX": ("EXX", "k", 15.0, lambda s, _: s["x"] * 1e-3),
    "scale:EYY": ("EYY", "k", 15.0, lambda s, _: s["y"] * 1e-3),
    "scale:EZZ": ("EZZ", "k", 15.0, lambda s, _: s["z"] * 1e-3),
    "backlash:EXX": ("EXX", "B", 3.0, lambda s, _: 0.5 * s["d_x"]),
    "backlash:EYY": ("EYY", "B", 3.0, lambda s, _: 0.5 * s["d_y"]),
    "squareness:EC0Y": ("EC0Y", "alpha", 20.0, lambda s, _: np.ones_like(s["x"])),
    "polynomial_position:EYX:degrees=[2]": ("EYX", "c2", 4.0, lambda s, m: 1.5 * _u(s, "x", m) ** 2 - 0.5),
    "polynomial_position:EXX:degrees=[2]": ("EXX", "c2", 3.0, lambda s, m: 1.5 * _u(s, "x", m) ** 2 - 0.5),
    "polynomial_position:EYY:degrees=[3]": (
        "EYY", "c3", 3.0, lambda s, m: 2.5 * _u(s, "y", m) ** 3 - 1.5 * _u(s, "y", m)
    ),
    "axis_expansion:EXX:sensor=T_bed": ("EXX", "k", 11.0, lambda s, _: s["x"] * 1e-3 * (s["T_bed"] - 20.0)),
    "mount_expansion:EYY:sensor=T_column": ("EYY", "k", 1.0, lambda s, _: s["T_column"] - 20.0),
}  # fmt: skip
"""What is asked of the fit: the component, the number's name, its usual size, and the shape of one unit of it."""


@dataclass(frozen=True)
class Truth:
    """A machine with effects of chosen sizes."""

    machine: Machine
    size: Mapping[str, float]

    def tip_um(self, state: State) -> Floats:
        """Exact error of the tool tip against the workpiece, (n, 3)."""
        names = list(self.size)
        parts = {n: self.size[n] * SHAPES[n][3](state, self.machine) for n in names}
        place = np.stack([state[a.channel] for a in self.machine.axes], axis=1)
        errors: dict[str, Floats | float] = {}
        for n in names:
            errors[SHAPES[n][0]] = errors.get(SHAPES[n][0], 0.0) + parts[n]
        return exact_tip_errors_um(self.machine, place, errors)


def noisy(rng: np.random.Generator, true: Floats, white_um: float, drift: bool) -> Floats:
    """With white noise; with drift, a first-order memory of some ten readings of the same size beside it."""
    out = true + white_um * rng.standard_normal(len(true))
    if drift:
        slow, keep = 0.0, np.exp(-0.1)
        for i in range(len(true)):
            slow = keep * slow + np.sqrt(1.0 - keep**2) * white_um * rng.standard_normal()
            out[i] += slow
    return out


def _state(machine: Machine, place: Mapping[str, Floats], degc: Floats, seed: int) -> dict[str, Floats]:
    n = len(degc)
    out = {a.channel: place.get(a.channel, np.full(n, np.mean(a.travel_mm))) for a in machine.axes}
    for a in machine.axes:
        step = np.diff(out[a.channel], prepend=out[a.channel][0])
        way, ways = 1.0, np.empty(n)
        for i, s in enumerate(step):
            way = np.sign(s) if abs(s) > 1e-9 else way
            ways[i] = way
        if np.ptp(out[a.channel]) > 0.0:
            ways[0] = ways[1]
        out[a.direction_channel] = ways
    rng = np.random.default_rng([seed, 5])
    for k, sensor in enumerate(machine.sensor_names):
        out[sensor] = 20.0 + (degc - 20.0) * (0.4 + 0.3 * k) + 0.002 * rng.standard_normal(n)
    return out


def laser(truth: Truth, axis: str, seed: int, drift: bool) -> Measurement:
    """Eight runs there and back while the machine warms up and cools."""
    rng, line = np.random.default_rng([seed, 1, ord(axis)]), truth.machine.axis(axis)
    low, high = line.travel_mm
    run, place = [], []
    for r in range(1, 9):
        targets = np.sort(np.linspace(low + 8.0, high - 8.0, TARGETS) + rng.uniform(-4.0, 4.0, TARGETS))
        place += [*targets, *targets[::-1]]
        run += [r] * (2 * TARGETS)
    number = np.array(run)
    degc = 20.0 + 9.0 * np.sin(number / 8.0 * 2.5 + 0.3) + 0.01 * np.arange(len(number))
    state = _state(truth.machine, {line.channel: np.array(place)}, degc, seed)
    # The first reading of a run is reached from below.
    state[line.direction_channel][:: 2 * TARGETS] = 1.0
    state[line.direction_channel][TARGETS :: 2 * TARGETS] = -1.0
    made = make_instrument("laser_linear", {"zero": "setup"}, axis, None, truth.machine, "proof")
    true = truth.tip_um(state)[:, "XYZ".index(line.direction)] + rng.normal(0.0, 5.0)
    readings = {made.columns()[0]: noisy(rng, true, 0.3, drift)}
    return Measurement(
        f"laser {axis}", made, truth.machine, number, np.arange(0.0, 30.0 * len(number), 30.0), state, readings
    )


def bar(truth: Truth, plane: str, sense: str, seed: int, drift: bool) -> Measurement:
    """Eight turns; the table-side ball is off the centre by micrometres that nobody knows."""
    rng, radius, turns = np.random.default_rng([seed, 2, hash_of(plane + sense)]), 120.0, 8
    centre = np.array([np.mean(a.travel_mm) for a in truth.machine.axes])
    angle = 2.0 * np.pi * (np.arange(TURN * turns) + 0.5) / TURN * (1.0 if sense == "ccw" else -1.0)
    first, second = (truth.machine.axis(d) for d in plane)
    index = [truth.machine.axis_names.index(d) for d in plane]
    place = {
        first.channel: centre[index[0]] + radius * np.cos(angle),
        second.channel: centre[index[1]] + radius * np.sin(angle),
    }
    run = np.repeat(np.arange(1, turns + 1), TURN)
    state = _state(truth.machine, place, np.full(len(angle), 20.0 + rng.uniform(0.0, 4.0)), seed)
    setup = {
        "plane": plane,
        "centre_mm": centre.tolist(),
        "radius_mm": radius,
        "direction": sense,
        "feed_mm_min": 1000.0,
    }
    made = make_instrument("ball_bar", setup, None, None, truth.machine, "proof")
    rows = ["XYZ".index(d) for d in plane]
    away = np.zeros((len(angle), 3))
    away[:, rows[0]], away[:, rows[1]] = radius * np.cos(angle), radius * np.sin(angle)
    off = np.zeros(3)
    off[rows] = rng.normal(0.0, 4e-3, 2)
    true = 1e3 * (np.linalg.norm(away + 1e-3 * truth.tip_um(state) - off, axis=1) - radius)
    readings = {made.columns()[0]: noisy(rng, true, 0.4, drift)}
    return Measurement(
        f"bar {plane} {sense}", made, truth.machine, run, np.linspace(0.0, 0.4 * len(run), len(run)), state, readings
    )


def plate(truth: Truth, middle: tuple[float, float], seed: int, drift: bool) -> Measurement:
    """Eight runs over a plate, line by line, there and back; it lies off by micrometres and turned by microradians."""
    rng, runs_of, half = np.random.default_rng([seed, 3, int(middle[0])]), 8, 70.0
    line = np.linspace(-half, half, PLATE)
    x = np.concatenate([np.concatenate([line, line[::-1]]) for _ in line] * runs_of)
    y = np.concatenate([np.repeat(line, 2 * PLATE), np.repeat(line[::-1], 2 * PLATE)] * (runs_of // 2))
    run = np.repeat(np.arange(1, runs_of + 1), 2 * PLATE * PLATE)
    degc = np.full(len(run), 20.0 + rng.uniform(0.0, 4.0))
    state = _state(truth.machine, {"x": x + middle[0], "y": y + middle[1]}, degc, seed)
    z = float(np.mean(truth.machine.axis("Z").travel_mm))
    setup = {"plane": "XY", "origin_mm": [*middle, z]}
    made = make_instrument("grid_encoder", setup, None, None, truth.machine, "proof")
    tip, turn = truth.tip_um(state), rng.normal(0.0, 20.0)
    shown = [tip[:, 0] + turn * 1e-3 * y + rng.normal(0.0, 5.0), tip[:, 1] - turn * 1e-3 * x + rng.normal(0.0, 5.0)]
    readings = {c: noisy(rng, v, 0.5, drift) for c, v in zip(made.columns(), shown, strict=True)}
    name = f"plate {middle[0]:g} {middle[1]:g}"
    return Measurement(name, made, truth.machine, run, np.arange(0.0, 2.0 * len(run), 2.0), state, readings)


def hash_of(text: str) -> int:
    """A number for a text, the same in every process."""
    return sum((i + 1) * ord(c) for i, c in enumerate(text))


def drawn(seed: int) -> tuple[Truth, list[Measurement]]:
    """A machine and what was measured on it."""
    rng, machine = np.random.default_rng([seed, 11]), MILL
    names = list(SHAPES)
    chosen = [names[i] for i in sorted(rng.choice(len(names), int(rng.integers(4, 9)), replace=False))]
    truth = Truth(machine, {n: float(rng.normal(0.0, SHAPES[n][2])) for n in chosen})
    drift = bool(seed % 2)
    measured = [laser(truth, a, seed, drift) for a in "XYZ"]
    measured += [bar(truth, p, s, seed, drift) for p, s in (("XY", "ccw"), ("XY", "cw"), ("YZ", "ccw"))]
    measured += [plate(truth, m, seed, drift) for m in ((150.0, 140.0), (320.0, 250.0))]
    return truth, measured


def errors_of(seed: int) -> list[tuple[str, float]]:
    """Distances from the truth in standard errors of all numbers of one machine's fit."""
    truth, measured = drawn(seed)
    result = characterise(measured, wanted=read_wanted(",".join(truth.size), truth.machine))
    out = []
    for n in truth.size:
        component, number, *_ = SHAPES[n]
        found = next(
            c for c in result.coefficients
            if c.component == component and c.name == number and c.effect.split("(")[0] == n.split(":")[0]
        )  # fmt: skip
        assert found.se is not None
        out.append((n, (found.value - truth.size[n]) / found.se))
    return out


def kept(path: Path | None) -> dict[int, list[tuple[str, float]]]:
    """Machines that a file has, by their seeds; a line that was cut off is none."""
    out = {}
    for line in path.read_text("utf-8").splitlines() if path and path.exists() else ():
        with suppress(json.JSONDecodeError):
            seed, numbers = json.loads(line)
            out[int(seed)] = [(str(name), float(z)) for name, z in numbers]
    return out


def main(argv: Sequence[str] | None = None) -> None:
    """Print the share of numbers within three standard errors, and the root mean square in these."""
    parser = argparse.ArgumentParser(prog="python -m tests.characterise.joint_proof")
    parser.add_argument("machines", type=int, nargs="?", default=300)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--to", type=Path, help="keep each machine as a line of this file, and go on from it")
    wish = parser.parse_args(argv)
    seeds, done = range(wish.first, wish.first + wish.machines), kept(wish.to)
    with suppress(KeyboardInterrupt), wish.to.open("a", encoding="utf-8") if wish.to else nullcontext() as to:
        for seed in seeds:
            if seed in done:
                continue
            done[seed] = errors_of(seed)
            if to:
                to.write("\n" + json.dumps([seed, done[seed]]))
                to.flush()
    whole = [number for seed in seeds for number in done.get(seed, ())]
    z = np.array([v for _, v in whole])
    lines = [
        f"{sum(seed in done for seed in seeds)} machines, {len(z)} numbers",
        f"within 3 standard errors: {100.0 * np.mean(np.abs(z) < 3.0):.1f} %, rms {np.sqrt(np.mean(z**2)):.2f}",
    ]
    for name in SHAPES:
        mine = np.array([v for n, v in whole if n == name])
        if len(mine):
            lines.append(f"{name}: {len(mine)}, rms {np.sqrt(np.mean(mine**2)):.2f}, largest {np.abs(mine).max():.2f}")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
