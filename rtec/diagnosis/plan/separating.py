"""Which experiment separates rival effects: the residual of one when the other is fitted to it.

Two effects that explain the same readings equally well are separated by a test for which their predictions differ. If
one is true, the other has a misfit `d` after its best fit to both the old readings and the new test; half of `dᵀ Σ⁻¹ d`
is the expected logarithm of the odds that the test gives. The smaller of both directions counts. The current model, and
the unknowns of the instruments, are fitted along.

The module also names, for a finding and its rivals, the best separating test that the machine can take.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.diagnosis import words
from rtec.diagnosis.plan.ideas import extra_tests
from rtec.diagnosis.plan.parameters import names_of
from rtec.diagnosis.plan.plan import USUAL_NOISE, Extra, clean, effect_columns
from rtec.diagnosis.result import Alike
from rtec.effects import Effect
from rtec.estimation.columns import slope
from rtec.estimation.gls import solve
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings, read
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.wording import duration

CLEAR = math.log(20.0)
"""From these expected log odds on, a test separates two effects."""
A_DAY = 24.0
"""A test of more hours is not proposed."""
INDEPENDENT = 100.0
"""A test has at most the information of this many readings: those close together share the drift of instrument and
machine, so that many readings do not resolve what is far below the noise of one."""
VARIES_K = 1.0
"""A temperature that varies by less, K, is still."""
TINY = 1e-11
"""Directions below this share of the largest are not seen."""


@dataclass(frozen=True)
class SimulatedRival:
    """A rival effect, as columns.

    Attributes:
        name: in words.
        columns: places of its columns: coefficients first, then slopes by its non-linear parameters.
        values: sizes of the coefficients.
    """

    name: str
    columns: Ints
    values: Floats


@dataclass(frozen=True)
class Pair:
    """Two rivals, and the expected logarithm of the odds for the right one.

    Attributes:
        one, other: names.
        gain: with the test.
        before: of the existing measurements.
    """

    one: str
    other: str
    gain: float
    before: float

    @property
    def clear(self) -> bool:
        """Whether the right one would be at least twenty times as likely."""
        return self.gain >= CLEAR


@dataclass(frozen=True)
class Separator:
    """What a test would separate.

    Attributes:
        test: the test.
        pairs: all pairs of the rivals.
    """

    test: Extra
    pairs: tuple[Pair, ...]

    @property
    def clear(self) -> int:
        """Number of pairs that it separates."""
        return sum(p.clear for p in self.pairs)

    @property
    def least(self) -> float:
        """Expected logarithm of the odds of the pair that it separates least."""
        return min(p.gain for p in self.pairs)


def separating(
    model: Model,
    rivals: Sequence[FittedEffect],
    measurements: Sequence[Measurement],
    extras: Sequence[Extra] | None = None,
    *,
    noise: float,
    whitener: Whitener | None = None,
) -> list[Separator]:
    """Rank tests by how well they would separate rival effects: most pairs first, then the quickest.

    Args:
        model: the current model, without the rivals; its numbers are fitted along.
        rivals: two or more effects, each with its size (`fitted_to` estimates it from readings).
        measurements: those that cannot separate the rivals; may be none.
        extras: additional tests; by default those that the machine can take.
        noise: white noise of a reading in the additional tests, µm or µrad.
        whitener: noise of the measurements as the diagnosis estimated it; by default white noise of that size.
    """
    machine = model.machine
    tests = extra_tests(machine, measurements) if extras is None else extras
    if whitener is not None:
        here = _information(_columns(model, rivals, whitener.readings), whitener)
    else:
        here = np.zeros(2 * (_width((*model.effects, *rivals), machine),))
        here += sum(_of_test(model, rivals, m, noise) for m in measurements)
    informed = [(t, _of_test(model, rivals, _still(t.measurement, model.reference_degc), noise)) for t in tests]
    base, split = _as_columns(model, rivals)
    return ranked(here, informed, base, split)


def separated(
    model: Model, rivals: Sequence[FittedEffect], measurements: Sequence[Measurement], noise: float = USUAL_NOISE
) -> tuple[Pair, ...]:
    """How well tests by themselves separate rival effects, all pairs; arguments as `separating`."""
    here = sum(_of_test(model, rivals, m, noise) for m in measurements)
    base, split = _as_columns(model, rivals)
    gains = _gains(np.asarray(here), base, split)
    return _pairs(split, gains, gains)


def _as_columns(model: Model, rivals: Sequence[FittedEffect]) -> tuple[Ints, list[SimulatedRival]]:
    """Places of the model's columns, and the rivals with theirs."""
    machine = model.machine
    edges = np.cumsum([_width(model.effects, machine), *(_width([f], machine) for f in rivals)])
    split = [
        SimulatedRival(name, np.arange(first, last), _values(f, machine))
        for name, f, first, last in zip(names_of(rivals), rivals, edges[:-1], edges[1:], strict=True)
    ]
    return np.arange(edges[0]), split


