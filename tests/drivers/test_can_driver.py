"""Temperatures, spindle speed and positions from CAN buses; frames made by cantools and canopen, not by us."""

import multiprocessing
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from rtec.errors import ConfigError, DriverError, DriverFault, DriverTimeout, DriverUnavailable
from rtec.tomlfile import validated
from rtec_drivers.can.driver import CanDriver, CanTemperatureOptions
from tests.support.can_peer import CLOCK, MS, Repeater, SlcanAdapter, bus_on, frame, new_channel
from tests.support.conformance import DriverLaws, Rig, open_files
from tests.support.modbus_peer import MACHINE, SENSORS, until

DBC = """
VERSION ""
NS_ :
BS_:
BU_: Box
BO_ 257 Temps: 8 Box
 SG_ Bed : 0|12@1- (0.0625,20) [-50|150] "degC" Box
 SG_ Column : 12|16@1- (0.01,0) [-50|150] "degC" Box
BO_ 2147484161 Spindle: 4 Box
 SG_ Speed : 7|16@0- (0.5,0) [-8000|8000] "rpm" Box
BO_ 300 Mixed: 8 Box
 SG_ Which M : 0|8@1+ (1,0) [0|3] "" Box
 SG_ Air m1 : 8|16@1- (0.1,0) [-50|150] "degC" Box
 SG_ Other m2 : 8|16@1- (0.1,0) [-50|150] "degC" Box
"""
PDO = {"node": 5, "map": ["i16", "i16", "i16", "i16"], "scale": 0.1, "timeout_s": 0.3}
BED: dict[str, Any] = {"temperature": {"T_bed": {**PDO, "item": 1, "open_codes": [32767]}}}


def table(channel: str, **more: Any) -> dict[str, Any]:
    return {"interface": "virtual", "channel": channel, "first_retry_s": 0.02, "longest_retry_s": 0.1, **more}


def driver(base: Path = Path(), **options: Any) -> CanDriver:
    return CanDriver(validated(CanTemperatureOptions, options, "run.toml"), MACHINE, CLOCK, base)


def value(device: CanDriver, sensor: str) -> float:
    degc, time_ns = np.full(len(SENSORS), np.nan), np.zeros(len(SENSORS), np.int64)
    with suppress(DriverFault, DriverUnavailable):
        device.read_temperatures(degc, time_ns)
    k = SENSORS.index(sensor)
    assert np.isnan(degc[k]) or 0 < time_ns[k] <= CLOCK.now_ns()
    return float(degc[k])


def pdo(*numbers: int) -> bytes:
    return b"".join(n.to_bytes(2, "little", signed=True) for n in numbers)


@pytest.fixture
def channel() -> str:
    return new_channel()


class TestCan(DriverLaws):
    @pytest.fixture
    def rig(self, channel: str) -> Iterator[Rig]:
        with bus_on(channel) as bus:

            def say(k: int) -> None:
                bus.send(frame(0x185, pdo(200 + k % 7, 0, 0, 0)))
                bus.send(frame(0x289, (1500 + k % 3).to_bytes(4, "little")))

            with Repeater(say, 0.005):
                yield Rig(
                    CanDriver,
                    table(
                        channel,
                        temperature={"T_headstock": {**PDO, "item": 1}},
                        spindle={"node": 9, "pdo": 2, "map": ["i32"]},
                    ),
                    misspelt="temperatur",
                    nearest="temperature",
                    sensors=["T_headstock"],
                    missing={"interface": "slcan", "channel": "/dev/rtec-no-such-port"},
                )


def test_dbc_signals_are_those_that_cantools_encodes(channel: str, tmp_path: Path) -> None:
    """Oracle: cantools as the encoder: signed 12 bits, big-endian, an extended identifier, a multiplexer."""
    cantools = pytest.importorskip("cantools", reason="cantools is not installed: pip install 'rtec[can]'")
    (tmp_path / "machine.dbc").write_text(DBC, encoding="utf-8")
    other = cantools.database.load_string(DBC)
    temperature = {
        "T_bed": {"message": "Temps", "signal": "Bed"},
        "T_column": {"message": "Temps", "signal": "Column"},
        "T_air": {"message": "Mixed", "signal": "Air", "range_degc": [-60, 100]},
    }
    options = table(
        channel, dbc="machine.dbc", temperature=temperature, spindle={"message": "Spindle", "signal": "Speed"}
    )
    with bus_on(channel) as bus, driver(tmp_path, **options) as device:
        rng = np.random.default_rng(3)
        for _ in range(20):
            bed, column = 20 + 0.0625 * int(rng.integers(-400, 400)), 0.01 * int(rng.integers(-4000, 9000))
            air, speed = 0.1 * int(rng.integers(-400, 400)), 0.5 * int(rng.integers(-9000, 9000))
            for name, content in (
                ("Temps", {"Bed": bed, "Column": column}),
                ("Mixed", {"Which": 1, "Air": air}),
                ("Mixed", {"Which": 2, "Other": 77.0}),
                ("Spindle", {"Speed": speed}),
            ):
                message = other.get_message_by_name(name)
                bus.send(frame(message.frame_id, message.encode(content), message.is_extended_frame))
            assert until(lambda t=column: abs(value(device, "T_column") - t) < 1e-9)  # type: ignore[misc]
            assert until(lambda t=speed: device.read_spindle() == t)  # type: ignore[misc]
            assert abs(value(device, "T_bed") - bed) < 1e-9
            assert abs(value(device, "T_air") - air) < 1e-9


