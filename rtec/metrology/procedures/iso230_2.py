"""Positioning of a linear axis after ISO 230-2: accuracy, repeatability and reversal, coverage factor 2.

x_ij: actual minus target position at target i (m of them) in cycle j (n of them); ↑ approached in the positive
direction, ↓ in the negative one. All in µm. Figures that need both directions are None where only one was measured.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.iso230_drift import CycleDrift, cycle_drift

Floats = NDArray[np.float64]
SAME_PHASE = 0.02
"""Targets whose place within the pitch differs by less than this share of it see the periodic error alike."""


@dataclass(frozen=True)
class Visits:
    """Deviations at the targets of one axis.

    Attributes:
        name: file, or what it is called.
        target_mm: (m,), rising.
        up_um, down_um: deviations by direction of approach, (m, n); NaN where a reading is missing; a direction that
            was not measured is all NaN.
        notes: what was left out or is unusual, in words.
    """

    name: str
    target_mm: Floats
    up_um: Floats
    down_um: Floats
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class OneWay:
    """Figures of one direction of approach, µm.

    Attributes:
        mean_um: x̄_i = Σ_j x_ij / n, (m,).
        s_um: s_i = sqrt( Σ_j (x_ij - x̄_i)² / (n - 1) ), (m,).
        R_i_um: R_i = 4 s_i, (m,).
        E_um: systematic deviation, max x̄_i - min x̄_i.
        R_um: repeatability, max R_i.
        A_um: accuracy, max(x̄_i + 2 s_i) - min(x̄_i - 2 s_i).
    """

    mean_um: Floats
    s_um: Floats
    R_i_um: Floats
    E_um: float
    R_um: float
    A_um: float


@dataclass(frozen=True)
class TwoWay:
    """Figures of both directions together, µm.

    Attributes:
        mean_um: x̄_i = (x̄_i↑ + x̄_i↓) / 2, (m,).
        B_i_um: reversal at a target, x̄_i↑ - x̄_i↓, (m,).
        B_um: reversal of the axis, max |B_i|.
        B_mean_um: Σ B_i / m, with its sign.
        M_um: mean systematic deviation, max x̄_i - min x̄_i.
        E_um: systematic deviation, max(x̄_i↑, x̄_i↓) - min(x̄_i↑, x̄_i↓) over all targets and both directions.
        R_i_um: max(2 s_i↑ + 2 s_i↓ + |B_i|, R_i↑, R_i↓), (m,).
        R_um: max R_i.
        A_um: max(x̄_i↑ + 2 s_i↑, x̄_i↓ + 2 s_i↓) - min(x̄_i↑ - 2 s_i↑, x̄_i↓ - 2 s_i↓).
    """

    mean_um: Floats
    B_i_um: Floats
    B_um: float
    B_mean_um: float
    M_um: float
    E_um: float
    R_i_um: Floats
    R_um: float
    A_um: float


@dataclass(frozen=True)
class Positioning:
    """The result for one axis; `warnings` are sentences for the user."""

    visits: Visits
    up: OneWay | None
    down: OneWay | None
    both: TwoWay | None
    drift: CycleDrift | None
    warnings: tuple[str, ...]


def positioning(visits: Visits, pitch_mm: float | None = None) -> Positioning:
    """Give the figures of ISO 230-2, the drift between cycles, and warnings.

    Args:
        visits: deviations; every target needs two readings at least in a direction that was measured.
        pitch_mm: of the screw or scale; None where there is none or it is not known.

    Raises:
        MeasurementError: no readings, or a target with fewer than two in one direction.
    """
    up, down = (one_way(visits, x) for x in (visits.up_um, visits.down_um))
    if up is None and down is None:
        raise MeasurementError(f"{visits.name}: no readings")
    both = two_way(up, down) if up and down else None
    drift = cycle_drift(visits.target_mm, [x for x in (visits.up_um, visits.down_um) if not np.isnan(x).all()])
    warnings = [*visits.notes, *_few(visits), *hidden_period(visits.target_mm, pitch_mm)]
    if both is None:
        warnings.append("Only one direction of approach was measured: no reversal value and no bidirectional figures.")
    if drift is None:
        warnings.append("Cycles are not all complete: drift between them is not told apart from repeatability.")
    return Positioning(visits, up, down, both, drift, tuple(warnings))


def one_way(visits: Visits, x_um: Floats) -> OneWay | None:
    """Figures of one direction from deviations (m, n); None where it was not measured at all."""
    known = ~np.isnan(x_um)
    if not known.any():
        return None
    count = known.sum(axis=1)
    if (count < 2).any():
        target = visits.target_mm[int(np.argmin(count))]
        raise MeasurementError(
            f"{visits.name}: target {target:g} mm has {int(count.min())} reading(s) in one direction; "
            "a standard deviation needs two, ISO 230-2 asks for five"
        )
    mean = np.nanmean(x_um, axis=1)
    s = np.nanstd(x_um, axis=1, ddof=1)
    high, low = mean + 2 * s, mean - 2 * s
    return OneWay(
        mean, s, 4 * s, float(mean.max() - mean.min()), float(4 * s.max()), float(high.max() - low.min())
    )  # fmt: skip


def two_way(up: OneWay, down: OneWay) -> TwoWay:
    """Figures of both directions together."""
    mean, reversal = (up.mean_um + down.mean_um) / 2, up.mean_um - down.mean_um
    means = np.stack([up.mean_um, down.mean_um])
    s = np.stack([up.s_um, down.s_um])
    repeat = np.max([2 * s.sum(axis=0) + np.abs(reversal), up.R_i_um, down.R_i_um], axis=0)
    return TwoWay(
        mean_um=mean,
        B_i_um=reversal,
        B_um=float(np.abs(reversal).max()),
        B_mean_um=float(reversal.mean()),
        M_um=float(mean.max() - mean.min()),
        E_um=float(means.max() - means.min()),
        R_i_um=repeat,
        R_um=float(repeat.max()),
        A_um=float((means + 2 * s).max() - (means - 2 * s).min()),
    )


SEEN_ALL_ROUND = 0.4
"""Where no larger part of the pitch is without a target, its error shows (two places leave half, three a third)."""


def hidden_period(target_mm: Floats, pitch_mm: float | None) -> list[str]:
    """Say so where the targets see one or two places of the pitch only."""
    if pitch_mm is None or len(target_mm) < 2:
        return []
    phase = np.sort(np.mod((target_mm - target_mm[0]) / pitch_mm, 1.0))
    gaps = np.diff(np.append(phase, phase[0] + 1.0))
    places = max(1, int((gaps > SAME_PHASE).sum()))
    # A dense run leaves no gap at all: it sees the whole pitch.
    if places > 2 or gaps.max() < SEEN_ALL_ROUND:
        return []
    where = "multiples of the pitch" if places == 1 else "multiples of half the pitch"
    return [
        f"Targets are {where} ({pitch_mm:g} mm) apart: error that repeats with each pitch is hidden, whatever its "
        "size. Add a dense run over one or two pitches, or targets that are no multiples."
    ]


def _few(visits: Visits) -> list[str]:
    cycles, targets = visits.up_um.shape[1], len(visits.target_mm)
    out = []
    if cycles < 5:
        out.append(f"{cycles} cycles: ISO 230-2 asks for five; s and all that contains it are less certain.")
    if targets < 5:
        out.append(f"{targets} targets: ISO 230-2 asks for five at least on an axis up to 2 m.")
    missing = sum(int(np.isnan(x).sum()) for x in (visits.up_um, visits.down_um) if not np.isnan(x).all())
    if missing:
        out.append(f"{missing} readings are missing; their targets' figures come from fewer cycles.")
    return out
