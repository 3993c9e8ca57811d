"""What each parameter adds to the readings of a test, and what that test tells of them all.

A test's information is one small matrix, `Cᵀ C` of its columns over the noise with what the instrument cannot know
taken out; that of several tests is the sum. So a test that might be added costs one matrix, however many there are.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.plan.parameters import Ball, Place, Planned, Stays, ball_place
from rtec.effects import Effect
from rtec.errors import ModelError
from rtec.estimation.gls import without_nuisance
from rtec.estimation.readings import Readings, read
from rtec.metrology.ball_bar.circle import Circle, circle_of
from rtec.metrology.ball_bar.design import stacked_design
from rtec.metrology.instruments.ball_bar import BallBar, BallBarSetup
from rtec.metrology.measurement import Measurement

Floats = NDArray[np.float64]
USUAL_NOISE = 0.5
"""White noise of a reading where nobody says, µm or µrad."""


def information(
    parameters: Sequence[Planned], measurement: Measurement, noise: float = USUAL_NOISE, stays: Stays = "shared"
) -> Floats:
    """What one test tells of the parameters, (parameters, parameters).

    Args:
        parameters: asked for.
        measurement: poses and channels; readings may be anything.
        noise: white noise of its readings, µm or µrad.
        stays: which ball-bar tests share a table-side ball.
    """
    place = ball_place(measurement, stays)
    if any(_reads_itself(p, measurement) for p in parameters):
        columns = _on_circle(parameters, circle_of(measurement), place)
    else:
        asked = any(p.ball is not None and p.ball.place == place for p in parameters)
        readings = read([_with_known_centre(measurement) if asked else measurement])
        columns = clean(np.stack([_column(p, readings, place) for p in parameters], axis=1), readings)
    scaled = columns / noise
    return np.asarray(scaled.T @ scaled)


def effect_columns(effect: Effect, readings: Readings, theta: dict[str, float] | None = None) -> Floats:
    """One column a coefficient, (m, coefficients); zero where a channel is not recorded."""
    at = {p.name: p.start for p in effect.nonlinear(readings.machine)} if theta is None else theta
    try:
        return readings.columns(effect, at)
    except ModelError:
        return np.zeros((len(readings), len(effect.coefficients(readings.machine))))


def clean(columns: Floats, readings: Readings) -> Floats:
    """Columns with what each run and each set-up cannot know taken out, (m, p)."""
    whole = np.concatenate([readings.setup, columns], axis=1)
    flat = np.stack([without_nuisance(readings, c) for c in whole.T], axis=1)
    count = readings.setup.shape[1]
    if not count:
        return flat
    return without(flat[:, :count], flat[:, count:])


def without(nuisance: Floats, columns: Floats) -> Floats:
    """Columns less their part along nuisances; of nuisances that are copies of others nothing is left."""
    basis, size, _ = np.linalg.svd(nuisance, full_matrices=False)
    q = basis[:, size > 1e-9 * max(float(size[0]), 1e-300)]
    return np.asarray(columns - q @ (q.T @ columns))


def _reads_itself(parameter: Planned, measurement: Measurement) -> bool:
    """Whether `rtec ballbar` has a column of its own for it in this test."""
    instrument = measurement.instrument
    if parameter.bar is None or not isinstance(instrument, BallBar):
        return False
    return instrument.setup.plane == parameter.bar.origin.setup.plane


def _on_circle(parameters: Sequence[Planned], circle: Circle, place: Place | None) -> Floats:
    """Columns of a ball-bar test over its measured arc, as `rtec ballbar` has them, (n, parameters)."""
    strange = next((p.name for p in parameters if p.bar is None and p.ball is None), None)
    if strange is not None:
        raise ModelError(f"plan: {strange} cannot be asked for together with a ball bar's own parameters")
    own = [(p.bar.cause, p.bar.origin) for p in parameters if p.bar is not None]
    made = iter(stacked_design([cause for cause, _ in own], [own[0][1], circle])[len(own[0][1]) :].T)
    bar = circle.instrument.bar_mm(circle.machine, circle.pose_mm)
    columns = np.stack(
        [_ball_column(p.ball, circle.setup, bar, place) if p.ball is not None else next(made) for p in parameters],
        axis=1,
    )
    zeros = _zeros(circle)
    return without(zeros, columns) if zeros.shape[1] else columns


def _zeros(circle: Circle) -> Floats:
    """Unknown length of a bar that was not calibrated, once or in every run."""
    n = len(circle)
    if circle.setup.zero == "setup":
        return np.ones((n, 1))
    if circle.setup.zero == "run":
        return np.asarray(circle.run[:, None] == np.unique(circle.run)[None], dtype=np.float64)
    return np.zeros((n, 0))


def _column(parameter: Planned, readings: Readings, place: Place | None) -> Floats:
    instrument, row = readings.measurements[0].instrument, readings.series[0].row
    if parameter.ball is not None:
        if not isinstance(instrument, BallBar):
            return np.zeros(len(readings))
        bar = instrument.bar_mm(readings.machine, readings.poses_mm[0])[row]
        return _ball_column(parameter.ball, instrument.setup, bar, place)
    out = np.zeros(len(readings))
    for part in parameter.parts:
        out += part.factor * effect_columns(part.effect, readings)[:, part.coefficient]
    return out


def _ball_column(ball: Ball, setup: BallBarSetup, bar_mm: Floats, place: Place | None) -> Floats:
    """A ball that stands one µm off shortens the bar by its share of it."""
    if ball.place != place:
        return np.zeros(len(bar_mm))
    return np.asarray(-bar_mm[:, setup.rows[ball.direction]] / np.linalg.norm(bar_mm, axis=1))


def _with_known_centre(measurement: Measurement) -> Measurement:
    """The same with the centre no nuisance of its own: it is a parameter of all tests with that ball."""
    instrument = measurement.instrument
    if not isinstance(instrument, BallBar):
        return measurement
    setup = instrument.setup.model_copy(update={"centre": "none"})
    return dataclasses.replace(measurement, instrument=dataclasses.replace(instrument, setup=setup))
