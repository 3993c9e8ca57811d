"""The gateware's box link, UART and all, against the box in software: the same answers to the same bytes.

Oracle: `BoxSimulator`, written from docs/rtec-box-link.md and checked against its test vectors; and the counts that an
independent decoder makes of the lines that go out. The instant in an answer is the chip's own clock: only its order
is compared.
"""

import random
import struct
from collections.abc import Iterator

import pytest

from rtec_drivers.box.simulator import BoxSimulator, crc32, unstuff
from tests.support import gateware
from tests.support.box_peer import StillPlant
from tests.support.gateware import BOARD, GatewareBox, frame, line_times, missing, spi_times

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())
MS = 1_000_000
HELLO, READ, COMMAND, RESUME = 1, 2, 3, 4


def command(number: int, boot: int, *targets: int) -> bytes:
    """A COMMAND."""
    return frame(COMMAND, number, struct.pack(f"<H{len(targets)}i", boot, *targets))


def bodies(data: bytes) -> list[bytes]:
    """Frames in what came, without their CRC, which must be right."""
    out = []
    for block in data.split(b"\0"):
        if block:
            body = unstuff(block)
            assert crc32(body[:-4]) == int.from_bytes(body[-4:], "little")
            out.append(body[:-4])
    return out


class Both:
    """The gateware and the software, told the same."""

    def __init__(self, **options: int) -> None:
        self.hard_plant, self.soft_plant = StillPlant(2), StillPlant(2)
        self.hard = GatewareBox(self.hard_plant, 2, **options)
        self.soft = BoxSimulator(self.soft_plant, 2, **options)
        self.now_ns = 10**9
        self.last_us = -1

    def move(self, *position: int) -> None:
        """Both encoders go there; the gateware's take an edge after the other."""
        self.hard_plant.position, self.soft_plant.position = list(position), list(position)
        self.wait(20)

    def wait(self, ms: int) -> None:
        """Time goes by, a millisecond at a time; no box speaks unasked."""
        for _ in range(ms):
            self.now_ns += MS
            assert self.hard.idle(self.now_ns) == self.soft.idle(self.now_ns) == b""

    def tell(self, data: bytes, ms: int = 1) -> list[bytes]:
        """Send bytes; the answers must be alike. Then time goes by."""
        hard, soft = (bodies(box.receive(data, self.now_ns)) for box in (self.hard, self.soft))
        assert [self._without_time(body) for body in hard] == [self._without_time(body) for body in soft]
        for body in hard:
            if body[1] == 0x82:
                us = int.from_bytes(body[9:13], "little")
                assert us > self.last_us
                self.last_us = us
        self.wait(ms)
        return hard

    @staticmethod
    def _without_time(body: bytes) -> bytes:
        return body[:9] + body[13:] if body[1] == 0x82 else body


@pytest.fixture
def both() -> Iterator[Both]:
    made = Both(boot=7)
    yield made
    made.hard.close()


def test_a_conversation(both: Both) -> None:
    """Start, resume, counts, commands both ways; in the end the controller has what was commanded."""
    assert len(both.tell(frame(HELLO, 1))) == 1
    both.tell(frame(READ, 2))
    both.tell(command(3, 7, 5, 5))  # not resumed: dropped
    assert both.tell(frame(READ, 4))[0][6] & 1
    both.tell(frame(RESUME, 5, (8).to_bytes(2, "little")))  # another start's order
    both.tell(frame(RESUME, 6, (7).to_bytes(2, "little")))
    both.tell(command(7, 7, 12, -9), ms=5)
    both.move(1000, -2000)
    both.tell(frame(READ, 8), ms=5)
    both.tell(command(9, 8, 50, 50))  # of another start: dropped
    both.tell(frame(READ, 9))
    both.tell(command(10, 7, -3, 4), ms=5)
    both.tell(frame(READ, 11), ms=5)
    assert both.hard_plant.inserted == both.soft_plant.inserted == [-3, 4]


def test_silence_holds_and_the_next_command_goes_on(both: Both) -> None:
    """Nothing moves in silence, whatever was still to be inserted."""
    both.tell(frame(RESUME, 1, (7).to_bytes(2, "little")))
    both.tell(command(2, 7, 1, -1), ms=150)
    assert both.tell(frame(READ, 3))[0][6] & 2
    both.tell(command(4, 7, 3, 3), ms=5)
    assert not both.tell(frame(READ, 5))[0][6] & 2
    assert both.hard_plant.inserted == [3, 3]


def test_garbage_is_passed_over(both: Both) -> None:
    """Noise, cut frames, wrong CRC, wrong version, long blocks: the next whole frame is read again."""
    chance = random.Random(1)
    both.tell(frame(RESUME, 1, (7).to_bytes(2, "little")))
    for k in range(25):
        good = frame(READ, 2 + k)
        spoilt = bytearray(command(2 + k, 7, 99, 99))
        spoilt[chance.randrange(1, len(spoilt) - 1)] ^= 1 << chance.randrange(8)
        noise = bytes(chance.randrange(256) for _ in range(chance.randrange(40)))
        long = bytes(chance.randrange(1, 256) for _ in range(80))
        both.tell(chance.choice([noise, good[:-3], bytes(spoilt), frame(HELLO, 3, version=9), b"\0" + long]) + b"\0")
        assert len(both.tell(good)) == 1
    assert both.hard_plant.inserted == both.soft_plant.inserted


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_counters_wrap_at_their_width(bits: int) -> None:
    """As negative counts show."""
    both = Both(boot=3, counter_bits=bits)
    both.move(-5, 70_000)
    both.tell(frame(HELLO, 1))
    both.tell(frame(READ, 2))
    both.hard.close()


