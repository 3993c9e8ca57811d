"""Date and time of day for people who look for a stretch of a log. Nothing here decides an order."""

from datetime import UTC, datetime, timedelta
from typing import Final

from rtec.errors import LogError

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND: Final = timedelta(microseconds=1)
EXAMPLES: Final = "2026-03-09, '2026-03-09 14:30', 2026-03-09T13:30:00Z or 2026-03-09T14:30:00+01:00"


def instant_ns(text: str) -> int:
    """Give the instant that an ISO 8601 text names, ns since 1970 UTC; without a zone it is this computer's own time.

    Raises:
        LogError: it is no date and time.
    """
    try:
        found = datetime.fromisoformat(text.strip())
        return (found.astimezone(UTC) - _EPOCH) // _MICROSECOND * 1000
    except (ValueError, OverflowError) as error:
        raise LogError(f"{text!r} is no date and time; give {EXAMPLES}") from error


def utc_text(instant: int) -> str:
    """Give an instant, ns since 1970 UTC, as `2026-03-09 13:30:00Z`; "" where no calendar reaches."""
    try:
        return (_EPOCH + timedelta(microseconds=instant // 1000)).strftime("%Y-%m-%d %H:%M:%SZ")
    except OverflowError:
        return ""
