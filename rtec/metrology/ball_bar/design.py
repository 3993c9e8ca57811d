"""The design matrix of several ball-bar tests, and which parameters it separates.

The stacked design has the columns of [BB]'s parameters, to first order and exactly. Its rank shows which parameters
have no influence on the readings and which stay confounded. Beside it are the columns of the candidates beyond [BB].
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.metrology.ball_bar.beyond import ExtraCause, candidates
from rtec.metrology.ball_bar.causes import Cause, causes, tip_um
from rtec.metrology.ball_bar.circle import CircleTest

UNSEEN = 1e-9
"""A column smaller than this share of the largest counts as zero."""
ALIKE = 1e-6
"""A direction with a singular value below this share of the largest is not separated."""
IN_IT = 1e-3
"""A parameter belongs to a confounded set if its share in such a direction is larger than this."""


@dataclass(frozen=True)
class Rank:
    """Which parameters a design separates.

    Attributes:
        count: number of parameters.
        rank: number of combinations of them that the readings determine.
        never: parameters without influence on any reading.
        confounded: sets of which the readings determine only combinations.
        condition: condition number of the columns, each scaled to one, over the separated directions.
        kept: places of the parameters that a fit can have; of a confounded set the first ones.
    """

    count: int
    rank: int
    never: tuple[str, ...]
    confounded: tuple[tuple[str, ...], ...]
    condition: float
    kept: tuple[int, ...]

    @property
    def complete(self) -> bool:
        """Whether the readings determine every parameter."""
        return self.rank == self.count


def rank_of(design: Floats, names: Sequence[str]) -> Rank:
    """The rank of a design, (readings, parameters), with one name a column."""
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
    """Places of the columns that are independent of the ones before them."""
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
    """Sets of parameters that the projector on the undetermined directions connects."""
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


Centre = Literal["shared", "each"]


def unseen_of(columns: Floats) -> Floats:
    """Changes of a confounded set's parameters, (k, m), that change no reading; columns are (n, k)."""
    size = np.linalg.norm(columns, axis=0)
    _, singular, rows = np.linalg.svd(columns / size, full_matrices=False)
    return np.asarray(rows[singular <= ALIKE * singular[0]].T / size[:, None], dtype=np.float64)


def determined(columns: Floats, of: Sequence[int]) -> Floats:
    """Combinations of some parameters of a confounded set that the readings determine, (m, parameters).

    The first factor of each is one; each has as few parameters as possible.

    Args:
        columns: columns of the whole set, (readings, k).
        of: places of those parameters; the others do not occur in a combination.
    """
    size = np.linalg.norm(columns, axis=0)
    unseen = (unseen_of(columns) * size[:, None])[list(of)].T
    _, singular, rows = np.linalg.svd(unseen, full_matrices=True)
    seen = rows[int((singular > IN_IT).sum()) :]
    place = 0
    for column in range(seen.shape[1]):
        if place == len(seen):
            break
        best = place + int(np.argmax(np.abs(seen[place:, column])))
        if abs(seen[best, column]) < IN_IT:
            continue
        seen[[place, best]] = seen[[best, place]]
        seen[place] /= seen[place, column]
        others = [i for i in range(len(seen)) if i != place]
        seen[others] -= seen[others][:, [column]] * seen[place]
        place += 1
    seen[np.abs(seen) < IN_IT] = 0.0
    # The columns are scaled; dividing by the size gives factors in the parameters' units, the first one again.
    own = seen * size[list(of)]
    first = own[np.arange(len(own)), (own != 0.0).argmax(axis=1)] if len(own) else np.zeros(0)
    return np.asarray(own / first[:, None], dtype=np.float64)


SETTING_UP = "setting up"
"""Group of the causes that belong to the instrument's set-up and not to the machine."""
FLAT_MM = 1e-6
"""A bar that is inclined by less does not show the height."""


