"""The guard: what stands between a model's wish and the machine.

In this order: are the inputs fresh and in range? then the slew and acceleration limits, then the stop limit. While
anything is wrong the correction brakes within its acceleration limit and stays where it comes to rest: never a
jump, never a silent zero.
"""

import math
from enum import IntFlag
from typing import Annotated

from pydantic import Field, model_validator

from rtec.jit import njit
from rtec.tomlfile import Strict


class Flag(IntFlag):
    """What a command says about itself; bits of `Commands.flags`."""

    STALE_COUNTS = 1
    """The counts are older than allowed."""
    STALE_TEMPERATURE = 2
    """A temperature that the model reads is older than allowed; or it, or the spindle speed, is not known."""
    SENSOR_FAULT = 4
    """A temperature is outside what its sensor can give: a broken wire or sensor."""
    OUT_OF_RANGE = 8
    """A channel is outside the range that the model was fitted in."""
    OVER_STOP_LIMIT = 16
    """The model asks for more than the stop limit."""
    OVER_WARNING_LIMIT = 32
    """The model asks for more than the warning limit."""
    ORDERED_HOLD = 64
    """The operator ordered a hold."""
    ORDERED_OFF = 128
    """The operator switched the correction off."""
    FADING = 256
    """Held for longer than `fade_after_s`: the correction fades to nothing."""
    LIMITED = 512
    """The applied correction is on its way to the requested one, at its slew or acceleration limit."""
    OUTPUT_SATURATED = 1024
    """The sink can give no more."""
    HELD = 2048
    """The correction stays where it is, for one of the reasons above."""


HOLD_REASONS = int(
    Flag.STALE_COUNTS
    | Flag.STALE_TEMPERATURE
    | Flag.SENSOR_FAULT
    | Flag.OUT_OF_RANGE
    | Flag.OVER_STOP_LIMIT
    | Flag.ORDERED_HOLD
)

REASONS = {
    Flag.STALE_COUNTS: "counts are stale",
    Flag.STALE_TEMPERATURE: "a temperature (or the spindle speed) is stale or was never read",
    Flag.SENSOR_FAULT: "a temperature sensor reads what it cannot",
    Flag.OUT_OF_RANGE: "outside the range that the model was fitted in",
    Flag.OVER_STOP_LIMIT: "the model asks for more than the stop limit",
    Flag.OVER_WARNING_LIMIT: "the model asks for more than the warning limit",
    Flag.ORDERED_HOLD: "hold was ordered, or an order to resume is waited for",
    Flag.ORDERED_OFF: "switched off",
    Flag.FADING: "fading to nothing",
    Flag.OUTPUT_SATURATED: "the actuator can give no more",
}


class Limits(Strict):
    """Limits of one axis' correction. All four must be set: without them nothing runs.

    Attributes:
        warning_um: a request beyond this is flagged.
        stop_um: a request beyond this is not followed; the applied correction never passes it.
        slew_um_s: fastest change of the correction.
        acceleration_um_s2: fastest change of that speed.
    """

    warning_um: Annotated[float, Field(gt=0)]
    stop_um: Annotated[float, Field(gt=0)]
    slew_um_s: Annotated[float, Field(gt=0)]
    acceleration_um_s2: Annotated[float, Field(gt=0)]

    @model_validator(mode="after")
    def _ordered(self) -> "Limits":
        if self.warning_um > self.stop_um:
            raise ValueError(f"warning_um {self.warning_um:g} is above stop_um {self.stop_um:g}")
        return self


class GuardSettings(Strict):
    """When inputs are too old, and what a long hold leads to.

    Attributes:
        counts_max_age_s: counts older than this are stale.
        temperature_max_age_s: so are temperatures.
        fade_after_s: after so long a hold the correction fades to nothing; not set: it stays for ever.
    """

    counts_max_age_s: Annotated[float, Field(gt=0)] = 0.005
    temperature_max_age_s: Annotated[float, Field(gt=0)] = 30.0
    fade_after_s: Annotated[float, Field(gt=0)] | None = None


@njit
def guard_update(
    applied: float, speed: float, target: float, hold: bool, dt: float, stop: float, slew: float, acceleration: float
) -> tuple[float, float]:
    """Move the applied correction towards its target for one cycle.

    Args:
        applied: correction now, µm.
        speed: its speed, µm/s.
        target: where it should go, µm; not looked at while held.
        hold: brake and stay. Beyond `stop`, where a lower limit that was loaded anew leaves it, it goes to `stop`.
        dt: length of the cycle, s.
        stop, slew, acceleration: limits, µm, µm/s, µm/s².

    Returns:
        applied and speed after the cycle. Speed never passes `slew`, changes by at most `acceleration · dt`, and is
        always low enough to come to rest at a target that stands still; `applied` never passes `stop`, nor goes
        further away where it is beyond.
    """
    if dt <= 0.0:
        return applied, speed
    change = acceleration * dt
    bound = max(stop, abs(applied))
    wanted, arriving, goal = 0.0, False, applied
    if not hold or bound > stop:
        goal = min(max(applied if hold else target, -stop), stop)
        per_cycle = abs(goal - applied) / dt
        # Braking by `change` a cycle from k·change takes k(k+1)/2·change of way; k whole cycles fit, the rest of
        # the way is shared out among the k+1 that it takes to get there.
        wanted = per_cycle
        if per_cycle >= change:
            k = math.floor(0.5 * (math.sqrt(1.0 + 8.0 * per_cycle / change) - 1.0))
            wanted = k * change + (per_cycle - 0.5 * k * (k + 1.0) * change) / (k + 1.0)
        wanted = min(slew, wanted)
        arriving = wanted == per_cycle
        if goal < applied:
            wanted = -wanted
    limited = min(max(wanted, speed - change), speed + change)
    if arriving and limited == wanted:
        return goal, limited
    return min(max(applied + limited * dt, -bound), bound), limited
