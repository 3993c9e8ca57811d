"""Tells the service manager how the daemon is: the protocol of `sd_notify(3)`, a datagram to a socket.

READY is told after the first good cycle: one whose counts were fresh, and every temperature that the model reads.
WATCHDOG is told only while the loop does cycles. Its rows are what is counted, so a loop that stands still, or a
supervisor that no longer gets any, is found out by the service manager, which starts the daemon anew.
"""

import os
import socket
from collections.abc import Mapping
from typing import Final

from rtec.correction.guard import Flag
from rtec.daemon.status import Status
from rtec.loop.clock import Clock

NOT_GOOD: Final = Flag.STALE_COUNTS | Flag.STALE_TEMPERATURE
STATUS_NS: Final = 1_000_000_000
_PARTS: Final = 4
"""So often within the time that the service manager allows."""


class Notifier:
    """Does nothing where no service manager asks for it.

    Args:
        address: path of the socket, or its abstract name behind an `@`; "": nobody asks.
        watchdog_ns: longest time between two signs of life; 0: nobody asks for them.
        clock: monotonic.

    Attributes:
        asked: whether a service manager listens.
    """

    def __init__(self, address: str, watchdog_ns: int, clock: Clock) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self.asked = bool(address)
        self._clock, self._period_ns = clock, watchdog_ns // _PARTS
        self._ready = False
        self._cycles, self._text = -1, ""
        self._next_life_ns = self._next_text_ns = 0

    @classmethod
    def from_environment(cls, environment: Mapping[str, str], clock: Clock) -> "Notifier":
        """Give what the service manager asked for: NOTIFY_SOCKET, WATCHDOG_USEC for the process WATCHDOG_PID."""
        usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
        mine = pid in ("", str(os.getpid())) and usec.isdecimal()
        return cls(environment.get("NOTIFY_SOCKET", ""), int(usec) * 1000 if mine else 0, clock)

    def look(self, status: Status) -> None:
        """Tell what the newest status gives reason to; called many times a second."""
        if not self._address:
            return
        now = self._clock.now_ns()
        if not self._ready and status.cycles and not status.flags & NOT_GOOD:
            self._ready = self._send(f"READY=1\nSTATUS={_words(status)}")
        lives, self._cycles = status.cycles != self._cycles, status.cycles
        if self._period_ns and lives and now >= self._next_life_ns and self._send("WATCHDOG=1"):
            self._next_life_ns = now + self._period_ns
        if now >= self._next_text_ns:
            self._next_text_ns = now + STATUS_NS
            self._tell(_words(status))

    def stopping(self) -> None:
        """Tell that the run comes to its end."""
        self._send("STOPPING=1")

    def _tell(self, text: str) -> None:
        if text != self._text and self._send(f"STATUS={text}"):
            self._text = text

    def _send(self, text: str) -> bool:
        """Send, and never wait for it: what does not go now is sent again at the next look."""
        if not self._address:
            return False
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as s:
                s.sendto(text.encode(), socket.MSG_NOSIGNAL, self._address)
        except (OSError, ValueError):
            return False
        return True


def _words(status: Status) -> str:
    """One line for `systemctl status`."""
    if not status.cycles:
        return "starting"
    wrong = [f"{name}: {'; '.join(texts)}" for name, texts in status.devices.items()]
    parts = [f"correction {status.mode}", *status.reasons, *wrong, status.log]
    return "; ".join(part.replace("\n", " ") for part in parts if part)
