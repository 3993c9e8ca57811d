"""Hardware in the loop: the interface of a bench, and its results. The bench itself comes by entry point.

A bench puts a simulated machine behind real buses and runs the daemon against it. It is loaded from the entry point
group `rtec.hil` as drivers are, so this package depends on no bus.

The results are plain data, for reports and programs.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel

from rtec.arrays import Floats
from rtec.errors import ConfigError, DriverUnavailable
from rtec.tomlfile import nearest

WITHIN = 0.10
"""Share of the all-simulated run's improvement that real buses may cost."""
LEAST_COMPARED_S = 5.0
"""Shortest time, s, that both runs must have in common for a judgement of the improvement."""


@dataclass(frozen=True)
class Accuracy:
    """Tool-tip error, actual minus commanded, in the directions that are compensated.

    Attributes:
        rms_um, largest_um: of the error vector, all those directions together.
        axis_rms_um: by direction.
    """

    rms_um: float
    largest_um: float
    axis_rms_um: Mapping[str, float]


@dataclass(frozen=True)
class OffAndOn:
    """Accuracy of one kind of run, uncorrected and corrected.

    Attributes:
        off, on: accuracy.
    """

    off: Accuracy
    on: Accuracy

    @property
    def factor(self) -> float:
        """How many times smaller the error is with correction; NaN where either is unknown."""
        return float("inf") if self.on.rms_um == 0.0 else self.off.rms_um / self.on.rms_um


@dataclass(frozen=True)
class FaultFound:
    """Effect of a fault.

    Attributes:
        order: the fault and its time.
        what: description.
        told: by device, the daemon's last message on it.
        noticed_s: from its beginning until the daemon reported it; NaN where it never did.
        held_s: time for which the correction was held, until the next fault began; overlapping faults share it.
        recovered_s: from its end until the correction followed again; NaN where it did not within the run.
        largest_um: largest tip error, all directions together, from its beginning until then.
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
    """A requirement.

    Attributes:
        name: the requirement.
        passed: is it met?
        found: the result in words and figures.
        judged: does it decide whether the run passed? No, where it depends on the clock of a PC that others use, too,
            or where the run does not show it.
        why_not: reason that it is not judged.
    """

    name: str
    passed: bool
    found: str
    judged: bool = True
    why_not: str = "this PC is shared"

    @property
    def good(self) -> bool:
        """Is it met, or not judged?"""
        return self.passed or not self.judged

    @property
    def words(self) -> str:
        """The result, and whether it counts."""
        return self.found if self.judged else f"not judged, as {self.why_not}: {self.found}"


def tally(checks: "Sequence[Check]") -> str:
    """How many of the judged checks passed, and how many were not judged."""
    judged = [c for c in checks if c.judged]
    without = len(checks) - len(judged)
    return f"{sum(c.passed for c in judged)} of {len(judged)}" + (f", {without} not judged" if without else "")


@dataclass(frozen=True)
class Course:
    """The tip error over time, (n, directions), µm; for the figure.

    Attributes:
        directions: names of the columns.
        time_s: (n,).
        off_um, on_um: errors behind real buses.
    """

    directions: tuple[str, ...]
    time_s: Floats
    off_um: Floats
    on_um: Floats


@dataclass(frozen=True)
class HilResult:
    """Result of a bench.

    Attributes:
        machine: name of the machine.
        rate_hz: rate of the loop.
        off_s, on_s: durations.
        wiring: by device of the run file, the bus that it is behind.
        buses, simulated: accuracy behind real buses, and of the all-simulated run of the same machine and program, all
            over the same times since the start of the program.
        compared_s: sum of those times.
        off_timing, on_timing: the daemon's own figures.
        faults: effect of each fault.
        checks: the requirements.
        warnings: what the system refused.
        course: tip error over time, for the figure.
        log: log of the corrected run, where it is kept.
        stopped: did a signal end the corrected run?
    """

    machine: str
    rate_hz: float
    off_s: float
    on_s: float
    wiring: Mapping[str, str]
    buses: OffAndOn
    simulated: OffAndOn
    compared_s: float
    off_timing: Mapping[str, Any]
    on_timing: Mapping[str, Any]
    faults: Sequence[FaultFound]
    checks: Sequence[Check]
    warnings: Sequence[str]
    course: Course
    log: Path | None = field(default=None)
    stopped: bool = False

    @property
    def comparable(self) -> bool:
        """Do the runs have enough time in common to compare them?"""
        return self.compared_s >= LEAST_COMPARED_S

    @property
    def passed(self) -> bool:
        """Are all requirements met?"""
        return all(c.good for c in self.checks)


@dataclass(frozen=True)
class SoakFault:
    """One kind of fault in a long run: its number, how often the daemon reported it, its longest delay, s."""

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
    """Missed deadlines.

    Attributes:
        lost: number of all.
        own: missed while the loop used clearly more processor time than usual: its own code may be the cause.
        taken_away: missed while another process had its processor, or the host took it away, as far as the host reports
            it.
        behind_worker: missed while the loop waited, with a free processor, and another thread of its process had none:
            that thread may have held the interpreter's lock.
        usual_cpu_us: processor time of a cycle, µs; 19 in 20 stretches of 20 ms need no more.
    """

    lost: int
    own: int
    taken_away: int
    behind_worker: int
    usual_cpu_us: float


@dataclass(frozen=True)
class SoakResult:
    """Result of a long run.

    Attributes:
        machine: name of the machine.
        rate_hz: rate of the loop.
        duration_s, ordered_s: duration, and the ordered one, s.
        seed: seed of the faults.
        faults: by kind.
        resources: memory, files, threads.
        deadlines: missed deadlines.
        timing: the daemon's own figures.
        checks: the requirements.
        warnings: what the system refused.
        log: path of the log.
        stopped: did a signal end the run?
    """

    machine: str
    rate_hz: float
    duration_s: float
    ordered_s: float
    seed: int
    faults: Sequence[SoakFault]
    resources: Sequence[Resource]
    deadlines: Deadlines
    timing: Mapping[str, Any]
    checks: Sequence[Check]
    warnings: Sequence[str]
    log: Path | None = None
    stopped: bool = False

    @property
    def passed(self) -> bool:
        """Are all requirements met?"""
        return all(c.good for c in self.checks)


GROUP = "rtec.hil"
FAULT = re.compile(r"(?P<name>[a-z][a-z0-9-]*)@(?P<at>\d+(?:\.\d+)?)s(?:\+(?P<length>\d+(?:\.\d+)?)s)?")
LENGTH_S = 5.0
"""Duration, s, of a fault that is ordered without one."""

Tell = Callable[[str, int, int], None]
"""Called with a description of the present work, the amount done, and the total."""


@dataclass(frozen=True)
class FaultOrder:
    """An ordered fault.

    Attributes:
        name: the bench's name of it.
        at_s: its beginning, s after the corrected run began.
        length_s: its duration, s.
    """

    name: str
    at_s: float
    length_s: float = LENGTH_S

    @property
    def end_s(self) -> float:
        """Its end, s after the corrected run began."""
        return self.at_s + self.length_s


@dataclass(frozen=True)
class HilOrder:
    """An order for a bench.

    Attributes:
        config: run file with a section `[hil]`.
        off_s, on_s: duration without and with correction; not given: as in the run file.
        faults: faults during the corrected run.
        keep: folder in which the log of the corrected run is kept.
        shared: others use this PC's processors, too: results that depend on its clock are reported, not judged.
        gateware: a library of simulated gateware (`make -C drivers/box sim`), which replaces the box in software.
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
    """An order for a long run with random faults.

    Attributes:
        config: run file with a section `[hil]`.
        minutes: duration.
        seed: the same seed gives the same faults.
        keep: folder in which the log is kept.
        shared, gateware: as for `HilOrder`.
    """

    config: Path
    minutes: float = 30.0
    seed: int = 1
    keep: Path | None = None
    shared: bool = False
    gateware: Path | None = None


