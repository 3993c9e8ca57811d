"""`rtec doctor CONFIG` against real parts: an encoder box and Modbus slaves on ptys.

Oracles: what the parts were told to give, and the faults that the tests made; each test says which.
"""

import json
import os
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtec.cli.main import status
from rtec.doctor.devices import examine
from rtec.report.devices import doctor_page
from tests.support import setups
from tests.support.box_rig import box_on_pty
from tests.support.conformance import open_files
from tests.support.doctor_rig import ALL_SIM, CALM_HZ, SPEED, plain_port, run_file, seen, sim, texts, usb_port
from tests.support.modbus_peer import FakeLine, FakeSlave, line, serial, slave_table

pytestmark = pytest.mark.xdist_group("real-clock")
SILENT_HINT = "is the device switched on, and its cable in (A and B, RX and TX not swapped)?"


def box(link: Path, **more: Any) -> dict[str, Any]:
    return {"driver": "serial_box", "port": str(link), "max_speed_mm_s": SPEED, "timeout_ms": 20.0, **more}


@contextmanager
def silent_pty() -> Iterator[str]:
    """A port that nobody is at."""
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        yield os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


def test_a_machine_that_is_well(tmp_path: Path) -> None:
    """Oracle: counts of the plant, 2000 a mm; registers of the slaves; the box counts its commands: none."""
    slaves = {1: FakeSlave(value=lambda _: 215), 2: FakeSlave(value=lambda _: 304)}
    with box_on_pty(tmp_path) as (peer, simulator, plant), line(slaves) as bus:
        plant.position[:] = [12_345, -2_000]
        patient = {"period_s": 0.2, "timeout_s": 10.0}
        bed = {"a": slave_table(1, "T_bed", **patient), "b": slave_table(2, "T_spindle_front", **patient)}
        role = {"counts": "box", "actuator": "box", "temperatures": ["bed"]}
        path = run_file(
            tmp_path,
            role,
            {
                "box": box(peer.link, timeout_ms=90.0),
                "bed": {"driver": "modbus", "serial": serial(bus.port), "slave": bed},
            },
            rate_hz=CALM_HZ,
        )
        found, by_name = seen(path, 1.0)
        assert simulator.commands == 0
    assert [texts(d) for d in found.devices] == [[], []]
    assert found.well
    values = {v.name: v for d in found.devices for v in d.values}
    assert {n: v.value for n, v in values.items()} == pytest.approx(
        {"axis X": 6.1725, "axis Z": -1.0, "applied X": 0.0, "applied Z": 0.0, "T_bed": 21.5, "T_spindle_front": 30.4}
    )
    assert values["axis X"].rate_hz is not None
    assert 0 < values["axis X"].rate_hz <= 1.05 * CALM_HZ  # [run] rate_hz, and less on a busy computer
    assert 0 < (values["T_bed"].rate_hz or 0.0) <= 1.3 * 5.0  # period_s 0.2
    assert (values["T_bed"].age_s or 0.0) >= 0
    assert by_name["box"].roles == ("counts", "actuator")


