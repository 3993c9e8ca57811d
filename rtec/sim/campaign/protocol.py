"""The day of a measurement: the order of its phases, and the state at every instant.

The warm-up is that of [G 3.1]: five cycles cold; then the machine warms up, first switched on, then with moving slides,
with five cycles after every step, over about eight hours. The drift test is that of [G 3.5]: constant speed, a reading
every ten minutes, then off overnight; more speeds follow.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rtec.errors import ConfigError
from rtec.machine import Machine
from rtec.metrology.instruments.base import Instrument
from rtec.sim.campaign.cycle import MOST_ROWS, Cycle
from rtec.sim.campaign.settings import DayPhase, Settings, Targets

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
GRID_S = 30.0
"""Largest time between two computed temperatures."""
LOAD_MM_S = 100.0
DRIFT_EVERY_S = 600.0


def phases_of(settings: Settings, instrument: Instrument) -> tuple[DayPhase, ...]:
    """Phases of the day: the user's own, or those of the protocol, or the usual ones of the instrument."""
    if settings.phase:
        return settings.phase
    usual = USUAL.get(instrument.name, "warm_up")
    return PRESETS[settings.protocol or usual](settings.cycles)


def _warm_up(cycles: int) -> tuple[DayPhase, ...]:
    def then(*steps: DayPhase) -> list[DayPhase]:
        return [p for b in steps for p in (b, DayPhase(name=f"measure after {b.name}", cycles=cycles))]

    return (
        DayPhase(name="measure cold", cycles=cycles),
        *then(
            DayPhase(name="idle 1", hours=1.0),
            DayPhase(name="move 1", hours=0.25, moving=0.8),
            DayPhase(name="move 2", hours=0.5, moving=0.8),
            DayPhase(name="spindle 1", hours=0.75, rpm=1500.0),
            DayPhase(name="move 3", hours=1.0, moving=0.8, rpm=2500.0),
            DayPhase(name="idle 2", hours=1.0),
            DayPhase(name="move 4", hours=1.5, moving=0.5, rpm=3000.0),
            DayPhase(name="off", hours=1.5, on=False),
        ),
    )


def _cold(cycles: int) -> tuple[DayPhase, ...]:
    return (DayPhase(name="measure cold", cycles=cycles),)


def _drift(cycles: int) -> tuple[DayPhase, ...]:
    del cycles
    out = [DayPhase(name="cold", hours=0.5, on=False, read_every_s=DRIFT_EVERY_S)]
    for rpm in (1000.0, 2000.0, 3000.0):
        out.append(DayPhase(name=f"{rpm:.0f} 1/min", hours=8.0, rpm=rpm, read_every_s=DRIFT_EVERY_S))
        out.append(DayPhase(name=f"off after {rpm:.0f} 1/min", hours=15.5, on=False, read_every_s=DRIFT_EVERY_S))
    return tuple(out)


