"""Which parameters a set of tests separates: rank, what is never seen, and which sets stay confounded."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
UNSEEN = 1e-9
"""A column smaller than this share of the largest is not there."""
ALIKE = 1e-6
"""A direction with a singular value below this share of the largest is not separated."""
IN_IT = 1e-3
"""Share in such directions from which on a parameter belongs to a confounded set."""


@dataclass(frozen=True)
class Rank:
    """What a design separates.

    Attributes:
        count: parameters asked for.
        rank: combinations of them that can be found.
        never: that no reading sees.
        confounded: sets of which only combinations can be found.
        condition: of the columns that are seen, each scaled to one; over the directions that are separated.
        kept: places of the parameters that a fit can have: of a confounded set the first ones.
    """

    count: int
    rank: int
    never: tuple[str, ...]
    confounded: tuple[tuple[str, ...], ...]
    condition: float
    kept: tuple[int, ...]

    @property
    def complete(self) -> bool:
        """Can every parameter be found?"""
        return self.rank == self.count


def rank_of(design: Floats, names: Sequence[str]) -> Rank:
    """Judge a design, (readings, parameters), with one name a column."""
    size = np.linalg.norm(design, axis=0)
    seen = [int(i) for i in np.flatnonzero(size > UNSEEN * max(float(size.max(initial=0.0)), 1e-300))]
    never = tuple(n for i, n in enumerate(names) if i not in seen)
    if not seen:
        return Rank(len(names), 0, never, (), float("inf"), ())
    scaled = design[:, seen] / size[seen]
    _, singular, rows = np.linalg.svd(scaled, full_matrices=False)
    good = singular > ALIKE * singular[0]
    sets = _sets(rows[~good].T, [names[i] for i in seen])
    condition = float(singular[0] / singular[good][-1])
    return Rank(len(names), int(good.sum()), never, sets, condition, tuple(seen[i] for i in _kept(scaled)))


def _kept(scaled: Floats) -> list[int]:
    """Columns that the ones before them do not make already."""
    out: list[int] = []
    basis = np.zeros((len(scaled), 0))
    for i in range(scaled.shape[1]):
        left = scaled[:, i] - basis @ (basis.T @ scaled[:, i])
        left = left - basis @ (basis.T @ left)
        size = float(np.linalg.norm(left))
        if size > 10.0 * ALIKE:
            basis = np.concatenate([basis, left[:, None] / size], axis=1)
            out.append(i)
    return out


def _sets(unseen: Floats, names: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Connected parts of the projector on the directions that are not seen."""
    projector = unseen @ unseen.T
    left = {i for i in range(len(names)) if projector[i, i] > IN_IT}
    out = []
    while left:
        group: set[int] = set()
        edge = {min(left)}
        while edge:
            i = edge.pop()
            group.add(i)
            edge |= {j for j in left - group if abs(projector[i, j]) > IN_IT}
        left -= group
        out.append(tuple(names[i] for i in sorted(group)))
    return tuple(out)
