"""Chooses terms on readings that were held out of the fit, and says where that does not decide.

Forward, one term at a time, by the error on held-out blocks; then the smallest choice within one standard error of the
best; then terms that do not pay are dropped, and each is tried against its rivals. The held-out errors of all choices
come from one set of normal equations. Choices that the held-out readings cannot separate from the one that was made are
listed, and effects that make the very readings of those that were chosen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.candidates import BEND, Drive, TermCandidate, at_constant_temperature, drive
from rtec.characterise.result import UndecidedTerm
from rtec.characterise.screen import VISIBLE, residual_gram, residual_parts
from rtec.estimation.gram.normal import NOTHING, Normal, ridged, solve, squares_left
from rtec.estimation.gram.stream import Progress
from rtec.machine.chain import component_unit

Floats = NDArray[np.float64]

NEAR = 0.02
"""Left-out errors that differ by less than this share decide nothing."""
SAME = 0.1
"""Predictions that differ by less than this share of what is left are the same prediction."""
TRIED = 80


def find_rivals(table: "HeldOutTable", chosen: Sequence[int]) -> list[UndecidedTerm]:
    """Exchange each temperature, difference or speed of a choice for every other, and list what is as good.

    Another lag of the same sensor is no rival. Of each sensor, and of each effect of another component, the best is
    given: what predicts something else first, then what predicts the same and is another cause.
    """
    out: list[UndecidedTerm] = []
    here = float(np.sqrt(table.held_out(chosen)))
    for i in chosen:
        mine = table.candidates[i]
        if not mine.feature:
            continue
        rest = [j for j in chosen if j != i]
        best: dict[tuple[str, ...], UndecidedTerm] = {}
        copies = table.copies.get(i, [])
        tried = [k for k in table.shortlist(rest, TRIED, rivals=True) if _may_stand_for(table.candidates[k], mine)]
        others = [*(k for k in copies if _may_stand_for(table.candidates[k], mine)), *tried]
        errors = [here] * (len(others) - len(tried)) + np.sqrt(table.held_out_beside(rest, tried)).tolist()
        for k, there in zip(others, errors, strict=True):
            other = table.candidates[k]
            which = (other.component, other.effect) if other.component != mine.component else other.channels
            if there > here * (1 + NEAR) or (which in best and best[which].held_out <= there):
                continue
            apart = _difference_um(table, chosen, [*rest, k])
            best[which] = UndecidedTerm(mine.label, other.label, mine.component, other.channels, there, here, apart)
        out += sorted(best.values(), key=lambda r: (r.apart <= SAME * here, r.held_out))
    return out


def _may_stand_for(other: TermCandidate, mine: TermCandidate) -> bool:
    """Whether another sensor or speed drives it, or it is in another component."""
    return bool(other.feature) and (other.channels != mine.channels or other.component != mine.component)


def _difference_um(table: "HeldOutTable", one: Sequence[int], other: Sequence[int]) -> float:
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
PLAIN = ("scale", "squareness", "backlash", "servo_lag", "inertia")
"""Effects that every machine has more or less of: where one was not chosen, that says nothing if nothing shows it."""
TWIST = 1
"""Degree of a turn that grows along the axis; every machine has it more or less, and bends."""
HIDDEN = 1e-4
"""A candidate of which a choice leaves less than this share makes the same readings as the choice."""


class HeldOutTable:
    """Left-out errors of choices, from the normal equations of all candidates."""

    def __init__(
        self, normal: Normal, candidates: Sequence[TermCandidate], single: Sequence[frozenset[Drive]] = ()
    ) -> None:
        self.normal, self.candidates, self.single = normal, candidates, single
        self.columns = [np.flatnonzero(normal.owner == i) for i in range(len(candidates))]
        self.most_features = max(1, min(MOST_FEATURES, len(normal.fold_numbers) // BLOCKS_EACH))
        self.freedom = float(np.sum([c.freedom for c in normal.cells]))
        offered = np.array([c.offered for c in candidates])
        self.shown, self.copies = _shown(normal, self.columns, offered)
        self.usable = self.shown & offered
        self._known: dict[tuple[int, ...], Floats] = {}

    def errors(self, chosen: Sequence[int]) -> Floats:
        """Mean squares of each fold, left out, (folds,); as shares of all readings, so they add up."""
        key = tuple(sorted(chosen))
        if key not in self._known:
            self._known[key] = self._folds(self._index(chosen), inside=False)
        return self._known[key]

    def _folds(self, columns: Ints, *, inside: bool) -> Floats:
        """Mean squares of each fold, by the fit to all or by that without it, (folds,)."""
        if self.normal.alone.any():
            part = self.normal.pick(columns)
            squares = part.held_out()[int(inside)]
            return np.asarray(np.bincount([c.fold for c in part.cells], squares / self.freedom))
        index = np.concatenate([columns, np.arange(self.normal.width, self.normal.gram.shape[1])])
        parts = self.normal.by_fold[:, index[:, None], index[None, :]]
        total, floor = parts.sum(axis=0), NOTHING * self.normal.raw[index[:-1]]
        values = solve(total[None] if inside else total[None] - parts, floor, refine=False)
        values = np.broadcast_to(values, (len(parts), len(index) - 1))
        return np.maximum(squares_left(parts, values), 0.0) / self.freedom

    def inside(self, chosen: Sequence[int]) -> float:
        """Mean square in sample."""
        return float(self._folds(self._index(chosen), inside=True).sum())

    def held_out(self, chosen: Sequence[int]) -> float:
        """Mean square on left-out blocks."""
        return float(self.errors(chosen).sum())

    def held_out_beside(self, chosen: Sequence[int], tried: Sequence[int]) -> Floats:
        """Mean squares on left-out blocks of a choice with one more candidate, for each of those tried, (tried,).

        The choice is solved once for all of them; a candidate then takes its share of what the choice leaves.
        """
        if self.normal.alone.any() or not tried:
            return np.array([self.held_out([*chosen, i]) for i in tried])
        last = self.normal.gram.shape[1] - 1
        base = np.concatenate([self._index(chosen), np.arange(self.normal.width, last)])
        index, p = np.concatenate([base, *(self.columns[i] for i in tried), [last]]), len(base)
        parts = self.normal.by_fold[:, index[:, None], index[None, :]]
        rest, scale = ridged(parts.sum(axis=0) - parts, NOTHING * self.normal.raw[index[:-1]])
        by_choice = np.linalg.solve(rest[:, :p, :p], rest[:, :p, p:])
        left = rest[:, p:, p:] - rest[:, p:, :p] @ by_choice
        # Each new column, and the readings, less what the choice makes of them; then their products in the fold itself.
        own = np.broadcast_to(np.eye(len(index) - p), (len(parts), len(index) - p, len(index) - p))
        beside = np.concatenate([-by_choice, own], axis=1)
        seen = beside.transpose(0, 2, 1) @ (parts * scale[:, :, None] * scale[:, None, :]) @ beside
        out, first = np.empty(len(tried)), 0
        for k, i in enumerate(tried):
            mine = np.arange(first, first + len(self.columns[i]))
            inner = left[:, mine[:, None], mine[None, :]]
            values = np.asarray(np.linalg.solve(inner, left[:, mine, -1:])[:, :, 0], dtype=np.float64)
            there = np.append(mine, -1)
            squares = squares_left(seen[:, there[:, None], there[None, :]], values)
            out[k] = np.maximum(squares, 0.0).sum() / self.freedom
            first += len(mine)
        return out

    def shortlist(self, chosen: Sequence[int], most: int = SHORTLIST, *, rivals: bool = False) -> list[int]:
        """Candidates that would explain most of what a choice leaves in sample; with rivals those not offered, too."""
        d, e, _ = residual_parts(self.normal, self._index(chosen))
        raw = self.normal.raw[: self.normal.width]
        gain = np.where(d > VISIBLE * raw, e * e / np.where(d > 0, d, 1.0), 0.0)
        total = np.array([gain[c].sum() if np.all(gain[c] > 0) else 0.0 for c in self.columns])
        total[list(chosen)] = 0.0
        total[~(self.shown if rivals else self.usable)] = 0.0
        order = [int(i) for i in np.argsort(-total, kind="stable") if total[i] > 0]
        features = self._features(chosen)
        drives = [drive(self.candidates[i].term.effect) for i in chosen]
        room = [i for i in order if self._room(i, features) and not self._cancels(i, drives)]
        # One spindle heats one way, an oil film lifts one way: two powers of a speed would only haggle over it.
        speeds = {self._of_speed(i) for i in chosen} - {None}
        return [i for i in room if self._of_speed(i) not in speeds][:most]

    def confounded(self, chosen: Sequence[int]) -> list[tuple[int, int, float]]:
        """Plain effects that were not chosen and that make the same readings as what was.

        Gives for each the number of the chosen candidate and its own, and how much the chosen one's coefficient holds
        of it, in units of the one per unit of the other.
        """
        index = self._index(chosen)
        owner, raw = self.normal.owner[index], self.normal.raw
        alone, _, _ = residual_parts(self.normal, np.zeros(0, dtype=np.int64))
        beside, _, _ = residual_parts(self.normal, index)
        out: list[tuple[int, int, float]] = []
        for k, own in enumerate(self.columns):
            j = int(own[0])
            shown = len(own) == 1 and alone[j] > VISIBLE * raw[j]
            if k in chosen or not shown or not _plain(self.candidates[k]) or beside[j] > HIDDEN * alone[j]:
                continue
            gram = residual_gram(self.normal, np.append(index, j))
            size = np.sqrt(np.diag(gram))
            share = np.linalg.lstsq((gram / np.outer(size, size))[:-1, :-1], gram[:-1, -1] / size[:-1] / size[-1])[0]
            out += [
                (int(i), k, float(a * size[-1] / s))
                for i, a, s in zip(owner, share, size[:-1], strict=True)
                if abs(a) > SAME and self._other(int(i), k)
            ]
        return out

    def _other(self, i: int, k: int) -> bool:
        """Whether a candidate is another fact than a chosen one: no other name for it, nor behind a lever arm."""
        mine, other = self.candidates[i], self.candidates[k]
        same_angle = mine.effect == other.effect == "squareness" and mine.component[:2] == other.component[:2]
        same_shape = mine.component == other.component and {mine.kind, other.kind} <= {"position", "region"}
        return not same_angle and not same_shape and (other.direct or not mine.direct)

    def constant(self, i: int) -> int | None:
        """The candidate that has the shape of a temperature's at constant temperature; None where none is shown."""
        shape = at_constant_temperature(self.candidates[i], self.candidates)
        k = None if shape is None else list(self.candidates).index(shape)
        return k if k is not None and self.usable[k] else None

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

    def _cancels(self, i: int, drives: Sequence[Drive]) -> bool:
        """Whether a candidate is one of those of which a choice may have one only, and has one."""
        mine = drive(self.candidates[i].term.effect)
        return any(mine in only and not only.isdisjoint(drives) for only in self.single)

    def _index(self, chosen: Sequence[int]) -> Ints:
        parts = [self.columns[i] for i in sorted(chosen)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _plain(candidate: TermCandidate) -> bool:
    turns = component_unit(candidate.component) == "urad"
    bent = getattr(candidate.term.effect, "degrees", None) == ((TWIST if turns else BEND),)
    return candidate.effect in PLAIN or bent


def _shown(
    normal: Normal, columns: Sequence[Ints], offered: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], dict[int, list[int]]]:
    """Candidates that the readings show and that are not the very column of one before them, offered ones first.

    And for each of which that is so, those that are its column.
    """
    d, _, _ = residual_parts(normal, np.zeros(0, dtype=np.int64))
    seen = d > VISIBLE * normal.raw[: normal.width]
    out = np.array([bool(seen[c].all()) and _apart(normal, c) for c in columns])
    single = np.array([i for i, c in enumerate(columns) if len(c) == 1 and out[i]], dtype=np.int64)
    copies: dict[int, list[int]] = {}
    if len(single) < 2:
        return out, copies
    single = single[np.argsort(~offered[single], kind="stable")]
    left = residual_gram(normal, np.concatenate([columns[i] for i in single]))
    size = np.sqrt(np.diag(left))
    for first, later in np.argwhere(np.abs(np.triu(left / np.outer(size, size), 1)) > 1 - ALIKE):
        copies.setdefault(int(single[first]), []).append(int(single[later]))
        out[single[later]] = False
    return out, copies


