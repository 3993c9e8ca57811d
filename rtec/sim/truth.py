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
    """Air of the workshop: a daily wave, a slow random walk that returns, and days that differ by seed.

    Attributes:
        mean_degc: its mean temperature.
        swing_degc: amplitude of the daily wave.
        coldest_at_h: when it is coldest, h from the start of the run.
        day_spread_degc: standard deviation of the mean between days.
        walk_degc_per_sqrt_h: step of the random walk, °C/√h.
        walk_return_h: time in which the walk returns to the mean.
    """

    mean_degc: DegreesCelsius = 20.0
    swing_degc: DegreesSpread = 0.0
    coldest_at_h: Annotated[float, Field(ge=-1e5, le=1e5)] = -3.0
    day_spread_degc: DegreesSpread = 0.0
    walk_degc_per_sqrt_h: DegreesSpread = 0.0
    walk_return_h: HoursPositive = 6.0


class Body(Strict):
    """A first-order body of the thermal network.

    Attributes:
        capacity_j_per_k: heat capacity, J/K; its time constant in air is this over `to_air_w_per_k`.
        to_air_w_per_k: heat path to the air, W/K.
    """

    capacity_j_per_k: Annotated[float, Field(ge=1e-3, le=1e12)]
    to_air_w_per_k: WattsPerKelvin = 0.0


class Conductance(Strict):
    """Heat path between two bodies.

    Attributes:
        between: names of the two bodies.
        w_per_k: heat that flows for each K between them, W/K.
    """

    between: tuple[str, str]
    w_per_k: WattsPerKelvin


class SpindleHeat(Strict):
    """Heat of the spindle, `w_at_1000_rpm · (n/1000)^exponent`, shared among bodies.

    Attributes:
        w_at_1000_rpm: heat at 1000 1/min, W.
        exponent: growth of the heat with the speed: 1 to 2.
        shares: share of the heat that each body takes, by name; together at most 1.
    """

    w_at_1000_rpm: Annotated[float, Field(ge=0, le=1e6)]
    exponent: Annotated[float, Field(ge=1e-3, le=10)]
    shares: dict[str, Share]


class SensorTruth(Strict):
    """A sensor on a body (or in the air: body "air").

    Attributes:
        body: name of the body that it reads; "air" for the workshop's.
        offset_degc: what it reads too much.
        noise_degc: standard deviation of its white noise.
        lag_s: time constant with which it follows its body.
        resolution_degc: its smallest step; 0 for none.
    """

    body: str
    offset_degc: DegreesDifference = 0.0
    noise_degc: DegreesSpread = 0.0
    lag_s: SecondsPositive = 1.0
    resolution_degc: DegreesSpread = 0.0


class TrueShape(Strict):
    """`slope_per_m · q` + waves + bumps, in µm or µrad by the table that it is in.

    Attributes:
        slope_per_m: straight part, per metre of travel.
        waves: amplitude, wavelength mm and phase rad of each wave.
        bumps: height, centre mm and width mm of each local bump.
    """

    slope_per_m: Coefficient = 0.0
    waves: tuple[tuple[Coefficient, MillimetresPositive, Radians], ...] = ()
    bumps: tuple[tuple[Coefficient, Millimetres, MillimetresPositive], ...] = ()


