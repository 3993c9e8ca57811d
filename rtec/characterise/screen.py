"""Correlates each component error with every temperature, difference and lag, and keeps those worth a try [G 3.6]."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.candidates import TermCandidate, catalogue, extended, geometry, thermal
from rtec.effects import effect_class
from rtec.effects.base import component_kind
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.source import Source, reads, thinned, varying_sensors
from rtec.estimation.gram.stream import gather
from rtec.estimation.visible import VisibleComponent, read_directly, visible_components
from rtec.machine import Machine

Floats = NDArray[np.float64]

READINGS = 20_000
"""Choosing uses about so many instants of each measurement at most."""
COLUMNS = 600
"""Candidates that go on to the choice, all components together."""
LEAST = 24
"""And at least so many for each component."""
VISIBLE = 1e-6
"""A column of which geometry and nuisances leave less than this share is not seen."""
BASE_DEGREE = 2
STRAIGHT = ("scale", "squareness")
ALONG = ("position", "direction", "region", "cyclic")
"""Kinds of candidates that are a shape along the axis."""


@dataclass(frozen=True)
class Correlation:
    """How a candidate goes with a component error, once geometry and nuisances are taken out of both.

    Attributes:
        candidate: which.
        r: correlation, -1 … 1.
        left: share of the candidate's own sum of squares that geometry and nuisances leave.
        kept: whether it goes on to the choice.
    """

    candidate: TermCandidate
    r: float
    left: float
    kept: bool = False


@dataclass(frozen=True)
class Screened:
    """What goes on to the choice.

    Attributes:
        sources: the measurements, thinned, blocks by fold.
        seen: component errors that can be seen.
        candidates: geometry of all, and what was kept.
        correlations: of each component with every candidate that depends on temperature or speed, best first.
        unused: sensors that are no candidates, and why, in words.
    """

    sources: tuple[Source, ...]
    seen: tuple[VisibleComponent, ...]
    candidates: tuple[TermCandidate, ...]
    correlations: tuple[Correlation, ...]
    unused: tuple[str, ...]


def screen(
    sources: Sequence[Source], allowed: Sequence[str] | None = None, known: Sequence[TermCandidate] = ()
) -> Screened:
    """Find the candidates of every component error that the measurements can see.

    Args:
        sources: measurements.
        allowed: names of the effects that may be candidates; None for all.
        known: what an earlier choice found. All of it stays a candidate. What it found in other components is taken
            out before a component is looked at. Other effects of its temperatures are rivals, and cannot be chosen.
    """
    few = [thinned(s, READINGS) for s in sources]
    whole = [replace(s, blocks=s.blocks.one) for s in few]
    seen = visible_components([s.measurement for s in few])
    sensors, unused = varying_sensors(few)

    shown = read_directly([s.measurement for s in few])

    def known_direct(candidates: Iterable[TermCandidate]) -> list[TermCandidate]:
        return [replace(c, direct=c.component in shown) for c in candidates]

    shapes = known_direct(c for s in seen for c in (*geometry(s, few), *extended(s, few)))
    # Of shapes that are the same to these readings the first is taken: a straight line has its own name first.
    shapes.sort(key=lambda c: c.effect not in STRAIGHT)
    warm = known_direct(c for s in seen for c in thermal(s, few, sensors))
    if allowed is not None:
        where = _asked_components(allowed, [*shapes, *warm], shown, few[0].measurement.machine)
        shapes, warm = ([c for c in part if c.component in where.get(c.effect, ())] for part in (shapes, warm))
    budget = max(LEAST, (COLUMNS - len(shapes)) // max(len(seen), 1))
    kept: list[TermCandidate] = []
    table: list[Correlation] = []
    others = known_direct(catalogue(few, allowed, {c.effect for c in shapes}))
    for component in seen:
        hot = [c for c in warm if c.component == component.name]
        hot += [c for c in others if c.component == component.name and c not in hot]
        if hot:
            base = [c for c in shapes if _simple(c)]
            base += [c for c in known if c.feature and c.component != component.name]
            found = _correlate([s for s in whole if reads(s, component.name)], base, hot)
            best = _best(found, budget) | {i for i, c in enumerate(found) if c.candidate in known}
            kept += [found[i].candidate for i in sorted(best)]
            # What goes with the temperature of something known may be another name for it.
            drives = {c.feature for c in known if c.feature}
            also = [c.candidate for i, c in enumerate(found) if i not in best and c.candidate.feature in drives]
            kept += [replace(c, offered=False) for c in also]
            marked = [replace(c, kept=i in best) for i, c in enumerate(found)]
            table += sorted(marked, key=lambda c: -abs(c.r))
    return Screened(tuple(few), tuple(seen), (*shapes, *kept), tuple(table), tuple(unused))


def _asked_components(
    names: Sequence[str], candidates: Sequence[TermCandidate], shown: Mapping[str, bool], machine: Machine
) -> dict[str, set[str]]:
    """Components for which an effect that was asked for by its name alone is a candidate.

    Those that a file names, and of those that the readings show directly the ones that the effect usually feeds, of
    a shape along an axis the positioning before the straightness; where there is none, all that they show directly.
    So `scale,backlash` is no model of every deviation across the axes, nor of every angle that reaches the reading
    through an arm. An effect that is only seen through arms (`squareness`) asks for the whole chain: there all
    components are candidates for all.
    """
    able = {name: {c.component for c in candidates if c.effect == name} for name in names}
    if any(found and not found & set(shown) for found in able.values()):
        return able
    out = {}
    for name in names:
        direct, usual = able[name] & set(shown), effect_class(name, "fit").feeds
        if "positioning" in usual and any(c.kind in ALONG for c in candidates if c.effect == name):
            usual = ("positioning",)
        out[name] = {c for c in direct if shown[c] or component_kind(c, machine) in usual} or direct
    return out


def _simple(candidate: TermCandidate) -> bool:
    degrees = getattr(candidate.term.effect, "degrees", (0,))
    return candidate.offered and candidate.kind in ("position", "direction") and max(degrees) <= BASE_DEGREE


def _correlate(
    sources: Sequence[Source], base: Sequence[TermCandidate], hot: Sequence[TermCandidate]
) -> list[Correlation]:
    normal = gather(sources, [c.term for c in (*base, *hot)], by_fold=True)
    first = int(np.searchsorted(normal.owner, len(base)))
    shown = np.flatnonzero(normal.share_left()[:first] > VISIBLE)
    d, e, left = residual_parts(normal, shown)
    size = np.sqrt(np.maximum(d * left, 1e-300))
    share = d / np.where(normal.raw[: normal.width] > 0, normal.raw[: normal.width], 1.0)
    out = []
    for i, candidate in enumerate(hot):
        k = first + i
        r = float(np.clip(e[k] / size[k], -1.0, 1.0)) if share[k] > VISIBLE else 0.0
        out.append(Correlation(candidate, r, float(max(share[k], 0.0))))
    return out


def residual_parts(normal: Normal, base: NDArray[np.int64]) -> tuple[Floats, Floats, float]:
    """What the base (and the explicit nuisances) leaves of each column and of the readings.

    Returns:
        Sum of squares of what is left of each column, its product with what is left of the readings, and the sum of
        squares of the latter.
    """
    total, width = normal.total, normal.width
    index = np.concatenate([base, np.arange(width, len(total) - 1)]).astype(np.int64)
    inner = total[np.ix_(index, index)]
    scale = np.sqrt(np.where(np.diag(inner) > 0, np.diag(inner), 1.0))
    inverse = np.linalg.pinv(inner / np.outer(scale, scale), rcond=1e-11, hermitian=True) / np.outer(scale, scale)
    cross = total[index][:, :width]
    fitted = inverse @ cross
    right = total[index, -1]
    d = np.diag(total)[:width] - np.einsum("ij,ij->j", cross, fitted)
    e = total[:width, -1] - fitted.T @ right
    left = float(total[-1, -1] - right @ inverse @ right)
    return np.maximum(d, 0.0), e, max(left, 1e-300)


def residual_gram(normal: Normal, columns: NDArray[np.int64]) -> Floats:
    """Products of some columns with each other once explicit nuisances are taken out."""
    total, extra = normal.total, np.arange(normal.width, len(normal.total) - 1)
    cross = total[np.ix_(extra, columns)]
    inner = total[np.ix_(columns, columns)]
    return np.asarray(
        inner - cross.T @ np.linalg.pinv(total[np.ix_(extra, extra)], rcond=1e-11, hermitian=True) @ cross
    )


def _best(found: Sequence[Correlation], budget: int) -> set[int]:
    """The best of each sensor and shape, then their second best, and so on, until the budget is spent.

    What goes without a lag always comes with its lagged forms: the simpler one must have its chance.
    """
    rank: dict[tuple[object, ...], int] = {}
    order = []
    for i in sorted(range(len(found)), key=lambda i: -abs(found[i].r)):
        c = found[i].candidate
        key = (c.channels, c.term.effect.effect)
        plain = not c.term.theta
        rank[key] = rank.get(key, 0) + (0 if plain else 1)
        order.append((1 if plain else rank[key], -abs(found[i].r), i))
    return {i for _, r, i in sorted(order)[:budget] if r < 0.0}
