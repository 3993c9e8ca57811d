"""Keys for control over the network: CURVE key pairs, and the list of clients that are let in, with their roles.

A key folder holds `server.key` (the daemon's two keys, readable by its owner only) and `clients.toml` (the list).
A client's own file holds its two keys and the daemon's public one; it goes to the client's computer and nowhere else.

Says to libzmq which keys are let in (ZAP, ZeroMQ RFC 27); with none of this, CURVE lets in anybody with any key.
"""

import os
import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import tomli_w
import zmq
from pydantic import Field
from zmq.utils import z85

from rtec.control.desk import Role
from rtec.errors import ConfigError
from rtec.tomlfile import Strict, nearest, read_toml, validated

SERVER, CLIENTS = "server.key", "clients.toml"
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")
Z85: Final = r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}"
Key = Annotated[str, Field(pattern=f"^{Z85}$")]


class Pair(Strict):
    """`server.key`: Z85 texts of 40 characters, as ZeroMQ writes them."""

    public: Key
    secret: Key


class ClientKeys(Pair):
    """A client's own file: its two keys, and the public key of the daemon that it knows the daemon by."""

    server: Key


P = TypeVar("P", bound=Pair)


class Client(Strict):
    """One client on the list: its public key, and what it may."""

    key: Key
    role: Role


class Clients(Strict):
    """`clients.toml`: who is let in, by name."""

    client: dict[str, Client] = Field(default_factory=dict)


