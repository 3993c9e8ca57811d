"""Reports of a run: while it goes on (`Status`), at its end (`Report`), each alarm as an event (`Alarms`).

`RowWatch` makes the status from the rows that pass, and accumulates the report of the whole run. A status has the
present faults; the events have the earlier ones, such as those of the night, with begin and end.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from rtec.correction.flags import REASONS, Flag
from rtec.daemon.ring import Ring
from rtec.loop.ports import HOLDS
from rtec.loop.records import MODES_BY_NAME, NEVER_NS, Commands, Layout, Samples
from rtec.text import joined, without_numbers


def texts_of(flags: Flag, causes: Mapping[str, str]) -> dict[str, str]:
    """Texts of flags for people, by the flag's name, each with its cause where that is known."""
    texts = {flag.name or "": text for flag, text in REASONS.items() if flag in flags}
    return {name: f"{text}: {causes[name]}" if name in causes else text for name, text in texts.items()}


@dataclass
class Status:
    """The newest row in words, with the loop's other figures.

    Attributes:
        time_s: since the first row.
        time_ns: instant of the newest row, monotonic clock; 0 before the first.
        cycles, misses: of the loop.
        mode: "on", "off" or "hold", as ordered.
        requested_um, applied_um, output, counts: by axis name; counts that were never read are None, and the request
            that follows from them is NaN.
        counts_age_s: age of the counts when the row was made; NaN where they were never read.
        flags: bits of `Flag`.
        causes: which device, sensor or axis a flag is about, and what is allowed, by the flag's name; only where that
            can be named.
        degc, degc_age_s: by sensor name; NaN where it was never read.
        spindle_rpm: NaN where it is not known.
        devices: present faults by device; only devices with a fault.
        takeovers: number of orders to resume that were carried out.
        reload: result of the last order to reload; "" before the first.
        reloads: number of reloads that the loop has taken over.
        log: present fault of the log; "" where there is none.
        overruns: number of rows that are in no log: the ring was full, or the disk.
        faults: how often a part of the daemon (a thread, a worker) failed and was restarted, by part.
        kept_mode: mode of the state on disk, which survives a power cut; "" where there is none (yet), None where the
            run file names no folder for it.
        parts: present faults by part of the daemon; only parts with a fault.
    """

    time_s: float = 0.0
    time_ns: int = 0
    cycles: int = 0
    misses: int = 0
    mode: str = ""
    requested_um: dict[str, float] = field(default_factory=dict)
    applied_um: dict[str, float] = field(default_factory=dict)
    output: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int | None] = field(default_factory=dict)
    counts_age_s: float = 0.0
    flags: Flag = field(default_factory=lambda: Flag(0))
    causes: dict[str, str] = field(default_factory=dict)
    degc: dict[str, float] = field(default_factory=dict)
    degc_age_s: dict[str, float] = field(default_factory=dict)
    spindle_rpm: float = float("nan")
    devices: dict[str, list[str]] = field(default_factory=dict)
    takeovers: int = 0
    reload: str = ""
    reloads: int = 0
    log: str = ""
    overruns: int = 0
    faults: dict[str, int] = field(default_factory=dict)
    parts: dict[str, str] = field(default_factory=dict)
    kept_mode: str | None = None

    @property
    def reasons(self) -> list[str]:
        """Why the applied correction is not the requested one."""
        return list(texts_of(self.flags, self.causes).values())


@dataclass
class Report:
    """Result of a run.

    Attributes:
        summary: the fast path's figures.
        warnings: what the system refused, and faults of the log.
        log: path of the log.
        overruns: rows that did not reach the log.
        interrupted: did a signal end it?
        status: the last row.
        flags_seen: share of cycles that carried each flag, by the flag's name.
        largest_um: largest applied correction by axis.
        unfinished: what a sign check left in the machine, in words; empty where it left nothing.
    """

    summary: dict[str, Any]
    warnings: list[str]
    log: Path | None
    overruns: int
    interrupted: bool
    status: Status
    flags_seen: dict[str, float]
    largest_um: dict[str, float]
    unfinished: str = ""


NS = 1e-9
MODE_NAMES: Final = {number: name for name, number in MODES_BY_NAME.items()}


