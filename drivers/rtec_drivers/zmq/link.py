"""The two sockets of a ZeroMQ link and the keys that protect them; only `wait` waits."""

import ipaddress
import re
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import ConfigError, DriverTimeout, DriverUnavailable
from rtec.files import beside
from rtec.quantities import Counts, MicrometresPositive, MillimetresPerSecond, SecondsPositive
from rtec.tomlfile import Strict
from rtec_drivers.zmq.message import TOPIC

TCP = re.compile(r"tcp://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/\[\]]+):(?P<port>\d{1,5})")
IPC = re.compile(r"ipc://.+")


class ZmqOptions(Strict):
    """Options of a link to another process by ZeroMQ.

    Attributes:
        state: address at which the other process publishes, `tcp://host:port` or `ipc://path`.
        command: address at which it accepts commands; not given: it is no actuator.
        actuator: kind of output that it accepts, by the name of the sink.
        unit_um: one unit of output, µm, for kinds that do not count pulses.
        clock: "shared": the other process' instants are those of this computer's monotonic clock; "own": of any other
            clock, which is then compared with this one by the fastest messages of the last minute.
        max_speed_mm_s: highest speed of each axis; needed where it gives counts; faster counts are refused.
        server_key_file: public key of the other process, as made by `zmq.auth.create_certificates`. Required where the
            link leaves this computer.
        own_key_file: this side's secret key; readable by its owner only.
        at_start: "required": the run does not begin without a first message; "later": it may come at any time.
        open_timeout_s: longest wait for that first message.
        silent_s: a silence of this time is reported.
        command_timeout_s: longest time without an answer to a command before that is reported.
        resume_step: the first command may differ from the output that the other process has by at most this.
        stuck_after_s: a temperature that is constant to its last digit for this time is not used.
    """

    state: str
    command: str | None = None
    actuator: Literal["pulse", "following_error", "phase", "origin_offset"] = "pulse"
    unit_um: MicrometresPositive = 1.0
    clock: Literal["shared", "own"] = "own"
    max_speed_mm_s: dict[str, MillimetresPerSecond] = Field(default_factory=dict)
    server_key_file: Path | None = None
    own_key_file: Path | None = None
    at_start: Literal["required", "later"] = "required"
    open_timeout_s: Annotated[float, Field(ge=1e-3, le=30)] = 3.0
    silent_s: Annotated[float, Field(ge=1e-3, le=3600)] = 1.0
    command_timeout_s: Annotated[float, Field(ge=1e-4, le=60)] = 0.1
    resume_step: Counts = 16
    stuck_after_s: SecondsPositive = 3600.0

    @model_validator(mode="after")
    def _addresses(self) -> Self:
        keys = (self.server_key_file, self.own_key_file)
        if (keys[0] is None) != (keys[1] is None):
            raise ValueError("server_key_file and own_key_file belong together; give both or none")
        for name, address in (("state", self.state), ("command", self.command)):
            if address is None:
                continue
            if not TCP.fullmatch(address) and not IPC.fullmatch(address):
                raise ValueError(f"{name}: {address!r} is neither tcp://host:port nor ipc://path")
            if keys[0] is None and leaves_computer(address):
                raise ValueError(
                    f"{name}: {address!r} leaves this computer: give server_key_file and own_key_file, so that nobody "
                    "else can listen or command"
                )
        return self


@dataclass(frozen=True)
class Keys:
    """CURVE keys, 40 characters each: of the other process, and this side's two."""

    server: bytes
    public: bytes
    secret: bytes


def leaves_computer(address: str) -> bool:
    """Does an address lead out of this computer? Only an address that certainly does not counts as inside."""
    match = TCP.fullmatch(address)
    if match is None:
        return False
    host = match["host"].strip("[]")
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def load_keys(options: ZmqOptions, base: Path) -> Keys | None:
    """Read the keys; None where the options have none.

    Raises:
        ConfigError: a file is missing, is no key, or the secret one is readable by others.
    """
    if options.server_key_file is None or options.own_key_file is None:
        return None
    server, _ = _certificate(beside(base, options.server_key_file))
    own = beside(base, options.own_key_file)
    public, secret = _certificate(own)
    if secret is None:
        raise ConfigError(f"own_key_file: {own} holds no secret key; the file that does ends in .key_secret")
    if own.stat().st_mode & 0o077:
        raise ConfigError(f"own_key_file: {own} may be read by others; chmod 600 it")
    return Keys(server, public, secret)


def _certificate(path: Path) -> tuple[bytes, bytes | None]:
    from zmq.auth import load_certificate

    try:
        return load_certificate(path)
    except (OSError, ValueError) as e:
        raise ConfigError(f"{path}: cannot be read as a key: {e}") from e


QUEUED = 256
READ_AT_ONCE = 16
LARGEST_MESSAGE = 65536
RECONNECT_MS = 100
"""First wait of libzmq between two attempts, ms; it doubles up to twenty times this."""


class Sockets:
    """Subscriber and dealer, connected; libzmq reconnects by itself, with growing waits.

    It does not after a message larger than `LARGEST_MESSAGE`: then `reconnect` does.

    Raises:
        DriverUnavailable: pyzmq is not installed, or an address cannot be used.
    """

    def __init__(self, options: ZmqOptions, keys: Keys | None) -> None:
        try:
            import zmq
        except ImportError as e:
            raise DriverUnavailable(f"pyzmq is not installed: {e}") from e
        self._zmq, self._options = zmq, options
        self._context: Any = zmq.Context()
        try:
            self._state = self._socket(zmq.SUB, keys)
            self._state.setsockopt(zmq.SUBSCRIBE, TOPIC)
            self._state.connect(options.state)
            self._command = None
            if options.command is not None:
                self._command = self._socket(zmq.DEALER, keys)
                self._command.setsockopt(zmq.IMMEDIATE, 1)  # nothing is queued for a process that is not connected
                self._command.connect(options.command)
        except zmq.ZMQError as e:
            self.close()
            raise DriverUnavailable(f"{options.state}: {e}") from e

    def close(self) -> None:
        """Close both, and the threads behind them."""
        self._context.destroy(linger=0)

    def reconnect(self) -> None:
        """Connect both again; does not wait. libzmq leaves a peer for good whose message was too large."""
        for socket, address in ((self._state, self._options.state), (self._command, self._options.command)):
            if socket is not None:
                with suppress(self._zmq.ZMQError):  # it has left that address already
                    socket.disconnect(address)
                socket.connect(address)

    def wait(self, timeout_s: float) -> bool:
        """Wait for a state, for at most that time."""
        return bool(self._state.poll(round(timeout_s * 1e3)))

    def states(self) -> list[bytes]:
        """The newest received states, oldest first; of a flood the older ones are dropped."""
        out: deque[bytes] = deque(maxlen=READ_AT_ONCE)
        for _ in range(QUEUED):
            try:
                frames = self._state.recv_multipart(self._zmq.NOBLOCK)
            except self._zmq.Again:
                break
            out.append(frames[1] if len(frames) == 2 and frames[0] == TOPIC else b"")
        return list(out)

    def answers(self) -> list[bytes]:
        """The received answers to commands."""
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
            DriverTimeout: no process is connected, or none accepts commands.
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
