"""Answers requests: checks rights, and that no order is carried out twice."""

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from rtec.control.messages import Request, RequestError, Role, answer, numbers, read_request
from rtec.control.residual import Residual
from rtec.daemon.status import Status
from rtec.daemon.supervision import DaemonParts
from rtec.errors import unforeseen
from rtec.log.recording import Event
from rtec.loop.clock import Clock
from rtec.loop.orders import Order, OrderRefused
from rtec.loop.run_file import Setup

SESSION_NS: Final = 10_000_000_000
"""Longest age, ns, of an order: one that was delayed for longer no longer fits the situation."""
EVENTS: Final = 20
REPORT_NS: Final = 60_000_000_000


class Daemon(Protocol):
    """The supervisor, as control uses it; all calls come from a thread of control's own."""

    @property
    def status(self) -> Status:
        """Status of the newest row."""
        ...

    @property
    def setup(self) -> Setup:
        """The setup in force."""
        ...

    @property
    def parts(self) -> DaemonParts:
        """Supervises the control's thread."""
        ...

    def order(self, order: Order, text: str = "", who: str = "local") -> str:
        """Give an order."""
        ...

    def note(self, what: str, text: str) -> None:
        """Write an event."""
        ...

    def recent_events(self, most: int) -> tuple[int, Sequence[Event]]:
        """The number of events so far, and the newest of them."""
        ...


@dataclass
class Session:
    """Makes an order valid once: a client first requests a `nonce`; `seq` of its orders only grows."""

    nonce: str
    since_ns: int
    seq: int = -1


@dataclass
class Peer:
    """The client of one connection.

    Attributes:
        name: name in the events.
        role: its rights.
        lowered: did it take a name and a role of its own, which it can do once?
        watches: does it get the status repeatedly?
        session: its newest session.
    """

    name: str
    role: Role
    lowered: bool = False
    watches: bool = False
    session: Session | None = None

    def lower(self, name: str, role: Role) -> None:
        """Add another name to its own, and take a role.

        Raises:
            OrderRefused: it did so before, or the role has more rights than it has.
        """
        if self.lowered or (role == "operate" and self.role != "operate"):
            raise OrderRefused(f"{self.name} cannot take another name or more rights")
        self.name, self.role, self.lowered = f"{name} ({self.name})", role, True


@dataclass
class Tally:
    """Numbers of requests that were answered, refused or malformed, and of connections closed to make room."""

    answered: int = 0
    refused: int = 0
    malformed: int = 0
    not_let_in: int = 0


@dataclass
class _Refusals:
    """Limits the events of refusals to one a minute, so that no client can fill the disk with them."""

    next_ns: int = 0
    kept_back: int = 0


@dataclass
class Desk:
    """Answers requests.

    Args:
        daemon: carries out the orders.
        clock: monotonic.
        origin: part of every status that is constant while the daemon runs.
        residual: residual of the last measurement.

    Attributes:
        tally: numbers of requests so far.
    """

    daemon: Daemon
    clock: Clock
    origin: Mapping[str, Any]
    residual: Residual = field(default_factory=lambda: Residual(None))
    tally: Tally = field(default_factory=Tally)
    _refusals: _Refusals = field(default_factory=_Refusals)

    def answer(self, message: bytes, peer: Peer) -> bytes:
        """Answer any message; never raises."""
        try:
            request = read_request(message)
        except RequestError as e:
            self.tally.malformed += 1
            self.refusal(f"{peer.name}: {e}")
            return answer(None, {"error": str(e)})
        try:
            text = answer(request.id, self._content(request, peer))
        except OrderRefused as e:
            self.tally.refused += 1
            self.refusal(f"{peer.name}: {request.ask}: {e}")
            return answer(request.id, {"refused": str(e)})
        except Exception as e:  # noqa: BLE001 (a status that fails must not block an order)
            self.tally.refused += 1
            self.refusal(f"{peer.name}: {request.ask}: {unforeseen(e)}")
            return answer(request.id, {"refused": unforeseen(e)})
        self.tally.answered += 1
        return text

    def status(self) -> dict[str, Any]:
        """Everything that the daemon reports of itself."""
        status, setup = self.daemon.status, self.daemon.setup
        model = setup.model
        per_mm = {axis.name: axis.counts_per_mm for axis in model.machine.axes}
        total, newest = self.daemon.recent_events(EVENTS)
        age_s = (self.clock.now_ns() - status.time_ns) * 1e-9 if status.time_ns else None
        facts = {
            **vars(status),
            "position_mm": {
                axis: None if counts is None else counts / per_mm[axis] for axis, counts in status.counts.items()
            },
            "flags": [f.name for f in status.flags],
            "reasons": status.reasons,
        }
        content = {
            **self.origin,
            "model": model.name,
            "left": self.residual.facts(model),
            "status": facts,
            "status_age_s": age_s,
            "temperature_max_age_s": setup.file.guard.temperature_max_age_s,
            "beyond_stop": {
                axis: limits.stop_um
                for axis, limits in setup.file.limits.items()
                if abs(status.applied_um.get(axis, 0.0)) > limits.stop_um
            },
            "events_total": total,
            "events": [vars(event) for event in newest],
            "control": vars(self.tally),
        }
        return {key: numbers(value) for key, value in content.items()}

    def refusal(self, text: str) -> None:
        """Write a refusal to the events, unless there was one in the last minute."""
        now_ns, before = self.clock.now_ns(), self._refusals
        if now_ns < before.next_ns:
            before.kept_back += 1
            return
        more = f" (and {before.kept_back} more since the last entry)" if before.kept_back else ""
        self.daemon.note("refused", text + more)
        before.next_ns, before.kept_back = now_ns + REPORT_NS, 0

    def _content(self, request: Request, peer: Peer) -> Mapping[str, Any]:
        if request.ask == "as":
            peer.lower(request.name, request.role)
            return {"name": peer.name, "role": peer.role}
        if request.ask in ("status", "watch"):
            peer.watches |= request.ask == "watch"
            return self.status()
        if peer.role != "operate":
            raise OrderRefused(f"{peer.name} may read, not operate")
        if request.ask == "session":
            peer.session = Session(secrets.token_hex(16), self.clock.now_ns())
            return {"session": peer.session.nonce, "good_for_s": SESSION_NS / 1e9}
        self._check(request, peer)
        return {"done": self.daemon.order(request.order, request.text, peer.name)}

    def _check(self, request: Request, peer: Peer) -> None:
        """Refuse an order of another connection, of an earlier daemon, of long ago, or sent twice."""
        session = peer.session
        if session is None or not secrets.compare_digest(session.nonce, request.session):
            raise OrderRefused("this session is not of this connection; ask for one")
        if self.clock.now_ns() - session.since_ns > SESSION_NS:
            raise OrderRefused("this session is over; the order may be old; ask for a new session")
        if request.seq <= session.seq:
            raise OrderRefused(f"order {request.seq} was given before")
        session.seq = request.seq
