"""Track of the tool tip of a simulated machine, and its accuracy."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rtec.hil import Accuracy
from rtec.machine import Machine

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TipTrack:
    """Track; one row an instant.

    Attributes:
        time_s: time since the machine's start, (n,).
        commanded_mm: (n, axes).
        tip_um: tool relative to workpiece, actual minus commanded, (n, 3).
        inserted: inserted counts at the machine's controller, (n, axes).
    """

    time_s: Floats
    commanded_mm: Floats
    tip_um: Floats
    inserted: NDArray[np.int64]

    def save(self, path: Path) -> None:
        """Write it as plain arrays."""
        np.savez(path, **vars(self))

    @classmethod
    def load(cls, path: Path) -> "TipTrack":
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as arrays:
            return cls(**{name: arrays[name] for name in cls.__dataclass_fields__})


def directions(machine: Machine) -> tuple[str, ...]:
    """Directions of the axes that are compensated, in the order X, Y, Z."""
    return tuple(d for d in "XYZ" if any(a.direction == d and a.compensate for a in machine.axes))


def errors_um(track: TipTrack, names: Sequence[str]) -> Floats:
    """Tip errors in some directions, (n, directions)."""
    return track.tip_um[:, ["XYZ".index(d) for d in names]]


def inside(time_s: Floats, spans: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Which instants are in any of the spans, (n,)."""
    out = np.zeros(len(time_s), np.bool_)
    for low, high in spans:
        out |= (time_s >= low) & (time_s <= high)
    return out


def accuracy(track: TipTrack, names: Sequence[str], spans: Sequence[tuple[float, float]]) -> Accuracy:
    """Accuracy of the tip in these spans of time."""
    error = errors_um(track, names)[inside(track.time_s, spans)]
    if not len(error):
        return Accuracy(float("nan"), float("nan"), dict.fromkeys(names, float("nan")))
    rms = np.sqrt(np.mean(error**2, axis=0))
    return Accuracy(
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        float(np.abs(error).max()),
        dict(zip(names, rms.tolist(), strict=True)),
    )
