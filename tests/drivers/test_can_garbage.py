"""Garbage from a CAN bus, and from adapters that send frames as text. Oracle: what was sent; how often it opened."""

import random
import struct
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from rtec.errors import ConfigError, DriverTimeout
from tests.drivers.test_can_driver import BED, driver, pdo, table, value
from tests.drivers.test_can_encoders import driver as encoder_driver
from tests.drivers.test_can_encoders import travelling
from tests.support.can_peer import CLOCK, MS, SlcanAdapter, bus_on, frame, new_channel
from tests.support.conformance import open_files
from tests.support.modbus_peer import until

LINES = (
    b"t18\r",
    b"T1\r",
    b"t1859\r",
    b"t1852C\r",
    b"d185F00\r",
    b"b\r",
    b"r18\r",
    b"\r",
    b"\a",
    b"t\xff\xfe\r",
    b"nonsense\r",
)
"""Halves of frames, kinds of frames that nobody asked for, and bytes that are no text."""


def slcan(port: str, **more: Any) -> dict[str, Any]:
    settings = {"sleep_after_open": 0.0}
    return table(port, interface="slcan", bitrate=500000, settings=settings, **BED, **more)


@pytest.fixture
def adapter() -> Any:
    adapter = SlcanAdapter(new_channel())
    yield adapter
    adapter.close()


@pytest.mark.parametrize("line", LINES, ids=repr)
def test_a_line_that_is_no_frame_costs_that_line(adapter: SlcanAdapter, line: bytes) -> None:
    """The next good frames are taken, and the adapter, which takes seconds for that, was not opened again."""
    with driver(**slcan(adapter.port)) as device:

        def reads(number: int) -> bool:
            adapter.say(b"t1858" + pdo(number, 0, 0, 0).hex().encode() + b"\r")
            return value(device, "T_bed") == number / 10

        assert until(lambda: reads(215))
        adapter.say(line)
        assert until(lambda: reads(225))
        assert device.attempts == 1


def test_one_line_in_a_hundred_is_spoilt(adapter: SlcanAdapter) -> None:
    """A byte of it changed, lost or doubled, or the line cut: none of that closes the adapter or ends the thread."""
    rng = random.Random(4)
    with driver(**slcan(adapter.port)) as device:
        for k in range(3000):
            line = bytearray(b"t1858" + pdo(200 + k % 50, 0, 0, 0).hex().encode() + b"\r")
            if k % 100 == 50:
                at = rng.randrange(len(line))
                line[at : at + rng.randrange(1, 4)] = rng.randbytes(rng.randrange(3))
            adapter.say(bytes(line))
            CLOCK.sleep_until_ns(CLOCK.now_ns() + MS // 5)

        def reads_on() -> bool:  # again and again: a busy PC's line may be full and lose one
            adapter.say(b"\rt1858" + pdo(285, 0, 0, 0).hex().encode() + b"\r")
            return value(device, "T_bed") == 28.5

        assert until(reads_on)
        assert device.attempts == 1
        assert device.faults() == []
        adapter.say(b"t18\r" * 5)
        assert until(lambda: any("what comes is no frame" in f for f in device.faults()))


def test_nothing_but_garbage_is_told_and_the_adapter_opened_again_with_pauses(adapter: SlcanAdapter) -> None:
    """Attempts stay bounded by the waits while it babbles; when it stops, all goes on by itself."""
    with driver(**slcan(adapter.port)) as device:
        start_ns = CLOCK.now_ns()

        def babbled() -> bool:
            adapter.say(b"t18\r" * 10)
            return device.attempts >= 4

        assert until(babbled)
        assert any("no frame; look at the adapter's cable" in f for f in device.faults())
        # 0.02, 0.04 and 0.08 s lie between the four openings, whatever the flood
        assert CLOCK.now_ns() - start_ns >= 140 * MS

        def back() -> bool:
            adapter.say(b"\rt1858" + pdo(215, 0, 0, 0).hex().encode() + b"\r")
            return value(device, "T_bed") == 21.5 and device.faults() == []

        assert until(back)


def test_positions_that_are_no_number_are_passed_over() -> None:
    """NaN and infinity in a PDO of floats; the good ones before and after are read."""
    channel = new_channel()
    axis = {"map": ["f32"], "max_speed_mm_s": 400.0}
    axes = {"X": {**axis, "node": 10}, "Z": {**axis, "node": 11}}
    counts = np.zeros(2, np.int64)
    with bus_on(channel) as bus, encoder_driver(channel, axis=axes, sync=False, timeout_ms=200.0) as device:

        def say(number: float) -> None:
            for node in (10, 11):
                bus.send(frame(0x180 + node, struct.pack("<f", number)))

        def reads(number: float) -> bool:
            say(number)
            with suppress(DriverTimeout):
                device.read_counts(counts)
            return bool(np.all(counts == number))

        assert until(lambda: reads(100))
        for wrong in (float("nan"), float("inf"), float("-inf")):
            say(wrong)
        assert until(lambda: reads(103))
        assert device._port.attempts == 1


def test_a_spindle_speed_that_is_no_number_gets_old() -> None:
    """NaN in a PDO: the last good speed stands until its timeout, then its absence is told."""
    channel = new_channel()
    spindle = {"node": 8, "pdo": 2, "map": ["f32"], "timeout_s": 0.2}
    with bus_on(channel) as bus, driver(**table(channel, spindle=spindle)) as device:

        def speed() -> float:
            with suppress(DriverTimeout):
                return device.read_spindle()
            return 0.0

        bus.send(frame(0x288, struct.pack("<f", 900.0)))
        assert until(lambda: speed() == 900.0)

        def old() -> bool:
            bus.send(frame(0x288, struct.pack("<f", float("nan"))))
            return speed() == 0.0

        assert until(old)


def test_a_counter_narrower_than_its_option_is_refused(tmp_path: Path) -> None:
    """It would wrap unseen, and every wrap look like a jump."""
    axis = {"map": ["u16"], "max_speed_mm_s": 400.0}
    axes = {"X": {**axis, "node": 10}, "Z": {**axis, "node": 11}}
    with pytest.raises(ConfigError, match="axis 'X': bits = 32, but its number in the frame has 16"):
        encoder_driver(new_channel(), axis=axes)
    encoder_driver(new_channel(), travelling(-10.0, 10.0), axis=axes, bits=16)
    pytest.importorskip("cantools", reason="cantools is not installed: pip install 'rtec[can]'")
    dbc = tmp_path / "scales.dbc"
    dbc.write_text('VERSION ""\nBU_: A\nBO_ 257 P: 8 A\n SG_ X : 0|24@1+ (1,0) [0|0] "" A\n', encoding="utf-8")
    named = {n: {"message": "P", "signal": "X", "max_speed_mm_s": 400.0} for n in ("X", "Z")}
    with pytest.raises(ConfigError, match="axis 'Z': bits = 25, but its number in the frame has 24"):
        encoder_driver(new_channel(), axis=named, dbc=str(dbc), bits=25)


def test_a_thousand_reconnects_of_encoders_leave_nothing() -> None:
    """Bus-off each time. Oracle: /proc/self/fd, the list of threads, and the worker's own count."""
    channel = new_channel()
    off = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False)
    waits = {"first_retry_s": 0.0001, "longest_retry_s": 0.0001}
    with bus_on(channel) as bus, encoder_driver(channel, **waits) as device:
        files, threads = open_files(), threading.active_count()

        def again() -> bool:
            bus.send(off)
            return device._port.attempts > 1000

        assert until(again, 60.0, period_ms=0.2)
        assert (open_files(), threading.active_count()) == (files, threads)
