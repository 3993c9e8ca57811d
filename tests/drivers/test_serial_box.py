"""The driver of the encoder box and a box in memory, on a virtual clock: every fault at an exact instant.

Oracle of each test: the box and the plant behind it, which share no code with the driver, and the virtual clock.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.loop.clock import VirtualClock
from rtec_drivers.box.driver import SerialBoxDriver
from tests.support import box_rig
from tests.support.box_rig import MS, MemoryBench, in_memory, options
from tests.support.conformance import MACHINE

TIMEOUT_NS = 600_000
SHORT = replace(MACHINE, axes=tuple(replace(a, travel_mm=(-8.0, 8.0)) for a in MACHINE.axes))
"""A machine whose travel, 32 000 counts, fits into counters of 16 bits."""
each_box = box_rig.each_box


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryBench]:
    """Started and resumed: three cycles are over."""
    with in_memory(monkeypatch) as bench:
        for _ in range(3):
            bench.cycle(0, 0)
        yield bench


def faults_of(bench: MemoryBench, cycles: int, *output: int) -> list[DriverError | None]:
    """What each of so many cycles met while reading; it commands all the same, as the loop does."""
    out: list[DriverError | None] = []
    for _ in range(cycles):
        bench.next_cycle()
        out.append(None)
        if output:
            bench.output[:] = output
        for action in (bench.read, lambda: bench.driver.apply(bench.output)):
            try:
                action()
            except DriverError as e:
                out[-1] = out[-1] or e
    return out


def test_counts_commands_and_ledger(bench: MemoryBench) -> None:
    """What the plant has is read; what is commanded stands in the plant; the reading's instant is that of asking."""
    bench.plant.position = [12_345, -7]
    bench.driver.resume()
    bench.next_cycle()
    asked_ns = bench.clock.now_ns()
    assert bench.read() == asked_ns
    assert bench.counts.tolist() == [12_345, -7]
    for _ in range(5):
        bench.cycle(10, -6)
    assert bench.plant.inserted == [10, -6]
    assert bench.ledger() == [10, -6]


def test_axes_in_another_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """The box's first input is Z. Oracle: the plant, which knows its inputs only."""
    with in_memory(monkeypatch, axes=("Z", "X")) as bench:
        bench.plant.position = [50, 7]
        bench.driver.resume()
        assert bench.cycle(3, 4) == [7, 50]
        bench.cycle()
        assert bench.plant.inserted == [4, 3]
        assert bench.ledger() == [3, 4]


def test_one_exchange_a_cycle(bench: MemoryBench) -> None:
    """A cycle takes one way to the box and one back, and nothing after the command."""
    bench.cycle(1, 1)
    for _ in range(10):
        bench.next_cycle()
        start_ns = bench.clock.now_ns()
        bench.read()
        bench.driver.apply(bench.output)
        assert bench.clock.now_ns() - start_ns == 2 * bench.line.WIRE_NS


