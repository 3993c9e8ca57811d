"""From raw numbers off a bus to valid temperatures: scale, open circuit, range, cold junction, stuck sensor.

One thread writes (`take`, `silent`), any thread reads (`fill`, `faults`); a reader never waits for a writer, because
each snapshot is replaced as a whole.

Converts thermocouple voltages by the reference functions of ITS-90 (NIST Monograph 175, IEC 60584-1).

A thermocouple's voltage depends on the difference between its tip and its terminals (the cold junction). So the voltage
of a tip at the terminals' temperature, against 0 °C, is added before the function is inverted:
`tip = E⁻¹(measured + E(cold junction))`.
"""

import importlib
import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Self

import numpy as np
from pydantic import model_validator

from rtec.arrays import Floats, Ints
from rtec.errors import ConfigError, DriverError, DriverFault, DriverUnavailable
from rtec.quantities import Code, Coefficient, DegreesCelsius, Factor, SecondsPositive
from rtec.tomlfile import Strict, nearest

Kind = Literal["B", "E", "J", "K", "N", "R", "S", "T"]
KINDS: tuple[Kind, ...] = ("B", "E", "J", "K", "N", "R", "S", "T")


def to_degc(kind: Kind, measured_mv: float, cold_junction_degc: float) -> float:
    """Temperature of the tip, °C.

    Args:
        kind: letter of the thermocouple.
        measured_mv: voltage at the terminals, mV.
        cold_junction_degc: temperature of the terminals, °C.

    Raises:
        DriverFault: outside the range of the letter's function; type B starts at about 250 °C.
        DriverUnavailable: the package with the functions is not installed.
    """
    table = _table(kind)
    try:
        return float(table.temperature(measured_mv, reference=cold_junction_degc))
    except ValueError as e:
        at = f"{measured_mv:g} mV with terminals at {cold_junction_degc:g} °C"
        raise DriverFault(f"type {kind}: {at} is no temperature that this type can have") from e


def check_installed() -> None:
    """Raise now, not at the first reading, if the package is missing.

    Raises:
        DriverUnavailable: it is missing.
    """
    _table("K")


def _table(kind: Kind) -> Any:
    try:
        package = importlib.import_module("thermocouple_its90")
    except ImportError as e:
        raise DriverUnavailable(
            "thermocouple voltages need the package thermocouple-its90: pip install 'rtec[thermocouples]'"
        ) from e
    return package.get(kind)


SAME = 1e-7
"""Relative tolerance: 9999.9 is 9999.900390625 on a bus that sends numbers of 32 bits."""
COLD_JUNCTION_AGE_NS = 60_000_000_000
"""ns; terminals drift slowly, but after a minute without their temperature a voltage gives no temperature."""


class Conversion(Strict):
    """Conversion of a raw number to a temperature.

    Attributes:
        scale, offset: value = raw · scale + offset, in °C; in mV where `thermocouple` is given.
        open_codes: raw numbers that mean "no sensor, or its wire is broken".
        range_degc: possible temperatures of the sensor; a reading outside is a fault.
        stuck_s: a raw number that is constant for this time is a fault; a sensor of coarse steps in a quiet room
            needs a longer time.
        thermocouple: letter of the thermocouple, where the value is a voltage.
        cold_junction: for a voltage: temperature of the terminals, °C, or the name of the reading that gives it.
    """

    scale: Factor = 1.0
    offset: Coefficient = 0.0
    open_codes: tuple[Code, ...] = ()
    range_degc: tuple[DegreesCelsius, DegreesCelsius] = (-50.0, 250.0)
    stuck_s: SecondsPositive = 900.0
    thermocouple: Kind | None = None
    cold_junction: str | DegreesCelsius | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.thermocouple is None) != (self.cold_junction is None):
            raise ValueError("thermocouple and cold_junction go together")
        if not self.range_degc[0] < self.range_degc[1]:
            raise ValueError("range_degc must be [lowest, highest]")
        return self


def open_code_faults(codes: Sequence[float], bits: int, signed: bool, kind: str) -> str:
    """Why one of the codes can never be a whole number of that many bits; "" where all can.

    Manuals often give 65535 or 8000h where a signed number is -1 or -32768.
    """
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    for code in codes:
        if code.is_integer() and low <= code <= high:
            continue
        instead = ""
        if code.is_integer() and abs(code) < 1 << bits:
            instead = f"; as {kind} it is {(int(code) - low) % (1 << bits) + low}"
        return f"open_codes: {code:.15g} is no {kind}, which goes from {low} to {high}{instead}"
    return ""


@dataclass
class _State:
    raw: float = math.nan
    since_ns: int = 0
    degc: float = math.nan
    time_ns: int = 0


@dataclass(frozen=True)
class _Snapshot:
    index: Ints
    degc: Floats
    time_ns: Ints


