"""What is found of this computer: is it fit for a loop that must never be late?"""

from dataclasses import asdict, dataclass
from typing import Any, Literal

State = Literal["good", "better", "wrong", "unknown"]
"""Good; works, and there is better; keeps the loop from its rhythm; not to be read here."""


@dataclass(frozen=True)
class Finding:
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

    findings: tuple[Finding, ...]

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
