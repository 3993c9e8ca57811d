"""Measurements whose scale contradicts that of the others: a cosine error of a laser, or a plate that was warm.

The scale of a measurement is what uniform growth of the machine would make of its readings. With all usual shapes in
the fit, one number must take away much of the residual, and it must come again in every part of the measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Floats
from rtec.characterise.candidates import TermCandidate
from rtec.characterise.screen import VISIBLE, residual_parts, simple
from rtec.estimation.gram.normal import Normal
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import gather
from rtec.metrology.instruments.laser import LaserLinear
from rtec.metrology.measurement import Measurement
from rtec.wording import listed, significant

Files = tuple[int, ...]

TAKES, SURE, LEAST_UM_PER_M = 0.05, 8.0, 3.0
"""Least share of the squared residual that the number takes away, least ratio to its standard error, and least size. Of
thirteen simulated campaigns without such an error the largest share was 0.031, with a cosine error of 5 mrad the least
0.084."""
OWN = 1e-3
"""Least share of the scale that the other measurements do not determine anyway."""
ALIKE = 0.9
"""Two explanations are as good where one takes away at least this share of what the other does."""
REMEDY = (
    "check the alignment of the beam (cosine error), the temperature of plate, bar or machine, and the unit; put the "
    'wrong one right, or write slope = "setup" under its [setup]'
)


@dataclass(frozen=True)
class OwnScale:
    """Measurements whose scale differs from that of the others.

    Attributes:
        files: their numbers.
        um_per_m: by how much they read more.
        alike: numbers of the others, if a scale of theirs explains it as well.
        decided: whether these are the wrong ones rather than those.
    """

    files: Files
    um_per_m: float
    alike: Files = ()
    decided: bool = True

    def message(self, measurements: Sequence[Measurement]) -> str:
        """In words, without a full stop."""
        names = listed([measurements[i].name for i in self.files])
        size = f"{significant(abs(self.um_per_m), 2)} µm/m {'more' if self.um_per_m > 0 else 'less'}"
        verbs = ("contradicts", "it reads") if len(self.files) == 1 else ("contradict", "they read")
        said = f"{names} {verbs[0]} the other measurements: {verbs[1]} {size}"
        if not self.alike:
            return said
        return f"{said}, or {listed([measurements[i].name for i in self.alike])} are the wrong ones"


def own_scale(
    sources: Sequence[Source], chosen: Sequence[TermCandidate], shapes: Sequence[TermCandidate]
) -> OwnScale | None:
    """The measurements whose scale differs most from that of the others; None where all agree.

    Args:
        sources: the measurements.
        chosen: terms of a choice; those that follow a temperature or a speed are in the fit.
        shapes: candidates, of which the usual shapes are.
    """
    measurements = [s.measurement for s in sources]
    groups = groups_of(measurements)
    base = [c for c in shapes if simple(c)] + [c for c in chosen if c.feature]
    scales = [i for i, c in enumerate(base) if c.effect == "scale"]
    if not groups or not scales:
        return None
    normal = gather(sources, [c.term for c in base])
    known = np.flatnonzero(normal.share_left() > VISIBLE)
    scaled = _with_scales(normal, np.flatnonzero(np.isin(normal.owner, scales)), groups)
    own, product, residual = residual_parts(scaled, known)
    place = normal.width + np.arange(len(groups))
    seen = own[place] > OWN * scaled.raw[place]
    takes = np.where(seen, product[place] ** 2 / np.maximum(own[place], 1e-300) / residual, 0.0)
    if takes.max() < TAKES:
        return None
    found = decide(measurements, groups, takes)
    at = normal.width + groups.index(found.files)
    value = product[at] / own[at]
    parts = [residual_parts(scaled.only(scaled.part != p), known) for p in np.unique(scaled.part)]
    without = np.array([part[1][at] / max(part[0][at], 1e-300) for part in parts])
    error = np.sqrt((len(parts) - 1) / len(parts) * np.sum((without - value) ** 2))
    return replace(found, um_per_m=value) if abs(value) >= max(LEAST_UM_PER_M, SURE * error) else None


def groups_of(measurements: Sequence[Measurement]) -> list[Files]:
    """Each measurement, and all of each instrument; without all measurements together."""
    kinds = [m.instrument.name for m in measurements]
    groups = {(i,) for i in range(len(kinds))} | {tuple(np.flatnonzero(np.array(kinds) == k).tolist()) for k in kinds}
    return sorted(g for g in groups if len(g) < len(kinds))


def decide(measurements: Sequence[Measurement], groups: Sequence[Files], takes: Floats) -> OwnScale:
    """The group whose scale takes away most, and the others that do as well.

    A laser measures lengths by its wavelength: where a plate or a bar explains it as well, that has the other scale.
    """
    alike = [g for g, t in zip(groups, takes, strict=True) if t >= ALIKE * takes.max()]
    lasers = {g: all(isinstance(measurements[i].instrument, LaserLinear) for i in g) for g in alike}
    best = min(alike, key=lambda g: (lasers[g], len(g), g))
    rivals = [g for g in alike if not {*g} & {*best}]
    others = tuple(sorted({i for g in rivals for i in g}))
    return OwnScale(best, 0.0, others, decided=all(lasers[g] and not lasers[best] for g in rivals))


def _with_scales(normal: Normal, scales: NDArray[np.intp], groups: Sequence[Files]) -> Normal:
    """Normal equations with a column more for each group: the sum of the scales' columns in its measurements."""
    width, size, count = normal.width, normal.gram.shape[1], len(groups)
    maps = np.zeros((int(normal.source.max()) + 1, size, size + count))
    maps[:, np.arange(width), np.arange(width)] = 1.0
    maps[:, np.arange(width, size), np.arange(width, size) + count] = 1.0
    for k, files in enumerate(groups):
        for i in files:
            maps[i, scales, width + k] = 1.0
    each = maps[normal.source]
    gram = each.transpose(0, 2, 1) @ normal.gram @ each
    squares = np.diag(gram.sum(axis=0))[width : width + count]
    return replace(
        normal,
        gram=gram,
        owner=np.append(normal.owner, normal.owner.max() + 1 + np.arange(count)),
        raw=np.insert(normal.raw, width, squares),
    )