class TemperatureReadings:
    """Newest valid temperature of each sensor of one device, and the faults of the others.

    Args:
        sensors: the machine's sensors, in the machine's order.
        conversions: by the name of the reading: a sensor, or a cold junction that another reading names.

    Raises:
        ConfigError: a name is neither, or names a cold junction that is not read.
        DriverUnavailable: a voltage needs a package that is not installed.
    """

    def __init__(self, sensors: Sequence[str], conversions: Mapping[str, Conversion]) -> None:
        junctions = {c.cold_junction for c in conversions.values() if isinstance(c.cold_junction, str)}
        faults = [
            f"{name!r}: the machine has no such sensor{nearest(name, sensors)}"
            for name in conversions
            if name not in sensors and name not in junctions
        ]
        faults += [
            f"cold_junction {n!r} is not read{nearest(n, conversions)}" for n in junctions if n not in conversions
        ]
        if faults:
            raise ConfigError("\n".join(faults))
        if any(c.thermocouple for c in conversions.values()):
            check_installed()
        self._sensors = {name: k for k, name in enumerate(sensors)}
        self._conversions = dict(conversions)
        self._states = {name: _State() for name in conversions}
        self._faults = dict.fromkeys(conversions, "no reading yet")
        self._snapshot = _Snapshot(np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64))

    def take(self, name: str, raw: float, time_ns: int) -> None:
        """Judge a raw number acquired at an instant, ns; publish it where it is valid."""
        state, conversion = self._states[name], self._conversions[name]
        if raw != state.raw or state.since_ns == 0:
            state.raw, state.since_ns = raw, time_ns
        try:
            degc, why = self._judged(conversion, state, raw, time_ns)
        except DriverError as e:
            degc, why = math.nan, str(e)
        self._faults[name] = why
        if why:
            return
        state.degc, state.time_ns = degc, time_ns
        self._publish()

    def silent(self, names: Iterable[str], why: str) -> None:
        """Record that no reading came; values and times stay."""
        for name in names:
            self._faults[name] = why

    def fill(self, degc: Floats, time_ns: Ints) -> None:
        """Write the newest valid values, °C, and their instants, ns, into the machine's arrays; change no others."""
        newest = self._snapshot
        degc[newest.index] = newest.degc
        time_ns[newest.index] = newest.time_ns

    def faults(self) -> list[str]:
        """Present faults, one line each, with the readings that have it; empty where there is none."""
        names: dict[str, list[str]] = {}
        for name, why in self._faults.items():
            if why:
                names.setdefault(why, []).append(name)
        return [f"{', '.join(of)}: {why}" for why, of in names.items()]

    def tell(self) -> None:
        """Raise the present faults.

        Raises:
            DriverFault: there are faults.
        """
        if any(self._faults.values()):
            raise DriverFault("; ".join(self.faults()))

    def _judged(self, conversion: Conversion, state: _State, raw: float, time_ns: int) -> tuple[float, str]:
        if not math.isfinite(raw):
            return math.nan, "the device sent no number"
        if any(math.isclose(raw, code, rel_tol=SAME) for code in conversion.open_codes):
            return math.nan, f"open circuit: the device sent {raw:g}; look at the sensor and its wires"
        value = raw * conversion.scale + conversion.offset
        if conversion.thermocouple is not None:
            value = to_degc(conversion.thermocouple, value, self._cold_junction_degc(conversion, time_ns))
        low, high = conversion.range_degc
        if not low <= value <= high:
            return value, f"{value:.1f} °C is outside range_degc, {low:g} to {high:g} °C"
        frozen_ns = time_ns - state.since_ns
        if frozen_ns > conversion.stuck_s * 1e9:
            return value, f"stuck: {value:.2f} °C has not changed for {frozen_ns * 1e-9:.0f} s"
        return value, ""

    def _cold_junction_degc(self, conversion: Conversion, time_ns: int) -> float:
        if not isinstance(conversion.cold_junction, str):
            return float(conversion.cold_junction or 0.0)
        junction = self._states[conversion.cold_junction]
        if junction.time_ns == 0 or time_ns - junction.time_ns > COLD_JUNCTION_AGE_NS:
            raise DriverError(f"its cold junction {conversion.cold_junction!r} has no fresh temperature")
        return junction.degc

    def _publish(self) -> None:
        rows = [(self._sensors[n], s) for n, s in self._states.items() if n in self._sensors and s.time_ns]
        self._snapshot = _Snapshot(
            np.array([k for k, _ in rows], np.int64),
            np.array([s.degc for _, s in rows]),
            np.array([s.time_ns for _, s in rows], np.int64),
        )


class StuckWatch:
    """Detects a reading that is constant, to the last digit, for too long.

    Args:
        after_s: longest time without a change.
    """

    def __init__(self, after_s: float) -> None:
        self._after_s = after_s
        self._since: dict[str, tuple[float, int]] = {}

    def look(self, name: str, value: float, now_ns: int) -> str:
        """Record a reading; give its fault, or ""."""
        known, since_ns = self._since.get(name, (None, now_ns))
        if known != value:
            self._since[name] = (value, now_ns)
            return ""
        still_s = (now_ns - since_ns) * 1e-9
        return f"{name}: has read {value:g} for {still_s:.0f} s: stuck" if still_s > self._after_s else ""


LOW_DEGC: Final = 10.0
HIGH_DEGC: Final = 45.0
SCALES: Final = (1.0, 0.1, 0.01)


def in_room(number: float, degc: bool = False) -> bool:
    """Is it a room's temperature in °C or, unless `degc`, in tenths or hundredths of it?"""
    return any(LOW_DEGC <= number * scale <= HIGH_DEGC for scale in (SCALES[:1] if degc else SCALES))


def room_high_word(word: int) -> bool:
    """Is it the high word of a float of 32 bits that is a room's temperature?

    As an integer it would be above 160 °C in hundredths, so no plain temperature is mistaken for one.
    """
    (value,) = struct.unpack(">f", struct.pack(">HH", word, 0))
    return in_room(value, degc=True)
