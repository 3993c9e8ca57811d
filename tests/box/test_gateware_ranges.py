"""What a board may tie, what may come on the line, and where numbers end: bit by bit, on the chip of the boards.

Oracles: docs/rtec-box-link.md, whose frames are packed here by `struct`; and arithmetic modulo 2^32.
"""

import struct
from collections.abc import Iterator

import numpy as np
import pytest

from rtec.correction.quadrature import encode
from rtec_drivers.box.gateware import Chip
from rtec_drivers.box.simulator import crc32, unstuff
from tests.support import gateware
from tests.support.gateware import BOARD, frame, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())
HELLO, READ, COMMAND, RESUME = 1, 2, 3, 4
NOT_RESUMED, HELD, FAULT = 1, 2, 8
CHEQUERED = (0x5555_5555, 0xAAAA_AAAA)
STILL = [0, 0, 0]


@pytest.fixture
def chip() -> Iterator[Chip]:
    with gateware.chip(3, **BOARD) as made:
        yield made


def asked(chip: Chip, *frames: bytes) -> list[bytes]:
    """Send frames; the bodies of what is answered, without their CRC, which must be right."""
    for data in frames:
        chip.send(data)
    chip.settle()
    bodies = [unstuff(block) for block in chip.received().split(b"\0") if block]
    assert all(crc32(b[:-4]) == int.from_bytes(b[-4:], "little") for b in bodies)
    return [b[:-4] for b in bodies]


def state(chip: Chip, number: int = 7) -> tuple[int, ...]:
    """What a READ says: boot, status, last command, time, then raw and inserted of each axis."""
    (body,) = asked(chip, frame(READ, number))
    assert body[:4] == struct.pack("<BBH", 1, 0x82, number)
    return struct.unpack("<HBHI" + "Ii" * 3, body[4:])


def command(number: int, *targets: int, boot: int = 1) -> bytes:
    return frame(COMMAND, number, struct.pack("<H3i", boot, *targets))


def resumed(chip: Chip) -> None:
    assert len(asked(chip, frame(RESUME, 1, (1).to_bytes(2, "little")))) == 1


def test_info_says_every_bit_that_a_board_ties(chip: Chip) -> None:
    for bits in (*CHEQUERED, 0xFFFF_FFFF, 0):
        short, byte = bits & 0xFFFF, bits & 0xFF
        chip.settings(
            boot=short, box_serial=bits, counter_bits=byte, hold_after_ms=short, counts_per_s=bits,
            interval=bits & 0xF_FFFF, limit=bits,
        )  # fmt: skip
        (info,) = asked(chip, frame(HELLO, short))
        assert info == struct.pack("<BBHHIBBHI", 1, 0x81, short, short, bits, 3, byte, short, bits)


def test_other_kinds_versions_and_lengths_are_dropped(chip: Chip) -> None:
    """But a HELLO of any version, which is answered. Oracle: "Frame" and "Types" of the link's page."""
    for byte in (0x55, 0xAA, 0xFF, 0x40, 0):
        assert asked(chip, frame(byte, 1), frame(READ, 2, version=byte)) == []
        (info,) = asked(chip, frame(HELLO, 3, version=byte))
        assert info[:2] == b"\x01\x81"
    for payload in (b"\1", bytes(range(20, 55))):
        assert asked(chip, *(frame(kind, 5, payload) for kind in (HELLO, READ, COMMAND, RESUME))) == []
    assert state(chip)[1] == NOT_RESUMED


def test_numbers_of_frames_and_starts(chip: Chip) -> None:
    """Another start's RESUME does nothing; the last command is the one that was taken."""
    for bits in (0x5555, 0xAAAA, 0xFFFF, 0):
        (answer,) = asked(chip, frame(RESUME, bits, bits.to_bytes(2, "little")))
        assert answer[2:4] == bits.to_bytes(2, "little")
        assert answer[6] & NOT_RESUMED
    resumed(chip)
    for bits in (0x5555, 0xAAAA, 0xFFFF, 0):
        assert asked(chip, command(bits, 0, 0, 0), command(bits ^ 1, 9, 9, 9, boot=2)) == []
        assert state(chip, bits)[:3] == (1, 0, bits)


