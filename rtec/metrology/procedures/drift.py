"""Spindle thermal drift [G 3.5]: constant speed for hours, then off overnight, at several speeds.

The record is divided into phases of constant speed; each phase is a first-order approach to a new state, `y = start +
change · (1 - exp(-t/τ))`. Radial, axial, and tilt = (radial 1 - radial 2) / distance of the probes.

For each τ of a grid, start and change follow by linear least squares (variable projection); the interval of τ has every
value whose residual an F test does not reject. Consecutive readings are not independent, so that they count as n /
correlation time. Where the residual of one time constant has a shape, two are fitted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np

from rtec.arrays import Floats
from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import SeparableFit, correlation_time, separable_fit, unit_errors
from rtec.result import Result

COVERS = 0.95
POINTS = 241
PAIR_POINTS = 60
APART = 2.0
"""Two time constants whose ratio is smaller than this count as one."""
SURE = 0.01
SHAPE = 1.5
"""A residual has a shape if it is more than this many times the noise between neighbours."""
LONGEST = 30.0
"""Largest τ of the search in lengths of the record: beyond it a curve is a straight line."""


@dataclass(frozen=True)
class TwoApproaches:
    """The sum of two approaches, the faster one first.

    Attributes:
        changes: change of each.
        taus_s: time constants.
        taus_se_s: their standard errors, if the sum of squares is quadratic in ln τ.
        start: value at t = 0.
        rms: root mean square of the residual.
    """

    changes: tuple[float, float]
    taus_s: tuple[float, float]
    taus_se_s: tuple[float, float]
    start: float
    rms: float

    def values(self, time_s: Floats) -> Floats:
        """The curve, (n,)."""
        curves = [-c * np.expm1(-time_s / tau) for c, tau in zip(self.changes, self.taus_s, strict=True)]
        return np.asarray(self.start + sum(curves), dtype=np.float64)


@dataclass(frozen=True)
class Approach:
    """A fitted approach; values in the unit of the readings.

    Attributes:
        start: value at t = 0.
        change: final value minus start.
        tau_s: time constant.
        tau_low_s, tau_high_s: 95 % interval; infinite above where a straight line fits as well, zero below where a step
            does.
        reached: share of the change that was reached in the record.
        rms: root mean square of the residual.
        noise: noise of a single reading, from neighbours.
        effective: number of independent readings.
        pair: two time constants, where they fit significantly better than one; else None.
        words: doubts about the fit, or empty.
    """

    start: float
    change: float
    tau_s: float
    tau_low_s: float
    tau_high_s: float
    reached: float
    rms: float
    noise: float
    effective: float
    pair: TwoApproaches | None
    words: str

    def values(self, time_s: Floats) -> Floats:
        """The curve, (n,); that of the pair where there is one."""
        if self.pair is not None:
            return self.pair.values(time_s)
        return np.asarray(self.start - self.change * np.expm1(-time_s / self.tau_s), dtype=np.float64)


def approach(time_s: Floats, reading: Floats) -> Approach:
    """Fit one approach to readings without gaps, (n,) each; time counts from the change of speed."""
    duration = float(time_s[-1] - time_s[0])
    step = float(np.median(np.diff(time_s)))
    grid = np.geomspace(0.3 * step, LONGEST * duration, POINTS)
    left = _sum_of_squares(time_s, reading, grid)
    best = int(np.argmin(left))
    fine = np.geomspace(grid[max(best - 1, 0)], grid[min(best + 1, POINTS - 1)], POINTS)
    tau = float(fine[int(np.argmin(_sum_of_squares(time_s, reading, fine)))])
    start, change = _linear(time_s, reading, tau)
    residual = reading - start + change * np.expm1(-time_s / tau)
    effective = len(reading) / correlation_time(residual)
    least = float(residual @ residual)
    low, high = _interval(grid, left, least, max(effective - 3.0, 2.0))
    noise = float(np.sqrt(np.mean(np.diff(reading) ** 2) / 2))
    rms = float(np.sqrt(least / len(reading)))
    pair = _better_pair(time_s, reading, least) if rms > SHAPE * noise else None
    words = "two parts" if pair else _words(rms, noise, low, high, float(np.std(reading)))
    reached = float(-np.expm1(-duration / tau))
    return Approach(start, change, tau, low, high, reached, rms, noise, effective, pair, words)


def _better_pair(time_s: Floats, reading: Floats, least: float) -> TwoApproaches | None:
    """Two approaches if an F test prefers them to one; time constants from the sampling to the length of the record."""
    from scipy.special import fdtrc

    duration, step = float(time_s[-1] - time_s[0]), float(np.median(np.diff(time_s)))
    taus = np.geomspace(step, duration, PAIR_POINTS)
    curves = -np.expm1(-time_s / taus[:, None])
    centred = curves - curves.mean(axis=1, keepdims=True)
    gram, along = centred @ centred.T, centred @ (reading - reading.mean())
    quick, slow = np.triu_indices(PAIR_POINTS, 1)
    apart = taus[slow] >= APART * taus[quick]
    quick, slow = quick[apart], slow[apart]
    area = gram[quick, quick] * gram[slow, slow] - gram[quick, slow] ** 2
    first = (along[quick] * gram[slow, slow] - along[slow] * gram[quick, slow]) / area
    second = (along[slow] * gram[quick, quick] - along[quick] * gram[quick, slow]) / area
    best = int(np.argmax(first * along[quick] + second * along[slow]))
    fit, ends = _refined(time_s, reading, taus[[quick[best], slow[best]]], (step, duration))
    rest = float(fit.residual @ fit.residual)
    free = max(len(reading) / fit.correlation - 5.0, 2.0)
    if rest > 0.0 and float(fdtrc(2, free, max(least / rest - 1.0, 0.0) * free / 2.0)) > SURE:
        return None
    start, *changes = (float(v) for v in fit.values)
    errors = ends * _log_errors(time_s, fit, ends)
    return TwoApproaches(
        (changes[0], changes[1]), (float(ends[0]), float(ends[1])), (float(errors[0]), float(errors[1])), start, fit.rms
    )  # fmt: skip


def _refined(
    time_s: Floats, reading: Floats, taus_s: Floats, bounds_s: tuple[float, float]
) -> tuple[SeparableFit, Floats]:
    """The fit with time constants within the bounds and at least a factor `APART` apart, and these, rising."""
    low, high = (float(np.log(b)) for b in bounds_s)
    apart = float(np.log(APART))

    def ends(theta: Floats) -> Floats:
        quick = low + theta[0] * (high - apart - low)
        return np.asarray(np.exp([quick, quick + apart + theta[1] * (high - apart - quick)]), dtype=np.float64)

    def build(theta: Floats) -> tuple[Floats, Floats]:
        curves = -np.expm1(-time_s[:, None] / ends(theta))
        return np.concatenate([np.ones((len(time_s), 1)), curves], axis=1), np.zeros(len(time_s))

    first = (float(np.log(taus_s[0])) - low) / (high - apart - low)
    quick = low + first * (high - apart - low)
    second = (float(np.log(taus_s[1])) - quick - apart) / max(high - apart - quick, 1e-9)
    begin = np.clip([first, second], 1e-3, 1 - 1e-3)
    fit = separable_fit(build, reading, [begin], np.zeros(2), np.ones(2), errors=False)
    return fit, ends(fit.theta)


def _log_errors(time_s: Floats, fit: SeparableFit, taus_s: Floats) -> Floats:
    """Standard errors of ln τ of a pair, whether or not it ended on a bound, (2,)."""
    decay = np.exp(-time_s[:, None] / taus_s)
    slopes = -fit.values[1:] * decay * time_s[:, None] / taus_s
    design = np.concatenate([np.ones((len(time_s), 1)), 1.0 - decay, slopes], axis=1)
    try:
        return np.asarray(fit.rms * np.sqrt(fit.correlation) * unit_errors(design)[3:], dtype=np.float64)
    except MeasurementError:
        return np.full(2, np.inf)


def _sum_of_squares(time_s: Floats, reading: Floats, taus: Floats) -> Floats:
    """Residual sum of squares for each τ, (τs,)."""
    curve = -np.expm1(-time_s / taus[:, None])
    curve = curve - curve.mean(axis=1, keepdims=True)
    level = reading - reading.mean()
    size = np.maximum((curve**2).sum(axis=1), 1e-300)
    return np.asarray(np.maximum(level @ level - (curve @ level) ** 2 / size, 0.0), dtype=np.float64)


def _linear(time_s: Floats, reading: Floats, tau_s: float) -> tuple[float, float]:
    curve = -np.expm1(-time_s / tau_s)
    centred = curve - curve.mean()
    size = float(centred @ centred)
    change = float(centred @ reading) / size if size > 0 else 0.0
    return float(reading.mean() - change * curve.mean()), change


def _interval(grid: Floats, left: Floats, least: float, free: float) -> tuple[float, float]:
    """Smallest and largest τ that the readings do not reject."""
    from scipy.special import fdtri

    inside = np.flatnonzero(left <= least * (1.0 + float(fdtri(1, free, COVERS)) / free) + 1e-12 * (least + 1e-12))
    if not len(inside):  # the readings are on the curve to the last digit
        best = int(np.argmin(left))
        inside = np.array([best])
    low, high = max(int(inside[0]) - 1, 0), min(int(inside[-1]) + 1, len(grid) - 1)
    return (0.0 if inside[0] == 0 else float(grid[low])), (
        float("inf") if inside[-1] == len(grid) - 1 else float(grid[high])
    )


def _words(rms: float, noise: float, low_s: float, high_s: float, spread: float) -> str:
    if spread < 2.0 * noise or spread == 0.0:
        return "only noise"
    if low_s == 0.0 and np.isinf(high_s):
        return "no approach"
    if np.isinf(high_s):
        return "not settled"
    if low_s == 0.0:
        return "a step"
    return "rest has a shape" if rms > 3.0 * max(noise, 1e-12) and rms > 0.1 * spread else ""


SAME_SPEED = 0.02
"""Speeds that differ by less than this share, or by less than 10 rpm, are one phase."""
LEAST_READINGS = 12
LEAST_S = 1800.0


@dataclass(frozen=True)
class SpeedPhase:
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
        measured: last reading minus the last one of the phase before (in the first phase, minus its first reading).
        instant: start of the approach minus the last reading before; NaN in the first phase. An immediate shift with
            the speed (centrifugal, preload), not a thermal one.
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
class Drift(Result):
    """Thermal drift of a spindle.

    Attributes:
        name: name of the file.
        time_h: (n,).
        rpm: (n,).
        phases, traces: in order; a trace has one fit a phase.
        temperatures_degc: by name, (n,).
        words: remarks on the result.
        notes: notes of the measurements, by name: what is missing in them, and what was accepted.
    """

    page_maker: ClassVar[str] = "rtec.report.procedures:drift_page"

    name: str
    time_h: Floats
    rpm: Floats
    phases: tuple[SpeedPhase, ...]
    traces: tuple[Trace, ...]
    temperatures_degc: Mapping[str, Floats]
    words: tuple[str, ...]
    notes: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        return self.own()

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """One row a phase of each trace, with its approach where there is one."""
        return [
            {"trace": t.name, "unit": t.unit, **asdict(self.phases[f.phase]), **asdict(f), **_numbers(f.approach)}
            for t in self.traces
            for f in t.fits
        ]


def _numbers(found: Approach | None) -> dict[str, Any]:
    return {} if found is None else {k: v for k, v in asdict(found).items() if k != "words"}


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
        temperatures_degc: shown beside the drift; (n,) by name.

    Raises:
        MeasurementError: there are too few rows or no probe, or the time does not rise.
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


def phases_of(time_s: Floats, rpm: Floats) -> list[SpeedPhase]:
    """Stretches of constant speed; speed 0 is "off"."""
    speed = _filled(rpm)
    phases, first = [], 0
    for i in range(1, len(speed) + 1):
        if i == len(speed) or abs(speed[i] - speed[first]) > max(10.0, SAME_SPEED * abs(speed[first])):
            hours = float(time_s[i - 1] - time_s[first]) / 3600.0
            phases.append(SpeedPhase(first, i, float(time_s[first]) / 3600.0, hours, float(np.median(speed[first:i]))))
            first = i
    return phases


def _filled(rpm: Floats) -> Floats:
    known = np.flatnonzero(~np.isnan(rpm))
    if not len(known):
        raise MeasurementError("spindle_rpm is empty; without speeds there are no phases")
    before = np.maximum(np.searchsorted(known, np.arange(len(rpm)), side="right") - 1, 0)
    return np.asarray(rpm[known[before]], dtype=np.float64)


def _phase_fit(time_s: Floats, values: Floats, phases: Sequence[SpeedPhase], k: int) -> PhaseFit:
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
    # Time counts from the last row of the phase before: the speed changed at some instant after it.
    since = time_s[rows] - time_s[phase.first]
    found = approach(since, values[rows])
    return PhaseFit(k, measured, (found.pair or found).start - before, found)


def _lasting(phases: Sequence[SpeedPhase]) -> list[str]:
    longest = max(phases, key=lambda p: p.hours)
    if longest.hours < 7.5:
        return [
            f"The longest phase lasts {longest.hours:.1f} h; [G 3.5] runs 8 h and cools overnight. A time constant "
            "longer than the phase has no upper bound."
        ]
    return []
