"""Which parameters a set of tests separates, which stay confounded, and what test to add.

Every reading is linear in the parameters, so the question is one of linear algebra: the columns of all parameters in
all tests, whitened and scaled, with what the instruments cannot know taken out. Its rank is the number of
combinations that can be found; directions that it does not see are the sets that stay confounded.

What each parameter adds to the readings of a test, and what that test tells of them all.

A test's information is one small matrix, `Cᵀ C` of its columns over the noise with what the instrument cannot know
taken out; that of several tests is the sum. So a test that might be added costs one matrix, however many there are.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.plan.parameters import Ball, Place, Planned, Stays, ball_place, planned
from rtec.effects import Effect
from rtec.errors import ModelError
from rtec.estimation.gls import without_nuisance
from rtec.estimation.readings import Readings, read
from rtec.metrology.ball_bar.circle import CircleTest, circle_of
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
        whole = _on_circle(parameters, circle_of(measurement), place)
    else:
        asked = any(p.ball is not None and p.ball.place == place for p in parameters)
        readings = read([_with_known_centre(measurement) if asked else measurement])
        columns = [*(_column(p, readings, place) for p in parameters), _height_of(readings)]
        whole = clean(np.stack(columns, axis=1), readings)
    scaled = beside_prior(whole[:, -1] / noise, whole[:, :-1] / noise)
    return np.asarray(scaled.T @ scaled)


def beside_prior(own: Floats, columns: Floats) -> Floats:
    """White columns beside one more unknown that is known to one unit before: most of their part along it goes.

    Args:
        own: what one standard uncertainty of the unknown makes, white, (n,).
        columns: (n, p).
    """
    power = float(own @ own)
    if power == 0.0:
        return columns
    keep = 1.0 / math.sqrt(1.0 + power)
    return np.asarray(columns - np.outer(own, (1.0 - keep) / power * (own @ columns)))


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


def _on_circle(parameters: Sequence[Planned], circle: CircleTest, place: Place | None) -> Floats:
    """Columns of a ball-bar test over its measured arc, as `rtec ballbar` has them, then that of its ball's height."""
    strange = next((p.name for p in parameters if p.bar is None and p.ball is None), None)
    if strange is not None:
        raise ModelError(f"plan: {strange} cannot be asked for together with a ball bar's own parameters")
    of = [(p.bar.cause, p.bar.origin) for p in parameters if p.bar is not None]
    made = iter(stacked_design([cause for cause, _ in of], [of[0][1], circle])[len(of[0][1]) :].T)
    bar = circle.instrument.bar_mm(circle.machine, circle.pose_mm)
    own = [_ball_column(p.ball, circle.setup, bar, place) if p.ball is not None else next(made) for p in parameters]
    columns = np.stack([*own, _height(circle.setup, bar)], axis=1)
    zeros = _zeros(circle)
    return without(zeros, columns) if zeros.shape[1] else columns


def _zeros(circle: CircleTest) -> Floats:
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


def _height_of(readings: Readings) -> Floats:
    """What the height of a table-side ball makes of readings, for one standard uncertainty of it, µm, (m,)."""
    instrument, row = readings.measurements[0].instrument, readings.series[0].row
    if not isinstance(instrument, BallBar):
        return np.zeros(len(readings))
    return _height(instrument.setup, instrument.bar_mm(readings.machine, readings.poses_mm[0])[row])


def _height(setup: BallBarSetup, bar_mm: Floats) -> Floats:
    along = bar_mm[:, setup.rows[2]] / np.linalg.norm(bar_mm, axis=1)
    return np.asarray(-1e3 * setup.height_uncertainty_mm * along)


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


UNSEEN = 1e-6
"""A parameter whose whitened column is smaller than this, for its usual size, is not seen."""
ALIKE = 1e-4
"""A direction of the scaled columns with a singular value below this share of the largest is not separated."""
IN_IT = 0.1
"""Share of the largest in such a direction from which on a parameter belongs to the set."""
WEAK = 30.0
"""A condition number from which on parameters are separated on paper only."""
SURE = 3.0
"""So many standard errors make a size detectable."""
MOST_STEPS = 4
"""Tests that are proposed one after another, at most."""