def test_counts_go_round_at_both_ends(chip: Chip) -> None:
    """Raw counts and what was inserted, of every axis. Oracle: arithmetic modulo 2^32."""
    resumed(chip)
    chip.settings(interval=12)
    for sign in (1, -1):
        far = [sign * (2**31 - 5), -sign * (2**31 - 5), sign * 0x5555_5555]
        chip.run(30_000, far)
        asked(chip, command(1, -6 * sign, 7 * sign, -8 * sign))
        chip.run(60_000, [place + 10 * sign for place in far])
        has = state(chip)[4:]
        assert list(has[::2]) == [(place + 10 * sign) % 2**32 for place in far]
        assert list(has[1::2]) == [-6 * sign, 7 * sign, -8 * sign]


def test_every_axis_has_its_index_and_its_faults(chip: Chip) -> None:
    """An index at a negative count; both lines at once; a receiver that sees no proper signal."""
    for axis in range(3):
        resumed(chip)
        place = -(np.arange(400) // 20)
        a, b = encode(place)
        chip.lines(axis, a, b, np.isin(place, (-7, -10)).astype(np.uint8))
        assert chip.ledger(axis).at_index == -10
        assert state(chip)[1] == 0
        still, both = np.zeros(200, np.uint8), np.zeros(200, np.uint8)
        both[100:] = 1
        chip.lines(axis, a[-1] ^ both, b[-1] ^ both, still)
        assert state(chip)[1] == FAULT
        resumed(chip)
        assert state(chip)[1] == 0
        chip.broken(1 << axis)
        chip.run(10, STILL)
        assert asked(chip, frame(RESUME, 1, (1).to_bytes(2, "little")))[0][6] == FAULT
        chip.broken(0)
        chip.run(10, STILL)
        assert state(chip)[1] == FAULT  # remembered until RESUME


def test_a_broken_encoder_is_not_resumed(chip: Chip) -> None:
    """RESUME takes sound encoders. Oracle: "What the box does", 2."""
    order = frame(RESUME, 1, (1).to_bytes(2, "little"))
    for axis in range(3):
        chip.broken(1 << axis)
        chip.run(10, STILL)
        assert asked(chip, order)[0][6] == NOT_RESUMED | FAULT
    chip.broken(0)
    chip.run(10, STILL)
    assert asked(chip, order)[0][6] == 0


def test_the_longest_interval(chip: Chip) -> None:
    """Two counts, the second no earlier than 2^20 - 1 clocks behind the first."""
    resumed(chip)
    chip.settings(interval=2**20 - 1, hold_after_ms=1000)
    asked(chip, command(1, 2, 2, 2))
    chip.run(2**20 - 1000, STILL)
    assert [chip.ledger(axis).inserted for axis in range(3)] == [1, 1, 1]
    chip.run(2000, STILL)
    assert [chip.ledger(axis).inserted for axis in range(3)] == [2, 2, 2]


def test_the_time_goes_round(chip: Chip) -> None:
    """Some 110 µs before the end, and 220 µs later."""
    chip.since(2**32 - 150, 0)
    before, after = (state(chip)[3] for _ in range(2))
    assert 2**32 - 150 < before < 2**32
    assert after < 300


@pytest.mark.parametrize("silent_ms", [0x5555, 0xAAAA, 0xFFFF])
def test_the_longest_silence(chip: Chip, silent_ms: int) -> None:
    """It holds between `hold_after_ms` and 2 ms more; here it begins 1 ms before."""
    resumed(chip)
    chip.settings(hold_after_ms=silent_ms)
    chip.since(0, silent_ms - 1)
    chip.run(chip.clk_hz // 1000 // 2, STILL)
    assert state(chip)[1] == 0
    chip.run(3 * chip.clk_hz // 1000, STILL)
    assert state(chip)[1] == HELD


def test_a_spike_on_the_serial_line_is_no_start_bit(chip: Chip) -> None:
    """Shorter than half a bit. The frame behind it is read, at whatever distance, a byte's length and less."""
    for clocks in (1, 2):
        for wait in range(4, 44, 3):
            chip.glitch(clocks)
            chip.run(wait, STILL)
            assert [body[1] for body in asked(chip, frame(HELLO, 1))] == [0x81]


def test_questions_that_come_faster_than_answers(chip: Chip) -> None:
    """Two READs at once are both answered: the second waits for the line."""
    bodies = asked(chip, frame(READ, 1), frame(READ, 2))
    assert [int.from_bytes(body[2:4], "little") for body in bodies] == [1, 2]
