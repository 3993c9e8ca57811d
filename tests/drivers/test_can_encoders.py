"""Encoders on a CAN bus as a count source. Oracle throughout: encoders written here, which latch at SYNC (CiA 406)."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import can
import numpy as np
import pytest

from rtec.errors import ConfigError, DriverFault, DriverTimeout
from rtec.loop.clock import VirtualClock
from rtec.machine import Machine
from rtec.tomlfile import validated
from rtec_drivers.can.encoders import CanEncoderOptions, CanEncodersDriver
from tests.support.can_peer import CLOCK, MS, frame, new_channel
from tests.support.conformance import MACHINE, DriverLaws, Rig
from tests.support.modbus_peer import until


class FakeEncoders:
    """Two encoders, nodes 10 and 11, with position value 6004h in their first PDO, sent at SYNC.

    Attributes:
        position: unwrapped.
        step: by so much they move at each SYNC.
        mute: nodes that do not answer.
        latched_ns: when each SYNC came.
        make: the frame of an identifier and a content.
    """

    def __init__(self, channel: str, bits: int = 32) -> None:
        self.position, self.step, self.mute, self.bits = [0, 0], [0, 0], set[int](), bits
        self.latched_ns: list[int] = []
        self.make: Callable[[int, bytes], can.Message] = frame
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._bus.shutdown()

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self._bus.recv(0.01)
            if message is None or message.arbitration_id != 0x80:
                continue
            self.latched_ns.append(CLOCK.now_ns())
            self.position = [p + s for p, s in zip(self.position, self.step, strict=True)]
            for k, p in enumerate(self.position):
                if 10 + k not in self.mute:
                    self._bus.send(self.make(0x18A + k, (p % 2**self.bits).to_bytes(4, "little")))


@contextmanager
def encoders(channel: str, bits: int = 32) -> Iterator[FakeEncoders]:
    fake = FakeEncoders(channel, bits)
    try:
        yield fake
    finally:
        fake.close()


PATIENT_MS = 1000.0
"""Longer than a busy computer keeps the encoders' thread waiting."""


def table(channel: str, **more: Any) -> dict[str, Any]:
    axis = {"map": ["u32"], "max_speed_mm_s": 400.0}
    axes = {"X": {**axis, "node": 10}, "Z": {**axis, "node": 11}}
    return {"interface": "virtual", "channel": channel, "axis": axes, "timeout_ms": PATIENT_MS, **more}


def driver(channel: str, machine: Machine = MACHINE, /, **more: Any) -> CanEncodersDriver:
    return CanEncodersDriver(validated(CanEncoderOptions, table(channel, **more), "run.toml"), machine, CLOCK)


def travelling(low_mm: float, high_mm: float) -> Machine:
    """The machine with another travel; 2000 counts a mm."""
    return replace(MACHINE, axes=tuple(replace(a, travel_mm=(low_mm, high_mm)) for a in MACHINE.axes))


def cycle(device: CanEncodersDriver) -> tuple[tuple[int, ...], int]:
    counts = np.zeros(2, np.int64)
    CLOCK.sleep_until_ns(CLOCK.now_ns() + MS)
    instant_ns = device.read_counts(counts)
    return tuple(counts.tolist()), instant_ns


def first(device: CanEncodersDriver) -> tuple[int, ...]:
    """The first reading that there is."""
    for _ in range(20_000):
        with suppress(DriverTimeout):
            return cycle(device)[0]
    raise AssertionError("no reading within 20 000 cycles")


def refused(device: CanEncodersDriver) -> str:
    """Why there is no reading now; empty where there is one."""
    try:
        cycle(device)
    except DriverTimeout as e:
        return str(e)
    return ""


def cycles(device: CanEncodersDriver, count: int) -> None:
    for _ in range(count):
        cycle(device)


@pytest.fixture
def channel() -> str:
    return new_channel()


class TestCanEncoders(DriverLaws):
    @pytest.fixture
    def rig(self, channel: str) -> Iterator[Rig]:
        with encoders(channel):
            yield Rig(
                CanEncodersDriver,
                table(channel),
                misspelt="axs",
                nearest="axis",
                missing={"interface": "slcan", "channel": "/dev/rtec-no-such-port"},
            )


