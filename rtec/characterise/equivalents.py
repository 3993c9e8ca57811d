"""Finds choices that the left-out readings cannot tell from the one that was made."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.normal import solve

if TYPE_CHECKING:
    from rtec.characterise.choose import HeldOutTable

Floats = NDArray[np.float64]

NEAR = 0.02
"""Left-out errors that differ by less than this share decide nothing."""
SAME = 0.1
"""Predictions that differ by less than this share of what is left are the same prediction."""
TRIED = 80


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


def find_rivals(table: "HeldOutTable", chosen: Sequence[int]) -> list[UndecidedTerm]:
    """Exchange each temperature, difference or speed of a choice for every other, and list what is as good.

    Another lag of the same sensor is no rival, nor is what predicts the same.
    """
    out: list[UndecidedTerm] = []
    here = float(np.sqrt(table.held_out(chosen)))
    for i in chosen:
        mine = table.candidates[i]
        if not mine.feature:
            continue
        rest = [j for j in chosen if j != i]
        best: dict[tuple[str, ...], UndecidedTerm] = {}
        for k in table.shortlist(rest, TRIED):
            other = table.candidates[k]
            if not other.feature or other.channels == mine.channels or other.component != mine.component:
                continue
            there = float(np.sqrt(table.held_out([*rest, k])))
            if there > here * (1 + NEAR) or (other.channels in best and best[other.channels].held_out <= there):
                continue
            apart = _apart(table, chosen, [*rest, k])
            if apart > SAME * here:
                best[other.channels] = UndecidedTerm(
                    mine.label, other.label, mine.component, other.channels, there, here, apart
                )
        out += sorted(best.values(), key=lambda r: r.held_out)
    return out


def _apart(table: "HeldOutTable", one: Sequence[int], other: Sequence[int]) -> float:
    """Root mean square difference of two choices' predictions, nuisances left free."""
    union = sorted({*one, *other})
    columns = [table.columns[i] for i in union]
    part = table.normal.pick(np.concatenate(columns))
    owner = np.repeat(union, [len(c) for c in columns])
    difference = np.zeros(part.width + len(part.extra))
    for chosen, sign in ((one, 1.0), (other, -1.0)):
        inside = np.append(np.flatnonzero(np.isin(owner, chosen)), np.arange(part.width, len(difference)))
        gram = part.total[np.ix_(np.append(inside, len(difference)), np.append(inside, len(difference)))]
        difference[inside] += sign * solve(gram[None])[0]
    square = float(difference @ part.total[:-1, :-1] @ difference)
    return float(np.sqrt(max(square, 0.0) / table.freedom))
