"""Fits non-linear parameters (time constant, pitch, exponent) by variable projection.

First a grid, because the error has many minima along a pitch: at each grid value, the coefficients are those that fit
best. Then Gauss-Newton with the coefficients projected out (Kaufman's form of Golub and Pereyra's method): the design
gets one more column for each parameter, the slope of its effect, and one pass through the readings gives a step of all
parameters at once.
"""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.effects import Effect, Parameter
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.source import LONGEST_LAG, Source
from rtec.estimation.gram.stream import Progress, Slope, Term, gather
from rtec.estimation.visible import within_record
from rtec.machine import Machine
from rtec.model.fit import SearchScale

GRID = 9
STRAIGHT_GRID = 17
"""Grid points of a parameter: on a logarithmic scale (time constants), on a linear one (pitch)."""
SMALL_GRID = 5
"""The same where an effect has two parameters."""
SWEEPS = 2
STEPS = 8
CLOSE = 0.02
"""A step below this share of the standard error ends the search."""
EDGE = 1e-4
"""A parameter within this share of its bounds from one of them is on it, and has no standard error."""


@dataclass(frozen=True)
class Polished:
    """Result of the search.

    Attributes:
        terms: with their final parameters.
        slopes: one for each parameter that is not on a bound.
        normal: normal equations of terms and slopes at these parameters.
        on_bound: parameters on a bound, as (term, name).
    """

    terms: tuple[Term, ...]
    slopes: tuple[Slope, ...]
    normal: Normal
    on_bound: tuple[tuple[int, str], ...]

    @property
    def linear(self) -> Normal:
        """The normal equations without the slopes."""
        return self.normal.pick(np.arange(self.normal.width - len(self.slopes)))

    @cached_property
    def left(self) -> float:
        """Sum of squared residuals at these parameters."""
        linear = self.linear
        return linear.squares(linear.values())


def starting_terms(effects: Sequence[Effect], sources: Sequence[Source]) -> list[Term]:
    """Terms with parameters from a grid: each in turn where the whole fits best, in two rounds."""
    machine = sources[0].measurement.machine
    choices = [[Term(e, theta) for theta in _grid(e.nonlinear(machine))] for e in effects]
    if all(len(c) == 1 for c in choices):
        return [c[0] for c in choices]
    everything = [t for c in choices for t in c]
    normal = gather(sources, everything, by_fold=True)
    first = np.concatenate([[0], np.cumsum([len(c) for c in choices])])
    columns = [np.flatnonzero(normal.owner == i) for i in range(len(everything))]
    chosen = [len(c) // 2 for c in choices]
    for _ in range(SWEEPS):
        for k in (k for k, c in enumerate(choices) if len(c) > 1):
            rest = [columns[first[j] + chosen[j]] for j in range(len(choices)) if j != k]
            left = [_left(normal, [*rest, columns[first[k] + i]]) for i in range(len(choices[k]))]
            chosen[k] = int(np.argmin(left))
    return [c[i] for c, i in zip(choices, chosen, strict=True)]


def polish(
    sources: Sequence[Source],
    terms: Sequence[Term],
    progress: Progress | None = None,
    only: Collection[int] | None = None,
) -> Polished:
    """Fit the parameters of all terms together, starting at their current ones.

    Args:
        sources: the measurements.
        terms: terms with their parameters.
        progress: progress callback.
        only: numbers of the terms of which the parameters are fitted; by default of all.
    """
    measurements = [s.measurement for s in sources]
    fitted = range(len(terms)) if only is None else sorted(only)
    free = [(i, p) for i in fitted for p in within_record(terms[i].effect, measurements, LONGEST_LAG) if p.low < p.high]
    if not free:
        return Polished(tuple(terms), (), gather(sources, terms, progress), ())
    place = np.clip([_place(p, terms[i].theta[p.name]) for i, p in free], 0.0, 1.0)
    best = _at(sources, terms, free, place, gather(sources, terms).values(), progress)
    for _ in range(STEPS):
        step, values, done = _step(best, free, place)
        if done:
            break
        for part in (1.0, 0.25, 0.0625):
            there = np.clip(place + part * step, 0.0, 1.0)
            trial = _at(sources, terms, free, there, values, progress)
            if trial.left <= best.left:
                break
        else:
            break
        best, place = trial, there
    return best


def _at(
    sources: Sequence[Source],
    terms: Sequence[Term],
    free: list[tuple[int, Parameter]],
    place: Floats,
    values: Floats,
    progress: Progress | None,
) -> Polished:
    """Normal equations with the slopes at a place."""
    out = list(terms)
    for (i, p), at in zip(free, place, strict=True):
        out[i] = replace(out[i], theta={**out[i].theta, p.name: SearchScale.of(p).value(float(at))})
    slopes = _slopes(out, free, place, values, sources[0].measurement.machine)
    stuck = tuple((i, p.name) for (i, p), at in zip(free, place, strict=True) if not _inside(at))
    return Polished(tuple(out), slopes, gather(sources, (*out, *slopes), progress), stuck)


def _inside(place: float) -> bool:
    return bool(EDGE < place < 1 - EDGE)


def _step(found: Polished, free: list[tuple[int, Parameter]], place: Floats) -> tuple[Floats, Floats, bool]:
    """Step of all parameters as places in 0 … 1, the coefficients there, and whether the step is negligible."""
    normal, count = found.normal, len(found.slopes)
    both, width = normal.values(), normal.width - count
    moved = both[width : width + count]
    noise = np.sqrt(max(normal.squares(both), 0.0) / max(normal.freedom, 1.0))
    spread = noise * np.sqrt(np.maximum(np.diag(normal.inverse()), 0.0))[width : width + count]
    step = np.zeros(len(free))
    for k, j in enumerate(np.flatnonzero([_inside(at) for at in place])):
        i, p = free[j]
        to = float(np.clip(found.terms[i].theta[p.name] + moved[k], p.low, p.high))
        # At most a third of the whole span at once: the slope is valid only near this place.
        step[j] = np.clip(_place(p, to) - place[j], -1 / 3, 1 / 3)
    done = bool(np.all(np.abs(moved) <= CLOSE * spread))
    return step, np.delete(both, np.arange(width, width + count)), done


def _slopes(
    terms: Sequence[Term], free: list[tuple[int, Parameter]], place: Floats, values: Floats, machine: Machine
) -> tuple[Slope, ...]:
    first = np.concatenate([[0], np.cumsum([len(t.names(machine)) for t in terms])])
    out = []
    for (i, p), at in zip(free, place, strict=True):
        if _inside(at):
            here, span = terms[i].theta[p.name], p.high - p.low
            step = min(1e-5 * span, 1e-3 * abs(here)) if here else 1e-5 * span
            out.append(Slope(terms[i], p.name, step, tuple(values[first[i] : first[i + 1]].tolist())))
    return tuple(out)


def _place(parameter: Parameter, value: float) -> float:
    return SearchScale.of(parameter).place(value)


def _grid(parameters: Sequence[Parameter]) -> list[dict[str, float]]:
    along = []
    for p in parameters:
        scale = SearchScale.of(p)
        count = SMALL_GRID if len(parameters) > 1 else GRID if scale.log else STRAIGHT_GRID
        places = {*np.linspace(0.0, 1.0, count + 2)[1:-1].tolist(), scale.place(p.start)}
        along.append([(p.name, scale.value(at)) for at in sorted(places)])
    return [dict(pairs) for pairs in itertools.product(*along)]


def _left(normal: Normal, columns: list[Ints]) -> float:
    part = normal.pick(np.concatenate(columns))
    return part.squares(part.values())
