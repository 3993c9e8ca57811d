"""Random bytes into everything that takes bytes off a wire.

Oracle: nothing but a refusal of its own kind comes out, no value is one that the loop could not use, memory stays
bounded. Half of the input is noise, half a good message with a few bytes changed, so that it gets past the first check.
A run over millions: `ROUNDS=1000000 pytest tests/drivers/test_decoders.py`.
"""

import json
import math
import os
import random
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest

from rtec.tomlfile import validated
from rtec_drivers.ascii.driver import ReadingBook
from rtec_drivers.ascii.text import AsciiOptions, LineParser
from rtec_drivers.box import protocol as box
from rtec_drivers.can import box as can_box_frames
from rtec_drivers.can.signals import Dbc, ObjectType, SignalOptions
from rtec_drivers.modbus import frame as modbus_frame
from rtec_drivers.modbus.map import Register
from rtec_drivers.temperatures import Conversion, TemperatureReadings
from rtec_drivers.zmq import message as zmq_message
from tests.support.box_peer import command_of, state_payload
from tests.support.conformance import MACHINE

ROUNDS = int(os.environ.get("ROUNDS", "4000"))
MS = 1_000_000
STATE = {
    "schema": 1, "boot": "a", "seq": 1, "time_ns": 5, "counts": {"X": 1, "Z": 2}, "counts_time_ns": 4,
    "degc": {"T_bed": [20.5, 3]}, "spindle_rpm": 1.5, "output": {"X": 1, "Z": 2},
}  # fmt: skip
REQUEST = modbus_frame.ModbusRequest(3, modbus_frame.HOLDING, 10, 4)
Feed = Callable[[bytes, int], bool]
"""Takes bytes and the number of the round; tells whether something came out."""


def changed(rng: random.Random, good: bytes) -> bytes:
    """The message with a bit turned, bytes lost, put in or replaced, in up to three places."""
    data = bytearray(good)
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(data) + 1)
        kind = rng.randrange(4)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at : at + rng.randrange(1, 8)]
        elif kind == 2:
            data[at:at] = rng.randbytes(rng.randrange(1, 8))
        else:
            data[at : at + 1] = bytes([rng.choice(b'\0\xff\x80\x7f9-eE.,"{}[]')])
    return bytes(data)