def _parts(cycles: int) -> tuple[DayPhase, ...]:
    out = []
    for i in range(3 * cycles):
        out.append(DayPhase(name=f"part {i + 1}", cycles=1))
        out.append(DayPhase(name=f"cutting {i + 1}", hours=0.5, moving=0.5, rpm=(2500.0, 1200.0, 0.0)[i // 5 % 3]))
    return tuple(out)


USUAL = {"spindle_drift": "drift", "work_piece": "parts", "ball_bar": "cold", "grid_encoder": "cold"}
"""Protocol of an instrument, where it is not the warm-up."""
PRESETS = {"warm_up": _warm_up, "cold": _cold, "drift": _drift, "parts": _parts}


@dataclass(frozen=True)
class Timeline:
    """Every computed instant, in order of time.

    Attributes:
        time_s, rpm: (n,).
        on: (n,), 0 or 1; as `load` and `rpm` it holds until the next instant.
        load: mean speed of each axis over 100 mm/s, (n, axes).
        pose_mm, direction: (n, axes).
        travelling: index of the axis that travels, -1 for none, (n,).
        run: (n,); 0 where no row is written.
        read: whether there is a reading, (n,).
        phase: index of the phase, (n,).
        phases: names.
        more: other channels by name, (n,); see `Cycle.more`.
    """

    time_s: Floats
    on: Floats
    rpm: Floats
    load: Floats
    pose_mm: Floats
    direction: Floats
    travelling: Ints
    run: Ints
    read: NDArray[np.bool_]
    phase: Ints
    phases: tuple[str, ...]
    more: Mapping[str, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_s)


def make_timeline(machine: Machine, settings: Settings, phases: tuple[DayPhase, ...], cycle: Cycle) -> Timeline:
    """Join the phases.

    Raises:
        ConfigError: there is no reading in any of them, or far too many.
    """
    rows = sum(p.cycles * len(cycle.after_s) + p.hours * 3600.0 / _least_s(p, settings) for p in phases)
    if rows > MOST_ROWS:
        raise ConfigError(f"[[phase]] the day has {rows:.3g} rows; at most {MOST_ROWS} are made")
    book = _Book(machine, settings, cycle)
    for i, phase in enumerate(phases):
        if phase.cycles:
            book.measure(i, phase)
        else:
            book.wait(i, phase)
    if not book.reads:
        raise ConfigError("[[phase]] nothing is read: no phase has cycles or read_every_s")
    return book.close(tuple(p.name for p in phases))


def _least_s(phase: DayPhase, settings: Settings) -> float:
    return min(GRID_S, phase.read_every_s or settings.log_every_s or GRID_S)


class _Book:
    """Collects the instants of the day, phase by phase."""

    def __init__(self, machine: Machine, settings: Settings, cycle: Cycle) -> None:
        self._axes, self._cycle, self._log_every_s = len(machine.axes), cycle, settings.log_every_s
        self._targets: Targets = settings.targets
        self._pieces: list[Mapping[str, NDArray[np.generic]]] = []
        self._time_s, self._run, self.reads = 0.0, 0, 0

    def measure(self, index: int, phase: DayPhase) -> None:
        cycle = self._cycle
        load = cycle.path_mm / cycle.seconds / LOAD_MM_S
        for _ in range(phase.cycles):
            self._add(index, phase, np.array([0.0]), load, run=0, read=False)
            part = np.zeros(len(cycle.after_s), dtype=np.int64) if cycle.part is None else cycle.part
            self._add(index, phase, cycle.after_s, load, run=self._run + 1 + part, read=True, cycle=cycle)
            self._run += 1 + int(part.max())
            self._time_s += cycle.seconds

    def wait(self, index: int, phase: DayPhase) -> None:
        seconds = phase.hours * 3600.0
        feed_mm_s = self._targets.feed_mm_min / 60.0
        moves = np.zeros(self._axes)
        moves[sorted({int(k) for k in self._cycle.travelling if k >= 0})] = 1.0
        load = moves * phase.moving * feed_mm_s / LOAD_MM_S
        every = phase.read_every_s or self._log_every_s
        after = np.arange(0.0, seconds, GRID_S)
        if every is None:
            self._add(index, phase, after, load, run=0, read=False)
        else:
            self._run += 1
            written = np.arange(every, seconds + 1e-6, every)
            fill = np.setdiff1d(after, written)
            self._add(index, phase, fill, load, run=0, read=False)
            self._add(index, phase, written, load, run=self._run, read=phase.read_every_s is not None)
        self._time_s += seconds

    def _add(
        self,
        index: int,
        phase: DayPhase,
        after_s: Floats,
        load: Floats,
        *,
        run: "int | Ints",
        read: bool,
        cycle: Cycle | None = None,
    ) -> None:
        n, here = len(after_s), self._cycle
        full = np.ones(n)
        self.reads += n if read else 0
        self._pieces.append(
            {
                "time_s": self._time_s + after_s,
                "on": full * phase.on,
                "rpm": full * phase.rpm,
                "load": np.tile(load, (n, 1)),
                "pose_mm": here.pose_mm if cycle else np.tile(here.pose_mm[-1], (n, 1)),
                "direction": here.direction if cycle else np.tile(here.direction[-1], (n, 1)),
                "travelling": here.travelling if cycle else np.full(n, -1),
                "run": np.full(n, run),
                "read": np.full(n, read),
                "phase": np.full(n, index),
                **{
                    f"more {name}": values if cycle else _resting(name, values, n) for name, values in here.more.items()
                },
            }
        )

    def close(self, names: tuple[str, ...]) -> Timeline:
        joined = {key: np.concatenate([p[key] for p in self._pieces]) for key in self._pieces[0]}
        order = np.argsort(joined["time_s"], kind="stable")
        ordered = {k: v[order] for k, v in joined.items()}
        more = {k.removeprefix("more "): ordered.pop(k) for k in list(ordered) if k.startswith("more ")}
        return Timeline(**ordered, phases=names, more=more)


def _resting(name: str, values: Floats, n: int) -> Floats:
    """A channel while the machine is at rest after a cycle, (n,)."""
    return np.zeros(n) if name.startswith(("v_", "a_")) else np.full(n, values[-1])
