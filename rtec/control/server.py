"""Control of a running daemon: a thread of the supervisor's process that answers clients and publishes the status.

The loop is another process; all that it ever sees of this are the orders that the supervisor hands on. Clients speak
lines of JSON through a local socket, or through one that only shows the status; Prometheus asks by HTTP. A client can
be slow, dead or hostile: connections, bytes and requests are limited, nobody waits for anybody, and a new client always
finds room.
"""

import asyncio
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
from rtec.errors import ConfigError, unforeseen
from rtec.loop.clock import Clock, wall_clock_iso
from rtec.loop.run_file import Setup

MOST_CONNECTIONS: Final = 256
"""To the local socket. One more, and the one that has been idle for longest is closed, of whoever has most."""
MOST_WATCHERS: Final = 64
"""Connections to the socket that only shows the status; the same rule, and none of them takes the place of an order."""
TELEMETRY_USER: Final = "rtec-telemetry"
"""Of the unit that talks to the network: may read, whichever socket it reaches and whatever group it is in."""
MOST_SCRAPES: Final = 16
"""Connections of Prometheus at a time; the same rule."""
REQUEST_NS: Final = 5_000_000
"""Requests of all clients together are answered no faster than this, one behind the other."""
CONNECTION_NS: Final = 2_000_000
"""So are new connections taken."""
BURST_NS: Final = 50_000_000
"""So far ahead of that pace may they be."""
AT_ONCE: Final = 4
"""The first requests of a connection do not wait behind those of others: enough for an order."""
LARGEST_BUFFER: Final = 65536
"""Bytes that wait for a client that does not read."""
SLOW_S: Final = 5.0
"""A client that does not take its answer within this time is cut off; so is an HTTP request that is not whole."""
END_S: Final = 2.0
ENDING_NS: Final = 2_000_000_000
LOOK_NS: Final = 10_000_000
FULL_S: Final = 0.1
"""Rest where the process has no file descriptors left."""
_CREDENTIALS: Final = struct.Struct("3i")


Serve = Callable[["Line", asyncio.StreamReader], Awaitable[None]]


@dataclass(eq=False)
class Line:
    """One connection.

    Attributes:
        socket: of it.
        uid, pid: user and process at the other end; -1 where the kernel does not say.
        used_ns: when it was last of use.
        writer: its stream; None before it is served.
        peer: what the desk knows of it.
        task: serves it.
    """

    socket: socket.socket
    uid: int
    pid: int
    used_ns: int
    writer: asyncio.StreamWriter | None = None
    peer: Peer = field(default_factory=lambda: Peer("", "read"))
    task: asyncio.Task[None] | None = None

    def end(self) -> None:
        """Have it served no more."""
        if self.task is not None:
            self.task.cancel()

    def close(self) -> None:
        """Close it; what waits for it is thrown away."""
        if self.writer is not None:
            self.writer.transport.abort()
        else:
            self.socket.close()


class Pace:
    """Lets one after the other through, at a steady pace, with some grace.

    Args:
        clock: monotonic.
        period_ns: of one.
    """

    def __init__(self, clock: Clock, period_ns: int) -> None:
        self._clock, self._period_ns, self._due_ns = clock, period_ns, 0

    async def turn(self) -> None:
        """Wait for one's turn."""
        now_ns = self._clock.now_ns()
        self._due_ns = max(self._due_ns, now_ns) + self._period_ns
        await asyncio.sleep(max(0, self._due_ns - now_ns - BURST_NS) * 1e-9)


class Guests:
    """The connections of one listening socket, never more than a number.

    Args:
        most: that number.
    """

    def __init__(self, most: int) -> None:
        self._most, self.lines = most, list[Line]()

    def admit(self, line: Line) -> Line | None:
        """Take one in; give the one that has to go for it: idle for longest, of the process and user with most."""
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
        """Forget one, which may have had to go already, and close it."""
        with suppress(ValueError):
            self.lines.remove(line)
        line.close()


