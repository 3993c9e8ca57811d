"""Spindle thermal drift [G 3.5]: constant speed for hours, then off overnight, at several speeds.

The record is cut into phases of constant speed; each phase is a first-order approach to a new state,
`y = start + change · (1 - exp(-t/τ))`. Radial, axial, and tilt = (radial 1 - radial 2) / distance of the probes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.errors import MeasurementError
from rtec.metrology.procedures.approach import Approach, approach

Floats = NDArray[np.float64]
SAME_SPEED = 0.02
"""Speeds closer than this share, or 10 rpm, are one phase."""
LEAST_READINGS = 12
LEAST_S = 1800.0


@dataclass(frozen=True)
class Phase:
    """A stretch of constant speed: rows `first` to before `end`."""

    first: int
    end: int
    start_h: float
    hours: float
    rpm: float


@dataclass(frozen=True)
class PhaseFit:
    """One probe in one phase, in its unit.

    Attributes:
        phase: number of the phase, from 0.
        measured: last reading minus the last one of the phase before (the first one's own first).
        instant: start of the approach minus the last reading before; NaN in the first phase. A shift at once with the
            speed (centrifugal, preload), not a thermal one.
        approach: the fit; None where the phase is too short, see `why`.
        why: reason for that, in words.
    """

    phase: int
    measured: float
    instant: float
    approach: Approach | None
    why: str = ""


@dataclass(frozen=True)
class Trace:
    """One drift over time: name, unit ("µm" or "µrad"), values (n,), and its phases."""

    name: str
    unit: str
    values: Floats
    fits: tuple[PhaseFit, ...]


@dataclass(frozen=True)
class Drift:
    """The result.

    Attributes:
        name: of the file.
        time_h: (n,).
        rpm: (n,).
        phases, traces: in order; a trace has one fit a phase.
        temperatures_degc: by name, (n,).
        words: what must be said with it.
    """

    name: str
    time_h: Floats
    rpm: Floats
    phases: tuple[Phase, ...]
    traces: tuple[Trace, ...]
    temperatures_degc: Mapping[str, Floats]
    words: tuple[str, ...]


def tilt_urad(radial1_um: Floats, radial2_um: Floats, distance_mm: float) -> Floats:
    """Tilt drift, (n,): (radial 1 - radial 2) / distance.

    Raises:
        MeasurementError: the distance is not positive.
    """
    if not distance_mm > 0.0:
        raise MeasurementError(f"the distance between the radial probes must be positive, found {distance_mm:g} mm")
    return (radial1_um - radial2_um) / distance_mm * 1e3


def spindle_drift(
    name: str,
    time_s: Floats,
    rpm: Floats,
    probes_um: Mapping[str, Floats],
    distance_mm: float | None = None,
    temperatures_degc: Mapping[str, Floats] | None = None,
) -> Drift:
    """Phases, drift of each probe and of the tilt, and time constants.

    Args:
        name: for messages.
        time_s: (n,), rising.
        rpm: spindle speed, (n,); NaN counts as the speed before.
        probes_um: by name, (n,); "radial1" and "radial2" give the tilt too. NaN where missing.
        distance_mm: between the radial probes; None: no tilt.
        temperatures_degc: shown beside.

    Raises:
        MeasurementError: too few rows, time not rising, or no probe.
    """
    if not probes_um:
        raise MeasurementError(f"{name}: no probe was named")
    if len(time_s) < LEAST_READINGS or not (np.diff(time_s) > 0).all():
        raise MeasurementError(f"{name}: needs at least {LEAST_READINGS} rows with rising time")
    traces = {n: ("µm", v) for n, v in probes_um.items()}
    words = []
    if {"radial1", "radial2"} <= set(probes_um):
        if distance_mm is not None:
            traces["tilt"] = "µrad", tilt_urad(probes_um["radial1"], probes_um["radial2"], distance_mm)
        else:
            words.append("No distance between the radial probes was given, so no tilt.")
    phases = phases_of(time_s, rpm)
    fitted = tuple(
        Trace(n, unit, v, tuple(_phase_fit(time_s, v, phases, k) for k in range(len(phases))))
        for n, (unit, v) in traces.items()
    )
    return Drift(
        name, time_s / 3600.0, rpm, tuple(phases), fitted, temperatures_degc or {}, tuple(words + _lasting(phases))
    )


def phases_of(time_s: Floats, rpm: Floats) -> list[Phase]:
    """Stretches of constant speed; speed 0 is "off"."""
    speed = _filled(rpm)
    phases, first = [], 0
    for i in range(1, len(speed) + 1):
        if i == len(speed) or abs(speed[i] - speed[first]) > max(10.0, SAME_SPEED * abs(speed[first])):
            hours = float(time_s[i - 1] - time_s[first]) / 3600.0
            phases.append(Phase(first, i, float(time_s[first]) / 3600.0, hours, float(np.median(speed[first:i]))))
            first = i
    return phases


def _filled(rpm: Floats) -> Floats:
    known = np.flatnonzero(~np.isnan(rpm))
    if not len(known):
        raise MeasurementError("spindle_rpm is empty; without speeds there are no phases")
    before = np.maximum(np.searchsorted(known, np.arange(len(rpm)), side="right") - 1, 0)
    return np.asarray(rpm[known[before]], dtype=np.float64)


def _phase_fit(time_s: Floats, values: Floats, phases: Sequence[Phase], k: int) -> PhaseFit:
    phase = phases[k]
    rows = np.arange(phase.first, phase.end)[~np.isnan(values[phase.first : phase.end])]
    earlier = values[: phase.first][~np.isnan(values[: phase.first])]
    before = float(earlier[-1]) if len(earlier) else float("nan")
    if not len(rows):
        return PhaseFit(k, float("nan"), float("nan"), None, "no readings")
    measured = float(values[rows[-1]]) - (before if len(earlier) else float(values[rows[0]]))
    duration_s = float(time_s[rows[-1]] - time_s[rows[0]])
    if len(rows) < LEAST_READINGS or duration_s < LEAST_S:
        return PhaseFit(k, measured, float("nan"), None, "too short")
    # Time counts from the last row of the phase before: somewhere from there on the speed was the new one.
    since = time_s[rows] - time_s[phase.first]
    found = approach(since, values[rows])
    return PhaseFit(k, measured, (found.pair or found).start - before, found)


def _lasting(phases: Sequence[Phase]) -> list[str]:
    longest = max(phases, key=lambda p: p.hours)
    if longest.hours < 7.5:
        return [
            f"The longest phase lasts {longest.hours:.1f} h; [G 3.5] runs 8 h and cools overnight. A time constant "
            "longer than the phase has no upper bound."
        ]
    return []
