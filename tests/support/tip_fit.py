"""A fit of effects to tip errors, independent of the engine in `rtec.estimation`; the tests' oracle for it.

A reading of the tip error is linear in the coefficients: the column of a coefficient is the lever arm of its component
times its basis function, `J(pose)[:, component] · basis(state)`. The other parameters θ are searched for within their
bounds by variable projection (Golub and Pereyra).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, Parameter, State
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.model.fit import Margin, SearchScale, valid_range
from rtec.model.model import FittedEffect, Model, names_of

Floats = NDArray[np.float64]
DEPENDENT = 1e-8
"""A direction of the design below this share of its largest is not seen by the readings."""
NAMED = 0.05
"""Effects with at least this share in such a direction are named."""


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


def fit_model(
    effects: Sequence[Effect],
    state: State,
    tip_um: Floats,
    *,
    name: str = "model",
    measurements: Mapping[str, str] | None = None,
    margin: Margin | None = None,
) -> Model:
    """Fit effects to tip-error readings.

    Args:
        effects: without numbers.
        state: n instants in order; instants without a reading are welcome, because lags need the temperatures
            between the readings too.
        tip_um: tip error as read, µm, (n, 3): actual minus nominal; NaN where not read.
        name: of the model.
        measurements: SHA-256 by name, kept in the model.
        margin: how far the valid ranges reach beyond the readings.

    Returns:
        The model with coefficients, standard errors (they suppose independent noise of one size), the valid range
        of every channel that it reads, and the noise, µm: root of the residual sum of squares by degrees of freedom.
        A non-linear parameter that ends on its bound has no standard error.

    Raises:
        ModelError: an effect does not fit the machine, there are fewer readings than numbers to find, or the
            readings cannot tell some effects apart; the message names those.
    """
    for i, effect in enumerate(effects):
        effect.check(state.machine, f"fit: [effect {i + 1}, {effect.effect}]")
    design = Design.of(effects, state, tip_um)
    free = design.parameters
    if len(design.reading) <= design.width + len(free):
        raise ModelError(f"fit: {len(design.reading)} readings for {design.width + len(free)} numbers; take more")
    theta = _search(design, free) if free else np.zeros(0)
    matrix = design.matrix(theta)
    _tell_apart(design, matrix)
    values, residual = _solve(matrix, design.reading)
    noise_um = float(np.sqrt(residual @ residual / (len(residual) - len(values) - len(theta))))
    errors = noise_um * _unit_errors(design, matrix, values, theta)
    return Model(
        machine=state.machine,
        effects=tuple(fitted_effects(design.effects, state.machine, values, theta, errors)),
        name=name,
        reference_degc=state.reference_degc,
        valid_range=valid_range(design.effects, [(state, design.rows)], margin or Margin()),
        noise_um=noise_um,
        measurements=measurements or {},
        history=({"change": "fit", "readings": len(residual), "numbers": len(values) + len(theta)},),
    )


def _search(design: Design, free: Sequence[Parameter]) -> Floats:
    """Variable projection: θ that leaves least, within the bounds.

    Columns that θ does not touch are projected out once; what is left of the readings is fitted at each θ by the few
    columns that it does touch.
    """
    from scipy.optimize import least_squares

    scales = [SearchScale.of(p) for p in free]
    basis = np.linalg.qr(design.fixed)[0]
    reading = design.reading - basis @ (basis.T @ design.reading)

    def left(x: NDArray[np.float64]) -> Floats:
        columns = design.moving(np.array([s.value(v) for s, v in zip(scales, x, strict=True)]))
        columns = columns - basis @ (basis.T @ columns)
        return reading - columns @ np.linalg.lstsq(columns, reading, rcond=None)[0]

    start = np.array([s.place(p.start) for s, p in zip(scales, free, strict=True)])
    found = least_squares(left, np.clip(start, 1e-6, 1 - 1e-6), bounds=(0.0, 1.0), ftol=1e-7, xtol=1e-6, max_nfev=60)
    return np.array([s.value(v) for s, v in zip(scales, found.x, strict=True)])


def _tell_apart(design: Design, matrix: Floats) -> None:
    """Raise ModelError where a combination of effects leaves every reading as it is."""
    size = np.linalg.norm(matrix, axis=0)
    blind = sorted({design.owner[k] for k in np.flatnonzero(size == 0)})
    if blind:
        raise ModelError(f"fit: no reading shows {design.names(blind)}; nothing that it depends on was there")
    _, singular, directions = np.linalg.svd(np.linalg.qr(matrix / size, mode="r"))
    sets = []
    for row in directions[singular < DEPENDENT * singular[0]]:
        share = np.abs(row) >= NAMED * np.abs(row).max()
        sets.append(design.names(sorted({design.owner[k] for k in np.flatnonzero(share)})))
    if sets:
        raise ModelError(
            "\n".join(
                f"fit: these cannot be distinguished by the readings (confounded): {s}" for s in dict.fromkeys(sets)
            )
            + "\nleave one out, or measure where they differ"
        )


def _solve(matrix: Floats, reading: Floats) -> tuple[Floats, Floats]:
    size = np.linalg.norm(matrix, axis=0)
    values = np.linalg.lstsq(matrix / size, reading, rcond=None)[0] / size
    return values, reading - matrix @ values


def _unit_errors(design: Design, matrix: Floats, values: Floats, theta: Floats) -> Floats:
    """Standard errors for noise of 1 µm, coefficients first; NaN for a θ on its bound."""
    slopes, inside = _slopes(design, values, theta)
    whole = np.concatenate([matrix, slopes], axis=1)
    size = np.linalg.norm(whole, axis=0)
    triangle = np.linalg.qr(whole / np.where(size > 0, size, 1.0), mode="r")
    inverse = np.linalg.pinv(triangle, rcond=1e-12)
    errors = np.full(len(values) + len(theta), np.nan)
    known = np.concatenate([np.ones(len(values), bool), inside])
    errors[known] = np.linalg.norm(inverse, axis=1) / np.where(size > 0, size, np.nan)
    return errors


def _slopes(design: Design, values: Floats, theta: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """How the readings' prediction changes with each θ that is inside its bounds, and which those are."""
    columns, inside = [], np.zeros(len(theta), bool)
    for i, parameter in enumerate(design.parameters):
        step = 1e-5 * (parameter.high - parameter.low)
        if not parameter.low + 2 * step < theta[i] < parameter.high - 2 * step:
            continue
        inside[i] = True
        step = min(step, 1e-3 * abs(theta[i])) if theta[i] else step
        ends = []
        for sign in (1.0, -1.0):
            moved = theta.copy()
            moved[i] += sign * step
            ends.append(design.matrix(moved) @ values)
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.array(columns).reshape(-1, len(design.reading)).T, inside


def fitted_effects(
    effects: Sequence[Effect], machine: Machine, values: Floats, theta: Floats, errors: Floats
) -> list[FittedEffect]:
    """Give each effect its numbers: coefficients, non-linear parameters, and the standard errors of both in a row."""
    out, first, first_free = [], 0, 0
    for effect in effects:
        linear, free = names_of(effect, machine)
        ends = first + len(linear), first_free + len(free)
        names = (*linear, *free)
        found = [*errors[first : ends[0]], *errors[len(values) + first_free : len(values) + ends[1]]]
        out.append(
            FittedEffect(
                effect,
                dict(zip(linear, map(float, values[first : ends[0]]), strict=True)),
                dict(zip(free, map(float, theta[first_free : ends[1]]), strict=True)),
                {n: float(e) for n, e in zip(names, found, strict=True) if np.isfinite(e)},
            )
        )
        first, first_free = ends
    return out
