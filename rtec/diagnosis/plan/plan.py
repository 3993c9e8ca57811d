"""Which parameters a set of tests separates, which stay confounded, and what test to add.

Every reading is linear in the parameters, so the question is one of linear algebra: the columns of all parameters in
all tests, whitened and scaled, with the unknowns of the instruments projected out. Its rank is the number of
combinations that are determined; its null directions are the sets that stay confounded.

The module also computes the columns of each parameter in a test, and the test's information about all of them.

A test's information is one small matrix, `Cᵀ C` of its columns over the noise with the unknowns of the instrument
projected out; that of several tests is the sum. So a possible test costs one matrix, however many there are.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.plan.parameters import Ball, Place, Planned, Stays, ball_place, planned
from rtec.effects import Effect
from rtec.errors import ModelError
from rtec.estimation.gls import without_nuisance
from rtec.estimation.readings import Readings, read
from rtec.metrology.ball_bar.circle import CircleTest, circle_of
from rtec.metrology.ball_bar.design import stacked_design
from rtec.metrology.instruments.ball_bar import BallBar, BallBarSetup
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect

USUAL_NOISE = 0.5
"""White noise of a reading by default, µm or µrad."""


def information(
    parameters: Sequence[Planned], measurement: Measurement, noise: float = USUAL_NOISE, stays: Stays = "shared"
) -> Floats:
    """Information of one test about the parameters, (parameters, parameters).

    Args:
        parameters: in question.
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
    """White columns beside one more unknown with a prior of one unit: most of their part along it is removed.

    Args:
        own: white column of one standard uncertainty of the unknown, (n,).
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
    """Columns with the unknowns of each run and each set-up projected out, (m, p)."""
    whole = np.concatenate([readings.setup, columns], axis=1)
    flat = np.stack([without_nuisance(readings, c) for c in whole.T], axis=1)
    count = readings.setup.shape[1]
    if not count:
        return flat
    return without(flat[:, :count], flat[:, count:])


def without(nuisance: Floats, columns: Floats) -> Floats:
    """Columns less their part along nuisances; zero for copies of them."""
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
    """Columns of a ball-bar test over its measured arc, as in `rtec ballbar`, then that of its ball's height."""
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
    """Unknown length of an uncalibrated bar, once or in every run."""
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
        out += part.factor * effect_columns(part.effect, readings, dict(part.theta) or None)[:, part.coefficient]
    return out


def _height_of(readings: Readings) -> Floats:
    """Change of readings by one standard uncertainty of a table-side ball's height, µm, (m,)."""
    instrument, row = readings.measurements[0].instrument, readings.series[0].row
    if not isinstance(instrument, BallBar):
        return np.zeros(len(readings))
    return _height(instrument.setup, instrument.bar_mm(readings.machine, readings.poses_mm[0])[row])


def _height(setup: BallBarSetup, bar_mm: Floats) -> Floats:
    along = bar_mm[:, setup.rows[2]] / np.linalg.norm(bar_mm, axis=1)
    return np.asarray(-1e3 * setup.height_uncertainty_mm * along)


def _ball_column(ball: Ball, setup: BallBarSetup, bar_mm: Floats, place: Place | None) -> Floats:
    """A ball that is one µm off shortens the bar by its share of it."""
    if ball.place != place:
        return np.zeros(len(bar_mm))
    return np.asarray(-bar_mm[:, setup.rows[ball.direction]] / np.linalg.norm(bar_mm, axis=1))


def _with_known_centre(measurement: Measurement) -> Measurement:
    """The same without the centre as a nuisance: it is a parameter of all tests with that ball."""
    instrument = measurement.instrument
    if not isinstance(instrument, BallBar):
        return measurement
    setup = instrument.setup.model_copy(update={"centre": "none"})
    return dataclasses.replace(measurement, instrument=dataclasses.replace(instrument, setup=setup))


UNSEEN = 1e-6
"""A parameter is not seen where its whitened column is smaller than this, for its usual size."""
ALIKE = 1e-4
"""A direction of the scaled columns with a singular value below this share of the largest is not separated."""
IN_IT = 0.1
"""From this share of the largest in such a direction on, a parameter belongs to the set."""
WEAK = 30.0
"""From this condition number on, parameters are separated only in theory."""
SURE = 3.0
"""Standard errors that make a size detectable."""
MOST_STEPS = 4
"""Most tests that are proposed one after another."""


