"""The design matrix of tip-error readings: one column a coefficient, one row a number that was read."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, Parameter, State
from rtec.errors import ModelError
from rtec.model.model import names_of

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Design:
    """Effects, the state in which they were read, and the readings.

    Attributes:
        effects: without numbers.
        state: n instants.
        rows: instants with any reading.
        read: which of their three numbers were read, (rows, 3).
        reading: those numbers one after the other, µm, (m,).
        arms: lever arms at those instants, (rows, 3, components).
    """

    effects: tuple[Effect, ...]
    state: State
    rows: NDArray[np.int64]
    read: NDArray[np.bool_]
    reading: Floats
    arms: Floats

    @classmethod
    def of(cls, effects: Sequence[Effect], state: State, tip_um: Floats) -> "Design":
        """Prepare the design.

        Raises:
            ModelError: the readings are not (n, 3), or there are none.
        """
        if tip_um.shape != (len(state), 3):
            raise ModelError(f"fit: tip errors have the shape {tip_um.shape}; need ({len(state)}, 3)")
        if np.isinf(tip_um).any():
            raise ModelError("fit: a tip error is infinite")
        read = np.isfinite(tip_um)
        rows = np.flatnonzero(read.any(axis=1))
        if not len(rows) or not effects:
            raise ModelError("fit: there are no readings, or no effects")
        arms = state.machine.chain.jacobian(state.positions_mm()[rows])
        return cls(tuple(effects), state, rows, read[rows], tip_um[rows][read[rows]], arms)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Non-linear parameters of all effects, in order."""
        return tuple(p for e in self.effects for p in e.nonlinear(self.state.machine))

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """Which effect each column belongs to."""
        sizes = [len(e.coefficients(self.state.machine)) for e in self.effects]
        return np.repeat(np.arange(len(sizes)), sizes)

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.owner)

    @cached_property
    def fixed(self) -> Floats:
        """Columns that no non-linear parameter touches, (m, columns)."""
        still = [self._columns(e, ()) for e in self.effects if not e.nonlinear(self.state.machine)]
        return np.concatenate([np.zeros((len(self.reading), 0)), *still], axis=1)

    def moving(self, theta: Floats) -> Floats:
        """Columns that non-linear parameters touch, at their values θ, (m, columns)."""
        columns, first = [], 0
        for effect in self.effects:
            count = len(effect.nonlinear(self.state.machine))
            if count:
                columns.append(self._columns(effect, tuple(theta[first : first + count])))
            first += count
        return np.concatenate([np.zeros((len(self.reading), 0)), *columns], axis=1)

    def matrix(self, theta: Floats) -> Floats:
        """All columns in the order of the effects, (m, width)."""
        moved = np.array([bool(e.nonlinear(self.state.machine)) for e in self.effects])[self.owner]
        out = np.empty((len(self.reading), self.width))
        out[:, ~moved], out[:, moved] = self.fixed, self.moving(theta)
        return out

    def names(self, effects: Sequence[int]) -> str:
        """Effects by name and component, for messages."""
        return ", ".join(f"{self.effects[i].effect}({self.effects[i].component})" for i in effects)

    def _columns(self, effect: Effect, theta: tuple[float, ...]) -> Floats:
        machine = self.state.machine
        named = dict(zip(names_of(effect, machine)[1], theta, strict=True))
        arm = self.arms[:, :, machine.components.index(effect.component)]
        columns = []
        for value in effect.basis(machine, self.state, named):
            basis = np.broadcast_to(np.asarray(value, dtype=np.float64), (len(self.state),))[self.rows]
            columns.append((arm * basis[:, None])[self.read])
        return np.stack(columns, axis=1)
