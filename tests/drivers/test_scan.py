"""Looking for numbers on a line or bus, on parts that nobody here wrote; each search only reads.

Oracles: what libmodbus, pymodbus' server and python-can's buses hold and were sent; our own encoder box beside them.
"""

import re
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import can
import pytest
from pymodbus.simulator import DataType, SimData, SimDevice

from rtec.commission.scan import loudest, unit_of
from rtec.errors import DriverUnavailable
from rtec.loop.clock import RealClock
from rtec.loop.driver_info import all_drivers
from rtec.loop.ports import Scanner
from rtec.tomlfile import validated
from rtec_drivers.ascii.driver import AsciiLinesDriver
from rtec_drivers.ascii.text import AsciiOptions
from rtec_drivers.box.driver import SerialBoxDriver
from rtec_drivers.box.simulator import BoxSimulator
from rtec_drivers.can.bus import CanOptions
from rtec_drivers.can.driver import CanTemperatureOptions
from rtec_drivers.can.encoders import CanEncodersDriver
from rtec_drivers.can.scan import CanScanner
from rtec_drivers.modbus.driver import ModbusDriver, ModbusOptions, ModbusScanner, float_pairs
from rtec_drivers.modbus.frame import INPUT
from rtec_drivers.pty_peer import PtyPeer
from tests.drivers.test_modbus_others import other_server, program, pty_pair, running
from tests.support.box_peer import StillPlant
from tests.support.can_peer import Repeater, bus_on, frame, new_channel
from tests.support.modbus_peer import CLOCK, FakeSlave, line, until

pytestmark = pytest.mark.xdist_group("real-clock")
__all__ = ["program"]  # a fixture


@pytest.fixture(autouse=True)
def few_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """All 247 slaves take 50 s."""
    monkeypatch.setattr("rtec_drivers.modbus.driver.NUMBERS", range(1, 9))


def found_by(scanner: Scanner) -> list[str]:
    shares, words = zip(*scanner.search(), strict=True)
    assert list(shares) == sorted(shares)
    assert 0.0 <= shares[0] <= shares[-1] == 1.0
    return [text for text in words if text]


def test_libmodbus_on_a_serial_line(program: Path) -> None:
    """Its registers 0 to 127 hold 200 + address, holding 100 and 101 the float 36.6; 10 counts the requests."""
    with pty_pair() as (ours, theirs), running(str(program), "rtu", theirs, "5"):
        scanner = ModbusDriver.scanner({"serial": {"port": ours, "baud": 19200}}, CLOCK)
        assert scanner.duration == "up to 2 s, and up to 10 s more for each slave that answers"
        with scanner:
            assert found_by(scanner) == ["slave 5 answers: 128 input registers and 128 holding registers"]
            first, second = scanner.read(), scanner.read()
        assert first["slave 5, input register 7"] == 207.0
        assert first["slave 5, holding registers 100 and 101 (float)"] == pytest.approx(36.6)
        assert [p for p in first if first[p] != second[p]] == ["slave 5, holding register 10"]
        table = scanner.table({"T_bed": "slave 5, input register 7", "T_air": "slave 5, holding register 3"}, 0.1)
        assert validated(ModbusOptions, {"serial": {"port": ours}, **table}, "").slave["slave_5"].id == 5


def test_a_device_on_tcp_that_answers_to_every_number_is_one_slave(program: Path) -> None:
    """libmodbus over TCP takes no notice of the number."""
    with running(str(program), "tcp", "15220") as (_, line):
        way = {"tcp": {"host": "127.0.0.1", "port": int(line.split()[1])}}
        with ModbusDriver.scanner(way, CLOCK) as scanner:
            found = found_by(scanner)
        assert found == [
            "the same device answers to every number: it is taken as slave 1",
            "slave 1 answers: 128 input registers and 128 holding registers",
        ]


