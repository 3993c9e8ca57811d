"""One run of the daemon behind real buses, as it was found afterwards."""

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
    """One run of the daemon behind real buses.

    Attributes:
        setup: its run file.
        report: the daemon's own.
        start_ns: when the machine began to live.
        track: what the tip did.
        logbook: what the log says.
        log: the log.
        found: what the far sides counted.
        watch: what the daemon said.
        warnings: what the system did not grant.
    """

    setup: Setup
    report: Report
    start_ns: int
    track: TipTrack
    logbook: Logbook
    log: Path
    found: Mapping[str, Mapping[str, Any]]
    watch: FaultWatch
    warnings: Sequence[str]
