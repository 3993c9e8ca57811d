"""Serial ports, CAN interfaces and who has them, below a made-up root. Oracle: the files that the test wrote."""

import os
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from rtec.doctor import ports as doctor_ports
from rtec.doctor import readings as doctor_readings
from rtec.doctor.ports import Holder, PortHere
from rtec.doctor.readings import SerialPlace, serial_places, shared_ports, ways
from rtec.errors import DriverFault, DriverTimeout, DriverUnavailable
from rtec.tomlfile import validated
from rtec_drivers.can.driver import CanTemperatureOptions
from rtec_drivers.modbus.driver import ModbusOptions
from rtec_drivers.serial_line import PortOptions
from tests.support.doctor_rig import plain_port, usb_port

GONE = DriverUnavailable("no such port; plug it in, or name another")
BUSY = DriverUnavailable("in use by another program")
REFUSED = DriverUnavailable("may not be opened by this user")
SILENT = DriverTimeout("no answer")


def port(**more: Any) -> PortOptions:
    return validated(PortOptions, more, "run.toml")


@pytest.fixture
def device(tmp_path: Path) -> str:
    """A file that stands for a port."""
    path = tmp_path / "dev" / "ttyUSB0"
    path.parent.mkdir()
    path.touch()
    return str(path)


def holder(root: Path, pid: int, name: str, device: str) -> None:
    """A process that has the device open."""
    process = root / "proc" / str(pid)
    (process / "fd").mkdir(parents=True)
    (process / "comm").write_text(name + "\n", encoding="utf-8")
    (process / "fd" / "5").symlink_to(device)
    (process / "fd" / "6").symlink_to("/dev/null")


def test_ports_with_their_numbers(tmp_path: Path) -> None:
    usb_port(tmp_path, "ttyUSB1", "FT77")
    usb_port(tmp_path, "ttyACM0", "0042", "RTEC box")
    plain_port(tmp_path, "ttyS0", "4")
    plain_port(tmp_path, "ttyS1", "0")
    (tmp_path / "sys/class/tty/tty0").mkdir()
    assert doctor_ports.serial_ports(tmp_path) == [
        PortHere("/dev/ttyACM0", "0042", "FTDI RTEC box"),
        PortHere("/dev/ttyUSB1", "FT77", "FTDI UART"),
        PortHere("/dev/ttyS0"),
    ]
    assert doctor_ports.serial_ports(tmp_path / "nothing") == []


def test_this_computers_own_files_are_read() -> None:
    """No oracle but that nothing raises, and that this process' own files are not another's."""
    for found in doctor_ports.serial_ports():
        assert found.device.startswith("/dev/")
    read, write = os.pipe()
    assert doctor_ports.holders(f"/proc/self/fd/{read}") == []
    for end in (read, write):
        os.close(end)


def test_who_has_it(tmp_path: Path, device: str) -> None:
    holder(tmp_path, 4711, "minicom", device)
    holder(tmp_path, 4712, "bash", "/dev/null")
    holder(tmp_path, os.getpid(), "ourselves", device)
    link = tmp_path / "by-id"
    link.symlink_to(device)
    assert doctor_ports.holders(str(link), tmp_path) == [Holder(4711, "minicom")]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("minicom", "end it (kill 4711)"),
        ("ModemManager", "it tries every new serial port: sudo systemctl disable --now ModemManager"),
        ("rtec", "that is `rtec run`: `rtec status` shows its devices; to look at them here stop it first"),
    ],
)
def test_busy(tmp_path: Path, device: str, name: str, said: str) -> None:
    holder(tmp_path, 4711, name, device)
    wanted = (f"process 4711 ({name}) has {device} open: {said}",)
    assert ways(port(port=device), BUSY, False, tmp_path) == wanted


def test_busy_with_a_process_that_this_user_does_not_see(
    tmp_path: Path, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor_readings, "sees_all_processes", lambda: False)
    wanted = (f"sudo fuser -v {device} tells which program has it open",)
    assert ways(port(port=device), BUSY, False, tmp_path) == wanted


