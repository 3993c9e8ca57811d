"""Encoder lines A, B and Z from a position: what a logic analyser would see.

Gray code of `floor(counts) mod 4`: 0 → A0 B0, 1 → A1 B0, 2 → A1 B1, 3 → A0 B1; so A leads B in the positive
direction and every edge of either line is one count [G 4]. Z is high for one count in each turn.
"""

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError
from rtec.machine import Machine

Floats = NDArray[np.float64]
A_BIT, B_BIT, Z_BIT = 1, 2, 4
GRAY = np.array([0, A_BIT, A_BIT | B_BIT, B_BIT], dtype=np.uint8)


def lines_of(position_counts: Floats, counts_per_index: int | None = None) -> NDArray[np.uint8]:
    """Lines at each sample, one byte each: bit 0 A, bit 1 B, bit 2 Z.

    Args:
        position_counts: position of the encoder, counts after x4, at equal steps of time, (n, …).
        counts_per_index: distance between index marks; None = a single mark at count 0.

    Raises:
        ConfigError: the encoder moves by more than one count between two samples, so its lines would be lost.
    """
    count = np.floor(position_counts).astype(np.int64)
    step = int(np.max(np.abs(np.diff(count, axis=0)), initial=0))
    if step > 1:
        raise ConfigError(
            f"encoder lines: {step} counts between two samples; sample at least {step} times as fast as now"
        )
    marked = count == 0 if counts_per_index is None else count % counts_per_index == 0
    return GRAY[count % 4] | np.where(marked, np.uint8(Z_BIT), np.uint8(0))


def lines_between(machine: Machine, start_counts: Floats, tick_counts: Floats, samples: int) -> NDArray[np.uint8]:
    """Lines of all axes at `samples` equal steps over a run of servo ticks, the last at the last tick, (samples, axes).

    Args:
        machine: gives the distance between index marks, one a pitch.
        start_counts: position before the first tick, (axes,).
        tick_counts: position after each tick, (ticks, axes); between ticks an axis moves evenly.
        samples: how many samples in the whole run.
    """
    known = np.concatenate([start_counts[None], tick_counts])
    at = np.arange(1, samples + 1) * (len(tick_counts) / max(samples, 1))
    out = np.zeros((samples, len(machine.axes)), dtype=np.uint8)
    for a, axis in enumerate(machine.axes):
        index = round(axis.pitch_mm * axis.counts_per_mm) if axis.pitch_mm else None
        out[:, a] = lines_of(np.interp(at, np.arange(len(known)), known[:, a]), index)
    return out