class RowWatch:
    """Accumulates status and report from the rows.

    Args:
        layout: axes and sensors.
        without: flags that are no news: a run without an actuator is always off.
        period_ns: longest time between two values of an output. Only a row with a new value says that the actuator can
            give no more; it stays so until the next.

    Attributes:
        status: of the newest row.
        rows: number of rows so far.
        largest_um: largest applied correction so far, by axis.
        newest: the newest row; None before the first.
    """

    def __init__(self, layout: Layout, without: Flag = Flag(0), period_ns: int = 0) -> None:  # noqa: B008 (a number)
        self.layout, self.status, self.rows = layout, Status(), 0
        self._looked_at, self._period_ns, self._saturated_ns = ~int(without), period_ns, 0
        self.newest: Samples | None = None
        self._first_ns: int | None = None
        self._flag_counts = np.zeros(len(Flag), dtype=np.int64)
        self._largest = np.zeros(len(layout.axes))
        self._passed = Flag(0)

    def look(self, samples: Samples, commands: Commands, ring: Ring) -> None:
        """Add rows, at least one."""
        if self._first_ns is None:
            self._first_ns = int(samples.time_ns[0])
        self.rows += len(samples)
        self.newest = samples.rows(len(samples) - 1, len(samples))
        flags = commands.flags & self._looked_at
        self._flag_counts += [np.count_nonzero(flags & int(flag)) for flag in Flag]
        self._passed |= Flag(int(np.bitwise_or.reduce(flags)))
        self._largest = np.maximum(self._largest, np.abs(commands.applied_um).max(axis=0))
        axes, sensors = self.layout.axes, self.layout.sensors
        now_ns, now = int(samples.time_ns[-1]), Flag(int(flags[-1]))
        saturated = np.flatnonzero(flags & int(Flag.OUTPUT_SATURATED))
        if len(saturated):
            self._saturated_ns = int(samples.time_ns[saturated[-1]]) + self._period_ns
        if now_ns < self._saturated_ns:
            now |= Flag.OUTPUT_SATURATED
        degc_time_ns = samples.degc_time_ns[-1]
        degc_age_s = np.where(degc_time_ns == 0, np.nan, (now_ns - degc_time_ns) * NS)
        counts_read = int(samples.counts_time_ns[-1]) != NEVER_NS
        requested_um = commands.requested_um[-1] if counts_read else np.full(len(axes), np.nan)
        self.status = Status(
            time_s=(now_ns - self._first_ns) * NS,
            time_ns=now_ns,
            cycles=self.rows + ring.overruns,
            misses=ring.deadline_misses,
            mode=MODE_NAMES.get(ring.orders.mode, ""),
            requested_um=dict(zip(axes, requested_um.tolist(), strict=True)),
            applied_um=dict(zip(axes, commands.applied_um[-1].tolist(), strict=True)),
            output=dict(zip(axes, commands.output[-1].tolist(), strict=True)),
            counts=dict(zip(axes, samples.counts[-1].tolist() if counts_read else [None] * len(axes), strict=True)),
            counts_age_s=(now_ns - int(samples.counts_time_ns[-1])) * NS if counts_read else float("nan"),
            flags=now,
            degc=dict(zip(sensors, samples.degc[-1].tolist(), strict=True)),
            degc_age_s=dict(zip(sensors, degc_age_s.tolist(), strict=True)),
            spindle_rpm=float(samples.spindle_rpm[-1]),
            devices=ring.note.read() if ring.note is not None else {},
            takeovers=ring.takeovers,
            reloads=ring.reloads,
            overruns=ring.overruns,
        )

    def take_passed(self) -> Flag:
        """Flags of all rows since the last call."""
        passed, self._passed = self._passed, Flag(0)
        return passed

    @property
    def largest_um(self) -> dict[str, float]:
        """Largest applied correction so far, µm, by axis."""
        return dict(zip(self.layout.axes, self._largest.tolist(), strict=True))

    @property
    def flags_seen(self) -> dict[str, float]:
        """Share of rows that carried each flag, by the flag's name."""
        return {
            flag.name or str(flag): count / self.rows
            for flag, count in zip(Flag, self._flag_counts.tolist(), strict=True)
            if count
        }


ORDERED: Final = Flag.ORDERED_HOLD | Flag.ORDERED_OFF | Flag.FADING
"""Flags without an alarm: ordered, which is an event of its own, or a consequence of another flag."""
START_NS: Final = 10_000_000_000
"""Time, ns, that slow devices may take for their first reading."""
QUIET_NS: Final = 10_000_000_000
"""A fault that returns within this time, ns, is the same alarm."""

Tell = Callable[[str, str], None]


MOST_REASONS: Final = 5
"""An alarm tells so many different reasons at most,"""
MOST_WAITING: Final = 50
"""and so many where one of them waits for an order: nothing goes on before somebody reads it."""


@dataclass
class _Alarm:
    since_ns: int
    last_ns: int
    texts: dict[str, str] = field(default_factory=dict)
    """By what they say but for numbers, such as a time that grows."""


class Alarms:
    """Reports each alarm when it begins, when it has another reason, and when it has been over for some seconds.

    Args:
        tell: called with the kind of event, "alarm" or "alarm over", and a text.
    """

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._going_on: dict[str, _Alarm] = {}
        self._first_ns: int | None = None

    def look(
        self,
        now_ns: int,
        passed: Flag,
        devices: Mapping[str, Sequence[str]],
        causes: Mapping[str, str] | None = None,
        loop: str = "",
    ) -> None:
        """Begin and end alarms.

        Args:
            now_ns: monotonic.
            passed: flags of any of the rows since the last look.
            devices: present faults, by device.
            causes: those of the newest row's flags, by the flag's name.
            loop: what is wrong with the loop itself; "" for nothing.
        """
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        if now_ns - self._first_ns < START_NS:
            return
        wrong = _wrong(passed & ~ORDERED, devices, causes or {}) | ({"loop": loop} if loop else {})
        for key, text in wrong.items():
            alarm = self._going_on.setdefault(key, _Alarm(now_ns, now_ns))
            alarm.last_ns, says = now_ns, without_numbers(text)
            if any(known.startswith(says) for known in alarm.texts):
                continue  # the newest row was good again: the flag without its cause is no news
            most = MOST_WAITING if HOLDS in text else MOST_REASONS
            if says not in alarm.texts and len(alarm.texts) < most:
                alarm.texts[says] = text
                self._tell("alarm", text)
        for key, alarm in list(self._going_on.items()):
            if now_ns - alarm.last_ns >= QUIET_NS:
                del self._going_on[key]
                lasted_s = (alarm.last_ns - alarm.since_ns) * 1e-9
                self._tell("alarm over", f"{'; then '.join(alarm.texts.values())}; it lasted {lasted_s:.1f} s")


def _wrong(flags: Flag, devices: Mapping[str, Sequence[str]], causes: Mapping[str, str]) -> dict[str, str]:
    """Texts by device and role: a text with a growing time is still one alarm."""
    out = {f"flag {name}": text for name, text in texts_of(flags, causes).items()}
    return out | {f"device {name}": f"device {name}: {joined(texts)}" for name, texts in devices.items()}
