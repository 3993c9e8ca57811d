"""The bench's parts: far sides against the drivers' own decoders, what was found against what was put in."""

import math
import random
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest

from rtec.correction.flags import MODE_ON, MODE_TAKEN_OVER, Flag
from rtec.daemon.status import Status
from rtec.errors import ConfigError
from rtec.hil import Accuracy, Check, Course, FaultOrder, HilResult, OffAndOn, load_bench, parse_fault
from rtec.log.writer import LogWriter
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.run_file import load_setup
from rtec.report.hil import hil_facts, hil_page
from rtec.tomlfile import validated
from rtec_drivers.can.driver import CanTemperatureOptions
from rtec_drivers.can.signals import Dbc
from rtec_drivers.hil.bus_devices import adapter, crc, slave_line
from rtec_drivers.hil.bus_run import Logbook, held_spans, read_logbook
from rtec_drivers.hil.faults import AFTER_S, FAULTS, FaultWatch
from rtec_drivers.hil.findings import (
    RECOVER_S,
    compared_spans,
    faults_found,
    given_astray,
    held_check,
    improvement_check,
    quiet_spans,
    unheld_spans,
)
from rtec_drivers.hil.injector import can_switches, modbus_switches
from rtec_drivers.hil.plant import TipTrack, accuracy
from rtec_drivers.hil.soak import Resources, ResourceSeries, TimeStretch, draw_faults
from rtec_drivers.hil.wiring import read_wiring
from rtec_drivers.modbus.driver import ModbusOptions
from rtec_drivers.modbus.frame import HOLDING, INPUT, ModbusRequest, find_rtu
from rtec_drivers.pty_peer import PtyPeer, WireFaults
from tests.support import hil_rig, setups

KNOWN = load_bench().faults()
NS = 1_000_000_000


def test_faults_are_read_as_they_are_written() -> None:
    assert parse_fault("modbus-silent@30s", KNOWN) == FaultOrder("modbus-silent", 30.0)
    assert parse_fault("box-crc@1.5s+10s", KNOWN) == FaultOrder("box-crc", 1.5, 10.0)
    for text in ("box-crc", "box-crc@30", "box-crc@30s+", "@3s", "box-crc@-3s", "box crc@3s"):
        with pytest.raises(ConfigError, match="NAME@30s"):
            parse_fault(text, KNOWN)
    with pytest.raises(ConfigError, match="did you mean 'box-silent'"):
        parse_fault("box-silnt@3s", KNOWN)


def test_every_fault_has_a_switch() -> None:
    """Oracle: the catalogue. The box's switches are seen at work in `test_hil`."""
    made = modbus_switches([], []) | can_switches([], [])
    assert set(made) == {name for name, fault in FAULTS.items() if fault.bus != "box"}


# ---- Modbus slaves: the driver's own finder of answers is the oracle

REGISTERS: dict[str, dict[str, Any]] = {
    "T_bed": {"address": 3, "function": "input", "type": "int16", "scale": 0.1},
    "T_air": {"address": 4, "function": "holding", "type": "float32", "word_order": "low"},
    "T_headstock": {"address": 6, "function": "holding", "type": "int32", "scale": 0.01, "offset": -40.0},
    "T_x_nut": {"address": 9, "function": "holding", "type": "uint16", "scale": 0.5, "open_codes": [65535]},
}
DEGC = {"T_bed": -12.3, "T_air": 21.625, "T_headstock": 33.21, "T_x_nut": 24.5}


def _line() -> Any:
    table = {"serial": {"port": "/dev/none"}, "slave": {"a": {"id": 7, "register": REGISTERS}}}
    options = validated(ModbusOptions, table, "test")
    sensors: dict[str, Callable[[], float]] = {n: partial(float, v) for n, v in DEGC.items()}
    return slave_line(options, sensors, "test"), options.slave["a"].register_


@pytest.mark.parametrize("name", sorted(REGISTERS))
def test_slaves_say_what_the_driver_reads(name: str) -> None:
    line, registers = _line()
    register = registers[name]
    request = ModbusRequest(7, INPUT if register.function == "input" else HOLDING, register.address, register.words)
    answer = find_rtu(line.receive(request.rtu(), 0), request)
    assert answer is not None
    value = register.number(answer.registers) * register.scale + register.offset
    assert value == pytest.approx(DEGC[name], abs=0.5 * register.scale if register.type != "float32" else 1e-6)