@dataclass(frozen=True)
class Separation:
    """What a set of tests can tell.

    Attributes:
        parameters: that were asked for.
        rank: combinations that can be found.
        never: parameters that no reading sees.
        confounded: sets of parameters of which only combinations can be found.
        condition: of the scaled columns of those that are seen and separated.
        detectable: smallest size of each parameter that is found with three standard errors, in its unit; infinite
            for those never seen or confounded.
    """

    parameters: tuple[Planned, ...]
    rank: int
    never: tuple[str, ...]
    confounded: tuple[tuple[str, ...], ...]
    condition: float
    detectable: Mapping[str, float]

    @property
    def complete(self) -> bool:
        """Whether every parameter can be found."""
        return self.rank == len(self.parameters)

    @property
    def found(self) -> set[str]:
        """Parameters that can be found each by itself."""
        return {name for name, size in self.detectable.items() if math.isfinite(size)}

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "parameters": [{"name": p.name, "unit": p.unit, "typical": p.typical} for p in self.parameters],
            "rank": self.rank,
            "count": len(self.parameters),
            "never_seen": list(self.never),
            "confounded": [list(c) for c in self.confounded],
            "condition_number": self.condition,
            "smallest_detectable": {k: v if math.isfinite(v) else None for k, v in self.detectable.items()},
        }


@dataclass(frozen=True)
class Extra:
    """A test that might be added.

    Attributes:
        name: what is done, for people.
        measurement: its poses and channels; the readings do not matter.
        hours: how long it takes, setting up and all.
    """

    name: str
    measurement: Measurement
    hours: float

    @property
    def setup(self) -> dict[str, Any]:
        """Keys of `[setup]` that are not as usual: where a circle's centre is, its radius, its feed."""
        return self.measurement.instrument.setup.model_dump(mode="json", exclude_defaults=True)

    def facts(self) -> dict[str, Any]:
        """What it takes to make it, as plain data."""
        instrument = self.measurement.instrument
        return {
            "test": self.name, "hours": self.hours, "instrument": instrument.name, "axis": instrument.axis,
            "setup": self.setup,
        }  # fmt: skip


@dataclass(frozen=True)
class Proposal:
    """What a test would add.

    Attributes:
        test: which.
        after: what could be told with it.
        gained: parameters found with it and not without.
    """

    test: Extra
    after: Separation
    gained: tuple[str, ...]


Asked = Sequence[Effect | Planned]


def separation(
    asked: Asked,
    measurements: Sequence[Measurement],
    noise: Mapping[str, float] | None = None,
    stays: Stays = "shared",
) -> Separation:
    """Say what a set of tests can tell.

    Args:
        asked: effects whose coefficients are to be found (non-linear ones are taken at their start), or parameters.
        measurements: poses and channels of the tests; readings may be anything.
        noise: white noise of a measurement by name, in the unit of its readings; 0.5 where not given.
        stays: which ball-bar tests share a table-side ball.
    """
    parameters = planned(asked, measurements[0].machine)
    return judge(parameters, told(parameters, measurements, noise or {}, stays))


def told(
    parameters: Sequence[Planned], measurements: Sequence[Measurement], noise: Mapping[str, float], stays: Stays
) -> Floats:
    """What several tests tell together, (parameters, parameters)."""
    parts = [information(parameters, m, noise.get(m.name, USUAL_NOISE), stays) for m in measurements]
    return np.asarray(np.sum(parts, axis=0))


