"""Left-out errors of choices among candidates, from one set of normal equations."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.candidates import Candidate
from rtec.characterise.normal import NOTHING, Normal, solve, squares_left
from rtec.characterise.screen import VISIBLE, residual_gram, residual_parts

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SHORTLIST = 40
"""Each step tries so many of the candidates that explain most in sample on the left-out blocks."""
ALIKE = 1e-9
"""Columns whose correlation is this near to one are the same, under two names: the first is kept."""
TOGETHER = 1e-8
"""A direction of a candidate's own columns below this share of the largest is not seen."""
MOST_FEATURES = 4
"""Temperatures, differences and speeds that one component error may depend on; one or two is usual [G 3.6]."""
BLOCKS_EACH = 2
"""And no more of them than one for so many left-out blocks: each must be seen to come and go more than once."""


class Table:
    """Left-out errors of choices, from the normal equations of all candidates."""

    def __init__(self, normal: Normal, candidates: Sequence[Candidate]) -> None:
        self.normal, self.candidates = normal, candidates
        self.columns = [np.flatnonzero(normal.owner == i) for i in range(len(candidates))]
        self.most_features = max(1, min(MOST_FEATURES, len(normal.fold_numbers) // BLOCKS_EACH))
        self.freedom = float(np.sum([c.freedom for c in normal.cells]))
        self.usable = _usable(normal, self.columns)
        self._known: dict[tuple[int, ...], tuple[Floats, Floats]] = {}

    def errors(self, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Mean squares of each fold, left out and inside, (folds,); as shares of all readings, so they add up."""
        key = tuple(sorted(chosen))
        if key not in self._known:
            self._known[key] = self._folds(self._index(chosen))
        return self._known[key]

    def _folds(self, columns: Ints) -> tuple[Floats, Floats]:
        if self.normal.alone.any():
            return self._cell_by_cell(self.normal.pick(columns))
        index = np.concatenate([columns, np.arange(self.normal.width, self.normal.gram.shape[1])])
        parts = self.normal.by_fold[:, index[:, None], index[None, :]]
        total, floor = parts.sum(axis=0), NOTHING * self.normal.raw[index[:-1]]
        out = squares_left(parts, solve(total[None] - parts, floor, refine=False))
        full = np.broadcast_to(solve(total[None], floor, refine=False), (len(parts), len(index) - 1))
        return np.maximum(out, 0.0) / self.freedom, np.maximum(squares_left(parts, full), 0.0) / self.freedom

    def _cell_by_cell(self, part: Normal) -> tuple[Floats, Floats]:
        folds = [c.fold for c in part.cells]
        out, inside = (np.bincount(folds, v / self.freedom) for v in part.held_out())
        return np.asarray(out), np.asarray(inside)

    def held_out(self, chosen: Sequence[int]) -> float:
        """Mean square on left-out blocks."""
        return float(self.errors(chosen)[0].sum())

    def shortlist(self, chosen: Sequence[int], most: int = SHORTLIST) -> list[int]:
        """Candidates that would explain most of what a choice leaves in sample."""
        d, e, _ = residual_parts(self.normal, self._index(chosen))
        raw = self.normal.raw[: self.normal.width]
        gain = np.where(d > VISIBLE * raw, e * e / np.where(d > 0, d, 1.0), 0.0)
        total = np.array([gain[c].sum() if np.all(gain[c] > 0) else 0.0 for c in self.columns])
        total[list(chosen)] = 0.0
        total[~self.usable] = 0.0
        order = [int(i) for i in np.argsort(-total, kind="stable") if total[i] > 0]
        features = self._features(chosen)
        room = [i for i in order if self._room(i, features)]
        # One spindle heats one way, an oil film lifts one way: two powers of a speed would only haggle over it.
        speeds = {self._of_speed(i) for i in chosen} - {None}
        return [i for i in room if self._of_speed(i) not in speeds][:most]

    def _of_speed(self, i: int) -> tuple[str, str] | None:
        """Component and kind of a candidate that goes with a power of a speed; None of others."""
        candidate = self.candidates[i]
        return (candidate.component, candidate.kind) if candidate.kind in ("speed", "velocity") else None

    def _features(self, chosen: Sequence[int]) -> dict[str, set[str]]:
        out: dict[str, set[str]] = {}
        for i in chosen:
            if self.candidates[i].feature:
                out.setdefault(self.candidates[i].component, set()).add(self.candidates[i].feature)
        return out

    def _room(self, i: int, features: dict[str, set[str]]) -> bool:
        """Whether a component may have this candidate's feature too."""
        candidate = self.candidates[i]
        there = features.get(candidate.component, set())
        return not candidate.feature or candidate.feature in there or len(there) < self.most_features

    def _index(self, chosen: Sequence[int]) -> Ints:
        parts = [self.columns[i] for i in sorted(chosen)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _usable(normal: Normal, columns: Sequence[Ints]) -> NDArray[np.bool_]:
    """Candidates that the readings show and that are not the very column of one before them."""
    d, _, _ = residual_parts(normal, np.zeros(0, dtype=np.int64))
    seen = d > VISIBLE * normal.raw[: normal.width]
    out = np.array([bool(seen[c].all()) and _apart(normal, c) for c in columns])
    single = np.array([int(c[0]) for i, c in enumerate(columns) if len(c) == 1 and out[i]], dtype=np.int64)
    if len(single) < 2:
        return out
    left = residual_gram(normal, single)
    size = np.sqrt(np.diag(left))
    alike = np.abs(np.triu(left / np.outer(size, size), 1)) > 1 - ALIKE
    copies = set(single[alike.any(axis=0)].tolist())
    return np.array([ok and not (len(c) == 1 and int(c[0]) in copies) for ok, c in zip(out, columns, strict=True)])


def _apart(normal: Normal, own: Ints) -> bool:
    """Whether the readings tell a candidate's own columns from each other and from the nuisances."""
    if len(own) < 2:
        return True
    left = residual_gram(normal, own)
    size = np.sqrt(np.maximum(np.diag(left), 1e-300))
    part = np.linalg.eigvalsh(left / np.outer(size, size))
    return bool(part[0] > TOGETHER * part[-1])
