"""Reversals that a touch probe makes: its stylus bends before it triggers, and by the same in each direction."""

from collections.abc import Mapping

from rtec.diagnosis.doubts.doubt import Doubt
from rtec.estimation.readings import Readings
from rtec.wording import listed, two_numbers

SAME = 0.1
"""Reversals that differ by less than this share are equal: a worn screw is not as worn as another one."""


def by_pre_travel(readings: Readings, plays: Mapping[str, float]) -> tuple[Doubt, ...]:
    """Doubt where the tool tip was read in several directions, and reverses by the same in each; empty for none.

    Args:
        readings: all readings.
        plays: backlash of each axis, µm.
    """
    tips = {m.instrument.name for m in readings.measurements} == {"tool_tip"}
    low, high = (f(plays.values(), default=0.0) for f in (min, max))
    if not tips or len(plays) < 2 or high - low > SAME * max(abs(low), abs(high)):
        return ()
    sizes = " to ".join(dict.fromkeys(two_numbers(low, high)))
    message = (
        f"The reversals of {listed(sorted(plays))} are equal, {sizes} µm: a touch probe makes the same by its "
        "pre-travel, the way that its stylus bends until it triggers."
    )
    step = "Calibrate the probe in each direction, or measure one axis with a laser or a ball bar."
    return (Doubt("pre_travel", message, step),)