@dataclass(frozen=True)
class BarDesign:
    """The stacked design of all tests, with n readings and k parameters.

    Attributes:
        labels: the parameters, (k).
        columns: first order: reading, µm, per unit of each parameter, (n, k).
        tips: displacement of one ball relative to the other per unit, µm, (n, k, 3).
        squares: displacement per square of the unit, µm, (n, k, 3).
        bar_mm: vector from one ball to the other, (n, 3).
    """

    labels: tuple[Cause, ...]
    columns: Floats
    tips: Floats
    squares: Floats
    bar_mm: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, (k)."""
        return tuple(c.name for c in self.labels)

    def rows(self, keep: Bools) -> "BarDesign":
        """The design with only these readings, (n,)."""
        return BarDesign(self.labels, self.columns[keep], self.tips[keep], self.squares[keep], self.bar_mm[keep])

    @cached_property
    def known(self) -> tuple[int, ...]:
        """Places of the parameters with a prior uncertainty."""
        return tuple(i for i, c in enumerate(self.labels) if math.isfinite(c.prior))

    @cached_property
    def rank(self) -> Rank:
        """What readings and priors together separate; `kept` are places among all parameters."""
        free = [i for i in range(len(self.labels)) if i not in self.known]
        out = rank_of(self.columns[:, free], [self.names[i] for i in free])
        return replace(out, kept=(*(free[i] for i in out.kept), *self.known))

    @cached_property
    def by_readings(self) -> Rank:
        """What the readings alone separate, without priors."""
        return rank_of(self.columns, self.names)

    @cached_property
    def _by_parameter(self) -> Floats:
        """The tips as (k, 3 n), so that their sum is one matrix product."""
        return self.tips.transpose(1, 0, 2).reshape(len(self.labels), -1)

    @cached_property
    def _curved(self) -> Ints:
        """Places of the parameters with a term in their square."""
        return np.flatnonzero(self.squares.any(axis=(0, 2)))

    def second_order_um(self, kept: Sequence[int], values: Floats) -> Floats:
        """Exact reading minus first order, µm, (n,), at values of some of the parameters."""
        before = np.linalg.norm(self.bar_mm, axis=1)
        first, moved = self._moved_mm(kept, values)
        after = np.linalg.norm(self.bar_mm + moved, axis=1)
        exact = np.einsum("nd,nd->n", 2.0 * self.bar_mm + moved, moved) / (after + before)
        return np.asarray((exact - np.einsum("nd,nd->n", self.bar_mm, first) / before) * 1e3)

    def slopes(self, kept: Sequence[int], values: Floats) -> Floats:
        """Reading, µm, per unit of some of the parameters, (n, kept), at these values, which turn the bar."""
        before = self.bar_mm / np.linalg.norm(self.bar_mm, axis=1, keepdims=True)
        after = self.bar_mm + self._moved_mm(kept, values)[1]
        after = after / np.linalg.norm(after, axis=1, keepdims=True)
        out = np.asarray(self.columns + np.einsum("nd,nkd->nk", after - before, self.tips))
        whole = self._whole(kept, values)
        for i in self._curved:
            out[:, i] += np.einsum("nd,nd->n", after, self.squares[:, i]) * (2.0 * whole[i])
        return np.asarray(out[:, kept], dtype=np.float64)

    def _whole(self, kept: Sequence[int], values: Floats) -> Floats:
        """Values of all parameters, (k,); zero where they are not among those kept."""
        out = np.zeros(len(self.labels))
        out[list(kept)] = values
        return out

    def _moved_mm(self, kept: Sequence[int], values: Floats) -> tuple[Floats, Floats]:
        """Displacement of one ball relative to the other, to first order and with the squares, (n, 3) each."""
        whole = self._whole(kept, values)
        first = 1e-3 * (whole @ self._by_parameter).reshape(-1, 3)
        return first, first + 1e-3 * sum(self.squares[:, i] * whole[i] ** 2 for i in self._curved)


def stacked_design(of: Sequence[Cause], circles: Sequence[CircleTest]) -> Floats:
    """Columns of causes in all tests, stacked, (readings, causes), µm per unit."""
    parts = [np.stack([np.einsum("nd,nd->n", tip_um(x, c, circles[0]), c.along) for x in of], axis=1) for c in circles]
    return np.concatenate(parts)


def design_of(
    circles: Sequence[CircleTest],
    *,
    bent: bool,
    centre: Centre = "shared",
    more: Sequence[Cause] = (),
    curved: Collection[int] = (),
) -> BarDesign:
    """The design with [BB]'s parameters, heights of the ball, and the zero of a bar that was not calibrated.

    Args:
        circles: tests of one plane; shapes and arms count from the first one's centre.
        bent: use the non-linear model.
        centre: "shared": the table-side ball stays in place from test to test, as in [BB]; "each": it does not, and the
            tests then do not separate perpendicularity from its place.
        more: causes beyond [BB]'s; they follow these.
        curved: see `causes`.
    """
    of = (*causes(circles[0], bent=bent, curved=curved), *more)
    labels, tips, squares = [], [], []
    rows = np.repeat(np.arange(len(circles)), [len(c) for c in circles])
    for cause in of:
        tip = np.concatenate([tip_um(cause, c, circles[0]) for c in circles])
        square = np.concatenate([tip_um(cause, c, circles[0], square=True) for c in circles])
        for label, here in _split(cause, circles, rows, centre):
            labels.append(label)
            tips.append(np.where(here[:, None], tip, 0.0))
            squares.append(square)
    for label, tip in _heights(circles, rows):
        labels.append(label)
        tips.append(tip)
        squares.append(np.zeros_like(tip))
    bar = np.concatenate([c.bar_mm for c in circles])
    whole = np.stack(tips, axis=1)
    columns = np.einsum("nd,nkd->nk", bar / np.linalg.norm(bar, axis=1, keepdims=True), whole)
    zeros = list(_zeros(circles, rows))
    if zeros:
        labels += [label for label, _ in zeros]
        columns = np.concatenate([columns, np.stack([c for _, c in zeros], axis=1)], axis=1)
    still = np.zeros((len(bar), len(zeros), 3))
    return BarDesign(
        tuple(labels), columns, np.concatenate([whole, still], axis=1),
        np.concatenate([np.stack(squares, axis=1), still], axis=1), bar,
    )  # fmt: skip


def _split(cause: Cause, circles: Sequence[CircleTest], rows: Ints, centre: Centre) -> Iterator[tuple[Cause, Bools]]:
    """One column of the cause for all tests; for a centre offset that is not shared, one a test."""
    if cause.centre is None or centre == "shared" or len(circles) == 1:
        yield cause, np.ones(len(rows), dtype=np.bool_)
        return
    for i, circle in enumerate(circles):
        yield replace(cause, name=f"{cause.name}_{i + 1}", title=f"{cause.title}, {circle.name}"), rows == i


def _heights(circles: Sequence[CircleTest], rows: Ints) -> Iterator[tuple[Cause, Floats]]:
    """Actual minus stated height of the table-side ball, in each test with an inclined bar."""
    for i, circle in enumerate(circles):
        known_um = 1e3 * circle.setup.height_uncertainty_mm
        if known_um > 0.0 and abs(circle.setup.height_mm) > FLAT_MM:
            tip = np.zeros((len(rows), 3))
            tip[rows == i, circle.setup.rows[2]] = -1.0
            title = f"height of the table ball, {circle.name}"
            yield Cause(f"height_{i + 1}", title, "um", SETTING_UP, prior=known_um), tip


def _zeros(circles: Sequence[CircleTest], rows: Ints) -> Iterator[tuple[Cause, Floats]]:
    """Length of a bar that was not calibrated: one a test, or one a run."""
    run = np.concatenate([c.run for c in circles])
    for i, circle in enumerate(circles):
        if circle.setup.zero == "setup":
            title = f"length of the bar, {circle.name}"
            yield Cause(f"zero_{i + 1}", title, "um", SETTING_UP), np.where(rows == i, 1.0, 0.0)
        elif circle.setup.zero == "run":
            for number in np.unique(circle.run):
                title = f"length of the bar, {circle.name}, run {number}"
                here = np.where((rows == i) & (run == number), 1.0, 0.0)
                yield Cause(f"zero_{i + 1}_{number}", title, "um", SETTING_UP), here


APART = 0.1
"""A cause is not separated from the others if less than this share of its columns is independent of theirs."""
UNSEEN_UM = 1e-6
"""A parameter has no influence if one unit of it changes every reading by less than this."""
PART_OF = 0.3
"""A parameter is named as a twin if its part is larger than this share of the largest part."""


@dataclass(frozen=True)
class NotLookedFor:
    """A cause that these tests cannot show.

    Attributes:
        candidate: the cause.
        why: the reason, in words.
        twins: names of the causes from which it is not separated; none where it has no influence on the readings.
        parts: sizes of known parameters, by name, that give the same readings as one unit of it.
        rival: it explains the readings as well as its twins, which are named, in their place.
    """

    candidate: ExtraCause
    why: str
    twins: tuple[str, ...] = ()
    parts: Mapping[str, float] = field(default_factory=dict)
    rival: bool = False

    def goes_into(self, factors: Mapping[str, float]) -> bool:
        """Whether it changes a determined combination of parameters, given by factors by name."""
        terms = [factor * self.parts.get(name, 0.0) for name, factor in factors.items() if name in self.twins]
        return abs(sum(terms)) > IN_IT * max((abs(t) for t in terms), default=0.0)


@dataclass(frozen=True)
class CandidateTable:
    """Columns of [BB]'s parameters and of the candidates in several tests.

    Attributes:
        circles: the readings that are used.
        design: [BB]'s non-linear model; no candidate gets what it can explain.
        separated: candidates that influence the readings and are separated from the others.
        columns: columns of each of them, for each distance to the top of a spike, (n, k).
        left_out: the other candidates.
    """

    circles: tuple[CircleTest, ...]
    design: BarDesign
    separated: tuple[ExtraCause, ...]
    columns: tuple[tuple[Floats, ...], ...]
    left_out: tuple[NotLookedFor, ...]

    @cached_property
    def base(self) -> Floats:
        """Columns of [BB]'s parameters and the set-up that the readings alone separate, (n, k)."""
        return self.design.columns[:, list(self.design.by_readings.kept)]


