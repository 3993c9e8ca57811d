"""Thermocouple voltages to temperatures, by the reference functions of ITS-90 (NIST Monograph 175, IEC 60584-1).

A thermocouple's voltage tells the difference between its tip and its terminals (the cold junction). So the voltage
that a tip at the terminals' temperature would give, against 0 °C, is added before the function is turned round:
`tip = E⁻¹(measured + E(cold junction))`.
"""

import importlib
from typing import Any, Literal

from rtec.errors import DriverFault, DriverUnavailable

Kind = Literal["B", "E", "J", "K", "N", "R", "S", "T"]
KINDS: tuple[Kind, ...] = ("B", "E", "J", "K", "N", "R", "S", "T")


def to_degc(kind: Kind, measured_mv: float, cold_junction_degc: float) -> float:
    """Temperature of the tip, °C.

    Args:
        kind: letter of the thermocouple.
        measured_mv: voltage at the terminals, mV.
        cold_junction_degc: temperature of the terminals, °C.

    Raises:
        DriverFault: outside what the letter's function is defined for; type B starts at about 250 °C.
        DriverUnavailable: the package with the functions is not installed.
    """
    table = _table(kind)
    try:
        return float(table.temperature(measured_mv, reference=cold_junction_degc))
    except ValueError as e:
        at = f"{measured_mv:g} mV with terminals at {cold_junction_degc:g} °C"
        raise DriverFault(f"type {kind}: {at} is no temperature that this type can have") from e


def to_mv(kind: Kind, tip_degc: float, cold_junction_degc: float) -> float:
    """Voltage at the terminals, mV, of a tip and terminals at these temperatures, °C; raises as `to_degc` does."""
    table = _table(kind)
    try:
        return float(table.emf(tip_degc)) - float(table.emf(cold_junction_degc))
    except ValueError as e:
        raise DriverFault(f"type {kind}: {tip_degc:g} °C or {cold_junction_degc:g} °C is outside its range") from e


def check_installed() -> None:
    """Say now, not at the first reading, that the package is missing.

    Raises:
        DriverUnavailable: it is.
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
