"""Units of measuring programs, and rtec's own unit of each kind."""

from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats
from rtec.tomlfile import nearest


@dataclass(frozen=True)
class Unit:
    """A unit; units of one `kind` can be converted: value in the kind's base = (value + before) × factor."""

    kind: str
    factor: float
    before: float = 0.0


INCH_MM = 25.4
URAD_PER_DEG = np.pi / 180.0 * 1e6

UNITS: dict[str, Unit] = {
    # length, base mm
    "nm": Unit("length", 1e-6),
    "um": Unit("length", 1e-3),
    "mm": Unit("length", 1.0),
    "cm": Unit("length", 10.0),
    "m": Unit("length", 1000.0),
    "inch": Unit("length", INCH_MM),
    "ft": Unit("length", 12.0 * INCH_MM),
    "mil": Unit("length", INCH_MM * 1e-3),
    "uinch": Unit("length", INCH_MM * 1e-6),
    # angle, base µrad
    "nrad": Unit("angle", 1e-3),
    "urad": Unit("angle", 1.0),
    "mrad": Unit("angle", 1e3),
    "rad": Unit("angle", 1e6),
    "deg": Unit("angle", URAD_PER_DEG),
    "gon": Unit("angle", 0.9 * URAD_PER_DEG),
    "arcmin": Unit("angle", URAD_PER_DEG / 60.0),
    "arcsec": Unit("angle", URAD_PER_DEG / 3600.0),
    "um/m": Unit("angle", 1.0),
    "mm/m": Unit("angle", 1e3),
    # temperature, base °C
    "degc": Unit("temperature", 1.0),
    "degf": Unit("temperature", 5.0 / 9.0, -32.0),
    "k": Unit("temperature", 1.0, -273.15),
    # time, base s
    "ns": Unit("time", 1e-9),
    "us": Unit("time", 1e-6),
    "ms": Unit("time", 1e-3),
    "s": Unit("time", 1.0),
    "min": Unit("time", 60.0),
    "h": Unit("time", 3600.0),
    "d": Unit("time", 86400.0),
    # speed, base mm/s
    "mm/s": Unit("speed", 1.0),
    "mm/min": Unit("speed", 1.0 / 60.0),
    "m/s": Unit("speed", 1000.0),
    "m/min": Unit("speed", 1000.0 / 60.0),
    "inch/s": Unit("speed", INCH_MM),
    "inch/min": Unit("speed", INCH_MM / 60.0),
    # acceleration, base mm/s²
    "mm/s2": Unit("acceleration", 1.0),
    "m/s2": Unit("acceleration", 1000.0),
    # turning, base 1/min
    "rpm": Unit("turning", 1.0),
    "1/s": Unit("turning", 60.0),
    # mass, base kg
    "kg": Unit("mass", 1.0),
    "g": Unit("mass", 1e-3),
    "t": Unit("mass", 1000.0),
    "lb": Unit("mass", 0.45359237),
    "1": Unit("number", 1.0),
}

ALIASES = {
    "µm": "um",
    "μm": "um",  # the Greek letter, not the micro sign
    "micron": "um",
    "microns": "um",
    "in": "inch",
    "inches": "inch",
    "in.": "inch",
    "zoll": "inch",
    "feet": "ft",
    "thou": "mil",
    "µinch": "uinch",
    "μinch": "uinch",
    "µin": "uinch",
    "μin": "uinch",
    "uin": "uinch",
    "microin": "uinch",
    "microinch": "uinch",
    "microinches": "uinch",
    "µrad": "urad",
    "μrad": "urad",
    "µm/m": "um/m",
    "μm/m": "um/m",
    "°": "deg",
    "degree": "deg",
    "degrees": "deg",
    "'": "arcmin",
    '"': "arcsec",
    "″": "arcsec",
    "°c": "degc",
    "c": "degc",
    "celsius": "degc",
    "℃": "degc",
    "ºc": "degc",  # the ordinal indicator, not the degree sign
    "deg c": "degc",
    "deg_c": "degc",
    "°f": "degf",
    "f": "degf",
    "fahrenheit": "degf",
    "℉": "degf",
    "deg f": "degf",
    "deg_f": "degf",
    "kelvin": "k",
    "°k": "k",
    "µs": "us",
    "μs": "us",
    "sec": "s",
    "seconds": "s",
    "sek": "s",
    "sekunden": "s",
    "minuten": "min",
    "std": "h",
    "stunden": "h",
    "tage": "d",
    "minutes": "min",
    "hours": "h",
    "days": "d",
    "1/min": "rpm",
    "u/min": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm",
    "min-1": "rpm",
    "min^-1": "rpm",
    "hz": "1/s",
    "mm/s²": "mm/s2",
    "mm/s^2": "mm/s2",
    "m/s²": "m/s2",
    "m/s^2": "m/s2",
    "": "1",
}