def test_slaves_misbehave_as_asked() -> None:
    """Silent, late, another number, open, frozen; a request in two pieces; one with a wrong checksum."""
    line, _ = _line()
    (slave,) = line.slaves
    request = ModbusRequest(7, HOLDING, 9, 1)
    frame = request.rtu()
    assert line.receive(frame[:3], 0) == b""
    assert find_rtu(line.receive(frame[3:], 0), request) is not None
    assert line.receive(frame[:-1] + bytes([frame[-1] ^ 1]), 0) == b""
    assert line.receive(ModbusRequest(8, HOLDING, 9, 1).rtu(), 0) == b""
    slave.late_ns = 5
    assert line.receive(frame, 100) == b""
    assert line.idle(104) == b""
    assert find_rtu(line.idle(105), request) is not None
    slave.late_ns, slave.answers_as = 0, 8
    assert line.receive(frame, 0)[0] == 8
    slave.answers_as, slave.silent = 7, True
    assert line.receive(frame, 0) == b""
    refused = line.slaves[0].answer(6, 0, 1)
    assert refused == bytes([0x86, 2])
    assert crc(frame[:-2]) == frame[-2:]


# ---- CAN: python-can's own slcan reader over a pty, and the driver's decoders, are the oracle


class _Sent:
    """Frames that python-can reads from the adapter."""

    def __init__(self, folder: Path) -> None:
        pdo = {"node": 5, "pdo": 1, "map": ["i16", "u8", "i32"]}
        table = {
            "interface": "slcan",
            "channel": "x",
            "temperature": {
                "T_bed": {**pdo, "item": 1, "scale": 0.1},
                "T_air": {**pdo, "item": 3, "scale": 0.001, "offset": 5.0, "open_codes": [99]},
            },
            "spindle": {"node": 6, "pdo": 2, "map": ["i32"]},
            "node": {"a": {"id": 5}},
        }
        self.options = validated(CanTemperatureOptions, table, "test")
        sensors: dict[str, Callable[[], float]] = {"T_bed": lambda: -12.3, "T_air": lambda: 21.5}
        self.adapter = adapter(self.options, sensors, lambda: -2400.0, folder, "test")
        self.link = folder / "port"

    def frames(self, count: int) -> dict[int, bytes]:
        from rtec.loop.clock import RealClock

        with PtyPeer(self.adapter, RealClock(), self.link):
            bus = can.Bus(interface="slcan", channel=str(self.link), bitrate=500_000, sleep_after_open=0.0)
            try:
                got = [bus.recv(5.0) for _ in range(count)]
            finally:
                bus.shutdown()
        return {m.arbitration_id: bytes(m.data) for m in got if m is not None}

    def value(self, name: str, frames: dict[int, bytes]) -> float:
        table = self.options.temperature[name]
        source = Dbc(None).source(table, scaled=True)
        return source.number(frames[source.identifier]) * table.scale + table.offset


def test_the_adapter_says_what_the_driver_reads(tmp_path: Path) -> None:
    sent = _Sent(tmp_path)
    frames = sent.frames(3)
    assert frames.keys() == {0x185, 0x286, 0x705}
    assert sent.value("T_bed", frames) == pytest.approx(-12.3, abs=0.05)
    assert sent.value("T_air", frames) == pytest.approx(21.5, abs=0.0005)
    assert int.from_bytes(frames[0x286], "little", signed=True) == -2400
    assert frames[0x705] == b"\x05"


def test_the_adapter_off_the_bus_hears_and_sends_nothing(tmp_path: Path) -> None:
    adapted = _Sent(tmp_path).adapter
    assert adapted.receive(b"C\rS6\rO\r", 0).count(b"t") == 3
    assert adapted.receive(b"t1232AABB\r", 1) == b"z\r"
    adapted.bus_off = True
    assert adapted.receive(b"t1232AABB\r", 2) == b"\a"
    assert adapted.idle(10 * NS) == b""
    adapted.bus_off, adapted.wrong_node = False, True
    assert b"t1A5" in adapted.idle(11 * NS)


def test_one_message_in_so_many_is_cut() -> None:
    faults = WireFaults()
    faults.cut_every = 3
    arrived = []
    for k in range(9):
        faults.put(b"abcdefgh", k)
        arrived.append(faults.take(k))
    assert [len(m) for m in arrived] == [8, 8, 4] * 3
    assert faults.garbled == 3


# ---- wiring


