"""One judgement of a model on measurements: the same residual, noise floor and held-out error in every command."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rtec.arrays import Floats
from rtec.effects import Effect
from rtec.estimation import floor
from rtec.estimation.columns import Base, base_of
from rtec.estimation.floor import Floor, Unit
from rtec.estimation.gls import HeldOut, held_out, solve
from rtec.estimation.joint import ChangedNumber
from rtec.estimation.noise import Whitener, noise_on_stretches
from rtec.estimation.outliers import Clean
from rtec.estimation.plain import Plain, as_good, plain_fit
from rtec.estimation.readings import Readings
from rtec.model import Model

CANCELS = 2.0
"""A change of one number that is this many times the residual is taken back by another number."""
QUIETEST = 1e-3
"""Least noise, µm or µrad, by which residuals are counted: exact readings have none."""


@dataclass(frozen=True)
class MeasurementMet:
    """How well the model meets one measurement; root mean squares over all of its reading columns.

    Attributes:
        unit: of the following values.
        readings: number of readings that count.
        measured: readings less what the instrument cannot know.
        residual: of the model.
        held_out: error on held-out runs, with the model's numbers refitted to the others.
        floor: noise floor.
    """

    unit: Unit
    readings: int
    measured: float
    residual: float
    held_out: float
    floor: float


@dataclass(frozen=True)
class Judgement:
    """A model with its current numbers, on readings that count.

    Attributes:
        model: as given.
        given: the readings, and the rejected ones.
        scales: one over the unit of each series, (series,); None for those of its own floors.
    """

    model: Model
    given: Clean
    scales: tuple[float, ...] | None = None

    @property
    def readings(self) -> Readings:
        """The readings that count."""
        return self.given.readings

    @cached_property
    def base(self) -> Base:
        """The model's columns and prediction."""
        return base_of(self.model, self.readings, self.given.delays)

    @cached_property
    def left(self) -> Floats:
        """Residual, less what the instruments cannot know, (m,)."""
        return floor.cleaned(self.readings, self.readings.values - self.base.predicted)

    @cached_property
    def floors(self) -> list[Floor]:
        """Noise floor of each series."""
        return floor.noise_floors(self.readings, self.left, self.flexible)

    @cached_property
    def flexible(self) -> Whitener:
        """Noise fitted together with every smooth function of the channels."""
        return floor.flexible_noise(self.readings, self.base.columns)

    @property
    def unit(self) -> Unit:
        """Unit of all root mean squares below."""
        return floor.unit_of(self.readings)

    @cached_property
    def scale(self) -> Floats:
        """One over the unit of each series, (series,)."""
        if self.unit != "noise":
            return np.ones(len(self.readings.series))
        if self.scales is not None:
            return np.array(self.scales)
        return 1.0 / np.maximum([f.value for f in self.floors], QUIETEST)

    def pooled(self, left: Floats) -> float:
        """Root mean square of residuals, (m,)."""
        return floor.pooled(self.readings, floor.rms_by_series(self.readings, left), self.scale)

    def columns_of(self, effect: Effect, theta: Mapping[str, float] | None = None) -> Floats:
        """Columns of an effect, less what the instruments cannot know, (m, k)."""
        return floor.cleaned(self.readings, self.readings.columns(effect, theta or {}))

    def left_by(self, columns: Floats) -> float:
        """Root mean square of the residual with columns, (m, k), fitted to it."""
        return self.pooled(self.left - columns @ solve(columns, self.left))

    def left_beside(self, columns: Floats) -> float:
        """Root mean square of the residual with columns, (m, k), fitted beside the model's own numbers."""
        values, both = self._values, np.hstack([self._own, columns])
        return self.pooled(values - both @ solve(both, values))

    @cached_property
    def _own(self) -> Floats:
        return floor.cleaned(self.readings, self.base.columns)

    @cached_property
    def _values(self) -> Floats:
        return floor.cleaned(self.readings, self.readings.values)

    @cached_property
    def residual(self) -> float:
        """Root mean square of the residual, in `unit`."""
        return self.pooled(self.left)

    @cached_property
    def noise_floor(self) -> float:
        """Root mean square of the noise, in `unit`."""
        return floor.pooled(self.readings, np.array([f.value for f in self.floors]), self.scale)

    @cached_property
    def drift(self) -> float:
        """Root mean square of the slow drift that no recorded channel explains; no part of the noise floor."""
        return floor.pooled(self.readings, np.array([f.drift for f in self.floors]), self.scale)

    @property
    def floor_from(self) -> str:
        """Source of the noise floor."""
        return " and ".join(sorted({f.source for f in self.floors}))

    @cached_property
    def _plain(self) -> tuple[Plain, Floats]:
        return plain_fit(self.readings, self.flexible, self.base.columns)

    @cached_property
    def noise(self) -> Whitener:
        """Noise fitted together with the model's own columns."""
        return noise_on_stretches(self.readings, lambda _, keep: self.base.columns[keep])

    @property
    def _weights(self) -> tuple[Whitener, Plain]:
        """Weights of generalised and of ordinary least squares."""
        return self.noise, self._plain[0]

    @cached_property
    def refitted(self) -> float:
        """Residual with the model's own numbers refitted by ordinary least squares."""
        columns, values = self.base.columns, self._plain[1]
        return min(self.pooled(floor.cleaned(self.readings, self.readings.values - columns @ values)), self.residual)

    @property
    def most_moved(self) -> ChangedNumber | None:
        """The number whose refit by ordinary least squares changes the prediction most; None where there is none.

        Nor where it changes the prediction by more than is to be explained: then another number takes that back. A
        delay that has changed comes first.
        """
        if self.given.delays:
            i, delay_s = next(iter(self.given.delays.items()))
            f = self.model.effects[i]
            return ChangedNumber(f.label, "tau", "s", f.theta["tau"], delay_s, math.nan)
        out, most, at, names = None, 0.0, 0, self.base.names
        for f in self.model.effects:
            units = {p.name: p.unit for p in f.effect.coefficients(self.readings.machine)}
            for name in (*f.values, *f.theta):
                if at == len(names) or names[at] != f"{f.label} {name}":
                    continue  # the readings do not show it
                if name in units:
                    was, now = f.values[name], float(self._plain[1][at])
                    change = self.pooled(floor.cleaned(self.readings, self.base.columns[:, at] * (now - was)))
                    if change > most:
                        out, most = ChangedNumber(f.label, name, units[name], was, now, math.nan), change
                at += 1
        return out if most < CANCELS * self.residual else None

    @cached_property
    def _held_out(self) -> HeldOut:
        """Error on held-out runs, with the numbers refitted to the others by the better kind of least squares."""
        columns = self.base.columns
        weighted, plain = (held_out(w, columns, self.scale) for w in self._weights)
        return weighted if as_good(weighted, plain) else plain

    @property
    def held_out(self) -> float:
        """Root mean square error on held-out runs, in `unit`."""
        return self._held_out.rms

    def with_own(self, kept: Collection[int]) -> float:
        """Root mean square error on held-out runs if some effects keep their numbers and all others are refitted.

        Args:
            kept: effects, by number, whose numbers these readings do not determine, or hardly.
        """
        if not kept:
            return self.held_out
        alone, columns = self._refitted_to(kept)
        weighted, plain = (held_out(replace(w, readings=alone), columns, self.scale) for w in self._weights)
        return (weighted if as_good(weighted, plain) else plain).rms

    def beyond_drift(self, by: Whitener, kept: Collection[int] = ()) -> float:
        """Error on held-out runs beyond slow drift, root mean square in multiples of the noise.

        Args:
            by: the noise, of these readings.
            kept: as of `with_own`.
        """
        alone, columns = self._refitted_to(kept)
        white = held_out(replace(by, readings=alone), columns).white
        return float(np.sqrt(white.sum() / max(len(alone), 1)))

    def _refitted_to(self, kept: Collection[int]) -> tuple[Readings, Floats]:
        """What some effects leave of the readings, and the columns of all others, (m, p)."""
        effects, delays = self.model.effects, self.given.delays
        mine, others = ([i for i in range(len(effects)) if (i in kept) is k] for k in (True, False))
        known, rest = (replace(self.model, effects=tuple(effects[i] for i in part)) for part in (mine, others))
        alone = replace(self.readings, values=self.readings.values - base_of(known, self.readings).predicted)
        return alone, base_of(rest, alone, {k: delays[i] for k, i in enumerate(others) if i in delays}).columns

    @cached_property
    def by_measurement(self) -> tuple["MeasurementMet", ...]:
        """How well the model meets each measurement."""
        measured = floor.flattened(self.readings, self.readings.values)
        sizes = (
            floor.rms_by_series(self.readings, measured),
            floor.rms_by_series(self.readings, self.left),
            np.sqrt(self._held_out.series) / self.scale,
            np.array([f.value for f in self.floors]),
        )
        return tuple(self._of(i, sizes) for i in range(len(self.readings.measurements)))

    def _of(self, source: int, sizes: Sequence[Floats]) -> "MeasurementMet":
        mine = np.array([s.source == source for s in self.readings.series])
        units = {s.unit for s in self.readings.series if s.source == source}
        count = np.array([len(s) for s in self.readings.series])[mine]
        scale = np.ones(len(count)) if len(units) == 1 else self.scale[mine]
        if not len(count):
            return MeasurementMet("um", 0, 0.0, 0.0, 0.0, 0.0)
        unit: Unit = "noise" if len(units) > 1 else "urad" if units == {"urad"} else "um"
        pooled = [float(np.sqrt(np.average((size[mine] * scale) ** 2, weights=count))) for size in sizes]
        return MeasurementMet(unit, int(count.sum()), *pooled)

    def facts(self) -> dict[str, Any]:
        """As plain data; keys as in the documented JSON."""
        return {
            "unit": self.unit,
            "rms_residual": self.residual,
            "noise_floor": self.noise_floor,
            "noise_floor_from": self.floor_from,
            "rms_held_out": self.held_out,
            "readings": len(self.readings),
            "wrong_readings": [vars(w) for w in self.given.wrong],
        }
