"""Measurements whose scale contradicts that of the others: a cosine error of a laser, or a plate that was warm.

The scale of a measurement is what uniform expansion of the machine would make of its readings. With all usual shapes in
the fit, one number must take away much of the residual, and it must come again in every part of the measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rtec.characterise.candidates import TermCandidate
from rtec.characterise.screen import VISIBLE, simple
from rtec.estimation.gram.normal import PARTS, Normal
from rtec.estimation.gram.source import Source
from rtec.estimation.gram.stream import gather
from rtec.metrology.instruments.laser import LaserLinear
from rtec.metrology.measurement import Measurement
from rtec.wording import listed, significant

Floats = NDArray[np.float64]

TAKES, SURE, LEAST_UM_PER_M = 0.02, 8.0, 3.0
"""Least share of the squared residual that the number takes away, least ratio to its standard error, and least size. Of
twelve campaigns without such an error none came beyond 0.01 and 4."""
OWN = 1e-3
"""Least share of the measurement's scale that the others do not determine anyway."""
REMEDY = (
    "check the alignment of the beam (cosine error), the temperature of plate, bar or machine, and the unit; put right,"
    ' or write slope = "setup" under [setup] of the wrong one, and fit again'
)
ALIKE = 0.9
"""Two explanations are as good where one takes away at least this share of what the other does."""


@dataclass(frozen=True)
class OddScale:
    """Measurements whose scale differs from that of the others.

    Attributes:
        files: their numbers.
        um_per_m: by how much they read more.
        alike: numbers of others that explain it as well.
    """

    files: tuple[int, ...]
    um_per_m: float
    alike: tuple[int, ...]

    def message(self, measurements: Sequence[Measurement]) -> str:
        """In words, without a full stop."""
        names = listed([measurements[i].name for i in self.files])
        size = f"{significant(abs(self.um_per_m), 2)} µm/m {'more' if self.um_per_m > 0 else 'less'}"
        said = f"{names} read{'s' if len(self.files) == 1 else ''} {size} than the other measurements"
        if not self.alike:
            return said
        others = listed([measurements[i].name for i in self.alike])
        return f"{said}; it may as well be {others} with as much the other way"


def odd_scale(
    sources: Sequence[Source], chosen: Sequence[TermCandidate], shapes: Sequence[TermCandidate]
) -> OddScale | None:
    """The measurements whose scale differs most from that of the others; None where all agree.

    Args:
        sources: the measurements.
        chosen: terms of a choice; those that follow a temperature are in the fit.
        shapes: candidates, of which the usual shapes are.
    """
    measurements = [s.measurement for s in sources]
    found = _Scales.of(sources, chosen, shapes)
    if len(sources) < 2 or found is None:
        return None
    groups: set[tuple[int, ...]] = {(i,) for i in range(len(sources))}
    kinds = [m.instrument.name for m in measurements]
    groups |= {tuple(i for i, k in enumerate(kinds) if k == name) for name in kinds}
    takes = {g: found.takes(g) for g in groups if len(g) < len(sources)}
    best = max(takes.values(), default=0.0)
    if best < TAKES:
        return None
    # A laser measures lengths by its wavelength: where a plate or a bar explains it as well, that has the other scale.
    alike = sorted(g for g in takes if takes[g] >= ALIKE * best)
    odd = min(alike, key=lambda g: (all(isinstance(measurements[i].instrument, LaserLinear) for i in g), len(g), g))
    value, error = found.value(odd)
    if abs(value) < LEAST_UM_PER_M or abs(value) < SURE * error:
        return None
    return OddScale(odd, value, tuple(sorted({i for g in alike for i in g} - {*odd})))


def sized(
    odd: OddScale, sources: Sequence[Source], chosen: Sequence[TermCandidate], shapes: Sequence[TermCandidate]
) -> OddScale:
    """The same with its size by a choice that nothing misled; arguments as for `odd_scale`."""
    found = _Scales.of(sources, chosen, shapes)
    return odd if found is None else replace(odd, um_per_m=found.value(odd.files)[0])


