"""The address of the pages, which accepts connections at once, with the key of this start.

The browser may open before the server answers: it waits at the open port.
"""

import secrets
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rtec.errors import RtecError

PAGES: Final = {
    "measurements": "Measurements",
    "compare": "Compare",
    "diagnose": "Diagnose",
    "add": "Add and watch",
    "explore": "Explore",
    "live": "Live",
    "report": "Report",
}
"""Title of each page, by its name in the address."""
BESIDE: Final = ("import",)
"""Pages that are opened from another page, not from the list."""


@dataclass(frozen=True)
class Address:
    """Address of the pages.

    Attributes:
        host, port: the requested ones; port 0 takes a free one.
        token: the key of this start.
        certificate, key: files for TLS; None: without TLS.
    """

    host: str
    port: int
    token: str
    certificate: Path | None = None
    key: Path | None = None


@dataclass(frozen=True)
class OpenPort:
    """An address that accepts connections.

    Attributes:
        address: the requested address.
        socket: the listening socket.
    """

    address: Address
    socket: socket.socket

    @property
    def port(self) -> int:
        """Port of the listening socket."""
        return int(self.socket.getsockname()[1])

    @property
    def url(self) -> str:
        """The whole address with the key."""
        a = self.address
        host = f"[{a.host}]" if ":" in a.host else a.host
        return f"{'https' if a.certificate else 'http'}://{host}:{self.port}/?token={a.token}"


def new_token() -> str:
    """A random key."""
    return secrets.token_urlsafe(24)


def open_port(address: Address) -> OpenPort:
    """Listen at an address.

    Raises:
        RtecError: the address cannot be used, or the files for TLS cannot be used.
    """
    host, port = address.host, address.port
    if address.certificate is not None:
        _check_tls(address.certificate, address.key)
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        made.bind((host, port))
        made.listen()
    except OSError as e:
        made.close()
        raise RtecError(f"{host}:{port}: cannot be listened at: {e.strerror}; name another with --host, --port") from e
    return OpenPort(address, made)


def _check_tls(certificate: Path, key: Path | None) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as e:
        raise RtecError(f"{certificate}, {key}: are no certificate with its key in PEM: {e}") from e