def test_every_fault_of_every_device_is_told_at_once(tmp_path: Path) -> None:
    """Oracle: one fault made in each device; those that are well are told well."""
    slaves = {
        1: FakeSlave(value=lambda _: 215),
        2: FakeSlave(value=lambda _: 32767),
        3: FakeSlave(silent=True),
    }
    open_codes = {"open_codes": [32767]}
    patient = {"timeout_s": 0.5}  # so that a busy computer makes no late answers
    three = {
        "a": slave_table(1, "T_bed", **patient),
        "b": slave_table(2, "T_air", register=open_codes, **patient),
        "c": {
            **slave_table(3, "T_carriage", **patient),
            "register": {"T_carriage": {"address": 0}, "T_x_nut": {"address": 1}},
        },
    }
    with box_on_pty(tmp_path) as (peer, _, _), line(slaves) as bus, silent_pty() as nobody:
        devices = {
            "box": box(peer.link),
            "bed": {"driver": "modbus", "serial": serial(bus.port), "slave": three},
            "gone": {"driver": "ascii_lines", "port": "/dev/ttyUSB7", "patterns": [r"(?P<T_air>\S+)"]},
            "mute": {"driver": "ascii_lines", "port": nobody, "patterns": [r"(?P<T_headstock>\S+)"]},
            "odd": {"driver": "modbuss"},
            "misspelt": {**box(peer.link), "bauds": 9600, "max_speed": 1},
        }
        role = {"counts": "box", "actuator": "box", "temperatures": ["bed", "gone", "mute"]}
        usb_port(tmp_path, "ttyUSB0", "A5069RR4")
        found, by_name = seen(run_file(tmp_path, role, devices), 2.5, root=tmp_path)
    assert texts(by_name["box"]) == []
    assert texts(by_name["bed"]) == [
        "T_air: open circuit: the device sent 32767; look at the sensor and its wires",
        "T_carriage, T_x_nut: slave 3 (c): no answer, within 500 ms; look at id = 3 (has the module this number?), "
        "baud rate, parity, wires A and B, and its supply",
    ]
    assert [v.value for v in by_name["bed"].values] == [21.5]
    assert texts(by_name["gone"]) == ["/dev/ttyUSB7: no such port; plug it in, or name another; trying again"]
    assert by_name["gone"].wrong[0].mend == (
        "serial ports here: /dev/ttyUSB0 (FTDI UART, serial number A5069RR4)",
        'found whatever its name is today: usb_serial = "A5069RR4" instead of port',
    )
    (mute,) = by_name["mute"].wrong
    assert mute.what == "silent: no temperature came in 2.5 s"
    assert SILENT_HINT in mute.mend
    assert (
        "the line is set to baud 9600, bytesize 8, parity none, stopbits 1 here: the device must be, too" in mute.mend
    )
    assert mute.mend[-1] == "a device that seldom speaks needs a longer look: --seconds 25"
    assert texts(by_name["odd"]) == ["no driver 'modbuss'; did you mean 'modbus'?"]
    assert sorted(texts(by_name["misspelt"])) == [
        "unknown key 'bauds'; did you mean 'baud'?",
        "unknown key 'max_speed'; did you mean 'max_speed_mm_s'?",
    ]
    assert "[role] does not name it: nothing reads it" not in by_name["misspelt"].told  # it was never opened
    (lacking,) = found.wrong
    assert lacking.what.startswith("no device gave T_spindle_front: the model reads them")
    assert lacking.mend == ("[role] temperatures names bed, gone, mute",)
    assert not found.well