def _apart(normal: Normal, own: Ints) -> bool:
    """Whether the readings tell a candidate's own columns from each other and from the nuisances."""
    if len(own) < 2:
        return True
    left = residual_gram(normal, own)
    size = np.sqrt(np.maximum(np.diag(left), 1e-300))
    part = np.linalg.eigvalsh(left / np.outer(size, size))
    return bool(part[0] > TOGETHER * part[-1])


MOST_TERMS = 40
PAYS = 0.002
"""The left-out error falls by at least this share, or the step was in vain."""
PATIENCE = 2
"""So many steps in vain end the search."""
SIMPLER = 0.005
"""Of candidates whose left-out errors differ by less than this share, the simplest is taken."""
SWAPS = 3
KINDS = (
    "position",
    "direction",
    "velocity",
    "acceleration",
    "temperature",
    "speed",
    "difference",
    "cross",
    "region",
    "cyclic",
    "other",
)


@dataclass(frozen=True)
class ChoiceStep:
    """One step of the search: what was added, and the error, in units of the rough noise, inside and left out."""

    label: str
    inside: float
    held_out: float


@dataclass(frozen=True)
class TermChoice:
    """What was chosen.

    Attributes:
        chosen: candidates, as numbers of the list that was given.
        steps: the way there.
        held_out: root mean square on left-out blocks, in units of the rough noise.
        rivals: other choices that are as good.
        confounded: what makes the same readings as what was chosen, as `HeldOutTable.confounded` gives it.
    """

    chosen: tuple[int, ...]
    steps: tuple[ChoiceStep, ...]
    held_out: float
    rivals: tuple[UndecidedTerm, ...]
    confounded: tuple[tuple[int, int, float], ...]


