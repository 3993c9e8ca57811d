"""Chooses terms by their error on held-out blocks, and lists the alternatives where that does not decide.

Forward selection adds one term at a time by the error on held-out blocks. Then the smallest choice within one standard
error of the best one counts; unnecessary terms are dropped, and each term is exchanged for its rivals. The held-out
errors of all choices come from one set of normal equations. Alternatives that the held-out readings do not separate
from the choice are listed, as are effects that are confounded with the chosen ones.
"""

import copy
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.characterise.candidates import (
    BEND,
    EVERY_MACHINE,
    Drive,
    TermCandidate,
    at_constant_temperature,
    drive,
    every_machine_has,
)
from rtec.characterise.result import UndecidedTerm
from rtec.characterise.screen import VISIBLE, residual_gram, residual_parts
from rtec.effects.thermal import AxisExpansion
from rtec.estimation.candidates import on_part
from rtec.estimation.gram.normal import NOTHING, Normal, ridged, solve, squares_left
from rtec.estimation.gram.stream import Progress
from rtec.machine.chain import component_unit

NEAR = 0.02
"""Held-out errors that differ by less than this share do not decide."""
SAME = 0.1
"""Predictions count as equal if they differ by less than this share of the residual."""
TRIED = 80


def find_rivals(table: "HeldOutTable", chosen: Sequence[int]) -> list[UndecidedTerm]:
    """Exchange each temperature, difference or speed of a choice for every other one, and list those that are as good.

    Another lag of the same sensor is no rival. The list has the best one of each sensor and of each effect of another
    component: first those with different predictions, then those with the same prediction.
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
            alike = other.feature == mine.feature
            best[which] = UndecidedTerm(
                mine.label, other.label, mine.component, other.channels, there, here, apart, alike
            )
        out += sorted(best.values(), key=lambda r: (r.apart <= SAME * here, r.held_out))
    return out


def _may_stand_for(other: TermCandidate, mine: TermCandidate) -> bool:
    """Whether a candidate is a rival of a chosen one: it has another sensor or speed, or another component."""
    return bool(other.feature) and (other.channels != mine.channels or other.component != mine.component)


def _difference_um(table: "HeldOutTable", one: Sequence[int], other: Sequence[int]) -> float:
    """Root mean square difference of two choices' predictions, with free nuisance parameters."""
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


SHORTLIST = 40
"""Number of candidates, those that explain most in sample, that each step evaluates on the held-out blocks."""
ALIKE = 1e-9
"""Columns are the same if their correlation differs from one by less than this; the first one is kept."""
TOGETHER = 1e-8
"""A direction of a candidate's own columns is not determined if it is below this share of the largest."""
MOST_FEATURES = 4
"""Largest number of temperatures, differences and speeds for one component error; one or two is usual [G 3.6]."""
BLOCKS_EACH = 2
"""Held-out blocks for each of them at least: each must vary more than once."""
SERVOS = ("servo_lag", "inertia")
PLAIN = (*EVERY_MACHINE, *SERVOS)
"""With effects that every machine has to some degree: they may be confounded with chosen ones even if not chosen."""
FEW_FILES = 2
"""Files of a ball bar whose lengths have one difference: that of the bar itself is no other."""
TWIST = 1
"""Degree of a rotation that grows along the axis; every machine has it to some degree, and bends, too."""
HIDDEN = 1e-4
"""A candidate is confounded with a choice if less than this share of it is independent of the choice."""