@dataclass(frozen=True)
class Separation:
    """What a set of tests determines.

    Attributes:
        parameters: in question.
        rank: number of combinations that are determined.
        never: parameters that no reading sees.
        confounded: sets of parameters of which only combinations are determined.
        condition: of the scaled columns of those that are seen and separated.
        detectable: smallest detectable size of each parameter, three standard errors, in its unit; infinite
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
        """Whether every parameter is determined."""
        return self.rank == len(self.parameters)

    @property
    def found(self) -> set[str]:
        """Parameters that are determined each by itself."""
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
    """A possible additional test.

    Attributes:
        name: what the user does, in words.
        measurement: its poses and channels; the readings do not matter.
        hours: its duration, including setting up.
    """

    name: str
    measurement: Measurement
    hours: float

    @property
    def setup(self) -> dict[str, Any]:
        """Keys of `[setup]` with unusual values: where a circle's centre is, its radius, its feed."""
        return self.measurement.instrument.setup.model_dump(mode="json", exclude_defaults=True)

    def facts(self) -> dict[str, Any]:
        """What the test needs, as plain data."""
        instrument = self.measurement.instrument
        return {
            "test": self.name, "hours": self.hours, "instrument": instrument.name, "axis": instrument.axis,
            "setup": self.setup,
        }  # fmt: skip


@dataclass(frozen=True)
class Proposal:
    """What an additional test would bring.

    Attributes:
        test: the additional test.
        after: separation with it.
        gained: parameters that are determined only with it.
    """

    test: Extra
    after: Separation
    gained: tuple[str, ...]


Asked = Sequence[Effect | FittedEffect | Planned]


def separation(
    asked: Asked,
    measurements: Sequence[Measurement],
    noise: Mapping[str, float] | None = None,
    stays: Stays = "shared",
) -> Separation:
    """What a set of tests determines.

    Args:
        asked: effects whose coefficients are in question (non-linear parameters at their start, or as given), or
            parameters.
        measurements: poses and channels of the tests; readings may be anything.
        noise: white noise of a measurement by name, in the unit of its readings; 0.5 where not given.
        stays: which ball-bar tests share a table-side ball.
    """
    parameters = planned(asked, measurements[0].machine)
    return judge(parameters, total_information(parameters, measurements, noise or {}, stays))


def total_information(
    parameters: Sequence[Planned], measurements: Sequence[Measurement], noise: Mapping[str, float], stays: Stays
) -> Floats:
    """Information of several tests together, (parameters, parameters)."""
    parts = [information(parameters, m, noise.get(m.name, USUAL_NOISE), stays) for m in measurements]
    return np.asarray(np.sum(parts, axis=0))


def judge(parameters: Sequence[Planned], whole: Floats) -> Separation:
    """Rank, unseen and confounded parameters, smallest sizes; from the information of all tests."""
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
    """Rank additional tests: by what they would separate, then by duration, then by condition number."""
    parameters = planned(asked, measurements[0].machine)
    here = total_information(parameters, measurements, noise or {}, stays)
    return _ranked(parameters, here, information_by_test(parameters, extras, noise or {}, stays))


def route(
    asked: Asked,
    measurements: Sequence[Measurement],
    extras: Sequence[Extra],
    noise: Mapping[str, float] | None = None,
    stays: Stays = "shared",
) -> list[Proposal]:
    """Tests one after another, each the cheapest of the best, until everything is separated or nothing helps."""
    parameters = planned(asked, measurements[0].machine)
    here = total_information(parameters, measurements, noise or {}, stays)
    left = information_by_test(parameters, extras, noise or {}, stays)
    out: list[Proposal] = []
    while len(out) < MOST_STEPS and not judge(parameters, here).complete:
        ranked = [p for p in _ranked(parameters, here, left) if p.after.rank > judge(parameters, here).rank]
        if not ranked:
            break
        out.append(ranked[0])
        here = here + next(i for e, i in left if e is ranked[0].test)
    return out


def information_by_test(
    parameters: Sequence[Planned], extras: Sequence[Extra], noise: Mapping[str, float], stays: Stays
) -> list[tuple[Extra, Floats]]:
    """Information of each additional test; its noise is that of the others."""
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
