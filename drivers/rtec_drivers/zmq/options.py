"""What a run file may say of a ZeroMQ link, and its keys."""

import ipaddress
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import ConfigError
from rtec.quantities import Counts, MicrometresPositive, MillimetresPerSecond, SecondsPositive
from rtec.tomlfile import Strict

TCP = re.compile(r"tcp://(?P<host>\[[0-9a-fA-F:.]+\]|[^:/\[\]]+):(?P<port>\d{1,5})")
IPC = re.compile(r"ipc://.+")


class ZmqOptions(Strict):
    """Options of a link to another process by ZeroMQ.

    Attributes:
        state: where the other process publishes, `tcp://host:port` or `ipc://path`.
        command: where it takes commands; not given: it is no actuator.
        actuator, unit_um: which kind of output it takes, by the name of the sink; one unit of it, for those that do not
            count pulses.
        clock: "shared": the other process' instants are of this computer's monotonic clock; "own": of any other
            clock, which is then compared with this one by the quickest messages of the last minute.
        max_speed_mm_s: highest speed of each axis; needed where it gives counts; faster ones are refused.
        server_key_file: public key of the other process, as made by `zmq.auth.create_certificates`. Needed where the
            link leaves this computer.
        own_key_file: this side's secret key; readable by its owner only.
        at_start: "required": the run does not begin without a first message; "later": it may come any time.
        open_timeout_s: longest wait for that first message.
        silent_s: so long without a message is told.
        command_timeout_s: so long may a command stay without an answer before that is told.
        resume_step: the first command may differ from the output that the other process has by at most this.
        stuck_after_s: as for other sensors: a temperature that stands still for so long is told. Not set: never.
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
    stuck_after_s: SecondsPositive | None = None

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
    """Does an address lead out of this computer? Only what surely does not counts as inside."""
    match = TCP.fullmatch(address)
    if match is None:
        return False
    host = match["host"].strip("[]")
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host != "localhost"


def load_keys(options: ZmqOptions, base: Path) -> Keys | None:
    """Read the keys; None where the options name none.

    Raises:
        ConfigError: a file is missing, is no key, or the secret one may be read by others.
    """
    if options.server_key_file is None or options.own_key_file is None:
        return None
    server, _ = _certificate(base / options.server_key_file)
    own = base / options.own_key_file
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
