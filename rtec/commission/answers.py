"""The answers that `rtec init` needs, from a script's file or from its questions.

A template describes the kind of machine; the answers have what differs. `[role]` and `[device]` are as in a run file.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from rtec.correction.flags import Limits
from rtec.errors import ConfigError
from rtec.loop.run_file import Roles
from rtec.quantities import (
    CountsPerMillimetre,
    MicrometresPerSecond,
    MicrometresPerSecond2,
    MicrometresPositive,
    Millimetres,
    MillimetresPositive,
    SecondsPositive,
    Vector,
)
from rtec.tomlfile import Strict, nearest, read_toml, validated

FOLDER: Final = Path(__file__).parent / "templates"
TEMPLATES: Final = {
    "lathe": "two axes, X (radius) on Z",
    "mill": "three axes, the workpiece on X on Y, Z the spindle",
    "bridge": "three axes, the bridge on Y, X on it, Z the ram",
    "axis": "one axis",
}
WARNING_SHARE: Final = 0.8
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class AxisAnswer(Strict):
    """`[axis.X]`: an axis of the template, and its differences.

    Attributes:
        direction: machine coordinate along which it moves.
        travel_mm: lowest and highest position.
        resolution_um: µm per count of its scale or encoder, after x4; either this or `counts_per_mm`.
        counts_per_mm: counts per millimetre; either this or `resolution_um`.
        pitch_mm: pitch of the screw or scale; omit it where there is none.
        compensate: may rtec correct it?
    """

    direction: Literal["X", "Y", "Z"]
    travel_mm: tuple[Millimetres, Millimetres]
    resolution_um: MicrometresPositive | None = None
    counts_per_mm: CountsPerMillimetre | None = None
    pitch_mm: MillimetresPositive | None = None
    compensate: bool = True

    @model_validator(mode="after")
    def _one_scale(self) -> Self:
        if self.resolution_um is None and self.counts_per_mm is None:
            raise ValueError("give resolution_um (of one count) or counts_per_mm")
        return self

    @property
    def per_mm(self) -> float:
        """Counts per millimetre."""
        return self.counts_per_mm or 1e3 / (self.resolution_um or 1.0)


class LimitAnswer(Strict):
    """`[limits]`: limits of the correction of every axis.

    Attributes:
        stop_um: a larger request is not followed. Set it below anything that could cause damage.
        warning_um: a larger request is flagged; not given: 80 % of `stop_um`.
        slew_um_s: fastest change of the correction.
        acceleration_um_s2: fastest change of that speed.
    """

    stop_um: MicrometresPositive = 50.0
    warning_um: MicrometresPositive | None = None
    slew_um_s: MicrometresPerSecond = 20.0
    acceleration_um_s2: MicrometresPerSecond2 = 200.0

    @property
    def of_axis(self) -> Limits:
        """The limits in the form of the run file.

        Raises:
            ValueError: the warning is beyond the stop.
        """
        warning_um = self.warning_um or WARNING_SHARE * self.stop_um
        return Limits(
            warning_um=warning_um,
            stop_um=self.stop_um,
            slew_um_s=self.slew_um_s,
            acceleration_um_s2=self.acceleration_um_s2,
        )


class Answers(Strict):
    """All answers.

    Attributes:
        template: kind of machine: lathe, mill, bridge or axis.
        name: name of the machine.
        tool_chain: links from the base to the tool tip.
        work_chain: links from the base to the cutting point.
        axis: axes by name.
        link: offset of a fixed link from the one before it, mm; a link without an entry is at the one before it.
        sensors: names of the temperature sensors.
        role: which device reads and corrects, by its name in `device`; None: only files are measured, there is no run.
        device: devices, as in a run file.
        limits: limits of the correction.
        output: `[output]` of every corrected axis, where the actuator takes no counts; not given: from the device.
        rate_hz: cycles per second; not given: as fast as the counts' device allows.
        mode: mode after a start; "hold" until the machine is measured.
        counts_max_age_s: counts older than this hold the correction; not given: from the device.
        temperature_max_age_s: temperatures older than this hold it, too.
        log_folder: folder of the log, relative to the run file's folder.
    """

    template: Literal["lathe", "mill", "bridge", "axis"]
    name: Annotated[str, Field(min_length=1)]
    tool_chain: tuple[Name, ...]
    work_chain: tuple[Name, ...] = ()
    axis: dict[str, AxisAnswer]
    link: dict[Name, Vector] = Field(default_factory=dict)
    sensors: tuple[Name, ...] = ()
    role: Roles | None = None
    device: dict[str, dict[str, Any]] = Field(default_factory=dict)
    limits: LimitAnswer = LimitAnswer()
    output: dict[str, Any] | None = None
    rate_hz: Annotated[float, Field(ge=1, le=4000)] | None = None
    mode: Literal["on", "off", "hold"] = "hold"
    counts_max_age_s: SecondsPositive | None = None
    temperature_max_age_s: SecondsPositive = 30.0
    log_folder: Path = Path("logs")

    @model_validator(mode="after")
    def _role_of_devices(self) -> Self:
        if self.device and self.role is None:
            raise ValueError("[device.NAME] needs [role], which says what each device is for")
        return self


def template_tables(name: str) -> dict[str, Any]:
    """The tables of a template.

    Raises:
        ConfigError: no template has that name.
    """
    if name not in TEMPLATES:
        raise ConfigError(f"rtec init: no template {name!r}{nearest(name, TEMPLATES)}")
    return {"template": name, "name": name, **read_toml(FOLDER / f"{name}.toml")}


def with_answers(template: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """A template with the differences; tables are merged key by key, axes stay those of the template."""
    return {
        key: with_answers(template[key], given[key])
        if isinstance(template.get(key), Mapping) and isinstance(given.get(key), Mapping) and key != "link"
        else given.get(key, template.get(key))
        for key in dict.fromkeys([*template, *given])
    }


def answers_from(data: Mapping[str, Any], source: str) -> Answers:
    """Check the tables of an answers file, merged into those of its template.

    Raises:
        ConfigError: all faults.
    """
    template = data.get("template")
    if not isinstance(template, str):
        raise ConfigError(f"{source}: key 'template' is missing; it is one of {', '.join(TEMPLATES)}")
    tables = template_tables(template)
    unknown = [name for name in data.get("axis", {}) if name not in tables["axis"]]
    if unknown:
        known = nearest(unknown[0], tables["axis"])
        raise ConfigError(f"{source}: [axis.{unknown[0]}] the template {template!r} has no such axis{known}")
    for name, axis in data.get("axis", {}).items():
        if isinstance(axis, Mapping) and "counts_per_mm" in axis:
            tables["axis"][name].pop("resolution_um")
    answers = validated(Answers, with_answers(tables, data), source)
    try:
        _ = answers.limits.of_axis
    except ValueError as e:
        raise ConfigError(f"{source}: [limits] warning_um is above stop_um") from e
    return answers
