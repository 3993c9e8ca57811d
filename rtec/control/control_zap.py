"""Says to libzmq which keys are let in (ZAP, ZeroMQ RFC 27); with none of this, CURVE lets in anybody with any key."""

from typing import Any, Final

import zmq
from zmq.utils import z85

from rtec.control.keys import AllowList

ADDRESS: Final = "inproc://zeromq.zap.01"
_VERSION: Final = b"1.0"
_FRAMES: Final = 7
"""Of a request with CURVE: version, id, domain, address, routing id, mechanism, key."""


class Door:
    """Answers libzmq's questions about new connections; bind it before the first socket that asks.

    Args:
        context: of the sockets that ask.
        allowed: who is let in.

    Attributes:
        socket: to be polled; `serve` when something is there.
        turned_away: addresses that were not let in since `serve` was called the last time.
    """

    def __init__(self, context: Any, allowed: AllowList) -> None:
        self.socket: Any = context.socket(zmq.ROUTER)
        self.socket.linger = 0
        self.socket.bind(ADDRESS)
        self.turned_away: list[str] = []
        self._allowed = allowed

    def serve(self) -> None:
        """Answer every question that waits."""
        self.turned_away = []
        while True:
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
                at = frames.index(b"") + 1
                self.socket.send_multipart([*frames[:at], *self._judge(frames[at:])], zmq.NOBLOCK)
            except zmq.Again:
                return

    def _judge(self, frames: list[bytes]) -> list[bytes]:
        """Let in with the public key as user id, or not."""
        request_id = frames[1] if len(frames) > 1 else b""
        if len(frames) == _FRAMES and frames[0] == _VERSION and frames[5] == b"CURVE" and len(frames[6]) == 32:
            key = z85.encode(frames[6])
            if self._allowed.find(key.decode()) is not None:
                return [_VERSION, request_id, b"200", b"", key, b""]
        self.turned_away.append(frames[3].decode(errors="replace") if len(frames) > 3 else "?")
        return [_VERSION, request_id, b"400", b"this key is not on the list", b"", b""]