TORQUES = ("Nm", "kNm", "mNm", "Ncm")
"""Torques as they are written: in small letters the first is a nanometre."""
OTHERS = frozenset({
    "knm", "mnm", "ncm", "n*m", "n·m", "n.m", "n m", "lbf*ft", "n", "kn", "mn", "lbf", "a", "ma", "v", "mv", "w",
    "kw", "va", "bar", "mbar", "pa", "hpa", "kpa", "mpa", "psi", "l/min", "l/h", "m3/h", "%", "%rh", "% rh", "khz",
    "mhz", "j", "kj", "wh", "kwh", "ohm", "db", "ppm", "g/m3",
})  # fmt: skip
"""Units of what no column of a measurement holds, in small letters: torque, force, current, pressure, a share."""
NO_UNIT = frozenset({"", "1", "-", "none", "n/a", "bool", "count", "counts", "cts", "inc", "incr", "increments",
                     "digit", "digits", "raw", "state"})  # fmt: skip
"""Words for a number without a unit, or whose unit only the user knows."""

# The longest suffix that fits is the unit of a column.
SUFFIXES = {
    "_mm": "mm",
    "_um": "um",
    "_urad": "urad",
    "_deg": "deg",
    "_degc": "degc",
    "_s": "s",
    "_mm_s": "mm/s",
    "_mm_s2": "mm/s2",
    "_mm_min": "mm/min",
    "_rpm": "rpm",
    "_kg": "kg",
}


def canonical(name: str) -> str:
    """The unit's name in `UNITS`.

    Raises:
        ValueError: there is no such unit; the message has the nearest one.
    """
    word = name.strip().lower()
    if name.strip() in TORQUES:
        raise ValueError(f"unit {name!r} is a torque, which no column of a measurement holds")
    word = ALIASES.get(word, word)
    if word not in UNITS:
        raise ValueError(f"unit {name!r} is not known{nearest(word, UNITS)}")
    return word


def logged(name: str) -> str:
    """The unit that a log gives to a channel: its name in `UNITS`; "1" for one of `OTHERS`; empty for no unit.

    Raises:
        ValueError: as `canonical`.
    """
    word = name.strip().lower()
    if word in NO_UNIT:
        return ""
    return "1" if name.strip() in TORQUES or word in OTHERS else canonical(name)


def unit_of_column(column: str) -> str:
    """Unit of a column of a measurement file by its name's ending; "1" for `run` and directions."""
    fitting = [s for s in SUFFIXES if column.endswith(s)]
    return SUFFIXES[max(fitting, key=len)] if fitting else "1"


def convert(values: Floats, unit: str, target: str) -> Floats:
    """Convert values to another unit of the same kind.

    Raises:
        ValueError: the units are of different kinds or unknown.
    """
    have, want = UNITS[canonical(unit)], UNITS[canonical(target)]
    if have.kind != want.kind:
        raise ValueError(f"{unit} is a unit of {have.kind}, {target} of {want.kind}")
    if have == want:
        return values
    if not have.before and not want.before:
        return values * (have.factor / want.factor)
    return (values + have.before) * have.factor / want.factor - want.before