def test_names_that_are_not_in_the_dbc_file_are_told(channel: str, tmp_path: Path) -> None:
    """Oracle: the messages, all at once."""
    pytest.importorskip("cantools", reason="cantools is not installed: pip install 'rtec[can]'")
    (tmp_path / "machine.dbc").write_text(DBC, encoding="utf-8")
    (tmp_path / "bad.dbc").write_text("BO_ nonsense", encoding="utf-8")
    wrong = {"T_bed": {"message": "Temp", "signal": "Bed"}, "T_air": {"message": "Temps", "signal": "Colum"}}
    with pytest.raises(
        ConfigError, match=r"no message 'Temp'; did you mean 'Temps'(.|\n)*no signal 'Colum'; did you mean"
    ):
        driver(tmp_path, **table(channel, dbc="machine.dbc", temperature=wrong))
    for name, told in (("bad.dbc", "not a good DBC file"), ("none.dbc", "cannot be read")):
        with pytest.raises(ConfigError, match=told):
            driver(tmp_path, **table(channel, dbc=name, temperature=wrong))
    with pytest.raises(ConfigError, match="no dbc file is given"):
        driver(tmp_path, **table(channel, temperature=wrong))


def test_pdos_are_those_that_canopen_encodes(channel: str) -> None:
    """Oracle: the canopen package as a device: CiA 404 process values of 16 and 32 bits, and floats."""
    canopen = pytest.importorskip("canopen", reason="canopen is not installed (dev group)")
    od = canopen.objectdictionary
    book = od.ObjectDictionary()
    kinds = ((0x7130, od.datatypes.INTEGER16), (0x9130, od.datatypes.INTEGER32), (0x6130, od.datatypes.REAL32))
    for index, kind in kinds:
        record = od.ODRecord(f"PV {index:X}", index)
        for sub in (1, 2):
            variable = od.ODVariable(f"AI{sub}", index, sub)
            variable.data_type = kind
            record.add_member(variable)
        book.add_object(record)
    for number in (1, 2):
        for base, subs in ((0x1800, 6), (0x1A00, 9)):
            record = od.ODRecord(f"PDO {number}", base + number - 1)
            for sub in range(subs):
                variable = od.ODVariable(f"s{sub}", base + number - 1, sub)
                variable.data_type = od.datatypes.UNSIGNED32 if sub else od.datatypes.UNSIGNED8
                record.add_member(variable)
            book.add_object(record)
    temperature = {
        "T_bed": {"node": 5, "pdo": 1, "map": ["i16", "i16", "i32"], "item": 2, "scale": 0.1},
        "T_air": {"node": 5, "pdo": 1, "map": ["i16", "i16", "i32"], "item": 3, "scale": 0.001},
        "T_column": {"node": 5, "pdo": 2, "map": ["f32", "f32"], "item": 2},
    }
    with bus_on(channel) as bus, driver(**table(channel, temperature=temperature)) as device:
        network = canopen.Network(bus)
        node = canopen.LocalNode(5, book)
        node.associate_network(network)
        for number, objects in ((1, ((0x7130, 1), (0x7130, 2), (0x9130, 1))), (2, ((0x6130, 1), (0x6130, 2)))):
            pdo_map = node.tpdo[number]
            pdo_map.cob_id = {1: 0x185, 2: 0x285}[number]
            pdo_map.clear()
            for index, sub in objects:
                pdo_map.add_variable(index, sub)
        node.tpdo[1][0].raw, node.tpdo[1][1].raw, node.tpdo[1][2].raw = 111, -55, 98765
        node.tpdo[2][0].raw, node.tpdo[2][1].raw = 1.5, 36.625
        for number in (1, 2):
            node.tpdo[number].transmit()
        assert until(lambda: value(device, "T_column") == 36.625)
        assert abs(value(device, "T_bed") + 5.5) < 1e-9
        assert abs(value(device, "T_air") - 98.765) < 1e-9
        node.remove_network()


