"""The client of control: reads a running daemon's status, gives it an order, and waits for the result.

A client on the network has sshd run `relay` beside the daemon: it copies the client's bytes to the daemon's local
socket, and back. The relay itself sends the first line to the daemon: it names the client and lowers its rights, for
good.
"""

import os
import re
import selectors
import shlex
import socket
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from rtec.control.facts import headline, held, stays, um_text
from rtec.control.messages import RequestError, Role, may_be_text, read_answer, request
from rtec.control.places import all_of, answers, of_config
from rtec.errors import RtecError
from rtec.loop.clock import Clock
from rtec.loop.orders import LONGEST_TEXT, MODE_OF, Order, OrderRefused
from rtec.loop.records import MODES_BY_NAME
from rtec.text import joined

WAIT_S: Final = 5.0
SSH_WAIT_S: Final = 20.0
"""Longest wait, s, for a login by ssh."""
LARGEST_ANSWER: Final = 4 * 1024 * 1024
HOST: Final = re.compile(
    r"(?P<host>([A-Za-z0-9_][\w.-]*@)?([A-Za-z0-9][\w.-]*|\[[0-9a-fA-F:.]+\]))(:(?P<port>\d{1,5}))?"
)
LONGEST_NS: Final = 15_000_000_000
PERIOD_NS: Final = 50_000_000
UNDER_ORDER_NS: Final = 100_000_000
"""A row that is newer than an order by this, ns, was made under it."""
FIRST_READINGS_NS: Final = 1_000_000_000
"""A device that resumes forgets its readings; it may take this long, ns, until the next."""
_MODE_NAMES: Final = {number: name for name, number in MODES_BY_NAME.items()}
KEPT: Final = (Order.HOLD, Order.FADE)
"""Orders that must survive a restart of the daemon: they are done when they are on disk."""
_MODE_WORDS: Final = {
    Order.ENABLE: "the correction follows the model",
    Order.FADE: "the correction goes to nothing at its slew limit",
}
_NOTED: Final = {
    Order.MARK: ("mark",),
    Order.RELOAD: ("reloaded", "not reloaded"),
    Order.HOME: ("homed", "not homed"),
    Order.RESUME: ("resume",),
}


@dataclass(frozen=True)
class DaemonPlace:
    """Address of a daemon.

    Attributes:
        path: path of its local socket; None: it is on another computer.
        command: command whose input and output lead to the daemon there.
    """

    path: Path | None = None
    command: tuple[str, ...] = ()

    def __str__(self) -> str:
        return str(self.path) if self.path is not None else shlex.join(self.command)


def find(config: Path | None, at: str | None, key: Path | None) -> DaemonPlace:
    """Find a daemon.

    Args:
        config: its run file; None: the only daemon on this computer.
        at: "user@host:port" of another computer, which is reached by ssh; user and port may be omitted.
        key: file of the ssh key; None: as ssh is configured.

    Raises:
        RtecError: no daemon runs, several run, or access is denied; the message says what to do.
    """
    if at is not None:
        return DaemonPlace(command=_by_ssh(config, at, key))
    candidates = all_of() if config is None else of_config(config)
    alive = [path for path in candidates if answers(path)]
    if config is not None and alive:
        return DaemonPlace(alive[0])
    if len(alive) == 1:
        return DaemonPlace(alive[0])
    raise RtecError(_several(alive) if alive else _none(config))


def _by_ssh(config: Path | None, at: str, key: Path | None) -> tuple[str, ...]:
    match = HOST.fullmatch(at)
    if match is None:
        raise RtecError(f'--at {at!r} is not "user@host" or "user@host:port"')
    there = ["rtec", "ctl", "relay", "--role", "operate", *([] if config is None else [str(config)])]
    port = [] if match["port"] is None else ["-p", match["port"]]
    identity = [] if key is None else ["-o", "IdentitiesOnly=yes", "-i", str(key)]
    options = ("-T", "-o", "BatchMode=yes", "-o", "ServerAliveInterval=5")
    return ("ssh", *options, *port, *identity, "--", match["host"].replace("[", "").replace("]", ""), shlex.join(there))


def _none(config: Path | None) -> str:
    if config is not None and not config.exists():
        return f"{config}: no such file"
    who = "no daemon runs" if config is None else f"no daemon runs with {config}"
    user = f" as this user (number {os.geteuid()})" if config is None and os.geteuid() else ""
    return (
        f"{who}{user}: start one with `rtec run {config or 'CONFIG'}`, or `systemctl status 'rtec@*'` says why it does "
        "not run; one of another user answers to that user and to root"
    )


def _several(alive: list[Path]) -> str:
    names = []
    for path in alive:
        with Client(DaemonPlace(path)) as client:
            names.append(str(client.status()["config"]))
    return f"{len(alive)} daemons run: name the run file of one: {', '.join(names)}"


