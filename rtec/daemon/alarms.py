"""What kept the correction from being what it should be, and when: the beginning and end of every alarm as an event.

A status says what is wrong now. Whoever comes in the morning wants to know what was wrong in the night.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rtec.correction.guard import REASONS, Flag

ORDERED: Final = Flag.ORDERED_HOLD | Flag.ORDERED_OFF | Flag.FADING
"""Somebody ordered it, which is an event of its own; or it follows from another one."""
START_NS: Final = 10_000_000_000
"""So long may slow devices take for their first reading."""
QUIET_NS: Final = 10_000_000_000
"""What comes again within this time is one alarm."""

Tell = Callable[[str, str], None]


@dataclass
class _Alarm:
    text: str
    since_ns: int
    last_ns: int


class Alarms:
    """Tells of each alarm when it begins, and when it has been over for some seconds.

    Args:
        tell: told the kind of event, "alarm" or "alarm over", and a text.
    """

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._going_on: dict[str, _Alarm] = {}
        self._first_ns: int | None = None

    def look(self, now_ns: int, passed: Flag, devices: Mapping[str, Sequence[str]]) -> None:
        """Look at what is wrong.

        Args:
            now_ns: monotonic.
            passed: flags of any of the rows since the last look.
            devices: what is wrong now, by device.
        """
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        if now_ns - self._first_ns < START_NS:
            return
        for key, text in _wrong(passed & ~ORDERED, devices).items():
            if key in self._going_on:
                self._going_on[key].last_ns = now_ns
            else:
                self._going_on[key] = _Alarm(text, now_ns, now_ns)
                self._tell("alarm", text)
        for key, alarm in list(self._going_on.items()):
            if now_ns - alarm.last_ns >= QUIET_NS:
                del self._going_on[key]
                lasted_s = (alarm.last_ns - alarm.since_ns) * 1e-9
                self._tell("alarm over", f"{alarm.text}; it lasted {lasted_s:.1f} s")


def _wrong(flags: Flag, devices: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Texts by what they are of: a device's reason may tell a time that grows, and is one alarm all the same."""
    out = {f"flag {flag.name}": text for flag, text in REASONS.items() if flag in flags}
    return out | {f"device {name}": f"device {name}: {'; '.join(texts)}" for name, texts in devices.items()}
