"""Effects that are ruled out, with the smallest size that would have been detected, and effects that are untestable."""

import math
from collections.abc import Sequence

import numpy as np

from rtec.diagnosis import words
from rtec.diagnosis.result import Absent, Finding, NotTestable
from rtec.diagnosis.search.screen import Screen
from rtec.estimation.candidates import Untried
from rtec.estimation.floor import unit_of
from rtec.estimation.gls import bic_cost

SURE = math.log(20.0)
"""Log odds required beyond the prior odds of any effect at all."""
ALPHA = 0.05
"""Accepted false-positive rate, family-wise, by default."""
HARDLY = 3.0
"""An effect that would be detected only from this many times its usual size on could not be checked."""


def untestable(untried: Sequence[Untried], found: Screen) -> tuple[NotTestable, ...]:
    """Effects that these readings could not have shown at any size, and why."""
    from rtec.effects.registry import all_effects

    kinds = all_effects()
    out: dict[tuple[str, str], NotTestable] = {}
    for u in untried:
        kind = kinds.get(u.effect)
        test = f"measure with {', '.join(kind.about.seen_by)}" if kind is not None and kind.about.seen_by else ""
        out.setdefault((u.effect, u.why), NotTestable(u.effect, u.component, u.why, test))
    gone = {found.candidates[i].effect.effect for i in found.absorbed}
    there = {found.candidates[v.candidate].effect.effect for v in found.variants}
    for name in sorted(gone - there):
        why = "the current model, or what the instruments cannot know, takes up everything that it would do here"
        out.setdefault(
            (name, why), NotTestable(name, "", why, "vary what drives it, at other places and in other orders")
        )
    return tuple(out.values())


def significant(found: Screen, prior_odds: float) -> list[int]:
    """Significant candidates, best first.

    Args:
        found: the evidence of all candidates.
        prior_odds: log of the prior odds of "nothing" against any one effect.
    """
    return [i for i in found.order if found.score[i] > prior_odds + SURE]


def absent_effects(
    screens: Sequence[Screen], findings: Sequence[Finding], prior_odds: float
) -> tuple[tuple[Absent, ...], tuple[NotTestable, ...]]:
    """The smallest size of each effect that would have been detected, root mean square in the readings.

    An effect that is significant in any of the screens is not absent, whatever was named before it.

    Args:
        screens: of all candidates; the last has the named effects in its model and the best noise estimate.
        findings: the named effects.
        prior_odds: log of the prior odds of "nothing" against any one effect.

    Returns:
        Effects that are ruled out; and effects that would show only if they were far larger than usual.
    """
    detected = [(found, i) for found in screens for i in significant(found, prior_odds)]
    there = {(found.candidates[i].effect.effect, found.candidates[i].effect.component) for found, i in detected}
    there |= {(f.effect.effect, f.effect.component) for f in findings if f.group}
    found, best, usual = screens[-1], dict[tuple[str, str], list[float]](), dict[tuple[str, str], float]()
    projected = found.projected
    n = float(len(projected.left))
    noise = projected.squares / projected.freedom
    family = math.log(max(len(found.best), 2))
    readings = projected.whitener.readings
    unit, scale = unit_of(readings), np.ones(len(readings.series))
    if unit == "noise":
        scale /= np.maximum(projected.whitener.floor, 1e-12)
    for i, v in enumerate(found.variants):
        candidate = found.candidates[v.candidate]
        key = (candidate.effect.effect, candidate.effect.component)
        if key in there or found.best[v.candidate] != i:
            continue
        # Evidence ln m needs a gain in log likelihood of ln m + ½ (k + n_θ) ln n.
        searched = math.log(len(candidate.thetas))
        need = 2.0 * (family + searched + bic_cost(v.count, n)) * noise
        plain = np.sqrt(v.squares @ scale**2 / len(readings))
        seen = v.size[:, 1]
        good = seen > 0
        if good.any():
            best.setdefault(key, []).append(float((math.sqrt(need) * plain[good] / seen[good]).min()))
            typical = np.array([p.typical for p in candidate.effect.coefficients(readings.machine)])
            usual[key] = max(usual.get(key, 0.0), float((plain * typical)[good].max()))
    sizes = {key: float(np.median(values)) for key, values in sorted(best.items())}
    hidden = {key for key, size in sizes.items() if size > HARDLY * usual[key]}
    absent = tuple(Absent(*key, size, unit) for key, size in sizes.items() if key not in hidden)
    return absent, tuple(_hardly(key, sizes[key], usual[key], unit) for key in sizes if key in hidden)


def _hardly(key: tuple[str, str], size: float, usual: float, unit: str) -> NotTestable:
    why = words.hardly((usual,), (size,), unit)
    return NotTestable(*key, why, "vary what drives it more, or by itself", usual, size)
