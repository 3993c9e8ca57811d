"""Clock steps (NTP, summer time, a hand on the clock): only monotonic time decides.

Oracles: the same run with a calendar that stands still; the source text, for who may look at the calendar at all.
"""

import ast
import random
import time
from dataclasses import replace
from pathlib import Path

import pytest

from rtec.arrays import Floats, Ints
from rtec.correction.flags import Flag, GuardSettings
from rtec.loop.clock import RealClock, VirtualClock, wall_clock_ns
from rtec.loop.devices import Ports
from tests.loop.test_loop import run
from tests.support.setups import setup

S = 10**9
ROOT = Path(__file__).parents[2]
CALENDAR = {"wall_clock_ns", "wall_clock_iso"}
ROOMS = ("correction", "model", "effects", "loop", "log", "daemon", "control", "doctor", "replay")
MAY_KNOW_THE_DATE = {"control", "log", "daemon"}
"""What tells people the date: packages of rtec that run."""


def test_commands_do_not_change_when_the_calendar_jumps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By up to a year, both ways, at every look."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    _, still, _, _ = run(setup(tmp_path / "a"), VirtualClock(10**9), 2000)
    chance = random.Random(4)
    year_ns = 365 * 86_400 * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: 1_700_000_000 * 10**9 + chance.randint(-year_ns, year_ns))
    monkeypatch.setattr(time, "time", lambda: 1.7e9 + chance.uniform(-3e7, 3e7))
    assert abs(wall_clock_ns() - wall_clock_ns()) > 10**9, "the calendar does jump"
    _, jumping, _, _ = run(setup(tmp_path / "b"), VirtualClock(10**9), 2000)
    for name, array in still.arrays().items():
        assert array.tobytes() == getattr(jumping, name).tobytes(), name


@pytest.mark.parametrize("ahead_ns", [10 * S, 1_700_000_000 * S], ids=["seconds", "the calendar"])
@pytest.mark.parametrize("what", ["counts", "temperatures"])
def test_a_device_of_another_clock_is_never_fresh(tmp_path: Path, what: str, ahead_ns: int) -> None:
    """It stamps by a clock that is ahead, and falls silent: it holds from the beginning. Oracle: the flags."""
    flag = {"counts": Flag.STALE_COUNTS, "temperatures": Flag.STALE_TEMPERATURE}[what]

    def wrapped(ports: Ports) -> Ports:
        counts, temperatures = ports.counts, ports.temperatures[0]

        class Ahead:
            def read_counts(self, values: Ints) -> int:
                return counts.read_counts(values) + ahead_ns

            def read_temperatures(self, degc: Floats, time_ns: Ints) -> None:
                temperatures.read_temperatures(degc, time_ns)
                time_ns += ahead_ns

        return replace(ports, counts=Ahead()) if what == "counts" else replace(ports, temperatures=(Ahead(),))

    made = setup(tmp_path)
    made = replace(made, file=made.file.model_copy(update={"guard": GuardSettings(temperature_max_age_s=5.0)}))
    _, commands, loop, _ = run(made, VirtualClock(S), 500, wrapped)
    held = int(flag | Flag.HELD)
    assert ((commands.flags & held) == held)[1:].all()
    assert not commands.output.any()
    said = [text for texts in loop.stats.reasons().values() for text in texts]
    assert any("ahead of the loop's clock" in text for text in said), said


def test_real_time_is_monotonic(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the daemon does not follow a calendar that is set back."""
    clock = RealClock()
    before_ns = clock.now_ns()
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert 0 <= clock.now_ns() - before_ns < 60 * 10**9


def test_who_looks_at_the_calendar() -> None:
    """Not the loop, not the guard, no driver: only what writes logs and answers people."""
    found = set()
    rooms = [path for room in ROOMS for path in (ROOT / "rtec" / room).rglob("*.py")]
    for path in [*rooms, *(ROOT / "drivers" / "rtec_drivers").rglob("*.py")]:
        if path.name == "clock.py":
            continue
        names = {n.id for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Name)}
        if names & CALENDAR:
            found.add(path.relative_to(ROOT).parts[1])
    assert found
    assert found <= MAY_KNOW_THE_DATE, found