def with_slope(measurement: Measurement) -> Measurement | None:
    """The measurement with a scale of its own, which the fit estimates; None if its instrument cannot have one."""
    setup = measurement.instrument.setup
    if getattr(setup, "slope", None) != "none":
        return None
    own = setup.model_copy(update={"slope": "setup"})
    return replace(measurement, instrument=replace(measurement.instrument, setup=own))


class _Scales:
    """What one more number, the scale of some measurements, takes away from the residual."""

    def __init__(self, normal: Normal, scale: NDArray[np.intp]) -> None:
        self._normal, self._scale = normal, scale
        width = normal.width
        known = np.flatnonzero(normal.share_left() > VISIBLE)
        self._base = np.concatenate([known, np.arange(width, len(normal.total) - 1)])
        self._part = np.zeros(len(normal.fold), dtype=np.int64)
        for s in np.unique(normal.source):
            mine = np.flatnonzero(normal.source == s)
            self._part[mine] = np.arange(len(mine)) * min(PARTS, len(mine)) // len(mine)
        self._inverse = self._inverted(normal.total)

    @classmethod
    def of(
        cls, sources: Sequence[Source], chosen: Sequence[TermCandidate], shapes: Sequence[TermCandidate]
    ) -> "_Scales | None":
        """Beside the usual shapes and what follows a temperature; None where no scale is among them."""
        base = [c for c in shapes if simple(c)] + [c for c in chosen if c.feature]
        scale = [i for i, c in enumerate(base) if c.effect == "scale"]
        if not scale:
            return None
        normal = gather(sources, [c.term for c in base])
        return cls(normal, np.flatnonzero(np.isin(normal.owner, scale)))

    def takes(self, files: tuple[int, ...]) -> float:
        """Share of the squared residual that the scale of these measurements takes away."""
        right = self._normal.total[self._base, -1]
        residual = self._normal.total[-1, -1] - right @ self._inverse @ right
        product, own, whole = self._beside(self._normal.total, self._of(files), self._inverse)
        return 0.0 if own <= OWN * whole else float(product**2 / own / max(residual, 1e-300))

    def value(self, files: tuple[int, ...]) -> tuple[float, float]:
        """The scale of these measurements beyond that of the others, µm/m, and its standard error by the parts."""
        gram = self._normal.gram
        here = np.isin(self._normal.source, files)

        def estimated(kept: NDArray[np.bool_]) -> float:
            total = gram[kept].sum(axis=0)
            product, own, _ = self._beside(total, gram[kept & here].sum(axis=0), self._inverted(total))
            return product / max(own, 1e-300)

        parts = np.unique(self._part)
        without = np.array([estimated(self._part != p) for p in parts])
        value = estimated(np.ones(len(self._part), dtype=np.bool_))
        share = (len(parts) - 1) / len(parts)
        return value, float(np.sqrt(share * np.sum((without - value) ** 2)))

    def _of(self, files: tuple[int, ...]) -> Floats:
        return np.asarray(self._normal.gram[np.isin(self._normal.source, files)].sum(axis=0))

    def _inverted(self, total: Floats) -> Floats:
        inner = total[np.ix_(self._base, self._base)]
        size = np.sqrt(np.maximum(np.diag(inner), 1e-300))
        scaled = np.linalg.pinv(inner / np.outer(size, size), rcond=1e-10, hermitian=True)
        return np.asarray(scaled / np.outer(size, size))

    def _beside(self, total: Floats, mine: Floats, inverse: Floats) -> tuple[float, float, float]:
        """Product of the column with the residual, its square beside the base, and its square."""
        column = mine[self._scale].sum(axis=0)
        whole = float(mine[np.ix_(self._scale, self._scale)].sum())
        cross = column[self._base]
        product = column[-1] - cross @ inverse @ total[self._base, -1]
        return float(product), whole - float(cross @ inverse @ cross), whole
