"""Fits effects to tip-error readings: linear coefficients by least squares, the few others by variable projection.

A reading of the tip error is linear in the coefficients (seam 5 of the architecture): the design column of a
coefficient is the lever arm of its component times its basis function, `J(pose)[:, component] · basis(state)`.
Non-linear parameters θ (time constant, pitch, exponent) are searched for within their bounds; for every θ tried,
the coefficients are those that fit best, so the search runs over θ alone (Golub and Pereyra's variable projection).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.effects import Effect, Parameter, State
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.model.design import Design, Floats
from rtec.model.model import FittedEffect, Model, names_of

DEPENDENT = 1e-8
"""A direction of the design below this share of its largest is not seen by the readings."""
NAMED = 0.05
"""Effects with at least this share in such a direction are named."""
LOG_SPAN = 50.0
"""Parameters whose bounds are further apart than this factor are searched for on a logarithmic scale."""


@dataclass(frozen=True)
class Margin:
    """How far beyond the readings a model may be used: a share of what was seen, and at least so many °C.

    Another day begins a little colder or ends a little warmer than the day of the readings; outside the valid range
    the guard holds the correction where it is.
    """

    share: float = 0.05
    least_degc: float = 2.0


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


@dataclass(frozen=True)
class SearchScale:
    """A parameter's bounds as 0 … 1, straight or logarithmic."""

    low: float
    high: float
    log: bool

    @classmethod
    def of(cls, parameter: Parameter) -> "SearchScale":
        """Give the scale of a parameter; ModelError where it has no bounds."""
        low, high = parameter.low, parameter.high
        if not np.isfinite([low, high]).all():
            raise ModelError(f"fit: non-linear parameter {parameter.name!r} has no bounds to search within")
        log = low > 0 and high / low > LOG_SPAN
        return cls(np.log(low), np.log(high), True) if log else cls(low, high, False)

    def value(self, place: float) -> float:
        """Give the parameter at a place in 0 … 1."""
        there = self.low + (self.high - self.low) * place
        return float(np.exp(there)) if self.log else float(there)

    def place(self, value: float) -> float:
        """Give the place of a parameter, 0 … 1 within the bounds."""
        there = np.log(value) if self.log else value
        return float((there - self.low) / (self.high - self.low))


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


def valid_range(
    effects: Sequence[Effect], read: Sequence[tuple[State, NDArray[np.int64]]], margin: Margin
) -> dict[str, tuple[float, float]]:
    """Range of every channel that the effects read, where there are readings, with the margin.

    Directions have no margin. Velocities and accelerations take in standstill, at which every motion begins and
    ends. Distances since a reversal have no range: each begins at nothing and is as long as the travel allows.

    Args:
        effects: whose channels.
        read: states, and the rows of each that have a reading; a state without a channel says nothing of it.
        margin: how far beyond.
    """
    machine = read[0][0].machine
    directions = {a.direction_channel for a in machine.axes}
    rates = {c for a in machine.axes for c in (a.velocity_channel, a.acceleration_channel)}
    since = {a.since_reversal_channel for a in machine.axes}
    out = {}
    for channel in sorted({c for e in effects for c in e.channels(machine)} - since):
        seen = [state.value(channel)[rows] for state, rows in read if state.has(channel) and len(rows)]
        low, high = float(min(s.min() for s in seen)), float(max(s.max() for s in seen))
        if channel in rates:
            low, high = min(low, 0.0), max(high, 0.0)
        extra = margin.share * (high - low)
        if channel in machine.sensor_names:
            extra = max(extra, margin.least_degc)
        out[channel] = (low, high) if channel in directions else (low - extra, high + extra)
    return out
