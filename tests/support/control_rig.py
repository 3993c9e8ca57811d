"""A daemon without a loop behind the real socket of control, and a client that says what it likes."""

import json
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rtec.control.messages import SCHEMA
from rtec.control.places import socket_path
from rtec.correction.flags import Flag
from rtec.daemon.status import Status
from rtec.daemon.supervision import DaemonParts
from rtec.log.recording import Event, Events
from rtec.loop.clock import RealClock
from rtec.loop.orders import Order, OrderRefused
from rtec.loop.run_file import Setup

LONG_S = 20.0


class FakeDaemon:
    """Takes every order but `reload`, and remembers it."""

    def __init__(self, setup: Setup) -> None:
        self.setup, self.orders, self._events = setup, list[tuple[Order, str, str]](), Events(None)
        self.parts = DaemonParts(RealClock(), self.note)
        self.status = Status(
            time_s=7200.0,
            time_ns=1,
            cycles=7_200_000,
            misses=3,
            mode="on",
            requested_um={"X": 1.5, "Z": -2.5},
            applied_um={"X": 1.25, "Z": float("nan")},
            output={"X": 2, "Z": -5},
            counts={"X": 100, "Z": -7},
            flags=Flag(0),
            degc={"T_bed": 21.25, "T_air": float("nan")},
            degc_age_s={"T_bed": 0.5, "T_air": 9e9},
        )

    def order(self, order: Order, text: str = "", who: str = "local") -> str:
        """Remember it."""
        if order is Order.RELOAD:
            raise OrderRefused("an earlier order to reload is not done with yet")
        self.orders.append((order, text, who))
        return f"{order} ordered"

    def note(self, what: str, text: str) -> None:
        """Remember it."""
        self._events.note(Event(0, 0, "2026-01-01T00:00:00Z", what, text, "rtec"))

    def recent_events(self, most: int) -> tuple[int, Sequence[Event]]:
        """The newest."""
        return self._events.total, list(self._events.newest)[-most:]

    @property
    def notes(self) -> list[str]:
        """Texts of the events."""
        return [event.text for event in self._events.newest]


class Line:
    """A raw connection to the daemon's local socket, or whatever else speaks its lines."""

    def __init__(self, made: socket.socket) -> None:
        self.socket, self._received = made, b""

    @classmethod
    def to(cls, config: Path, place: Callable[[Path], Path] = socket_path) -> "Line":
        """Connect to the daemon with that run file; `place` gives its socket."""
        made = socket.socket(socket.AF_UNIX)
        made.connect(str(place(config)))
        return cls(made)

    def __enter__(self) -> "Line":
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, message: bytes) -> None:
        """Send, unread."""
        self.socket.sendall(message + b"\n")

    def receive(self, wait_s: float = LONG_S) -> dict[str, Any] | None:
        """The next answer; None where none comes."""
        self.socket.settimeout(wait_s)
        while b"\n" not in self._received:
            try:
                data = self.socket.recv(65536)
            except (TimeoutError, ConnectionError):
                return None
            if not data:
                return None
            self._received += data
        text, self._received = self._received.split(b"\n", 1)
        found = json.loads(text)
        assert isinstance(found, dict)
        assert found["schema"] == SCHEMA
        return found

    def ask(self, wait_s: float = LONG_S, **content: object) -> dict[str, Any] | None:
        """Send what is asked as JSON; give the answer."""
        self.send(json.dumps({"schema": SCHEMA, **content}).encode())
        return self.receive(wait_s)

    def order(self, **changed: object) -> bytes:
        """Open a session; give the text of an order in it, unsent."""
        found = self.ask(ask="session")
        assert found is not None
        content = {"schema": SCHEMA, "ask": "order", "session": found["session"], "seq": 1, "order": "hold"}
        return json.dumps({**content, **changed}).encode()


def free_place() -> str:
    """A place on the loopback where nobody listens."""
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{trial.getsockname()[1]}"
