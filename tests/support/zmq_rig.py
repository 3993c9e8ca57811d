"""Another process at the far end of the ZeroMQ link, as somebody would write it from `docs/zmq-link.md` alone."""

import json
import threading
from pathlib import Path
from typing import Any, Self

import zmq

from rtec.loop.clock import RealClock

MS = 1_000_000


class Cell:
    """Publishes every millisecond and takes commands, in a thread of its own.

    Attributes:
        position, degc: what it publishes.
        output: what it was commanded.
        lock: take it to change anything.
        skew_ns: its clock minus the real one.
        raw: this text is published once instead of a state.
    """

    def __init__(self, state: str, command: str, boot: str = "a1", keys: Any = None) -> None:
        self.state, self.command, self.boot, self.keys = state, command, boot, keys
        self.position = {"X": 1000, "Z": -2000}
        self.degc = {"T_bed": 21.25}
        self.output = {"X": 0, "Z": 0}
        self.lock, self.skew_ns, self.raw, self.silent = threading.Lock(), 0, b"", False
        self.answering, self.extra = True, dict[str, Any]()
        self.commands: list[dict[str, Any]] = []
        self._seq, self._clock, self._stop = 0, RealClock(), threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Bind both addresses."""
        self._context = zmq.Context()
        self._pub, self._router = self._context.socket(zmq.PUB), self._context.socket(zmq.ROUTER)
        for socket, address in ((self._pub, self.state), (self._router, self.command)):
            socket.setsockopt(zmq.LINGER, 0)
            if self.keys is not None:
                socket.curve_server = True
                socket.curve_publickey, socket.curve_secretkey = self.keys
            socket.bind(address)
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Vanish."""
        self._stop.set()
        assert self._thread is not None
        self._thread.join()
        self._context.destroy(linger=0)

    def message(self) -> dict[str, Any]:
        """The next state."""
        now_ns = self._clock.now_ns() + self.skew_ns
        self._seq += 1
        return {
            "schema": 1,
            "boot": self.boot,
            "seq": self._seq,
            "time_ns": now_ns,
            "counts": self.position,
            "counts_time_ns": now_ns,
            "degc": {name: [value, now_ns] for name, value in self.degc.items()},
            "spindle_rpm": 900.0,
            "output": self.output,
            **self.extra,
        }

    def _serve(self) -> None:
        while not self._stop.is_set():
            with self.lock:
                if not self.silent:
                    text, self.raw = self.raw or json.dumps(self.message()).encode(), b""
                    self._pub.send_multipart([b"rtec.state", text])
            if self._router.poll(1):
                sender, text = self._router.recv_multipart()
                with self.lock:
                    self._take(sender, json.loads(text))

    def _take(self, sender: bytes, said: dict[str, Any]) -> None:
        self.commands.append(said)
        answer = {"schema": 1, "boot": self.boot, "seq": said["seq"]}
        if said["boot"] == self.boot:
            self.output = said["output"]
        else:
            answer["refused"] = "for another start"
        if self.answering:
            self._router.send_multipart([sender, json.dumps(answer).encode()])


def ipc_cell(folder: Path, **more: Any) -> Cell:
    """A cell on this computer."""
    return Cell(f"ipc://{folder}/state", f"ipc://{folder}/command", **more)