@pytest.mark.parametrize("faster", [-0.025, 0.0, 0.02])
def test_the_other_end_has_a_clock_of_its_own(faster: float) -> None:
    """At 4 clocks a bit, as on the boards. Oracle: a bit is looked at between 0.5 and 0.75 of it, and there are 9.5."""
    with gateware.chip(BAUD=1_000_000) as chip:
        chip.pace(faster)
        for n in range(40):  # the frames meet the chip's clock at different instants
            chip.send(frame(HELLO, n))
            chip.settle()
            chip.run(n, [0, 0])
        assert [int.from_bytes(body[2:4], "little") for body in bodies(chip.received())] == list(range(40))


def test_at_4_khz_no_latch_of_three_axes_is_lost() -> None:
    """READ and COMMAND every 250 µs at 12 MHz and 3 Mbaud. Oracle: the numbers asked, and axes that move as one."""
    read_us, command_us, lost = line_times()
    assert lost == 0
    # 11 bytes out and 43 in, of 10 bits, and what the chip thinks; 24 bytes out and the way through the pipeline.
    assert 180.0 < read_us < 250.0
    assert 80.0 < command_us < 100.0


def test_over_spi_at_4_khz_no_latch_of_three_axes_is_lost() -> None:
    """The same at 2 MHz; an answer goes on in the next transfer. Oracle: as above."""
    read_us, command_us, lost = spi_times()
    assert lost == 0
    # 11 bytes out and 43 in, of 8 bits, and what the chip thinks; 24 bytes out and the way through the pipeline.
    assert 216.0 < read_us < 280.0
    assert 96.0 < command_us < 110.0


@pytest.mark.parametrize("half", [2, 3, 9])
def test_over_spi_a_frame_without_zeros_is_whole(half: int) -> None:
    """Large negative numbers: the line cannot wait while the chip looks for the next zero. Oracle: what was put in.

    Faster than `spi.v` allows too: what the simulated line does not need is there for that of a board.
    """
    with gateware.chip(3, **BOARD, SPI=1) as chip:
        chip.settings(interval=12)
        chip.run(1000, [0, 0, 0])
        boot = unstuff(chip.spi(frame(HELLO, 1) + bytes(80), half).strip(b"\0"))[4:6]
        chip.spi(frame(RESUME, 2, boot) + bytes(100), half)
        chip.spi(frame(COMMAND, 0x1213, boot + struct.pack("<3i", -5, -6, -7)), half)
        places = [-0x5A5B5C5D, -0x5A5B5C5E, -0x5A5B5C5F]
        chip.run(3000, places)
        for number in range(0x2101, 0x2111):
            chip.since(0x11111111, 0)
            (state,) = bodies(chip.spi(frame(READ, number) + bytes(90), half))
            assert (state[:4], state[9:13].count(0)) == (struct.pack("<BBH", 1, 0x82, number), 0)
            raw, inserted = struct.unpack("<6i", state[13:37])[::2], struct.unpack("<6i", state[13:37])[1::2]
            assert (raw, inserted) == (tuple(places), (-5, -6, -7))


def test_the_limit_holds_whatever_is_asked(both: Both) -> None:
    """Oracle: the limit that the board ties, here 10 counts either way."""
    chip = both.hard.chip
    chip.settings(boot=7, limit=10)
    both.hard.receive(frame(RESUME, 1, (7).to_bytes(2, "little")), both.now_ns)
    for targets, has in (((50, -50), [10, -10]), ((2**31 - 1, -(2**31)), [10, -10]), ((3, -4), [3, -4])):
        both.hard.receive(command(2, 7, *targets), both.now_ns)
        chip.run(20_000, [0, 0])
        assert [chip.ledger(i).inserted for i in range(2)] == has


def test_spi_carries_the_same_frames_and_each_start_has_its_number() -> None:
    """Oracle: INFO and STATE as docs/rtec-box-link.md says; the number of the start is boot.v's own."""
    chip = gateware.chip(SPI=1)
    numbers = []
    for wait in (1000, 3456):
        chip.reset()
        chip.run(wait, [0, 0])
        answers = bodies(chip.spi(frame(HELLO, 9)) + chip.spi(bytes(60)))
        assert [a[1] for a in answers] == [0x81]
        assert answers[0][6:10] == (42).to_bytes(4, "little")
        numbers.append(answers[0][4:6])
    assert numbers[0] != numbers[1]
    chip.run(2000, [123, -45])
    chip.spi(frame(RESUME, 10, numbers[1]))
    chip.spi(bytes(60))
    (state,) = bodies(chip.spi(frame(READ, 11)) + chip.spi(bytes(60)))
    assert struct.unpack("<iiii", state[13:29])[::2] == (123, -45)
    chip.spi(command(12, int.from_bytes(numbers[1], "little"), 4, -4))
    chip.run(20_000, [123, -45])
    assert [chip.ledger(i).inserted for i in range(2)] == [4, -4]
    chip.close()


@pytest.mark.parametrize("piece", [1, 7])
def test_an_answer_over_spi_may_be_read_in_pieces(piece: int) -> None:
    """Each transfer ends with the select line. Oracle: INFO as docs/rtec-box-link.md says, its CRC."""
    with gateware.chip(SPI=1) as chip:
        chip.run(500, [0, 0])
        chip.spi(frame(HELLO, 9))
        chip.run(3000, [0, 0])
        (info,) = bodies(b"".join(chip.spi(bytes(piece)) for _ in range(70 // piece)))
    assert (info[1], info[2:4], info[10]) == (0x81, b"\x09\x00", 2)
