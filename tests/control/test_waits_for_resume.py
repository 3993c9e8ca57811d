"""Whether a status says that the order to resume is waited for. Oracle: what the loop and its devices say."""

from typing import Any

import numpy as np
import pytest

from rtec.arrays import Floats, Ints
from rtec.control.facts import reasons_not_ordered, waits_for_resume
from rtec.correction.flags import REASONS, Flag
from rtec.errors import DriverFault
from rtec.loop.believed import BelievedTemperatures
from rtec.loop.ports import HOLDS
from tests.support.diagnosis_examples import small_machine


class _Jumping:
    """A sensor that reads 20 °C, and a second later 90 °C."""

    def __init__(self) -> None:
        self._count = 0

    def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
        """Fill in."""
        self._count += 1
        degc.fill(20.0 if self._count == 1 else 90.0)
        time_ns.fill(self._count * 1_000_000_000)


def _status(*texts: str) -> dict[str, Any]:
    return {"devices": {"box": texts} if texts else {}}


def test_a_device_that_waits_is_known_by_its_reason() -> None:
    """One that is in trouble and does not wait is none."""
    assert waits_for_resume(_status("the cable is loose", f"the box restarted; {HOLDS}"))
    assert not waits_for_resume(_status("the cable is loose"))
    assert not waits_for_resume(_status())


def test_a_temperature_that_jumped_waits() -> None:
    """Its reason is another than that of a device."""
    source = BelievedTemperatures(_Jumping(), small_machine())
    degc, time_ns = np.zeros(2), np.zeros(2, dtype=np.int64)
    source.read(degc, time_ns, ["T_bed"], 1_000_000_000)
    with pytest.raises(DriverFault) as raised:
        source.read(degc, time_ns, ["T_bed"], 2_000_000_000)
    assert source.must_resume
    assert waits_for_resume(_status(str(raised.value)))


def test_what_was_ordered_is_no_trouble() -> None:
    """Oracle: the orders: off and hold do what they say; a stale count was ordered by nobody."""
    stale = REASONS[Flag.STALE_COUNTS]
    off, hold = REASONS[Flag.ORDERED_OFF], REASONS[Flag.ORDERED_HOLD]
    assert reasons_not_ordered({"mode": "off", "reasons": [off, REASONS[Flag.FADING], stale]}) == [stale]
    assert reasons_not_ordered({"mode": "hold", "reasons": [hold]}) == []
    assert reasons_not_ordered({"mode": "on", "reasons": [hold, stale]}) == [hold, stale]