def judge(parameters: Sequence[Planned], whole: Floats) -> Separation:
    """Rank, what is never seen, what is confounded, smallest sizes; from what the tests tell together."""
    typical = np.array([p.typical for p in parameters])
    size = np.sqrt(np.maximum(np.diag(whole), 0.0))
    seen = size * typical > UNSEEN
    never = tuple(p.name for p, s in zip(parameters, seen, strict=True) if not s)
    kept = [p for p, s in zip(parameters, seen, strict=True) if s]
    detectable = dict.fromkeys([p.name for p in parameters], math.inf)
    if not kept:
        return Separation(tuple(parameters), 0, never, (), math.inf, detectable)
    scaled = whole[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    value, vector = np.linalg.eigh(scaled)
    singular = np.sqrt(np.maximum(value, 0.0))
    good = singular > ALIKE * singular[-1]
    confounded = _sets(vector[:, ~good], kept)
    lost = {name for group in confounded for name in group}
    inverse = (vector[:, good] / value[good]) @ vector[:, good].T
    for i, p in enumerate(kept):
        if p.name not in lost:
            detectable[p.name] = float(SURE * math.sqrt(inverse[i, i]) / size[seen][i])
    condition = float(singular[-1] / singular[good][0])
    return Separation(tuple(parameters), int(good.sum()), never, confounded, condition, detectable)


def propose(
    asked: Asked,
    measurements: Sequence[Measurement],
    extras: Sequence[Extra],
    noise: Mapping[str, float] | None = None,
    stays: Stays = "shared",
) -> list[Proposal]:
    """Rank tests that might be added: by what they would separate, then by time, then by condition number."""
    parameters = planned(asked, measurements[0].machine)
    here = told(parameters, measurements, noise or {}, stays)
    return _ranked(parameters, here, told_by(parameters, extras, noise or {}, stays))


def route(
    asked: Asked,
    measurements: Sequence[Measurement],
    extras: Sequence[Extra],
    noise: Mapping[str, float] | None = None,
    stays: Stays = "shared",
) -> list[Proposal]:
    """Tests one after another, the cheapest of the best each time, until everything is told apart or nothing helps."""
    parameters = planned(asked, measurements[0].machine)
    here = told(parameters, measurements, noise or {}, stays)
    left = told_by(parameters, extras, noise or {}, stays)
    out: list[Proposal] = []
    while len(out) < MOST_STEPS and not judge(parameters, here).complete:
        ranked = [p for p in _ranked(parameters, here, left) if p.after.rank > judge(parameters, here).rank]
        if not ranked:
            break
        out.append(ranked[0])
        here = here + next(i for e, i in left if e is ranked[0].test)
    return out


def told_by(
    parameters: Sequence[Planned], extras: Sequence[Extra], noise: Mapping[str, float], stays: Stays
) -> list[tuple[Extra, Floats]]:
    """What each test that might be added tells; its noise is that of the others."""
    usual = float(np.median(list(noise.values()))) if noise else USUAL_NOISE
    return [(e, information(parameters, e.measurement, noise.get(e.name, usual), stays)) for e in extras]


def _ranked(parameters: Sequence[Planned], here: Floats, extras: Sequence[tuple[Extra, Floats]]) -> list[Proposal]:
    before = judge(parameters, here)
    out = []
    for test, more in extras:
        after = judge(parameters, here + more)
        out.append(Proposal(test, after, tuple(sorted(after.found - before.found))))
    useful = [p for p in out if p.after.rank > before.rank or p.after.condition < 0.7 * before.condition]
    return sorted(useful, key=lambda p: (-p.after.rank, p.test.hours, p.after.condition))


def _sets(unseen: Floats, parameters: Sequence[Planned]) -> tuple[tuple[str, ...], ...]:
    """Sets of parameters that share unseen directions.

    A basis of the unseen directions is not unique, so the sets are the connected parts of their projector: two
    parameters belong together where some unseen direction moves both.
    """
    if not unseen.shape[1]:
        return ()
    projector = unseen @ unseen.T
    touched = [i for i in range(len(parameters)) if projector[i, i] > IN_IT**2 * projector.diagonal().max()]
    left, out = set(touched), []
    while left:
        group, edge = set(), {min(left)}
        while edge:
            i = edge.pop()
            group.add(i)
            near = {j for j in left - group if abs(projector[i, j]) > IN_IT**2}
            edge |= near
        left -= group
        out.append(tuple(parameters[i].name for i in sorted(group)))
    return tuple(out)
