"""One judgement of a model on measurements: the same residual, noise floor and held-out error in every command."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rtec.estimation import floor
from rtec.estimation.columns import Base, base_of
from rtec.estimation.floor import Floor, Unit
from rtec.estimation.gls import HeldOut, held_out
from rtec.estimation.noise import Whitener, found_on_stretches
from rtec.estimation.outliers import Clean
from rtec.estimation.plain import Plain, as_good, plain_fit
from rtec.estimation.readings import Readings
from rtec.model import FittedEffect, Model

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class MeasurementMet:
    """How well one measurement is met; root mean squares over all of its reading columns.

    Attributes:
        unit: of what follows.
        readings: that count.
        measured: less what the instrument cannot know.
        residual: what the model leaves.
        held_out: on held-out runs, the model's numbers refitted to the others.
        floor: the noise.
    """

    unit: Unit
    readings: int
    measured: float
    residual: float
    held_out: float
    floor: float


@dataclass(frozen=True)
class Judgement:
    """A model as it stands, on readings that count.

    Attributes:
        model: as given.
        given: the readings, with those that were left out.
        scales: one over the unit of each series, (series,); None for those of its own floors.
    """

    model: Model
    given: Clean
    scales: tuple[float, ...] | None = None

    @property
    def readings(self) -> Readings:
        """Those that count."""
        return self.given.readings

    @cached_property
    def base(self) -> Base:
        """The model's columns and prediction."""
        return base_of(self.model, self.readings)

    @cached_property
    def left(self) -> Floats:
        """Residual, less what the instruments cannot know, (m,)."""
        return floor.cleaned(self.readings, self.readings.values - self.base.predicted)

    @cached_property
    def floors(self) -> list[Floor]:
        """Noise of each series."""
        return floor.noise_floors(self.readings, self.left, self.flexible)

    @cached_property
    def flexible(self) -> Whitener:
        """Noise beside everything that goes smoothly with the channels."""
        return floor.flexible_noise(self.readings, self.base.columns)

    @property
    def unit(self) -> Unit:
        """Of all that follows."""
        return floor.unit_of(self.readings)

    @cached_property
    def scale(self) -> Floats:
        """One over the unit of each series, (series,)."""
        if self.unit != "noise":
            return np.ones(len(self.readings.series))
        if self.scales is not None:
            return np.array(self.scales)
        return 1.0 / np.maximum([f.value for f in self.floors], 1e-12)

    def pooled(self, left: Floats) -> float:
        """Root mean square of residuals, (m,)."""
        return floor.pooled(self.readings, floor.rms_by_series(self.readings, left), self.scale)

    @cached_property
    def residual(self) -> float:
        """Root mean square of the residual."""
        return self.pooled(self.left)

    @cached_property
    def noise_floor(self) -> float:
        """Root mean square of the noise."""
        return floor.pooled(self.readings, np.array([f.value for f in self.floors]), self.scale)

    @cached_property
    def drift(self) -> float:
        """Root mean square of the slow drift that no recorded channel explains; no part of the noise floor."""
        return floor.pooled(self.readings, np.array([f.drift for f in self.floors]), self.scale)

    @property
    def floor_from(self) -> str:
        """Where the noise floor comes from."""
        return " and ".join(sorted({f.source for f in self.floors}))

    @cached_property
    def _plain(self) -> tuple[Plain, Floats]:
        return plain_fit(self.readings, self.flexible, self.base.columns)

    @cached_property
    def noise(self) -> Whitener:
        """Noise beside the model's own columns."""
        return found_on_stretches(self.readings, lambda _, keep: self.base.columns[keep])

    @property
    def _weights(self) -> tuple[Whitener, Plain]:
        """Those of both kinds of least squares."""
        return self.noise, self._plain[0]

    @cached_property
    def refitted(self) -> float:
        """Residual with the model's own numbers refitted by ordinary least squares."""
        columns, values = self.base.columns, self._plain[1]
        return min(self.pooled(floor.cleaned(self.readings, self.readings.values - columns @ values)), self.residual)

    @cached_property
    def _held_out(self) -> HeldOut:
        """On held-out runs, with the numbers refitted to the others by the better of both kinds of least squares."""
        columns = self.base.columns
        weighted, plain = (held_out(w, columns, self.scale) for w in self._weights)
        return weighted if as_good(weighted, plain) else plain

    @property
    def held_out(self) -> float:
        """Root mean square error on held-out runs."""
        return self._held_out.rms

    @cached_property
    def untouched(self) -> float:
        """Root mean square error on held-out runs of the model with its own numbers; only the set-up is fitted."""
        return self.with_own(len(self.model.effects))

    def with_own(self, count: int) -> float:
        """Root mean square error on held-out runs if the first effects keep their numbers, and all others are refitted.

        Args:
            count: of effects that keep their numbers: none of them has been fitted to these readings.
        """
        kept, others = (replace(self.model, effects=part) for part in _cut(self.model.effects, count))
        alone = replace(self.readings, values=self.readings.values - base_of(kept, self.readings).predicted)
        columns = base_of(others, self.readings).columns
        weighted, plain = (held_out(replace(w, readings=alone), columns, self.scale) for w in self._weights)
        return (weighted if as_good(weighted, plain) else plain).rms

    @cached_property
    def by_measurement(self) -> tuple["MeasurementMet", ...]:
        """How well each measurement is met."""
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


def _cut(effects: tuple[FittedEffect, ...], count: int) -> tuple[tuple[FittedEffect, ...], tuple[FittedEffect, ...]]:
    """The first so many, and the others."""
    return effects[:count], effects[count:]