def choose(
    normal: Normal,
    candidates: Sequence[TermCandidate],
    forced: Sequence[int] = (),
    progress: Progress | None = None,
    single: Sequence[frozenset[Drive]] = (),
) -> TermChoice:
    """Choose among candidates by their left-out errors; those that are forced stay.

    Args:
        normal: of all candidates.
        candidates: among which it chooses.
        forced: by number.
        progress: told how far it is.
        single: drives of which a choice may have one only, because two of them cancel.
    """
    table = HeldOutTable(normal, candidates, single)
    forced = independent(normal, [table.columns[i] for i in forced], forced)
    path, steps = _forward(table, forced, progress)
    chosen = _smallest_good(table, path)
    chosen = _drop(table, chosen, forced, table.errors(_best(table, path)))
    for _ in range(SWAPS):
        better = _joined(table, _swapped(table, chosen, forced), forced)
        if set(better) == set(chosen):
            break
        best = min((table.errors(c) for c in (better, _best(table, path))), key=np.sum)
        chosen = _drop(table, better, forced, best)
    held_out = float(np.sqrt(table.held_out(chosen)))
    rivals, same = find_rivals(table, chosen), table.confounded(chosen)
    return TermChoice(tuple(sorted(chosen)), tuple(steps), held_out, tuple(rivals), tuple(same))


