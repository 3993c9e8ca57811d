"""Thermocouple voltages and what is believed of a reading."""

import importlib
from typing import Any

import numpy as np
import pytest

from rtec.errors import ConfigError, DriverFault, DriverUnavailable
from rtec.tomlfile import validated
from rtec_drivers.can.driver import TemperatureSignal
from rtec_drivers.modbus.map import Register, blocks_of, load_profile, profile_names
from rtec_drivers.temperatures import KINDS, Conversion, Kind, TemperatureReadings, to_degc

NAMES = ("T_bed", "T_air")
S = 1_000_000_000

# NIST, ITS-90 thermocouple database (SRD 60), reference tables: °C and mV against 0 °C, printed to 0.001 mV.
TABLE: dict[Kind, list[tuple[float, float]]] = {
    "B": [(500.0, 1.242), (1000.0, 4.834), (1500.0, 10.099)],
    "E": [(-100.0, -5.237), (25.0, 1.495), (100.0, 6.319), (500.0, 37.005)],
    "J": [(-100.0, -4.633), (25.0, 1.277), (100.0, 5.269), (500.0, 27.393)],
    "K": [(-100.0, -3.554), (25.0, 1.000), (100.0, 4.096), (500.0, 20.644), (1000.0, 41.276)],
    "N": [(-100.0, -2.407), (25.0, 0.659), (100.0, 2.774), (500.0, 16.748)],
    "R": [(25.0, 0.141), (100.0, 0.647), (1000.0, 10.506)],
    "S": [(25.0, 0.143), (100.0, 0.646), (1000.0, 9.587)],
    "T": [(-100.0, -3.379), (25.0, 0.992), (100.0, 4.279), (300.0, 14.862)],
}


def to_mv(kind: Kind, tip_degc: float, cold_junction_degc: float) -> float:
    table = importlib.import_module("thermocouple_its90").get(kind)
    return float(table.emf(tip_degc)) - float(table.emf(cold_junction_degc))


@pytest.fixture
def package() -> None:
    pytest.importorskip("thermocouple_its90", reason="not installed: pip install 'rtec[thermocouples]'")


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize("kind", KINDS)
def test_voltages_are_those_of_the_nist_tables(kind: Kind) -> None:
    """Oracle: the printed tables; the temperature within what half of their last digit is worth."""
    for degc, mv in TABLE[kind]:
        assert abs(to_mv(kind, degc, 0.0) - mv) <= 0.00051
        slope = (to_mv(kind, degc + 1.0, 0.0) - to_mv(kind, degc - 1.0, 0.0)) / 2.0
        assert abs(to_degc(kind, mv, 0.0) - degc) <= 0.0006 / slope


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize("kind", KINDS)
def test_the_cold_junction_is_added_as_a_voltage_not_as_degrees(kind: Kind) -> None:
    """Oracle: forward and back; and the sum of degrees, which is wrong, is not what comes out."""
    for tip in (400.0, 650.0) if kind == "B" else (60.0, 350.0):
        for cold in (15.0, 35.0):
            assert abs(to_degc(kind, to_mv(kind, tip, cold), cold) - tip) < 1e-6
    if kind != "B":
        assert abs(to_degc(kind, to_mv(kind, 350.0, 35.0), 0.0) + 35.0 - 350.0) > 0.3


@pytest.mark.usefixtures("package")
def test_what_no_thermocouple_can_give_is_told() -> None:
    with pytest.raises(DriverFault, match=r"type K: 80 mV with terminals at 25 °C"):
        to_degc("K", 80.0, 25.0)
    with pytest.raises(DriverFault, match="type B"):
        to_degc("B", 0.0, 25.0)


def test_without_the_package_the_way_on_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    real = importlib.import_module

    def absent(name: str, *rest: Any) -> Any:
        if name == "thermocouple_its90":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(DriverUnavailable, match=r"pip install 'rtec\[thermocouples\]'"):
        TemperatureReadings(NAMES, {"T_bed": Conversion(thermocouple="K", cold_junction=25.0)})
    TemperatureReadings(NAMES, {"T_bed": Conversion()})  # nobody who needs no thermocouple needs the package


def filled(readings: TemperatureReadings) -> tuple[list[float], list[int]]:
    degc, time_ns = np.full(2, np.nan), np.zeros(2, np.int64)
    readings.fill(degc, time_ns)
    return degc.tolist(), time_ns.tolist()


@pytest.mark.usefixtures("package")
def test_a_voltage_waits_for_a_fresh_cold_junction() -> None:
    """Oracle: 4.096 mV against 25 °C is 124.3 °C by the table: E(124.3) = 4.096 + 1.000."""
    bed = Conversion(scale=0.001, thermocouple="K", cold_junction="terminals", range_degc=(0.0, 300.0))
    readings = TemperatureReadings(NAMES, {"T_bed": bed, "terminals": Conversion(scale=0.01)})
    readings.take("T_bed", 4096, 1 * S)
    assert any("its cold junction 'terminals' has no fresh temperature" in f for f in readings.faults())
    readings.take("terminals", 2500, 2 * S)
    readings.take("T_bed", 4096, 3 * S)
    (bed_degc, air_degc), (bed_ns, air_ns) = filled(readings)
    assert abs(to_mv("K", bed_degc, 0.0) - 5.096) < 0.0005
    assert (bed_ns, air_ns) == (3 * S, 0)
    assert np.isnan(air_degc)
    assert readings.faults() == []
    readings.take("T_bed", 4097, 90 * S)
    assert len(readings.faults()) == 1
    assert filled(readings)[1][0] == 3 * S


