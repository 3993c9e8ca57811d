"""Dates and times of foreign files, and their time zones."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta, tzinfo
from typing import Any
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from rtec.metrology.readers.base import ForeignTable

SUCH_AS = "such as Europe/Berlin, UTC or +02:00"
ABSOLUTE = ("unix", "filetime")
"""Units of time that count from an instant in UTC."""


def zone_of(text: str) -> tzinfo:
    """A time zone by its place, "UTC", or its distance from UTC.

    Raises:
        ValueError: there is no such zone.
    """
    if text.upper() in ("UTC", "Z"):
        return UTC
    if re.fullmatch(r"[+-]\d\d:?\d\d", text):
        return datetime.strptime(text, "%z").tzinfo or UTC
    try:
        return ZoneInfo(text)
    except (ZoneInfoNotFoundError, ValueError, OSError) as e:
        raise ValueError(f"{text!r} is no time zone, {SUCH_AS}") from e


def parsed(text: str, pattern: str | None) -> datetime:
    """Parse a date and time; without a time zone where the text has none.

    Args:
        text: the text.
        pattern: strptime pattern; None reads ISO 8601.

    Raises:
        ValueError: the text does not match.
    """
    return datetime.strptime(text, pattern) if pattern else datetime.fromisoformat(text)


def in_utc(moment: datetime, zone: tzinfo | None, before: datetime | None) -> datetime:
    """A moment in UTC. In the hour that comes twice at the end of summer time it is the one that follows `before`.

    Args:
        moment: with a zone of its own, or local.
        zone: of local moments; None takes them as UTC.
        before: the moment before, in UTC; None for the first.
    """
    if moment.tzinfo is not None:
        return moment.astimezone(UTC)
    if zone is None:
        return moment.replace(tzinfo=UTC)
    first, second = (moment.replace(tzinfo=zone, fold=fold).astimezone(UTC) for fold in (0, 1))
    return second if before is not None and first < before <= second else first


def dated(pattern: str | None) -> bool:
    """Whether times of this strptime pattern, or ISO 8601, have a date."""
    return pattern is None or any(word in pattern for word in ("%d", "%j", "%x", "%c"))


def said_zone(table: ForeignTable, time: Mapping[str, Any]) -> str | None:
    """The zone that a file says: "UTC" or "+02:00"; empty where it has a clock and says none; None without a clock.

    Args:
        table: of the file.
        time: keys of `[time]`.
    """
    unit, pattern, name = time.get("unit"), time.get("format"), time.get("column")
    if name is None or not (pattern or unit in ("iso", "excel", *ABSOLUTE)):
        return None
    if time.get("zone") or unit in ABSOLUTE:
        return time.get("zone") or "UTC"
    if unit == "excel" or time.get("date"):
        return ""
    cells = (str(v).strip() for v in table.columns.get(name, ()))
    try:
        moment = parsed(next(c for c in cells if c and c != "nan"), pattern)
    except (StopIteration, ValueError, OverflowError):
        return None
    return written(moment.utcoffset())


def written(offset: timedelta | None) -> str:
    """A distance from UTC as text; empty for none."""
    if offset is None:
        return ""
    minutes = round(offset.total_seconds() / 60.0)
    return f"{'-' if minutes < 0 else '+'}{abs(minutes) // 60:02d}:{abs(minutes) % 60:02d}" if minutes else "UTC"