def test_silence_open_wires_short_frames_and_other_nodes_are_told(channel: str) -> None:
    """Oracle: what was sent."""
    with bus_on(channel) as bus, driver(**table(channel, **BED)) as device:
        bus.send(frame(0x186, pdo(999, 0, 0, 0)))
        bus.send(frame(0x185, pdo(215, 0, 0, 0)))
        assert until(lambda: value(device, "T_bed") == 21.5)
        bus.send(frame(0x185, pdo(32767, 0, 0, 0)))
        assert until(lambda: any("T_bed: open circuit" in f for f in device.faults()))
        bus.send(frame(0x185, pdo(220, 0, 0)))  # CiA 301: the whole map, or nothing of it
        whole = "185h comes with 6 bytes, 8 are needed for map i16, i16, i16, i16; compare"
        assert until(lambda: any(whole in f for f in device.faults()))
        assert until(lambda: any("T_bed: no frame for" in f for f in device.faults()))
        assert value(device, "T_bed") == 21.5
        bus.send(frame(0x185, pdo(216, 0, 0, 0)))
        assert until(lambda: value(device, "T_bed") == 21.6 and device.faults() == [])


def test_bus_off_is_told_and_the_interface_is_opened_again(channel: str) -> None:
    """Oracle: error frames as SocketCAN makes them (linux/can/error.h); the sensor's value stays, then goes on."""
    with bus_on(channel) as bus, driver(**table(channel, **BED)) as device:
        bus.send(frame(0x185, pdo(215, 0, 0, 0)))
        assert until(lambda: value(device, "T_bed") == 21.5)
        passive = can.Message(
            arbitration_id=0x04, data=[0, 0x20, 0, 0, 0, 0, 0, 0], is_error_frame=True, is_extended_id=False
        )
        bus.send(passive)
        assert until(lambda: any("error passive" in f for f in device.faults()))
        opened = device.attempts
        bus.send(can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False))
        assert until(lambda: device.attempts > opened)
        assert value(device, "T_bed") == 21.5

        def back() -> bool:
            bus.send(frame(0x185, pdo(220, 0, 0, 0)))
            return value(device, "T_bed") == 22.0 and device.faults() == []

        assert until(back)


def test_heartbeats_states_and_emergencies_of_a_node(channel: str) -> None:
    """Oracle: CiA 301: heartbeat 700h + node, emergency 80h + node, NMT order 01h."""
    node = {"thermometer": {"id": 5, "heartbeat_s": 0.3, "start": True}}
    with bus_on(channel) as bus, driver(**table(channel, **BED, node=node)) as device:
        bus.send(frame(0x185, pdo(215, 0, 0, 0)))
        bus.send(frame(0x705, b"\x7f"))
        assert until(lambda: any("node 5 is pre-operational" in f for f in device.faults()))
        order = bus.recv(2.0)
        assert order is not None
        assert (order.arbitration_id, bytes(order.data)) == (0, b"\x01\x05")
        bus.send(frame(0x705, b"\x05"))
        assert until(lambda: not any("node 5" in f for f in device.faults()))
        bus.send(frame(0x085, bytes.fromhex("3050010000000000")))
        assert until(lambda: any("error code 5030h" in f for f in device.faults()))
        bus.send(frame(0x085, bytes(8)))
        assert until(lambda: any("node 5: no heartbeat for" in f for f in device.faults()))
        bus.send(frame(0x085, bytes.fromhex("1081010000000000")))
        assert until(lambda: any("error code 8110h" in f for f in device.faults()))
        bus.send(frame(0x705, b"\x00"))
        bus.send(frame(0x705, b"\x05"))
        assert until(lambda: not any("node 5" in f for f in device.faults())), "its boot-up ends what was before"


def test_slcan_on_a_pty_with_a_cable_that_is_pulled(channel: str, tmp_path: Path) -> None:
    """Oracle: an adapter written from Lawicel's manual; garbage and half frames on its line too."""
    link = tmp_path / "ttyACM0"
    options = table(str(link), interface="slcan", bitrate=500000, settings={"sleep_after_open": 0.0}, at_start="later")
    with driver(**{**options, **BED}) as device, bus_on(channel) as bus:
        assert until(lambda: any("cannot be opened" in f for f in device.faults()))
        for number in (215, 225):
            adapter = SlcanAdapter(channel)
            try:
                link.symlink_to(adapter.port)

                def heard(n: int = number) -> bool:
                    bus.send(frame(0x185, pdo(n, 0, 0, 0)))
                    return value(device, "T_bed") == n / 10 and device.faults() == []

                assert until(heard)
                assert "S6" in adapter.heard
                assert "O" in adapter.heard
                adapter.say(b"t1858\xff\xfe garbage\rt185\r")
                assert until(heard)
                adapter.say(b"t1854")
                link.unlink()
            finally:
                adapter.close()
            assert until(lambda: bool(device.faults()))
            assert value(device, "T_bed") == number / 10


