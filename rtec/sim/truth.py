"""The truth of the simulated machine, read from TOML; the model never reads this file.

Section names have the unit of their values: `motion_um`, `motion_urad`, `growth_um`, `growth_urad`, `drift_um`. Shapes
are sums of long waves and local bumps, on purpose not polynomials.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.quantities import (
    Coefficient,
    DegreesCelsius,
    DegreesDifference,
    DegreesSpread,
    HoursPositive,
    Micrometres,
    MicrometresNotNegative,
    Microradians,
    Millimetres,
    MillimetresPerSecond,
    MillimetresPerSecond2,
    MillimetresPositive,
    Radians,
    SecondsPositive,
    Share,
    WattsPerKelvin,
)
from rtec.tomlfile import Strict, nearest, read_toml, validated

Motion = Literal["X", "Y", "Z", "A", "B", "C"]
AngularMotion = Literal["A", "B", "C", "A0", "B0", "C0"]


class Ambient(Strict):
    """Air of the workshop: a daily wave, a slow random walk that returns, and days that differ by seed."""

    mean_degc: DegreesCelsius = 20.0
    swing_degc: DegreesSpread = 0.0
    coldest_at_h: Annotated[float, Field(ge=-1e5, le=1e5)] = -3.0
    day_spread_degc: DegreesSpread = 0.0
    walk_degc_per_sqrt_h: DegreesSpread = 0.0
    walk_return_h: HoursPositive = 6.0


class Body(Strict):
    """A first-order body of the thermal network."""

    capacity_j_per_k: Annotated[float, Field(ge=1e-3, le=1e12)]
    to_air_w_per_k: WattsPerKelvin = 0.0


class Conductance(Strict):
    """Heat path between two bodies."""

    between: tuple[str, str]
    w_per_k: WattsPerKelvin


class SpindleHeat(Strict):
    """Heat of the spindle, `w_at_1000_rpm · (n/1000)^exponent`, shared among bodies."""

    w_at_1000_rpm: Annotated[float, Field(ge=0, le=1e6)]
    exponent: Annotated[float, Field(ge=1e-3, le=10)]
    shares: dict[str, Share]


class SensorTruth(Strict):
    """A sensor on a body (or in the air: body "air")."""

    body: str
    offset_degc: DegreesDifference = 0.0
    noise_degc: DegreesSpread = 0.0
    lag_s: SecondsPositive = 1.0
    resolution_degc: DegreesSpread = 0.0


class TrueShape(Strict):
    """`slope_per_m · q` + waves (amplitude, wavelength mm, phase rad) + bumps (height, centre mm, width mm)."""

    slope_per_m: Coefficient = 0.0
    waves: tuple[tuple[Coefficient, MillimetresPositive, Radians], ...] = ()
    bumps: tuple[tuple[Coefficient, Millimetres, MillimetresPositive], ...] = ()


class Screw(Strict):
    """Screw or scale that determines the slide's position: expansion and periodic errors.

    Attributes:
        bodies: its bodies, of equal lengths along the travel.
        fixed_at_mm: its fixed point, where expansion is zero.
        um_per_m_degc: expansion coefficient.
        bend_per_degc: relative rise of that coefficient per °C (real steel is not quite linear).
        cyclic_um: error once per pitch; `cyclic2_um` twice per pitch; phases in rad.
        encoder_um: error once per turn of the encoder on the screw; has no meaning on a linear scale.
    """

    bodies: tuple[str, ...] = ()
    fixed_at_mm: Millimetres = 0.0
    um_per_m_degc: Coefficient = 0.0
    bend_per_degc: Coefficient = 0.0
    cyclic_um: Micrometres = 0.0
    cyclic_phase_rad: Radians = 0.0
    cyclic2_um: Micrometres = 0.0
    cyclic2_phase_rad: Radians = 0.0
    encoder_um: Micrometres = 0.0
    encoder_phase_rad: Radians = 0.0


class Drive(Strict):
    """Servo drive and position loop of one axis, and the heat that it makes."""

    kv_per_s: Annotated[float, Field(ge=1e-3, le=1e4)] = 40.0
    feed_forward: Annotated[float, Field(ge=0, le=10)] = 1.0
    lag_ms: Annotated[float, Field(ge=1e-3, le=1e6)] = 2.0
    heat_j_per_mm: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    shares: dict[str, Share] = Field(default_factory=dict)
    production_feed_mm_s: Annotated[float, Field(ge=0, le=1e5)] = 50.0


class AxisTruth(Strict):
    """One axis: place of its encoder, its six motions, squareness and play."""

    encoder: Literal["screw", "scale"] = "screw"
    backlash_um: MicrometresNotNegative = 0.0
    screw: Screw = Screw()
    drive: Drive = Drive()
    motion_um: dict[str, TrueShape] = Field(default_factory=dict)
    motion_urad: dict[str, TrueShape] = Field(default_factory=dict)
    squareness_urad: dict[Literal["A", "B", "C"], Microradians] = Field(default_factory=dict)


class Growth(Strict):
    """Motion `X`, `Y` or `Z` of a link, µm per °C of a body, or of its difference to another body (`minus`)."""

    link: str
    motion: Literal["X", "Y", "Z"]
    body: str
    minus: str | None = None
    per_degc: Coefficient
    per_degc2: Coefficient = 0.0


class AngularGrowth(Growth):
    """As `Growth`, µrad; `A0` `B0` `C0` tilt only an axis' direction of travel (squareness, parallelism)."""

    motion: AngularMotion  # type: ignore[assignment]