class Control:
    """Entering opens the sockets and starts the thread, leaving ends both.

    Args:
        setup: what runs; its `[control]` says where.
        daemon: the supervisor.
        clock: monotonic.

    Raises:
        RtecError: on entering: a socket cannot be had.
    """

    def __init__(self, setup: Setup, daemon: Daemon, clock: Clock) -> None:
        self._setup, self._table, self._clock, self._daemon = setup, setup.file.control, clock, daemon
        compared = None if self._table.compared is None else setup.base / self._table.compared
        self.desk = Desk(daemon, clock, _origin(setup), Residual(compared))
        self.guests, self.watchers, self.scrapes = Guests(MOST_CONNECTIONS), Guests(MOST_WATCHERS), Guests(MOST_SCRAPES)
        self._local: LocalSocket | None = None
        self._status: LocalSocket | None = None
        self._http: socket.socket | None = None
        self._thread = KeptThread(daemon.parts.add("control", essential=self._table.local), self._work)
        self._end: Callable[[], object] | None = None
        self._pace = Pace(clock, REQUEST_NS)

    def listen(self) -> None:
        """Open the sockets, as entering does. Whoever connects before that waits for an answer.

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
                self._http = _loopback(self._table.prometheus)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        if self._local is None and self._http is None:
            self.listen()
        if self._local is not None or self._http is not None:
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
        """Close the sockets. A copy of this process does it, too: a loop without its supervisor must not answer."""
        for local in (self._local, self._status):
            if local is not None:
                local.socket.close()
        if self._http is not None:
            self._http.close()

    def _until_free(self, path: Any) -> None:
        """A daemon that is just ending gets two seconds for it, as for its state."""
        last_ns = self._clock.now_ns() + ENDING_NS
        while answers(path) and self._clock.now_ns() < last_ns:
            self._clock.sleep_until_ns(self._clock.now_ns() + LOOK_NS)

    def close(self) -> None:
        """Give the sockets back; leaving does it."""
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
        if self._http is not None:
            tasks.append(asyncio.create_task(self._accept(self._http, self.scrapes, self._scrape)))
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
            except OSError as e:  # out of files, or whoever came has left
                self.desk.refusal(f"a connection that cannot be taken: {e.strerror}")
                await asyncio.sleep(FULL_S)
                continue
            line = Line(accepted, *_whose(accepted), self._clock.now_ns())
            if (goes := guests.admit(line)) is not None:
                self.desk.tally.not_let_in += 1
                self.desk.refusal(f"more than {len(guests.lines)} connections, most of them of {_user(goes.uid)}")
                goes.end()
            line.task = asyncio.create_task(self._serve_line(line, serve))
            line.task.add_done_callback(partial(_left, guests, line))

    async def _serve_line(self, line: Line, serve: Serve) -> None:
        """Serve a connection to its end; whatever goes wrong with it ends it and nothing else."""
        try:
            reader, line.writer = await asyncio.open_connection(sock=line.socket, limit=LARGEST_REQUEST)
            line.writer.transport.set_write_buffer_limits(LARGEST_BUFFER)
            await serve(line, reader)
        except (OSError, TimeoutError, EOFError, asyncio.LimitOverrunError):
            return  # it left, or is cut off
        except Exception as e:  # noqa: BLE001 (one client's fault is no other's)
            self.desk.refusal(unforeseen(e))

    async def _talk(self, line: Line, reader: asyncio.StreamReader, role: Role) -> None:
        user = _user(line.uid)
        line.peer = Peer(user, "read" if user == TELEMETRY_USER else role)
        for count in itertools.count():
            try:
                message = await reader.readuntil(b"\n")
            except asyncio.LimitOverrunError:
                message = b" " * (LARGEST_REQUEST + 1)
            if count >= AT_ONCE:
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
                await reader.read(1)  # until it has taken all of it and hangs up

    async def _send(self, line: Line, text: bytes) -> None:
        if line.writer is not None:
            line.writer.write(text)
            async with asyncio.timeout(SLOW_S):
                await line.writer.drain()

    async def _publish(self) -> None:
        """Send the status to those who watch; one that has not taken the last one is passed over."""
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


def _left(guests: Guests, line: Line, task: asyncio.Task[None]) -> None:
    del task
    guests.leave(line)


def _loopback(place: str) -> socket.socket:
    host, port = place.rsplit(":", 1)
    try:
        return socket.create_server((host, int(port)))
    except OSError as e:
        raise ConfigError(f"[control] prometheus {place}: cannot listen there: {e.strerror}") from e


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
        "pid": os.getpid(),
        "started": wall_clock_iso(),
    }
