"""One row of the benchmark: what, how much, and beside what it was measured in the same run."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """A figure.

    Attributes:
        name: what was measured.
        value: with unit, as text.
        ratio: to what it is measured against; None where there is nothing.
        against: what that is, with its own figure.
        goal: what the project wants, as text.
        met: whether it is so here and now.
    """

    name: str
    value: str
    ratio: float | None
    against: str
    goal: str
    met: bool
