"""Result of a comparison: for each reading column how wrong the model is, against the noise floor, and where."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from rtec.arrays import Floats
from rtec.diagnosis.compare.shape import ResidualShape
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.estimation.floor import Floor
from rtec.estimation.judge import Judgement
from rtec.estimation.readings import Readings
from rtec.result import Result


@dataclass(frozen=True)
class Bound:
    """A stretch of one channel.

    Attributes:
        channel: name of the channel; `run` is the run number.
        low, high: ends, both included; equal where the channel has one value there.
        unit: of both.
    """

    channel: str
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Region:
    """Where the model is worse than elsewhere.

    Attributes:
        bounds: one channel, or a pair of them.
        rms: root mean square of the residual there, µm or µrad.
        mean: mean of the residual there, with its sign.
        elsewhere: root mean square of the readings in none of the regions.
        n: readings there.
        p: probability that noise alone shows such a contrast anywhere in the comparison.
        words: in plain words.
        same: other regions, in words, with nearly the same readings: the data cannot distinguish them.
        apart: difference between readings in direction + and -, with its sign, where it is the same everywhere: then it
            is no place, and `elsewhere` is the residual without it; None otherwise.
    """

    bounds: tuple[Bound, ...]
    rms: float
    mean: float
    elsewhere: float
    n: int
    p: float
    words: str
    same: tuple[str, ...] = ()
    apart: float | None = None

    def facts(self) -> dict[str, Any]:
        """As plain data; keys as in the documented JSON."""
        first, *others = self.bounds
        return {
            "channel": first.channel,
            "low": first.low,
            "high": first.high,
            "unit": first.unit,
            "and": [vars(b) for b in others],
            "rms_um": self.rms,
            "mean_um": self.mean,
            "rms_elsewhere_um": self.elsewhere,
            "n": self.n,
            "p": self.p,
            "words": self.words,
            "same_readings_as": list(self.same),
            "directions_apart_um": self.apart,
        }


@dataclass(frozen=True)
class EffectShare:
    """Contribution of one effect of the model to a reading column, nuisances projected out.

    Attributes:
        label: effect, component, and what it depends on.
        component: component error that it feeds; empty for an unknown start.
        rms, most: root mean square and largest size, µm or µrad.
    """

    label: str
    component: str
    rms: float
    most: float


@dataclass(frozen=True)
class Outside:
    """Readings outside the range in which the model was fitted.

    Attributes:
        channel: name; `unit` its unit.
        low, high: of the model.
        lowest, highest: of the readings.
        n: number of readings outside.
    """

    channel: str
    unit: str
    low: float
    high: float
    lowest: float
    highest: float
    n: int


@dataclass(frozen=True)
class Size:
    """Root mean square and largest size, µm or µrad."""

    rms: float
    most: float


@dataclass(frozen=True)
class Compared:
    """One reading column of one measurement; nuisances of runs and set-up are projected out of all sizes.

    Attributes:
        name, column, instrument: identify the readings.
        unit: "um" or "urad".
        n, runs: numbers of readings and of their runs.
        measured, predicted, left: sizes; `left` is the residual, measured minus predicted.
        noise: its floor, the source of that, and the slow drift beside it.
        explained: share of the explainable mean square that the model explains; None where the measured error is at
            the floor, at least -1.
        sees: component errors that the instrument sees here.
        parts: contribution of each effect, largest first; without those that contribute nothing.
        outside: where the readings leave the model's range.
        worst: regions, best evidence first.
        shape: the simplest shape of the residual; None at the floor, or where it has none.
        drift_goes_with: a temperature or place that explains most of the slow drift, in words; empty where none does.
    """

    name: str
    column: str
    instrument: str
    unit: Literal["um", "urad"]
    n: int
    runs: int
    measured: Size
    predicted: Size
    left: Size
    noise: Floor
    explained: float | None
    sees: tuple[str, ...]
    parts: tuple[EffectShare, ...]
    outside: tuple[Outside, ...]
    worst: tuple[Region, ...]
    shape: ResidualShape | None = None
    drift_goes_with: str = ""

    @property
    def floor(self) -> float:
        """Root mean square of noise alone, in `unit`."""
        return self.noise.value

    def facts(self) -> dict[str, Any]:
        """As plain data; keys as in the documented JSON. `_um` keys are µrad where `unit` says so."""
        return {
            "name": self.name,
            "column": self.column,
            "instrument": self.instrument,
            "unit": self.unit,
            "n": self.n,
            "runs": self.runs,
            "rms_measured_um": self.measured.rms,
            "max_measured_um": self.measured.most,
            "rms_predicted_um": self.predicted.rms,
            "max_predicted_um": self.predicted.most,
            "rms_residual_um": self.left.rms,
            "max_residual_um": self.left.most,
            "noise_floor_um": self.noise.value,
            "noise_floor_from": self.noise.source,
            "noise_floor_repeats_um": self.noise.repeats,
            "noise_floor_fitted_um": self.noise.fitted,
            "slow_drift_um": self.noise.drift,
            "slow_drift_goes_with": self.drift_goes_with or None,
            "explained": self.explained,
            "components": list(self.sees),
            "contributions": [
                {"effect": p.label, "component": p.component, "rms_um": p.rms, "max_um": p.most} for p in self.parts
            ],
            "outside_valid_range": [vars(o) for o in self.outside],
            "worst": [r.facts() for r in self.worst],
            "shape": vars(self.shape) if self.shape else None,
        }


@dataclass(frozen=True)
class Traces:
    """Data of the figures, reading by reading, nuisances projected out.

    Attributes:
        readings: that were compared.
        measured, predicted: µm or µrad, (m,).
        parts: contribution of each effect, by label, (m,); they sum to `predicted`.
    """

    readings: Readings
    measured: Floats
    predicted: Floats
    parts: Mapping[str, Floats]

    @property
    def left(self) -> Floats:
        """Measured minus predicted, (m,)."""
        return self.measured - self.predicted


@dataclass(frozen=True)
class Comparison(Result):
    """A model against measurements.

    Attributes:
        model: its name.
        items: one for each reading column of each measurement.
        notes: treatment of the data, in words.
        seed: of the random draws.
        judged: all reading columns together.
        traces: for the figures.
        doubts: about the record itself.
    """

    page_maker: ClassVar[str] = "rtec.report.compare:compare_page"

    model: str
    items: tuple[Compared, ...]
    notes: tuple[str, ...]
    seed: int
    judged: Judgement = field(repr=False, compare=False)
    traces: Traces = field(repr=False, compare=False)
    doubts: tuple[Doubt, ...] = ()

    def rows(self) -> list[Mapping[str, Any]]:
        """One row for each reading column of each measurement."""
        return [c.facts() for c in self.items]

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return {
            "model": self.model,
            "measurements": [c.facts() for c in self.items],
            "together": self.judged.facts(),
            "doubts": [vars(d) for d in self.doubts],
            "notes": list(self.notes),
            "seed": self.seed,
        }
