"""Correlates each component error with every temperature, difference and lag, and keeps the best ones [G 3.6]."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from rtec.arrays import Floats, Ints
from rtec.characterise.candidates import TermCandidate, catalogue, extended, geometry, thermal
from rtec.effects import effect_class
from rtec.effects.base import component_kind
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.source import REAL_K, Source, reads, thinned, varied_k, varying_sensors
from rtec.estimation.gram.stream import gather
from rtec.estimation.visible import (
    VisibleComponent,
    behind_arm,
    lever_arms,
    lines_shown,
    moves,
    read_directly,
    visible_components,
)
from rtec.machine import Machine
from rtec.machine.chain import component_unit

READINGS = 20_000
"""Approximate largest number of instants of each measurement for the choice."""
COLUMNS = 600
"""Number of candidates for the choice, all components together."""
LEAST = 24
"""Smallest number of candidates for each component."""
VISIBLE = 1e-6
"""A column is not visible if less than this share of it is independent of geometry and nuisance parameters."""
SECOND_NAME = 0.02
"""An angle is not separated from a shift if less than this share of it is independent of the shift and of geometry."""
BASE_DEGREE = 2
STRAIGHT = ("scale", "squareness")
ALONG = ("position", "direction", "region", "cyclic")
"""Kinds of candidates with a shape along the axis."""


@dataclass(frozen=True)
class Correlation:
    """Partial correlation of a candidate with a component error, without geometry and nuisance parameters.

    Attributes:
        candidate: the candidate.
        r: correlation, -1 … 1.
        left: share of the candidate's sum of squares that is independent of geometry and nuisance parameters.
        kept: whether it is a candidate for the choice.
    """

    candidate: TermCandidate
    r: float
    left: float
    kept: bool = False


@dataclass(frozen=True)
class Screened:
    """Input of the choice.

    Attributes:
        sources: the measurements with fewer instants, blocks by fold.
        seen: component errors that influence the readings.
        candidates: geometry of all components, and the kept candidates.
        correlations: of each component with every candidate that depends on temperature or speed, best first.
        unused: why sensors are no candidates, and what to do about it, in words.
    """

    sources: tuple[Source, ...]
    seen: tuple[VisibleComponent, ...]
    candidates: tuple[TermCandidate, ...]
    correlations: tuple[Correlation, ...]
    unused: tuple[tuple[str, str], ...]


def screen(
    sources: Sequence[Source], allowed: Sequence[str] | None = None, known: Sequence[TermCandidate] = ()
) -> Screened:
    """Screen the candidates of every component error that influences the readings.

    Args:
        sources: the measurements.
        allowed: names of the effects that may be candidates; None for all.
        known: an earlier choice. All of it stays a candidate. Its terms in other components are subtracted before a
            component is screened. Other effects of its temperatures are rivals, and cannot be chosen.
    """
    few = [thinned(s, READINGS) for s in sources]
    whole = [replace(s, blocks=s.blocks.one) for s in few]
    seen = visible_components([s.measurement for s in few])
    sensors, unused = varying_sensors(few)

    shown = read_directly([s.measurement for s in few])
    direct = shown.keys() | lines_shown([s.measurement for s in few])

    def known_direct(candidates: Iterable[TermCandidate]) -> list[TermCandidate]:
        return [replace(c, direct=c.component in direct) for c in candidates]

    shapes = known_direct(c for s in seen for c in (*geometry(s, few), *extended(s, few)))
    # Of shapes that are the same at these readings the first counts: a straight line comes under its own name first.
    shapes.sort(key=lambda c: c.effect not in STRAIGHT)
    warm = known_direct(c for s in seen for c in thermal(s, few, sensors))
    if allowed is not None:
        where = _asked_components(allowed, [*shapes, *warm], shown, few[0].measurement.machine)
        shapes, warm = ([c for c in part if c.component in where.get(c.effect, ())] for part in (shapes, warm))
    else:
        warm = [c for s in seen for c in _varied_along(s, [c for c in warm if c.component == s.name], few)]
    budget = max(LEAST, (COLUMNS - len(shapes)) // max(len(seen), 1))
    kept: list[TermCandidate] = []
    table: list[Correlation] = []
    others = known_direct(catalogue(few, allowed, {c.effect for c in shapes}))
    for component in seen:
        hot = [c for c in warm if c.component == component.name]
        hot += [c for c in others if c.component == component.name and c not in hot]
        if hot:
            base = [c for c in shapes if simple(c)]
            base += [c for c in known if c.feature and c.component != component.name]
            found = _correlate([s for s in whole if reads(s, component.name)], base, hot)
            best = _best(found, budget) | {i for i, c in enumerate(found) if c.candidate in known}
            kept += [found[i].candidate for i in sorted(best)]
            # A candidate with the temperature of a known term may be the same effect under another name.
            drives = {c.feature for c in known if c.feature}
            also = [c.candidate for i, c in enumerate(found) if i not in best and c.candidate.feature in drives]
            kept += [replace(c, offered=False) for c in also]
            marked = [replace(c, kept=i in best) for i, c in enumerate(found)]
            table += sorted(marked, key=lambda c: -abs(c.r))
    candidates = [*shapes, *kept]
    if allowed is None:
        # An angle that shows at one arm only would be a second name for a shift, and free of the limits of the first.
        arms = lever_arms([s.measurement for s in few])
        behind = {s.name for s in seen if behind_arm(s.name, shown, arms)}
        shifts = [c for c in warm if c.component in shown and not _turns(c)]
        twins = _second_names(whole, [c for c in shapes if simple(c)], [c for c in kept if _turns(c)], shifts)
        candidates = [replace(c, offered=False) if c.component in behind or c.label in twins else c for c in candidates]
    return Screened(tuple(few), tuple(seen), tuple(candidates), tuple(table), tuple(unused))


def _asked_components(
    names: Sequence[str], candidates: Sequence[TermCandidate], shown: Mapping[str, bool], machine: Machine
) -> dict[str, set[str]]:
    """Components for which an effect with a name only is a candidate.

    These are the components that a file names, and those that the readings show directly and that the effect usually
    feeds; for a shape along an axis positioning has priority over straightness. Where there is none, all components
    that the readings show directly. So `scale,backlash` does not become a model of every deviation across the axes, nor
    of every angle behind an arm. If a named effect is visible only through arms (`squareness`), all components are
    candidates for all effects.
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