def test_both_axes_are_of_the_same_sync_and_carry_its_instant(channel: str) -> None:
    with encoders(channel) as fake, driver(channel) as device:
        fake.step = [3, -3]
        first(device)
        for _ in range(100):
            (x, z), instant_ns = cycle(device)
            assert x == -z
            assert -MS < fake.latched_ns[x // 3 - 1] - instant_ns < 20 * MS


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_counters_go_round(channel: str, bits: int) -> None:
    """Oracle: the encoders' unwrapped positions; 40 counts a cycle of about 1 ms are 40 mm/s or less."""
    with encoders(channel, bits) as fake:
        fake.position = [2 ** (bits - 1) - 500, -(2 ** (bits - 1)) + 500]
        fake.step = [40, -40]
        with driver(channel, travelling(-10.0, 10.0), bits=bits) as device:
            start = first(device)
            seen = [cycle(device)[0] for _ in range(60)][-1]
            assert seen[0] > 2 ** (bits - 1)
            assert seen[1] < -(2 ** (bits - 1))
            assert (seen[0] - start[0]) % 40 == 0
            assert seen[0] - start[0] == start[1] - seen[1]


@pytest.mark.parametrize(
    ("travel_mm", "at"), [((0.0, 32.0), (50_000, 5)), ((-32.0, 0.0), (-50_000, -5)), ((-16.0, 16.0), (-15_536, 5))]
)
def test_a_start_is_within_the_travel(channel: str, travel_mm: tuple[float, float], at: tuple[int, int]) -> None:
    """Of 16 bits: unsigned, below zero, signed. Oracle: the only position within the travel that shows this number."""
    with encoders(channel, 16) as fake, driver(channel, travelling(*travel_mm), bits=16) as device:
        fake.position = list(at)
        assert until(lambda: first(device) == at)
    with pytest.raises(
        ConfigError, match=r"axis 'X': a counter of 16 bits goes round within its travel, 400000 counts"
    ):
        driver(channel, bits=16)


def test_one_encoder_that_is_silent_is_told_and_comes_back(channel: str) -> None:
    with encoders(channel) as fake, driver(channel, timeout_ms=50.0) as device:
        first(device)
        fake.mute = {11}
        assert until(lambda: refused(device).endswith("no new positions within 50 ms (waiting for Z)"))
        fake.mute = set()
        assert first(device) == (0, 0)


def test_frames_that_cannot_be_used_are_named_with_what_is_needed(channel: str) -> None:
    """Oracle: what was sent in the place of the answers: 2 bytes; 4 bytes under a 29-bit identifier; nothing."""
    with encoders(channel) as fake, driver(channel, timeout_ms=50.0) as device:
        first(device)
        fake.make = lambda number, data: frame(number, data[:2])
        short = "axis X: 18Ah comes with 2 bytes, 4 are needed for map u32; compare map with the device's object 1A00h"
        assert until(lambda: f"no new positions within 50 ms: what comes is unusable: {short}" in refused(device))
        fake.make = lambda number, data: frame(number, data, extended=True)
        long = "axis Z: 18Bh comes as a 29-bit identifier, an 11-bit one is needed; clear bit 29 of the COB-ID"
        assert until(lambda: long in refused(device))
        fake.make = frame
        assert first(device) == (0, 0)
        fake.mute = {10, 11}
        assert until(lambda: refused(device).endswith("no new positions within 50 ms (waiting for X, Z)"))


def test_the_default_longest_age_follows_the_period_of_reading(channel: str) -> None:
    """Oracle: docs/can.md: a reading is a cycle old. At 21 ms a cycle, all are good; three without an answer are not.

    The loop's clock is in the test's hands; the encoders answer when their thread runs.
    """
    clock, counts, period_ns = VirtualClock(10**12), np.zeros(2, np.int64), 21 * MS
    without = {k: v for k, v in table(channel).items() if k != "timeout_ms"}
    options = validated(CanEncoderOptions, without, "run.toml")

    def reads() -> int:
        with suppress(DriverTimeout):
            return device.read_counts(counts)
        return 0

    with encoders(channel) as fake, CanEncodersDriver(options, MACHINE, clock) as device:

        def starts() -> bool:
            clock.sleep_until_ns(clock.now_ns() + period_ns)
            return reads() > 0

        assert until(starts)
        assert until(lambda: reads() == clock.now_ns() - period_ns)
        for _ in range(20):
            asked_ns = clock.now_ns()
            clock.sleep_until_ns(asked_ns + period_ns)
            assert until(lambda asked_ns=asked_ns: reads() == asked_ns)  # type: ignore[misc]
        fake.mute = {11}
        clock.sleep_until_ns(clock.now_ns() + period_ns)
        assert reads()
        for _ in range(3):
            clock.sleep_until_ns(clock.now_ns() + period_ns)
            reads()
        with pytest.raises(DriverTimeout, match=r"no new positions within 52\.5 ms \(waiting for .*Z\)"):
            device.read_counts(counts)


def test_a_jump_that_stays_needs_an_order(channel: str) -> None:
    with encoders(channel) as fake, driver(channel) as device:
        first(device)
        fake.position = [10_000_000, 0]
        with pytest.raises(DriverFault, match="axis X jumped by 10000000 counts"):
            cycles(device, 30)
        with pytest.raises(DriverFault, match="the position is not known"):
            cycles(device, 30)
        assert any("the position is not known" in f for f in device.faults())
        device.resume()
        assert first(device) == (10_000_000, 0)


def test_without_sync_the_reading_is_as_old_as_its_oldest_frame(channel: str) -> None:
    """Oracle: the instants at which the two frames were sent, 0.3 s apart."""
    with can.Bus(interface="virtual", channel=channel) as bus, driver(channel, sync=False, timeout_ms=1000.0) as device:
        before_ns = CLOCK.now_ns()
        bus.send(frame(0x18A, (111).to_bytes(4, "little")))
        after_ns = CLOCK.now_ns()
        CLOCK.sleep_until_ns(after_ns + 300 * MS)
        second_ns = CLOCK.now_ns()
        bus.send(frame(0x18B, (222).to_bytes(4, "little")))
        assert first(device) == (111, 222)
        assert before_ns <= cycle(device)[1] < second_ns
        assert bus.recv(0.05) is None  # nothing was sent, SYNC neither


def test_axes_that_are_missing_or_wrong_are_told(channel: str) -> None:
    axis = {"node": 10, "map": ["u32"], "max_speed_mm_s": 400.0}
    assert until(lambda: True)
    with pytest.raises(ConfigError, match=r"axis 'Y': the machine has no such axis(.|\n)*axis 'Z' is missing"):
        driver(channel, axis={"X": axis, "Y": axis})