class UnseenDrift(Strict):
    """A slow wave that no sensor reads; its phase differs by seed."""

    link: str
    motion: Literal["X", "Y", "Z"]
    amplitude: Coefficient
    period_h: HoursPositive


class Servo(Strict):
    """The controller: one speed profile for all."""

    period_us: Literal[50, 100, 125, 200, 250, 500, 1000] = 500
    rapid_mm_s: MillimetresPerSecond = 250.0
    acceleration_mm_s2: MillimetresPerSecond2 = 2000.0
    spindle_rpm_per_s: Annotated[float, Field(ge=1e-3, le=1e9)] = 2000.0


class Truth(Strict):
    """A whole simulated machine; `check_truth` compares it with the machine file."""

    reference_degc: DegreesCelsius = 20.0
    ambient: Ambient = Ambient()
    body: dict[str, Body]
    conductance: tuple[Conductance, ...] = ()
    spindle: SpindleHeat
    sensor: dict[str, SensorTruth] = Field(default_factory=dict)
    axis: dict[str, AxisTruth] = Field(default_factory=dict)
    growth_um: tuple[Growth, ...] = ()
    growth_urad: tuple[AngularGrowth, ...] = ()
    drift_um: tuple[UnseenDrift, ...] = ()
    servo: Servo = Servo()


def load_truth(path: Path) -> Truth:
    """Read a truth file.

    Raises:
        ConfigError: the file is wrong; the message has section, key and what is allowed.
    """
    return validated(Truth, read_toml(path), str(path))


def check_truth(truth: Truth, machine: Machine, source: str = "truth") -> None:
    """Compare the names in a truth with each other and with the machine.

    Raises:
        ConfigError: names are unknown; the message has one a line.
    """
    faults = [
        *_unknown("sensor", truth.sensor, machine.sensor_names),
        *_unknown("axis", truth.axis, machine.axis_names),
        *(
            f"[sensor.{name}] is missing; the machine has it"
            for name in machine.sensor_names
            if name not in truth.sensor
        ),
        *(f"[axis.{name}] is missing; the machine has it" for name in machine.axis_names if name not in truth.axis),
        *_body_faults(truth),
        *_motion_faults(truth, machine),
    ]
    if faults:
        raise ConfigError("\n".join(f"{source}: {fault}" for fault in faults))


def _unknown(
    section: str, names: "dict[str, SensorTruth] | dict[str, AxisTruth]", allowed: tuple[str, ...]
) -> list[str]:
    return [f"[{section}.{n}] is not in the machine{nearest(n, allowed)}" for n in names if n not in allowed]


def _body_faults(truth: Truth) -> list[str]:
    used = [(f"conductance {c.between}", name) for c in truth.conductance for name in c.between]
    used += [("spindle.shares", name) for name in truth.spindle.shares]
    used += [(f"sensor.{n}", s.body) for n, s in truth.sensor.items() if s.body != "air"]
    for name, axis in truth.axis.items():
        used += [(f"axis.{name}.screw", body) for body in axis.screw.bodies]
        used += [(f"axis.{name}.drive.shares", body) for body in axis.drive.shares]
    for g in (*truth.growth_um, *truth.growth_urad):
        used += [(f"growth of {g.link}", body) for body in (g.body, g.minus) if body not in (None, "air")]
    return [f"[{where}] no body {name!r}{nearest(name, truth.body)}" for where, name in used if name not in truth.body]


def _motion_faults(truth: Truth, machine: Machine) -> list[str]:
    out = []
    for name, axis in truth.axis.items():
        for section, keys, letters in (
            ("motion_um", axis.motion_um, "XYZ"),
            ("motion_urad", axis.motion_urad, "ABC"),
        ):
            allowed = [f"E{letter}{name}" for letter in letters]
            out += [f"[axis.{name}.{section}] no motion {k!r}{nearest(k, allowed)}" for k in keys if k not in allowed]
    links = (*machine.tool_chain, *machine.work_chain)
    items: list[Growth | UnseenDrift] = [*truth.growth_um, *truth.growth_urad, *truth.drift_um]
    for item in items:
        allowed_links = machine.axis_names if item.motion.endswith("0") else links
        if item.link not in allowed_links:
            out.append(
                f"[growth, drift] motion {item.motion}: no link {item.link!r}{nearest(item.link, allowed_links)}"
            )
    return out
