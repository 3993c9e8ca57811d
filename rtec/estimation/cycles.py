"""Readings that swing to and fro with a period that no recorded channel has: a chiller, hydraulics, air conditioning.

What switches by itself every few minutes looks like noise to a drift with a short memory, and no effect of a recorded
channel follows it. A period shows in what comes again after one, and is opposite after half of one.
"""

from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats
from rtec.estimation.readings import Readings
from rtec.wording import ERROR_UNITS, significant

FEWEST, MOST = 60, 4000
"""Fewest readings of a series, and most that are looked at."""
STEPS, CYCLES = 6, 6
"""A period is at least so many readings long, and comes at least so often."""
AGAIN, OF_FEW, OPPOSITE = 0.45, 1.2, -0.35
"""Least correlation after one period of very many, what few add to it over their number, and largest after half of one.
Of 5000 records of noise, of drift with a memory and of a random walk none has both."""
VISIBLE = 2.0
"""It swings by at least this many times the noise to either side."""


@dataclass(frozen=True)
class OwnSwing:
    """A swing that no recorded channel has.

    Attributes:
        series: number of the series.
        period_s: its period.
        swing: half of the way from the lowest to the highest value, in the unit of the readings.
        message: in words.
    """

    series: int
    period_s: float
    swing: float
    message: str


def cycles(readings: Readings, left: Floats, noise: Floats) -> list[OwnSwing]:
    """Series that swing with a period that no recorded channel has, the largest swing first.

    Args:
        readings: the readings.
        left: their residual, (m,).
        noise: of each series, in its unit, (series,).
    """
    out = []
    for i, s in enumerate(readings.series):
        found = _of(s.time_s, left[s.part])
        if found is None or found[1] < VISIBLE * noise[i]:
            continue
        period_s, swing = found
        state = readings.states[s.source]
        names = [n for n in (*readings.machine.sensor_names, "spindle_rpm", "load_kg") if n in state.channels]
        if any(_shares(s.time_s, left[s.part], state.channels[n][s.row], period_s) for n in names):
            continue
        size = f"±{significant(swing, 2)} {ERROR_UNITS.get(s.unit, s.unit)}"
        name = f"{readings.measurements[s.source].name} {s.column}"
        period = f"{significant(period_s / 60.0, 2)} min" if period_s > 100.0 else f"{significant(period_s, 2)} s"
        message = f"{name} swings by {size} with a period of {period}, as no recorded channel does."
        out.append(OwnSwing(i, period_s, swing, message))
    return sorted(out, key=lambda c: -c.swing)


def _even(time_s: Floats, values: Floats) -> tuple[float, Floats]:
    """Values at even steps, and the step, s."""
    count = min(len(values), MOST)
    at = np.linspace(time_s[0], time_s[-1], count)
    return float(at[1] - at[0]), np.interp(at, time_s, values)


def _about(values: Floats, lag: int) -> Floats:
    """Values less their mean over one period."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(values - uniform_filter1d(values, lag, mode="nearest"))


def _correlation(one: Floats, other: Floats) -> float:
    size = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / size if size > 0.0 else 0.0


def _of(time_s: Floats, left: Floats) -> tuple[float, float] | None:
    """Period, s, and swing of the most regular swing; None where there is none."""
    if len(left) < FEWEST or time_s[-1] <= time_s[0]:
        return None
    step_s, values = _even(time_s, left)
    best, found = 0.0, None
    for lag in range(STEPS, len(values) // CYCLES + 1):
        about, half = _about(values, lag), lag // 2
        again = _correlation(about[:-lag], about[lag:])
        least = AGAIN + OF_FEW * lag / len(values)
        if again > max(best, least) and _correlation(about[:-half], about[half:]) < OPPOSITE:
            best, found = again, (lag * step_s, float(np.sqrt(2.0 * again) * about.std()))
    return found


def _shares(time_s: Floats, left: Floats, channel: Floats, period_s: float) -> bool:
    """Whether a channel swings with the same period, perhaps earlier or later."""
    if float(np.ptp(channel)) == 0.0:
        return False
    step_s, values = _even(time_s, left)
    lag = max(round(period_s / step_s), 2)
    one, other = _about(values, lag), _about(_even(time_s, channel)[1], lag)
    moved = [max(round(lag * part / 8), 0) for part in range(8)]
    return any(abs(_correlation(one[k:], other[: len(other) - k])) > AGAIN for k in moved)
