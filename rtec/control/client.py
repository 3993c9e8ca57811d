"""The other end of control: asks a running daemon, and gives it orders.

Gives an order and waits for what comes of it.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import zmq

from rtec.control.facts import held, um_text
from rtec.control.keys import ClientKeys, read_client
from rtec.control.messages import RequestError, may_be_text, read_answer, request
from rtec.control.places import all_of, answers, of_config
from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.orders import LONGEST_TEXT, MODE_OF, Order, OrderRefused
from rtec.loop.records import MODES_BY_NAME
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


LONGEST_NS: Final = 15_000_000_000
PERIOD_NS: Final = 50_000_000
SEEN_NS: Final = 100_000_000
"""Rows that are so much newer than an order were made under it."""
_MODE_NAMES: Final = {number: name for name, number in MODES_BY_NAME.items()}
KEPT: Final = (Order.HOLD, Order.FADE)
"""Orders that a daemon that is restarted must not forget: they are done when they are on disk."""
_TOGETHER: Final = {
    Order.ENABLE: "the correction follows the model",
    Order.HOLD: "the correction stays where it is",
    Order.FADE: "the correction goes to nothing at its slew limit",
}


@dataclass(frozen=True)
class Outcome:
    """What came of an order.

    Attributes:
        done: it was carried out; False: the daemon could not (the text says why), or it took longer than was waited.
        text: in a sentence.
        status: of the daemon afterwards.
    """

    done: bool
    text: str
    status: dict[str, Any]


def carry_out(client: Client, order: Order, text: str, clock: Clock) -> Outcome:
    """Give an order, wait until it is carried out.

    Raises:
        OrderRefused: it is not taken.
        RtecError: the daemon does not answer.
    """
    before = client.status()
    answer = client.order(order, text)
    last_ns = clock.now_ns() + LONGEST_NS
    while True:
        after = client.status()
        outcome = _outcome(order, before, after)
        if outcome is not None:
            return outcome
        if clock.now_ns() >= last_ns:
            kept = order in KEPT and after["status"]["mode"] == _MODE_NAMES[MODE_OF[order]]
            what = "not kept: it is not on disk" if kept else "not carried out"
            return Outcome(False, f"{answer}, and {what} after {LONGEST_NS / 1e9:g} s", after)
        clock.sleep_until_ns(clock.now_ns() + PERIOD_NS)


def _outcome(order: Order, before: dict[str, Any], after: dict[str, Any]) -> Outcome | None:
    """What came of it; None: nothing yet."""
    if after["pid"] != before["pid"]:
        raise RtecError("the daemon was started anew meanwhile; look at `rtec status`")
    status = after["status"]
    count = after["events_total"] - before["events_total"]
    new = [e for e in after["events"][-count:] if e["what"] in _NOTED.get(order, (str(order),))] if count else []
    if order in MODE_OF:
        done = status["mode"] == _MODE_NAMES[MODE_OF[order]]
        return _ordered(order, status, new, after) if done else None
    if order is Order.RESUME:
        return _resumed(before["status"], status, after) if new else None
    if not new:
        return None
    if order is Order.MARK:
        return Outcome(True, f"marked row {new[-1]['row']}, {new[-1]['utc']}: {new[-1]['text']}", after)
    return Outcome(new[-1]["what"] == "reloaded", new[-1]["text"], after)


_NOTED: Final = {Order.MARK: ("mark",), Order.RELOAD: ("reloaded", "not reloaded"), Order.RESUME: ("resume",)}


def _ordered(order: Order, status: dict[str, Any], new: list[dict[str, Any]], after: dict[str, Any]) -> Outcome | None:
    """What came of an order that is a mode; None: no row that was made under it has been seen."""
    why = held(status)
    if not why:
        return _kept(order, status, new, after)
    if not new or status["time_ns"] - new[-1]["time_ns"] < SEEN_NS:
        return None
    return Outcome(False, f"enabled, but the correction stays where it is: {why}", after)


def _kept(order: Order, status: dict[str, Any], new: list[dict[str, Any]], after: dict[str, Any]) -> Outcome | None:
    """What came of an order that was carried out: is it on disk, where a power cut leaves it? None: not yet."""
    text = _mode_text(order, status)
    if order not in KEPT or status["kept_mode"] == status["mode"]:
        return Outcome(True, text, after)
    if status["kept_mode"] is None:
        return Outcome(True, f"{text}; not kept over a power cut: the run file names no state_folder", after)
    trouble = status["parts"].get("disk") or status["log"]
    if status["kept_mode"] or not trouble or not new or status["time_ns"] - new[-1]["time_ns"] < SEEN_NS:
        return None
    return Outcome(False, f"{text}; but not kept: {trouble}", after)


def _mode_text(order: Order, status: dict[str, Any]) -> str:
    units = {axis: "" if um is None else " µm" for axis, um in status["applied_um"].items()}
    applied = ", ".join(f"{axis} {um_text(um)}{units[axis]}" for axis, um in status["applied_um"].items())
    return f"{_TOGETHER[order]}; applied now: {applied}"


def _resumed(before: dict[str, Any], status: dict[str, Any], after: dict[str, Any]) -> Outcome | None:
    if status["takeovers"] == before["takeovers"]:
        return None
    wrong = [f"{name}: {'; '.join(texts)}" for name, texts in status["devices"].items()]
    if wrong:
        return Outcome(False, f"resumed, but {' | '.join(wrong)}", after)
    return Outcome(True, "the devices go on from where they are", after)