class Client:
    """A connection to a daemon; leaving closes it.

    Args:
        place: address of the daemon.
        wait_s: longest wait for an answer.

    Raises:
        RtecError: nothing answers there.
    """

    def __init__(self, place: DaemonPlace, wait_s: float | None = None) -> None:
        self._place = place
        self._wait_s = (SSH_WAIT_S if place.path is None else WAIT_S) if wait_s is None else wait_s
        self._id = self._seq = 0
        self._received = b""
        self._process: subprocess.Popen[bytes] | None = None
        self._socket = self._connected() if place.path is not None else self._begun()
        self._socket.settimeout(self._wait_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    def status(self) -> dict[str, Any]:
        """Everything that the daemon reports of itself (`docs/control.md`).

        Raises:
            RtecError: it does not answer.
        """
        return self._ask("status")

    def lower(self, name: str, role: Role) -> None:
        """Take a name for the events, and at most the rights of a role, for the rest of the connection.

        Raises:
            OrderRefused: the daemon grants less.
            RtecError: it does not answer.
        """
        self._ask("as", name=name, role=role)

    def order(self, order: Order, text: str = "") -> str:
        """Give an order; return the daemon's answer.

        Raises:
            OrderRefused: the daemon refuses it; the message says why.
            RtecError: it does not answer; the order may or may not have reached it.
        """
        if not may_be_text(text):
            raise OrderRefused(f"the text may have at most {LONGEST_TEXT} printable characters, and no line breaks")
        session = self._ask("session")["session"]
        self._seq += 1
        return str(self._ask("order", session=session, seq=self._seq, order=str(order), text=text)["done"])

    def _connected(self) -> socket.socket:
        made = socket.socket(socket.AF_UNIX)
        # Only a blocking socket waits while the queue is full.
        made.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", max(1, round(self._wait_s)), 0))
        try:
            made.connect(str(self._place.path))
        except OSError as e:
            made.close()
            raise RtecError(f"{self._place}: nobody answers ({e.strerror or e}); does the daemon run?") from e
        return made

    def _begun(self) -> socket.socket:
        """Start the command; a socket is its input and its output, and its error messages go to the user."""
        here, there = socket.socketpair()
        try:
            with there:
                ends = there.fileno()
                self._process = subprocess.Popen(self._place.command, stdin=ends, stdout=ends)  # noqa: S603 (no shell)
        except OSError as e:
            here.close()
            raise RtecError(f"{self._place.command[0]}: cannot be started: {e.strerror}; is ssh installed?") from e
        return here

    def _ask(self, ask: str, **more: object) -> dict[str, Any]:
        self._id += 1
        try:
            self._socket.sendall(request(ask, self._id, **more) + b"\n")
        except OSError as e:
            raise RtecError(self._silence()) from e
        while True:
            reply = self._read()
            if "error" in reply:
                raise RtecError(f"the daemon cannot read the request: {reply['error']}; another version of rtec?")
            if "refused" in reply:
                raise OrderRefused(f"refused: {reply['refused']}")
            if reply.get("id") == self._id:
                return reply

    def _read(self) -> dict[str, Any]:
        while b"\n" not in self._received:
            try:
                data = self._socket.recv(65536)
            except OSError as e:
                raise RtecError(self._silence()) from e
            self._received += data
            if not data or len(self._received) > LARGEST_ANSWER:
                raise RtecError(self._silence())
        line, self._received = self._received.split(b"\n", 1)
        try:
            return read_answer(line)
        except RequestError as e:
            raise RtecError(f"the daemon's answer {e}: is it of another version of rtec?") from e

    def _silence(self) -> str:
        if self._process is None:
            return f"no answer from {self._place}: the daemon is busy, or has just ended; try again"
        return f"no answer by `{self._place}`: is it allowed there, and does the daemon run? See docs/control.md"


@dataclass(frozen=True)
class Outcome:
    """Result of an order.

    Attributes:
        done: was it carried out? False: the daemon could not (the text says why), or it took longer than the wait.
        text: the result in a sentence.
        status: status of the daemon afterwards.
    """

    done: bool
    text: str
    status: dict[str, Any]


def carry_out(client: Client, order: Order, text: str, clock: Clock) -> Outcome:
    """Give an order and wait for its result.

    Raises:
        OrderRefused: the daemon refuses it.
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
    """Result of an order; None: not known yet."""
    if after["pid"] != before["pid"]:
        raise RtecError("the daemon was restarted meanwhile; look at `rtec status`")
    status = after["status"]
    count = after["events_total"] - before["events_total"]
    since = after["events"][-count:] if count else []
    new = [e for e in since if e["what"] in _NOTED.get(order, (str(order),))]
    if order in MODE_OF:
        done = status["mode"] == _MODE_NAMES[MODE_OF[order]]
        return _ordered(order, status, new, after) if done else _overtaken(order, since, after)
    if order is Order.RESUME:
        return _resumed(before["status"], status, new, after) if new else None
    if not new:
        return None
    if order is Order.MARK:
        return Outcome(True, f"marked row {new[-1]['row']}, {new[-1]['utc']}: {new[-1]['text']}", after)
    return Outcome(not new[-1]["what"].startswith("not "), new[-1]["text"], after)


def _overtaken(order: Order, since: list[dict[str, Any]], after: dict[str, Any]) -> Outcome | None:
    """Result of an order of a mode behind which another one came; None: none did."""
    modes = [e for e in since if e["what"] in map(str, MODE_OF)]
    if not modes or modes[-1]["what"] == order or all(e["what"] != order for e in modes):
        return None
    last = modes[-1]
    return Outcome(False, f"{order} ordered, and then {last['what']}, by {last['who']} at {last['utc']}", after)


def _ordered(order: Order, status: dict[str, Any], new: list[dict[str, Any]], after: dict[str, Any]) -> Outcome | None:
    """Result of an order of a mode; None: there is no row yet that was made under it."""
    why = held(status)
    if not why:
        return _kept(order, status, new, after)
    if not new or status["time_ns"] - new[-1]["time_ns"] < UNDER_ORDER_NS:
        return None
    return Outcome(False, f"enabled, but the correction {stays(after)}: {why}", after)


def _kept(order: Order, status: dict[str, Any], new: list[dict[str, Any]], after: dict[str, Any]) -> Outcome | None:
    """Result of an order that was carried out and must survive a power cut: is it on disk? None: not yet."""
    text = _mode_text(order, status, after) if after.get("actuator", True) else "; ".join(headline(after)[1:])
    if order not in KEPT or status["kept_mode"] == status["mode"]:
        return Outcome(True, text, after)
    if status["kept_mode"] is None:
        return Outcome(True, f"{text}; not kept over a power cut: the run file names no state_folder", after)
    trouble = status["parts"].get("disk") or status["log"]
    if status["kept_mode"] or not trouble or not new or status["time_ns"] - new[-1]["time_ns"] < UNDER_ORDER_NS:
        return None
    return Outcome(False, f"{text}; but not kept: {trouble}", after)


def _mode_text(order: Order, status: dict[str, Any], after: dict[str, Any]) -> str:
    units = {axis: "" if um is None else " µm" for axis, um in status["applied_um"].items()}
    applied = ", ".join(f"{axis} {um_text(um)}{units[axis]}" for axis, um in status["applied_um"].items())
    words = f"the correction {stays(after)}" if order is Order.HOLD else _MODE_WORDS[order]
    return f"{words}; applied now: {applied}"


def _resumed(
    before: dict[str, Any], status: dict[str, Any], new: list[dict[str, Any]], after: dict[str, Any]
) -> Outcome | None:
    """Result of an order to resume; None: it is not carried out yet, or the first readings behind it may still come."""
    if status["takeovers"] == before["takeovers"]:
        return None
    wrong = [f"{name}: {joined(texts)}" for name, texts in status["devices"].items()]
    if wrong and status["time_ns"] - new[-1]["time_ns"] < FIRST_READINGS_NS:
        return None
    if wrong:
        return Outcome(False, f"resumed, but {' | '.join(wrong)}", after)
    what = {"hold": "held", "off": "off"}.get(status["mode"])
    still = f"; the correction stays {what}, as ordered: `rtec ctl enable` ends that" if what else ""
    return Outcome(True, f"the devices go on from where they are{still}", after)


CHUNK_BYTES: Final = 65536


def relay(path: Path, name: str, role: Role, source: int = 0, sink: int = 1) -> None:
    """Copy until one of the two ends.

    Args:
        path: path of the daemon's socket.
        name: name of the client in the events.
        role: rights of the client.
        source, sink: file descriptors from the client, and to it.

    Raises:
        RtecError: nothing listens at `path`, or it refuses the name.
    """
    with socket.socket(socket.AF_UNIX) as daemon, selectors.DefaultSelector() as ready:
        try:
            daemon.connect(str(path))
            _greet(daemon, path, name, role)
            ready.register(source, selectors.EVENT_READ)
            ready.register(daemon, selectors.EVENT_READ)
            while all(_copied(daemon, key.fileobj, ready, source, sink) for key, _ in ready.select()):
                pass
        except (OSError, RequestError) as e:
            raise RtecError(f"{path}: {e}") from e


def _greet(daemon: socket.socket, path: Path, name: str, role: Role) -> None:
    """Give name and role; the client does not see the answer."""
    daemon.sendall(request("as", 0, name=name, role=role) + b"\n")
    heard = b""
    while not heard.endswith(b"\n"):
        if not (byte := daemon.recv(1)):
            raise RtecError(f"{path}: the daemon hung up")
        heard += byte
    answered = read_answer(heard)
    if why := answered.get("error") or answered.get("refused"):
        raise RtecError(f"--name {name!r} --role {role}: {why}")


def _copied(daemon: socket.socket, ready: object, selector: selectors.BaseSelector, source: int, sink: int) -> bool:
    """Copy what is ready; False once the daemon has ended."""
    if ready is not daemon:
        if data := os.read(source, CHUNK_BYTES):
            daemon.sendall(data)
        else:  # the client has sent all its requests; the answers are still to come
            selector.unregister(source)
            daemon.shutdown(socket.SHUT_WR)
        return True
    data = daemon.recv(CHUNK_BYTES)
    rest = data
    while rest:
        rest = rest[os.write(sink, rest) :]
    return bool(data)
