"""The figures of the benchmark: from the outcomes of many sets to one line each."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tests.discovery.generator.noise import FORMS
from tests.discovery.intervals import Share, share
from tests.discovery.score import Outcome

Test = Callable[[Outcome], bool]


@dataclass(frozen=True)
class Figure:
    """One line of the table.

    Attributes:
        name: what.
        share: as counted.
        goal: lowest or highest that is wanted; None where nothing is.
        at_most: the goal is an upper one.
    """

    name: str
    share: Share
    goal: float | None = None
    at_most: bool = False

    @property
    def met(self) -> bool | None:
        """Whether the goal is met here; None where there is none, or no set."""
        if self.goal is None or not self.share.total:
            return None
        return self.share.value <= self.goal if self.at_most else self.share.value >= self.goal


def figures(outcomes: Sequence[Outcome]) -> list[Figure]:
    """All lines."""
    of = {g: [o for o in outcomes if o.case.group == g] for g in ("singles", "clean", "pairs", "outside", "passive")}
    return [
        *_singles(of["singles"]),
        *_clean(of["clean"]),
        *_pairs(of["pairs"]),
        *_outside(of["outside"]),
        *_passive(of["passive"]),
        Figure("crashed", share([bool(o.failure) for o in outcomes]), 0.0, at_most=True),
    ]


def _singles(sets: list[Outcome]) -> list[Figure]:
    claimed = [o for o in sets if o.answer.accepted]
    improved = [o for o in sets if np.isfinite(o.held_out)]
    return [
        Figure("singles: right name first", _count(sets, lambda o: o.right == 1), 0.95),
        Figure("singles: right name among three", _count(sets, lambda o: 1 <= o.right <= 3), 0.98),
        Figure("singles: claimed", _count(sets, lambda o: o.answer.accepted)),
        Figure(
            "singles: claimed, and the first name wrong", _count(sets, lambda o: o.answer.accepted and o.right != 1)
        ),
        Figure("singles: said to be without a name", _count(sets, lambda o: bool(o.answer.unknown))),
        Figure("claimed: a right name among those not told apart", _count(claimed, lambda o: o.in_group), 0.97),
        Figure("singles improved: held-out error within 1.1 × floor", _count(improved, lambda o: o.at_floor), 0.90),
    ]


def _clean(sets: list[Outcome]) -> list[Figure]:
    return [
        Figure(f"nothing hidden, {form}: an effect is claimed", _count(_noise(sets, form), _false), 0.03, at_most=True)
        for form in FORMS
    ] + [
        Figure(
            "nothing hidden, all: something without a name is claimed",
            _count(sets, lambda o: bool(o.answer.unknown) and not o.answer.accepted),
        )
    ]


def _pairs(sets: list[Outcome]) -> list[Figure]:
    added = [(o.found, o.wrong) for o in sets]
    return [
        Figure("pairs improved: both found", _count(sets, lambda o: o.found == 2), 0.85),
        Figure(
            "pairs improved: what was added is right",
            Share(sum(f for f, _ in added), sum(f + w for f, w in added)),
        ),
        Figure("pairs improved: held-out error within 1.1 × floor", _count(sets, lambda o: o.at_floor)),
    ]


def _outside(sets: list[Outcome]) -> list[Figure]:
    return [
        Figure("outside the catalogue: only true variables named", _count(sets, lambda o: o.names_true_only), 0.85),
        Figure("outside: blamed on an effect", _count(sets, lambda o: o.answer.accepted), 0.15, at_most=True),
        Figure("outside: nothing said", _count(sets, lambda o: not o.answer.accepted and not o.answer.unknown)),
    ]


def _passive(sets: list[Outcome]) -> list[Figure]:
    clean, hidden = [o for o in sets if not o.case.hidden], [o for o in sets if o.case.hidden]
    claimed = [o for o in hidden if o.answer.accepted]
    return [
        Figure("passive, nothing hidden: an effect is claimed", _count(clean, _false), 0.03, at_most=True),
        Figure("passive, hidden: claimed", _count(hidden, lambda o: o.answer.accepted)),
        Figure("passive, claimed: a right name among those not told apart", _count(claimed, lambda o: o.in_group)),
    ]


def _false(o: Outcome) -> bool:
    return o.answer.accepted


def _noise(sets: Iterable[Outcome], form: str) -> list[Outcome]:
    return [o for o in sets if o.case.noise == form]


def _count(sets: Iterable[Outcome], test: Test) -> Share:
    return share([test(o) for o in sets])


def cut(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    """Mean share of the model's held-out error that went: after improving, and with the true shapes fitted."""
    sets = [o for o in outcomes if o.case.group == "singles" and np.isfinite(o.after)]
    if not sets:
        return float("nan"), float("nan")
    own = float(np.mean([1.0 - o.after / max(o.before, 1e-9) for o in sets]))
    return own, float(np.mean([1.0 - o.oracle / max(o.before, 1e-9) for o in sets]))


def seconds(outcomes: Sequence[Outcome]) -> tuple[float, float]:
    """Median and 95th percentile of the time of one diagnosis."""
    known = [o.seconds for o in outcomes if np.isfinite(o.seconds)]
    if not known:
        return float("nan"), float("nan")
    return float(np.median(known)), float(np.percentile(known, 95))
