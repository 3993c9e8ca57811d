"""Recordings of the simulated machine, instant by instant, with the truth."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.sim.controller import T_COMMAND, T_MOTOR, T_READING, T_SLIDE
from rtec.sim.geometry import Geometry

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class MotionRecording:
    """A recording, one row an instant; tip errors as in `SimulatedMachine`.

    Attributes:
        time_ns: (n,).
        commanded_mm, actual_mm: (n, axes); actual is the true position of the slides.
        raw_counts: (n, axes).
        reading_counts: the encoder's position as a real number of counts; `raw_counts` is its floor.
        tip_error_um, geometric_error_um: (n, 3).
    """

    time_ns: Ints
    commanded_mm: Floats
    actual_mm: Floats
    raw_counts: Ints
    reading_counts: Floats
    tip_error_um: Floats
    geometric_error_um: Floats


def recording_of(geometry: Geometry, counts_per_mm: Floats, trace: Floats, time_ns: Ints) -> MotionRecording:
    """A recording from the controller's trace, (n, axes, 4), all of it within one second of constant temperatures."""
    command, reading = trace[:, :, T_COMMAND], trace[:, :, T_READING]
    slides = geometry.slides_mm(trace[:, :, T_MOTOR], trace[:, :, T_SLIDE])
    tip = geometry.tip_mm(reading, slides)
    nominal = geometry.chain.nominal_mm
    in_counts = reading * counts_per_mm + 0.5
    return MotionRecording(
        time_ns=time_ns,
        commanded_mm=command.copy(),
        actual_mm=slides,
        raw_counts=np.floor(in_counts).astype(np.int64),
        reading_counts=in_counts,
        tip_error_um=(tip - nominal(command)) * 1e3,
        geometric_error_um=(tip - nominal(reading)) * 1e3,
    )