def one_standard_error(worse: Floats, better: Floats) -> bool:
    """Whether left-out errors fold by fold do not speak for the better choice: gain within one standard error."""
    gain = worse - better
    spread = np.std(gain, ddof=1) * np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.sum() <= spread)


def independent(normal: Normal, columns: Sequence[Ints], items: Sequence[int]) -> list[int]:
    """Those of some items, in order, whose columns the readings can tell from the ones before."""
    kept: list[int] = []
    index = np.zeros(0, dtype=np.int64)
    for item, own in zip(items, columns, strict=True):
        d, _, _ = residual_parts(normal, index)
        if np.all(d[own] > VISIBLE * normal.raw[own]):
            kept.append(item)
            index = np.concatenate([index, own])
    return kept


def _forward(
    table: HeldOutTable, forced: list[int], progress: Progress | None
) -> tuple[list[list[int]], list[ChoiceStep]]:
    path: list[list[int]] = [forced]
    steps = [_step(table, forced, "what was asked for" if forced else "nothing")]
    best, vain = table.held_out(forced), 0
    while len(path) <= MOST_TERMS and vain < PATIENCE:
        tried = table.shortlist(path[-1])
        if not tried:
            break
        errors = table.held_out_beside(path[-1], tried)
        pick = _simplest(table, tried, errors)
        path.append([*path[-1], pick])
        steps.append(_step(table, path[-1], table.candidates[pick].label))
        now = table.held_out(path[-1])
        vain = 0 if now < best * (1 - PAYS) else vain + 1
        best = min(best, now)
        if progress:
            progress(len(path) - 1, MOST_TERMS)
    return path, steps


