"""The daemon's ZeroMQ sockets: made so that nothing that goes on at the other end can make it wait or grow."""

import os
from dataclasses import dataclass
from typing import Any, Final

import zmq

from rtec.control.keys import Pair
from rtec.control.messages import LARGEST_REQUEST
from rtec.control.places import LocalSocket
from rtec.errors import ConfigError

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
