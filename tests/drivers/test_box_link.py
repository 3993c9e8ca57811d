"""The RTEC box link: the document, the driver's side and the box's side, each checked against the others."""

import json
import random
import re
import zlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec_drivers.box import protocol, simulator
from rtec_drivers.box.protocol import BoxState, Frame, FrameReader, Info
from rtec_drivers.box.simulator import BoxSimulator
from tests.support.box_peer import StillPlant, command_of, info_payload, state_payload

DOCUMENT = Path(__file__).parents[2] / "docs" / "rtec-box-link.md"
ROW = re.compile(r"^\| ([A-Z]+) \| (\d+) \| `(\{.*\})` \| `([0-9a-f ]+)` \|$", re.M)
VECTORS = ROW.findall(DOCUMENT.read_text(encoding="utf-8"))
MS = 1_000_000


def payload(name: str, says: dict[str, Any]) -> bytes:
    """The payload that a line of the document describes."""
    tuples: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in says.items()}
    match name:
        case "INFO":
            return info_payload(Info(**tuples))
        case "STATE":
            return state_payload(BoxState(**tuples))
        case "COMMAND":
            return protocol.command_payload(says["boot"], says["targets"])
        case "RESUME":
            return protocol.resume_payload(says["boot"])
    return b""


def test_the_document_has_vectors_of_every_type() -> None:
    """Oracle: the six types."""
    assert {name for name, *_ in VECTORS} == {"HELLO", "READ", "COMMAND", "RESUME", "INFO", "STATE"}


@pytest.mark.parametrize("row", VECTORS, ids=[f"{v[0]}-{v[1]}" for v in VECTORS])
def test_vectors_of_the_document(row: tuple[str, str, str, str]) -> None:
    """Oracle: the document; and the box's own stuffing and CRC, which share no code with the driver's."""
    name, sequence, says, wire = row
    frame = Frame(getattr(protocol, name), int(sequence), payload(name, json.loads(says)))
    data = bytes.fromhex(wire)
    assert protocol.encode(frame) == data
    assert FrameReader().feed(data) == [frame]
    body = simulator.unstuff(data[1:-1])
    assert simulator.stuff(body) == data[1:-1]
    assert simulator.crc32(body[:-4]) == int.from_bytes(body[-4:], "little")


def test_the_crc_is_the_one_that_the_document_names() -> None:
    """Oracle: the catalogue's check value."""
    assert zlib.crc32(b"123456789") == simulator.crc32(b"123456789") == 0xCBF43926


@given(st.binary(max_size=246), st.integers(0, 255), st.integers(0, 65535))
def test_any_frame_goes_through_both_sides(content: bytes, kind: int, sequence: int) -> None:
    """Oracle: what went in; no zero but at the ends; the box's stuffing gives the same bytes."""
    frame = Frame(kind, sequence, content)
    data = protocol.encode(frame)
    assert data[0] == data[-1] == 0
    assert 0 not in data[1:-1]
    assert simulator.stuff(simulator.unstuff(data[1:-1])) == data[1:-1]
    assert FrameReader().feed(data) == [frame]


def test_a_body_that_is_too_long_is_refused() -> None:
    """Oracle: one COBS block."""
    assert len(protocol.encode(Frame(1, 1, b"\1" * 246))) == 257
    with pytest.raises(ValueError, match="255 bytes"):
        protocol.encode(Frame(1, 1, b"\1" * 247))


@given(st.binary(max_size=600), st.integers(1, 40))
def test_it_is_in_step_again_after_any_garbage(garbage: bytes, piece: int) -> None:
    """Whatever came before, in whatever pieces, the next frame is read, by both sides. Oracle: that frame."""
    frame = Frame(protocol.READ, 99)
    data = garbage + protocol.encode(frame)
    reader = FrameReader()
    frames = [f for i in range(0, len(data), piece) for f in reader.feed(data[i : i + piece])]
    assert frames[-1] == frame
    box = BoxSimulator(StillPlant(2), 2)
    answers = b"".join(box.receive(data[i : i + piece], 0) for i in range(0, len(data), piece))
    assert FrameReader().feed(answers)[-1].sequence == 99


