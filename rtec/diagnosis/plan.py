"""Which parameters a set of tests separates, which stay confounded, and what test to add.

Every reading is linear in the parameters, so the question is one of linear algebra: the columns of all parameters in
all tests, whitened and scaled, with what the instruments cannot know taken out. Its rank is the number of
combinations that can be found; directions that it does not see are the sets that stay confounded.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.diagnosis.readings import Readings, read
from rtec.diagnosis.refit import without_nuisance
from rtec.effects import Effect
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement

Floats = NDArray[np.float64]

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


@dataclass(frozen=True)
class Planned:
    """A parameter that the tests are to find.

    Attributes:
        name: effect, component, what it depends on, and the coefficient.
        effect: whose.
        coefficient: its number among the effect's.
        unit: of the coefficient.
        typical: a usual size.
    """

    name: str
    effect: Effect
    coefficient: int
    unit: str
    typical: float


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
        hours: how long it takes.
    """

    name: str
    measurement: Measurement
    hours: float


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


def planned(effects: Sequence[Effect], machine: Machine) -> tuple[Planned, ...]:
    """Parameters of effects."""
    out = []
    for effect in effects:
        extra = [str(getattr(effect, k)) for k in ("axis", "sensor", "front", "back") if getattr(effect, k, None)]
        coefficients = effect.coefficients(machine)
        for i, p in enumerate(coefficients):
            label = f"{effect.effect}({', '.join([effect.component, *extra])})"
            out.append(Planned(label if len(coefficients) == 1 else f"{label} {p.name}", effect, i, p.unit, p.typical))
    names = [p.name for p in out]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice:
        raise ModelError(f"plan: {twice} stands twice among the effects")
    return tuple(out)


def separation(
    effects: Sequence[Effect], measurements: Sequence[Measurement], noise: Mapping[str, float] | None = None
) -> Separation:
    """Say what a set of tests can tell.

    Args:
        effects: whose parameters are to be found; non-linear ones are taken at their start.
        measurements: poses and channels of the tests; readings may be anything.
        noise: white noise of a measurement by name, in the unit of its readings; 0.5 where not given.
    """
    machine = measurements[0].machine
    parameters = planned(effects, machine)
    readings = read(measurements, smooth=False)
    return judge(parameters, columns_of(effects, readings), readings, noise or {})


def columns_of(effects: Sequence[Effect], readings: Readings) -> Floats:
    """One column a parameter, (m, parameters); zero in measurements that lack a channel."""
    parts = []
    for effect in effects:
        theta = {p.name: p.start for p in effect.nonlinear(readings.machine)}
        try:
            parts.append(readings.columns(effect, theta))
        except ModelError:
            parts.append(np.zeros((len(readings), len(effect.coefficients(readings.machine)))))
    return np.concatenate([np.zeros((len(readings), 0)), *parts], axis=1)


def judge(parameters: Sequence[Planned], columns: Floats, readings: Readings, noise: Mapping[str, float]) -> Separation:
    """Rank, what is never seen, what is confounded, smallest sizes."""
    white = _whitened(columns, readings, noise)
    typical = np.array([p.typical for p in parameters])
    size = np.linalg.norm(white, axis=0)
    seen = size * typical > UNSEEN
    never = tuple(p.name for p, s in zip(parameters, seen, strict=True) if not s)
    scaled = white[:, seen] / size[seen]
    kept = [p for p, s in zip(parameters, seen, strict=True) if s]
    if not kept:
        return Separation(
            tuple(parameters), 0, never, (), math.inf, dict.fromkeys([p.name for p in parameters], math.inf)
        )
    value, vector = np.linalg.eigh(scaled.T @ scaled)
    singular = np.sqrt(np.maximum(value, 0.0))
    good = singular > ALIKE * singular[-1]
    confounded = _sets(vector[:, ~good], kept)
    lost = {name for group in confounded for name in group}
    inverse = (vector[:, good] / value[good]) @ vector[:, good].T
    detectable = dict.fromkeys([p.name for p in parameters], math.inf)
    for i, p in enumerate(kept):
        if p.name not in lost:
            detectable[p.name] = float(SURE * math.sqrt(inverse[i, i]) / size[seen][i])
    condition = float(singular[-1] / singular[good][0])
    return Separation(tuple(parameters), int(good.sum()), never, confounded, condition, detectable)


def propose(
    effects: Sequence[Effect],
    measurements: Sequence[Measurement],
    extras: Sequence[Extra],
    noise: Mapping[str, float] | None = None,
) -> list[Proposal]:
    """Rank tests that might be added: by what they would separate, then by time, then by condition number."""
    before = separation(effects, measurements, noise)
    found = _found(before)
    out = []
    for test in extras:
        after = separation(effects, [*measurements, test.measurement], noise)
        gained = tuple(sorted(_found(after) - found))
        out.append(Proposal(test, after, gained))
    useful = [p for p in out if p.after.rank > before.rank or p.after.condition < 0.7 * before.condition]
    return sorted(useful, key=lambda p: (-p.after.rank, p.test.hours, p.after.condition))


def _found(s: Separation) -> set[str]:
    return {name for name, size in s.detectable.items() if math.isfinite(size)}


def _whitened(columns: Floats, readings: Readings, noise: Mapping[str, float]) -> Floats:
    """Columns over the noise, with what each run and each set-up cannot know taken out."""
    whole = np.concatenate([readings.setup, columns], axis=1)
    flat = np.stack([without_nuisance(readings, c) for c in whole.T], axis=1)
    for s in readings.series:
        flat[s.part] /= noise.get(readings.measurements[s.source].name, 0.5)
    count = readings.setup.shape[1]
    if not count:
        return flat
    q = np.linalg.qr(flat[:, :count])[0]
    return np.asarray(flat[:, count:] - q @ (q.T @ flat[:, count:]))


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
