"""Modbus RTU against slaves that misbehave, on a pty. Oracle throughout: what the fake slave was told to send."""

import os
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtec.errors import ConfigError, DriverUnavailable
from rtec.loop.ports import Actuator, CountSource, TemperatureSource
from tests.support.modbus_peer import CLOCK, MS, SENSORS, FakeSlave, Seen, crc, driver, line, serial, slave_table, until


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def constant(value: int) -> FakeSlave:
    return FakeSlave(value=lambda _: value)


def test_it_reads_what_the_slaves_say_and_leaves_other_sensors_alone() -> None:
    with line({1: constant(235), 2: constant(-40 & 0xFFFF)}) as fake:
        device = driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed"), "b": slave_table(2, "T_air")})
        assert isinstance(device, TemperatureSource)
        assert not isinstance(device, CountSource | Actuator)
        with device:
            seen = Seen(device)
            assert until(lambda: seen["T_bed"] == 23.5 and seen["T_air"] == -4.0)
            assert np.isnan(seen["T_column"])
            assert device.faults() == []
            first_ns = int(seen.time_ns[0])
            assert until(lambda: seen["T_bed"] == 23.5 and int(seen.time_ns[0]) > first_ns)


def test_stamps_are_those_of_the_request() -> None:
    """Oracle: the slave's own clock; a value is never said to be newer than it is."""
    with (
        line({1: FakeSlave(value=lambda k: k, delay_s=0.05)}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed")}) as device,
    ):
        seen = Seen(device)
        assert until(lambda: seen["T_bed"] >= 0.3)
        k = round(seen["T_bed"] * 10)
        assert 0 <= fake.slaves[1].asked_ns[k - 1] - int(seen.time_ns[0]) < 40 * MS


def test_one_silent_slave_slows_no_other() -> None:
    """Oracle: requests that reach the two others in 2 s, with and without the silent one."""

    def share(silent: bool) -> tuple[float, float, int]:
        slaves = {1: constant(200), 2: FakeSlave(value=lambda _: 210, silent=silent), 3: constant(220)}
        places = (("a", 1, "T_bed"), ("b", 2, "T_air"), ("c", 3, "T_column"))
        tables = {n: slave_table(i, s, late_s=0.1) for n, i, s in places}
        with line(slaves) as fake, driver(serial=serial(fake.port), slave=tables) as device:
            seen = Seen(device)
            assert until(lambda: seen["T_bed"] == 20.0 and seen["T_column"] == 22.0)
            start_ns, worst_ms = CLOCK.now_ns(), 0.0
            while CLOCK.now_ns() < start_ns + 2000 * MS:
                CLOCK.sleep_until_ns(CLOCK.now_ns() + 5 * MS)
                worst_ms = max(worst_ms, seen.age_ms("T_bed"), seen.age_ms("T_column"))
            asked = sum(t > start_ns for t in slaves[1].asked_ns)
            told = [f for f in device.faults() if "slave 2 (b): no answer, within 100 ms" in f]
            assert bool(told) == silent
            return asked, worst_ms, len(slaves[2].asked_ns)

    with_all, _, _ = share(silent=False)
    without, worst_ms, tries = share(silent=True)
    assert without > 0.85 * with_all
    assert worst_ms < 50 + 100 + 60  # period + one deadline of the silent one + what this machine adds
    assert 1 <= tries < 8


def test_a_block_that_is_refused_costs_no_other_block_anything() -> None:
    """The slave has registers 0 to 40. Oracle: its requests; one block is before the refused one, and one behind it."""
    register = {
        "T_bed": {"address": 0, "scale": 0.1},
        "T_column": {"address": 50, "scale": 0.1},
        "T_air": {"address": 5, "scale": 0.1, "function": "input"},
    }
    peer = FakeSlave(value=lambda _: 200, last=40)
    table = {"id": 1, "period_s": 0.05, "timeout_s": 0.1, "register": register}
    with line({1: peer}) as fake, driver(serial=serial(fake.port, longest_retry_s=5.0), slave={"a": table}) as device:
        seen, oldest_ms = Seen(device), 0.0
        assert until(lambda: seen["T_bed"] == 20.0 and seen["T_air"] == 20.5)
        start_ns = CLOCK.now_ns()
        while CLOCK.now_ns() < start_ns + 1500 * MS:
            CLOCK.sleep_until_ns(CLOCK.now_ns() + 5 * MS)
            oldest_ms = max(oldest_ms, seen.age_ms("T_bed"), seen.age_ms("T_air"))
        why = "T_column: slave 1 (a): holding register 50: error 2: it has no such register; look at address and count"
        assert device.faults() == [why]
        assert oldest_ms < 50 + 300  # its period, and what a busy PC adds; the back-off is longer by then
        asked = peer.addresses.count(50)
        assert 3 <= asked < peer.addresses.count(0) / 2
        assert device.attempts == 1
        peer.last = 60
        assert until(lambda: seen["T_column"] == 25.0 and device.faults() == [])


@pytest.mark.parametrize(("words", "shown"), [((0x0000, 0x41A0), "2.35e-41"), ((0x6666, 0x4214), "2.72e+23")])
def test_a_float_in_the_wrong_word_order_is_no_temperature(words: tuple[int, int], shown: str) -> None:
    """Oracle: IEEE 754: 20 °C is 41A00000h, 37.1 °C is 42146666h; here the low word comes first."""
    peer = FakeSlave(register={100: lambda: words[0], 101: lambda: words[1]})
    register = {"address": 100, "type": "float32", "scale": 1.0}
    with line({1: peer}) as fake:
        table = slave_table(1, "T_bed", register=register)
        with driver(serial=serial(fake.port), slave={"a": table}) as device:
            why = f"holding registers 100 to 101: {shown} is no temperature; look at word_order, type and address"
            assert until(lambda: device.faults() == [f"T_bed: slave 1 (a): {why}"])
            assert np.isnan(Seen(device)["T_bed"])
        table = slave_table(1, "T_bed", register={**register, "word_order": "low"})
        with driver(serial=serial(fake.port), slave={"a": table}) as device:
            assert until(lambda: 20.0 <= Seen(device)["T_bed"] < 37.11)


def test_a_slave_that_refuses_everything_proves_that_the_line_is_good() -> None:
    """Oracle: its refusals, error 6; the port is opened once. One that answers with function 4 to 3 is named so."""
    peer = FakeSlave(value=lambda _: 200)
    with (
        line({1: peer}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed", late_s=0.1)}) as device,
    ):
        peer.spoil = lambda _, data: data[:1] + b"\x83\x06" + crc(data[:1] + b"\x83\x06")
        asked = len(peer.asked_ns)
        assert until(lambda: len(peer.asked_ns) > asked + 8)
        assert device.faults() == ["T_bed: slave 1 (a): holding register 0: error 6: it is busy"]
        peer.spoil = lambda _, data: data[:1] + b"\x04" + data[2:-2] + crc(data[:1] + b"\x04" + data[2:-2])
        asked = len(peer.asked_ns)
        assert until(lambda: len(peer.asked_ns) > asked + 6)
        assert "it answers with function code 4, but 3 was asked" in device.faults()[0]
        assert "opening" not in device.faults()[0]
        assert device.attempts == 1
        peer.silent = True
        assert until(lambda: any("no answer, within 100 ms; look at id = 1" in f for f in device.faults()))
        assert until(lambda: device.attempts > 1)


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.parametrize("delay_s", [0.13, 0.25, 0.45])
def test_a_late_answer_is_never_taken_for_a_new_one(delay_s: float, beside: bool) -> None:
    """Oracle: the slave numbers its requests, so each value tells which request it answers and when that came.

    The delays are longer than the deadline, shorter and longer than the late time.
    """
    late = FakeSlave(value=lambda k: k, delay_s=delay_s)
    tables = {"a": slave_table(1, "T_bed", late_s=0.2)}
    if beside:
        tables["b"] = slave_table(2, "T_air", period_s=0.25)
    with line({1: late, 2: constant(300)}) as fake, driver(serial=serial(fake.port), slave=tables) as device:
        seen = Seen(device)

        def right() -> None:
            k, stamp_ns = round(seen["T_bed"] * 10) if seen["T_bed"] > 0 else 0, int(seen.time_ns[0])
            # Stamped before the request goes out: an instant behind the slave's own is that of a later request.
            # How long before depends on how busy this computer is.
            assert k == 0 or late.asked_ns[k - 1] - 1000 * MS < stamp_ns <= late.asked_ns[k - 1]

        def asked(times: int) -> bool:
            right()
            return len(late.asked_ns) >= times

        assert until(lambda: asked(5), 25.0)
        assert any("slave 1" in f for f in device.faults())
        late.delay_s = 0.0
        assert until(lambda: seen["T_bed"] > 0, 25.0)
        assert until(lambda: asked(len(late.asked_ns)) and device.faults() == [])


def test_damaged_answers_are_not_taken_and_one_in_a_hundred_costs_nothing() -> None:
    """Oracle: every damaged answer carries a value of its own."""

    def spoil(k: int, data: bytes) -> bytes:
        return data[:-1] + bytes([data[-1] ^ 1]) if k % 100 == 7 else data

    bad = FakeSlave(value=lambda k: 900 if k % 100 == 7 else 200, spoil=spoil)
    with (
        line({1: bad}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed", period_s=0.01)}) as device,
    ):
        seen = Seen(device)
        values = set()

        def enough() -> bool:
            values.add(seen["T_bed"])
            return len(bad.asked_ns) > 220

        assert until(enough, 20.0)
        assert {v for v in values if not np.isnan(v)} == {20.0}
        assert device.faults() == []
        bad.spoil = lambda _, data: data[:-1] + bytes([data[-1] ^ 1])
        assert until(lambda: any("checksum is wrong" in f for f in device.faults()))


def test_half_a_frame_and_another_slaves_answer_are_told() -> None:
    peer = FakeSlave(value=lambda _: 200, spoil=lambda _, data: data[:4])
    with (
        line({1: peer}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed", late_s=0.1)}) as device,
    ):
        assert until(lambda: any("only 4 of 7 bytes" in f for f in device.faults()))
        peer.spoil = lambda _, data: b"\x09" + data[1:-2] + crc(b"\x09" + data[1:-2])
        assert until(lambda: any("slave 9 answered instead" in f for f in device.faults()))
        assert np.isnan(Seen(device)["T_bed"])
        peer.spoil = lambda _, data: data
        assert until(lambda: Seen(device)["T_bed"] == 20.0)


def test_another_slave_that_answers_instead_keeps_its_own_channels_fresh() -> None:
    """Slave 2's number stands in what comes when slave 1 is asked. Oracle: slave 2's own answers are in time.

    Slave 1 is told, and comes back by itself in three late times at the most; slave 2 is never left alone for it.
    """

    def as_slave_2(_: int, data: bytes) -> bytes:
        return b"\x02" + data[1:-2] + crc(b"\x02" + data[1:-2])

    wrong, right = FakeSlave(value=lambda _: 200), FakeSlave(value=lambda k: 100 + k % 50)
    tables = {"a": slave_table(1, "T_bed", late_s=0.3), "b": slave_table(2, "T_air", late_s=1.5, period_s=0.25)}
    with line({1: wrong, 2: right}) as fake, driver(serial=serial(fake.port), slave=tables) as device:
        seen = Seen(device)
        assert until(lambda: len(right.asked_ns) > 5 and seen["T_bed"] == 20.0)
        wrong.spoil = as_slave_2
        assert until(lambda: any("T_bed: slave 1 (a): slave 2 answered instead" in f for f in device.faults()))
        start_ns, oldest_ns = CLOCK.now_ns(), 0
        while CLOCK.now_ns() < start_ns + 1500 * MS:
            seen["T_air"]
            oldest_ns = max(oldest_ns, CLOCK.now_ns() - int(seen.time_ns[SENSORS.index("T_air")]))
            assert not any("T_air" in f for f in device.faults())
            CLOCK.sleep_until_ns(CLOCK.now_ns() + MS)
        # Its period, one deadline of slave 1, what a busy PC adds; left alone it would be three late times of slave 1.
        assert oldest_ns < (250 + 100 + 300) * MS
        wrong.spoil = lambda _, data: data
        back_ns = CLOCK.now_ns()
        assert until(lambda: device.faults() == [])
        assert CLOCK.now_ns() - back_ns < 2000 * MS


def test_garbage_before_and_behind_an_answer_does_not_hide_it() -> None:
    noise = bytes(range(1, 200))
    peer = FakeSlave(value=lambda _: 200, spoil=lambda _, data: noise + data + b"\x01\x03\x02")
    with (
        line({1: peer}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed")}) as device,
    ):
        assert until(lambda: Seen(device)["T_bed"] == 20.0)


def test_a_babbling_line_is_told_and_is_no_busy_loop() -> None:
    """Oracle: processor time of the process, against real time."""
    peer = FakeSlave(silent=True)
    with (
        line({1: peer}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed", late_s=0.1)}) as device,
    ):
        stop = threading.Event()

        def babble() -> None:
            while not stop.wait(0.002):
                fake.say(os.urandom(20))

        thread = threading.Thread(target=babble)
        thread.start()
        try:
            assert until(lambda: any("bytes that are no answer" in f for f in device.faults()))
            start_ns, cpu_s = CLOCK.now_ns(), sum(os.times()[:2])
            CLOCK.sleep_until_ns(start_ns + 500 * MS)
            assert sum(os.times()[:2]) - cpu_s < 0.4
        finally:
            stop.set()
            thread.join()
        peer.silent = False
        assert until(lambda: Seen(device)["T_bed"] == 0.0, 15.0)


def test_open_circuit_range_and_stuck_are_told_and_mend_themselves() -> None:
    raw = [200]
    peer = FakeSlave(value=lambda _: raw[0])
    register = {"open_codes": [32767], "range_degc": [0, 100], "stuck_s": 0.4}
    with (
        line({1: peer}) as fake,
        driver(serial=serial(fake.port), slave={"a": slave_table(1, "T_bed", register=register)}) as device,
    ):
        seen = Seen(device)
        assert until(lambda: seen["T_bed"] == 20.0)
        raw[0] = 32767
        assert until(lambda: any("T_bed: open circuit: the device sent 32767" in f for f in device.faults()))
        old_ns = int(seen.time_ns[0])
        raw[0] = 2000
        assert until(lambda: any("200.0 °C is outside range_degc" in f for f in device.faults()))
        assert seen["T_bed"] == 20.0
        assert int(seen.time_ns[0]) == old_ns or int(seen.time_ns[0]) - old_ns < 100 * MS
        raw[0] = 210
        assert until(lambda: seen["T_bed"] == 21.0)
        assert until(lambda: any("T_bed: stuck: 21.00 °C has not changed" in f for f in device.faults()))
        assert seen["T_bed"] == 21.0
        frozen_ns = int(seen.time_ns[0])
        assert until(lambda: seen.age_ms("T_bed") > 200)
        assert int(seen.time_ns[0]) == frozen_ns
        raw[0] = 211
        assert until(lambda: abs(seen["T_bed"] - 21.1) < 1e-9 and device.faults() == [])


def test_a_cable_pulled_and_put_back_and_a_port_that_comes_later(tmp_path: Path) -> None:
    """The port is a link that points to another pty afterwards, as after plugging an adapter in again."""
    link = tmp_path / "ttyUSB0"
    options = {"serial": serial(str(link), at_start="later"), "slave": {"a": slave_table(1, "T_bed")}}
    with driver(**options) as device:
        seen = Seen(device)
        assert until(lambda: any("no such port" in f for f in device.faults()))
        for value in (200, 210, 220):
            with line({1: constant(value)}) as fake:
                link.symlink_to(fake.port)
                assert until(lambda v=value: seen["T_bed"] == v / 10 and device.faults() == [])  # type: ignore[misc]
                link.unlink()
            assert until(lambda: bool(device.faults()))
            assert seen["T_bed"] == value / 10
    with pytest.raises(DriverUnavailable, match="no such port"):
        driver(serial=serial(str(link)), slave=options["slave"]).__enter__()


def test_an_adapter_is_found_again_under_another_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: a list of ports in which the adapter with our number is another pty after it was pulled."""
    there: list[str] = []

    def ports() -> list[Any]:
        return [SimpleNamespace(device=d, serial_number="FT0ABCDE", location="1-1:1.0") for d in there]

    monkeypatch.setattr("serial.tools.list_ports.comports", ports)
    by_number = {**serial("", at_start="later"), "port": None, "usb_serial": "FT0ABCDE"}
    with driver(serial=by_number, slave={"a": slave_table(1, "T_bed")}) as device:
        seen = Seen(device)
        assert until(lambda: any("no port with the USB serial number 'FT0ABCDE'" in f for f in device.faults()))
        with line({1: constant(200)}) as one, line({1: constant(210)}) as other:
            assert one.port != other.port
            there[:] = [one.port]
            assert until(lambda: seen["T_bed"] == 20.0)
            there[:] = []
            one.hang_up()
            assert until(lambda: bool(device.faults()))
            there[:] = [other.port]
            assert until(lambda: seen["T_bed"] == 21.0 and device.faults() == [])


def test_a_port_in_use_is_told() -> None:
    with line({1: constant(200)}) as fake:
        options = {"serial": serial(fake.port), "slave": {"a": slave_table(1, "T_bed")}}
        with driver(**options), pytest.raises(DriverUnavailable, match="in use by another program"):
            driver(**options).__enter__()


def test_a_thousand_reconnects_leave_no_descriptor_and_no_thread() -> None:
    """Oracle: /proc/self/fd and the list of threads."""
    with line({1: constant(200)}) as fake:
        options = {"serial": serial(fake.port), "slave": {"a": slave_table(1, "T_bed")}}
        with driver(**options):
            pass
        files, threads = open_files(), threading.active_count()
        for _ in range(1000):
            with driver(**options):
                pass
        assert open_files() == files
        assert threading.active_count() == threads


def test_attempts_on_a_missing_port_are_bounded(tmp_path: Path) -> None:
    """Oracle: waits of 0.02, 0.04, 0.08, 0.1, 0.1 … s leave room for at most 9 attempts in 0.6 s, and 6 at least."""
    table = {"serial": serial(str(tmp_path / "none"), at_start="later"), "slave": {"a": slave_table(1, "T_bed")}}
    with driver(**table) as device:
        CLOCK.sleep_until_ns(CLOCK.now_ns() + 600 * MS)
        assert device.attempts <= 9
        assert until(lambda: device.attempts >= 6)


def test_wrong_options_are_told() -> None:
    """Oracle: the messages."""
    port = serial("/dev/null")
    with pytest.raises(ConfigError, match="give either serial or tcp"):
        driver(slave={"a": slave_table(1, "T_bed")})
    with pytest.raises(ConfigError, match=r"'T_bet': the machine has no such sensor; did you mean 'T_bed'"):
        driver(serial=port, slave={"a": slave_table(1, "T_bet")})
    with pytest.raises(ConfigError, match="two slaves have id 1"):
        driver(serial=port, slave={"a": slave_table(1, "T_bed"), "b": slave_table(1, "T_air")})
    with pytest.raises(ConfigError, match=r"is in slave 'a' and in slave 'b'"):
        driver(serial=port, slave={"a": slave_table(1, "T_bed"), "b": slave_table(2, "T_bed")})
    with pytest.raises(ConfigError, match=r"no profile 'exemys'"):
        driver(serial=port, slave={"a": {"id": 1, "profile": "exemys", "channels": {"T_bed": "1"}}})
    with pytest.raises(ConfigError, match=r"has no channel '9'"):
        driver(serial=port, slave={"a": {"id": 1, "profile": "exemys-rme1-tc", "channels": {"T_bed": "9"}}})
    with pytest.raises(ConfigError, match="nothing is read"):
        driver(serial=port, slave={"a": {"id": 1}})
    register = {"thermocouple": "K", "cold_junction": "T_box"}
    with pytest.raises(ConfigError, match="cold_junction 'T_box' is not read"):
        driver(serial=port, slave={"a": slave_table(1, "T_bed", register=register)})
