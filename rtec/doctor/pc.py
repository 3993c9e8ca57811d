"""Is this computer fit for real time? What it lacks, and how to get that."""

import os
import pwd
from collections.abc import Callable
from pathlib import Path

from rtec.doctor.pc_found import Finding, PcFound
from rtec.doctor.pc_kernel import clock_source, host, kernel, swap
from rtec.doctor.pc_processor import firmware, governor, idle_states, isolation, loops_processor
from rtec.doctor.pc_read import Pc
from rtec.doctor.pc_rights import locked_memory, priority
from rtec.doctor.wakeup import WakeUps, judged, measured
from rtec.errors import DriverUnavailable
from rtec.loop.run_file import Realtime, RunFile
from rtec.tomlfile import read_toml, validated

DEFAULT_RATE_HZ = 1000.0
Tell = Callable[[int, int], None]
Measure = Callable[[Realtime, float, float, Tell], WakeUps]


def wanted_of(path: Path | None) -> tuple[Realtime, float]:
    """What a run file asks of the computer, and its cycles a second; without one what holds where nothing is said.

    Raises:
        ConfigError: the run file is wrong.
    """
    if path is None:
        return Realtime(), DEFAULT_RATE_HZ
    file = validated(RunFile, read_toml(path), str(path))
    return file.realtime, file.run.rate_hz


def look_at(
    wanted: Realtime,
    rate_hz: float,
    seconds: float,
    tell: Tell = lambda _done, _of: None,
    pc: Pc | None = None,
    measure: Measure = measured,
) -> PcFound:
    """Look at this computer and measure its wake-ups.

    Args:
        wanted: what the loop asks of it.
        rate_hz: cycles a second.
        seconds: how long wake-ups are measured.
        tell: is given how much is done, of how much.
        pc: where its files are.
        measure: measures the wake-ups.
    """
    pc = pc or Pc()
    ours = loops_processor(pc, wanted)
    before = None if ours is None else pc.smi_count(ours)
    wake_ups = _wake_ups(measure, wanted, rate_hz, seconds, tell)
    after = None if ours is None else pc.smi_count(ours)
    user = _user()
    locked = locked_memory(pc, wanted, user)
    return PcFound(
        (
            wake_ups,
            priority(pc, wanted, user),
            locked,
            isolation(pc, wanted),
            idle_states(pc, wanted),
            governor(pc, wanted),
            firmware(pc, before, after, seconds),
            kernel(pc),
            host(pc),
            clock_source(pc),
            swap(pc, wanted.lock_memory and locked.state == "good"),
        )
    )


def _wake_ups(measure: Measure, wanted: Realtime, rate_hz: float, seconds: float, tell: Tell) -> Finding:
    try:
        return judged(measure(wanted, rate_hz, seconds, tell), rate_hz)
    except DriverUnavailable as e:
        return Finding("wake-ups", str(e), "unknown")


def _user() -> str:
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:  # a container may run as a user that has no name
        return str(os.geteuid())
