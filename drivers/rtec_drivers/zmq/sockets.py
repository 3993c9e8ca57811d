"""The two sockets of the ZeroMQ link; nothing here waits, but for `wait`."""

from collections import deque
from typing import Any

from rtec.errors import DriverTimeout, DriverUnavailable
from rtec_drivers.zmq.message import TOPIC
from rtec_drivers.zmq.options import Keys, ZmqOptions

QUEUED = 256
READ_AT_ONCE = 16
LARGEST_MESSAGE = 65536
RECONNECT_MS = 100
"""Between two attempts of libzmq, at first; it doubles up to twenty times this."""


class Sockets:
    """Subscriber and dealer, connected; libzmq connects again by itself, at growing distances.

    Raises:
        DriverUnavailable: pyzmq is not there, or an address cannot be used.
    """

    def __init__(self, options: ZmqOptions, keys: Keys | None) -> None:
        try:
            import zmq
        except ImportError as e:
            raise DriverUnavailable(f"pyzmq is not installed: {e}") from e
        self._zmq = zmq
        self._context: Any = zmq.Context()
        try:
            self._state = self._socket(zmq.SUB, keys)
            self._state.setsockopt(zmq.SUBSCRIBE, TOPIC)
            self._state.connect(options.state)
            self._command = None
            if options.command is not None:
                self._command = self._socket(zmq.DEALER, keys)
                self._command.setsockopt(zmq.IMMEDIATE, 1)  # nothing is kept for a process that is not there
                self._command.connect(options.command)
        except zmq.ZMQError as e:
            self.close()
            raise DriverUnavailable(f"{options.state}: {e}") from e

    def close(self) -> None:
        """Close both, and the threads behind them."""
        self._context.destroy(linger=0)

    def wait(self, timeout_s: float) -> bool:
        """Wait for a state, for at most so long."""
        return bool(self._state.poll(round(timeout_s * 1e3)))

    def states(self) -> list[bytes]:
        """The newest states that have come, oldest first; of a flood the older ones are left out."""
        out: deque[bytes] = deque(maxlen=READ_AT_ONCE)
        for _ in range(QUEUED):
            try:
                frames = self._state.recv_multipart(self._zmq.NOBLOCK)
            except self._zmq.Again:
                break
            out.append(frames[1] if len(frames) == 2 and frames[0] == TOPIC else b"")
        return list(out)

    def answers(self) -> list[bytes]:
        """Answers to commands that have come."""
        out: list[bytes] = []
        while self._command is not None and len(out) < READ_AT_ONCE:
            try:
                out.append(self._command.recv_multipart(self._zmq.NOBLOCK)[-1])
            except self._zmq.Again:
                break
        return out

    def send(self, message: bytes) -> None:
        """Send a command.

        Raises:
            DriverTimeout: nobody is connected, or nobody takes any.
        """
        if self._command is None:
            raise DriverUnavailable("no address for commands (key 'command')")
        try:
            self._command.send(message, self._zmq.NOBLOCK)
        except self._zmq.Again as e:
            raise DriverTimeout("nobody takes commands") from e

    def _socket(self, kind: int, keys: Keys | None) -> Any:
        zmq = self._zmq
        socket = self._context.socket(kind)
        socket.setsockopt(zmq.RCVHWM, QUEUED)
        socket.setsockopt(zmq.SNDHWM, READ_AT_ONCE)
        socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_MESSAGE)
        socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        socket.setsockopt(zmq.RECONNECT_IVL_MAX, 20 * RECONNECT_MS)
        socket.setsockopt(zmq.HEARTBEAT_IVL, 1000)
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, 3000)
        if keys is not None:
            socket.curve_serverkey = keys.server
            socket.curve_publickey, socket.curve_secretkey = keys.public, keys.secret
        return socket
