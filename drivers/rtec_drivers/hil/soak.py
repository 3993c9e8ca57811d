"""The long run: the whole bench with random faults, to show what only shows with time."""

import random
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtec.hil import Check, FaultOrder, SoakFault, SoakOrder, SoakResult, Tell
from rtec_drivers.hil.bus_run import BusRun
from rtec_drivers.hil.catalogue import FAULTS, Bus
from rtec_drivers.hil.daemon import ends_politely, every_ms_of, run_on_buses
from rtec_drivers.hil.findings import checks_of, held_check
from rtec_drivers.hil.resources import Resources
from rtec_drivers.hil.wiring import read_wiring

RECOVER_S = 8.0
"""The run goes on for this time, s, after the last fault."""
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
            duration_s=summary["cycles"] / run.setup.file.run.rate_hz,
            seed=order.seed,
            faults=_counted(faults, run),
            resources=resources.figures(),
            deadlines=resources.deadlines(cycle_ns),
            timing={k: summary[k] for k in ("cycles", "deadline_misses", "wake_up", "compute", "driver_errors")},
            checks=[*_checks(run, faults, not order.shared), *resources.checks(cycle_ns, judged=not order.shared)],
            warnings=list(dict.fromkeys(run.warnings)),
            log=run.log if order.keep else None,
        )


def _counted(faults: Sequence[FaultOrder], run: BusRun) -> list[SoakFault]:
    """Number of times of each fault, how often the daemon reported it, and its longest time to a report."""
    times = Counter(f.name for f in faults)
    soon: dict[str, list[float]] = {name: [] for name in times}
    for fault, reported in zip(faults, run.watch.reports, strict=True):
        if np.isfinite(reported.noticed_s):
            soon[fault.name].append(reported.noticed_s)
    return [SoakFault(n, times[n], len(soon[n]), max(soon[n], default=float("nan"))) for n in sorted(times)]


def _checks(run: BusRun, faults: Sequence[FaultOrder], judged: bool) -> list[Check]:
    at_end = bool(run.logbook.held[-1])
    return [
        *checks_of("soak", run, (), judged),
        held_check("soak", run, faults, judged),
        Check("soak: correction follows at the end", not at_end, "held" if at_end else "it follows the model", judged),
    ]
