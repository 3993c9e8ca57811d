"""The long run: the whole bench with random faults, to show what only shows with time, as memory and open files."""

import multiprocessing
import os
import random
import tempfile
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rtec.daemon.status import Status
from rtec.hil import Check, Deadlines, FaultOrder, Resource, SoakFault, SoakOrder, SoakResult, Tell
from rtec.loop.stats import Histogram
from rtec_drivers.hil.bus_run import BusRun, ends_politely, every_ms_of, run_on_buses
from rtec_drivers.hil.faults import FAULTS, Bus
from rtec_drivers.hil.findings import RECOVER_S, checks_of, held_check
from rtec_drivers.hil.wiring import read_wiring

LOOP = "rtec-loop"
PERIOD_S = 1.0
MEMORY_SLACK = 0.5
"""Difference of memory, MiB, that is allowed between two thirds of a run: the allocator's own variation."""
USUAL_PERCENT = 95.0
OWN_SHARE = 0.5
"""A missed deadline is our own code's where the loop used more processor time than usual, by this share of it."""
ALLOWED_SHARE = 1e-4
"""Allowed share of all cycles: a virtual PC's host takes time unseen, which looks like our own processor time."""
LEAST_S = 90.0
"""Memory is judged once the loop's cycles add up to this time, s: until then every program fills its own pools. The
clock does not count, as a busy PC takes longer for the same cycles."""
PROC = Path("/proc")
UNITS = {"memory": "MiB", "files": "", "threads": ""}


@dataclass(frozen=True)
class TimeStretch:
    """Times of the loop's process between two looks.

    Attributes:
        cycles, misses: of the loop.
        cpu_ns, waited_ns: of its thread: on a processor, and ready but without one.
        workers_waited_ns: the same of its other threads, which may hold the interpreter's lock meanwhile.
        stolen_ns: time that the host took from this virtual PC, of all processors, in steps of 10 ms; the kernel counts
            it as the thread's own time where it hits one.
    """

    cycles: int
    misses: int
    cpu_ns: int
    waited_ns: int
    workers_waited_ns: int
    stolen_ns: int

    @property
    def own_ns(self) -> int:
        """Processor time of the loop's thread without the host's."""
        return max(0, self.cpu_ns - self.stolen_ns)


@dataclass
class ResourceSeries:
    """One figure of one process over time, in eight bytes a look: the record of memory must not grow itself."""

    values: "array[float]" = field(default_factory=lambda: array("d"))

    def thirds(self) -> tuple[float, float, float]:
        """Largest value of each third of the run."""
        parts = np.array_split(np.array(self.values), 3)
        first, middle, last = (float(p.max()) if len(p) else 0.0 for p in parts)
        return first, middle, last


