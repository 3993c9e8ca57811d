"""The encoder box on a CAN bus. Oracle throughout: a box written from `docs/can.md` alone, and what it was told."""

import struct
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from rtec.correction.sinks import FollowingErrorSink
from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.tomlfile import validated
from rtec_drivers.can import box as frames
from rtec_drivers.can.box import CanBoxDriver, CanBoxOptions, CanBoxSession
from tests.support.can_peer import BASE, CLOCK, MS, FakeBox, box_bytes, crc8, new_channel
from tests.support.conformance import MACHINE, DriverLaws, Rig, open_files
from tests.support.modbus_peer import until

SPEED = {"X": 400.0, "Z": 400.0}


def info_number(version: int, axes: int, hold_after_ms: int) -> int:
    """Number of an INFO frame: version (8 bits), axes (8 bits), time until it holds (16 bits)."""
    number: int = struct.unpack("<i", struct.pack("<BBH", version, axes, hold_after_ms))[0]
    return number


def options(channel: str, **more: Any) -> dict[str, Any]:
    table = {"interface": "virtual", "channel": channel, "max_speed_mm_s": SPEED, "timeout_ms": 50.0}
    return {**table, "open_timeout_s": 1.0, "first_retry_s": 0.02, "longest_retry_s": 0.1, **more}


def driver(channel: str, **more: Any) -> CanBoxDriver:
    return CanBoxDriver(validated(CanBoxOptions, options(channel, **more), "run.toml"), MACHINE, CLOCK)


@pytest.fixture
def channel() -> str:
    return new_channel()


@pytest.fixture
def box(channel: str) -> Iterator[FakeBox]:
    fake = FakeBox(channel)
    yield fake
    fake.close()


class TestCanBox(DriverLaws):
    @pytest.fixture
    def rig(self, channel: str, box: FakeBox) -> Rig:
        del box
        return Rig(
            CanBoxDriver,
            options(channel),
            misspelt="base_it",
            nearest="base_id",
            wrong_sinks=[FollowingErrorSink(resolution_um=1.0)],
            missing={"channel": "rtec-nobody-there", "open_timeout_s": 0.1},
        )


def newest(device: CanBoxDriver) -> tuple[int, ...]:
    """Counts of one cycle; a cycle of 1 ms."""
    counts = np.zeros(2, np.int64)
    CLOCK.sleep_until_ns(CLOCK.now_ns() + MS)
    device.read_counts(counts)
    return tuple(counts.tolist())


def cycles(device: CanBoxDriver, count: int) -> None:
    for _ in range(count):
        newest(device)


def command(device: CanBoxDriver, *targets: int) -> None:
    with suppress(DriverError):
        newest(device)
    device.apply(np.array(targets, np.int64))


