"""`[control]` of a run file: who may ask the daemon how it goes, and order it about, and where."""

import re
from pathlib import Path
from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from rtec.tomlfile import Strict

PLACE: Final = re.compile(r"(?P<host>\[[0-9a-fA-F:.]+\]|\*|[^:/\[\]\s]+):(?P<port>\d{1,5})")
LOOPBACK: Final = re.compile(r"(127\.\d{1,3}\.\d{1,3}\.\d{1,3}|localhost):\d{1,5}")


class ControlTable(Strict):
    """Sockets of the daemon. The local ones are files beside the state; what leaves them needs keys.

    Attributes:
        local: answer on this computer, by a socket that file permissions guard.
        access: who may use it: "user" (the one that the daemon runs as, and root) or "group" (its group, too).
        status_hz: how often the status is published.
        tcp: "host:port" at which clients with a key are answered; not given: nothing listens on the network.
        tcp_status: "host:port" at which the status is published to clients with a key.
        keys: folder made by `rtec keys server`; needed with `tcp` or `tcp_status`.
        prometheus: "host:port" of this computer at which Prometheus reads figures; not given: nothing listens.
        compared: file with what `rtec compare --json` printed last; what it says is left stands in the status.
    """

    local: bool = True
    access: Literal["user", "group"] = "user"
    status_hz: Annotated[float, Field(ge=0.1, le=50)] = 10.0
    tcp: str | None = None
    tcp_status: str | None = None
    keys: Path | None = None
    prometheus: str | None = None
    compared: Path | None = None

    @model_validator(mode="after")
    def _places(self) -> Self:
        for name, place in (("tcp", self.tcp), ("tcp_status", self.tcp_status), ("prometheus", self.prometheus)):
            if not isinstance(place, str):
                continue
            match = PLACE.fullmatch(place)
            if match is None or not 0 < int(match["port"]) < 65536:
                raise ValueError(f'{name}: {place!r} is not "host:port"')
            if self.keys is None and name != "prometheus":
                raise ValueError(f"{name} needs keys: make them with `rtec keys server FOLDER`, name the folder here")
        if self.tcp is not None and self.tcp == self.tcp_status:
            raise ValueError("tcp and tcp_status need different ports")
        if self.prometheus is not None and not LOOPBACK.fullmatch(self.prometheus):
            raise ValueError(
                f'prometheus: {self.prometheus!r} is not "127.0.0.1:PORT" or "localhost:PORT": it asks for no key, '
                "so it stays on the loopback"
            )
        return self
