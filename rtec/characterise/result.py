"""Result of a characterisation: the model, its errors, the search, and warnings."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

from rtec.arrays import Floats
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import WrongReading
from rtec.model import Model
from rtec.result import Result


@dataclass(frozen=True)
class Warn:
    """A warning.

    Attributes:
        code: short name, the same in `docs/fit.md`.
        text: the finding, with numbers.
        remedy: what to do about it.
    """

    code: str
    text: str
    remedy: str


@dataclass(frozen=True)
class MeasurementFit:
    """Errors of the model in one measurement; root mean squares, as in `compare`.

    Attributes:
        name, instrument: of the measurement.
        unit: unit of the readings, "um" or "urad"; "noise" (multiples of it) where it reads both.
        readings: number of used readings.
        measured: readings without the instrument's nuisance parameters, before the model is subtracted.
        inside: residual in sample.
        held_out: residual on held-out runs.
        floor: noise floor.
        blocks: division into blocks, in words.
    """

    name: str
    instrument: str
    unit: str
    readings: int
    measured: float
    inside: float
    held_out: float
    floor: float
    blocks: str


@dataclass(frozen=True)
class Coefficient:
    """One fitted number; `t` is the number over its standard error, None where that is not known."""

    effect: str
    component: str
    name: str
    value: float
    se: float | None
    t: float | None
    unit: str


@dataclass(frozen=True)
class Correlated:
    """Correlation of one temperature, difference or speed with a component error."""

    component: str
    feature: str
    effect: str
    r: float
    left: float
    kept: bool


@dataclass(frozen=True)
class SearchStep:
    """One step of the search: what was added, the number of terms with it, and the error in sample and held out,
    relative to that without terms.
    """

    added: str
    terms: int
    inside: float
    held_out: float


@dataclass(frozen=True)
class UndecidedTerm:
    """An alternative that is as good on the held-out blocks.

    Attributes:
        instead_of, candidate: labels of the term and of its alternative.
        component: component error of the term.
        channels: channels that drive the alternative.
        held_out, chosen_held_out: root mean squares on held-out blocks of both, in units of the rough noise.
        apart: root mean square difference of the two predictions at the readings, in the same units.
        alike: whether the same temperature or speed drives both.
    """

    instead_of: str
    candidate: str
    component: str
    channels: tuple[str, ...]
    held_out: float
    chosen_held_out: float
    apart: float
    alike: bool


@dataclass(frozen=True)
class Characterisation(Result):
    """Result of a characterisation.

    Attributes:
        model: the fitted model.
        measurements: errors in each measurement.
        coefficients: every number with its standard error.
        condition: condition number of the scaled design.
        inside_rms, held_out_rms: root mean squares of all residuals, in the unit of `unit`.
        unit: "um"; "urad" where there are angles only; "noise" (multiples of it) where there are both.
        steps: steps of the search; empty where there was no choice.
        undecided: alternatives that are as good as the choice.
        correlations: the largest ones of each component error.
        outliers: outliers that were removed.
        warnings: in words.
        notes: notes on each measurement from its file (missing readings, what was accepted), by its name.
        residuals: for figures: hours, (n,), and readings minus prediction, (readings, n), by measurement name.
        judged: the model on its readings, judged as by every command.
    """

    page_maker: ClassVar[str] = "rtec.report.fit:fit_page"

    model: Model
    measurements: tuple[MeasurementFit, ...]
    coefficients: tuple[Coefficient, ...]
    condition: float
    inside_rms: float
    held_out_rms: float
    unit: str
    judged: Judgement = field(repr=False, compare=False)
    steps: tuple[SearchStep, ...] = ()
    undecided: tuple[UndecidedTerm, ...] = ()
    correlations: tuple[Correlated, ...] = ()
    outliers: tuple[WrongReading, ...] = ()
    warnings: tuple[Warn, ...] = ()
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    residuals: dict[str, tuple[Floats, Floats]] = field(default_factory=dict, repr=False)

    def rows(self) -> list[Mapping[str, Any]]:
        """One row a coefficient."""
        return [asdict(c) for c in self.coefficients]

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        plain = {
            name: [asdict(item) for item in getattr(self, name)]
            for name in ("measurements", "coefficients", "steps", "undecided", "correlations", "outliers", "warnings")
        }
        return {
            "model": {
                "name": self.model.name,
                "sha256": self.model.hash,
                "effects": len(self.model.effects),
                "numbers": len(self.coefficients),
                "noise_um": self.model.noise_um,
            },
            "rms_inside": self.inside_rms,
            "rms_held_out": self.held_out_rms,
            "unit": self.unit,
            "judged": self.judged.facts(),
            "condition_number": self.condition,
            **plain,
            "notes": {name: list(said) for name, said in self.notes.items()},
        }