class Bench(Protocol):
    """A simulated machine behind real buses.

    Attributes:
        options_model: the keys of `[hil]` in a run file.
    """

    options_model: type[BaseModel]

    def faults(self) -> Mapping[str, str]:
        """All faults that it can cause: name, and description."""
        ...

    def run(self, order: HilOrder, tell: Tell) -> HilResult:
        """Run the daemon against it.

        Raises:
            ConfigError: the run file has no section `[hil]`, or names a device that cannot be simulated here.
            KeyboardInterrupt: a signal ended it before the corrected run; its processes and files are gone.
        """
        ...

    def soak(self, order: SoakOrder, tell: Tell) -> SoakResult:
        """Run the daemon against it for a long time, with random faults.

        Raises:
            ConfigError, KeyboardInterrupt: as `run`; a run that a signal ended within its first second has no result.
        """
        ...


def load_bench() -> Bench:
    """The installed bench.

    Raises:
        DriverUnavailable: there is none, or it cannot be imported.
    """
    benches = sorted(entry_points(group=GROUP), key=lambda e: e.name)
    if not benches:
        raise DriverUnavailable("no bench is installed: rtec's own comes with its drivers (pip install rtec)")
    try:
        bench: Bench = benches[0].load()()
    except ImportError as e:
        raise DriverUnavailable(f"the bench {benches[0].value!r} cannot be imported: {e}") from e
    return bench


def parse_fault(text: str, known: Mapping[str, str]) -> FaultOrder:
    """Read `name@30s` or `name@30s+10s`.

    Raises:
        ConfigError: the text is neither, or the fault does not exist.
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
