"""`make attack` itself: it finds a loss. Oracle: rows written down here, each with one thing wrong."""

import pytest

from tests.attack.__main__ import GROWTH_MB, KILLS, Row, killed, show


@pytest.mark.parametrize(
    ("row", "status"),
    [
        (Row("quiet", 3, 3, 1.0, 0.1, GROWTH_MB, "7 of 9"), 0),
        (Row("an order unanswered", 3, 2), 1),
        (Row("nothing was tried", 0, 0), 1),
        (Row("a jump", 3, 3, 1.01), 1),
        (Row("memory", 3, 3, memory_mb=GROWTH_MB + 1), 1),
        (Row("a fault", 3, 3, losses=["the daemon ended"]), 1),
    ],
)
def test_every_loss_is_one(row: Row, status: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert show([row]) == status
    assert ("LOST" in capsys.readouterr().out) == bool(status)


def begun(*output: int) -> dict[str, object]:
    """A loop that took over this ledger after the second command."""
    return {"after": 2, "output": list(output), "mode": 0, "kept_ns": 0}


@pytest.mark.parametrize(
    ("begins", "saved", "lost"),
    [
        ([begun(0, 0), begun(1, 0), begun(1, 0)], [1, 0], 0),
        ([begun(0, 0)], [1, 0], 0),  # all others died before they took over
        ([begun(0, 0), begun(0, 0), begun(1, 0)], [1, 0], 1),
        ([begun(0, 0), begun(1, 0)], [5, 0], 1),
    ],
)
def test_a_kill_is_lost_where_a_ledger_is_wrong(begins: list[object], saved: list[int], lost: int) -> None:
    """Two commands went out, the second of one count; what a loop takes over after them must be that one."""
    commands = [[0, 0, 0, 0, 0], [1, 0, 0, 1, 0], [2, 0, 0, 1, 0]]
    found = {"commands": commands, "begins": begins, "saved": saved, "inserted": [1, 0]}
    survived, step = killed(found, "box")
    assert survived == KILLS - lost
    assert 0.0 < step <= 1.0
