"""What a characterisation gives: the model, how good it is, how it was chosen, and what to beware of."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import WrongReading
from rtec.model import Model
from rtec.result import Result

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Warn:
    """Something to beware of.

    Attributes:
        code: short name, the same in `docs/fit.md`.
        text: what was found, with numbers.
        remedy: what to do about it.
    """

    code: str
    text: str
    remedy: str


@dataclass(frozen=True)
class MeasurementFit:
    """How well one measurement is met; root mean squares, as `compare` has them.

    Attributes:
        name, instrument: of it.
        unit: "um" or "urad" of its readings; "noise" (multiples of it) where it reads both.
        readings: how many count.
        measured: readings less what the instrument cannot know, before any machine error is taken out.
        inside: what the model leaves.
        held_out: the same on held-out runs.
        floor: the noise.
        blocks: how it was cut, in words.
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
    """How one temperature, difference or speed goes with a component error."""

    component: str
    feature: str
    effect: str
    r: float
    left: float
    kept: bool


@dataclass(frozen=True)
class SearchStep:
    """One step of the search: what was added, and the error in sample and held out, relative to that of nothing."""

    added: str
    inside: float
    held_out: float


@dataclass(frozen=True)
class UndecidedTerm:
    """Another choice that is as good on the left-out blocks.

    Attributes:
        instead_of, candidate: labels of the term and of what might stand in its place.
        component: that it feeds.
        channels: what drives the rival.
        held_out, chosen_held_out: root mean squares on left-out blocks, in units of the rough noise.
        apart: root mean square difference of the two predictions where there are readings, in the same units.
    """

    instead_of: str
    candidate: str
    component: str
    channels: tuple[str, ...]
    held_out: float
    chosen_held_out: float
    apart: float


@dataclass(frozen=True)
class Characterisation(Result):
    """A machine characterised.

    Attributes:
        model: to be saved.
        measurements: how well each is met.
        coefficients: every number with its standard error.
        condition: condition number of the scaled design.
        inside_rms, held_out_rms: of all readings, in the unit of `unit`.
        unit: "um"; "urad" where there are angles only; "noise" (multiples of it) where there are both.
        steps: the search; empty where nothing was chosen.
        undecided: choices that are as good as the one that was made.
        correlations: the best of each component error.
        outliers: wrong readings that were left out.
        warnings: in words.
        notes: what was said of each measurement as it was read (missing readings, what was accepted), by its name.
        residuals: for figures: measurement name to hours, (n,), and readings minus prediction, (readings, n).
        judged: the model on its readings as every command judges it.
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
        """The coefficients."""
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
