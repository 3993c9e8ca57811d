"""A ball bar whose length changes from circle to circle: it warms up in the hand, and no axis grows like that."""

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.estimation.gls import solve
from rtec.estimation.judge import Judgement
from rtec.metrology.instruments.ball_bar import BallBar
from rtec.wording import ERROR_UNITS, number, sizes

FEWEST_RUNS = 4
"""Fewest circles that tell a length which changes from a drift."""
MOST_OF = 0.5
"""With a length of its own for each circle the model leaves less than this share of what its refitted numbers leave; a
temperature that explains the lengths leaves less than this share of them."""
NEAR = 1.5
"""With these lengths the model leaves at most this many times the noise."""
GROWS = 24e-3
"""Expansion of aluminium, µm/(mm·K): no machine grows faster."""


def length_of_circles(judged: Judgement) -> Doubt | None:
    """Doubt about bars whose length differs between circles by what neither the model nor a temperature explains."""
    readings = judged.readings
    bars = [
        s
        for s in readings.series
        if isinstance(b := readings.measurements[s.source].instrument, BallBar) and b.setup.zero != "run"
    ]
    if not bars:
        return None
    left, lengths, warm = judged.left.copy(), list[float](), list[list[float]]()
    names = [n for n in readings.machine.sensor_names if all(n in readings.states[s.source].channels for s in bars)]
    for s in bars:
        for run in np.unique(s.run):
            mine = np.flatnonzero(s.run == run)
            length = float(left[s.part][mine].mean())
            left[s.part][mine] -= length
            lengths.append(length)
            warm.append([float(readings.states[s.source].channels[n][s.row][mine].mean()) for n in names])
    after, before = judged.pooled(left), min(judged.residual, judged.refitted)
    if len(lengths) < FEWEST_RUNS or after > NEAR * judged.noise_floor or after > MOST_OF * before:
        return None
    longest = max(b.setup.length_mm for m in readings.measurements if isinstance(b := m.instrument, BallBar))
    if _follows(np.array(lengths), np.array(warm), GROWS * longest):
        return None
    here, there = sizes(after, judged.residual)
    unit, spread = ERROR_UNITS[judged.unit], number(float(np.ptp(lengths)))
    message = (
        f"The circles differ in size by up to {spread} {unit} from run to run, which no recorded temperature and no "
        "number of the model explains: a ball bar warms up in the hand. With a length of its own for each circle the "
        f"model leaves {here} instead of {there} {unit}."
    )
    step = (
        'Write zero = "run" in the [setup] of these files, so that each circle has a length of its own; or let the bar '
        "rest on the machine for half an hour and measure again."
    )
    return Doubt("instrument_warm_up", message, step, fatal=True)


def _follows(lengths: Floats, warm: Floats, most: float) -> bool:
    """Whether lengths, (n,), follow one of some temperatures, (n, sensors), by at most so many µm/K."""
    about = lengths - lengths.mean()
    for degc in (warm - warm.mean(axis=0)).T:
        column = degc[:, None]
        by = solve(column, about)
        if abs(by[0]) < most and np.linalg.norm(about - column @ by) < MOST_OF * np.linalg.norm(about):
            return True
    return False
