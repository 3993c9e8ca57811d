"""Result of one run of the daemon behind real buses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtec.daemon.status import Report
from rtec.loop.run_file import Setup
from rtec_drivers.hil.logbook import Logbook
from rtec_drivers.hil.track import TipTrack
from rtec_drivers.hil.watch import FaultWatch


@dataclass(frozen=True)
class BusRun:
    """Result of one run of the daemon behind real buses.

    Attributes:
        setup: its run file.
        report: the daemon's report.
        start_ns: start of the machine.
        track: positions of the tool tip.
        logbook: summary of the log.
        log: path of the log.
        far_counts: counts of the far sides.
        watch: the daemon's messages.
        warnings: what the system refused.
    """

    setup: Setup
    report: Report
    start_ns: int
    track: TipTrack
    logbook: Logbook
    log: Path
    far_counts: Mapping[str, Mapping[str, Any]]
    watch: FaultWatch
    warnings: Sequence[str]
