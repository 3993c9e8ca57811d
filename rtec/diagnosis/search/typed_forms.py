"""Forms of an expression for what has no name: polynomials, a hump, a step, a wave; over one variable or two."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

DEGREES = (1, 2, 3, 4)
LETTERS = "ABCDEFGH"
CENTRES, WIDTHS = 24, 7
NARROWEST, WIDEST = 0.02, 0.5
"""Of the span: widths of humps and steps that are tried."""
SAMPLED, TURNS, PERIODS = 2.1, 1.5, 60
"""Shortest period over the step from place to place; fewest turns of a wave over the span; periods tried."""
AROUND = 4.0
"""A width is proposed with bounds so many times as small and large."""


@dataclass(frozen=True)
class Span:
    """A variable as an expression reads it.

    Attributes:
        name: of the channel.
        low, high: of the readings; of a temperature above the reference.
        step: from one place to the next.
        zero: of a temperature, the reference; what is added for people.
    """

    name: str
    low: float
    high: float
    step: float
    zero: float

    @property
    def scaled(self) -> str:
        """The variable scaled to about -1 … +1, as text; a direction is that already."""
        if self.name.startswith("d_"):
            return self.name
        middle, half = _short(0.5 * (self.low + self.high)), _short(0.5 * (self.high - self.low))
        return (
            f"(({self.name} - {middle})/{half})" if float(middle) >= 0.0 else f"(({self.name} + {middle[1:]})/{half})"
        )


@dataclass(frozen=True)
class Searched:
    """A non-linear parameter: where it may lie, and what is tried; `ratio` where steps are ratios."""

    name: str
    low: float
    high: float
    grid: tuple[float, ...]
    ratio: bool = False

    @property
    def start(self) -> float:
        """The middle of what is tried."""
        return self.grid[len(self.grid) // 2]

    def between(self, value: float) -> float:
        """The step of the grid at a value."""
        if len(self.grid) < 2:
            return 0.1 * (self.high - self.low)
        return value * (self.grid[1] / self.grid[0] - 1.0) if self.ratio else self.grid[1] - self.grid[0]

    def text(self, value: float) -> str:
        """As `--param` takes it, about a value."""
        low, high = (max(self.low, value / AROUND), min(self.high, value * AROUND)) if self.ratio else (
            self.low, self.high)  # fmt: skip
        return f"{self.name}={_short(value)}:{_short(min(low, value))}..{_short(max(high, value))}"


@dataclass(frozen=True)
class Form:
    """An expression with what is searched for; `along` is the variable that the words are of; a wave may grow."""

    kind: Literal["polynomial", "hump", "step", "wave"]
    expression: str
    searched: tuple[Searched, ...] = ()
    along: int = 0
    grows: int | None = None


def forms_of(spans: Sequence[Span], period: float | None) -> Iterator[Form]:
    """Forms over one variable or two.

    Args:
        spans: the variables.
        period: of a wave along the first, in its unit; None where there is none.
    """
    if period is not None:
        yield from _waves(spans, period)
        return
    if len(spans) == 1:
        yield from _of_one(spans[0])
        yield from _waves(spans, None)
        return
    for along, other in ((0, 1), (1, 0)):
        if not spans[along].name.startswith("d_"):
            yield from _grown(spans, along, spans[other].scaled)
    one, two = (s.scaled for s in spans[:2])
    terms = [one, two, f"{one}*{two}"]
    yield Form("polynomial", _sum(terms))


def _of_one(span: Span) -> Iterator[Form]:
    u = span.scaled
    powers = [u, *(f"{u}**{k}" for k in DEGREES[1:])]
    for degree in DEGREES:
        yield Form("polynomial", _sum(powers[:degree]))
    for kind, text, searched in _local(span):
        yield Form(kind, _sum([text]), searched)
        yield Form(kind, _sum([text, u]), searched)


def _grown(spans: Sequence[Span], along: int, factor: str) -> Iterator[Form]:
    """Forms along one variable whose height goes with the other."""
    u = spans[along].scaled
    powers = [factor, *(f"{factor}*{u}" if k == 1 else f"{factor}*{u}**{k}" for k in DEGREES[:3])]
    for count in range(2, len(powers) + 1):
        yield Form("polynomial", _sum(powers[:count]), along=along)
    for kind, text, searched in _local(spans[along]):
        yield Form(kind, _sum([f"{factor}*{text}"]), searched, along)
        yield Form(kind, _sum([text, f"{factor}*{text}"]), searched, along)


def _local(span: Span) -> Iterator[tuple[Literal["hump", "step"], str, tuple[Searched, ...]]]:
    wide = span.high - span.low
    narrow = max(NARROWEST * wide, span.step)
    if narrow >= WIDEST * wide:
        return
    centre = Searched("centre", span.low, span.high, tuple(np.linspace(span.low, span.high, CENTRES + 2)[1:-1]))
    widths = tuple(np.geomspace(narrow, WIDEST * wide, WIDTHS))
    width = Searched("width", 0.5 * narrow, wide, widths, ratio=True)
    yield "hump", f"exp(-(({span.name} - centre)/width)**2)", (centre, width)
    yield "step", f"tanh(({span.name} - centre)/width)", (centre, width)


def _waves(spans: Sequence[Span], period: float | None) -> Iterator[Form]:
    """An even wave, and those that grow with a variable, their own place too."""
    first = spans[0]
    wide = first.high - first.low
    if period is not None:
        # Farther off than this, the wave is out of step at the ends.
        off = 0.5 * period / max(wide, period)
        searched = Searched("period", period * (1.0 - off), period * (1.0 + off), (period,))
    else:
        shortest, longest = max(SAMPLED * first.step, NARROWEST * wide), wide / TURNS
        if shortest >= longest:
            return
        grid = tuple(1.0 / np.linspace(1.0 / longest, 1.0 / shortest, PERIODS))
        searched = Searched("period", shortest, longest, grid)
    waves = [f"{f}(2*pi*{first.name}/period)" for f in ("sin", "cos")]
    yield Form("wave", _sum(waves), (searched,))
    for place, span in enumerate(spans):
        yield Form("wave", _sum([*waves, *(f"{span.scaled}*{w}" for w in waves)]), (searched,), grows=place)


def _sum(terms: Sequence[str]) -> str:
    return " + ".join(f"{letter}*{term}" for letter, term in zip(LETTERS, terms, strict=False))


def _short(value: float) -> str:
    return f"{value:.4g}"
