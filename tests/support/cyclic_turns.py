"""Cyclic error over full turns: harmonics by number, and a forward/backward difference split by its cause.

A difference between forward and backward can be a delay (the reading is late, so the error grows with speed) or a
reversal (play or hysteresis, the same at any speed). What is late is the whole reading, cyclic error included:

    reading(t) = q + offset + closing · q/360 + Σ_k (c_k cos kq + s_k sin kq) + ½ · reversal · direction,
    q = position(t - delay)

so the harmonics are not blurred by the delay. Delay and reversal are told apart by rests, speed changes and the shift
of the harmonics; at one constant speed without harmonics they could not be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtec.effects.derived import direction_track
from rtec.errors import MeasurementError
from rtec.metrology.procedures.fitting import SeparableFit, separable_fit

Floats = NDArray[np.float64]
SURE = 3.0
"""A term counts as real from this many standard errors on."""


@dataclass(frozen=True)
class Number:
    """A value with its standard error."""

    value: float
    se: float

    @property
    def is_real(self) -> bool:
        """Is it at least three standard errors from nil?"""
        return abs(self.value) >= SURE * self.se


@dataclass(frozen=True)
class Harmonic:
    """c cos kφ + s sin kφ; amplitude and its standard error in the unit of the readings, phase of its maximum, °."""

    order: int
    amplitude: Number
    phase_deg: float


@dataclass(frozen=True)
class CyclicError:
    """The result, in degrees and seconds.

    Attributes:
        harmonics: from 1 up.
        delay_s: how late the reading is; minus it is the error per speed.
        reversal_deg: difference between forward and backward that does not depend on speed.
        closing_deg: error after one whole turn: slip, or a wrong number of counts for a turn.
        rms_deg: of what is left.
        readings, effective: how many, and how many independent ones they amount to.
        words: the finding.
    """

    harmonics: tuple[Harmonic, ...]
    delay_s: Number
    reversal_deg: Number
    closing_deg: Number
    rms_deg: float
    readings: int
    effective: float
    words: tuple[str, ...]

    @property
    def strongest(self) -> Harmonic:
        """The harmonic with the largest amplitude."""
        return max(self.harmonics, key=lambda h: h.amplitude.value)


def cyclic_error(
    time_s: Floats,
    position_deg: Floats,
    reading_deg: Floats,
    orders: int = 32,
    longest_delay_s: float = 0.1,
    dead_band_deg: float = 0.01,
) -> CyclicError:
    """Analyse turns forward and back.

    Args:
        time_s: (n,), rising.
        position_deg: of the reference, (n,), not wrapped.
        reading_deg: of what is tested, (n,), not wrapped.
        orders: highest harmonic.
        longest_delay_s: bound of the search, either sign.
        dead_band_deg: motion back by at most this much is no reversal.

    Raises:
        MeasurementError: less than a whole turn, only one direction, or terms that these readings cannot tell apart.
    """
    _check(position_deg, time_s)
    direction = direction_track(np.ascontiguousarray(position_deg), dead_band_deg)
    if not ((direction > 0).any() and (direction < 0).any()):
        raise MeasurementError("only one direction of turning: delay and reversal need both")

    def build(theta: Floats) -> tuple[Floats, Floats]:
        late = np.interp(time_s - theta[0], time_s, position_deg)
        angle = np.deg2rad(late)[:, None] * np.arange(1, orders + 1)
        columns = [np.ones((len(late), 1)), late[:, None] / 360.0, direction[:, None] / 2]
        return np.concatenate([*columns, np.cos(angle), np.sin(angle)], axis=1), late

    bound = np.array([longest_delay_s])
    fit = separable_fit(build, reading_deg, [np.zeros(1)], -bound, bound)
    if abs(fit.theta[0]) > 0.98 * longest_delay_s:
        raise MeasurementError(f"the delay reached its bound of {longest_delay_s:g} s; give a larger one")
    return _result(fit, orders)


def _check(position_deg: Floats, time_s: Floats) -> None:
    if np.ptp(position_deg) < 360.0 * 0.999:
        raise MeasurementError(f"the turn covers {np.ptp(position_deg):.1f}° only; harmonics need a whole one")
    rising = np.diff(time_s) > 0
    if not rising.all():
        raise MeasurementError(f"time does not rise at reading {int(np.argmin(rising)) + 2}")


def _result(fit: SeparableFit, orders: int) -> CyclicError:
    cosines, sines = fit.values[3 : 3 + orders], fit.values[3 + orders :]
    errors = fit.errors[3 : 3 + orders], fit.errors[3 + orders : 3 + 2 * orders]
    harmonics = []
    for k, (c, s, ce, se) in enumerate(zip(cosines, sines, *errors, strict=True), 1):
        size = float(np.hypot(c, s))
        error = float(np.hypot(c * ce, s * se) / size) if size > 0 else float(max(ce, se))
        harmonics.append(Harmonic(k, Number(size, error), float(np.degrees(np.arctan2(s, c))) % 360.0))
    delay = Number(float(fit.theta[0]), float(fit.errors[-1]))
    closing, reversal = (Number(float(fit.values[i]), float(fit.errors[i])) for i in (1, 2))
    return CyclicError(
        tuple(harmonics), delay, reversal, closing, fit.rms, len(fit.residual),
        len(fit.residual) / fit.correlation, _words(harmonics, delay, reversal, closing),
    )  # fmt: skip


def _words(harmonics: list[Harmonic], delay: Number, reversal: Number, closing: Number) -> tuple[str, ...]:
    top = max(harmonics, key=lambda h: h.amplitude.value)
    out = [f"Harmonic {top.order} is the largest: {top.amplitude.value:.3f}° ({top.amplitude.se:.3f})."]
    if delay.is_real:
        out.append(
            f"The reading is late by {delay.value * 1e3:.1f} ms ({delay.se * 1e3:.1f}): "
            "forward and backward differ in proportion to speed."
        )
    if reversal.is_real:
        out.append(f"Beyond the delay there is a reversal of {reversal.value:.3f}° ({reversal.se:.3f}): play.")
    else:
        out.append(f"No reversal beyond the delay: {reversal.value:.3f}° ({reversal.se:.3f}).")
    if closing.is_real:
        out.append(
            f"A turn does not close: {closing.value:.3f}° ({closing.se:.3f}) are missing after 360°. "
            "Slip, or a reference with other counts per turn than supposed."
        )
    return tuple(out)
