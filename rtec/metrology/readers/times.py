"""Dates and times in the formats of other programs."""

from datetime import UTC, datetime, timedelta

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
EPOCH_FILETIME = datetime(1601, 1, 1, tzinfo=UTC)
EPOCH_UNIX = datetime(1970, 1, 1, tzinfo=UTC)
EPOCH_EXCEL = datetime(1899, 12, 30, tzinfo=UTC)


def filetime_text(ticks: int) -> str:
    """A FILETIME (100 ns since 1601) as ISO text in UTC; the number itself where no calendar has it."""
    try:
        return (EPOCH_FILETIME + timedelta(microseconds=ticks // 10)).isoformat()
    except OverflowError:
        return f"FILETIME {ticks}"


def parsed(text: str, pattern: str | None) -> datetime:
    """Parse a date and time; local times are taken as UTC.

    Args:
        text: the text.
        pattern: strptime pattern; None reads ISO 8601.

    Raises:
        ValueError: the text does not match.
    """
    moment = datetime.strptime(text, pattern) if pattern else datetime.fromisoformat(text)
    return moment if moment.tzinfo else moment.replace(tzinfo=UTC)
