"""Sinks: the ways a correction gets into a machine [G 4]. Each is a scale from µm to whole units.

| kind | unit | goes to |
|---|---|---|
| pulse | encoder counts | an encoder box that inserts them into A/B |
| following_error | controller units | the controller's following-error register |
| phase | steps of an N-bit D/A over ± range | the reference of the phase comparator |
| origin_offset | controller units | the controller's origin offset |

Kinds differ in sign, smallest step, update period and range; the code is the same.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from rtec.machine import Axis
from rtec.quantities import (
    CountsPerSecond,
    MicrometresPositive,
    MillimetresPositive,
    SecondsNotNegative,
    SecondsPositive,
)
from rtec.tomlfile import Strict

DEAD_BAND = 0.75
"""In quanta: the ledger moves only where it is off by more than this, so that noise does not make it chatter."""
UNLIMITED = float(2**52)
"""Units that no correction reaches; still exact in a float."""


@dataclass(frozen=True)
class SinkScale:
    """A sink as the ledger uses it.

    Attributes:
        units_per_um: units per µm of correction, with sign.
        quantum: smallest step, units.
        rate_per_s: largest rate, units per second.
        low, high: range of the output, units.
        period_s: shortest time between two new values; 0: every cycle.
    """

    units_per_um: float
    quantum: int
    rate_per_s: float
    low: float
    high: float
    period_s: float


class PulseSink(Strict):
    """Pulse insertion.

    Attributes:
        kind: counts inserted into the encoder signal.
        quantum_counts: 1 for single counts, 4 for whole cycles, as the original RTEC did.
        max_counts_per_s: largest rate that box and controller follow.
    """

    kind: Literal["pulse"] = "pulse"
    quantum_counts: Literal[1, 4] = 1
    max_counts_per_s: CountsPerSecond = 20000.0

    @property
    def most_um(self) -> float:
        """Largest correction, µm: counts have no limit of their own."""
        return math.inf

    def scale(self, axis: Axis) -> SinkScale:
        """Counts; positive ones make the axis stop sooner, hence the sign."""
        per_um = -axis.counts_per_mm * 1e-3
        return SinkScale(per_um, self.quantum_counts, self.max_counts_per_s, -UNLIMITED, UNLIMITED, 0.0)


class _OffsetSink(Strict):
    """An offset in the controller.

    Attributes:
        kind: what the controller does with the number.
        resolution_um: one unit of output: the smallest step of the controller.
        period_s: shortest time between two new values.
        max_um: the largest offset that the controller accepts.
    """

    resolution_um: MicrometresPositive
    period_s: SecondsPositive = 0.020
    max_um: MicrometresPositive = 1000.0

    @property
    def unit_um(self) -> float:
        """One unit, µm."""
        return self.resolution_um

    @property
    def most_um(self) -> float:
        """Largest correction, µm."""
        return self.max_um

    def scale(self, axis: Axis) -> SinkScale:
        """Controller units, of the correction's own sign."""
        del axis
        per_um, most = 1.0 / self.resolution_um, float(int(self.max_um / self.resolution_um))
        return SinkScale(per_um, 1, UNLIMITED, -most, most, self.period_s)


class FollowingErrorSink(_OffsetSink):
    """Offset added to the following error every `period_s` (20 ms in [G 4])."""

    kind: Literal["following_error"] = "following_error"


class OriginOffsetSink(_OffsetSink):
    """Shift of the controller's origin; slower controllers accept a new one about every second."""

    kind: Literal["origin_offset"] = "origin_offset"
    period_s: SecondsPositive = 1.0


class PhaseSink(Strict):
    """An N-bit D/A over ± `range_mm` shifts the phase reference ([G 4.1]: 8 bits over ±0.1 mm).

    Attributes:
        kind: steps of a D/A at the reference of the phase comparator.
        bits: resolution of the D/A.
        range_mm: shift at full scale.
        period_s: shortest time between two new values; 0: every cycle.
    """

    kind: Literal["phase"] = "phase"
    bits: Annotated[int, Field(ge=4, le=24)] = 8
    range_mm: MillimetresPositive = 0.1
    period_s: SecondsNotNegative = 0.020

    @property
    def unit_um(self) -> float:
        """One step, µm."""
        return 2e3 * self.range_mm / float(2**self.bits)

    @property
    def most_um(self) -> float:
        """Largest correction, µm; upwards one step less."""
        return 1e3 * self.range_mm

    def scale(self, axis: Axis) -> SinkScale:
        """Steps of 2 · range / 2^bits (0.78 µm for 8 bits over ±0.1 mm), of the correction's own sign."""
        del axis
        half = float(2 ** (self.bits - 1))
        return SinkScale(half / (self.range_mm * 1e3), 1, UNLIMITED, -half, half - 1.0, self.period_s)


Sink = Annotated[PulseSink | FollowingErrorSink | OriginOffsetSink | PhaseSink, Field(discriminator="kind")]


def differs(sink: Sink, actuator: str, unit_um: float) -> str:
    """Why an actuator of this kind, with units of `unit_um`, cannot take the sink's output; "" where it can.

    Counts have no unit; all other kinds must have the same unit, or the correction would have another size.
    """
    if sink.kind != actuator:
        return f'takes {actuator!r}, not {sink.kind!r}: write kind = "{actuator}" there'
    if sink.kind != "pulse" and not math.isclose(sink.unit_um, unit_um, rel_tol=1e-9):
        return f"has units of {unit_um:g} µm (its option unit_um), the output has {sink.unit_um:g} µm"
    return ""
