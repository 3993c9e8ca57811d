"""What a bench found: plain data, for reports and programs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from rtec.hil import FaultOrder

WITHIN = 0.10
"""Real buses may cost this share of the improvement that the all-simulated run has."""

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Accuracy:
    """Tool-tip error, actual minus commanded, in the directions that are compensated.

    Attributes:
        rms_um, largest_um: of all those directions together; `largest_um` of the worst one.
        axis_rms_um: by direction.
    """

    rms_um: float
    largest_um: float
    axis_rms_um: Mapping[str, float]


@dataclass(frozen=True)
class Comparison:
    """One way of running the machine, uncorrected and corrected.

    Attributes:
        off, on: accuracy.
    """

    off: Accuracy
    on: Accuracy

    @property
    def factor(self) -> float:
        """How many times smaller the error is with correction."""
        return self.off.rms_um / self.on.rms_um if self.on.rms_um > 0.0 else float("inf")


@dataclass(frozen=True)
class FaultFound:
    """What a fault did.

    Attributes:
        order: which and when.
        what: it, in words.
        told: by device, the last that the daemon said of it.
        noticed_s: from its beginning until the daemon said so; NaN where it never did.
        held_s: so long the correction was held, until the next fault began; faults that overlap share that.
        recovered_s: from its end until the correction followed again; NaN where it did not within the run.
        largest_um: largest tip error from its beginning until then.
        oldest_s: by sensor, its oldest reading meanwhile.
    """

    order: "FaultOrder"
    what: str
    told: Mapping[str, str]
    noticed_s: float
    held_s: float
    recovered_s: float
    largest_um: float
    oldest_s: Mapping[str, float]


@dataclass(frozen=True)
class Check:
    """Something that must be so."""

    name: str
    passed: bool
    found: str


@dataclass(frozen=True)
class Course:
    """The tip error over time, (n, directions), µm; for the figure.

    Attributes:
        directions: names of the columns.
        time_s: (n,).
        off_um, on_um: behind real buses.
    """

    directions: tuple[str, ...]
    time_s: Floats
    off_um: Floats
    on_um: Floats


@dataclass(frozen=True)
class HilResult:
    """What a bench found.

    Attributes:
        machine: its name.
        rate_hz: of the loop.
        off_s, on_s: how long it ran.
        wiring: by device of the run file, the bus that it was put behind.
        buses, simulated: accuracy behind real buses, and of the all-simulated run of the same machine and programme.
        off_timing, on_timing: the daemon's own figures.
        faults: what each did.
        checks: what must be so.
        warnings: what the system did not grant.
        course: for the figure.
        log: of the corrected run, where it is kept.
    """

    machine: str
    rate_hz: float
    off_s: float
    on_s: float
    wiring: Mapping[str, str]
    buses: Comparison
    simulated: Comparison
    off_timing: Mapping[str, Any]
    on_timing: Mapping[str, Any]
    faults: Sequence[FaultFound]
    checks: Sequence[Check]
    warnings: Sequence[str]
    course: Course
    log: Path | None = field(default=None)

    @property
    def passed(self) -> bool:
        """Whether all that must be so is."""
        return all(c.passed for c in self.checks)


@dataclass(frozen=True)
class SoakFault:
    """One kind of fault in a long run: how often it came, how often the daemon said so, how soon at the latest, s."""

    name: str
    times: int
    told: int
    latest_s: float


@dataclass(frozen=True)
class Resource:
    """Memory, files or threads of one process: the largest in each third of the run, and whether it stopped growing."""

    process: str
    what: str
    unit: str
    first: float
    middle: float
    last: float
    flat: bool


@dataclass(frozen=True)
class Deadlines:
    """Deadlines that were lost.

    Attributes:
        lost: all of them.
        own: while the loop used clearly more processor time than usual: our own code may be the cause.
        taken_away: while another process had its processor, or the host took it away, as far as the host tells.
        behind_worker: the loop waited, with a processor at hand, while another thread of its process had none: that one
            may have held the interpreter.
        usual_cpu_us: processor time of a cycle; 19 in 20 stretches of 20 ms need no more.
    """

    lost: int
    own: int
    taken_away: int
    behind_worker: int
    usual_cpu_us: float


@dataclass(frozen=True)
class SoakResult:
    """What a long run found.

    Attributes:
        machine: its name.
        rate_hz: of the loop.
        duration_s: how long it ran.
        seed: of the faults.
        faults: by kind.
        resources: memory, files, threads.
        deadlines: lost ones.
        timing: the daemon's own figures.
        checks: what must be so.
        warnings: what the system did not grant.
        log: where it is kept.
    """

    machine: str
    rate_hz: float
    duration_s: float
    seed: int
    faults: Sequence[SoakFault]
    resources: Sequence[Resource]
    deadlines: Deadlines
    timing: Mapping[str, Any]
    checks: Sequence[Check]
    warnings: Sequence[str]
    log: Path | None = None

    @property
    def passed(self) -> bool:
        """Whether all that must be so is."""
        return all(c.passed for c in self.checks)