def test_frames_are_those_of_the_description() -> None:
    """Oracle: the catalogue's check value of CRC-8/AUTOSAR, and bytes computed apart, as in docs/can.md."""
    assert frames.crc8(b"123456789") == crc8(b"123456789") == 0xDF
    text = (Path(__file__).parents[2] / "docs" / "can.md").read_text(encoding="utf-8")
    for place, number, sequence, boot, bits in ((0x00, 1, 5, 7, 3), (0x10, -123456, 5, 7, 0), (0x21, 42, 200, 7, 0)):
        made = frames.pack(BASE + place, frames.BoxFrame(number, sequence, boot, bits))
        assert made == box_bytes(BASE + place, number, sequence, boot, bits)
        assert made.hex(" ") in text
        assert frames.unpack(BASE + place, made) == frames.BoxFrame(number, sequence, boot, bits)
        assert frames.unpack(BASE + place + 1, made) is None
        for k in range(64):
            broken = bytearray(made)
            broken[k // 8] ^= 1 << (k % 8)
            assert frames.unpack(BASE + place, bytes(broken)) is None
    assert frames.info_of(info_number(1, 3, 65000)) == (1, 3, 65000)


def test_all_axes_are_of_one_instant(channel: str, box: FakeBox) -> None:
    """Oracle: the box moves both counters together at every latch; a reading that mixes latches would show.

    Every seventh frame is lost, so that the axes' newest frames are often of different latches.
    """

    def move() -> None:
        box.counts = [box.counts[0] + 3, box.counts[1] - 3]

    box.on_latch = move
    seen = set()
    with driver(channel) as device:
        box.spoil = lambda k, data: None if k % 7 == 0 else data
        for _ in range(200):
            with suppress(DriverTimeout):
                seen.add(newest(device))
    assert len(seen) > 50
    assert all(x == -z for x, z in seen)


def test_lost_and_damaged_frames_lose_nothing(channel: str, box: FakeBox) -> None:
    """Oracle: every tenth frame of the box is lost and every seventh damaged; the ledger ends where it was ordered."""

    def spoil(k: int, data: bytes) -> bytes | None:
        if k % 10 == 3:
            return None
        return bytes([data[0] ^ 64, *data[1:]]) if k % 7 == 5 else data

    box.counts = [1000, -1000]
    with driver(channel) as device:
        command(device, 0, 0)
        box.spoil = spoil
        good = 0
        for k in range(300):
            with suppress(DriverTimeout):
                assert newest(device) == (1000, -1000)
                good += 1
            device.apply(np.array([k // 10, -k // 10]))
        assert good > 250
        assert until(lambda: _ledger(device) == (29, -30))
    assert box.ledger == [29, -30]


def _ledger(device: CanBoxDriver) -> tuple[int, ...]:
    output = np.zeros(2, np.int64)
    with suppress(DriverTimeout):
        newest(device)
    try:
        device.read_output(output)
    except DriverUnavailable:  # its counts came, its ledger not yet
        return ()
    return tuple(output.tolist())


def test_repeated_commands_change_nothing_and_are_few(channel: str, box: FakeBox) -> None:
    """Oracle: the box's own list of commands; 200 cycles of 1 ms with one command need no more than one in 20 ms."""
    with driver(channel) as device:
        for _ in range(200):
            command(device, 5, 6)
        assert box.ledger == [5, 6]
        assert {(a, n) for a, n, _ in box.commands} == {(0, 5), (1, 6)}
        assert len(box.commands) < 2 * (200 * 3 // 20 + 4)


def test_a_command_that_is_lost_is_made_good_while_nothing_else_changes(channel: str, box: FakeBox) -> None:
    """Oracle: the box's ledger; it hears one command frame in three."""
    with driver(channel) as device:
        command(device, 0, 0)
        box.deaf = lambda k: k % 3 != 0
        assert until(lambda: command(device, 12, -12) is None and box.ledger == [12, -12])  # type: ignore[func-returns-value]


def test_a_box_that_started_anew_is_not_commanded_until_ordered(channel: str, box: FakeBox) -> None:
    with driver(channel, command_timeout_s=10.0) as device:
        command(device, 8, 9)
        assert until(lambda: _ledger(device) == (8, 9))
        assert device.supply == (first := box.boot)
        box.restart()
        with pytest.raises(DriverFault, match=r"restarted .* ledger is zero again; the correction holds"):
            cycles(device, 50)
        assert "restarted" in device.must_resume
        for _ in range(20):
            with pytest.raises(DriverFault, match="until it is ordered to resume"):
                device.apply(np.array([8, 9]))
            with pytest.raises(DriverFault, match="until it is ordered to resume"):
                newest(device)
        assert box.ledger == [0, 0]
        assert not box.resumed
        device.resume()
        assert until(lambda: _resumed(device) and _ledger(device) == (0, 0))
        with pytest.raises(DriverFault, match="must take over the box's ledger first"):
            device.apply(np.array([800, 9]))
        command(device, 1, 1)
        assert until(lambda: _ledger(device) == (1, 1))
        assert device.supply == box.boot != first


def _resumed(device: CanBoxDriver) -> bool:
    with suppress(DriverTimeout, DriverFault):
        newest(device)
        return True
    return False


def test_a_silent_box_is_told_and_comes_back_by_itself(channel: str, box: FakeBox) -> None:
    with driver(channel) as device:
        assert newest(device) == (0, 0)
        box.silent = True
        with pytest.raises(DriverTimeout, match=r"has sent no counts for \d+ ms"):
            cycles(device, 200)
        box.silent = False
        assert until(lambda: _resumed(device))
        assert device.must_resume == ""


def test_a_counter_goes_round_at_32_bits_and_jumps_are_refused(channel: str, box: FakeBox) -> None:
    """Oracle: 2³¹ - 2 and five counts on; then a jump of a million counts that stays."""
    box.counts = [2**31 - 2, 0]
    with driver(channel) as device:
        assert newest(device)[0] == 2**31 - 2
        box.counts = [2**31 + 3, 0]
        assert until(lambda: newest(device)[0] == 2**31 + 3)
        box.counts = [2**31 + 3, 1_000_000]
        with pytest.raises(DriverFault, match="axis Z jumped by"):
            cycles(device, 20)
        with pytest.raises(DriverFault, match="the position is not known"):
            cycles(device, 50)
        assert "the position is not known" in device.must_resume, "so that a daemon that starts again waits, too"
        with pytest.raises(DriverFault, match="the position is not known"):
            device.apply(np.zeros(2, np.int64))
        device.resume()
        assert until(lambda: _resumed(device) and newest(device)[1] == 1_000_000)


def test_wrong_box_and_wrong_options_are_told(channel: str, box: FakeBox) -> None:
    box.version = 2
    with pytest.raises(DriverFault, match="speaks version 2 of the link, rtec 1"):
        driver(channel).__enter__()
    with pytest.raises(ConfigError, match="multiple of 64"):
        driver(channel, base_id=0x141)
    with pytest.raises(ConfigError, match="axis 'Z' is missing"):
        driver(channel, max_speed_mm_s={"X": 400.0})
    with pytest.raises(DriverTimeout, match=r"does not answer within 0\.1 s"):
        driver(channel, base_id=0x400, open_timeout_s=0.1).__enter__()
    with pytest.raises(DriverUnavailable, match="not entered"):
        driver(channel).apply(np.zeros(2, np.int64))


def test_reconnects_leave_no_descriptor_and_no_thread(channel: str, box: FakeBox) -> None:
    """Oracle: /proc/self/fd and the list of threads."""
    del box
    with driver(channel):
        pass
    files, threads = open_files(), threading.active_count()
    for _ in range(100):
        with driver(channel):
            pass
    assert (open_files(), threading.active_count()) == (files, threads)


def test_a_thousand_bus_offs_leave_no_descriptor_and_no_thread(channel: str, box: FakeBox) -> None:
    """The interface is opened again each time, and the box goes on. Oracle: /proc/self/fd and the list of threads."""
    off = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False)
    with driver(channel, first_retry_s=0.0001, longest_retry_s=0.0001) as device:
        command(device, 4, 5)
        files, threads = open_files(), threading.active_count()

        def again() -> bool:
            box.bus.send(off)
            return device._port.attempts > 1000

        assert until(again, 60.0, period_ms=0.2)
        assert (open_files(), threading.active_count()) == (files, threads)
        assert until(lambda: _resumed(device) and _ledger(device) == (4, 5))


def test_an_answer_later_than_256_questions_is_not_taken_for_a_new_one() -> None:
    """An adapter that keeps frames back for 300 cycles. Oracle: the instant at which the box really latched."""
    kept: deque[tuple[int, bytes]] = deque()
    latched: dict[int, int] = {}

    def keep(n: int, data: bytes) -> None:
        kept.append((n, data))

    session = CanBoxSession(BASE, 2, keep)
    session.info, session.boot = (1, 2, 100), 7
    now_ns, readings = 0, []
    for k in range(3000):
        now_ns = k * MS
        asked = len(kept)
        session.latch(False, now_ns)
        if len(kept) > asked:
            latched[k] = kept[-1][1][4]
        if k - 300 in latched:
            for axis in (0, 1):
                identifier = BASE + 0x10 + axis
                session.take(identifier, False, box_bytes(identifier, k - 300, latched[k - 300], 7, 0), now_ns)
        newest = session.newest
        if newest is not None and newest not in readings:
            readings.append(newest)
    assert len(readings) > 20
    assert all(reading.asked_ns == reading.counts[0] * MS for reading in readings)


def test_a_silent_box_is_asked_less_often() -> None:
    """Oracle: the questions in one second of cycles of 1 ms: 50 ms at full rate, then one in 20 ms."""
    sent: list[int] = []
    session = CanBoxSession(BASE, 2, lambda n, _: sent.append(n))
    for k in range(100, 1100):
        session.latch(False, k * MS)
    assert 40 <= len(sent) <= 110


def test_a_question_that_never_left_is_not_waited_for() -> None:
    """The interface takes no frames for a while; then the first question goes out at once, in whatever cycle."""
    sent: list[int] = []
    full = [True]

    def send(n: int, _: bytes) -> None:
        if full[0]:
            raise DriverTimeout("takes no frame")
        sent.append(n)

    session = CanBoxSession(BASE, 2, send)
    for k in range(1, 2000):
        with pytest.raises(DriverTimeout):
            session.latch(False, k * MS)
    full[0] = False
    session.latch(False, 2000 * MS)
    assert len(sent) == 1


def test_an_info_frame_is_packed_as_described() -> None:
    """Oracle: struct, little-endian: version, axes, milliseconds."""
    assert struct.pack("<i", info_number(1, 2, 100)) == bytes([1, 2, 100, 0])
