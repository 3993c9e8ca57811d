"""Control of a running daemon: a thread of the supervisor's process that answers clients and publishes the status.

The loop is another process; the only effect of control on it are the orders that the supervisor passes on. Clients send
lines of JSON through a local socket, or through one that only reads the status; Prometheus reads by HTTP. A client can
be slow, dead or hostile: connections, bytes and requests are limited, no client waits for another, and a new client is
always admitted.
"""

import asyncio
import errno
import itertools
import os
import pwd
import socket
import struct
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.util import register_after_fork
from typing import Any, Final, Self

from rtec.control.desk import Daemon, Desk, Peer
from rtec.control.messages import LARGEST_REQUEST, Role, answer
from rtec.control.places import LocalSocket, answers, listen, socket_path, status_path
from rtec.control.prometheus import http_answer
from rtec.control.residual import Residual
from rtec.daemon.supervision import KeptThread
from rtec.errors import unforeseen
from rtec.loop.clock import Clock, wall_clock_iso
from rtec.loop.run_file import Setup

MOST_CONNECTIONS: Final = 256
"""To the local socket. One more closes the longest idle one of the process and user with the most connections."""
MOST_WATCHERS: Final = 64
"""Connections to the socket that only reads the status; the same rule, and none of them displaces an order."""
TELEMETRY_USER: Final = "rtec-telemetry"
"""User of the unit that is on the network: it may only read, whatever socket it reaches and group it is in."""
MOST_SCRAPES: Final = 16
"""Connections of Prometheus at a time; the same rule."""
REQUEST_NS: Final = 5_000_000
"""Shortest time, ns, between two answers, over all clients."""
CONNECTION_NS: Final = 2_000_000
"""Shortest time, ns, between two new connections."""
BURST_NS: Final = 50_000_000
"""Lead, ns, that a burst may have on that pace."""
UNPACED_REQUESTS: Final = 4
"""First requests of a connection that do not wait behind those of others: enough for an order."""
LARGEST_BUFFER: Final = 65536
"""Bytes that may wait for a client that does not read."""
SLOW_S: Final = 5.0
"""A client that does not accept its answer within this time is cut off; so is an incomplete HTTP request."""
END_S: Final = 2.0
ENDING_NS: Final = 2_000_000_000
LOOK_NS: Final = 10_000_000
HTTP_AGAIN_S: Final = 2.0
"""Period, s, of trying to listen for Prometheus."""
FULL_S: Final = 0.1
"""Wait, s, where the process has no file descriptors left."""
_CREDENTIALS: Final = struct.Struct("3i")


Serve = Callable[["Line", asyncio.StreamReader], Awaitable[None]]


@dataclass(eq=False)
class Line:
    """One connection.

    Attributes:
        socket: its socket.
        uid, pid: user and process at the other end; -1 where they are unknown.
        used_ns: instant of its last use.
        writer: its stream; None before it is served.
        peer: the client, as the desk knows it.
        task: task that serves it.
    """

    socket: socket.socket
    uid: int
    pid: int
    used_ns: int
    writer: asyncio.StreamWriter | None = None
    peer: Peer = field(default_factory=lambda: Peer("", "read"))
    task: asyncio.Task[None] | None = None

    def end(self) -> None:
        """Stop serving it."""
        if self.task is not None:
            self.task.cancel()

    def close(self) -> None:
        """Close it; data that waits for it is dropped."""
        if self.writer is not None:
            self.writer.transport.abort()
        else:
            self.socket.close()


class Pace:
    """Lets callers through one by one, at a steady pace, with some lead for bursts.

    Args:
        clock: monotonic.
        period_ns: time for one caller, ns.
    """

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self._clock, self._period_ns, self._due_ns = clock, period_ns, 0

    async def turn(self) -> None:
        """Wait for the caller's turn."""
        now_ns = self._clock.now_ns()
        self._due_ns = max(self._due_ns, now_ns) + self._period_ns
        await asyncio.sleep(max(0, self._due_ns - now_ns - BURST_NS) * 1e-9)


class Guests:
    """The connections of one listening socket, limited in number.

    Args:
        most: largest number.
    """

    def __init__(self, most: int) -> None:
        self._most, self.lines = most, list[Line]()

    def admit(self, line: Line) -> Line | None:
        """Admit one; give the one closed for it: the longest idle one, of the process and user with the most."""
        self.lines.append(line)
        if len(self.lines) <= self._most:
            return None
        users = Counter(one.uid for one in self.lines)
        processes = Counter((one.uid, one.pid) for one in self.lines)
        goes = max(
            self.lines[:-1], key=lambda one: (users[one.uid], processes[one.uid, one.pid], line.used_ns - one.used_ns)
        )
        self.lines.remove(goes)
        return goes

    def leave(self, line: Line) -> None:
        """Remove one, which may be removed already, and close it."""
        with suppress(ValueError):
            self.lines.remove(line)
        line.close()


