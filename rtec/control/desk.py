"""Answers requests, whatever line they came by: who may what, and what was said before is not carried out again."""

import dataclasses
import secrets
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Protocol

from rtec.control.messages import Request, RequestError, answer, numbers, read_request
from rtec.control.residual import Left
from rtec.daemon.status import Status
from rtec.log.events import Event
from rtec.loop.clock import Clock
from rtec.loop.orders import Order, OrderRefused
from rtec.loop.run_file import Setup

Role = Literal["read", "operate"]
SESSION_NS: Final = 10_000_000_000
"""An order that was held up for longer is old: whoever gave it has long looked away."""
SESSIONS: Final = 256
EVENTS: Final = 20
TELL_NS: Final = 60_000_000_000


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

    def order(self, order: Order, text: str = "", who: str = "local") -> str:
        """Order something."""
        ...

    def note(self, what: str, text: str) -> None:
        """Put something into the events."""
        ...

    def recent_events(self, most: int) -> tuple[int, Sequence[Event]]:
        """How many there were, and the newest of them."""
        ...


@dataclass(frozen=True)
class Peer:
    """Who asks.

    Attributes:
        name: stands in the events.
        role: what it may.
        line: of its connection; another one after each time that it connects.
    """

    name: str
    role: Role
    line: bytes


@dataclass
class Tally:
    """How often requests were answered, refused, could not be read; and lines that were not let in."""

    answered: int = 0
    refused: int = 0
    malformed: int = 0
    not_let_in: int = 0


@dataclass
class _Session:
    nonce: str
    since_ns: int
    seq: int = -1


@dataclass
class _Tell:
    """Refusals go to the events, but not more often than once a minute: nobody fills the disk with them."""

    next_ns: int = 0
    kept_back: int = 0


@dataclass
class Desk:
    """Answers requests.

    Args:
        daemon: is told the orders.
        clock: monotonic.
        origin: what does not change while the daemon runs; stands in every status.
        left: knows what the last measurement says.

    Attributes:
        tally: of everything so far.
    """

    daemon: Daemon
    clock: Clock
    origin: Mapping[str, Any]
    left: Left = field(default_factory=lambda: Left(None))
    tally: Tally = field(default_factory=Tally)
    _sessions: OrderedDict[bytes, _Session] = field(default_factory=OrderedDict)
    _tell: _Tell = field(default_factory=_Tell)

    def answer(self, message: bytes, peer: Peer) -> bytes:
        """Give the answer to any message; raises nothing for any of them."""
        try:
            request = read_request(message)
        except RequestError as e:
            self.tally.malformed += 1
            self.refusal(f"{peer.name}: {e}")
            return answer(None, {"error": str(e)})
        try:
            content = self._content(request, peer)
        except OrderRefused as e:
            self.tally.refused += 1
            self.refusal(f"{peer.name}: {request.ask}: {e}")
            return answer(request.id, {"refused": str(e)})
        self.tally.answered += 1
        return answer(request.id, content)

    def status(self) -> dict[str, Any]:
        """Everything that the daemon tells of itself."""
        status, model = self.daemon.status, self.daemon.setup.model
        total, newest = self.daemon.recent_events(EVENTS)
        age_s = (self.clock.now_ns() - status.time_ns) * 1e-9 if status.time_ns else None
        facts = {**dataclasses.asdict(status), "flags": [f.name for f in status.flags], "reasons": status.reasons}
        content = {
            **self.origin,
            "model": model.name,
            "left": self.left.facts(model),
            "status": facts,
            "status_age_s": age_s,
            "events_total": total,
            "events": [dataclasses.asdict(event) for event in newest],
            "control": dataclasses.asdict(self.tally),
        }
        return {key: numbers(value) for key, value in content.items()}

    def refusal(self, text: str) -> None:
        """Put a refusal into the events, if none was there in the last minute."""
        now_ns, tell = self.clock.now_ns(), self._tell
        if now_ns < tell.next_ns:
            tell.kept_back += 1
            return
        more = f" (and {tell.kept_back} more since the last entry)" if tell.kept_back else ""
        self.daemon.note("refused", text + more)
        tell.next_ns, tell.kept_back = now_ns + TELL_NS, 0

    def _content(self, request: Request, peer: Peer) -> Mapping[str, Any]:
        if request.ask == "status":
            return self.status()
        if peer.role != "operate":
            raise OrderRefused(f"{peer.name} may read, not operate")
        if request.ask == "session":
            return {"session": self._begin(peer), "good_for_s": SESSION_NS / 1e9}
        self._check(request, peer)
        return {"done": self.daemon.order(request.order, request.text, peer.name)}

    def _begin(self, peer: Peer) -> str:
        self._sessions.pop(peer.line, None)
        while len(self._sessions) >= SESSIONS:
            self._sessions.popitem(last=False)
        made = self._sessions[peer.line] = _Session(secrets.token_hex(16), self.clock.now_ns())
        return made.nonce

    def _check(self, request: Request, peer: Peer) -> None:
        """Refuse what was sent before: over another line, to an earlier daemon, long ago, or twice."""
        session = self._sessions.get(peer.line)
        if session is None or not secrets.compare_digest(session.nonce, request.session):
            raise OrderRefused("this session is not of this connection; ask for one")
        if self.clock.now_ns() - session.since_ns > SESSION_NS:
            raise OrderRefused("this session is over; the order may be old; ask for a new session")
        if request.seq <= session.seq:
            raise OrderRefused(f"order {request.seq} was given before")
        session.seq = request.seq
