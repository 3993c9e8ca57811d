"""What an instrument is: a linear functional of the model, and what it cannot know (seam 5 of the architecture).

    reading = H(instrument, pose) · component errors + nuisance

`arms` gives `H · J`: how much each component error, µm or µrad, moves each reading, µm or µrad. All errors are of the
tool relative to the workpiece; a reading is actual minus nominal.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from rtec.effects import State
from rtec.machine import Machine
from rtec.metrology.measurement import Ints, Setup

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Nuisance:
    """Something in a reading that no machine error explains and that the fit must find along with it.

    Attributes:
        name: in the field's words: "zero", "slope", "cosine".
        unit: of its coefficient.
        values: what one unit adds to each reading, (readings, n).
        per: "run": another value for each run; "setup": one for the whole measurement.
    """

    name: str
    unit: str
    values: Floats
    per: Literal["run", "setup"]


@dataclass(frozen=True)
class Instrument(ABC):
    """An instrument with its set-up on one machine.

    Attributes:
        setup: the `[setup]` table.
        axis: axis that it follows, where it has one.
        component: component that it reads directly, where it does.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    setup_model: ClassVar[type[Setup]]

    setup: Setup
    axis: str | None = None
    component: str | None = None

    @abstractmethod
    def columns(self) -> tuple[str, ...]:
        """Names of the reading columns, with their unit: `reading_um`, `reading_x_um` and so on."""

    @abstractmethod
    def arms(self, machine: Machine, pose_mm: Floats) -> Floats:
        """How each component error moves each reading, (readings, n, components).

        Args:
            machine: whose chain is used.
            pose_mm: (n, axes).
        """

    @abstractmethod
    def nuisance(self, state: State, run: Ints) -> tuple[Nuisance, ...]:
        """What the instrument cannot know."""

    def check(self, machine: Machine, where: str) -> None:
        """Raise MeasurementError where axis, component or set-up do not fit the machine."""
        del machine, where
