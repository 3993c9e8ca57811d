"""The status in Prometheus' text format 0.0.4, by HTTP at `/metrics`; off unless the run file names an address.

It has no authentication, so it listens on this computer only (`rtec.control.server`); it is read-only.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from typing import Any, Final

from rtec.correction.flags import Flag
from rtec.text import clean

CONTENT: Final = "text/plain; version=0.0.4; charset=utf-8"
_MODES: Final = ("on", "off", "hold")
_OURS: Final = re.compile(rb"(localhost|127(\.\d{1,3}){3}|\[::1\])(:\d+)?", re.IGNORECASE)
"""Names of this computer alone: a web page that gives its own name to this address (DNS rebinding) reads nothing."""


def http_answer(head: bytes, status: Callable[[], Mapping[str, Any]]) -> bytes:
    """Answer a request's head; the connection ends with the answer.

    Args:
        head: request line and header lines.
        status: gives the status.
    """
    first, *lines = head.split(b"\r\n")
    method, path, *_ = [*first.split(b" "), b"", b""]
    host = next((line.partition(b":")[2].strip() for line in lines if line.lower().startswith(b"host:")), b"localhost")
    if not _OURS.fullmatch(host):
        code, body = HTTPStatus.MISDIRECTED_REQUEST, b""
    elif method != b"GET":
        code, body = HTTPStatus.NOT_IMPLEMENTED, b""
    elif path.partition(b"?")[0] != b"/metrics":
        code, body = HTTPStatus.NOT_FOUND, b""
    else:
        code, body = HTTPStatus.OK, metrics(status()).encode()
    answer = (
        f"HTTP/1.1 {code.value} {code.phrase}",
        f"Content-Type: {CONTENT}",
        f"Content-Length: {len(body)}",
        "Connection: close",
    )
    return "\r\n".join((*answer, "", "")).encode() + body


def metrics(report: Mapping[str, Any]) -> str:
    """The text of a status (`docs/control.md`); an unknown value has no line."""
    lines: list[str] = []
    for name, kind, what, values in _families(report):
        known = [(labels, value) for labels, value in values if value is not None]
        if known:
            lines += [f"# HELP rtec_{name} {what}", f"# TYPE rtec_{name} {kind}"]
            lines += [f"rtec_{name}{_labels(labels)} {_number(value)}" for labels, value in known]
    return "\n".join(lines) + "\n"


_Values = list[tuple[dict[str, str], Any]]


def _families(report: Mapping[str, Any]) -> Iterator[tuple[str, str, str, _Values]]:
    status = report["status"]
    yield "requested_um", "gauge", "Correction that the model asks for, um.", _by("axis", status["requested_um"])
    yield "applied_um", "gauge", "Correction that is applied, um.", _by("axis", status["applied_um"])
    residual = {axis: of["rms_um"] for axis, of in report["left"]["axes"].items()}
    yield "left_um", "gauge", "Residual of the last measurement, root mean square, um.", _by("axis", residual)
    yield "temperature_celsius", "gauge", "Temperatures.", _by("sensor", status["degc"])
    since_s = report["status_age_s"] or 0.0
    counts_age_s = None if status["counts_age_s"] is None else status["counts_age_s"] + since_s
    ages = {sensor: None if age is None else age + since_s for sensor, age in status["degc_age_s"].items()}
    yield "temperature_age_seconds", "gauge", "Age of the temperatures.", _by("sensor", ages)
    yield "counts_age_seconds", "gauge", "Age of the axis counts.", [({}, counts_age_s)]
    yield "spindle_rpm", "gauge", "Spindle speed, 1/min.", [({}, status["spindle_rpm"])]
    yield "status_age_seconds", "gauge", "Age of the loop's newest row.", [({}, report["status_age_s"])]
    yield "mode", "gauge", "1 for the mode that is ordered.", _by("mode", {m: m == status["mode"] for m in _MODES})
    flags = {str(f.name).lower(): f.name in status["flags"] for f in Flag}
    yield "flag", "gauge", "1 where it keeps the correction from being the requested one.", _by("flag", flags)
    yield "device_trouble", "gauge", "1 for a device in trouble.", _by("device", dict.fromkeys(status["devices"], 1))
    yield "cycles_total", "counter", "Cycles of the loop.", [({}, status["cycles"])]
    yield "deadline_misses_total", "counter", "Missed deadlines.", [({}, status["misses"])]
    yield "rows_lost_total", "counter", "Rows that did not reach the log.", [({}, status["overruns"])]
    yield "faults_total", "counter", "Faults of a part of the daemon.", _by("part", status["faults"])
    yield "reloads_total", "counter", "Reloads carried out.", [({}, status["reloads"])]
    yield "control_requests_total", "counter", "Requests by what came of them.", _by("result", report["control"])


def _by(label: str, values: Mapping[str, Any]) -> _Values:
    return [({label: name}, value) for name, value in values.items()]


def _labels(labels: Mapping[str, str]) -> str:
    inner = ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items())
    return f"{{{inner}}}" if inner else ""


def _number(value: float) -> str:
    """The shortest text of the same number."""
    return repr(float(value)).removesuffix(".0")


def _escaped(value: str) -> str:
    return clean(value).replace("\\", "\\\\").replace('"', '\\"')