class AllowList:
    """The list as it stands in its file now; whoever is taken off it is refused from that instant.

    Args:
        path: the file.

    Attributes:
        trouble: why nobody is let in; "" where the list can be read.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._seen, self.trouble = path, (0, 0, 0), ""
        self._by_key: Mapping[str, tuple[str, Role]] = {}

    def find(self, key: str) -> tuple[str, Role] | None:
        """Name and role of the client with that public key; None: it is not on the list."""
        self._look()
        return self._by_key.get(key)

    def _look(self) -> None:
        stamp = (0, 0, 0)
        with suppress(OSError):
            found = self._path.stat()
            stamp = (found.st_mtime_ns, found.st_size, found.st_ino)
        if stamp == self._seen and stamp != (0, 0, 0):
            return
        self._seen = stamp
        try:
            clients, self.trouble = read_clients(self._path), ""
        except ConfigError as e:
            clients, self.trouble = {}, f"nobody is let in over the network: {e}"
        self._by_key = {client.key: (name, client.role) for name, client in clients.items()}


def read_server(folder: Path) -> Pair:
    """Read the daemon's keys.

    Raises:
        ConfigError: they are not there, others can read them, or they are not a pair.
    """
    return _secret(folder / SERVER, Pair, f"make them with `rtec keys server {folder}`")


def read_client(path: Path) -> ClientKeys:
    """Read a client's own file.

    Raises:
        ConfigError: as for `read_server`.
    """
    return _secret(path, ClientKeys, "`rtec keys client` makes one, where the daemon's keys are")


def read_clients(path: Path) -> dict[str, Client]:
    """Read the list.

    Raises:
        ConfigError: it is not there, or something in it is wrong.
    """
    if not path.exists():
        raise ConfigError(f"{path}: no such file; `rtec keys server {path.parent}` makes keys and an empty list")
    clients = validated(Clients, read_toml(path), str(path)).client
    for name, client in clients.items():
        same = [other for other, c in clients.items() if c.key == client.key]
        if len(same) > 1:
            raise ConfigError(f"{path}: {' and '.join(same)} have the same key; a client has one role")
        _check_name(name, str(path))
    return clients


def make_server(folder: Path) -> str:
    """Make a folder with the daemon's keys and an empty list; give the public key.

    Raises:
        ConfigError: there are keys already, or it cannot be made.
    """
    if (folder / SERVER).exists():
        raise ConfigError(f"{folder / SERVER}: is there already; with new keys every client needs a new file")
    pair = _new_pair()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as e:
        raise ConfigError(f"{folder}: cannot be made: {e.strerror}") from e
    _write(folder / SERVER, {"public": pair.public, "secret": pair.secret}, folder)
    if not (folder / CLIENTS).exists():
        _write(folder / CLIENTS, {"client": {}}, folder)
    return pair.public


def add_client(folder: Path, name: str, role: Role, key: str | None, out: Path) -> Path | None:
    """Put a client on the list.

    Args:
        folder: of the daemon's keys.
        name: stands in the events with what it orders.
        role: what it may.
        key: its public key, where it made its pair itself; None: make a pair.
        out: the client's own file, for the pair that is made.

    Returns:
        The client's own file; None where it made its pair itself.

    Raises:
        ConfigError: the name is taken or cannot be one, or something cannot be read or written.
    """
    _check_name(name, "rtec keys")
    server, clients = read_server(folder), read_clients(folder / CLIENTS)
    if name in clients:
        raise ConfigError(f"{folder / CLIENTS}: {name} is on the list; take it off first: `rtec keys remove`")
    pair = _new_pair() if key is None else None
    if key is not None and not re.fullmatch(Z85, key):
        raise ConfigError(f"{key[:60]!r} is no public key: 40 characters, as `zmq.curve_keypair()` gives them first")
    entry = validated(Client, {"key": pair.public if pair else key, "role": role}, f"client {name}")
    if any(c.key == entry.key for c in clients.values()):
        raise ConfigError(f"{folder / CLIENTS}: this key is on the list under another name")
    if pair is not None:
        if out.exists():
            raise ConfigError(f"{out}: is there already; name another file with --out")
        _write(out, {"public": pair.public, "secret": pair.secret, "server": server.public})
    _write_clients(folder, {**clients, name: entry})
    return out if pair is not None else None


def remove_client(folder: Path, name: str) -> None:
    """Take a client off the list.

    Raises:
        ConfigError: it is not on it.
    """
    clients = read_clients(folder / CLIENTS)
    if name not in clients:
        raise ConfigError(f"{folder / CLIENTS}: no client {name!r}{nearest(name, clients)}")
    _write_clients(folder, {n: c for n, c in clients.items() if n != name})


def _secret(path: Path, kind: type[P], way: str) -> P:
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as e:
        raise ConfigError(f"{path}: no such file; {way}") from e
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from e
    if mode & 0o077:
        raise ConfigError(f"{path}: others may read this secret; `chmod 600 {path}`")
    pair = validated(kind, read_toml(path), str(path))
    import zmq

    try:
        public = zmq.curve_public(pair.secret.encode()).decode()
    except zmq.ZMQError:
        public = ""
    if public != pair.public:
        raise ConfigError(f"{path}: the two keys are not a pair; one of them was changed")
    return pair


def _new_pair() -> Pair:
    import zmq

    public, secret = zmq.curve_keypair()
    return Pair(public=public.decode(), secret=secret.decode())


def _check_name(name: str, source: str) -> None:
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{source}: {name[:60]!r} is no name for a client: letters, digits, '-' and '_', at most 40")


def _write_clients(folder: Path, clients: Mapping[str, Client]) -> None:
    _write(folder / CLIENTS, {"client": {name: c.model_dump() for name, c in clients.items()}}, folder)


def _write(path: Path, content: Mapping[str, Any], folder: Path | None = None) -> None:
    """Whole or not at all, readable by its owner only from its first instant; root writes for the folder's owner."""
    try:
        fd, name = tempfile.mkstemp(dir=path.parent, prefix=".keys-")
        with os.fdopen(fd, "wb") as file:
            if folder is not None and os.geteuid() == 0:
                owner = folder.stat()
                os.fchown(fd, owner.st_uid, owner.st_gid)
            tomli_w.dump(content, file)
            file.flush()
            os.fsync(fd)
        Path(name).replace(path)
    except OSError as e:
        raise ConfigError(f"{path}: cannot be written: {e.strerror}") from e


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