def test_the_run_file_stays_as_it_is_but_for_its_ports(tmp_path: Path) -> None:
    """Both run files that the bench writes are good ones; options that are no ports are those of the user."""
    wiring = read_wiring(hil_rig.SHIPPED)
    assert dict(wiring.buses) == {"box": "box", "thermocouples": "modbus", "sensors": "can"}
    ours, user = load_setup(wiring.with_ports(tmp_path, "off")), load_setup(hil_rig.SHIPPED)
    assert ours.file.run.mode == "off"
    assert ours.file.limits == user.file.limits
    assert ours.file.device["box"]["max_speed_mm_s"] == user.file.device["box"]["max_speed_mm_s"]
    assert ours.file.device["thermocouples"]["slave"] == user.file.device["thermocouples"]["slave"]
    assert ours.file.device["thermocouples"]["serial"]["parity"] == "even"
    assert ours.file.device["sensors"]["temperature"] == user.file.device["sensors"]["temperature"]
    assert all(str(tmp_path) in str(ours.file.device[name]) for name in wiring.buses)
    assert load_setup(wiring.simulated(tmp_path)).file.device["machine"]["driver"] == "sim"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.pop("hil"), r"\[hil\] is missing"),
        (lambda t: t["hil"].update(of_s=3), "did you mean 'off_s'"),
        (lambda t: t["hil"].update(program="G9 X1"), r"hil\.toml: \[hil\] program line 1"),
        (lambda t: t["hil"].update(truth="none.toml"), r"hil\.toml: \[hil\] .*none\.toml: no such file"),
        (lambda t: t["hil"].update(actuator="phase"), "inserts counts"),
        (lambda t: t["device"]["sensors"].update(driver="zmq_link"), "no far side"),
        (lambda t: t["device"].pop("box"), "needs one encoder box"),
        (
            lambda t: t["device"]["thermocouples"]["slave"]["bed"].update(timeuot_s=0.2),
            r"\[device.thermocouples\]: \[slave.bed\] unknown key 'timeuot_s'; did you mean 'timeout_s'",
        ),
    ],
)
def test_run_files_that_the_bench_cannot_use(tmp_path: Path, change: Callable[[Any], Any], words: str) -> None:
    content = hil_rig.tables()
    change(content)
    with pytest.raises(ConfigError, match=words):
        read_wiring(hil_rig.write(tmp_path, content))


# ---- findings: made of what was put in


