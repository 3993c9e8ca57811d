"""What a report of a running daemon has. Oracle: the status that went in."""

from pathlib import Path
from typing import Any

import pytest

from rtec.control.desk import Desk
from rtec.loop.clock import VirtualClock
from rtec.report.daemon import DaemonMoment, Moment, daemon_lead, daemon_sections
from tests.support import setups
from tests.support.control_rig import FakeDaemon


@pytest.fixture(scope="module")
def status(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    setup = setups.setup(tmp_path_factory.mktemp("run"))
    return Desk(FakeDaemon(setup), VirtualClock(10), {"machine": "mill", "config": str(Path("run.toml"))}).status()


def test_the_report_has_the_axes_the_inputs_and_the_past(status: dict[str, Any]) -> None:
    """A temperature that is not read, and a past with gaps, are drawn; before two points there is no past."""
    past = [Moment(float(k), {"X": 1.0 * k, "Z": None}, {"T_bed": 20.0, "T_air": None}) for k in range(5)]
    made = DaemonMoment("2026-01-02T03:04:05Z", status, {"X": (40.0, 50.0)}, past, past[:1])
    assert daemon_lead(made).startswith("Correction: on. mill, model ")
    assert daemon_lead(made).endswith(", 2026-01-02 03:04:05 UTC.")
    sections = daemon_sections(made)
    cells = {tuple(row) for s in sections if s.table is not None for row in s.table.rows}
    assert ("X", "0.0500", "+1.50", "+1.25", "not known", "+2") in cells
    assert ("T_bed", "21.25 °C", "0.5 s") in cells
    figures = [s.figure for s in sections if s.figure is not None]
    assert [f.name for f in figures] == ["axes.png", "minutes.png"]
    assert all(f.png.startswith(b"\x89PNG") for f in figures)


def test_why_it_is_held_is_the_first_sentence(status: dict[str, Any]) -> None:
    """Oracle: the reasons of the status; an operator's hold."""
    inner = {**status["status"], "mode": "on", "flags": ["HELD"], "reasons": ["counts are stale"], "devices": {}}
    held = DaemonMoment("2026-01-02T03:04:05Z", {**status, "status": inner}, {}, (), ())
    assert daemon_lead(held).startswith("Correction: held: counts are stale. ")
    assert "why: counts are stale" in daemon_sections(held, figures=False)[0].text
    inner = {**inner, "mode": "hold", "flags": [], "reasons": []}
    assert daemon_lead(DaemonMoment("", {**status, "status": inner}, {}, (), ())).startswith(
        "Correction: held: ordered by an operator. "
    )
