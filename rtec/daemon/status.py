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
from rtec.loop.records import MODES_BY_NAME, NEVER_NS, Commands, Layout, Samples
from rtec.text import gist, joined
from rtec.wording import TO_RESUME


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
            takeovers=ring.takeovers,  # before the devices' faults, which the loop writes first
            devices=ring.note.read() if ring.note is not None else {},
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
"""An alarm tells so many reasons at most within `RECENT_NS`,"""
MOST_WAITING: Final = 50
"""and so many that wait for an order: nothing goes on before somebody reads them."""
RECENT_NS: Final = 600_000_000_000
MORE: Final = "more reasons come than are recorded; `rtec status` has the present ones"


@dataclass
class _Alarm:
    """An alarm that goes on.

    Attributes:
        since_ns, last_ns: first and last instant.
        says: clauses of its texts, without values, with their last instants; forgotten where away for a while.
        told: the first texts that were reported, by what they say.
        more: number of further ones.
        told_ns: instants of the recent ones, by whether they wait for an order.
        full: did it say that more reasons come than it tells?
    """

    since_ns: int
    last_ns: int
    says: dict[str, int] = field(default_factory=dict)
    told: dict[str, str] = field(default_factory=dict)
    more: int = 0
    told_ns: dict[bool, list[int]] = field(default_factory=lambda: {False: [], True: []})
    full: bool = False

    def look(self, now_ns: int, clauses: Sequence[str]) -> list[str]:
        """Note the present clauses; those that it does not know."""
        self.last_ns = now_ns
        new = []
        for clause in clauses:
            known = next((k for k in self.says if k.startswith(clause)), None)
            if known is None:
                new.append(clause)
            else:  # the newest row was good again: a flag without its cause is no news
                self.says[known] = now_ns
        self.says = {clause: at for clause, at in self.says.items() if now_ns - at < QUIET_NS}
        return new

    def has_room(self, now_ns: int, waits: bool) -> bool:
        """May one more reason be reported now?"""
        recent = self.told_ns[waits] = [at for at in self.told_ns[waits] if now_ns - at < RECENT_NS]
        if not recent:
            self.full = False
        return len(recent) < (MOST_WAITING if waits else MOST_REASONS)

    def add(self, now_ns: int, text: str, new: Sequence[str], waits: bool) -> None:
        """Note a text that is reported."""
        self.says |= dict.fromkeys(new, now_ns)
        self.told_ns[waits].append(now_ns)
        if len(self.told) < MOST_REASONS or waits:
            self.told.setdefault("; ".join(gist(text)), text)
        else:
            self.more += 1

    @property
    def over(self) -> str:
        """What to say at its end."""
        more = f"; then {self.more} more" if self.more else ""
        return f"{'; then '.join(self.told.values())}{more}; it lasted {(self.last_ns - self.since_ns) * 1e-9:.1f} s"


class Alarms:
    """Reports each alarm when it begins, when it has another reason, and when it has been over for some seconds.

    Args:
        tell: called with the kind of event, "alarm" or "alarm over", and a text.
    """

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._going_on: dict[str, _Alarm] = {}
        self._first_ns: int | None = None
        self._takeovers = 0

    def look(
        self,
        now_ns: int,
        passed: Flag,
        devices: Mapping[str, Sequence[str]],
        causes: Mapping[str, str] | None = None,
        loop: str = "",
        takeovers: int = 0,
    ) -> None:
        """Begin and end alarms.

        Args:
            now_ns: monotonic.
            passed: flags of any of the rows since the last look.
            devices: present faults, by device.
            causes: those of the newest row's flags, by the flag's name.
            loop: what is wrong with the loop itself; "" for nothing.
            takeovers: number of orders to resume that were carried out: what they ended is news if it comes again.
        """
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        if now_ns - self._first_ns < START_NS:
            return
        wrong = _wrong(passed & ~ORDERED, devices, causes or {})
        if loop:
            wrong["loop"] = loop, gist(loop)
        if takeovers != self._takeovers:
            self._takeovers = takeovers
            self._resumed(wrong)
        for key, (text, clauses) in wrong.items():
            alarm = self._going_on.setdefault(key, _Alarm(now_ns, now_ns))
            new, waits = alarm.look(now_ns, clauses), TO_RESUME in text
            if not new:
                continue
            if alarm.has_room(now_ns, waits):
                alarm.add(now_ns, text, new, waits)
                self._tell("alarm", text)
            elif not alarm.full:
                alarm.full = True
                self._tell("alarm", f"{text.partition(': ')[0]}: {MORE}")
        for key, alarm in list(self._going_on.items()):
            if now_ns - alarm.last_ns >= QUIET_NS:
                self._end(key)

    def _resumed(self, wrong: Mapping[str, tuple[str, Sequence[str]]]) -> None:
        """Forget what the order to resume has ended: devices' faults, and what waited for it."""
        for key, alarm in list(self._going_on.items()):
            if not key.startswith("device ") and not any(TO_RESUME in text for text in alarm.told.values()):
                continue
            if key in wrong:
                present = set(wrong[key][1])
                alarm.says = {clause: at for clause, at in alarm.says.items() if clause in present}
            else:
                self._end(key)

    def _end(self, key: str) -> None:
        self._tell("alarm over", self._going_on.pop(key).over)


def _wrong(
    flags: Flag, devices: Mapping[str, Sequence[str]], causes: Mapping[str, str]
) -> dict[str, tuple[str, list[str]]]:
    """Text and what its clauses say, by device and flag: a text with a growing time is still one alarm."""
    out = {}
    for name, text in texts_of(flags, causes).items():
        out[f"flag {name}"] = text, [name, *(gist(causes[name]) if name in causes else ())]
    for device, texts in devices.items():
        text = joined(texts)
        out[f"device {device}"] = f"device {device}: {text}", gist(text)
    return out
