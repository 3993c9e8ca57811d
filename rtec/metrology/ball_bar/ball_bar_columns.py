"""Columns of everything that is looked for beyond [BB]'s parameters, and which of them these tests can show at all."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtec.metrology.ball_bar.beyond import Candidate, candidates
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.design import Centre, Design, design_of, stacked_design
from rtec.metrology.ball_bar.rank import Rank, rank_of

Floats = NDArray[np.float64]
APART = 0.1
"""A cause of whose columns less than this share is left beside all the others is not separated from them."""
UNSEEN_UM = 1e-6
"""Readings for one unit of a parameter below which no reading sees it."""
PART_OF = 0.3
"""Share of the largest from which on a parameter is named among those that make the same."""


@dataclass(frozen=True)
class NotLookedFor:
    """A cause that these tests cannot show.

    Attributes:
        candidate: which.
        why: in words.
        twins: names of what it is not separated from; none where it cannot be seen at all.
    """

    candidate: Candidate
    why: str
    twins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Table:
    """What several tests see of [BB]'s parameters and of the candidates.

    Attributes:
        circles: readings that are used.
        design: [BB]'s non-linear model: what it can explain is not given to another cause.
        rank: of it.
        tried: candidates that are seen and separate.
        columns: of each candidate, for each way to the top of a spike, (n, k).
        left_out: the others.
    """

    circles: tuple[Circle, ...]
    design: Design
    rank: Rank
    tried: tuple[Candidate, ...]
    columns: tuple[tuple[Floats, ...], ...]
    left_out: tuple[NotLookedFor, ...]

    @cached_property
    def base(self) -> Floats:
        """Columns of [BB]'s parameters that a fit can have, (n, k)."""
        return self.design.columns[:, list(self.rank.kept)]


def table_of(circles: Sequence[Circle], centre: Centre) -> Table:
    """Work out the columns and which candidates separate."""
    design = design_of(circles, bent=True, centre=centre)
    rank = rank_of(design.columns, [c.name for c in design.labels])
    known = design.columns[:, list(rank.kept)]
    names = [design.labels[i].name for i in rank.kept]
    tried, columns, left_out = [], [], []
    for candidate in candidates(circles):
        if candidate.missing:
            left_out.append(NotLookedFor(candidate, candidate.missing))
            continue
        ways = candidate.ways_mm or (0.0,)
        own = tuple(stacked_design(candidate.make(way), circles) for way in ways)
        seen = own[len(own) // 2]
        if np.abs(seen).max() < UNSEEN_UM:
            left_out.append(NotLookedFor(candidate, _unseen(candidate, circles)))
        elif share_left(known, seen) < APART:
            twins = _twins(known, seen, names, rank)
            left_out.append(NotLookedFor(candidate, f"not separated from {' and '.join(twins)}", twins))
        else:
            tried.append(candidate)
            columns.append(own)
            known = np.concatenate([known, seen], axis=1)
            names += [candidate.name] * seen.shape[1]
    return Table(tuple(circles), design, rank, tuple(tried), tuple(columns), tuple(left_out))


def share_left(known: Floats, own: Floats) -> float:
    """Smallest share of a combination of columns, (n, k), that columns that are known do not make."""
    basis = np.linalg.qr(known / _sizes(known))[0]
    scaled = own / _sizes(own)
    left = scaled - basis @ (basis.T @ scaled)
    whole = np.linalg.svd(scaled, compute_uv=False)
    return float(np.linalg.svd(left, compute_uv=False)[-1] / whole[0])


def with_setup(circle: Circle, **changes: float | str) -> Circle:
    """A test like another one in everything but some keys of its set-up."""
    setup = circle.setup.model_copy(update=changes)
    travel = (setup.sense * np.rad2deg(circle.angle_rad) - setup.sense * setup.start_deg) % 360.0
    return Circle(
        circle.name, circle.machine, replace(circle.instrument, setup=setup), circle.angle_rad, travel,
        circle.reading_um, circle.run,
    )  # fmt: skip


def _unseen(candidate: Candidate, circles: Sequence[Circle]) -> str:
    flat = all(abs(c.setup.height_mm) < 1e-9 for c in circles)
    if candidate.effect == "backlash" and flat:
        return "the bar lies flat: a test with a height shows it"
    return "no reading sees it"


def _twins(known: Floats, own: Floats, names: Sequence[str], rank: Rank) -> tuple[str, ...]:
    """What makes the same readings, the largest parts only."""
    size = _sizes(known)
    parts = np.abs(np.linalg.lstsq(known / size, own / _sizes(own), rcond=None)[0]).max(axis=1)
    found = [n for n, part in zip(names, parts, strict=True) if part > PART_OF * parts.max()]
    alike = [n for n in found for group in rank.confounded if n in group for n in group]
    return tuple(dict.fromkeys([*found, *alike]))


def _sizes(columns: Floats) -> Floats:
    size = np.linalg.norm(columns, axis=0)
    return np.asarray(np.where(size > 0.0, size, 1.0), dtype=np.float64)
