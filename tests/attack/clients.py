"""Hostile clients of a running daemon: `python -m tests.attack.clients NAME SOCKET HTTP SECONDS`, each a process.

Nothing here shares code with the daemon. Whatever the daemon does (hangs up, refuses), the client goes on until its
time is over.
"""

import json
import os
import random
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from rtec.loop.clock import RealClock

STATUS: Final = b'{"schema":1,"ask":"status"}\n'
CLOCK: Final = RealClock()
Going = Callable[[], bool]


def _line(path: str) -> socket.socket:
    made = socket.socket(socket.AF_UNIX)
    made.connect(path)
    made.settimeout(0.05)
    return made


def _http(place: str) -> socket.socket:
    host, port = place.rsplit(":", 1)
    made = socket.create_connection((host, int(port)), timeout=1.0)
    made.settimeout(0.05)
    return made


def idle(path: str, place: str, going: Going) -> None:
    """1100 connections that say nothing; each that is closed is opened again."""
    del place
    kept: list[socket.socket] = []
    while going():
        kept = [*kept[-1099:], _line(path)]


def half_open(path: str, place: str, going: Going) -> None:
    """Half a request, byte by byte, on many connections."""
    del place
    kept = [_line(path) for _ in range(200)]
    while going():
        for k, made in enumerate(kept):
            try:
                made.send(STATUS[:1])
            except OSError:
                kept[k] = _line(path)


def garbage(path: str, place: str, going: Going) -> None:
    """Random bytes, with and without ends of lines."""
    del place
    rng = random.Random(1)
    while going():
        with _line(path) as made:
            for _ in range(100):
                made.sendall(rng.randbytes(rng.randrange(1, 5000)))


def endless(path: str, place: str, going: Going) -> None:
    """A request that never ends."""
    del place
    while going():
        with _line(path) as made:
            while going():
                made.sendall(b"x" * 65536)


def requests(path: str, place: str, going: Going) -> None:
    """As many requests as go in, on 64 connections; no answer is ever read."""
    del place
    kept = [_line(path) for _ in range(64)]
    while going():
        for k, made in enumerate(kept):
            try:
                made.sendall(STATUS * 200)
            except TimeoutError:
                continue
            except OSError:
                kept[k] = _line(path)


def asking(path: str, place: str, going: Going) -> None:
    """As many requests as are answered, on 64 connections; every answer is read."""
    del place
    kept = [_line(path) for _ in range(64)]
    while going():
        for k, made in enumerate(kept):
            try:
                made.sendall(STATUS)
                made.recv(65536)
            except TimeoutError:
                continue
            except OSError:
                kept[k] = _line(path)


def connections(path: str, place: str, going: Going) -> None:
    """Come and go as fast as it goes."""
    del place
    while going():
        _line(path).close()


def watchers(path: str, place: str, going: Going) -> None:
    """Two hundred that want every status and read none."""
    del place
    kept = [_line(path) for _ in range(200)]
    for made in kept:
        made.sendall(b'{"schema":1,"ask":"watch"}\n')
    while going():
        CLOCK.sleep_until_ns(CLOCK.now_ns() + 10_000_000)


def replayed(path: str, place: str, going: Going) -> None:
    """An order that was good, again and with every bit flipped in turn, over its own connection and over others."""
    del place
    with _line(path) as own:
        own.settimeout(5.0)
        own.sendall(b'{"schema":1,"ask":"session"}\n')
        session = json.loads(own.makefile().readline())["session"]
        order = json.dumps({"schema": 1, "ask": "order", "session": session, "seq": 1, "order": "mark", "text": "once"})
        own.sendall(order.encode() + b"\n")
        own.settimeout(0.01)
        at = 0
        while going():
            bad = bytearray(order.encode())
            bad[at // 8 % len(bad)] ^= 1 << at % 8
            for made, text in ((own, order.encode()), (_line(path), order.encode()), (_line(path), bytes(bad))):
                with suppress(OSError):
                    made.sendall(text + b"\n")
                    made.recv(65536)
            at += 1


def dying(path: str, place: str, going: Going) -> None:
    """Processes that are killed in the middle of a request."""
    del place
    while going():
        if (pid := os.fork()) == 0:
            try:
                made = _line(path)
                made.sendall(STATUS + STATUS[:9])
            finally:
                os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(pid, 0)


def scrapes(path: str, place: str, going: Going) -> None:
    """Slow, endless and half requests to the page for Prometheus."""
    del path
    kept = [_http(place) for _ in range(64)]
    while going():
        for k, made in enumerate(kept):
            try:
                made.sendall(b"GET /metrics HTTP/1.1\r\nX: y" if k % 2 else b"x" * 10_000)
            except OSError:
                with suppress(OSError):
                    kept[k] = _http(place)


ATTACKS: Final[dict[str, Callable[[str, str, Going], None]]] = {
    "1100 idle connections": idle,
    "half requests": half_open,
    "garbage": garbage,
    "requests without an end": endless,
    "requests, answers unread": requests,
    "requests, answers read": asking,
    "connections that come and go": connections,
    "watchers that do not read": watchers,
    "orders replayed and bit-flipped": replayed,
    "clients killed while they ask": dying,
    "slow scrapes": scrapes,
}


def main(name: str, path: str, place: str, seconds: float) -> None:
    """Attack for so long, whatever happens."""
    end_ns = CLOCK.now_ns() + round(seconds * 1e9)

    def going() -> bool:
        return CLOCK.now_ns() < end_ns

    while going():
        with suppress(OSError, ValueError):  # thrown out: again
            ATTACKS[name](path, place, going)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], float(sys.argv[4]))