class Screw(Strict):
    """Screw or scale that determines the slide's position: expansion and periodic errors.

    Attributes:
        bodies: its bodies, of equal lengths along the travel.
        fixed_at_mm: its fixed point, where expansion is zero.
        um_per_m_degc: expansion coefficient, µm/(m·°C).
        bend_per_degc: relative rise of that coefficient per °C (real steel is not quite linear).
        cyclic_um: amplitude of the error once per pitch.
        cyclic_phase_rad: its phase.
        cyclic2_um: amplitude of the error twice per pitch.
        cyclic2_phase_rad: its phase.
        encoder_um: amplitude of the error once per turn of the encoder on the screw; has no meaning on a linear scale.
        encoder_phase_rad: its phase.
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
    """Servo drive and position loop of one axis, and the heat that it makes.

    Attributes:
        kv_per_s: gain of the position loop, 1/s.
        feed_forward: share of the speed that goes to the drive directly; 1 leaves no following error.
        lag_ms: time constant of the speed loop.
        heat_j_per_mm: heat that a way of 1 mm makes, J/mm.
        shares: share of that heat that each body takes, by name.
        production_feed_mm_s: usual feed, from which a day's heat is reckoned where no program runs.
    """

    kv_per_s: Annotated[float, Field(ge=1e-3, le=1e4)] = 40.0
    feed_forward: Annotated[float, Field(ge=0, le=10)] = 1.0
    lag_ms: Annotated[float, Field(ge=1e-3, le=1e6)] = 2.0
    heat_j_per_mm: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    shares: dict[str, Share] = Field(default_factory=dict)
    production_feed_mm_s: Annotated[float, Field(ge=0, le=1e5)] = 50.0


class AxisTruth(Strict):
    """One axis: place of its encoder, its six motions, squareness and play.

    Attributes:
        encoder: where its encoder is: "screw" or "scale".
        backlash_um: play at a reversal.
        motion_um: translational error of its slide by component: "EXX", "EYX", "EZX".
        motion_urad: rotational error of its slide by component: "EAX", "EBX", "ECX".
        squareness_urad: tilt of its line of travel about A, B or C.
    """

    encoder: Literal["screw", "scale"] = "screw"
    backlash_um: MicrometresNotNegative = 0.0
    screw: Screw = Screw()
    drive: Drive = Drive()
    motion_um: dict[str, TrueShape] = Field(default_factory=dict)
    motion_urad: dict[str, TrueShape] = Field(default_factory=dict)
    squareness_urad: dict[Literal["A", "B", "C"], Microradians] = Field(default_factory=dict)


class Growth(Strict):
    """Motion of a link, µm per °C of a body, or of its difference to another body (`minus`).

    Attributes:
        link: name of the link that moves.
        motion: direction: X, Y or Z.
        body: the body whose temperature moves it.
        minus: a second body; the difference to its temperature counts. Not set: to the reference.
        per_degc: motion per °C, µm or µrad.
        per_degc2: motion per °C², µm or µrad.
    """

    link: str
    motion: Literal["X", "Y", "Z"]
    body: str
    minus: str | None = None
    per_degc: Coefficient
    per_degc2: Coefficient = 0.0


class AngularGrowth(Growth):
    """As `Growth`, µrad; `A0` `B0` `C0` tilt only an axis' direction of travel (squareness, parallelism).

    Attributes:
        motion: rotation A, B or C of the link; A0, B0 or C0 of the axis' line of travel alone.
    """

    motion: AngularMotion  # type: ignore[assignment]


class UnseenDrift(Strict):
    """A slow wave that no sensor reads; its phase differs by seed.

    Attributes:
        link: name of the link that drifts.
        motion: direction: X, Y or Z.
        amplitude: its height, µm.
        period_h: its period.
    """

    link: str
    motion: Literal["X", "Y", "Z"]
    amplitude: Coefficient
    period_h: HoursPositive


class Servo(Strict):
    """The controller: one speed profile for all.

    Attributes:
        period_us: servo period.
        rapid_mm_s: speed of rapid motions.
        acceleration_mm_s2: acceleration of all axes.
        spindle_rpm_per_s: ramp of the spindle, 1/min per second.
    """

    period_us: Literal[50, 100, 125, 200, 250, 500, 1000] = 500
    rapid_mm_s: MillimetresPerSecond = 250.0
    acceleration_mm_s2: MillimetresPerSecond2 = 2000.0
    spindle_rpm_per_s: Annotated[float, Field(ge=1e-3, le=1e9)] = 2000.0


class Truth(Strict):
    """A whole simulated machine; `check_truth` compares it with the machine file.

    Attributes:
        reference_degc: temperature at which nothing has grown.
        ambient: air of the workshop.
        body: the bodies of the thermal network, by name.
        conductance: heat paths between them.
        spindle: the spindle's heat.
        sensor: the machine file's sensors, by name.
        axis: the machine file's axes, by name.
        growth_um: links that move as bodies warm up.
        growth_urad: links that tilt as bodies warm up.
        drift_um: slow motions that no sensor reads.
        servo: the controller.
    """

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