@pytest.mark.parametrize("serial", [False, True], ids=["tcp", "rtu"])
def test_several_slaves_of_pymodbus(serial: bool) -> None:
    """Slave 2: three registers in tenths, at 10; slave 7: a float at 20, by pymodbus' own packing."""
    devices = [
        SimDevice(id=2, simdata=[SimData(10, values=[215, 221, 65136], datatype=DataType.REGISTERS)]),
        SimDevice(id=7, simdata=[SimData(20, values=23.25, datatype=DataType.FLOAT32)]),
    ]
    with ExitStack() as stack:
        ours, theirs = stack.enter_context(pty_pair())
        server = stack.enter_context(other_server(devices, theirs if serial else ""))
        way = (
            {"serial": {"port": ours, "baud": 19200}} if serial else {"tcp": {"host": "127.0.0.1", "port": server.port}}
        )
        scanner = stack.enter_context(ModbusDriver.scanner(way, CLOCK))
        found = found_by(scanner)
        assert [re.sub(":.*", "", words) for words in found] == ["slave 2 answers", "slave 7 answers"]
        now = scanner.read()
        assert (now["slave 2, input register 11"], now["slave 2, holding register 12"]) == (221.0, -400.0)
        assert now["slave 7, input registers 20 and 21 (float)"] == 23.25
        assert scanner.proposed(["A", "B"]) == {
            "A": "slave 2, input register 10",
            "B": "slave 2, input register 11",
        }


def test_a_slave_that_answers_late_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes 150 ms, and is looked at when the next number has been asked; not for long, since it is slow."""
    monkeypatch.setattr("rtec_drivers.modbus.driver.SLAVE_NS", 1_000_000_000)
    with line({3: FakeSlave(value=lambda _: 215, last=31, delay_s=0.15)}) as bus:
        with ModbusDriver.scanner({"serial": {"port": bus.port, "baud": 115200}}, CLOCK) as scanner:
            assert found_by(scanner) == ["slave 3 answers: 32 input registers and 32 holding registers"]
        assert {frame[1] for frame in bus.unknown} <= {3, 4}, "reading functions only"


def test_an_answer_later_than_patience_is_not_taken_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each answer takes 30 ms, patience ends after 20. Oracle: its 32 registers hold their address, 100 to 131."""
    for name, ms in (("SLAVE_NS", 2000), ("PATIENT_NS", 20), ("TIMEOUT_NS", 100)):
        monkeypatch.setattr(f"rtec_drivers.modbus.driver.{name}", ms * 1_000_000)
    with line({3: FakeSlave(value=lambda _: 100, last=31, delay_s=0.03)}) as bus:
        scanner = ModbusDriver.scanner({"serial": {"port": bus.port, "baud": 115200}}, CLOCK)
        assert isinstance(scanner, ModbusScanner)
        with scanner:
            found_by(scanner)
        read = {address: word for (_, function, address), word in scanner._words.items() if function == INPUT}
    assert read == {address: 100 + address for address in range(32)}


@pytest.mark.parametrize(
    ("words", "pairs"),
    [
        ([0x41AC, 0x1234], {0: "high"}),
        ([0x1234, 0x41AC], {0: "low"}),
        ([215, 0x41AC], {0: "low"}),
        ([215, 221], {}),
        ([1650, 17100], {}),
    ],
)
def test_floats_of_a_room(words: list[int], pairs: dict[int, str]) -> None:
    """Oracle: 0x41AC is the high word of 21.5 (IEEE 754)."""
    assert struct.unpack(">f", bytes.fromhex("41AC0000"))[0] == 21.5
    assert dict(float_pairs(dict(enumerate(words)))) == pairs


def pdo(*numbers: int) -> bytes:
    return b"".join(n.to_bytes(2, "little", signed=True) for n in numbers)


@contextmanager
def bus_of(interface: str) -> Iterator[tuple[dict[str, Any], can.BusABC]]:
    """A bus, and how it is reached."""
    if interface == "virtual":
        way: dict[str, Any] = {"interface": "virtual", "channel": new_channel()}
        with bus_on(way["channel"]) as bus:
            yield way, bus
        return
    settings = {"port": 43121, "hop_limit": 0}
    way = {"interface": "udp_multicast", "channel": "239.74.163.21", "settings": settings}
    with can.Bus(interface="udp_multicast", channel="239.74.163.21", port=43121, hop_limit=0) as bus:
        yield way, bus


