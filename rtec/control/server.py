"""Control and telemetry: a thread in the supervisor's process that answers clients and publishes the status.

The loop is another process; all that it ever sees of this are the orders that the supervisor hands on. A client can be
slow, dead, or talk nonsense: nothing here waits for it, keeps more than a few messages for it, or reads faster than
some thousand messages a second.

The daemon's ZeroMQ sockets: made so that nothing that goes on at the other end can make it wait or grow.
"""

import os
import pwd
import threading
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import zmq

from rtec.control.desk import Daemon, Desk, Peer
from rtec.control.keys import CLIENTS, AllowList, Door, Pair, read_server
from rtec.control.messages import LARGEST_REQUEST, TOPIC, answer
from rtec.control.places import ORDERS, STATUS, LocalSocket, answers, listen, socket_path
from rtec.control.prometheus import Endpoint
from rtec.control.residual import Left
from rtec.errors import ConfigError
from rtec.loop.clock import Clock, wall_clock_iso
from rtec.loop.run_file import Setup

QUEUED: Final = 64
"""Messages that wait at most, in either direction, for each client."""
DOMAIN: Final = b"rtec"
HANDSHAKE_MS: Final = 5000


@dataclass(frozen=True)
class Incoming:
    """A message.

    Attributes:
        line: of its connection, as the socket calls it.
        content: its last part.
        key: public key of the client, over the network; "" on this computer.
        address: of the other end, as libzmq says it.
    """

    line: bytes
    content: bytes
    key: str
    address: str


def local_socket(context: Any, kind: int, local: LocalSocket) -> Any:
    """A socket at a file that listens already."""
    made = _socket(context, kind)
    made.setsockopt(zmq.USE_FD, os.dup(local.fd))  # closed with the socket
    made.bind(f"ipc://{local.path}")
    return made


def network_socket(context: Any, kind: int, place: str, pair: Pair) -> Any:
    """A socket on the network, CURVE only.

    Raises:
        ConfigError: the place cannot be had.
    """
    made = _socket(context, kind)
    made.curve_server = True
    made.curve_publickey, made.curve_secretkey = pair.public.encode(), pair.secret.encode()
    made.zap_domain = DOMAIN
    made.ipv6 = "[" in place
    try:
        made.bind(f"tcp://{place}")
    except zmq.ZMQError as e:
        made.close(0)
        raise ConfigError(f"[control] {place}: cannot listen there: {e.strerror}") from e
    return made