def ranked(
    here: Floats, tests: Sequence[tuple[Extra, Floats]], base: Ints, rivals: Sequence[SimulatedRival]
) -> list[Separator]:
    """Rank tests by how well they would separate rivals, from the information of each, (p, p).

    Args:
        here: information of the existing measurements.
        tests: additional ones with their information.
        base: places of the columns that are always fitted along.
        rivals: two or more.
    """
    before = _gains(here, base, rivals)
    out = [Separator(test, _pairs(rivals, before, _gains(here + more, base, rivals))) for test, more in tests]
    return sorted(out, key=lambda s: (-s.clear, s.test.hours if s.clear else 0.0, -s.least))


def fitted_to(whitener: Whitener, base: Floats, effect: Effect, theta: Mapping[str, float]) -> FittedEffect:
    """An effect with its size, from a fit to the readings together with the current model.

    Args:
        whitener: readings and their noise.
        base: columns of the current model, (m, p).
        effect: its size is estimated.
        theta: its non-linear parameters.
    """
    columns = whitener.readings.columns(effect, theta)
    found = solve(whitener(np.concatenate([base, columns], axis=1)), whitener(whitener.readings.values))
    names = [p.name for p in effect.coefficients(whitener.readings.machine)]
    return FittedEffect(effect, dict(zip(names, map(float, found[base.shape[1] :]), strict=True)), dict(theta))


def _gains(whole: Floats, base: Ints, rivals: Sequence[SimulatedRival]) -> Floats:
    """Half the squared misfit of rival j fitted to rival i, (rivals, rivals)."""
    out = np.zeros((len(rivals), len(rivals)))
    for i, one in enumerate(rivals):
        own = one.columns[: len(one.values)]
        for j, other in enumerate(rivals):
            if i != j:
                rest = np.concatenate([base, other.columns]).astype(np.int64)
                out[i, j] = 0.5 * _misfit(whole, own, one.values, rest)
    return out


def _pairs(rivals: Sequence[SimulatedRival], before: Floats, after: Floats) -> tuple[Pair, ...]:
    """All pairs of rivals, with the smaller gain of both directions."""
    before, after = np.minimum(before, before.T), np.minimum(after, after.T)
    return tuple(
        Pair(rivals[i].name, rivals[j].name, float(after[i, j]), float(before[i, j]))
        for i, j in itertools.combinations(range(len(rivals)), 2)
    )


def _misfit(whole: Floats, own: Ints, values: Floats, rest: Ints) -> float:
    """Sum of squares of `columns[own] · values` that the columns `rest` cannot explain."""
    size = np.sqrt(np.maximum(np.diag(whole), 1e-300))
    scaled = whole / np.outer(size, size)
    weights = values * size[own]
    inner = scaled[np.ix_(rest, rest)]
    cross = scaled[np.ix_(rest, own)] @ weights
    total = float(weights @ scaled[np.ix_(own, own)] @ weights)
    taken = float(cross @ np.linalg.pinv(inner, rcond=TINY, hermitian=True) @ cross) if len(rest) else 0.0
    # Smaller values are rounding of this large sum.
    return max(total - taken, 0.0) if total - taken > 1e-9 * total else 0.0


def _width(effects: Sequence[FittedEffect], machine: Machine) -> int:
    return sum(len(f.effect.coefficients(machine)) + len(f.effect.nonlinear(machine)) for f in effects)


def _values(fitted: FittedEffect, machine: Machine) -> Floats:
    return np.array([fitted.values[p.name] for p in fitted.effect.coefficients(machine)])


