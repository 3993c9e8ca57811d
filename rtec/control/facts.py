"""What a daemon's status means, for people: the rows of its tables, and its lines of text."""

from collections.abc import Mapping
from typing import Any, Final

STANDS_S: Final = 1.0
"""A row that is older: the loop stands."""
_UNITS: Final = {"um": "µm", "urad": "µrad"}
_MODES: Final = {
    "on": "on: the correction follows the model",
    "off": "off: the correction goes to nothing, or has gone there",
    "hold": "hold: the correction stays where it is",
    "": "starting",
}


def well(found: Mapping[str, Any]) -> bool:
    """Is nothing wrong that somebody has to look at?"""
    return not troubles(found)


def axis_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """Of each axis: name, requested and applied correction, residual of the last measurement, output, counts."""
    status, residual = found["status"], found["left"]["axes"]
    return [
        [
            axis,
            um_text(status["requested_um"][axis]),
            um_text(status["applied_um"][axis]),
            f"{residual[axis]['rms_um']:.2f}" if axis in residual else "not known",
            f"{status['output'][axis]:+d}",
            f"{status['counts'][axis]:d}",
        ]
        for axis in status["applied_um"]
    ]


def input_rows(found: Mapping[str, Any]) -> list[list[str]]:
    """Of each input: name, value, age."""
    status = found["status"]
    rows = [["counts", "", f"{1e3 * status['counts_age_s']:.2f} ms"]]
    for sensor, degc in status["degc"].items():
        value = "not read" if degc is None else f"{degc:.2f} °C"
        rows.append([sensor, value, _age(status["degc_age_s"][sensor]) if degc is not None else ""])
    rpm = status["spindle_rpm"]
    return [*rows, ["spindle", "not known" if rpm is None else f"{rpm:.0f} rpm", ""]]


def headline(found: Mapping[str, Any]) -> list[str]:
    """Sentences above the tables."""
    status = found["status"]
    return [
        f"{found['machine']}, model {found['model']}, {found['config']}",
        _mode_line(status),
    ]


def held(status: Mapping[str, Any]) -> str:
    """Why the correction does not follow the model though it is ordered to, in words; "" where it does."""
    if status["mode"] != "on" or "HELD" not in status["flags"]:
        return ""
    devices = [f"device {name}: {'; '.join(texts)}" for name, texts in status["devices"].items()]
    return "; ".join([*devices, *status["reasons"]]) or "no reason is given"


def _mode_line(status: Mapping[str, Any]) -> str:
    if held(status):
        return "mode on is ordered, but the correction stays where it is: see why"
    return f"mode {_MODES.get(status['mode'], status['mode'])}"


def footer(found: Mapping[str, Any]) -> list[str]:
    """Sentences below the tables."""
    status = found["status"]
    hours = status["time_s"] / 3600
    lasted = f"{hours:.1f} h" if hours >= 1 else f"{status['time_s']:.0f} s"
    lines = [f"{status['cycles']} cycles in {lasted}, {status['misses']} deadlines missed"]
    if status["overruns"]:
        lines.append(f"{status['overruns']} rows of this run are in no log; the events say when and why")
    lines += _residual(found["left"])
    if status["reload"]:
        lines.append(status["reload"])
    control = found["control"]
    bad = control["refused"] + control["malformed"] + control["not_let_in"]
    if bad:
        lines.append(
            f"control: {control['refused']} requests refused, {control['malformed']} not understood, "
            f"{control['not_let_in']} connections cut to make room"
        )
    return lines


def _residual(residual: Mapping[str, Any]) -> list[str]:
    """Where the residuals come from; without a comparison, what the model's history says."""
    lines = [
        f"residual of {axis}: root mean square of {', '.join(of['from'])}; noise {of['noise_um']:.2f} µm"
        for axis, of in residual["axes"].items()
    ]
    if residual["trouble"]:
        lines.append(f"residual: {residual['trouble']}")
    elif not lines and residual["model"]["rms"] is not None:
        unit = _UNITS.get(residual["model"]["unit"], residual["model"]["unit"])
        lines.append(
            f"residual of the model: {residual['model']['rms']:.2f} {unit} on held-out runs, all axes together"
        )
    return lines


def troubles(found: Mapping[str, Any]) -> list[str]:
    """What is wrong, a line each."""
    status = found["status"]
    lines = [f"device {name}: {'; '.join(texts)}" for name, texts in status["devices"].items()]
    lines += [f"{name}: {text}" for name, text in status["parts"].items()]
    if status["log"]:
        lines.append(f"log: {status['log']}")
    if found["status_age_s"] is not None and found["status_age_s"] > STANDS_S:
        lines.append(f"the loop stands: its newest row is {found['status_age_s']:.1f} s old")
    return lines


def um_text(value: float | None) -> str:
    """A correction for people; null, which stands for NaN, in words."""
    return "not known" if value is None else f"{value:+.2f}"


def _age(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
