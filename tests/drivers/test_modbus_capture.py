"""A real flowmeter's Modbus line, captured by others with a logic analyser, through our frame code.

The bits are turned into bytes here (9600 baud, 8 data bits, no parity: the shortest pulse is 1/9600 s and no low
pulse is longer than 9 bits), so nothing but the frame code is ours.
"""

import struct
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.playback.sigrok import read
from rtec_drivers.modbus.frame import ModbusRequest, find_rtu, frames_of_slaves, good_crc
from rtec_drivers.modbus.map import Register
from tests.support.modbus_peer import crc
from tests.support.real_data import real_file

BAUD = 9600
FILES = (
    "flowmeter_target0_val0.sr",
    "flowmeter_target_0liter_per_min.sr",
    "flowmeter_target_15liter_per_min.sr",
    "flowmeter_target_20liter_per_min.sr",
)


def uart(line: NDArray[np.uint8], samplerate_hz: int) -> Iterator[tuple[float, int]]:
    """Bytes of a serial line and when their start bit began, s; a byte without a stop bit ends the capture."""
    bit = samplerate_hz / BAUD
    falls = np.flatnonzero(np.diff(line.astype(np.int8)) == -1) + 1
    free = 0.0
    for start in falls:
        if start < free or start + 10 * bit >= len(line):
            continue
        bits = [int(line[round(start + (k + 0.5) * bit)]) for k in range(10)]
        assert bits[0] == 0
        if bits[9] == 1:
            yield start / samplerate_hz, sum(b << k for k, b in enumerate(bits[1:9]))
            free = start + 9.5 * bit


def frames(name: str) -> list[bytes]:
    """Bytes between two silences of 2 characters; the first and the last may be cut, so they are left out."""
    capture = read(real_file("modbus_rtu", name))
    stream = list(uart(capture.line("RXTX"), capture.samplerate_hz))
    out = [bytes([stream[0][1]])]
    for (before_s, _), (at_s, byte) in pairwise(stream):
        out = [*out, bytes([byte])] if at_s - before_s > 30 / BAUD else [*out[:-1], out[-1] + bytes([byte])]
    return out[1:-1]


@pytest.mark.parametrize("name", FILES)
def test_every_frame_on_the_wire_has_a_good_checksum(name: str) -> None:
    """Oracle: the meter and its tool understood each other; and a checksum computed bit by bit."""
    seen = frames(name)
    assert len(seen) > 20
    for frame in seen:
        assert good_crc(frame), frame.hex()
        assert crc(frame[:-2]) == frame[-2:]
        assert not good_crc(frame[:-1] + bytes([frame[-1] ^ 4]))


@pytest.mark.parametrize("name", FILES)
def test_questions_are_those_that_we_would_send_and_answers_are_found(name: str) -> None:
    """Oracle: the tool's own questions, byte by byte, and the length of the meter's answers."""
    seen, pairs = frames(name), 0
    for question, answer in pairwise(seen):
        if len(question) != 8 or question[1] not in (3, 4) or len(answer) == 8:
            continue
        request = ModbusRequest(
            question[0], question[1], int.from_bytes(question[2:4], "big"), int.from_bytes(question[4:6], "big")
        )
        assert request.rtu() == question
        found = find_rtu(b"\x00\xff" + answer, request)
        assert found is not None
        assert len(found.registers) == request.count
        assert [slave for slave, _ in frames_of_slaves(answer)] == [question[0]]
        pairs += 1
    assert pairs > 5


@pytest.mark.parametrize("name", FILES)
def test_the_meters_gas_temperature_is_that_of_a_room(name: str) -> None:
    """Oracle: a laboratory; registers 2 and 3 of the meter hold a float that stays near 23 in all four captures."""
    seen, register = frames(name), Register(address=2, type="float32")
    values = []
    for question, answer in pairwise(seen):
        request = ModbusRequest(247, 3, 0, 15)
        found = find_rtu(answer, request) if question == request.rtu() else None
        if found is not None:
            values.append(register.number(found.registers[2:4]))
    assert len(values) > 5
    assert all(22.0 < v < 24.0 for v in values)
    assert max(values) - min(values) < 0.5


def test_the_tool_set_the_flow_that_the_file_is_named_after() -> None:
    """Oracle: the file's name, 15 litres a minute; function 16, 2 registers."""
    written = [f for f in frames(FILES[2]) if f[1] == 16 and len(f) == 13]
    assert 15.0 in [struct.unpack(">f", f[7:11])[0] for f in written]