@pytest.mark.parametrize("interface", ["virtual", "udp_multicast"])
def test_can_identifiers_and_the_bytes_that_change(interface: str) -> None:
    """A CANopen thermometer of node 5, a frame without CANopen's number, one with 29 bits. Nothing is sent to them."""
    heard: list[int] = []
    with bus_of(interface) as (way, bus):

        def say(k: int) -> None:
            bus.send(frame(0x185, pdo(215, 221 + k % 3, -50, 0)))
            bus.send(frame(0x123, b"\x01\x02\x03"))
            bus.send(frame(0x18FF1234, b"\0", extended=True))
            while (message := bus.recv(0)) is not None:
                heard.append(message.arbitration_id)

        scanner = CanScanner(validated(CanOptions, way, ""), CLOCK, "temperature", listen_s=0.6)
        with Repeater(say, 0.02), scanner:
            found = found_by(scanner)
            now = scanner.read()
    foreign = set(heard) - {0x185, 0x123, 0x18FF1234}
    assert foreign == set()
    assert [re.sub(r"\d+ a second", "N a second", words) for words in found] == [
        "frame 123h: 3 bytes, N a second, always the same",
        "frame 185h (in CANopen: process data 1 of node 5): 8 bytes, N a second, bytes that change: 2",
        "frame 18FF1234h (29 bits: its signals need a DBC file): 1 byte, N a second, always the same",
    ]
    assert now["frame 185h, bytes 0-1"] == 215.0
    assert now["frame 185h, bytes 4-5"] == -50.0
    assert scanner.proposed(["A", "B"]) == {"A": "frame 185h, bytes 0-1", "B": "frame 185h, bytes 2-3"}
    table = scanner.table({"T_bed": "frame 185h, bytes 2-3", "T_air": "frame 123h, bytes 0-1"}, 0.1)
    assert table["temperature"]["T_bed"] == {
        "node": 5, "pdo": 1, "map": ["i16", "i16", "i16", "i16"], "item": 2, "scale": 0.1,
    }  # fmt: skip
    assert table["temperature"]["T_air"]["cob_id"] == 0x123
    assert validated(CanTemperatureOptions, {**way, **table}, "").temperature["T_air"].map == ("i16", "u8")