def _columns(model: Model, rivals: Sequence[FittedEffect], readings: Readings) -> Floats:
    """Columns of the model and of each rival, slopes after the coefficients, (m, p)."""
    parts = [np.zeros((len(readings), 0))]
    for fitted in (*model.effects, *rivals):
        theta = {p.name: fitted.theta[p.name] for p in fitted.effect.nonlinear(readings.machine)}
        parts.append(effect_columns(fitted.effect, readings, theta))
        parts += [_slope(fitted, readings, name)[:, None] for name in theta]
    return np.concatenate(parts, axis=1)


def _slope(fitted: FittedEffect, readings: Readings, name: str) -> Floats:
    if not effect_columns(fitted.effect, readings, dict(fitted.theta)).any():
        return np.zeros(len(readings))
    return slope(fitted, readings, name, _values(fitted, readings.machine))


def _still(test: Measurement, degc: float) -> Measurement:
    """A test with each temperature that hardly varies in it at the reference: it tells nothing of two sensors there."""
    names = [n for n in test.machine.sensor_names if n in test.channels and np.ptp(test.channels[n]) < VARIES_K]
    return replace(test, channels={**test.channels, **{n: np.full(len(test), degc) for n in names}})


def _of_test(model: Model, rivals: Sequence[FittedEffect], measurement: Measurement, noise: float) -> Floats:
    """Information of one test."""
    # Temperatures smoothed: a machine does not follow a sensor's noise, which would otherwise separate two sensors.
    readings = read([measurement], model.reference_degc)
    columns = clean(_columns(model, rivals, readings), readings) / noise
    return np.asarray(columns.T @ columns * min(1.0, INDEPENDENT / len(columns)))


def _information(columns: Floats, whitener: Whitener) -> Floats:
    """Information of measurements under their own noise, with the unknowns of the set-up projected out."""
    setup = whitener.readings.setup
    count = setup.shape[1]
    white = whitener(np.concatenate([setup, columns], axis=1))
    left = white[:, count:]
    if count:
        q = np.linalg.qr(white[:, :count])[0]
        left = left - q @ (q.T @ left)
    return np.asarray(left.T @ left)


def with_gains(
    alikes: Sequence[tuple[Alike, FittedEffect]],
    winner: FittedEffect,
    model: Model,
    whitener: Whitener,
    extras: Sequence[Extra] | None = None,
) -> tuple[Alike, ...]:
    """Name for each confounded effect the quickest separating test, with its expected additional log Bayes factor.

    Where none separates it (20 to 1) within a day, none is named. Each gets the numbers that it was fitted with.

    Args:
        alikes: confounded effects, fitted (`separating.fitted_to`).
        winner: the effect that they are confounded with.
        model: the current model.
        whitener: readings and noise of the diagnosis.
        extras: possible tests; by default those that the machine can take.
    """
    if not alikes:
        return ()
    readings = whitener.readings
    noise = float(np.median([n.sigma for n in whitener.noises]))
    found = separating(
        model, [winner, *(f for _, f in alikes)], readings.measurements, extras, noise=noise, whitener=whitener
    )
    out = []
    for place, (alike, fitted) in enumerate(alikes):
        # Pairs are in the order of the combinations: those of the winner come first.
        # The information of the existing readings is in both: only what a test adds can separate them.
        best = min(found, key=lambda s: _worth(s.test, _added(s.pairs[place])))
        gain = _added(best.pairs[place])
        test, numbers = _words(alike.separating_test, best.test, gain), None if alike.fitted is None else fitted
        out.append(replace(alike, gain=gain, separating_test=test, fitted=numbers))
    return tuple(out)


def _added(pair: Pair) -> float:
    return pair.gain - pair.before


def _worth(test: Extra, gain: float) -> tuple[bool, float, float]:
    return (gain < CLEAR, test.hours if gain >= CLEAR else 0.0, -gain)


def _words(known: str, test: Extra, gain: float) -> str:
    if gain >= CLEAR and test.hours <= A_DAY:
        odds = "more than 1000 to 1" if gain > math.log(1000.0) else f"about {math.exp(gain):.0f} to 1"
        text = f"{'here: ' if known else ''}{test.name} ({duration(3600.0 * test.hours)}), expected odds {odds}"
    else:
        text = words.NONE_SETTLES + (" within a day" if gain >= CLEAR else "")
    return f"{known}; {text}" if known else text
