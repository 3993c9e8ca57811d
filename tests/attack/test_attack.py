"""`make attack` itself: it finds a loss. Oracle: rows written down here, each with one thing wrong."""

import pytest

from tests.attack.__main__ import GROWTH_MB, Row, show


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