def _talk(group: str, port: int, count: int) -> None:
    """Another process on the multicast bus."""
    with can.Bus(interface="udp_multicast", channel=group, port=port) as bus:
        for k in range(count):
            bus.send(frame(0x185, pdo(200 + k % 50, 0, 0, 0)))
            CLOCK.sleep_until_ns(CLOCK.now_ns() + 20 * MS)


def test_udp_multicast_between_two_processes() -> None:
    """Oracle: what the other process sends."""
    pytest.importorskip("msgpack", reason="msgpack is not installed (python-can[multicast])")
    options = table("239.74.163.2", interface="udp_multicast", settings={"port": 43117}, **BED)
    device = driver(**options)
    try:
        device.__enter__()
    except DriverUnavailable as e:
        pytest.skip(f"no multicast here: {e}")
    talker = multiprocessing.get_context("spawn").Process(target=_talk, args=("239.74.163.2", 43117, 500))
    with device:
        talker.start()
        try:
            assert until(lambda: 20.0 <= value(device, "T_bed") < 25.0, 20.0)
            first = value(device, "T_bed")
            assert until(lambda: value(device, "T_bed") != first)
        finally:
            talker.kill()
            talker.join()
        assert until(lambda: any("no frame for" in f for f in device.faults()))


def test_udp_multicast_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: python-can itself, without msgpack."""
    for name in [n for n in sys.modules if n.startswith(("msgpack", "can.interfaces.udp_multicast"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "msgpack", None)
    options = table("239.74.163.2", interface="udp_multicast", settings={"port": 43118}, **BED)
    with pytest.raises(DriverUnavailable, match=r"msgpack not installed: pip install 'rtec\[can\]'"):
        driver(**options).__enter__()


def test_socketcan_where_the_kernel_has_it() -> None:
    """Oracle: a frame written to a raw socket of the kernel's own."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
            raw.bind(("vcan0",))
            with driver(**table("vcan0", interface="socketcan", **BED)) as device:
                raw.send(bytes.fromhex("8501000008000000d700000000000000"))
                assert until(lambda: value(device, "T_bed") == 21.5)
    except OSError as e:
        pytest.skip(f"no SocketCAN interface vcan0 here: {e} (ip link add vcan0 type vcan; ip link set vcan0 up)")


def test_without_an_interface_the_reason_is_told() -> None:
    with pytest.raises(DriverUnavailable, match=r"socketcan rtec-none: cannot be opened"):
        driver(**table("rtec-none", interface="socketcan", **BED)).__enter__()
    with pytest.raises(DriverUnavailable, match=r"nonsense x: cannot be opened"):
        driver(**table("x", interface="nonsense", **BED)).__enter__()
    with pytest.raises(ConfigError, match="nothing is read"):
        driver(**table("x"))
    with pytest.raises(ConfigError, match=r"give either message and signal .* or node"):
        driver(**table("x", temperature={"T_bed": {"scale": 1.0}}))
    with pytest.raises(ConfigError, match="item 3: map has only 1"):
        driver(**table("x", temperature={"T_bed": {"node": 1, "map": ["i16"], "item": 3}}))


def test_a_spindle_that_is_not_there_or_silent_is_told(channel: str) -> None:
    spindle = {"node": 8, "pdo": 2, "map": ["i32"], "timeout_s": 0.2}
    with bus_on(channel) as bus, driver(**table(channel, spindle=spindle)) as device:
        with pytest.raises(DriverTimeout, match=r"no spindle speed for 0\.2 s"):
            device.read_spindle()
        bus.send(frame(0x288, (-1500).to_bytes(4, "little", signed=True)))

        def speed() -> bool:
            with suppress(DriverError):
                return device.read_spindle() == -1500.0
            return False

        assert until(speed)
    with driver(**table(channel, **BED)) as device, pytest.raises(DriverFault, match="spindle is missing"):
        device.read_spindle()


def test_a_thousand_reconnects_leave_no_descriptor_and_no_thread(channel: str) -> None:
    """Oracle: /proc/self/fd, the list of threads, and the worker's own count; bus-off makes it open again each time."""
    options = table(channel, **BED) | {"first_retry_s": 0.0001, "longest_retry_s": 0.0001}
    off = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False)
    with bus_on(channel) as bus, driver(**options) as device:
        files, threads = open_files(), threading.active_count()

        def again() -> bool:
            bus.send(off)
            return device.attempts > 1000

        assert until(again, 60.0, period_ms=0.2)
        assert (open_files(), threading.active_count()) == (files, threads)
        assert until(lambda: bus.send(frame(0x185, pdo(215, 0, 0, 0))) is None and value(device, "T_bed") == 21.5)