def _simplest(table: HeldOutTable, tried: Sequence[int], errors: Floats) -> int:
    """Of the candidates that are as good as the best, the simplest.

    What the readings show as it is comes before what reaches them through a lever arm: an instrument that stands at
    one arm cannot distinguish an angle from a shift, and on the rest of the machine they are not the same.
    """
    near = np.flatnonzero(errors <= errors.min() * (1 + SIMPLER)).tolist()
    # The first of equals: rounding decides nothing, so the order of the candidates does.
    ranks = [(*_complexity(table, tried[k]), round(errors[k] / errors.min(), 6), tried[k]) for k in near]
    return min(ranks)[-1]


def _complexity(table: HeldOutTable, i: int) -> tuple[bool, int, int, int]:
    candidate = table.candidates[i]
    return not candidate.direct, len(table.columns[i]), KINDS.index(candidate.kind), len(candidate.term.theta)


def _step(table: HeldOutTable, chosen: Sequence[int], label: str) -> ChoiceStep:
    return ChoiceStep(label, float(np.sqrt(table.inside(chosen))), float(np.sqrt(table.held_out(chosen))))


def _best(table: HeldOutTable, path: Sequence[list[int]]) -> list[int]:
    return min(path, key=table.held_out)


def _smallest_good(table: HeldOutTable, path: Sequence[list[int]]) -> list[int]:
    """The first choice of the path that is within one standard error of the path's best."""
    best = table.errors(_best(table, path))
    return next(c for c in path if one_standard_error(table.errors(c), best))


def _drop(table: HeldOutTable, chosen: list[int], forced: list[int], best: Floats) -> list[int]:
    """Drop terms, the least missed first, while what is left stays within one standard error of the best."""
    while len(chosen) > len(forced):
        fewer = min(([j for j in chosen if j != i] for i in chosen if i not in forced), key=table.held_out)
        if not one_standard_error(table.errors(fewer), best):
            break
        chosen = fewer
    return chosen


def _swapped(table: HeldOutTable, chosen: list[int], forced: list[int]) -> list[int]:
    """The choice with terms exchanged one by one, where that lowers the left-out error for good.

    Or where a simpler shape does as well beside what was found after the one that was taken.
    """
    now = list(chosen)
    for i in chosen:
        if i in forced:
            continue
        rest, here = [j for j in now if j != i], table.held_out(now)
        tried = table.shortlist(rest)
        errors = table.held_out_beside(rest, tried)
        if not len(errors):
            continue
        pick = _simplest(table, tried, errors)
        there = errors[tried.index(pick)]
        better = errors.min() < here * (1 - PAYS) and there < here
        if better or (_simpler_shape(table, pick, i) and there <= here * _room_for_simpler(table, pick, i)):
            now = [*rest, pick]
    return now


def _simpler_shape(table: HeldOutTable, i: int, k: int) -> bool:
    """Whether a candidate is a simpler shape than the regions or cross-talk that another one is."""
    plain = not table.candidates[i].feature and table.candidates[k].kind in ("cross", "region")
    return plain and _complexity(table, i) < _complexity(table, k)


def _room_for_simpler(table: HeldOutTable, i: int, k: int) -> float:
    """By which factor the left-out error may rise for a simpler shape: not at all where it is in another component."""
    return 1 + SIMPLER * (table.candidates[i].component == table.candidates[k].component)


def _joined(table: HeldOutTable, chosen: list[int], forced: list[int]) -> list[int]:
    """The choice with all temperatures of one component and form replaced by one, where that is as good.

    Forward search often takes two near-enough temperatures before it has seen the right one. Beside the right one
    stands the same shape at constant temperature, because the machine need not be without error at the reference.
    """
    forms: dict[tuple[str, str], list[int]] = {}
    for i in chosen:
        if table.candidates[i].feature and i not in forced:
            forms.setdefault(_form(table.candidates[i]), []).append(i)
    for form, together in forms.items():
        rest = [j for j in chosen if j not in together]
        shape = table.constant(together[0])
        for base in (rest, [*rest, shape] if shape is not None and shape not in rest else rest):
            tried = [i for i in table.shortlist(base, len(table.candidates)) if _form(table.candidates[i]) == form]
            if tried:
                one = [*base, tried[int(np.argmin(table.held_out_beside(base, tried)))]]
                fewer = len(one) < len(chosen) and one_standard_error(table.errors(one), table.errors(chosen))
                if fewer or table.held_out(one) < table.held_out(chosen) * (1 - PAYS):
                    chosen = one
    return chosen


def _form(candidate: TermCandidate) -> tuple[str, str]:
    return candidate.component, candidate.effect