def crc16(data: bytes) -> bytes:
    """With the checksum of a Modbus frame behind it, so that the noise is looked at."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return data + value.to_bytes(2, "little")


def box_link() -> Feed:
    reader = box.FrameReader()

    def feed(data: bytes, _: int) -> bool:
        frames = reader.feed(data)
        for payload in [*(frame.payload for frame in frames), data]:
            for read in (box.state_of, box.info_of, command_of, box.decode):
                read(payload)
        assert len(reader._rest) <= box.LONGEST_BODY + 3
        return bool(frames)

    return feed


def can_box() -> Feed:
    def feed(data: bytes, _: int) -> bool:
        return can_box_frames.unpack(0x150, data[:8]) is not None

    return feed


def modbus() -> Feed:
    registers = [Register(address=0, type=t) for t in ("int32", "uint32", "float32", "float64")]

    def feed(data: bytes, _: int) -> bool:
        taken = False
        for sealed in (data, crc16(data), crc16(b"\x03\x03\x08" + data[:8].ljust(8, b"\0"))):
            answer = modbus_frame.find_rtu(sealed, REQUEST)
            assert modbus_frame.why_not(sealed, REQUEST)
            assert all(modbus_frame.good_crc(frame) for _, frame in modbus_frame.frames_of_slaves(sealed))
            for register in registers:
                if answer is not None and not answer.error:
                    taken = True
                    assert isinstance(register.number(answer.registers[: register.words]), float)
        parts = modbus_frame.split_tcp(data)
        assert parts is None or len(parts[1]) < 260
        modbus_frame.decode(data, REQUEST)
        return taken

    return feed


def zmq_link() -> Feed:
    def feed(data: bytes, _: int) -> bool:
        with suppress(zmq_message.MessageError):
            zmq_message.read_answer(data)
        try:
            state = zmq_message.read_state(data)
        except zmq_message.MessageError:
            return False
        assert all(abs(count) < 2**63 for count in (*state.counts.values(), *state.output.values()))
        assert all(math.isfinite(degc) for degc, _ in state.degc.values())
        return True

    return feed


def lines() -> Feed:
    table = {
        "port": "x",
        "patterns": [r"X=(?P<X>\S+) Z=(?P<Z>\S+)", r"T=(?P<T_bed>\S+) (?P<spindle_rpm>\S+)"],
        "units": {"X": "inch", "Z": "um"},
        "max_speed_mm_s": {"X": 400.0, "Z": 400.0},
    }
    parser = LineParser(validated(AsciiOptions, table, "run.toml"), MACHINE)
    options = validated(AsciiOptions, table, "run.toml")
    book, reader = ReadingBook(parser, options, MACHINE), parser.reader()

    def feed(data: bytes, k: int) -> bool:
        for line in reader.feed(data):
            book.take(line, k * MS, (k + 1) * MS)
        if k % 1000 == 0:
            book.restart()
        assert all(math.isfinite(value) and abs(value) < 2**63 for value, _ in book.values.values())
        assert len(book.faults) < 10
        assert len(reader._rest) <= options.longest_line + 1
        return bool(book.values)

    return feed


def readings() -> Feed:
    kinds = [
        Conversion(scale=0.001, thermocouple="K", cold_junction=25.0),
        Conversion(scale=1e12, offset=1e12, thermocouple="B", cold_junction=20.0),
        Conversion(scale=1e-3, thermocouple="T", cold_junction="T_air"),
        Conversion(),
    ]
    names = ["T_bed", "T_carriage", "T_headstock", "T_air"]
    book = TemperatureReadings(MACHINE.sensor_names, dict(zip(names, kinds, strict=True)))

    def feed(data: bytes, k: int) -> bool:
        raw = data[:8].ljust(8, b"\0")
        number = struct.unpack("<d", raw)[0] if k % 2 else float(struct.unpack("<h", raw[:2])[0])
        book.take(names[k % 4], number, (k + 1) * MS)
        assert all(-50 <= degc <= 250 for degc in book._snapshot.degc)
        return bool(len(book._snapshot.degc))

    return feed


def pdos() -> Feed:
    kinds: tuple[ObjectType, ...] = ("i8", "u8", "i16", "u16", "i24", "u24", "i32", "u32", "i64", "u64", "f32", "f64")
    sources = [(kind, Dbc(None).source(SignalOptions(node=5, map=(kind,)), True)) for kind in kinds]

    def feed(data: bytes, _: int) -> bool:
        taken = False
        for kind, source in sources:
            if len(data) >= int(kind[1:]) // 8:
                number, taken = source.number(data), True
                assert kind[0] == "f" or -(1 << source.bits) < number < 1 << source.bits
        return taken

    return feed


STATE_FRAME = box.encode(box.Frame(box.STATE, 5, state_payload(box.BoxState(1, 0, 3, 100, (1, 2), (3, -4)))))
DECODERS: list[tuple[Callable[[], Feed], bytes, int]] = [
    (box_link, STATE_FRAME, 1),
    (can_box, can_box_frames.pack(0x150, can_box_frames.BoxFrame(5, 1, 1)), 1),
    (modbus, crc16(bytes([3, 3, 8, 0, 1, 0, 2, 0, 3, 0, 4])), 1),
    (zmq_link, json.dumps(STATE).encode(), 1),
    (lines, b"X=12.5 Z=-3.25\r\nT=21.5 300\n", 1),
    (readings, bytes(8), 10),
    (pdos, bytes(8), 1),
]


@pytest.mark.parametrize(("make", "good", "divisor"), DECODERS, ids=[d[0].__name__ for d in DECODERS])
def test_noise_is_refused(make: Callable[[], Feed], good: bytes, divisor: int) -> None:
    """Oracle: what each feed asserts of what comes out; and the good message, read before and after the noise."""
    rng, feed = random.Random(11), make()
    assert feed(good, 4)
    for k in range(ROUNDS // divisor):
        feed(rng.randbytes(rng.randrange(300)) if k % 2 else changed(rng, good), k)
    if make is not box_link:  # a frame that began in the noise may swallow what follows
        assert feed(good, 1004)


@pytest.mark.parametrize("number", ["1" + 400 * "0", "-1" + 400 * "0", "1e999", "-1e999", "NaN", "true", "null", '"1"'])
@pytest.mark.parametrize(
    "place", ['"spindle_rpm":%s', '"degc":{"T_bed":[%s,3]}', '"degc":{"T_bed":[1,%s]}', '"seq":%s']
)
def test_numbers_of_a_message_that_are_none(place: str, number: str) -> None:
    """JSON knows integers of any length; what does not fit is refused like a text."""
    text = '{"schema":1,"boot":"a","seq":1,"time_ns":5,' + place % number + "}"
    with pytest.raises(zmq_message.MessageError, match="must be a"):
        zmq_message.read_state(text.encode())


@pytest.mark.parametrize("text", ["1e308", "-1e308", "1e17", "-99999999999999999999"])
def test_positions_too_large_to_be_true(text: str) -> None:
    """They would overflow, or wrap in 64 bits to a position that looks sound, at the first reading unnoticed."""
    table: dict[str, Any] = {"port": "x", "patterns": [r"X=(?P<X>\S+) Z=(?P<Z>\S+)"], "units": {"X": "mm"}}
    options = validated(AsciiOptions, {**table, "max_speed_mm_s": {"X": 400.0, "Z": 400.0}}, "run.toml")
    book = ReadingBook(LineParser(options, MACHINE), options, MACHINE)
    book.take(b"X=%s Z=1" % text.encode(), 0, MS)
    assert book.values == {}
    assert book.faults == {"X": f"X: {text[:20]!r} is too large to be true"}


def test_a_block_with_a_zero_is_no_frame() -> None:
    """No zero stands between two zero bytes; whoever hands one over gets an answer, not an endless loop."""
    assert box.uncobs(b"\x02a\0b") is None
    assert box.decode(b"\0" * 12) is None