def test_no_permission(tmp_path: Path, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the group that the file was given; root may open everything, so that is made up."""
    import grp

    monkeypatch.setattr(os, "access", lambda *_: False)
    Path(device).chmod(0o660)
    group = grp.getgrgid(Path(device).stat().st_gid).gr_name
    said = f"members of group {group!r} may open {device}: sudo usermod -aG {group} $USER, then log in again"
    assert ways(port(port=device), REFUSED, False, tmp_path) == (said,)
    Path(device).chmod(0o600)
    (said,) = ways(port(port=device), REFUSED, False, tmp_path)
    assert said.startswith(f"no group may open {device}: a udev rule")


def test_missing(tmp_path: Path) -> None:
    assert "no serial port now" in ways(port(port="/dev/ttyUSB9"), GONE, False, tmp_path)[0]
    usb_port(tmp_path, "ttyUSB0", "FT77")
    assert ways(port(usb_serial="OTHER"), GONE, False, tmp_path) == (
        "serial ports here: /dev/ttyUSB0 (FTDI UART, serial number FT77)",
    )


def test_silent_and_heard(tmp_path: Path, device: str) -> None:
    """What has answered has power and a cable; a driver's fault that is no silence says itself what it is."""
    options = port(port=device, baud=9600, parity="even")
    first, second = ways(options, SILENT, False, tmp_path)
    assert "switched on" in first
    assert "baud 9600, bytesize 8, parity even, stopbits 1" in second
    assert ways(options, SILENT, True, tmp_path) == ()
    assert ways(options, DriverFault("box number 42 answers, not 5"), False, tmp_path) == ()
    assert ways(options, DriverFault("slave 3: no answer, within 50 ms"), False, tmp_path) == (first, second)
    assert ways(None, SILENT, False, tmp_path) == ()


def test_places_in_tables_within_tables() -> None:
    slave = {"a": {"id": 1, "register": {"T_bed": {"address": 0}}}}
    options = validated(ModbusOptions, {"serial": {"port": "/dev/ttyUSB3"}, "slave": slave}, "run.toml")
    settings = "baud 9600, bytesize 8, parity none, stopbits 1"
    assert serial_places(options) == [SerialPlace("/dev/ttyUSB3", "", settings)]
    signal = {"T_bed": {"node": 5, "map": ["i16"]}}
    table = {"interface": "slcan", "channel": "/dev/ttyACM0@115200", "temperature": signal}
    assert [p.port for p in serial_places(validated(CanTemperatureOptions, table, "run.toml"))] == ["/dev/ttyACM0"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (None, "no interface can0; CAN interfaces here: can1"),
        ("0x40080", "can0 is down: sudo ip link set can0 up type can bitrate 250000 restart-ms 100"),
        ("0x400c1", "can0 is up; ip -details -statistics link show can0 tells its bit rate and errors"),
    ],
)
def test_can(tmp_path: Path, flags: str | None, said: str) -> None:
    """Flags as the kernel writes them: bit 0 is IFF_UP (linux/if.h)."""
    for name, kind in (("can1", "280"), ("eth0", "1")):
        place = tmp_path / "sys/class/net" / name
        place.mkdir(parents=True)
        (place / "type").write_text(kind, encoding="utf-8")
    if flags is not None:
        (tmp_path / "sys/class/net/can0").mkdir()
        (tmp_path / "sys/class/net/can0/flags").write_text(flags, encoding="utf-8")
    signal = {"T_bed": {"node": 5, "map": ["i16"]}}
    table = {"interface": "socketcan", "channel": "can0", "bitrate": 250_000, "temperature": signal}
    assert ways(validated(CanTemperatureOptions, table, "run.toml"), GONE, False, tmp_path) == (said,)


class _Host(BaseModel):
    host: str = "192.168.1.50"
    port: int = 502


def test_network() -> None:
    error = DriverUnavailable("no connection")
    assert ways(_Host(), error, False) == (
        "does `ping 192.168.1.50` answer? If not: power, network cable, address of the device",
    )
    error.__cause__ = ConnectionRefusedError()
    assert "nothing listens on port 502" in ways(_Host(), error, False)[0]
    assert ways(_Host(), error, True) == ()
    for reached in (
        "the connection is open: look at id = 1",
        "error 11: the gateway is there, but the unit does not answer",
    ):
        assert ways(_Host(), DriverFault(f"T_bed: no answer; {reached}"), False) == ()


def test_an_open_port_that_others_read_too_or_whose_adapter_waits(tmp_path: Path, device: str) -> None:
    holder(tmp_path, 4711, "minicom", device)
    timer = tmp_path / "sys/bus/usb-serial/devices/ttyUSB0/latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n", encoding="utf-8")
    said = shared_ports(port(port=device), tmp_path)
    assert said[0] == f"{device} is open in process 4711 (minicom) too: each gets a part of the bytes"
    assert "keeps bytes back for 16 ms" in said[1]
    timer.write_text("1\n", encoding="utf-8")
    assert len(shared_ports(port(port=device), tmp_path)) == 1
