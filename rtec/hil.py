"""Hardware in the loop: what is asked of a bench. The bench itself comes by entry point.

A bench puts a simulated machine behind real buses and runs the daemon against it. It is loaded from the entry point
group `rtec.hil` as drivers are, so that this package knows no bus.

What a bench found: plain data, for reports and programs.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError, DriverUnavailable
from rtec.tomlfile import nearest

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
class OffAndOn:
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
    """Something that must be so.

    Attributes:
        name: what must be so.
        passed: whether it is.
        found: in words and figures.
        judged: it decides whether the run passed; not so where it depends on the clock of a PC that others use, too.
    """

    name: str
    passed: bool
    found: str
    judged: bool = True

    @property
    def good(self) -> bool:
        """Is it so, or not judged?"""
        return self.passed or not self.judged

    @property
    def words(self) -> str:
        """What was found, and whether it counts."""
        return self.found if self.judged else f"not judged, as this PC is shared: {self.found}"


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
    buses: OffAndOn
    simulated: OffAndOn
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
        return all(c.good for c in self.checks)


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
        return all(c.good for c in self.checks)


GROUP = "rtec.hil"
FAULT = re.compile(r"(?P<name>[a-z][a-z0-9-]*)@(?P<at>\d+(?:\.\d+)?)s(?:\+(?P<length>\d+(?:\.\d+)?)s)?")
LENGTH_S = 5.0
"""A fault without a duration lasts so long."""

Tell = Callable[[str, int, int], None]
"""Is told what is being done, how much of it is done, of how much."""


@dataclass(frozen=True)
class FaultOrder:
    """A fault that is ordered.

    Attributes:
        name: as the bench calls it.
        at_s: when it begins, s after the corrected run began.
        length_s: how long it lasts.
    """

    name: str
    at_s: float
    length_s: float = LENGTH_S

    @property
    def end_s(self) -> float:
        """When it is over, s after the corrected run began."""
        return self.at_s + self.length_s


@dataclass(frozen=True)
class HilOrder:
    """What a bench is to do.

    Attributes:
        config: run file with a section `[hil]`.
        off_s, on_s: how long without and with correction; the run file says where not given.
        faults: to inject while corrected.
        keep: the log of the corrected run is kept in this folder.
        shared: others use this PC's processors, too: what depends on its clock is reported, not judged.
        gateware: a library of simulated gateware (`make -C drivers/box sim`), in the place of the box in software.
    """

    config: Path
    off_s: float | None = None
    on_s: float | None = None
    faults: Sequence[FaultOrder] = ()
    keep: Path | None = None
    shared: bool = False
    gateware: Path | None = None


@dataclass(frozen=True)
class SoakOrder:
    """A long run with faults by chance.

    Attributes:
        config: run file with a section `[hil]`.
        minutes: how long.
        seed: the same seed draws the same faults.
        keep: the log is kept in this folder.
        shared, gateware: as for `HilOrder`.
    """

    config: Path
    minutes: float = 30.0
    seed: int = 1
    keep: Path | None = None
    shared: bool = False
    gateware: Path | None = None


class Bench(Protocol):
    """Puts a simulated machine behind real buses."""

    def faults(self) -> Mapping[str, str]:
        """All faults that it can make happen: name, and what it is."""
        ...

    def run(self, order: HilOrder, tell: Tell) -> HilResult:
        """Run the daemon against it.

        Raises:
            ConfigError: the run file has no section `[hil]`, or names a device that has no far side here.
            KeyboardInterrupt: somebody ended it; nothing is left behind.
        """
        ...

    def soak(self, order: SoakOrder, tell: Tell) -> SoakResult:
        """Run the daemon against it for long, with faults by chance.

        Raises:
            ConfigError, KeyboardInterrupt: as `run`.
        """
        ...


def load_bench() -> Bench:
    """Give the bench that is installed.

    Raises:
        DriverUnavailable: none is, or it cannot be imported.
    """
    found = sorted(entry_points(group=GROUP), key=lambda e: e.name)
    if not found:
        raise DriverUnavailable("no bench is installed: rtec's own comes with its drivers (pip install rtec)")
    try:
        bench: Bench = found[0].load()()
    except ImportError as e:
        raise DriverUnavailable(f"the bench {found[0].value!r} cannot be imported: {e}") from e
    return bench


def parse_fault(text: str, known: Mapping[str, str]) -> FaultOrder:
    """Read `name@30s` or `name@30s+10s`.

    Raises:
        ConfigError: it is neither, or there is no such fault.
    """
    match = FAULT.fullmatch(text.strip())
    if match is None:
        raise ConfigError(
            f"--fault {text!r} cannot be read; write NAME@30s (for {LENGTH_S:g} s) or NAME@30s+10s; "
            "--fault list names them all"
        )
    name = match["name"]
    if name not in known:
        raise ConfigError(f"--fault: no fault {name!r}{nearest(name, known)}; --fault list tells what each is")
    length_s = float(match["length"]) if match["length"] else LENGTH_S
    return FaultOrder(name, float(match["at"]), length_s)