class Resources:
    """Records the daemon's two processes: the supervisor, which is this one, and the loop.

    Memory is that of the process alone (RssAnon): the ring and mapped files are not counted.
    """

    def __init__(self) -> None:
        self._series: dict[tuple[str, str], ResourceSeries] = {}
        self._next_s = 0.0
        self._loop: int | None = None
        self._before: tuple[int, int, int, int, int, int] | None = None
        self._lost: list[TimeStretch] = []
        self._cycles = 0
        self._cpu, self._workers = Histogram(), Histogram()

    def look(self, status: Status) -> None:
        """Record the present figures; memory, files and threads once a second."""
        if self._loop is None:
            self._loop = next((p.pid for p in multiprocessing.active_children() if p.name == LOOP), None)
        self._look_at_time(status)
        if status.time_s < self._next_s:
            return
        self._next_s = status.time_s + PERIOD_S
        for name, pid in (("supervisor", os.getpid()), ("loop", self._loop)):
            for what, value in _figures(pid).items():
                self._series.setdefault((name, what), ResourceSeries()).values.append(value)

    def figures(self) -> list[Resource]:
        """Every figure, in the first, the second and the last third of the run."""
        return [
            Resource(process, what, UNITS[what], *series.thirds(), flat=_flat(what, series))
            for (process, what), series in self._series.items()
        ]

    def deadlines(self, period_ns: float) -> Deadlines:
        """Missed deadlines, and how many of them the loop's own code may have cost."""
        usual_us = self._cpu.percentile_us(USUAL_PERCENT)
        usual_wait_us = self._workers.percentile_us(USUAL_PERCENT)
        lost, own, behind, away = 0, 0, 0, 0
        for step in self._lost:
            lost += step.misses
            enough_ns = OWN_SHARE * period_ns * step.misses
            if step.own_ns - usual_us * 1e3 * step.cycles > enough_ns:
                own += step.misses
            elif step.stolen_ns > 0 or step.waited_ns > enough_ns:
                away += step.misses
            elif step.workers_waited_ns - usual_wait_us * 1e3 * step.cycles > enough_ns:
                behind += step.misses
        return Deadlines(lost, own, away, behind, usual_us)

    def checks(self, period_ns: float, *, judged: bool = True, stopped: bool = False) -> list[Check]:
        """Requirements.

        Args:
            period_ns: period of the loop, ns.
            judged: judge missed deadlines; not on a PC that runs other programs, too.
            stopped: a signal ended the run; then files and threads, too, need the time that memory needs.
        """
        out = []
        for what in UNITS:
            mine = [r for r in self.figures() if r.what == what]
            text = "; ".join(f"{r.process} {r.middle:.4g} then {r.last:.4g} {r.unit}".strip() for r in mine)
            long_enough = not (stopped or what == "memory") or self._cycles * period_ns >= LEAST_S * 1e9
            why_not = f"the loop's cycles are less than {LEAST_S:.0f} s"
            flat = long_enough and all(r.flat for r in mine)
            out.append(Check(f"{what} flat", flat, text, judged=long_enough, why_not=why_not))
        return [*out, self._deadline_check(period_ns, judged)]

    def _deadline_check(self, period_ns: float, judged: bool) -> Check:
        lost, cycles = self.deadlines(period_ns), int(self._cycles)
        ours = lost.own + lost.behind_worker
        text = (
            f"{lost.lost} lost: in {lost.own} the loop itself used more processor time than usual, in "
            f"{lost.behind_worker} one of its own threads was kept off the processor; allowed 1 in "
            f"{1.0 / ALLOWED_SHARE:.0f} of {cycles} cycles"
        )
        return Check("no deadline lost to our own code", ours <= ALLOWED_SHARE * cycles, text, judged)

    def _look_at_time(self, status: Status) -> None:
        """Record the processor time of the loop's thread since the last look, and its wait for a processor."""
        if self._loop is None:
            return
        try:
            threads = {int(t.name): _times(t) for t in (PROC / str(self._loop) / "task").iterdir()}
        except (OSError, ValueError):  # the process is just ending
            return
        cpu_ns, waited_ns = threads.pop(self._loop, (0, 0))
        workers_ns = sum(waited for _, waited in threads.values())
        now = (status.cycles, status.misses, cpu_ns, waited_ns, workers_ns, _stolen_ns())
        if self._before is None:
            self._before = now
        if now[0] == self._before[0]:
            return
        step = TimeStretch(*(new - old for new, old in zip(now, self._before, strict=True)))
        self._before = now
        self._cycles += step.cycles
        self._cpu.add(step.cpu_ns // step.cycles)
        self._workers.add(step.workers_waited_ns // step.cycles)
        if step.misses:
            self._lost.append(step)


def _stolen_ns() -> int:
    """Time, ns, that the host took from this PC since its start, of all processors; 0 where that is unknown."""
    words = (PROC / "stat").read_text().split(maxsplit=9)
    return int(words[8]) * 1_000_000_000 // os.sysconf("SC_CLK_TCK")


def _times(thread: Path) -> tuple[int, int]:
    """Times on a processor, and ready but without one, ns."""
    cpu_ns, waited_ns, _ = (thread / "schedstat").read_text().split()
    return int(cpu_ns), int(waited_ns)


def _figures(pid: int | None) -> dict[str, float]:
    """Figures of one process; empty where it has ended."""
    if pid is None:
        return {}
    folder = PROC / str(pid)
    try:
        lines = (folder / "status").read_text().splitlines()
        files = sum(1 for _ in (folder / "fd").iterdir())
    except OSError:
        return {}
    words = {name: value.split()[0] for name, _, value in (line.partition(":") for line in lines) if value.split()}
    return {"memory": int(words["RssAnon"]) / 1024.0, "files": files, "threads": int(words["Threads"])}


def _flat(what: str, series: ResourceSeries) -> bool:
    """Is it no larger in the last third than in the second?"""
    _, middle, last = series.thirds()
    return last <= middle + (MEMORY_SLACK if what == "memory" else 0.0)


LENGTH_S: dict[Bus, tuple[float, float]] = {"box": (0.3, 4.0), "modbus": (1.0, 10.0), "can": (1.0, 10.0)}
PAUSE_S: dict[Bus, tuple[float, float]] = {"box": (4.0, 12.0), "modbus": (3.0, 12.0), "can": (3.0, 12.0)}
FIRST_S = 4.0


def draw_faults(buses: Sequence[Bus], duration_s: float, seed: int) -> list[FaultOrder]:
    """Random faults: one at a time on each bus, on different buses also at the same time.

    The first fault of each bus is its cable: then everything that a reconnection needs once (a thread, a file) exists
    before threads and files are counted. All others follow in random order, then all again in another order.
    """
    chance = random.Random(seed)  # noqa: S311 - random numbers of a test
    out = []
    for bus in sorted(set(buses)):
        names = [name for name, fault in FAULTS.items() if fault.bus == bus]
        at_s, bag = FIRST_S + chance.random(), [f"{bus}-unplugged"]
        while True:
            length_s = round(chance.uniform(*LENGTH_S[bus]), 2)
            if at_s + length_s + RECOVER_S > duration_s:
                break
            out.append(FaultOrder(bag.pop(), round(at_s, 2), length_s))
            at_s += length_s + chance.uniform(*PAUSE_S[bus])
            bag = bag or chance.sample(names, len(names))
    return sorted(out, key=lambda f: f.at_s)


def soak(order: SoakOrder, tell: Tell) -> SoakResult:
    """Run with correction for the ordered time, and judge."""
    wiring = read_wiring(order.config, order.gateware)
    duration_s = order.minutes * 60.0
    faults = draw_faults(list(wiring.buses.values()), duration_s, order.seed)
    every_ms = every_ms_of(duration_s)
    with ends_politely(), tempfile.TemporaryDirectory(prefix="rtec-hil-", ignore_cleanup_errors=True) as name:
        resources = Resources()
        run = run_on_buses(wiring, Path(name), "on", duration_s, faults, every_ms, tell, order.keep, resources.look)
        summary = run.report.summary
        cycle_ns = 1e9 / run.setup.file.run.rate_hz
        return SoakResult(
            machine=run.setup.machine.name,
            rate_hz=run.setup.file.run.rate_hz,
            duration_s=run.duration_s,
            ordered_s=duration_s,
            seed=order.seed,
            faults=_counted(faults, run),
            resources=resources.figures(),
            deadlines=resources.deadlines(cycle_ns),
            timing={k: summary[k] for k in ("cycles", "deadline_misses", "wake_up", "compute", "driver_errors")},
            checks=[
                *_checks(run, faults, not order.shared),
                *resources.checks(cycle_ns, judged=not order.shared, stopped=run.report.interrupted),
            ],
            warnings=list(dict.fromkeys(run.warnings)),
            log=run.log if order.keep else None,
            stopped=run.report.interrupted,
        )


def _counted(faults: Sequence[FaultOrder], run: BusRun) -> list[SoakFault]:
    """Number of times of each fault, how often the daemon reported it, and its longest time to a report.

    Faults that a stopped run did not reach are not counted.
    """
    times = Counter(f.name for f in faults if f.at_s < run.duration_s)
    soon: dict[str, list[float]] = {name: [] for name in times}
    for fault, reported in zip(faults, run.watch.reports, strict=True):
        if fault.at_s < run.duration_s and np.isfinite(reported.noticed_s):
            soon[fault.name].append(reported.noticed_s)
    return [SoakFault(n, times[n], len(soon[n]), max(soon[n], default=float("nan"))) for n in sorted(times)]


def _checks(run: BusRun, faults: Sequence[FaultOrder], judged: bool) -> list[Check]:
    at_end, stopped = bool(run.logbook.held[-1]), run.report.interrupted
    follows = "held" if at_end else "it follows the model"
    why_not = {"why_not": "the run was stopped"} if stopped else {}
    return [
        *checks_of("soak", run, (), judged),
        held_check("soak", run, faults, judged),
        Check("soak: correction follows at the end", not at_end, follows, judged and not stopped, **why_not),
    ]
