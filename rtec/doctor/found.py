"""What the doctor finds, as data: of each device of a run file, and of this computer."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from rtec.loop.run_file import RunFile
from rtec.machine import Machine


@dataclass(frozen=True)
class Patient:
    """What the doctor is given.

    Attributes:
        path: of the run file.
        file: what it says.
        machine: that it names.
        root: where this computer's files are.
    """

    path: Path
    file: RunFile
    machine: Machine
    root: Path

    def roles(self, device: str) -> tuple[str, ...]:
        """What the run file uses a device for, by the keys of `[role]`."""
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
    """Something that must be mended.

    Attributes:
        what: is wrong.
        mend: ways to mend it, the likeliest first; empty where `what` says it itself.
    """

    what: str
    mend: tuple[str, ...] = ()


@dataclass(frozen=True)
class Value:
    """One thing that a device reads.

    Attributes:
        name: of the axis or sensor.
        value: the newest, in `unit`.
        unit: "mm", "°C", "1/min", "counts" or "units".
        digits: behind the point, as far as they mean something.
        age_s: since it was acquired; None where the device does not say.
        rate_hz: new values a second; None where it has read less than two.
    """

    name: str
    value: float
    unit: str
    digits: int
    age_s: float | None = None
    rate_hz: float | None = None


@dataclass
class DeviceFound:
    """One device of the run file.

    Attributes:
        name, driver: in the run file.
        roles: what the run file uses it for.
        doing: what is being done with it now: "waits", "is made", "is opened", "is read", "is closed", "done".
        values: what it reads.
        wrong: what must be mended.
        told: what else is to be known.
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
    """All devices of a run file.

    Attributes:
        machine: its name.
        seconds: how long each device was read.
        devices: each device.
        wrong: what is wrong with the run file itself, or with what all devices together give.
    """

    machine: str
    seconds: float
    devices: list[DeviceFound]
    wrong: list[DeviceFault]

    @property
    def well(self) -> bool:
        """Is nothing wrong?"""
        return not self.wrong and not any(d.wrong for d in self.devices)

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {**asdict(self), "well": self.well}


State = Literal["good", "better", "wrong", "unknown"]
"""Good; works, and there is better; keeps the loop from its rhythm; not to be read here."""


@dataclass(frozen=True)
class PcFinding:
    """One thing that matters for real time.

    Attributes:
        topic: what.
        found: how it is here.
        state: is that good?
        why: what it does to the loop, and what to know before it is changed; or "".
        limits: lines for a file in /etc/security/limits.d.
        unit: lines for the [Service] section of a systemd unit.
        kernel: words for the kernel's command line.
        commands: to type, or what to do in words.
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
    """This computer.

    Attributes:
        findings: one thing each.
    """

    findings: tuple[PcFinding, ...]

    @property
    def well(self) -> bool:
        """Does nothing keep the loop from its rhythm?"""
        return all(f.state != "wrong" for f in self.findings)

    def lines(self, where: Literal["limits", "unit", "kernel", "commands"]) -> list[str]:
        """What to write there, or to do, each once; in the order of the findings."""
        return list(dict.fromkeys(line for f in self.findings for line in getattr(f, where)))

    def plain(self) -> dict[str, Any]:
        """As data for JSON."""
        return {"well": self.well, "findings": [asdict(f) for f in self.findings]}