def test_can_encoders_by_their_identifiers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two encoders of 32 bits, which send unasked: the driver then reads what the search wrote down."""
    monkeypatch.setattr("rtec_drivers.can.scan.LISTEN_S", 0.4)
    way = {"interface": "virtual", "channel": new_channel()}
    with bus_on(way["channel"]) as bus:

        def say(k: int) -> None:
            bus.send(frame(0x18A, (70000 + k).to_bytes(4, "little")))
            bus.send(frame(0x18B, (5).to_bytes(4, "little")))

        with Repeater(say, 0.01), CanEncodersDriver.scanner(way, CLOCK) as scanner:
            assert len(found_by(scanner)) == 2
            assert scanner.read()["frame 18Ah, bytes 0-3"] >= 70000
            assert scanner.proposed(["X"]) == {}, "two positions, one axis: which?"
            table = scanner.table(scanner.proposed(["X", "Z"]), 1.0)
    assert table == {
        "sync": False,
        "axis": {
            "X": {"node": 10, "pdo": 1, "map": ["u32"], "item": 1},
            "Z": {"node": 11, "pdo": 1, "map": ["u32"], "item": 1},
        },
    }


def test_a_silent_bus_says_where_to_look() -> None:
    scanner = CanScanner(CanOptions(interface="virtual", channel=new_channel()), CLOCK, "axis", listen_s=0.1)
    with scanner:
        (words,) = found_by(scanner)
    assert "bit rate, wiring, termination?" in words
    assert scanner.read() == {}


def test_the_encoder_box_says_who_it_is(tmp_path: Path) -> None:
    """Oracle: the simulated box, which is told nothing: no command, no order to resume."""
    box = BoxSimulator(StillPlant(2), 2)
    with PtyPeer(box, RealClock(), tmp_path / "box", 0.001):
        with SerialBoxDriver.scanner({"port": str(tmp_path / "box")}, CLOCK) as scanner:
            (words,) = found_by(scanner)
            assert until(lambda: bool(scanner.read()))  # counts come with the next frame
            now = scanner.read()
        assert words.startswith("RTEC encoder box number ")
        assert "2 inputs" in words
        assert list(now) == ["input 1", "input 2"]
        assert scanner.table({"X": "input 2", "Z": "input 1"}, 1.0)["axes"] == ["Z", "X"]
        assert scanner.proposed(["X", "Y", "Z"]) == {}


class Printer:
    def __init__(self, text: bytes) -> None:
        self.text = text

    def receive(self, data: bytes, now_ns: int) -> bytes:
        del now_ns
        assert data == b"", "nothing is sent"
        return b""

    def idle(self, now_ns: int) -> bytes:
        del now_ns
        return self.text


@pytest.mark.parametrize(
    ("text", "more"),
    [
        (b"T1=21,5;T2=22,25\r\n", {"decimal": ","}),
        (b"T1 21.5 T2 22.25\r", {"line_end": "cr"}),
        (b"T1: 215  T2: 222\n", {"units": {"T_bed": "0.1degc", "T_air": "0.1degc"}}),
    ],
)
def test_lines_of_a_readout(tmp_path: Path, text: bytes, more: dict[str, Any]) -> None:
    """Oracle: Python's own matching of the line by the pattern; the options model of the driver."""
    names = ["T_bed", "T_air"]
    scanner = AsciiLinesDriver.scanner({"port": str(tmp_path / "tty")}, CLOCK)
    with PtyPeer(Printer(text), RealClock(), tmp_path / "tty", 0.01), scanner:
        assert found_by(scanner) == [f"prints lines at 9600 baud: {text.decode().strip()}"]
        now, places = scanner.read(), scanner.proposed(names)
        table = scanner.table(places, unit_of([now[p] for p in places.values()]))
    match = re.fullmatch(table["patterns"][0], text.decode().strip())
    assert match is not None
    assert list(match.groupdict()) == names
    assert {k: v for k, v in table.items() if k not in ("patterns", "baud")} == more
    assert validated(AsciiOptions, {"port": "x", **table}, "").baud == 9600


@pytest.mark.parametrize("numbers", [[21.5, 36.0], [215.0, 360.0], [2150.0, 3600.0]])
def test_the_unit_of_numbers_is_that_in_which_all_are_a_rooms_temperature(numbers: list[float]) -> None:
    assert [round(n * unit_of(numbers), 6) for n in numbers] == [21.5, 36.0]


REST = {"clock": 5.0, "T": 1.0, "still": 0.0, "Y": 0.0}
NOW = {"clock": 60000.0, "T": 231.0, "still": 215.0, "Y": 1e6}


@pytest.mark.parametrize(
    ("change", "kind", "best"),
    [
        ({"clock": 5.0, "T": 16.0, "still": 0.0}, "sensor", "T"),
        ({"clock": 5.0, "T": 1.0, "still": 0.0}, "sensor", None),
        ({"clock": 5.0, "T": 2000.0, "Y": 1.0}, "axis", "T"),
        ({}, "axis", None),
    ],
)
def test_what_changes_at_rest_is_no_sensor(change: dict[str, float], kind: str, best: str | None) -> None:
    """A clock counts whatever is warmed; a still axis may flicker by one count while another moves."""
    assert loudest(change, REST, NOW, kind) == best


PLACES: dict[str, Callable[[str], dict[str, Any]]] = {
    "modbus": lambda port: {"serial": {"port": port}},
    "can": lambda port: {"interface": "slcan", "channel": port},
    "can_encoders": lambda port: {"interface": "slcan", "channel": port},
    "serial_box": lambda port: {"port": port},
    "ascii_lines": lambda port: {"port": port},
}


def test_every_driver_that_looks_says_what_is_wrong_with_a_port(tmp_path: Path) -> None:
    """Oracle: a port that does not exist."""
    from rtec.commission.scan import scanner_of

    assert {d.name for d in all_drivers() if d.scans} == set(PLACES)
    for name, table in PLACES.items():
        scanner = scanner_of(name, table(str(tmp_path / "none")), CLOCK, "test")
        assert scanner is not None
        with pytest.raises(DriverUnavailable, match="no such port"), scanner:
            pass
