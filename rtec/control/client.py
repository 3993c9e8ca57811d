"""The other end of control: asks a running daemon, and gives it orders."""

import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import zmq

from rtec.control.keys import ClientKeys, read_client
from rtec.control.messages import RequestError, may_be_text, read_answer, request
from rtec.control.places import all_of, answers, of_config
from rtec.errors import RtecError
from rtec.loop.orders import LONGEST_TEXT, Order, OrderRefused
from rtec.loop.run_file import PLACE

WAIT_S: Final = 2.0


@dataclass(frozen=True)
class Place:
    """Where a daemon answers.

    Attributes:
        address: as ZeroMQ writes it.
        keys: of this client; None: on this computer.
    """

    address: str
    keys: ClientKeys | None = None


def find(config: Path | None, at: str | None, key: Path | None) -> Place:
    """Find the daemon that is meant.

    Args:
        config: its run file; None: the only one that runs on this computer.
        at: "host:port" of a daemon on the network.
        key: this client's own file, for the network.

    Raises:
        RtecError: none runs, several run, or it may not be used; the message says what to do.
    """
    if at is not None:
        if key is None or not PLACE.fullmatch(at):
            raise RtecError(
                'a daemon on the network needs --at "host:port" and --key FILE (made by `rtec keys client`)'
            )
        return Place(f"tcp://{at}", read_client(key))
    candidates = all_of() if config is None else of_config(config)
    alive = [path for path in candidates if answers(path)]
    if config is not None and alive:
        return Place(f"ipc://{alive[0]}")
    if len(alive) == 1:
        return Place(f"ipc://{alive[0]}")
    raise RtecError(_several(alive) if alive else _none(config))


class Client:
    """A connection to a daemon; close it by leaving it.

    Args:
        place: where it answers.
        wait_s: longest wait for an answer.
    """

    def __init__(self, place: Place, wait_s: float = WAIT_S) -> None:
        self._place, self._wait_s = place, wait_s
        self._id = self._seq = 0
        self._context: Any = zmq.Context()
        self._socket: Any = self._context.socket(zmq.DEALER)
        self._socket.linger = 0
        self._socket.ipv6 = "[" in place.address
        if place.keys is not None:
            self._socket.curve_serverkey = place.keys.server.encode()
            self._socket.curve_publickey = place.keys.public.encode()
            self._socket.curve_secretkey = place.keys.secret.encode()
        self._socket.connect(place.address)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.destroy(linger=0)

    def status(self) -> dict[str, Any]:
        """Everything that the daemon tells of itself (`docs/control.md`).

        Raises:
            RtecError: it does not answer.
        """
        return self._ask("status")

    def order(self, order: Order, text: str = "") -> str:
        """Give an order; give what the daemon says to it.

        Raises:
            OrderRefused: the daemon does not take it; the message says why.
            RtecError: it does not answer; the order may or may not have reached it.
        """
        if not may_be_text(text):
            raise OrderRefused(f"the text may have at most {LONGEST_TEXT} printable characters, and no line breaks")
        session = self._ask("session")["session"]
        self._seq += 1
        return str(self._ask("order", session=session, seq=self._seq, order=str(order), text=text)["done"])

    def _ask(self, ask: str, **more: object) -> dict[str, Any]:
        self._id += 1
        self._socket.send_multipart([b"", request(ask, self._id, **more)])
        while self._socket.poll(round(self._wait_s * 1e3)):
            try:
                found = read_answer(self._socket.recv_multipart()[-1])
            except RequestError as e:
                raise RtecError(f"the daemon's answer {e}: is it of another version of rtec?") from e
            if "error" in found:
                raise RtecError(f"the daemon cannot read the request: {found['error']}; another version of rtec?")
            if "refused" in found:
                raise OrderRefused(f"refused: {found['refused']}")
            if found.get("id") == self._id:
                return found
        raise RtecError(self._silence())

    def _silence(self) -> str:
        head = f"no answer from {self._place.address} within {self._wait_s:g} s"
        if self._place.keys is None:
            return f"{head}: the daemon is busy starting or has just ended; try again"
        return (
            f"{head}: does the daemon run, does its [control] say this port, is this key on its list "
            "(`rtec keys list`), and is the file of the server whose key it was made for?"
        )


def _none(config: Path | None) -> str:
    who = "no daemon runs" if config is None else f"no daemon runs with {config}"
    user = f" as this user (number {os.geteuid()})" if config is None and os.geteuid() else ""
    return (
        f"{who}{user}: start one with `rtec run {config or 'CONFIG'}`, or `systemctl status 'rtec@*'` says why it does "
        "not run; one of another user answers to that user and to root"
    )


def _several(alive: list[Path]) -> str:
    names = []
    for path in alive:
        with Client(Place(f"ipc://{path}")) as client:
            names.append(str(client.status()["config"]))
    return f"{len(alive)} daemons run: name the run file of one: {', '.join(names)}"
