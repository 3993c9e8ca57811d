"""The doctor's results as data: for each device of a run file, and for this computer."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from rtec.loop.run_file import RunFile
from rtec.machine import Machine


@dataclass(frozen=True)
class Patient:
    """The run file to examine.

    Attributes:
        path: path of the run file.
        file: its content.
        machine: the machine that it names.
        root: folder of this computer's files.
    """

    path: Path
    file: RunFile
    machine: Machine
    root: Path

    def roles(self, device: str) -> tuple[str, ...]:
        """Roles of a device in the run file, by the keys of `[role]`."""
        role = self.file.role
        uses = {
            "counts": role.counts == device,
            "temperatures": device in role.temperatures,
            "spindle": role.spindle == device,
            "actuator": role.actuator == device,
        }
        return tuple(name for name, so in uses.items() if so)


@dataclass(frozen=True)
class DeviceFault:
    """A fault to mend.

    Attributes:
        what: the fault.
        mend: ways to mend it, the likeliest first; empty where `what` implies it.
    """

    what: str
    mend: tuple[str, ...] = ()


@dataclass(frozen=True)
class Value:
    """One reading of a device.

    Attributes:
        name: name of the axis or sensor.
        value: newest value, in `unit`.
        unit: "mm", "°C", "1/min", "counts" or "units".
        digits: meaningful digits after the point.
        age_s: time since its acquisition; None where the device does not report it.
        rate_hz: new values a second; None before the second one.
    """

    name: str
    value: float
    unit: str
    digits: int
    age_s: float | None = None
    rate_hz: float | None = None


@dataclass
class DeviceFound:
    """Result for one device of the run file.

    Attributes:
        name, driver: as in the run file.
        roles: its roles in the run file.
        doing: present step: "waits", "is made", "is opened", "is read", "is closed", "done".
        values: its readings.
        wrong: its faults.
        told: remarks.
    """

    name: str
    driver: str
    roles: tuple[str, ...] = ()
    doing: str = "waits"
    values: list[Value] = field(default_factory=list)
    wrong: list[DeviceFault] = field(default_factory=list)
    told: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Examination:
    """Results for all devices of a run file.

    Attributes:
        machine: name of the machine.
        seconds: duration of reading each device.
        devices: result for each device.
        wrong: faults of the run file itself, or of all devices together.
    """

    machine: str
    seconds: float
    devices: list[DeviceFound]
    wrong: list[DeviceFault]

    @property
    def well(self) -> bool:
        """Is there no fault?"""
        return not self.wrong and not any(d.wrong for d in self.devices)

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {**asdict(self), "well": self.well}


State = Literal["good", "better", "wrong", "unknown"]
"""Good; works, but could be better; disturbs the loop's timing; cannot be read here."""


@dataclass(frozen=True)
class PcFinding:
    """One property of the computer that matters for real time.

    Attributes:
        topic: name of the property.
        found: its value here.
        state: judgement.
        why: effect on the loop, and cautions before a change; or "".
        limits: lines for a file in /etc/security/limits.d.
        unit: lines for the [Service] section of a systemd unit.
        kernel: words for the kernel's command line.
        commands: commands to type, or instructions in words.
    """

    topic: str
    found: str
    state: State
    why: str = ""
    limits: tuple[str, ...] = ()
    unit: tuple[str, ...] = ()
    kernel: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()


@dataclass(frozen=True)
class PcFound:
    """Result for this computer.

    Attributes:
        findings: one for each property.
    """

    findings: tuple[PcFinding, ...]

    @property
    def well(self) -> bool:
        """Does nothing disturb the loop's timing?"""
        return all(f.state != "wrong" for f in self.findings)

    def lines(self, where: Literal["limits", "unit", "kernel", "commands"]) -> list[str]:
        """Lines to write there, or to carry out, each once; in the order of the findings."""
        return list(dict.fromkeys(line for f in self.findings for line in getattr(f, where)))

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {"well": self.well, "findings": [asdict(f) for f in self.findings]}