def test_one_percent_wrong_bits_both_ways_lose_nothing(bench: MemoryBench) -> None:
    """4000 cycles with moving axes: each reading that is taken is right, and the ledger follows to the last count."""
    bench.faults.flip_rate = 0.01
    bench.cycle(0, 0)
    failed, write = 0, bench.line.write
    dice = np.random.default_rng(3)

    def noisy(data: bytes) -> None:
        if dice.random() < 0.01:
            spoilt = bytearray(data)
            spoilt[int(dice.integers(len(data)))] ^= 1 << int(dice.integers(8))
            data = bytes(spoilt)
        write(data)

    bench.line.write = noisy  # type: ignore[method-assign]
    for k in range(4000):
        bench.plant.position = [5 * k, -3 * k]
        bench.output[:] = (k // 10, -k // 20)
        bench.next_cycle()
        try:
            bench.read()
            assert bench.counts.tolist() == bench.plant.position
        except DriverTimeout:
            failed += 1
        bench.driver.apply(bench.output)
    assert 40 < failed < 160
    assert bench.faults.garbled > 20
    assert bench.longest_ns <= TIMEOUT_NS
    for _ in range(20):
        faults_of(bench, 1)
    assert bench.plant.inserted == bench.output.tolist()
    assert not bench.driver.must_resume


def test_a_late_answer_is_an_older_reading(bench: MemoryBench) -> None:
    """Each answer comes 1.5 ms late, after the next question. It belongs to the older one, and so does its instant."""
    bench.cycle(0, 0)
    bench.faults.late_ns = 1_500_000
    read = []
    for k in range(10):
        bench.next_cycle()
        bench.plant.position = [k, k]
        start_ns = bench.clock.now_ns()
        try:
            read.append((start_ns, bench.read(), bench.counts.tolist()))
        except DriverTimeout:
            assert k == 0
    assert len(read) == 9
    for k, (start_ns, instant_ns, counts) in enumerate(read, 1):
        assert start_ns - instant_ns == MS
        assert counts == [k - 1, k - 1]
    assert bench.longest_ns <= TIMEOUT_NS


def test_half_a_frame_costs_one_cycle(bench: MemoryBench) -> None:
    bench.cycle(0, 0)
    for length in range(1, 30):
        bench.faults.cut_next = length
        assert isinstance(faults_of(bench, 1)[0], DriverTimeout)
        assert faults_of(bench, 1) == [None]


def test_babbling_garbage_before_every_answer_is_passed_over(bench: MemoryBench) -> None:
    """Noise with zeros in it, and a whole foreign frame."""
    bench.cycle(0, 0)
    for babble in (b"\xff\xfe\x00\x00\x01\x00U", b"\x00" * 50, bytes(range(256)), b"\x05\x01\x82\x07\x01\x00"):
        bench.faults.babble = babble
        bench.plant.position = [bench.plant.position[0] + 5, 0]
        assert bench.cycle() == bench.plant.position


def test_garbage_without_an_end_takes_no_longer_than_silence(bench: MemoryBench) -> None:
    """Bytes at every instant, never an answer."""
    bench.cycle(0, 0)
    bench.line.read = lambda: b"\x55" * 1000  # type: ignore[method-assign]
    bench.line.wait = lambda timeout_s: timeout_s > 0  # type: ignore[method-assign]
    assert isinstance(faults_of(bench, 1)[0], DriverTimeout)
    assert bench.longest_ns <= TIMEOUT_NS


def test_silence_is_not_waited_for_for_ever(bench: MemoryBench) -> None:
    """For 50 ms each cycle waits; then it asks every 20 ms and does not wait; the first answer ends that."""
    bench.cycle(4, 4)
    bench.line.deaf = True
    assert all(isinstance(e, DriverTimeout) for e in faults_of(bench, 60))
    asked, write = [], bench.line.write

    def note(data: bytes) -> None:
        asked.append(data[3])
        write(data)

    bench.longest_ns = 0
    bench.line.write = note  # type: ignore[method-assign]
    assert all(isinstance(e, DriverTimeout) for e in faults_of(bench, 200))
    assert bench.longest_ns == 0
    assert 9 <= sum(1 for kind in asked if kind == 0x02) <= 11
    bench.line.deaf = False
    came = faults_of(bench, 30, 5, 5)
    assert came[-1] is None
    assert sum(e is not None for e in came) <= 23
    assert bench.plant.inserted == [5, 5]


@pytest.mark.parametrize("pause_ms", [40, 60, 100, 1000])
def test_a_loop_that_pauses_is_no_silence_of_the_box(bench: MemoryBench, pause_ms: int) -> None:
    """Nobody asks for a while. Oracle: the plant, and one way to the box and back, which is as old as counts are."""
    for k in range(5):  # the first is the pause after opening
        bench.clock.sleep_until_ns(bench.clock.now_ns() + pause_ms * MS)
        bench.plant.position = [k, -k]
        start_ns = bench.clock.now_ns()
        assert bench.read() == start_ns
        assert bench.counts.tolist() == [k, -k]
        bench.driver.apply(bench.output)
        assert bench.clock.now_ns() - start_ns == 2 * bench.line.WIRE_NS


def test_the_box_holds_what_it_has_while_nobody_commands(bench: MemoryBench) -> None:
    """100 ms of silence: the plant keeps what it has, and the next command goes on from there without an order."""
    for _ in range(5):
        bench.cycle(8, -8)
    bench.line.deaf = True
    faults_of(bench, 500)
    bench.box.tick(bench.clock.now_ns())
    assert bench.plant.inserted == [8, -8]
    bench.line.deaf = False
    faults_of(bench, 40, 9, -9)
    assert bench.plant.inserted == [9, -9]


def test_a_box_that_starts_anew_is_not_commanded_until_ordered(bench: MemoryBench) -> None:
    """Its ledger is zero and so are its counters. Nothing is read or commanded, and why is said, until the order."""
    bench.plant.position = [5000, 5000]
    bench.driver.resume()
    for _ in range(5):
        bench.cycle(12, 3)
    assert bench.driver.supply == 1
    bench.box.reset()
    bench.plant.position = [0, 0]
    took = bench.box.commands
    for error in faults_of(bench, 300):
        assert isinstance(error, DriverFault)
        assert "restarted (start 2, before 1)" in str(error)
        assert "holds until it is ordered to resume" in str(error)
    assert bench.box.commands == took
    assert bench.plant.inserted == [0, 0]
    assert bench.counts.tolist() == [5000, 5000]
    assert bench.ledger() == [0, 0]
    bench.driver.resume()
    faults_of(bench, 5, 2, 1)
    assert bench.plant.inserted == [2, 1]
    assert bench.counts.tolist() == [0, 0]
    assert bench.driver.supply == 2  # an order to resume does not hide the other start


def test_after_the_order_a_jump_is_refused(bench: MemoryBench) -> None:
    """The loop still wants 500 counts, the box has none: never in one go. Within 16 counts it may."""
    bench.box.reset()
    faults_of(bench, 3)
    bench.driver.resume()
    errors = faults_of(bench, 5, 500, 0)
    assert all("first command [500, 0] is 500 counts off" in str(e) for e in errors)
    assert bench.plant.inserted == [0, 0]
    assert faults_of(bench, 3, 16, -16) == [None] * 3
    for k in range(3):
        assert faults_of(bench, 20, 16 + 30 * k, 0) == [None] * 20
    assert bench.plant.inserted == [76, 0]


def test_a_box_that_starts_anew_under_the_same_number(bench: MemoryBench) -> None:
    """Its number did not change, but it says itself that it does not insert."""
    bench.cycle(5, 5)
    bench.box.reset()
    bench.box._boot = 1
    assert "stopped inserting by itself" in str(faults_of(bench, 2)[-1])
    assert bench.driver.must_resume


def test_a_fault_of_an_encoder_holds_until_ordered(bench: MemoryBench) -> None:
    """As long as the fault stands, the order is not taken up."""
    bench.cycle(0, 0)
    bench.box.encoder_fault = True
    assert "fault of an encoder's signal" in str(faults_of(bench, 1)[0])
    bench.box.encoder_fault = False
    assert "fault of an encoder's signal" in str(faults_of(bench, 1)[0])
    bench.box.encoder_fault = True
    bench.driver.resume()
    for error in faults_of(bench, 5):
        assert "sees, or saw, a fault of an encoder's signal" in str(error)
    bench.box.encoder_fault = False
    assert faults_of(bench, 3)[1:] == [None, None]


def test_a_run_starts_on_a_box_that_remembers_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fault is long over. Starting is an order; with the first command the box looks again."""
    with in_memory(monkeypatch) as bench:
        bench.box.encoder_fault = True
        faults_of(bench, 3)
        bench.box.encoder_fault = False
        assert "sees, or saw, a fault" in str(faults_of(bench, 1)[0])
        assert faults_of(bench, 3) == [None] * 3
    with in_memory(monkeypatch) as bench:
        bench.box.encoder_fault = True
        bench.box.tick(bench.clock.now_ns() + MS)
        bench.box.encoder_fault = False
        bench.driver.__exit__(None, None, None)
        bench.driver.__enter__()
        assert "sees, or saw, a fault" in str(faults_of(bench, 1)[0])
        assert faults_of(bench, 3) == [None] * 3


def test_opening_alone_resumes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dry run opens, reads and leaves: the box still waits. The first command brings the order with it."""
    with in_memory(monkeypatch) as bench:
        bench.plant.position = [5, 6]
        bench.driver.resume()
        for _ in range(5):
            bench.next_cycle()
            bench.read()
        assert bench.counts.tolist() == [5, 6]
        assert bench.ledger() == [0, 0]
        assert not bench.box._resumed
        bench.cycle(2, 2)
        assert bench.box._resumed
        bench.cycle()
        assert bench.plant.inserted == [2, 2]


def test_an_order_that_the_box_does_not_take_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten may be lost on the way."""
    with in_memory(monkeypatch) as bench:
        write, resume = bench.line.write, 0x04
        bench.line.write = lambda data: None if data[3] == resume else write(data)  # type: ignore[method-assign]
        errors = faults_of(bench, 30)
    assert errors[:10] == [None] * 10
    assert all("does not take the order to resume" in str(e) for e in errors[12:])


def test_a_counter_alone_notices_another_start_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another device is the actuator: no command ever goes out, and yet the position is lost with the start."""
    with in_memory(monkeypatch) as bench:
        bench.next_cycle()
        bench.read()
        bench.box.reset()
        bench.next_cycle()
        with pytest.raises(DriverFault, match="restarted"):
            bench.read()


def test_a_frozen_box_is_told(bench: MemoryBench) -> None:
    """Answers come, good in every bit, and are always the same. When it goes on, so does the driver."""
    bench.cycle(0, 0)
    bench.box.frozen = True
    errors = faults_of(bench, 50)
    assert all("its clock stands still" in str(e) for e in errors[1:])
    bench.box.frozen = False
    assert faults_of(bench, 3) == [None] * 3


def test_counts_faster_than_the_machine(bench: MemoryBench) -> None:
    """A slip is refused and passes; a jump that stays holds until ordered. 800 counts a millisecond are allowed."""
    bench.cycle(0, 0)
    bench.plant.position = [800, 0]
    assert bench.cycle() == [800, 0]
    bench.plant.position = [5000, 0]
    assert "axis X jumped by 4200 counts" in str(faults_of(bench, 1)[0])
    assert bench.counts.tolist() == [800, 0]
    bench.plant.position = [810, 0]
    assert bench.cycle() == [810, 0]
    bench.plant.position = [90_000, 0]
    errors = faults_of(bench, 400)
    assert all(isinstance(e, DriverFault) for e in errors)
    assert "the position is not known; the correction holds" in str(errors[-1])
    bench.driver.resume()
    faults_of(bench, 2)
    assert bench.counts.tolist() == [90_000, 0]


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_counters_wrap(monkeypatch: pytest.MonkeyPatch, bits: int) -> None:
    """The axis goes from just below the wrap to above it and back. Oracle: the plant's own integers."""
    with in_memory(monkeypatch, {"counter_bits": bits}, SHORT) as bench:
        edge = 1 << (bits - 1)
        bench.plant.position = [edge - 2000, -edge + 2000]
        bench.driver.resume()
        bench.cycle(0, 0)
        for k in [*range(20), *range(20, -1, -1)]:
            bench.plant.position = [edge - 2000 + 400 * k, -edge + 2000 - 400 * k]
            assert bench.cycle() == bench.plant.position


def test_a_counter_that_may_have_gone_round_unseen(monkeypatch: pytest.MonkeyPatch) -> None:
    """16 bits and 60 ms of silence at 800 counts/ms at most: nobody knows the position."""
    with in_memory(monkeypatch, {"counter_bits": 16}, SHORT) as bench:
        bench.cycle(0, 0)
        bench.line.deaf = True
        faults_of(bench, 60)
        bench.line.deaf = False
        assert "may have gone round unseen" in str(faults_of(bench, 30)[-1])
        assert bench.driver.must_resume


def test_commands_that_do_not_arrive_are_told(bench: MemoryBench) -> None:
    """Questions arrive, commands do not. Oracle: 50 ms, the option."""
    bench.cycle(1, 1)
    write = bench.line.write
    bench.line.write = lambda data: None if len(data) > 20 else write(data)  # type: ignore[method-assign]
    errors = faults_of(bench, 100, 2, 2)
    assert errors[:50] == [None] * 50
    assert all("has taken no command for" in str(e) for e in errors[53:])
    bench.line.write = write  # type: ignore[method-assign]
    faults_of(bench, 2)
    assert faults_of(bench, 3) == [None] * 3


@pytest.mark.parametrize(
    ("box", "more", "words"),
    [
        ({"box_serial": 7}, {"box_serial": 8}, "box number 7 answers, not 8"),
        ({"counter_bits": 20}, {}, "counters of 20 bits"),
        ({"counter_bits": 16}, {}, "counters of 16 bits go round within the travel of X, Z; after a start nobody"),
    ],
)
def test_the_wrong_box(monkeypatch: pytest.MonkeyPatch, box: Any, more: Any, words: str) -> None:
    """Oracle: the message; the line is closed."""
    with pytest.raises(DriverFault, match=words), in_memory(monkeypatch, box, **more):
        pass


def test_a_silent_port_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody answers the greeting within `open_timeout_s`, and no longer is waited."""
    clock = VirtualClock()
    monkeypatch.setattr("tests.support.box_rig.BoxSimulator.receive", lambda *_: b"")
    monkeypatch.setattr("tests.support.box_rig.VirtualClock", lambda _: clock)
    with pytest.raises(DriverTimeout, match="no encoder box answers within 3 s"), in_memory(monkeypatch):
        pass
    assert clock.now_ns() == pytest.approx(3e9, rel=0.01)


def test_what_the_options_refuse() -> None:
    """Oracle: the messages."""
    for more, words in (
        ({"port": None}, "give port .* or usb_serial"),
        ({"max_speed_mm_s": {"X": 1.0}}, "max_speed_mm_s: axis 'Z' is missing"),
        ({"max_speed_mm_s": {"X": 1.0, "Z": 1.0, "x": 1.0}}, "has no axis 'x'; "),
        ({"axes": ("X", "X")}, "'X' is there 2 times"),
        ({"axes": ("X", "ZZ")}, "no axis 'ZZ'; did you mean 'Z'"),
        ({"parity": "odds"}, "parity"),
    ):
        with pytest.raises(ConfigError, match=words):
            SerialBoxDriver(options(**more), MACHINE, VirtualClock())


def test_a_number_that_does_not_fit_is_not_sent(bench: MemoryBench) -> None:
    bench.cycle(0, 0)
    bench.output[:] = (2**31, 0)
    with pytest.raises(DriverFault, match="do not fit into 32 bits"):
        bench.driver.apply(bench.output)


def test_before_and_after(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not entered: nothing is known and nothing can be done. After leaving the box keeps what it has."""
    driver = SerialBoxDriver(options(), MACHINE, VirtualClock())
    with pytest.raises(DriverUnavailable, match="has not told its ledger"):
        driver.read_output(np.zeros(2, np.int64))
    with in_memory(monkeypatch) as bench:
        for _ in range(3):
            bench.cycle(3, 3)
    assert bench.line.closed
    assert bench.plant.inserted == [3, 3]
    with pytest.raises(DriverUnavailable, match="not entered"):
        bench.read()