def failed_handshakes(context: Any, socket: Any) -> Any:
    """A socket that gets a message for every connection that ended before anybody's key could be looked at.

    Such a client has no key, or speaks with the key of another server: libzmq asks nobody about it (ZAP), it hangs up.
    """
    place = f"inproc://rtec-failed-{id(socket):x}"
    socket.monitor(place, zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
    made = context.socket(zmq.PAIR)
    made.linger = 0
    made.rcvhwm = 0  # libzmq's own thread would wait where there is no room
    made.connect(place)
    return made


def receive(socket: Any) -> Incoming | None:
    """Take a message; None where none waits."""
    try:
        frames = socket.recv_multipart(zmq.NOBLOCK, copy=False)
    except zmq.ZMQError:
        return None
    last = frames[-1]
    return Incoming(
        bytes(frames[0].buffer), bytes(last.buffer), _property(last, "User-Id"), _property(last, "Peer-Address")
    )


def drain(socket: Any) -> int:
    """Throw away all that waits; give how many messages that were."""
    count = 0
    while True:
        try:
            socket.recv_multipart(zmq.NOBLOCK)
        except zmq.ZMQError:
            return count
        count += 1


def send(socket: Any, *frames: bytes) -> None:
    """Send, or let it be where there is no room: nobody is waited for."""
    try:
        socket.send_multipart(frames, zmq.NOBLOCK)
    except zmq.ZMQError:
        return


def _socket(context: Any, kind: int) -> Any:
    made = context.socket(kind)
    made.linger = 0
    made.sndhwm = made.rcvhwm = QUEUED
    made.maxmsgsize = LARGEST_REQUEST
    made.handshake_ivl = HANDSHAKE_MS
    made.heartbeat_ivl, made.heartbeat_timeout = 5000, 15000
    made.tcp_keepalive = 1
    return made


def _property(frame: Any, name: str) -> str:
    try:
        return str(frame.get(name))
    except zmq.ZMQError:
        return ""


AT_ONCE: Final = 50
BREATH_NS: Final = 10_000_000
"""Rest after so many messages at once: the supervisor's own work comes first."""
END_S: Final = 2.0
ENDING_NS: Final = 2_000_000_000


class Control:
    """Entering opens the sockets and starts the thread, leaving ends both.

    Args:
        setup: what runs; its `[control]` says where.
        daemon: the supervisor.
        clock: monotonic.

    Raises:
        RtecError: on entering: a socket cannot be had, or keys cannot be read.
    """

    def __init__(self, setup: Setup, daemon: Daemon, clock: Clock) -> None:
        self._setup, self._table, self._clock = setup, setup.file.control, clock
        compared = None if self._table.compared is None else setup.base / self._table.compared
        self.desk = Desk(daemon, clock, _origin(setup), Left(compared))
        self._daemon = daemon
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="rtec-control", daemon=True)
        self._locals: list[LocalSocket] = []
        self._routers: list[Any] = []
        self._publishers: list[Any] = []
        self._failed: list[Any] = []
        self._door: Door | None = None
        self._allowed: AllowList | None = None
        self._told = ""
        self._endpoint = ExitStack()

    def __enter__(self) -> Self:
        self._context = zmq.Context(io_threads=1)
        try:
            if self._table.local:
                self._open_local()
            if self._table.prometheus is not None:
                self._endpoint.enter_context(Endpoint(self._table.prometheus, self.desk.status))
            if self._table.keys is not None:
                self._open_network(self._setup.base / self._table.keys)
        except BaseException:
            self._close()
            raise
        if self._routers or self._publishers:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(END_S)
        if self._thread.is_alive():  # it still uses the sockets; they go with the process
            return
        self._close()

    def _open_local(self) -> None:
        for suffix, kind, sockets in ((ORDERS, zmq.ROUTER, self._routers), (STATUS, zmq.PUB, self._publishers)):
            path = socket_path(self._setup.path, suffix)
            self._until_free(path)
            local = listen(path, self._table.access)
            self._locals.append(local)
            sockets.append(local_socket(self._context, kind, local))

    def _until_free(self, path: Path) -> None:
        """A daemon that is just ending gets two seconds for it, as for its state."""
        last_ns = self._clock.now_ns() + ENDING_NS
        while answers(path) and self._clock.now_ns() < last_ns:
            self._clock.sleep_until_ns(self._clock.now_ns() + BREATH_NS)

    def _open_network(self, folder: Path) -> None:
        pair, self._allowed = read_server(folder), AllowList(folder / CLIENTS)
        self._door = Door(self._context, self._allowed)
        wanted = ((self._table.tcp, zmq.ROUTER, self._routers), (self._table.tcp_status, zmq.PUB, self._publishers))
        for place, kind, sockets in wanted:
            if place is not None:
                made = network_socket(self._context, kind, place, pair)
                self._failed.append(failed_handshakes(self._context, made))
                sockets.append(made)

    def _close(self) -> None:
        self._endpoint.close()
        self._context.destroy(linger=0)
        for local in self._locals:
            local.remove()
            os.close(local.fd)
        self._locals = []

    def _work(self) -> None:
        poller = zmq.Poller()
        for socket in (*self._routers, *self._failed, *([self._door.socket] if self._door else [])):
            poller.register(socket, zmq.POLLIN)
        period_ns = round(1e9 / self._table.status_hz)
        next_ns = self._clock.now_ns()
        while not self._stop.is_set():
            left_ms = max(0, (next_ns - self._clock.now_ns()) // 1_000_000)
            ready = dict(poller.poll(min(left_ms + 1, 100)))
            if self._door is not None and self._door.socket in ready:
                self._let_in(self._door)
            for socket in self._failed:
                if socket in ready and (count := drain(socket)):
                    self.desk.tally.not_let_in += count
                    self.desk.refusal("a connection over the network without a key, or for another server's key")
            answered = [self._answer(socket) for socket in self._routers if socket in ready]
            if AT_ONCE in answered:
                self._clock.sleep_until_ns(self._clock.now_ns() + BREATH_NS)
            if self._clock.now_ns() >= next_ns:
                self._publish()
                next_ns = max(next_ns + period_ns, self._clock.now_ns())

    def _let_in(self, door: Door) -> None:
        door.serve()
        for address in door.turned_away:
            self.desk.tally.not_let_in += 1
            self.desk.refusal(f"{address}: its key is not on the list")

    def _answer(self, socket: Any) -> int:
        """Answer what waits at a socket, up to a number; give how many."""
        for k in range(AT_ONCE):
            if (incoming := receive(socket)) is None:
                return k
            peer = self._peer(socket, incoming)
            if peer is None:
                self.desk.tally.not_let_in += 1
                send(socket, incoming.line, b"", answer(None, {"refused": "this key is not on the list any more"}))
            else:
                send(socket, incoming.line, b"", self.desk.answer(incoming.content, peer))
        return AT_ONCE

    def _peer(self, socket: Any, incoming: Incoming) -> Peer | None:
        if self._table.local and socket is self._routers[0]:
            return Peer(_user(incoming.address), "operate", b"local " + incoming.line)
        found = self._allowed.find(incoming.key) if self._allowed is not None else None
        return None if found is None else Peer(found[0], found[1], incoming.key.encode() + incoming.line)

    def _publish(self) -> None:
        if self._allowed is not None and self._allowed.trouble != self._told:
            self._told = self._allowed.trouble
            self._daemon.note("control", self._told or "the list of clients can be read again")
        if not self._publishers:
            return
        message = answer(None, self.desk.status())
        for socket in self._publishers:
            send(socket, TOPIC, message)


def _user(address: str) -> str:
    """Name of the user at the other end of a local socket; libzmq tells ":uid:gid:pid"."""
    parts = address.split(":")
    with suppress(ValueError, KeyError, IndexError):
        return pwd.getpwuid(int(parts[-3])).pw_name
    return "local"


def _origin(setup: Setup) -> dict[str, Any]:
    from rtec import __version__

    return {
        "rtec_version": __version__,
        "config": str(setup.path.resolve()),
        "machine": setup.machine.name,
        "axes": list(setup.machine.axis_names),
        "rate_hz": setup.file.run.rate_hz,
        "pid": os.getpid(),
        "started": wall_clock_iso(),
    }