def table_of(circles: Sequence[CircleTest], centre: Centre) -> CandidateTable:
    """Compute the columns, and which candidates are separated."""
    design = design_of(circles, bent=True, centre=centre)
    rank = design.by_readings
    known = design.columns[:, list(rank.kept)]
    names = [design.names[i] for i in rank.kept]
    basis = np.linalg.qr(known / _sizes(known))[0]
    separated, columns, left_out = [], [], []
    for candidate in candidates(circles):
        if candidate.missing:
            left_out.append(NotLookedFor(candidate, candidate.missing))
            continue
        ways = candidate.ways_mm or (0.0,)
        own = tuple(stacked_design(candidate.make(way), circles) for way in ways)
        seen = own[len(own) // 2]
        if np.abs(seen).max() < UNSEEN_UM:
            left_out.append(NotLookedFor(candidate, _unseen(candidate, circles)))
            continue
        share, left = _beside(basis, seen)
        if share < APART:
            parts = np.linalg.lstsq(known / _sizes(known), seen / _sizes(seen), rcond=None)[0]
            like = (candidate.like,) if candidate.like else ()
            twins = like or _twins(np.abs(parts).max(axis=1), names, rank)
            same = dict(zip(names, (parts[:, 0] / _sizes(known)).tolist(), strict=True))
            why = f"not separated from {' and '.join(twins)}"
            left_out.append(NotLookedFor(candidate, why, twins, same, rival=bool(like)))
        else:
            separated.append(candidate)
            columns.append(own)
            known = np.concatenate([known, seen], axis=1)
            basis = np.concatenate([basis, np.linalg.qr(left)[0]], axis=1)
            names += [candidate.name] * seen.shape[1]
    return CandidateTable(tuple(circles), design, tuple(separated), tuple(columns), tuple(left_out))


def independent_share(known: Floats, own: Floats) -> float:
    """Smallest share of a combination of columns, (n, k), that is independent of known columns."""
    return _beside(np.linalg.qr(known / _sizes(known))[0], own)[0]


def _beside(basis: Floats, own: Floats) -> tuple[float, Floats]:
    """Smallest share of a combination of columns, (n, k), that an orthonormal basis lacks; and the scaled remainder."""
    scaled = own / _sizes(own)
    left = scaled - basis @ (basis.T @ scaled)
    left = left - basis @ (basis.T @ left)
    whole, rest = (np.linalg.eigvalsh(x.T @ x) for x in (scaled, left))
    return float(np.sqrt(max(rest[0], 0.0) / whole[-1])), left


def with_setup(circle: CircleTest, **changes: float | str) -> CircleTest:
    """A copy of a test with some keys of its set-up changed."""
    setup = circle.setup.model_copy(update=changes)
    travel = (setup.sense * np.rad2deg(circle.angle_rad) - setup.sense * setup.start_deg) % 360.0
    return CircleTest(
        circle.name, circle.machine, replace(circle.instrument, setup=setup), circle.angle_rad, travel,
        circle.reading_um, circle.run,
    )  # fmt: skip


def _unseen(candidate: ExtraCause, circles: Sequence[CircleTest]) -> str:
    flat = all(abs(c.setup.height_mm) < 1e-9 for c in circles)
    if candidate.effect == "backlash" and flat:
        return "the bar lies flat: a test with a height shows it"
    return "no reading sees it"


def _twins(parts: Floats, names: Sequence[str], rank: Rank) -> tuple[str, ...]:
    """Names of the parameters with the largest parts."""
    found = [n for n, part in zip(names, parts, strict=True) if part > PART_OF * parts.max()]
    alike = [n for n in found for group in rank.confounded if n in group for n in group]
    return tuple(dict.fromkeys([*found, *alike]))


def _sizes(columns: Floats) -> Floats:
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(np.where(size > 0.0, size, 1.0), dtype=np.float64)
