"""Hardware in the loop: what is asked of a bench. The bench itself comes by entry point.

A bench puts a simulated machine behind real buses and runs the daemon against it. It is loaded from the entry point
group `rtec.hil` as drivers are, so that this package knows no bus.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

from rtec.errors import ConfigError, DriverUnavailable
from rtec.hil_result import HilResult, SoakResult
from rtec.tomlfile import nearest

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
    """

    config: Path
    off_s: float | None = None
    on_s: float | None = None
    faults: Sequence[FaultOrder] = ()
    keep: Path | None = None


@dataclass(frozen=True)
class SoakOrder:
    """A long run with faults by chance.

    Attributes:
        config: run file with a section `[hil]`.
        minutes: how long.
        seed: the same seed draws the same faults.
        keep: the log is kept in this folder.
        shared: others use this PC's processors, too, as on a virtual one: lost deadlines are told, not judged.
    """

    config: Path
    minutes: float = 30.0
    seed: int = 1
    keep: Path | None = None
    shared: bool = False


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
