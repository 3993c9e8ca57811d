"""A controller in software that takes offsets as lines, on a pty or over TCP; it shares no code with the driver."""

import re
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

SET = re.compile(r"OFS X=(\S+) Z=(\S+)")


@dataclass
class OffsetController:
    """Takes `OFS X=… Z=…` in mm and answers OK; `OFS?` gives the offsets.

    Attributes:
        has: offsets, mm.
        lines: what it was sent, as it came.
        answers: it acknowledges and answers.
        refuses: it refuses commands.
        deaf: it acknowledges, and does nothing.
        restarts_after: it restarts after so many commands, once.
        says: printed at the next opportunity.
    """

    has: dict[str, float] = field(default_factory=lambda: {"X": 0.0, "Z": 0.0})
    lines: list[str] = field(default_factory=list)
    answers: bool = True
    refuses: bool = False
    deaf: bool = False
    restarts_after: int = -1
    says: bytes = b""
    rest: bytes = b""

    def receive(self, data: bytes, now_ns: int) -> bytes:
        *lines, self.rest = (self.rest + data).split(b"\r\n")
        return b"".join(self._answer(line.decode("ascii")) for line in lines) + self.idle(now_ns)

    def idle(self, now_ns: int) -> bytes:
        del now_ns
        said, self.says = self.says, b""
        return said

    def restart(self) -> None:
        self.has = {"X": 0.0, "Z": 0.0}
        self.says = b"READY V1.2\r\n"

    def _answer(self, line: str) -> bytes:
        self.lines.append(line)
        if line == "OFS?":
            text = f"OFS X={self.has['X']:.4f} Z={self.has['Z']:.4f}"
        elif self.refuses:
            text = "ERR 12"
        else:
            match = SET.fullmatch(line)
            text = "OK" if match else "ERR 1"
            if match and not self.deaf:
                self.has = {"X": float(match[1]), "Z": float(match[2])}
                self.restarts_after -= 1
                if self.restarts_after == 0:
                    self.restart()
        return text.encode() + b"\r\n" if self.answers else b""


@contextmanager
def controller_over_tcp(controller: OffsetController) -> Iterator[int]:
    """Serve it on a port of the loopback; gives the port."""

    class Handler(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            while data := self.request.recv(4096):
                if answer := controller.receive(data, 0):
                    self.request.sendall(answer)

    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield int(server.server_address[1])
        finally:
            server.shutdown()
            thread.join()