class HeldOutTable:
    """Held-out errors of choices, from the normal equations of all candidates."""

    def __init__(
        self, normal: Normal, candidates: Sequence[TermCandidate], single: Sequence[frozenset[Drive]] = ()
    ) -> None:
        self.normal, self.candidates, self.single = normal, candidates, single
        self.columns = [np.flatnonzero(normal.owner == i) for i in range(len(candidates))]
        self.most_features = max(1, min(MOST_FEATURES, len(normal.fold_numbers) // BLOCKS_EACH))
        self.freedom = float(np.sum([c.freedom for c in normal.cells]))
        offered = np.array([c.offered for c in candidates])
        self.of_one = np.array([i for i, c in enumerate(self.columns) if len(c) == 1], dtype=np.int64)
        self.of_several = [i for i, c in enumerate(self.columns) if len(c) != 1]
        self.shown, self.copies = _shown(normal, self.columns, offered)
        self.usable = self.shown & offered
        self._known: dict[tuple[int, ...], Floats] = {}

    @cached_property
    def drives(self) -> list[Drive]:
        """What drives each candidate."""
        return [drive(c.term.effect) for c in self.candidates]

    def errors(self, chosen: Sequence[int]) -> Floats:
        """Sum of squares of each held-out fold over the freedom of all readings, (folds,): parts of the mean square."""
        key = tuple(sorted(chosen))
        if key not in self._known:
            self._known[key] = self._folds(self._index(chosen), inside=False)
        return self._known[key]

    def _folds(self, columns: Ints, *, inside: bool) -> Floats:
        """As `errors`, by the fit to all readings (`inside`) or by the one without the fold, (folds,)."""
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
        """Mean square on held-out blocks."""
        return float(self.errors(chosen).sum())

    def held_out_beside(self, chosen: Sequence[int], tried: Sequence[int]) -> Floats:
        """Mean squares on held-out blocks of a choice with one more candidate, one for each in `tried`, (tried,).

        The choice is solved once; each candidate is then fitted to its residual.
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
        # New columns and readings, orthogonal to the choice outside the fold; then their products in the fold itself.
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
        """Candidates that explain most of a choice's residual in sample; `rivals`: also those that are not offered."""
        d, e, _ = residual_parts(self.normal, self._index(chosen))
        raw = self.normal.raw[: self.normal.width]
        gain = np.where(d > VISIBLE * raw, e * e / np.where(d > 0, d, 1.0), 0.0)
        total = np.zeros(len(self.columns))
        total[self.of_one] = gain[np.array([self.columns[i][0] for i in self.of_one], dtype=np.int64)]
        for i in self.of_several:
            own = gain[self.columns[i]]
            total[i] = own.sum() if np.all(own > 0) else 0.0
        total[list(chosen)] = 0.0
        total[~(self.shown if rivals else self.usable)] = 0.0
        order = (int(i) for i in np.argsort(-total, kind="stable") if total[i] > 0)
        features = self._features(chosen)
        drives = [self.drives[i] for i in chosen]
        room = (i for i in order if self._room(i, features) and not self._cancels(i, drives))
        # A spindle's heat and an oil film have one power of the speed each: two powers would share one effect.
        speeds = {self._of_speed(i) for i in chosen} - {None}
        return list(itertools.islice((i for i in room if self._of_speed(i) not in speeds), most))

    def confounded(self, chosen: Sequence[int]) -> list[tuple[int, int, int, float]]:
        """Plain effects that were not chosen and are confounded with chosen ones.

        Gives for each the index of the chosen candidate, the place of its coefficient, the index of the effect, and its
        share in that coefficient, in units of the chosen one per unit of its own.
        """
        index = self._index(chosen)
        owner, raw = self.normal.owner[index], self.normal.raw
        places = [int((owner[:n] == i).sum()) for n, i in enumerate(owner)]
        alone, _, _ = residual_parts(self.normal, np.zeros(0, dtype=np.int64))
        beside, _, _ = residual_parts(self.normal, index)
        out: list[tuple[int, int, int, float]] = []
        for k, own in enumerate(self.columns):
            j = int(own[0])
            shown = len(own) == 1 and alone[j] > VISIBLE * raw[j]
            if k in chosen or not shown or not _plain(self.candidates[k]) or beside[j] > HIDDEN * alone[j]:
                continue
            gram = residual_gram(self.normal, np.append(index, j))
            size = np.sqrt(np.diag(gram))
            share = np.linalg.lstsq((gram / np.outer(size, size))[:-1, :-1], gram[:-1, -1] / size[:-1] / size[-1])[0]
            out += [
                (int(i), place, k, float(a * size[-1] / s))
                for i, place, a, s in zip(owner, places, share, size[:-1], strict=True)
                if abs(a) > SAME and self._other(int(i), k)
            ]
        return out

    def _other(self, i: int, k: int) -> bool:
        """Whether a candidate is physically different from a chosen one: no other name, not behind a lever arm."""
        mine, other = self.candidates[i], self.candidates[k]
        same_angle = mine.effect == other.effect == "squareness" and mine.component[:2] == other.component[:2]
        same_shape = mine.component == other.component and {mine.kind, other.kind} <= {"position", "region"}
        return not same_angle and not same_shape and (other.direct or not mine.direct)

    @property
    def of_every_machine(self) -> list[int]:
        """Usable candidates of what every machine has, in components that the readings show directly."""
        all_of_them = enumerate(self.candidates)
        return [i for i, c in all_of_them if every_machine_has(c.term.effect) and c.direct and self.usable[i]]

    def of_own_sensors(self) -> "HeldOutTable":
        """The same table, in which nothing grows along an axis by a sensor that is not the axis' own."""
        other = copy.copy(self)
        other.usable = self.usable & np.array([not c.away for c in self.candidates])
        return other

    def of_what_is_shown(self) -> "HeldOutTable":
        """The same table with only components that the readings show directly, none behind a lever arm."""
        other = copy.copy(self)
        other.usable = self.usable & np.array([c.direct for c in self.candidates])
        return other

    def constant(self, i: int) -> int | None:
        """The usable candidate with a temperature's shape at constant temperature; None where there is none."""
        shape = at_constant_temperature(self.candidates[i], self.candidates)
        k = None if shape is None else list(self.candidates).index(shape)
        return k if k is not None and self.usable[k] else None

    def _of_speed(self, i: int) -> tuple[str, str] | None:
        """Component and kind of a candidate that depends on a power of a speed; None for others."""
        candidate = self.candidates[i]
        return (candidate.component, candidate.kind) if candidate.kind in ("speed", "velocity") else None

    def _features(self, chosen: Sequence[int]) -> dict[str, set[str]]:
        out: dict[str, set[str]] = {}
        for i in chosen:
            if self.candidates[i].feature:
                out.setdefault(self.candidates[i].component, set()).add(self.candidates[i].feature)
        return out

    def _room(self, i: int, features: dict[str, set[str]]) -> bool:
        """Whether a component may depend on this candidate's feature, too."""
        candidate = self.candidates[i]
        there = features.get(candidate.component, set())
        return not candidate.feature or candidate.feature in there or len(there) < self.most_features

    def _cancels(self, i: int, drives: Sequence[Drive]) -> bool:
        """Whether a choice already has one of the drives of which it may have only one, this candidate's included."""
        mine = self.drives[i]
        return any(mine in only and not only.isdisjoint(drives) for only in self.single)

    def _index(self, chosen: Sequence[int]) -> Ints:
        parts = [self.columns[i] for i in sorted(chosen)]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)


def _plain(candidate: TermCandidate) -> bool:
    turns = component_unit(candidate.component) == "urad"
    bent = getattr(candidate.term.effect, "degrees", None) == ((TWIST if turns else BEND),)
    return candidate.effect in PLAIN or bent


def _shown(normal: Normal, columns: Sequence[Ints], offered: Bools) -> tuple[Bools, dict[int, list[int]]]:
    """Whether the readings show each candidate, and its column is not that of an earlier one (offered ones are first).

    And for each of these candidates the ones with the same column.
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
    """Whether the readings separate a candidate's columns from each other and from the nuisance parameters."""
    if len(own) < 2:
        return True
    left = residual_gram(normal, own)
    size = np.sqrt(np.maximum(np.diag(left), 1e-300))
    part = np.linalg.eigvalsh(left / np.outer(size, size))
    return bool(part[0] > TOGETHER * part[-1])


MOST_TERMS = 40
PAYS = 0.002
"""A step counts as progress if the held-out error falls by at least this share."""
PATIENCE = 2
"""The search ends after this many steps without progress."""
SIMPLER = 0.005
"""If held-out errors of candidates differ by less than this share, the simplest one is chosen."""
SWAPS = 3
OWN = 2.0
"""Standard errors by which a sensor that is named after another axis must be better than one of the axis itself."""
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
    """One step of the search: what was added, the number of terms, and the errors in sample and held out, in units of
    the rough noise.
    """

    label: str
    terms: int
    inside: float
    held_out: float


@dataclass(frozen=True)
class TermChoice:
    """Result of a choice.

    Attributes:
        chosen: indices of the chosen candidates.
        steps: steps of the search.
        held_out: root mean square on held-out blocks, in units of the rough noise.
        rivals: alternatives that are as good.
        confounded: effects that are confounded with chosen ones, see `HeldOutTable.confounded`.
    """

    chosen: tuple[int, ...]
    steps: tuple[ChoiceStep, ...]
    held_out: float
    rivals: tuple[UndecidedTerm, ...]
    confounded: tuple[tuple[int, int, int, float], ...]


def choose(
    normal: Normal,
    candidates: Sequence[TermCandidate],
    forced: Sequence[int] = (),
    progress: Progress | None = None,
    single: Sequence[frozenset[Drive]] = (),
) -> TermChoice:
    """Choose among candidates by their held-out errors; forced ones always stay.

    Args:
        normal: normal equations of all candidates.
        candidates: the candidates.
        forced: indices of candidates that must be in the choice.
        progress: callback, called with the number of steps done and in total.
        single: drives of which a choice may have only one, because two of them cancel.
    """
    table = HeldOutTable(normal, candidates, single)
    forced = independent(normal, [table.columns[i] for i in forced], forced)
    path, steps = _forward(table, forced, "what was asked for", progress)
    chosen = _settled(table, path, forced)
    for among, start in _other_starts(table, chosen, forced):
        other_path, other_steps = _forward(among, start, "what every machine has", progress)
        other = _settled(among, other_path, forced)
        if _prior(table, other, chosen):
            chosen, steps = other, other_steps
    chosen = _by_own_sensors(table, chosen, forced)
    chosen = _by_every_machine(table, chosen, forced)
    return _judged(table, chosen, steps)


def completed(
    normal: Normal,
    candidates: Sequence[TermCandidate],
    choice: TermChoice,
    files: int,
    single: Sequence[frozenset[Drive]],
) -> TermChoice:
    """A choice without the length of a ball bar, completed by what every machine has, its servos, and how it grows.

    Args:
        normal: normal equations of all candidates, of readings of known length.
        candidates: the candidates.
        choice: the choice without the length; what not every machine has stays as it is there.
        files: number of measurements.
        single: as of `choose`.
    """
    table = HeldOutTable(normal, candidates, single)
    plain = np.array([_shown_by_length(c, files) for c in candidates])
    odd = [i for i in choice.chosen if not plain[i]]
    among = copy.copy(table)
    among.usable = table.usable & plain

    def with_plain(kept: list[int]) -> tuple[list[int], list[ChoiceStep]]:
        path, steps = _forward(among, kept, "shapes chosen without the length of the bar", None)
        return _settled(among, path, kept), steps

    kept = independent(normal, [table.columns[i] for i in odd], odd)
    chosen, steps = with_plain(kept)
    for i in [i for i in kept if not candidates[i].feature]:
        fewer = [k for k in kept if k != i]
        other, there = with_plain(fewer)
        if one_standard_error(table.errors(other), table.errors(chosen)):
            kept, chosen, steps = fewer, other, there
    return _judged(table, _by_own_sensors(table, chosen, []), steps)


def _shown_by_length(one: TermCandidate, files: int) -> bool:
    """Whether the length of a ball bar shows it: what every machine has, servos, growth by an axis' own sensor.

    Two files have one difference, which the bar itself makes as well.
    """
    effect = one.term.effect
    if isinstance(effect, AxisExpansion):
        along = effect.component[1] == effect.component[2]
        return files > FEW_FILES and along and on_part(effect.component[2:], [effect.sensor])
    return every_machine_has(effect) or one.effect in SERVOS


def _judged(table: HeldOutTable, chosen: list[int], steps: Sequence[ChoiceStep]) -> TermChoice:
    held_out = float(np.sqrt(table.held_out(chosen)))
    rivals, same = find_rivals(table, chosen), table.confounded(chosen)
    return TermChoice(tuple(sorted(chosen)), tuple(steps), held_out, tuple(rivals), tuple(same))


def _settled(table: HeldOutTable, path: Sequence[list[int]], forced: list[int]) -> list[int]:
    """The smallest good choice of a path, its unnecessary terms dropped, each term exchanged for a better one."""
    chosen = _smallest_good(table, path)
    chosen = _drop(table, chosen, forced, table.errors(_best(table, path)))
    for _ in range(SWAPS):
        better = _joined(table, _swapped(table, chosen, forced), forced)
        if set(better) == set(chosen):
            break
        best = min((table.errors(c) for c in (better, _best(table, path))), key=np.sum)
        chosen = _drop(table, better, forced, best)
    return chosen


def _other_starts(
    table: HeldOutTable, chosen: list[int], forced: list[int]
) -> Iterator[tuple[HeldOutTable, list[int]]]:
    """What every machine has; the same with the axis' own sensors, and no others, where the choice follows others; and
    with nothing behind a lever arm, where something is.

    A search that adds one term at a time may find one that stands for several, and then adds what mends it: a tilt for
    the growth of two directions, each with its own delay.
    """
    both = [*forced, *(i for i in table.of_every_machine if i not in forced)]
    start = _without_harm(table, independent(table.normal, [table.columns[i] for i in both], both), forced)
    if not set(start) <= set(chosen):
        yield table, start
    own, among = list(start), table.of_own_sensors()
    for i in chosen:
        if table.candidates[i].away and i not in forced and (near := _of_own(among, own, i)):
            own.append(near[int(np.argmin(table.held_out_beside(own, near)))])
    if len(own) > len(start):
        yield among, own
    if any(not table.candidates[i].direct for i in chosen):
        yield table.of_what_is_shown(), forced


def _without_harm(table: HeldOutTable, start: list[int], forced: list[int]) -> list[int]:
    """A start without what raises the error on held-out runs, such as a backlash that few readings show."""
    fewer = [[j for j in start if j != i] for i in start if i not in forced]
    best = min(fewer, key=table.held_out, default=start)
    return _without_harm(table, best, forced) if table.held_out(best) < table.held_out(start) * (1 - PAYS) else start


def _prior(table: HeldOutTable, other: list[int], chosen: list[int]) -> bool:
    """Whether another choice goes before one.

    It is as good with the sensors of its own axes, or follows no more temperatures and speeds and has fewer shapes that
    not every machine has. Or it is better by more than one standard error, and has no more of these.
    """

    def away(c: list[int]) -> int:
        return sum(table.candidates[i].away for i in c)

    def odd(c: list[int]) -> int:
        of = [table.candidates[i] for i in c]
        return sum(not every_machine_has(k.term.effect) and not k.feature for k in of)

    def followed(c: list[int]) -> int:
        return sum(bool(table.candidates[i].feature) for i in c)

    def behind(c: list[int]) -> int:
        return sum(not table.candidates[i].direct for i in c)

    def grow(c: list[int]) -> set[str]:
        of = [table.candidates[i] for i in c]
        return {k.component for k in of if k.effect == "axis_expansion" and k.component[1] == k.component[2]}

    if not grow(other) >= grow(chosen):
        return False  # a scale of one day would take the place of what grows on every day
    better, worse = table.errors(other), table.errors(chosen)
    as_good = one_standard_error(better, worse)
    if away(other) < away(chosen):
        return as_good
    if away(other) > away(chosen) or odd(other) > odd(chosen) or followed(other) > followed(chosen):
        return False
    fewer = odd(other) < odd(chosen) or behind(other) < behind(chosen)
    return as_good if fewer else not one_standard_error(worse, better)


def _of_own(table: HeldOutTable, rest: list[int], i: int) -> list[int]:
    """Candidates with the form of one whose sensor is not of its axis, by sensors that are nearer to it."""
    form, away = _form(table.candidates[i]), table.candidates[i].away
    near = [k for k in table.shortlist(rest, len(table.candidates)) if _form(table.candidates[k]) == form]
    return [k for k in near if table.candidates[k].away < away and k not in rest]


def _by_every_machine(table: HeldOutTable, chosen: list[int], forced: list[int]) -> list[int]:
    """The choice with an error that every machine has in the place of any other one that does no better.

    One after the other, until no more can be: one shape may have stood for two of them.
    """
    for i in chosen:
        near, one = [k for k in table.of_every_machine if k not in chosen], table.candidates[i]
        if i in forced or one.feature or every_machine_has(one.term.effect) or not near:
            continue
        rest = [j for j in chosen if j != i]
        errors = table.held_out_beside(rest, near)
        if errors.min() <= table.held_out(chosen) * (1 + SIMPLER):
            return _by_every_machine(table, [*rest, near[int(np.argmin(errors))]], forced)
    return chosen


def one_standard_error(worse: Floats, better: Floats, times: float = 1.0) -> bool:
    """Whether the gain of the better choice, fold by fold, is within one standard error, or so many `times` it."""
    gain = worse - better
    spread = np.std(gain, ddof=1) * np.sqrt(len(gain)) if len(gain) > 1 else 0.0
    return bool(gain.sum() <= times * spread)


def independent(normal: Normal, columns: Sequence[Ints], items: Sequence[int]) -> list[int]:
    """The items, in order, whose columns the readings separate from those of the items before them."""
    kept: list[int] = []
    index = np.zeros(0, dtype=np.int64)
    for item, own in zip(items, columns, strict=True):
        d, _, _ = residual_parts(normal, index)
        if np.all(d[own] > VISIBLE * normal.raw[own]):
            kept.append(item)
            index = np.concatenate([index, own])
    return kept


def _forward(
    table: HeldOutTable, start: list[int], label: str, progress: Progress | None
) -> tuple[list[list[int]], list[ChoiceStep]]:
    """Add one term at a time to a start, which has a label."""
    path: list[list[int]] = [start]
    steps = [_step(table, [], "nothing"), *([_step(table, start, label)] if start else [])]
    best, vain = table.held_out(start), 0
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
    """The simplest of the candidates that are as good as the best.

    A component that the readings show directly has priority over one behind a lever arm: an instrument with only one
    arm cannot distinguish an angle from a shift, though both differ elsewhere on the machine.
    """
    near = np.flatnonzero(errors <= errors.min() * (1 + SIMPLER)).tolist()
    # The first of equal ones: the order of the candidates decides, not rounding.
    ranks = [(*_complexity(table, tried[k]), round(errors[k] / errors.min(), 6), tried[k]) for k in near]
    return min(ranks)[-1]


def _complexity(table: HeldOutTable, i: int) -> tuple[bool, int, int, int, int]:
    candidate = table.candidates[i]
    return (
        not candidate.direct,
        candidate.away,
        len(table.columns[i]),
        KINDS.index(candidate.kind),
        len(candidate.term.theta),
    )


def _step(table: HeldOutTable, chosen: Sequence[int], label: str) -> ChoiceStep:
    inside, held_out = (float(np.sqrt(v)) for v in (table.inside(chosen), table.held_out(chosen)))
    return ChoiceStep(label, len(chosen), inside, held_out)


def _best(table: HeldOutTable, path: Sequence[list[int]]) -> list[int]:
    return min(path, key=table.held_out)


def _smallest_good(table: HeldOutTable, path: Sequence[list[int]]) -> list[int]:
    """The first choice of the path that is within one standard error of the best."""
    best = table.errors(_best(table, path))
    return next(c for c in path if one_standard_error(table.errors(c), best))


def _drop(table: HeldOutTable, chosen: list[int], forced: list[int], best: Floats) -> list[int]:
    """Drop the least important term while the error of the others stays within one standard error of the best."""
    while len(chosen) > len(forced):
        fewer = min(([j for j in chosen if j != i] for i in chosen if i not in forced), key=table.held_out)
        if not one_standard_error(table.errors(fewer), best):
            break
        chosen = fewer
    return chosen


def _swapped(table: HeldOutTable, chosen: list[int], forced: list[int]) -> list[int]:
    """The choice with terms exchanged one by one, where that lowers the held-out error.

    Or where a simpler shape is as good, now that the choice has terms which were added after the more complex shape.
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
    """Whether a candidate is a simpler shape than another one that consists of regions or cross-talk."""
    plain = not table.candidates[i].feature and table.candidates[k].kind in ("cross", "region")
    return plain and _complexity(table, i) < _complexity(table, k)


def _room_for_simpler(table: HeldOutTable, i: int, k: int) -> float:
    """Factor by which the held-out error may rise for a simpler shape; one where it is in another component."""
    return 1 + SIMPLER * (table.candidates[i].component == table.candidates[k].component)


def _joined(table: HeldOutTable, chosen: list[int], forced: list[int]) -> list[int]:
    """The choice with all temperatures of one component and form replaced by one, where that is as good.

    Forward selection often adds two similar temperatures instead of the right one. The right one gets the same shape at
    constant temperature beside it, because the machine may have an error at the reference temperature, too.
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


def _by_own_sensors(table: HeldOutTable, chosen: list[int], forced: list[int]) -> list[int]:
    """The choice with the sensor of the axis in the place of one that is not, where it is as good.

    The nuts of two axes that run together warm alike on this day, and on another day they do not.
    """
    for i in chosen:
        rest, away = [j for j in chosen if j != i], table.candidates[i].away
        if away and i not in forced and (near := _of_own(table, rest, i)):
            other = [*rest, near[int(np.argmin(table.held_out_beside(rest, near)))]]
            times = OWN if away > 1 else 1.0
            chosen = other if one_standard_error(table.errors(other), table.errors(chosen), times) else chosen
    return chosen


def _form(candidate: TermCandidate) -> tuple[str, str]:
    return candidate.component, candidate.effect
