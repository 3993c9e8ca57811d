"""What was looked for and not found, with the smallest size that would have been seen, and what could not be seen."""

import math
from collections.abc import Sequence

import numpy as np

from rtec.diagnosis.candidates import Untried
from rtec.diagnosis.result import Absent, Finding, NotTestable
from rtec.diagnosis.screen import Projected, Screen


def untestable(untried: Sequence[Untried], found: Screen) -> tuple[NotTestable, ...]:
    """What these readings could not have shown, whatever its size, and why."""
    from rtec.effects.registry import all_effects

    kinds = all_effects()
    out: dict[tuple[str, str], NotTestable] = {}
    for u in untried:
        test = f"measure with {', '.join(kinds[u.effect].about.seen_by)}" if kinds[u.effect].about.seen_by else ""
        out.setdefault((u.effect, u.why), NotTestable(u.effect, u.component, u.why, test))
    gone = {found.candidates[i].effect.effect for i in found.absorbed}
    there = {found.candidates[v.candidate].effect.effect for v in found.variants}
    for name in sorted(gone - there):
        why = "the current model, or what the instruments cannot know, takes up everything that it would do here"
        out.setdefault(
            (name, why), NotTestable(name, "", why, "vary what drives it, at other places and in other orders")
        )
    return tuple(out.values())


def absent_ones(found: Screen, findings: Sequence[Finding], projected: Projected) -> tuple[Absent, ...]:
    """The smallest size of each effect that would have been seen, root mean square in the readings."""
    named = {(f.effect.effect, f.effect.component) for f in findings if f.group}
    n, free = float(len(projected.left)), projected.freedom
    noise = projected.squares / free
    family = math.log(max(len(found.best), 2))
    best: dict[tuple[str, str], list[float]] = {}
    readings = projected.whitener.readings
    for i, v in enumerate(found.variants):
        candidate = found.candidates[v.candidate]
        key = (candidate.effect.effect, candidate.effect.component)
        if key in named or found.best[v.candidate] != i:
            continue
        # Evidence ln m needs a gain in log likelihood of ln m + ½ (k + n_θ) ln n.
        searched = math.log(len(candidate.thetas))
        need = 2.0 * (family + searched + 0.5 * v.count * math.log(n)) * noise
        columns = readings.columns(candidate.effect, candidate.thetas[v.theta])
        plain = np.sqrt(np.mean(columns**2, axis=0))
        seen = v.size[:, 1]
        good = seen > 0
        if good.any():
            best.setdefault(key, []).append(float((math.sqrt(need) * plain[good] / seen[good]).min()))
    units = {s.unit for s in readings.series}
    unit = "um" if units == {"um"} else "urad" if units == {"urad"} else "noise"
    return tuple(Absent(e, c, float(np.median(sizes)), unit) for (e, c), sizes in sorted(best.items()))
