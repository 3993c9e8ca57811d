"""The status as Prometheus reads it (text format 0.0.4), by HTTP at `/metrics`; off unless the run file names a place.

It asks for no key, so it listens on this computer only, and only tells.
"""

import threading
from collections.abc import Callable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from socketserver import TCPServer
from types import TracebackType
from typing import Any, Final, Self

from rtec.correction.guard import Flag
from rtec.errors import ConfigError

CONTENT: Final = "text/plain; version=0.0.4; charset=utf-8"
SLOW_S: Final = 2.0
"""A client gets so long for its request; one at a time is served."""
_MODES: Final = ("on", "off", "hold")


def metrics(found: Mapping[str, Any]) -> str:
    """Give the text for a status (`docs/control.md`); what is not known has no line."""
    lines: list[str] = []
    for name, kind, what, values in _families(found):
        known = [(labels, value) for labels, value in values if value is not None]
        if known:
            lines += [f"# HELP rtec_{name} {what}", f"# TYPE rtec_{name} {kind}"]
            lines += [f"rtec_{name}{_labels(labels)} {_number(value)}" for labels, value in known]
    return "\n".join(lines) + "\n"


_Values = list[tuple[dict[str, str], Any]]


def _families(found: Mapping[str, Any]) -> Iterator[tuple[str, str, str, _Values]]:
    status = found["status"]
    yield "requested_um", "gauge", "Correction that the model asks for, um.", _by("axis", status["requested_um"])
    yield "applied_um", "gauge", "Correction that is applied, um.", _by("axis", status["applied_um"])
    left = {axis: of["rms_um"] for axis, of in found["left"]["axes"].items()}
    yield "left_um", "gauge", "Error that the last measurement says is left, root mean square, um.", _by("axis", left)
    yield "temperature_celsius", "gauge", "Temperatures.", _by("sensor", status["degc"])
    yield "temperature_age_seconds", "gauge", "Age of the temperatures.", _by("sensor", status["degc_age_s"])
    yield "counts_age_seconds", "gauge", "Age of the axis counts.", [({}, status["counts_age_s"])]
    yield "spindle_rpm", "gauge", "Spindle speed, 1/min.", [({}, status["spindle_rpm"])]
    yield "status_age_seconds", "gauge", "Age of the loop's newest row.", [({}, found["status_age_s"])]
    yield "mode", "gauge", "1 for the mode that is ordered.", _by("mode", {m: m == status["mode"] for m in _MODES})
    flags = {str(f.name).lower(): f.name in status["flags"] for f in Flag}
    yield "flag", "gauge", "1 where it keeps the correction from being the requested one.", _by("flag", flags)
    yield "device_trouble", "gauge", "1 for a device in trouble.", _by("device", dict.fromkeys(status["devices"], 1))
    yield "cycles_total", "counter", "Cycles of the loop.", [({}, status["cycles"])]
    yield "deadline_misses_total", "counter", "Missed deadlines.", [({}, status["misses"])]
    yield "rows_lost_total", "counter", "Rows that did not reach the log.", [({}, status["overruns"])]
    yield "faults_total", "counter", "Faults of a part of the daemon.", _by("part", status["faults"])
    yield "reloads_total", "counter", "Reloads carried out.", [({}, status["reloads"])]
    yield "control_requests_total", "counter", "Requests by what came of them.", _by("result", found["control"])


def _by(label: str, values: Mapping[str, Any]) -> _Values:
    return [({label: name}, value) for name, value in values.items()]


def _labels(labels: Mapping[str, str]) -> str:
    inner = ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items())
    return f"{{{inner}}}" if inner else ""


def _number(value: float) -> str:
    """The shortest text that means the same number."""
    return repr(float(value)).removesuffix(".0")


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


class _Server(TCPServer):
    """`HTTPServer` asks the name service for its own name first; that can take long, and nobody needs it."""

    allow_reuse_address = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a client that went away in the middle is no news for the daemon's screen."""


class Endpoint:
    """Entering listens, leaving ends.

    Args:
        place: "host:port" on this computer.
        status: gives the status.

    Raises:
        ConfigError: on entering: the place cannot be had.
    """

    def __init__(self, place: str, status: Callable[[], Mapping[str, Any]]) -> None:
        self._place, self._status = place, status

    def __enter__(self) -> Self:
        host, port = self._place.rsplit(":", 1)
        try:
            self._server = _Server((host, int(port)), _handler(self._status))
        except OSError as e:
            raise ConfigError(f"[control] prometheus {self._place}: cannot listen there: {e.strerror}") from e
        self._thread = threading.Thread(target=self._server.serve_forever, name="rtec-prometheus", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Asked for from a thread that nobody waits for: a client may hold on to its connection.
        threading.Thread(target=self._server.shutdown, daemon=True).start()
        self._thread.join(SLOW_S)
        self._server.server_close()


def _handler(status: Callable[[], Mapping[str, Any]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = SLOW_S

        def do_GET(self) -> None:
            """Answer for /metrics only."""
            if self.path != "/metrics":
                self.send_error(404)
                return
            body = metrics(status()).encode()
            self.send_response(200)
            self.send_header("Content-Type", CONTENT)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing: a request every few seconds is no news."""

    return Handler