def test_what_is_wrong_with_several_sensors_is_said_once() -> None:
    """A line that is gone: its sensors in one sentence, as a person would say it."""
    readings = TemperatureReadings(NAMES, {name: Conversion() for name in NAMES})
    readings.silent(NAMES, "no connection")
    assert readings.faults() == ["T_bed, T_air: no connection"]
    readings.silent(NAMES[1:], "no answer")
    assert readings.faults() == ["T_bed: no connection", "T_air: no answer"]


def test_a_reading_is_stuck_after_its_time_and_not_before() -> None:
    readings = TemperatureReadings(NAMES, {"T_bed": Conversion(scale=0.1, stuck_s=600.0)})
    for k in range(601):
        readings.take("T_bed", 215, (100 + k) * S)
    assert readings.faults() == []
    readings.take("T_bed", 215, 701 * S)
    assert readings.faults() == ["T_bed: stuck: 21.50 °C has not changed for 601 s"]
    assert filled(readings)[1][0] == 700 * S
    readings.take("T_bed", 214, 702 * S)
    assert readings.faults() == []
    assert filled(readings)[1][0] == 702 * S


def test_wrong_conversions_are_told() -> None:
    for options, told in (
        ({"thermocouple": "K"}, "thermocouple and cold_junction go together"),
        ({"range_degc": [50, 10]}, r"range_degc must be \[lowest, highest\]"),
        ({"thermocouple": "Q", "cold_junction": 25.0}, "thermocouple"),
    ):
        with pytest.raises(ConfigError, match=told):
            validated(Conversion, options, "run.toml")


@pytest.mark.parametrize("name", profile_names())
def test_shipped_profiles_name_their_source_and_are_consistent(name: str) -> None:
    """Oracle: one request fetches all channels, which lie side by side; plain type K readings come out in °C."""
    profile = load_profile(name)
    assert len(profile.source) > 20
    assert len(profile.channel) in (6, 8)
    assert len(blocks_of(1, profile.channel, 0)) == 1
    for register in profile.channel.values():
        assert register.words == 1
        full = register.scale * 65536 + register.offset
        assert 700 < full < 7000


def test_word_orders_and_types() -> None:
    """Oracle: the numbers' own bytes."""
    assert Register(address=0, type="int32").number([0xFFFF, 0xFB2E]) == -1234
    assert Register(address=0, type="int32", word_order="low").number([0xFB2E, 0xFFFF]) == -1234
    assert Register(address=0, type="float32").number([0x4212, 0x8000]) == 36.625
    assert Register(address=0, type="uint16").number([0xFFFF]) == 65535
    assert Register(address=0).number([0xFFFF]) == -1


def test_reads_are_joined_where_registers_touch_and_gaps_are_allowed() -> None:
    """Oracle: counted by hand."""
    registers = {n: Register(address=a) for n, a in (("a", 0), ("b", 1), ("c", 5), ("d", 200))}
    registers["e"] = Register(address=1, function="input", type="float32")
    spans = [(b.request.function, b.request.address, b.request.count) for b in blocks_of(7, registers, 0)]
    assert spans == [(3, 0, 2), (3, 5, 1), (3, 200, 1), (4, 1, 2)]
    assert len(blocks_of(7, registers, 3)) == 3
    assert len(blocks_of(7, registers, 120)) == 3  # 125 registers are the most that one answer holds


@pytest.mark.parametrize(
    ("kind", "codes", "words"),
    [
        ("int16", [65535], "65535 is no int16, which goes from -32768 to 32767; as int16 it is -1"),
        ("int16", [0x8000], "as int16 it is -32768"),
        ("uint16", [-32768], "-32768 is no uint16, which goes from 0 to 65535; as uint16 it is 32768"),
        ("int32", [32767, 0xFFFFFFFF], "4294967295 is no int32, .*; as int32 it is -1"),
        ("int16", [3276.7], r"3276\.7 is no int16, which goes from -32768 to 32767$"),
    ],
)
def test_an_open_code_that_can_never_come_is_refused(kind: str, codes: list[float], words: str) -> None:
    """It would pass a broken wire as a temperature: 65535 comes as -1, and -0.1 °C is believed."""
    table = {"address": 0, "type": kind, "open_codes": codes}
    with pytest.raises(ConfigError, match=words):
        validated(Register, table, "run.toml")
    signal = {"node": 5, "map": [kind.replace("uint", "u").replace("int", "i")], "open_codes": codes}
    with pytest.raises(ConfigError, match="open_codes: "):
        validated(TemperatureSignal, signal, "run.toml")


def test_an_open_code_of_floats_is_met_as_the_bus_sends_it() -> None:
    """9999.9 cannot be written in 32 bits; the device's nearest number is meant. Oracle: numpy's own rounding."""
    book = TemperatureReadings(
        ["T"], {"T": Register(address=0, type="float32", open_codes=(9999.9,), range_degc=(0, 1e6))}
    )
    book.take("T", float(np.float32(9999.9)), S)
    assert book.faults() == ["T: open circuit: the device sent 9999.9; look at the sensor and its wires"]
    for near in (9999.0, 9999.8, 10000.0):
        book.take("T", float(np.float32(near)), S)
        assert book.faults() == []


def test_a_register_ends_where_the_addresses_end() -> None:
    with pytest.raises(ConfigError, match="address 65535: int32 takes 2 registers; 65535 is last"):
        validated(Register, {"address": 65535, "type": "int32"}, "run.toml")
    assert validated(Register, {"address": 65535}, "run.toml").words == 1