def simple(candidate: TermCandidate) -> bool:
    """Whether it is a shape up to the quadratic one, or a reversal."""
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


def _varied_along(
    seen: VisibleComponent, warm: Sequence[TermCandidate], sources: Sequence[Source]
) -> list[TermCandidate]:
    """Candidates of a component without shapes along its axis of temperatures that hardly varied while it moved.

    Where the axis stands still, such a shape is a drift under another name.
    """
    axis = seen.axis
    there = [s for s in sources if axis is not None and reads(s, seen.name) and moves(s.measurement, axis)]
    if axis is None or not there:
        return [*warm]
    machine = sources[0].measurement.machine

    @cache
    def varied(*sensors: str) -> bool:
        return varied_k(there, *sensors) >= REAL_K

    return [c for c in warm if axis.channel not in c.term.effect.channels(machine) or varied(*c.channels)]


def _second_names(
    sources: Sequence[Source],
    base: Sequence[TermCandidate],
    angles: Sequence[TermCandidate],
    shifts: Sequence[TermCandidate],
) -> set[str]:
    """Labels of angles with a temperature that these readings do not separate from shifts with the same temperature.

    Such as of an axis that a laser reads at one lever arm while it warms up, and a ball bar at many arms at one
    temperature. A constant angle takes the difference at that temperature.
    """
    alike: dict[tuple[str, ...], list[int]] = {}
    for i, shift in enumerate(shifts, len(angles)):
        alike.setdefault(_twin(shift), []).append(i)
    pairs = np.array([(i, j) for i, angle in enumerate(angles) for j in alike.get(_twin(angle), ())])
    if not len(pairs):
        return set()
    used, at = np.unique(pairs, return_inverse=True)
    both = [*angles, *shifts]
    normal = gather(sources, [c.term for c in (*base, *(both[i] for i in used.tolist()))], by_fold=True)
    known = np.flatnonzero(normal.share_left()[: int(np.searchsorted(normal.owner, len(base)))] > VISIBLE)
    gram = residual_gram(normal, np.searchsorted(normal.owner, len(base) + np.arange(len(used))), known)
    one, other = at.reshape(-1, 2).T
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    apart = 1.0 - (gram[one, other] / size[one] / size[other]) ** 2
    return {both[i].label for i in used[one[apart < SECOND_NAME]].tolist()}


def _twin(candidate: TermCandidate) -> tuple[str, ...]:
    """What an angle and a shift have in common that may be the same at some readings."""
    return candidate.effect, candidate.component[2:], candidate.feature


def _turns(candidate: TermCandidate) -> bool:
    return component_unit(candidate.component) == "urad"


def residual_parts(normal: Normal, base: Ints) -> tuple[Floats, Floats, float]:
    """Residuals of each column and of the readings after a fit of the base and the explicit nuisance parameters.

    Returns:
        Sum of squares of each column's residual, its product with the readings' residual, and the sum of squares of the
        latter.
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


def residual_gram(normal: Normal, columns: Ints, base: Ints | None = None) -> Floats:
    """Gram matrix of some columns, orthogonal to a base and the explicit nuisance parameters."""
    total = normal.total
    known = np.arange(normal.width, len(total) - 1)
    known = known if base is None else np.concatenate([base, known])
    size = np.sqrt(np.maximum(np.diag(total)[known], 1e-300))
    cross = total[np.ix_(known, columns)] / size[:, None]
    inner = total[np.ix_(known, known)] / np.outer(size, size)
    return np.asarray(
        total[np.ix_(columns, columns)] - cross.T @ np.linalg.pinv(inner, rcond=1e-11, hermitian=True) @ cross
    )


def _best(found: Sequence[Correlation], budget: int) -> set[int]:
    """The best ones of each sensor and shape, then the second best, and so on, until the budget is used up.

    The form without a lag ranks with the best lagged one, so that the simpler one can be chosen.
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