class Control:
    """Entering opens the sockets and starts the thread; leaving ends both.

    Args:
        setup: the running setup, with `[control]`.
        daemon: the supervisor.
        clock: monotonic.

    Raises:
        RtecError: on entering: a socket cannot be opened.
    """

    def __init__(self, setup: Setup, daemon: Daemon, clock: Clock) -> None:
        self._setup, self._table, self._clock, self._daemon = setup, setup.file.control, clock, daemon
        compared = None if self._table.compared is None else setup.base / self._table.compared
        self.desk = Desk(daemon, clock, _origin(setup), Residual(compared))
        self.guests, self.watchers, self.scrapes = Guests(MOST_CONNECTIONS), Guests(MOST_WATCHERS), Guests(MOST_SCRAPES)
        self._local: LocalSocket | None = None
        self._status: LocalSocket | None = None
        self._http: socket.socket | None = None
        self._http_failed = False
        self._thread = KeptThread(daemon.parts.add("control", essential=self._table.local), self._work)
        self._end: Callable[[], object] | None = None
        self._pace = Pace(clock, REQUEST_NS)

    def listen(self) -> None:
        """Open the sockets, as entering does. A client that connects before then waits for its answer.

        Raises:
            RtecError: a socket cannot be opened; another daemon has it.
        """
        register_after_fork(self, Control._let_go)
        try:
            if self._table.local:
                path = socket_path(self._setup.path)
                self._until_free(path)
                self._local = listen(path, self._table.access)
                self._status = listen(status_path(self._setup.path), self._table.status_access)
            if self._table.prometheus is not None:
                self._listen_http(self._table.prometheus)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        if self._local is None and self._http is None:
            self.listen()
        if self._local is not None or self._table.prometheus is not None:
            self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.stop.set()
        if (end := self._end) is not None:
            with suppress(RuntimeError):  # it has ended by itself
                end()
        self._thread.end(END_S)
        self.close()

    def _let_go(self) -> None:
        """Close the sockets; a copy of this process does so, too: a loop without its supervisor must not answer."""
        for local in (self._local, self._status):
            if local is not None:
                local.socket.close()
        if self._http is not None:
            self._http.close()

    def _listen_http(self, place: str) -> None:
        """Listen for Prometheus; a failure is one event, and the correction goes on."""
        host, port = place.rsplit(":", 1)
        try:
            self._http = socket.create_server((host, int(port)))
        except OSError as e:
            hint = " (a unit without a network: systemd/network.conf)" if e.errno == errno.EAFNOSUPPORT else ""
            if not self._http_failed:
                why = f"[control] prometheus {place}: cannot listen there: {e.strerror}{hint}; tried again"
                self.desk.daemon.note("prometheus", why)
            self._http_failed = True

    async def _serve_http(self, place: str) -> None:
        while self._http is None:
            await asyncio.sleep(HTTP_AGAIN_S)
            self._listen_http(place)
        await self._accept(self._http, self.scrapes, self._scrape)

    def _until_free(self, path: Any) -> None:
        """Wait up to two seconds for a daemon that is just ending."""
        last_ns = self._clock.now_ns() + ENDING_NS
        while answers(path) and self._clock.now_ns() < last_ns:
            self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)

    def close(self) -> None:
        """Close the sockets; leaving does it, too."""
        for local in (self._local, self._status):
            if local is not None:
                local.remove()
        self._let_go()
        self._local = self._status = self._http = None

    def _work(self) -> None:
        asyncio.run(self._serve())

    async def _serve(self) -> None:
        ended = asyncio.Event()
        self._end = partial(asyncio.get_running_loop().call_soon_threadsafe, ended.set)
        if self._thread.stop.is_set():
            return
        tasks: list[asyncio.Task[Any]] = [asyncio.create_task(ended.wait())]
        if self._local is not None:
            talk = partial(self._talk, role="operate")
            tasks.append(asyncio.create_task(self._accept(self._local.socket, self.guests, talk)))
            tasks.append(asyncio.create_task(self._publish()))
        if self._status is not None:
            look = partial(self._talk, role="read")
            tasks.append(asyncio.create_task(self._accept(self._status.socket, self.watchers, look)))
        if self._table.prometheus is not None:
            tasks.append(asyncio.create_task(self._serve_http(self._table.prometheus)))
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()

    async def _accept(self, listener: socket.socket, guests: Guests, serve: Serve) -> None:
        listener.setblocking(False)
        pace = Pace(self._clock, CONNECTION_NS)
        while True:
            await pace.turn()
            try:
                accepted, _ = await asyncio.get_running_loop().sock_accept(listener)
            except OSError as e:  # no file descriptors left, or the client has gone
                self.desk.refusal(f"a connection that cannot be taken: {e.strerror}")
                await asyncio.sleep(FULL_S)
                continue
            line = Line(accepted, *_whose(accepted), self._clock.now_ns())
            if (goes := guests.admit(line)) is not None:
                self.desk.tally.not_let_in += 1
                self.desk.refusal(f"more than {len(guests.lines)} connections, most of them of {_user(goes.uid)}")
                goes.end()
            line.task = asyncio.create_task(self._serve_line(line, serve))
            line.task.add_done_callback(partial(_ended, guests, line))

    async def _serve_line(self, line: Line, serve: Serve) -> None:
        """Serve a connection to its end; a fault ends this connection and nothing else."""
        try:
            reader, line.writer = await asyncio.open_connection(sock=line.socket, limit=LARGEST_REQUEST)
            line.writer.transport.set_write_buffer_limits(LARGEST_BUFFER)
            await serve(line, reader)
        except (OSError, TimeoutError, EOFError, asyncio.LimitOverrunError):
            return  # the client has gone, or was cut off
        except Exception as e:  # noqa: BLE001 (one client's fault must not affect others)
            self.desk.refusal(unforeseen(e))

    async def _talk(self, line: Line, reader: asyncio.StreamReader, role: Role) -> None:
        user = _user(line.uid)
        line.peer = Peer(user, "read" if user == TELEMETRY_USER else role)
        for count in itertools.count():
            try:
                message = await reader.readuntil(b"\n")
            except asyncio.LimitOverrunError:
                message = b" " * (LARGEST_REQUEST + 1)
            if count >= UNPACED_REQUESTS:
                await self._pace.turn()
            line.used_ns = self._clock.now_ns()
            await self._send(line, self.desk.answer(message, line.peer) + b"\n")
            if len(message) > LARGEST_REQUEST:
                return

    async def _scrape(self, line: Line, reader: asyncio.StreamReader) -> None:
        async with asyncio.timeout(SLOW_S):
            head = await reader.readuntil(b"\r\n\r\n")
        await self._pace.turn()
        await self._send(line, http_answer(head, self.desk.status))
        if line.writer is not None:
            line.writer.write_eof()
            async with asyncio.timeout(SLOW_S):
                await reader.read(1)  # until the client has read all of it and closes

    async def _send(self, line: Line, text: bytes) -> None:
        if line.writer is not None:
            line.writer.write(text)
            async with asyncio.timeout(SLOW_S):
                await line.writer.drain()

    async def _publish(self) -> None:
        """Send the status to the clients that watch; skip a client that has not read the last one."""
        while True:
            await asyncio.sleep(1.0 / self._table.status_hz)
            lines = (*self.guests.lines, *self.watchers.lines)
            watching = [one for one in lines if one.peer.watches and one.writer is not None]
            if not watching:
                continue
            try:
                text = answer(None, self.desk.status()) + b"\n"
            except Exception as e:  # noqa: BLE001 (orders get through all the same)
                self.desk.refusal(unforeseen(e))
                continue
            for line in watching:
                if line.writer is not None and line.writer.transport.get_write_buffer_size() == 0:
                    line.writer.write(text)
                    line.used_ns = self._clock.now_ns()


def _ended(guests: Guests, line: Line, task: asyncio.Task[None]) -> None:
    del task
    guests.leave(line)


def _whose(accepted: socket.socket) -> tuple[int, int]:
    """User and process at the other end of a local socket."""
    if accepted.family != socket.AF_UNIX:
        return -1, -1
    pid, uid, _ = _CREDENTIALS.unpack(accepted.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return uid, pid


def _user(uid: int) -> str:
    with suppress(KeyError):
        return pwd.getpwuid(uid).pw_name
    return "local" if uid < 0 else f"user {uid}"


def _origin(setup: Setup) -> dict[str, Any]:
    from rtec.version import __version__

    return {
        "rtec_version": __version__,
        "config": str(setup.path.resolve()),
        "machine": setup.machine.name,
        "axes": list(setup.machine.axis_names),
        "sensors": list(setup.machine.sensor_names),
        "rate_hz": setup.file.run.rate_hz,
        "actuator": setup.file.role.actuator is not None,
        "tables": {key: str(path) for key, path in setup.file.table.files.items()} if setup.file.table else {},
        "pid": os.getpid(),
        "started": wall_clock_iso(),
    }
