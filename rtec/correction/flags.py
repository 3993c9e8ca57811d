"""Orders and limits that the guard reads, and flags that it sets. Nothing here decides, and nothing is compiled."""

from enum import IntFlag
from typing import Final

from pydantic import model_validator

from rtec.quantities import MicrometresPerSecond, MicrometresPerSecond2, MicrometresPositive, SecondsPositive
from rtec.tomlfile import Strict

MODE_OFF: Final = 0
"""Ordered: the correction fades to zero at the slew limit."""
MODE_ON: Final = 1
"""Ordered: the correction follows the model."""
MODE_HOLD: Final = 2
"""Ordered: the correction keeps its value."""
MODE_TAKEN_OVER: Final = 3
"""One row: the ledger is the output that the device itself reports, as in `output`; the correction holds."""
ORDER_MASK: Final = 3
"""Bits of `Samples.mode` that hold one of these four modes; the other two bits are the actuator's."""
OUTPUT_UNCONFIRMED: Final = 4
"""Bit of `Samples.mode`: the actuator has not confirmed the command before; nothing moves in this cycle."""
OUTPUT_TROUBLE: Final = 8
"""Bit of `Samples.mode`: the actuator refuses commands, or does not follow them."""


class Flag(IntFlag):
    """Reasons and states of a command; bits of `Commands.flags`."""

    STALE_COUNTS = 1
    """The counts are older than allowed."""
    STALE_TEMPERATURE = 2
    """A temperature that the model reads is older than allowed; or it, or the spindle speed, is unknown."""
    SENSOR_FAULT = 4
    """A temperature is outside its sensor's range: a broken wire or sensor."""
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
    """Held for longer than `fade_after_s`: the correction fades to zero."""
    LIMITED = 512
    """The applied correction is on its way to the requested one, at its slew or acceleration limit."""
    OUTPUT_SATURATED = 1024
    """The output is at the end of the sink's range."""
    HELD = 2048
    """The correction keeps its value, for one of the reasons here."""
    OUTPUT_TROUBLE = 4096
    """The actuator refuses commands, or does not follow them: the correction stays at the actuator's output."""


HOLD_REASONS: Final = int(
    Flag.STALE_COUNTS
    | Flag.STALE_TEMPERATURE
    | Flag.SENSOR_FAULT
    | Flag.OUT_OF_RANGE
    | Flag.OVER_STOP_LIMIT
    | Flag.ORDERED_HOLD
    | Flag.OUTPUT_TROUBLE
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
    Flag.OUTPUT_TROUBLE: "the actuator takes no commands, or has an output that nobody commanded",
}


class Limits(Strict):
    """Limits of one axis' correction. All four are required: without them nothing runs.

    Attributes:
        warning_um: a request beyond this is flagged.
        stop_um: a request beyond this is not followed; the applied correction never passes it.
        slew_um_s: fastest change of the correction.
        acceleration_um_s2: fastest change of that speed.
    """

    warning_um: MicrometresPositive
    stop_um: MicrometresPositive
    slew_um_s: MicrometresPerSecond
    acceleration_um_s2: MicrometresPerSecond2

    @model_validator(mode="after")
    def _ordered(self) -> "Limits":
        if self.warning_um > self.stop_um:
            raise ValueError(f"warning_um {self.warning_um:g} is above stop_um {self.stop_um:g}")
        return self


CYCLES_OF_AGE: Final = 5
"""Usual largest age of the counts, cycles: a device that sends by itself is up to one old, and may be late."""


class GuardSettings(Strict):
    """Ages at which inputs are too old, and the end of a long hold.

    Attributes:
        counts_max_age_s: counts older than this are stale.
        temperature_max_age_s: temperatures older than this are stale.
        fade_after_s: after a hold of this length the correction fades to zero; not set: it holds for ever.
    """

    counts_max_age_s: SecondsPositive = 0.005
    temperature_max_age_s: SecondsPositive = 30.0
    fade_after_s: SecondsPositive | None = None
