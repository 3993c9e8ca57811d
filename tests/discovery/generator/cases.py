"""Which data sets there are: a case is a few words and a seed, and always gives the same numbers."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from tests.discovery.generator.campaign import KINDS
from tests.discovery.generator.noise import FORMS
from tests.discovery.generator.outside import OUTSIDE
from tests.discovery.generator.truth import Truth
from tests.discovery.generator.truths import TRUTHS

GROUPS = ("singles", "clean", "pairs", "outside", "passive")
PASSIVE_KINDS = ("laser", "straightness", "drift")
PASSIVE_TRUTHS = ("axis_expansion", "axis_expansion_nonuniform", "backlash_position", "cyclic_screw", "spindle_growth")
EVERY = {"singles": 1, "clean": 1, "pairs": 6, "outside": 3, "passive": 4}
"""A seed gives one single and one clean set of each noise; every so manieth seed the others."""


@dataclass(frozen=True)
class Case:
    """One data set.

    Attributes:
        group: of `GROUPS`.
        seed: of all chance in it.
        kind: of the campaign.
        noise: form of the drift.
        hidden: names of what is hidden, in `TRUTHS` or `OUTSIDE`.
        passive: as in production.
    """

    group: str
    seed: int
    kind: str
    noise: str
    hidden: tuple[str, ...] = ()
    passive: bool = False

    @property
    def label(self) -> str:
        """For tables."""
        return f"{self.group} {self.seed} {self.kind} {self.noise} {'+'.join(self.hidden) or 'nothing'}"

    def rng(self, what: str) -> np.random.Generator:
        """Chance of one part of it, independent of the others."""
        key = f"{self.group}|{self.kind}|{self.noise}|{'+'.join(self.hidden)}|{self.passive}|{what}"
        return np.random.default_rng([self.seed, crc32(key.encode())])

    @property
    def truths(self) -> tuple[Truth, ...]:
        """What is hidden."""
        return tuple(BY_NAME[name] for name in self.hidden)


BY_NAME = {t.name: t for t in (*TRUTHS, *OUTSIDE)}


def cases(seeds: Sequence[int], groups: Sequence[str] = GROUPS) -> Iterator[Case]:
    """All cases of some seeds, group by group."""
    for group in groups:
        for seed in seeds:
            if seed % EVERY[group] == 0:
                yield from _CASES[group](seed)


def single(seed: int, truth: Truth, noise: str | None = None) -> Case:
    """One hidden effect under a noise that the seed picks."""
    return Case("singles", seed, truth.kind, noise or FORMS[_pick(seed, truth.name, len(FORMS))], (truth.name,))


def _singles(seed: int) -> Iterator[Case]:
    yield single(seed, TRUTHS[seed % len(TRUTHS)])


def _clean(seed: int) -> Iterator[Case]:
    for i, form in enumerate(FORMS):
        yield Case("clean", seed, KINDS[(seed + i) % len(KINDS)], form)


def _pairs(seed: int) -> Iterator[Case]:
    rng = np.random.default_rng([seed, 77])
    first = TRUTHS[int(rng.integers(len(TRUTHS)))]
    fitting = [t for t in TRUTHS if t.kind == first.kind and _differ(first, t)]
    if not fitting:
        first = TRUTHS[0]
        fitting = [t for t in TRUTHS if t.kind == first.kind and _differ(first, t)]
    second = fitting[int(rng.integers(len(fitting)))]
    yield Case("pairs", seed, first.kind, FORMS[int(rng.integers(len(FORMS)))], (first.name, second.name))


def _outside(seed: int) -> Iterator[Case]:
    truth = OUTSIDE[(seed // EVERY["outside"]) % len(OUTSIDE)]
    yield Case("outside", seed, truth.kind, FORMS[_pick(seed, "noise", len(FORMS))], (truth.name,))


def _passive(seed: int) -> Iterator[Case]:
    place = seed // EVERY["passive"]
    form = FORMS[_pick(seed, "noise", len(FORMS))]
    yield Case("passive", seed, PASSIVE_KINDS[place % len(PASSIVE_KINDS)], form, (), True)
    truth = BY_NAME[PASSIVE_TRUTHS[place % len(PASSIVE_TRUTHS)]]
    yield Case("passive", seed, truth.kind, form, (truth.name,), True)


def _differ(one: Truth, two: Truth) -> bool:
    """Two that are not each other's other name, take no common place, and can be on one line."""
    if one.name == two.name or set(one.replaces) & set(two.replaces) or not set(one.axes) & set(two.axes):
        return False
    names = [{t.name, *(s.effect for s in t.same)} for t in (one, two)]
    return not names[0] & names[1]


def _pick(seed: int, what: str, count: int) -> int:
    return int(np.random.default_rng([seed, crc32(what.encode())]).integers(count))


_CASES = {"singles": _singles, "clean": _clean, "pairs": _pairs, "outside": _outside, "passive": _passive}
