"""Evaluation of grid-encoder set-ups: each alone, and their comparisons."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from rtec.errors import MeasurementError
from rtec.metrology.grid.compare import certain, directions, feeds, not_compared, places
from rtec.metrology.grid.paths import TRIM_MM
from rtec.metrology.grid.setup import GridSetup, Item, analyse
from rtec.metrology.measurement import Measurement
from rtec.result import Result


@dataclass(frozen=True)
class GridComparison:
    """One comparison: heading, what was compared, and the items."""

    heading: str
    items: tuple[Item, ...]


@dataclass(frozen=True)
class GridEvaluation(Result):
    """Result of the evaluation of some set-ups.

    Attributes:
        setups: the set-ups, each with its own report.
        comparisons: between directions, feeds, and set-ups.
        found: significant items.
        magnification: magnification of the figures; None: a round number for each.
    """

    page_maker: ClassVar[str] = "rtec.report.grid:grid_page"

    setups: tuple[GridSetup, ...]
    comparisons: tuple[GridComparison, ...]
    found: tuple[Item, ...]
    magnification: float | None = None

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return {
            "setups": [
                {"name": s.name, "plane": s.setup.plane, "origin_mm": s.setup.origin_mm, "corner_mm": s.corner_mm,
                 "pieces": len(s.edges), "items": s.items}
                for s in self.setups
            ],
            "not_compared": not_compared(self.setups),
            "comparisons": [
                {"heading": c.heading, "items": c.items, "certain": [i.name for i in c.items if i in self.found]}
                for c in self.comparisons
            ],
        }  # fmt: skip

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """Every error of each set-up, then every difference, each with its significance."""
        own = [{"of": s.name, **asdict(i), "certain": None} for s in self.setups for i in s.items]
        compared = [(c.heading, i) for c in self.comparisons for i in c.items]
        return own + [{"of": heading, **asdict(i), "certain": i in self.found} for heading, i in compared]


def evaluate(
    measurements: Sequence[Measurement],
    corner_mm: tuple[float, float] | None = None,
    trim_mm: float = TRIM_MM,
    magnification: float | None = None,
) -> GridEvaluation:
    """Analyse set-ups and compare them.

    Raises:
        MeasurementError: as `analyse`, or set-ups on different machines.
    """
    setups = tuple(analyse(m, corner_mm, trim_mm) for m in measurements)
    for other in setups[1:]:
        if other.machine.hash != setups[0].machine.hash:
            raise MeasurementError(f"{other.name} and {setups[0].name} were made on different machines")
    compared = []
    for setup in setups:
        compared.append(GridComparison(f"{setup.name}: direction", directions(setup)))
        compared.append(GridComparison(f"{setup.name}: feed", feeds(setup)))
    for i, one in enumerate(setups):
        compared += [GridComparison(f"{one.name} minus {two.name}", places(one, two)) for two in setups[i + 1 :]]
    kept = tuple(c for c in compared if c.items)
    found = certain([item for c in kept for item in c.items])
    return GridEvaluation(setups, kept, found, magnification)