def test_a_port_that_another_program_has(tmp_path: Path) -> None:
    """Oracle: the number of the process that has it, locked as pyserial does."""
    have = "s = serial.Serial(sys.argv[1], exclusive=True); print('have', flush=True); sys.stdin.read()"
    code = f"import sys, serial; {have}"
    with box_on_pty(tmp_path) as (peer, _, _):
        command = [sys.executable, "-c", code, str(peer.link)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == b"have\n"
            role = {"counts": "box", "actuator": "box"}
            _, by_name = seen(run_file(tmp_path, role, {"box": box(peer.link)}))
            other.communicate()
        (fault,) = by_name["box"].wrong
        assert fault.what == f"{peer.link}: in use by another program"
        assert [way for way in fault.mend if f"process {other.pid} (python" in way]
        _, by_name = seen(run_file(tmp_path, role, {"box": box(peer.link, timeout_ms=90.0)}, CALM_HZ), 0.5)
        assert not [text for text in texts(by_name["box"]) if "in use" in text]
        assert {v.name for v in by_name["box"].values} >= {"axis X", "axis Z"}


def test_two_devices_on_one_port(tmp_path: Path) -> None:
    """A table that was copied, and its port left as it was, once by another name. Oracle: the run file."""
    other = tmp_path / "by-id"
    with box_on_pty(tmp_path) as (peer, _, _):
        other.symlink_to(peer.link)
        board = {"driver": "ascii_lines", "port": str(other), "patterns": [r"(?P<T_bed>\S+)"]}
        devices = {"box": box(peer.link), "board": board}
        role = {"counts": "box", "actuator": "box", "temperatures": ["board"]}
        found, _ = seen(run_file(tmp_path, role, devices))
        told = [f.what for f in found.wrong]
        assert f"box, board name the same serial port, {peer.device}" in told
        assert not found.well
        found, _ = seen(run_file(tmp_path, {"counts": "box", "actuator": "box"}, {"box": box(peer.link)}))
        assert not any("same serial port" in f.what for f in found.wrong)


def test_a_box_that_is_another_or_does_not_answer(tmp_path: Path) -> None:
    """Oracle: the box's number, 42; a pty with nobody at it. What answered has its line well: no word about cables."""
    with box_on_pty(tmp_path) as (peer, _, _), silent_pty() as nobody:
        devices = {"box": box(peer.link, box_serial=5), "mute": box(Path(nobody), open_timeout_s=0.2)}
        _, by_name = seen(run_file(tmp_path, {"counts": "box", "actuator": "box"}, devices))
    (fault,) = by_name["box"].wrong
    assert "box number 42 answers, not 5" in fault.what
    assert SILENT_HINT not in fault.mend
    (fault,) = by_name["mute"].wrong
    assert "no encoder box answers within 0.2 s" in fault.what
    assert SILENT_HINT in fault.mend


def test_a_module_that_nobody_listens_for(tmp_path: Path) -> None:
    """Oracle: a TCP port of this computer that was free a moment ago."""
    import socket

    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    slave = {"a": {"id": 1, "register": {"T_bed": {"address": 0}}}}
    device = {"driver": "modbus", "tcp": {"host": "127.0.0.1", "port": free}, "slave": slave}
    role = {"counts": "box", "actuator": "box", "temperatures": ["cabinet"]}
    _, by_name = seen(run_file(tmp_path, role, {"box": sim(tmp_path), "cabinet": device}))
    (fault,) = by_name["cabinet"].wrong
    assert "no connection" in fault.what
    assert fault.mend == (f"127.0.0.1 is there, but nothing listens on port {free}: is that the right port?",)


def test_before_there_is_a_model(tmp_path: Path) -> None:
    """The devices are looked at; what keeps `rtec run` from starting is told as well."""
    path = run_file(tmp_path, ALL_SIM, {"box": sim(tmp_path)})
    (tmp_path / "model.toml").unlink()
    found, by_name = seen(path, 1.0)
    assert texts(by_name["box"]) == []
    assert len(by_name["box"].values) > 2
    (fault,) = found.wrong
    assert "model.toml: no such file" in fault.what


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit status by formats.md; JSON and page tell the same."""
    path = run_file(tmp_path, ALL_SIM, {"box": sim(tmp_path)})
    assert status(["doctor", str(path), "--no-pc", "--seconds", "1"]) == 0
    text = capsys.readouterr().out
    assert "nothing was commanded. All devices are well." in " ".join(text.split())
    tables = setups.tables(tmp_path)
    tables["device"]["gone"] = {"driver": "ascii_lines", "port": "/dev/ttyUSB7", "patterns": [r"(?P<T_air>\S+)"]}
    tables["role"]["temperatures"] = ["box", "gone"]
    tables["device"]["gone"]["at_start"] = "required"
    path = setups.write(tmp_path, tables)
    assert status(["doctor", str(path), "--no-pc", "--seconds", "1", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert (found["well"], found["devices"]["well"], found["pc"]) == (False, False, None)
    assert [bool(d["wrong"]) for d in found["devices"]["devices"]] == [False, True]
    assert status(["doctor", str(tmp_path / "absent.toml")]) == 2
    assert status(["doctor", "--no-pc"]) == 2


def test_the_page_says_each_fault_with_its_ways(tmp_path: Path) -> None:
    plain_port(tmp_path, "ttyS0", "4")
    plain_port(tmp_path, "ttyS1", "0")
    device = {"driver": "ascii_lines", "port": "/dev/ttyUSB7", "patterns": [r"(?P<T_air>\S+)"], "at_start": "required"}
    path = run_file(tmp_path, {**ALL_SIM, "temperatures": ["gone"]}, {"box": sim(tmp_path), "gone": device})
    shown: list[str] = []
    page = doctor_page(examine(path, 0.3, lambda found: shown.extend(d.doing for d in found), root=tmp_path))
    (section,) = [s for s in page.sections if s.heading == "Wrong: gone (ascii_lines)"]
    assert section.text == [
        "/dev/ttyUSB7: no such port; plug it in, or name another\n    → serial ports here: /dev/ttyS0"
    ]
    assert "Of 2 devices 1 is not well, and the run file is wrong." in page.lead
    assert "is read" in shown  # the live table had something to show


def test_the_peer_is_left_as_it_was(tmp_path: Path) -> None:
    """No thread and no descriptor is left behind."""
    bus: FakeLine
    with line({1: FakeSlave(value=lambda _: 215)}) as bus:
        slave = {"a": slave_table(1, "T_bed")}
        device = {"driver": "modbus", "serial": serial(bus.port), "slave": slave}
        role = {**ALL_SIM, "temperatures": ["bed"], "spindle": "box"}
        path = run_file(tmp_path, role, {"box": sim(tmp_path), "bed": device})
        before = (set(threading.enumerate()), open_files())
        seen(path, 0.2)
        assert (set(threading.enumerate()), open_files()) == before
