"""Answers requests: who may what, and that an order which was given before is not carried out again."""

import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from rtec.control.messages import Request, RequestError, Role, answer, numbers, read_request
from rtec.control.residual import Residual
from rtec.daemon.status import Status
from rtec.daemon.supervision import DaemonParts
from rtec.errors import unforeseen
from rtec.log.events import Event
from rtec.loop.clock import Clock
from rtec.loop.orders import Order, OrderRefused
from rtec.loop.run_file import Setup

SESSION_NS: Final = 10_000_000_000
"""An order that was held up for longer is old: whoever gave it has long looked away."""
EVENTS: Final = 20
REPORT_NS: Final = 60_000_000_000


class Daemon(Protocol):
    """What is asked of the supervisor; all of it from a thread of the control's own."""

    @property
    def status(self) -> Status:
        """Of the newest row."""
        ...

    @property
    def setup(self) -> Setup:
        """What is in force now."""
        ...

    @property
    def parts(self) -> DaemonParts:
        """Keeps the control's thread alive."""
        ...

    def order(self, order: Order, text: str = "", who: str = "local") -> str:
        """Order something."""
        ...

    def note(self, what: str, text: str) -> None:
        """Put something into the events."""
        ...

    def recent_events(self, most: int) -> tuple[int, Sequence[Event]]:
        """How many there were, and the newest of them."""
        ...


@dataclass
class Session:
    """What makes the orders of a connection new: `nonce` is asked for first, `seq` of the last order only grows."""

    nonce: str
    since_ns: int
    seq: int = -1


@dataclass
class Peer:
    """Who asks, over one connection.

    Attributes:
        name: as the events show it.
        role: what it may.
        lowered: it took a name and a role of its own, once and for good.
        watches: it is sent the status again and again.
        session: the one that it asked for last.
    """

    name: str
    role: Role
    lowered: bool = False
    watches: bool = False
    session: Session | None = None

    def lower(self, name: str, role: Role) -> None:
        """Take another name beside its own, and a role.

        Raises:
            OrderRefused: it did so before, or it has not the rights that it wants.
        """
        if self.lowered or (role == "operate" and self.role != "operate"):
            raise OrderRefused(f"{self.name} cannot take another name or more rights")
        self.name, self.role, self.lowered = f"{name} ({self.name})", role, True


@dataclass
class Tally:
    """How often requests were answered, refused, could not be read; and connections that were cut for others."""

    answered: int = 0
    refused: int = 0
    malformed: int = 0
    not_let_in: int = 0


@dataclass
class _Refusals:
    """Refusals go to the events, but not more often than once a minute: nobody fills the disk with them."""

    next_ns: int = 0
    kept_back: int = 0


@dataclass
class Desk:
    """Answers requests.

    Args:
        daemon: takes the orders.
        clock: monotonic.
        origin: what does not change while the daemon runs; is in every status.
        residual: knows what the last measurement says.

    Attributes:
        tally: of everything so far.
    """

    daemon: Daemon
    clock: Clock
    origin: Mapping[str, Any]
    residual: Residual = field(default_factory=lambda: Residual(None))
    tally: Tally = field(default_factory=Tally)
    _refusals: _Refusals = field(default_factory=_Refusals)

    def answer(self, message: bytes, peer: Peer) -> bytes:
        """Give the answer to any message; raises nothing for any of them."""
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
        except Exception as e:  # noqa: BLE001 (a status that cannot be had keeps no order out)
            self.tally.refused += 1
            self.refusal(f"{peer.name}: {request.ask}: {unforeseen(e)}")
            return answer(request.id, {"refused": unforeseen(e)})
        self.tally.answered += 1
        return text

    def status(self) -> dict[str, Any]:
        """Everything that the daemon reports of itself."""
        status, model = self.daemon.status, self.daemon.setup.model
        per_mm = {axis.name: axis.counts_per_mm for axis in model.machine.axes}
        total, newest = self.daemon.recent_events(EVENTS)
        age_s = (self.clock.now_ns() - status.time_ns) * 1e-9 if status.time_ns else None
        facts = {
            **vars(status),
            "position_mm": {axis: counts / per_mm[axis] for axis, counts in status.counts.items()},
            "flags": [f.name for f in status.flags],
            "reasons": status.reasons,
        }
        content = {
            **self.origin,
            "model": model.name,
            "left": self.residual.facts(model),
            "status": facts,
            "status_age_s": age_s,
            "events_total": total,
            "events": [vars(event) for event in newest],
            "control": vars(self.tally),
        }
        return {key: numbers(value) for key, value in content.items()}

    def refusal(self, text: str) -> None:
        """Put a refusal into the events, if none was there in the last minute."""
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
        """Refuse what was sent before: over another line, to an earlier daemon, long ago, or twice."""
        session = peer.session
        if session is None or not secrets.compare_digest(session.nonce, request.session):
            raise OrderRefused("this session is not of this connection; ask for one")
        if self.clock.now_ns() - session.since_ns > SESSION_NS:
            raise OrderRefused("this session is over; the order may be old; ask for a new session")
        if request.seq <= session.seq:
            raise OrderRefused(f"order {request.seq} was given before")
        session.seq = request.seq
