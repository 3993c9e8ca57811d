"""What a front end knows of a daemon. Oracle: the run file as the daemon itself reads it."""

from pathlib import Path
from typing import Any

import pytest

from rtec.errors import RtecError
from rtec.loop.clock import VirtualClock
from rtec.loop.run_file import load_setup
from rtec.tasks.daemon import LiveLink, limits_of
from tests.studio.studio_rig import live_config


def test_limits_are_those_that_the_daemon_reads(tmp_path: Path) -> None:
    """A run file that the daemon refuses has no limits, even if the table of one axis could be read."""
    config = live_config(tmp_path / "run")
    limits = load_setup(config).file.limits
    assert limits_of(config) == {axis: (v.warning_um, v.stop_um) for axis, v in limits.items()}
    assert set(limits) == {"X", "Z"}
    config.write_text(config.read_text(encoding="utf-8").replace("slew_um_s", "slew"), encoding="utf-8")
    with pytest.raises(RtecError, match="slew"):
        load_setup(config)
    assert limits_of(config) == {}


def _answer(pid: int, time_s: float, *events: str, cycles: int = 1, degc: float = 20.0) -> dict[str, Any]:
    status = {"time_s": time_s, "cycles": cycles, "applied_um": {"X": time_s}, "degc": {"T_bed": degc}}
    return {"pid": pid, "status": status, "events": [{"text": e} for e in events]}


def _followed(tmp_path: Path) -> LiveLink:
    """The daemon ran for 100 s; 7 s later it runs again, first without a row."""
    clock = VirtualClock()
    link = LiveLink(live_config(tmp_path / "run"), "read", clock)
    for k in range(101):
        clock.sleep_until_ns(clock.now_ns() + 1_000_000_000)
        link.note(_answer(1, float(k), "began", "new tool"))
    clock.sleep_until_ns(clock.now_ns() + 5_000_000_000)
    link.note(_answer(2, 0.0, "began again", cycles=0))
    clock.sleep_until_ns(clock.now_ns() + 2_000_000_000)
    for k in range(3):
        link.note(_answer(2, 1.0 + k, "began again"))
        clock.sleep_until_ns(clock.now_ns() + 1_000_000_000)
    return link


def test_the_past_is_kept_when_the_daemon_is_restarted(tmp_path: Path) -> None:
    """Oracle: the clock: what came before stays, a gap is where nothing ran, and time rises by what went by."""
    link = _followed(tmp_path)
    shown = [(m.time_s, m.applied_um.get("X")) for m in link.minutes]
    assert shown[:101] == [(float(k), float(k)) for k in range(101)]
    assert shown[101:] == [(100.0, None), (106.0, 1.0), (107.0, 2.0), (108.0, 3.0)]
    assert [m.time_s for m in link.hours] == [0.0, 60.0, 60.0, 106.0]
    assert link.runs == 2


def test_events_and_marks_are_kept_when_the_daemon_is_restarted(tmp_path: Path) -> None:
    """Each once, oldest first."""
    assert [e["text"] for e in _followed(tmp_path).events] == ["began", "new tool", "began again"]
