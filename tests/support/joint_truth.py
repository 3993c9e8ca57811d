"""Laser, plate and ball bars on one whole machine of exact transforms, for the proofs; shares no code with the program.

The machines are those of `ball_bar_truth`: tool-side, table-side and bridge, in any plane. Laser and plate read where
the slides rest, bars on the run; so a servo loop shows in bars only.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.ball_bar_truth import Bar, TrueMachine, machine_of, recordings, resting_um

Floats = NDArray[np.float64]
TRAVEL_MM, REACH_MM, TARGETS, RUNS, LINES, HALF_MM = 300.0, 285.0, 11, 8, 7, 150.0
"""Travel and reach of a laser on either side of the centre; its targets; runs; lines of a plate and half its side."""


def measured(m: TrueMachine, bars: Sequence[Bar], noise_um: float, seed: int, **setup: Any) -> list[Measurement]:
    """A laser along each axis of the plane, a plate in the plane, and ball bars, each with white noise."""
    given = machine_of(m.kind, TRAVEL_MM)
    lasers = [_laser(m, k, noise_um, seed) for k in (0, 1)]
    return [*lasers, _plate(m, noise_um, seed), *recordings(m, bars, noise_um, seed, 2.0, given, **setup)]


def _laser(m: TrueMachine, k: int, noise_um: float, seed: int) -> Measurement:
    rng, there = np.random.default_rng([seed, 1, k]), []
    for _ in range(RUNS):
        up = np.sort(np.linspace(-REACH_MM, REACH_MM, TARGETS) + rng.uniform(-4.0, 4.0, TARGETS))
        there += [*up, *up[::-1]]
    place = np.zeros((len(there), 2))
    place[:, k] = there
    way = np.ones_like(place)
    way[:, k] = np.tile(np.repeat([1.0, -1.0], TARGETS), RUNS)
    letter = m.plane[k]
    shown = resting_um(m, place, way)[:, ["XYZ".index(letter)]] + rng.normal(0.0, 5.0)
    return _recorded(f"laser {letter}", m, "laser_linear", {"zero": "setup"}, letter, place, way, shown, noise_um, rng)


def _plate(m: TrueMachine, noise_um: float, seed: int) -> Measurement:
    rng, line = np.random.default_rng([seed, 2]), np.linspace(-HALF_MM, HALF_MM, LINES)
    p = np.concatenate([np.concatenate([line, line[::-1]]) for _ in line] * RUNS)
    q = np.concatenate([np.repeat(line, 2 * LINES), np.repeat(line[::-1], 2 * LINES)] * (RUNS // 2))
    there = np.tile(np.repeat([1.0, -1.0], LINES), LINES * RUNS)
    back = np.repeat(np.tile([1.0, -1.0], RUNS // 2), 2 * LINES * LINES)
    place, way, turn = np.stack([p, q], axis=1), np.stack([there, back], axis=1), rng.normal(0.0, 20.0)
    shown = resting_um(m, place, way)[:, ["XYZ".index(d) for d in m.plane]]
    shown += turn * 1e-3 * np.stack([q, -p], axis=1) + rng.normal(0.0, 5.0, 2)
    setup = {"plane": m.plane, "origin_mm": [0.0, 0.0, 0.0]}
    return _recorded("plate", m, "grid_encoder", setup, None, place, way, shown, noise_um, rng)


def _recorded(
    name: str, m: TrueMachine, what: str, setup: dict[str, Any], axis: str | None, place: Floats, way: Floats,
    shown_um: Floats, noise_um: float, rng: np.random.Generator,
) -> Measurement:  # fmt: skip
    machine, n = machine_of(m.kind, TRAVEL_MM), len(place)
    channels = {a.channel: np.zeros(n) for a in machine.axes}
    for k, letter in enumerate(m.plane):
        one = machine.axis(letter)
        channels |= {one.channel: place[:, k], one.direction_channel: way[:, k]}
        if what == "grid_encoder":  # may read on the run, so its file says that it did not
            channels |= {one.velocity_channel: np.zeros(n), one.acceleration_channel: np.zeros(n)}
    made = make_instrument(what, setup, axis, None, machine, "proof")
    readings = shown_um + noise_um * rng.standard_normal(shown_um.shape)
    run = np.repeat(np.arange(1, RUNS + 1), n // RUNS)
    columns = dict(zip(made.columns(), readings.T, strict=True))
    return Measurement(name, made, machine, run, np.arange(0.0, 2.0 * n, 2.0), channels, columns)