def test_no_single_wrong_bit_passes() -> None:
    """Every bit of a STATE turned over once: never a frame that says something else. Oracle: the frame itself."""
    state = BoxState(7, 0, 3, 10**6, (5, 2**32 - 1), (-1, 70000))
    frame = Frame(protocol.STATE, 17, state_payload(state))
    data = protocol.encode(frame)
    for bit in range(8 * len(data)):
        spoilt = bytearray(data)
        spoilt[bit // 8] ^= 1 << bit % 8
        assert all(f == frame for f in FrameReader().feed(bytes(spoilt) + b"\0"))


def test_no_burst_of_garbage_is_a_frame() -> None:
    """Two megabytes of seeded noise; a CRC of 32 bits lets one block in four thousand million pass."""
    dice, reader = random.Random(5), FrameReader()
    for _ in range(500):
        assert reader.feed(dice.randbytes(4096)) == []
    assert reader.bad > 5000
    assert len(reader._rest) < 300


def test_memory_is_bounded_while_no_zero_comes() -> None:
    """Oracle: the longest block, and that the frame behind a megabyte without a zero is read."""
    reader = FrameReader()
    for _ in range(256):
        reader.feed(b"\1" * 4096)
        assert len(reader._rest) < 300
    assert reader.feed(protocol.encode(Frame(2, 5))) == [Frame(2, 5)]


def test_payloads_of_a_wrong_length_are_none() -> None:
    """Oracle: the lengths in the document."""
    for wrong in (b"", b"\0" * 5, b"\0" * 9, b"\0" * (9 + 8 * 17), b"\0" * 18):
        assert protocol.state_of(wrong) is None
    assert protocol.info_of(b"\0" * 13) is None
    assert protocol.info_of(info_payload(Info(1, 2, 3, 16, 5, 6)) + b"later") == Info(1, 2, 3, 16, 5, 6)
    assert command_of(protocol.command_payload(3, [1, -1])) == (3, (1, -1))
    assert command_of(b"\0" * 5) is None


class Host:
    """Somebody who speaks to a box."""

    def __init__(self, box: BoxSimulator) -> None:
        self.box, self.sequence, self.now_ns = box, 0, 10**9

    def say(self, kind: int, content: bytes = b"") -> Frame | None:
        self.sequence += 1
        frames = FrameReader().feed(self.box.receive(protocol.encode(Frame(kind, self.sequence, content)), self.now_ns))
        return frames[0] if frames else None

    def state(self) -> BoxState:
        frame = self.say(protocol.READ)
        assert frame is not None
        state = protocol.state_of(frame.payload)
        assert state is not None
        return state


def test_what_the_box_does() -> None:
    """Oracle: the numbered rules under 'What the box does' in the document."""
    plant = StillPlant(2)
    host = Host(BoxSimulator(plant, 2, counter_bits=16, counts_per_s=1000, boot=5))
    assert host.state().status == protocol.NOT_RESUMED
    assert host.say(protocol.COMMAND, protocol.command_payload(5, [9, 9])) is None
    host.now_ns += 50 * MS
    assert host.state().ledger == (0, 0)
    host.say(protocol.RESUME, protocol.resume_payload(4))
    assert host.state().status == protocol.NOT_RESUMED
    host.say(protocol.RESUME, protocol.resume_payload(5))
    assert host.state().status == 0
    host.say(protocol.COMMAND, protocol.command_payload(5, [50, -200]))
    taken = host.sequence
    host.say(protocol.COMMAND, protocol.command_payload(4, [1, 1]))
    host.say(protocol.COMMAND, protocol.command_payload(5, [1, 1, 1]))
    host.now_ns += 60 * MS
    state = host.state()
    # 60 ms at 1000 counts/s, and the one count that it may have saved up before.
    assert (state.ledger, state.status, state.last_command) == ((50, -61), protocol.MOVING, taken)
    host.now_ns += 41 * MS
    state = host.state()
    assert state.status == protocol.HELD_BY_SILENCE
    held = state.ledger
    host.now_ns += 1000 * MS
    assert host.state().ledger == held
    host.say(protocol.COMMAND, protocol.command_payload(5, [50, held[1] + 1]))
    host.now_ns += 20 * MS
    assert host.state().ledger == (50, held[1] + 1)
    assert plant.inserted == [50, held[1] + 1]
    plant.position = [70_000, -1]
    assert host.state().counts == (70_000 - 65_536, 65_535)
    host.box.reset()
    state = host.state()
    assert (state.boot, state.status, state.ledger) == (6, protocol.NOT_RESUMED, (0, 0))