def _logbook(held: "list[tuple[float, float]]", seconds: float = 30.0) -> Logbook:
    time_ns = np.arange(round(seconds * 1000), dtype=np.int64) * 1_000_000
    at_s = time_ns * 1e-9
    flags = np.zeros(len(time_ns), np.bool_)
    for low, high in held:
        flags |= (at_s >= low) & (at_s < high)
    commanded = np.stack([np.arange(len(time_ns)) // 50, np.zeros(len(time_ns), np.int64)], axis=1)
    age_s = {"T": np.where(flags, 3.0, 0.5).astype(np.float32)}
    return Logbook(time_ns, flags, age_s, 1.0, commanded, {"X": 0, "Z": 0})


def _track(logbook: Logbook, error_um: float = 1.0) -> TipTrack:
    every = np.arange(5, len(logbook.time_ns), 10)
    tip = np.full((len(every), 3), error_um, np.float64)
    return TipTrack(
        logbook.time_ns[every].astype(np.float64) * 1e-9,
        np.zeros((len(every), 2)),
        tip,
        logbook.commanded[every - 2].copy(),
    )


def _watch(faults: list[FaultOrder], clock: Any = None) -> FaultWatch:
    return FaultWatch(faults, {"box": "box", "tc": "modbus"}, clock or VirtualClock(), lambda _: None)


def test_what_a_fault_did() -> None:
    """Held from 11 to 16 s for a fault from 10 to 14 s; a hiccup; another fault at 20 s that never ends well."""
    faults = [FaultOrder("modbus-silent", 10.0, 4.0), FaultOrder("box-silent", 20.0, 2.0)]
    logbook = _logbook([(11.0, 16.0), (18.0, 18.02), (21.0, 30.0)])
    track = _track(logbook)
    track.tip_um[(track.time_s > 15) & (track.time_s < 15.5)] = 9.0
    first, second = faults_found(faults, logbook, track, _watch(faults), 30.0, ("X", "Z"))
    assert first.held_s == pytest.approx(5.02, abs=0.01)
    assert first.recovered_s == pytest.approx(2.0, abs=0.01)
    assert first.largest_um == pytest.approx(9.0 * math.sqrt(2.0))
    assert first.oldest_s == {"T": 3.0}
    assert math.isnan(second.recovered_s)
    assert math.isnan(first.noticed_s)
    quiet = np.array(quiet_spans([first, second], 4.0, 30.0))
    assert quiet == pytest.approx(np.array([[4.0, 10.0], [17.0, 20.0]]), abs=0.01)
    assert np.array(held_spans(logbook, 0)) == pytest.approx(np.array([[11.0, 16.0], [18.0, 18.02], [21.0, 29.999]]))


def test_a_hold_that_lasts_into_the_next_fault_ends_when_it_ends() -> None:
    """Held from 11 to 22 s for a fault from 10 to 14 s; another begins at 16 s. It followed again 8 s after its end."""
    faults = [
        FaultOrder("modbus-late", 10.0, 4.0),
        FaultOrder("box-late", 16.0, 2.0),
        FaultOrder("can-late", 26.0, 1.0),
    ]
    logbook = _logbook([(11.0, 22.0), (26.0, 30.0)])
    first, second, third = faults_found(faults, logbook, _track(logbook), _watch(faults), 30.0, ("X", "Z"))
    assert first.recovered_s == pytest.approx(8.0, abs=0.01)
    assert second.recovered_s == pytest.approx(4.0, abs=0.01)
    assert math.isnan(third.recovered_s)
    quiet = np.array(quiet_spans([first, second, third], 4.0, 30.0))
    assert quiet == pytest.approx(np.array([[4.0, 10.0], [23.0, 26.0]]), abs=0.01)


def test_holds_of_a_busy_pc_are_told_and_say_nothing_of_the_accuracy() -> None:
    """Held for a fault, for 20 ms, and for 3 s without any; quiet is what is left, a second behind each."""
    faults = [FaultOrder("box-silent", 2.0, 1.0)]
    logbook = _logbook([(2.0, 3.2), (25.0, 25.02), (27.0, 29.0)])
    run: Any = SimpleNamespace(logbook=logbook, start_ns=0)
    alone = held_check("soak", run, faults, judged=True)
    assert (alone.passed, alone.good) == (False, False)
    assert alone.found == "held 2 times, 1 of them without a fault"
    assert held_check("soak", run, faults, judged=False).good
    left = unheld_spans([(4.0, 10.0), (20.0, 30.0)], held_spans(logbook, 0))
    assert np.array(left) == pytest.approx(np.array([[4.2, 10.0], [20.0, 25.0], [26.02, 27.0]]), abs=0.01)
    assert unheld_spans([(4.0, 10.0)], []) == [(4.0, 10.0)]
    assert unheld_spans([(4.0, 10.0)], [(0.0, 20.0)]) == []


def test_counts_that_nobody_commanded_are_seen() -> None:
    logbook = _logbook([(11.0, 12.0)])
    track = _track(logbook)
    run: Any = SimpleNamespace(track=track, logbook=logbook, watch=_watch([]), start_ns=0)
    astray, looked = given_astray(run)
    assert astray == 0
    assert looked > 2500
    track.inserted[1000:1010, 0] += 30
    assert given_astray(run)[0] == 10


def test_accuracy_is_the_root_mean_square_of_the_directions() -> None:
    logbook = _logbook([])
    track = _track(logbook)
    track.tip_um[:, 0], track.tip_um[:, 1], track.tip_um[:, 2] = 3.0, 100.0, -4.0
    found = accuracy(track, ("X", "Z"), [(0.0, 30.0)])
    assert found.rms_um == pytest.approx(5.0)
    assert found.largest_um == pytest.approx(5.0)
    assert found.axis_rms_um == {"X": pytest.approx(3.0), "Z": pytest.approx(4.0)}
    assert math.isnan(accuracy(track, ("X",), []).rms_um)


@pytest.mark.parametrize(("on_um", "passed"), [(1.0, True), (1.09, True), (0.92, True), (1.12, False), (0.9, False)])
def test_the_improvement_must_be_that_of_the_simulation(on_um: float, passed: bool) -> None:
    def comparison(rms_um: float) -> OffAndOn:
        return OffAndOn(Accuracy(10.0, 0.0, {}), Accuracy(rms_um, 0.0, {}))

    assert improvement_check(comparison(on_um), comparison(1.0), [(4.0, 30.0)]).passed is passed
    short = improvement_check(comparison(9.0), comparison(1.0), [(4.0, 8.0)])
    assert not short.passed
    assert not short.judged
    assert short.good
    assert "not judged" in short.words


def test_without_a_correction_there_is_no_improvement_whatever_the_durations() -> None:
    """Oracle: both runs have the same errors, so the factor is 1. The errors change along the programme."""
    logbook = _logbook([])
    track = _track(logbook)
    track.tip_um[:] = np.random.default_rng(1).normal(size=(len(track.time_s), 3)) * (1.0 + track.time_s[:, None])
    for off_s, on_s in ((25.0, 8.0), (8.0, 25.0), (12.0, 30.0)):
        spans = compared_spans([(4.0, 6.0), (9.0, on_s)] if on_s > 9.0 else [(4.0, on_s)], off_s)
        off, on = (TipTrack(*(v[track.time_s < end] for v in vars(track).values())) for end in (off_s, on_s))
        assert max(high for _, high in spans) <= min(off_s, on_s)
        assert OffAndOn(accuracy(off, ("X", "Z"), spans), accuracy(on, ("X", "Z"), spans)).factor == 1.0
    assert compared_spans([(10.0, 20.0)], 8.0) == []


def _result(compared_s: float, checks: list[Check], *, stopped: bool = False) -> HilResult:
    off, on = Accuracy(24.0, 30.0, {"X": 24.0}), Accuracy(10.0, 12.0, {"X": 10.0})
    times = {"p50_us": 1.0, "p99_us": 1.0, "max_us": 1.0}
    timing = {"cycles": 1, "deadline_misses": 0, "wake_up": times, "compute": times, "devices": {}}
    no = np.zeros(0)
    return HilResult(
        machine="mill",
        rate_hz=500.0,
        off_s=8.0,
        on_s=35.0,
        wiring={},
        buses=OffAndOn(off, on),
        simulated=OffAndOn(off, on),
        compared_s=compared_s,
        off_timing=timing,
        on_timing=timing,
        faults=[],
        checks=checks,
        warnings=[],
        course=Course(("X",), no, no, no),
        stopped=stopped,
    )


def test_what_was_not_judged_is_neither_claimed_nor_counted() -> None:
    """Oracle: one check passed, two were not judged, for different reasons; 0.2 s are too few to compare."""
    comparison = OffAndOn(Accuracy(24.0, 0.0, {}), Accuracy(10.0, 0.0, {}))
    checks = [
        Check("ledger", passed=True, found="exact"),
        Check("held", passed=True, found="never", judged=False),
        improvement_check(comparison, comparison, [(4.0, 4.2)]),
    ]
    page = hil_page(_result(0.2, checks), figures=False)
    assert "times more accurate" not in page.lead
    assert "not judged" in page.lead
    assert ("1 of 1", "checks passed, 2 not judged") in page.numbers
    table = page.sections[-1].table
    assert table is not None
    assert [row[0] for row in table.rows] == ["yes", "-", "-"]
    assert "this PC is shared" not in table.rows[2][2]
    assert hil_facts(_result(0.2, checks))["buses"]["factor"] is None
    checks[-1] = improvement_check(comparison, comparison, [(4.0, 30.0)])
    enough = hil_page(_result(26.0, checks), figures=False)
    assert "2.4 times more accurate" in enough.lead
    assert ("2 of 2", "checks passed, 1 not judged") in enough.numbers
    assert "stopped after 35.0 s" in hil_page(_result(26.0, checks, stopped=True), figures=False).lead


def test_the_watch_orders_to_resume_and_puts_words_down_to_their_bus() -> None:
    faults = [FaultOrder("box-reset", 2.0, 1.0), FaultOrder("modbus-silent", 2.0, 3.0)]
    clock = VirtualClock(10 * NS)
    watch, orders = _watch(faults, clock), list[float]()
    watch.start_ns = 10 * NS
    watch.resume = lambda: orders.append(clock.now_ns() / NS - 10.0)
    for tenth in range(60):
        clock.sleep_until_ns(10 * NS + tenth * NS // 10)
        watch.look(Status(devices={"tc": ["slave 1: no answer"]} if tenth >= 25 else {}))
    assert orders == [pytest.approx(3.0 + AFTER_S, abs=0.11)]
    assert watch.reports[0].texts == {}
    assert watch.reports[1].texts == {"tc": "slave 1: no answer"}
    assert watch.reports[1].noticed_s == pytest.approx(0.5)
    assert watch.unasked == {}


def test_the_log_tells_a_jump_but_not_a_ledger_taken_over(tmp_path: Path) -> None:
    """Oracle: the slew limit of the run file, 50 µm/s: 0.05 µm a cycle."""
    setup = setups.setup(tmp_path)
    layout = Layout(setup.machine.axis_names, setup.machine.sensor_names)

    def fastest(step_um: float, mode: int) -> float:
        samples, commands = Samples.empty(layout, 100), Commands.empty(layout, 100)
        samples.time_ns[:] = np.arange(100) * 1_000_000
        samples.mode[:] = MODE_ON
        samples.mode[60] = mode
        commands.applied_um[60:, 0] = step_um
        commands.flags[70:] = int(Flag.HELD | Flag.STALE_COUNTS)
        path = tmp_path / "log.arrows"
        path.unlink(missing_ok=True)
        with LogWriter(path, layout, setup.log_header()) as writer:
            writer.write(samples.rows(0, 60), commands.rows(0, 60))
            writer.write(samples.rows(60, 100), commands.rows(60, 100))
        book = read_logbook(path, setup)
        assert book.held.tolist() == [False] * 70 + [True] * 30
        return book.fastest

    assert fastest(0.05, MODE_ON) == pytest.approx(1.0)
    assert fastest(0.5, MODE_ON) == pytest.approx(10.0)
    assert fastest(0.5, MODE_TAKEN_OVER) == 0.0


# ---- soak


@pytest.mark.parametrize("seed", range(5))
def test_drawn_faults_leave_time_to_recover(seed: int) -> None:
    """One at a time on a bus, the cable first, all kinds of a bus before any comes again; the same seed, the same."""
    faults = draw_faults(["box", "modbus", "can"], 600.0, seed)
    assert faults == draw_faults(["can", "box", "modbus"], 600.0, seed)
    assert max(f.end_s for f in faults) <= 600.0 - RECOVER_S
    for bus in ("box", "modbus", "can"):
        mine = [f for f in faults if FAULTS[f.name].bus == bus]
        kinds = {n for n, f in FAULTS.items() if f.bus == bus}
        assert mine[0].name == f"{bus}-unplugged"
        assert {f.name for f in mine[1 : 1 + len(kinds)]} == kinds
        assert all(a.end_s < b.at_s for a, b in pairwise(mine))


def test_growth_is_seen() -> None:
    """Flat noise passes; one file more, or 3 MiB more, does not. Memory is not judged in few cycles, however long."""
    chance = random.Random(3)
    resources = Resources()
    resources._cycles = 120_000
    flat = [100.0 + chance.random() * 0.5 for _ in range(120)]
    for what, values in (("memory", flat), ("files", [19.0] * 120), ("threads", [4.0] * 120)):
        resources._series["loop", what] = _series(values)
    assert all(c.passed for c in resources.checks(1e6)[:3])
    resources._series["loop", "memory"] = _series([v + k / 40.0 for k, v in enumerate(flat)])
    resources._series["loop", "files"] = _series([19.0] * 100 + [20.0] * 20)
    assert [c.passed for c in resources.checks(1e6)[:3]] == [False, False, True]
    resources._cycles = 60_000
    assert [c.good for c in resources.checks(1e6)[:3]] == [True, False, True]
    assert [c.judged for c in resources.checks(1e6, stopped=True)[:3]] == [False] * 3


def test_lost_deadlines_are_put_down_to_their_cause() -> None:
    resources = Resources()
    resources._cycles = 100_000
    for _ in range(1000):
        resources._cpu.add(200_000)
    for _ in range(1000):
        resources._workers.add(50_000)
    usual_ns, usual_wait_ns = 20 * 200_000, 20 * 50_000
    resources._lost = [
        TimeStretch(20, 3, usual_ns + 3_000_000, 0, 0, 0),
        TimeStretch(20, 5, usual_ns, 5_000_000, 0, 0),
        TimeStretch(20, 7, usual_ns, 0, usual_wait_ns + 4_000_000, 0),
        TimeStretch(20, 11, usual_ns, 0, usual_wait_ns, 0),
        TimeStretch(20, 13, usual_ns + 40_000_000, 0, 0, 40_000_000),
    ]
    found = resources.deadlines(1e6)
    assert (found.lost, found.own, found.taken_away, found.behind_worker) == (39, 3, 18, 7)
    assert resources.checks(1e6)[-1].passed
    resources._cycles = 10_000
    assert not resources.checks(1e6)[-1].passed
    told = resources.checks(1e6, judged=False)[-1]
    assert (told.passed, told.judged, told.good) == (False, False, True)
    assert told.words.startswith("not judged, as this PC is shared: ")


def _series(values: list[float]) -> ResourceSeries:
    out = ResourceSeries()
    out.values.extend(values)
    return out
