"""Makes a status of the rows that pass, and remembers what the whole run came to."""

import numpy as np

from rtec.correction.guard import Flag
from rtec.daemon.ring import Ring
from rtec.daemon.status import Status
from rtec.loop.records import MODES_BY_NAME, Commands, Layout, Samples

NS = 1e-9
_NAMES = {number: name for name, number in MODES_BY_NAME.items()}


class Watch:
    """Looks at rows.

    Attributes:
        status: of the newest row.
        rows: seen so far.
        largest_um: largest applied correction so far, by axis.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout, self.status, self.rows = layout, Status(), 0
        self._first_ns: int | None = None
        self._flag_counts = np.zeros(len(Flag), dtype=np.int64)
        self._largest = np.zeros(len(layout.axes))
        self._passed = Flag(0)

    def look(self, samples: Samples, commands: Commands, ring: Ring) -> None:
        """Take rows in, at least one."""
        if self._first_ns is None:
            self._first_ns = int(samples.time_ns[0])
        self.rows += len(samples)
        self._flag_counts += [np.count_nonzero(commands.flags & int(flag)) for flag in Flag]
        self._passed |= Flag(int(np.bitwise_or.reduce(commands.flags)))
        self._largest = np.maximum(self._largest, np.abs(commands.applied_um).max(axis=0))
        axes, sensors = self.layout.axes, self.layout.sensors
        now_ns = int(samples.time_ns[-1])
        degc_age_s = (now_ns - samples.degc_time_ns[-1]) * NS
        self.status = Status(
            time_s=(now_ns - self._first_ns) * NS,
            time_ns=now_ns,
            cycles=self.rows + ring.overruns,
            misses=ring.deadline_misses,
            mode=_NAMES.get(ring.orders.mode, ""),
            requested_um=dict(zip(axes, commands.requested_um[-1].tolist(), strict=True)),
            applied_um=dict(zip(axes, commands.applied_um[-1].tolist(), strict=True)),
            output=dict(zip(axes, commands.output[-1].tolist(), strict=True)),
            counts=dict(zip(axes, samples.counts[-1].tolist(), strict=True)),
            counts_age_s=(now_ns - int(samples.counts_time_ns[-1])) * NS,
            flags=Flag(int(commands.flags[-1])),
            degc=dict(zip(sensors, samples.degc[-1].tolist(), strict=True)),
            degc_age_s=dict(zip(sensors, degc_age_s.tolist(), strict=True)),
            spindle_rpm=float(samples.spindle_rpm[-1]),
            devices=ring.note.read() if ring.note is not None else {},
            takeovers=ring.takeovers,
            reloads=ring.reloads,
            overruns=ring.overruns,
        )

    def take_passed(self) -> Flag:
        """Give the flags of all rows since this was asked the last time."""
        passed, self._passed = self._passed, Flag(0)
        return passed

    @property
    def largest_um(self) -> dict[str, float]:
        """By axis."""
        return dict(zip(self.layout.axes, self._largest.tolist(), strict=True))

    @property
    def flags_seen(self) -> dict[str, float]:
        """Share of rows that carried each flag, by the flag's name."""
        return {
            flag.name or str(flag): count / self.rows
            for flag, count in zip(Flag, self._flag_counts.tolist(), strict=True)
            if count
        }
