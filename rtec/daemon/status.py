"""What a run tells of itself: while it goes on (`Status`) and at its end (`Report`). Plain data."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtec.correction.guard import REASONS, Flag


@dataclass
class Status:
    """The newest row in words, and what the loop tells beside it.

    Attributes:
        time_s: since the first row.
        time_ns: instant of the newest row, monotonic clock; 0 before the first.
        cycles, misses: of the loop.
        mode: "on", "off" or "hold", as ordered.
        requested_um, applied_um, output, counts: by axis name.
        counts_age_s: age of the counts when the row was made.
        flags: bits of `Flag`.
        degc, degc_age_s: by sensor name.
        spindle_rpm: NaN where it is not known.
        devices: by device, what is wrong now; a device without a fault is not there.
        takeovers: orders to resume that were carried out.
        reload: what came of the last order to reload; "" before the first.
        reloads: reloads that the loop has taken over.
        log: what goes on with the log; "" where all is well.
        overruns: rows so far that are in no log: the ring was full, or the disk.
    """

    time_s: float = 0.0
    time_ns: int = 0
    cycles: int = 0
    misses: int = 0
    mode: str = ""
    requested_um: dict[str, float] = field(default_factory=dict)
    applied_um: dict[str, float] = field(default_factory=dict)
    output: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    counts_age_s: float = 0.0
    flags: Flag = field(default_factory=lambda: Flag(0))
    degc: dict[str, float] = field(default_factory=dict)
    degc_age_s: dict[str, float] = field(default_factory=dict)
    spindle_rpm: float = float("nan")
    devices: dict[str, list[str]] = field(default_factory=dict)
    takeovers: int = 0
    reload: str = ""
    reloads: int = 0
    log: str = ""
    overruns: int = 0

    @property
    def reasons(self) -> list[str]:
        """Why the correction is not simply the requested one."""
        return [text for flag, text in REASONS.items() if flag in self.flags]


@dataclass
class Report:
    """What a run came to.

    Attributes:
        summary: the fast path's own figures.
        warnings: what the system did not grant, and what went wrong with the log.
        log: where the log is.
        overruns: rows that did not reach the log.
        interrupted: ended by a signal.
        status: the last row.
        flags_seen: share of cycles that carried each flag, by the flag's name.
        largest_um: largest applied correction by axis.
    """

    summary: dict[str, Any]
    warnings: list[str]
    log: Path | None
    overruns: int
    interrupted: bool
    status: Status
    flags_seen: dict[str, float]
    largest_um: dict[str, float]
