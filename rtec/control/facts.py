"""A daemon's status for people: the rows of its tables, and its lines of text."""

import math
from collections.abc import Mapping
from typing import Any, Final

from rtec.text import joined
from rtec.wording import ERROR_UNITS, POSITIONS_NOT_KNOWN, TO_RESUME, listed

STALLED_S: Final = 1.0
"""Largest age, s, of the newest row of a loop that runs."""
_MODES: Final = {
    "on": "on: the correction follows the model",
    "off": "off: the correction goes to nothing, or has gone there",
    "": "starting",
}

INPUT_FAULTS: Final = frozenset({"STALE_COUNTS", "STALE_TEMPERATURE", "SENSOR_FAULT"})
"""Flags of a device or sensor that gives no good readings, whether it reports a fault or not."""


def well(report: Mapping[str, Any]) -> bool:
    """Is there nothing that a person has to look at?

    There is where a device, a sensor, a part of the daemon or the log is in trouble, and where the correction is held
    although nobody ordered that.
    """
    status = report["status"]
    return not (troubles(report) or held(status) or INPUT_FAULTS & set(status["flags"]))


def positions_unknown(status: Mapping[str, Any]) -> bool:
    """Does a device say that nobody knows where the axes stand?"""
    return any(POSITIONS_NOT_KNOWN in text for texts in status["devices"].values() for text in texts)


def waits_for_resume(status: Mapping[str, Any]) -> bool:
    """Does the loop, or a device, wait for the order to resume?"""
    return any(TO_RESUME in text for texts in status["devices"].values() for text in texts)


AXIS_COLUMNS: Final = ("axis", "position, mm", "requested, µm", "applied, µm", "residual, µm", "output, units")


def axis_rows(report: Mapping[str, Any]) -> list[list[str]]:
    """For each axis: name, position, requested and applied correction, residual of the last measurement, output."""
    status, residual = report["status"], report["left"]["axes"]
    lost, position_mm = positions_unknown(status), status["position_mm"]
    return [
        [
            axis,
            "not known" if lost or position_mm[axis] is None else f"{position_mm[axis]:.4f}",
            um_text(status["requested_um"][axis]),
            um_text(status["applied_um"][axis]),
            f"{residual[axis]['rms_um']:.2f}" if axis in residual else "not known",
            f"{status['output'][axis]:+d}",
        ]
        for axis in status["applied_um"]
    ]


def input_rows(report: Mapping[str, Any]) -> list[list[str]]:
    """For each input: name, value, age; where the loop stands, the age now."""
    status, stands_s = report["status"], _stands_s(report)
    age_s = status["counts_age_s"]
    if age_s is None:
        rows = [["counts", "not read", ""]]
    else:
        rows = [["counts", "", _age(age_s + stands_s) if stands_s else f"{max(1e3 * age_s, 0.0):.2f} ms"]]
    for sensor, degc in status["degc"].items():
        value = "not read" if degc is None else f"{degc:.2f} °C"
        rows.append([sensor, value, _age(status["degc_age_s"][sensor] + stands_s) if degc is not None else ""])
    rpm = status["spindle_rpm"]
    return [*rows, ["spindle", "not known" if rpm is None else f"{rpm:.0f} rpm", ""]]


def headline(report: Mapping[str, Any]) -> list[str]:
    """Sentences above the tables."""
    lines = [f"{report['machine']}, model {report['model']}, {report['config']}", _mode_line(report)]
    if tables := report.get("tables"):
        follow = "are rewritten as the model predicts" if report["status"]["mode"] == "on" else "stay as they are"
        lines.append(f"the tables {follow}: {', '.join(f'{key} in {path}' for key, path in tables.items())}")
    return lines


def held(status: Mapping[str, Any]) -> str:
    """Why the correction does not follow the model although that is ordered, in words; "" where it does."""
    if status["mode"] != "on" or "HELD" not in status["flags"]:
        return ""
    devices = [f"device {name}: {joined(texts)}" for name, texts in status["devices"].items()]
    return "; ".join([*devices, *status["reasons"]]) or "no reason is given"


def state_word(status: Mapping[str, Any]) -> tuple[str, str]:
    """The state of the correction in one word (on, held, off, starting), and why it is held; "" where it is not."""
    if why := held(status):
        return "held", why
    if status["mode"] == "hold":
        return "held", "ordered by an operator"
    return status["mode"] or "starting", ""


def stays(report: Mapping[str, Any]) -> str:
    """What a correction does that is held: it stays, or goes back to a limit that was lowered below it."""
    if beyond := report.get("beyond_stop"):
        return f"goes back to stop_um of {listed(list(beyond))} at its slew limit, and stays there"
    return "stays where it is"


def _mode_line(report: Mapping[str, Any]) -> str:
    status = report["status"]
    if not report.get("actuator", True):
        return f"mode {status['mode'] or 'starting'}; without an actuator the loop commands nothing"
    if held(status):
        return f"mode on is ordered, but the correction {stays(report)}: see why"
    if status["mode"] == "hold":
        return f"mode hold: the correction {stays(report)}"
    return f"mode {_MODES.get(status['mode'], status['mode'])}"


def footer(report: Mapping[str, Any]) -> list[str]:
    """Sentences below the tables."""
    status = report["status"]
    hours = status["time_s"] / 3600
    lasted = f"{hours:.1f} h" if hours >= 1 else f"{status['time_s']:.0f} s"
    lines = [f"{status['cycles']} cycles in {lasted}, {status['misses']} deadlines missed"]
    if status["overruns"]:
        lines.append(f"{status['overruns']} rows of this run are in no log; the events say when and why")
    lines += _residual(report["left"])
    if status["reload"]:
        lines.append(status["reload"])
    control = report["control"]
    bad = control["refused"] + control["malformed"] + control["not_let_in"]
    if bad:
        lines.append(
            f"control: {control['refused']} requests refused, {control['malformed']} not understood, "
            f"{control['not_let_in']} connections cut to make room"
        )
    return lines


def _residual(residual: Mapping[str, Any]) -> list[str]:
    """Source of the residuals; without a comparison, the residual in the model's history."""
    lines = [
        f"residual of {axis}: root mean square of {', '.join(of['from'])}; noise {of['noise_um']:.2f} µm"
        for axis, of in residual["axes"].items()
    ]
    if residual["trouble"]:
        lines.append(f"residual: {residual['trouble']}")
    elif not lines and residual["model"]["rms"] is not None:
        unit = ERROR_UNITS.get(residual["model"]["unit"], residual["model"]["unit"])
        lines.append(
            f"residual of the model: {residual['model']['rms']:.2f} {unit} on held-out runs, all axes together"
        )
    return lines


def troubles(report: Mapping[str, Any]) -> list[str]:
    """Present faults, a line each."""
    status = report["status"]
    lines = [f"device {name}: {joined(texts)}" for name, texts in status["devices"].items()]
    lines += [f"{name}: {text}" for name, text in status["parts"].items()]
    if status["log"]:
        lines.append(f"log: {status['log']}")
    if stands_s := _stands_s(report):
        lines.append(f"the loop stands: its newest row is {stands_s:.1f} s old")
    return lines


def _stands_s(report: Mapping[str, Any]) -> float:
    """For how long the loop has stood, s; 0 where it runs."""
    age_s: float = report.get("status_age_s") or 0.0
    return age_s if age_s > STALLED_S else 0.0


def reasons_not_ordered(status: Mapping[str, Any]) -> list[str]:
    """Reasons of the correction's state without those that are what the ordered mode does."""
    from rtec.correction.flags import REASONS, Flag

    of_mode = {"off": (Flag.ORDERED_OFF, Flag.FADING), "hold": (Flag.ORDERED_HOLD,)}
    ordered = {REASONS[f] for f in of_mode.get(status["mode"], ())}
    return [r for r in status["reasons"] if r not in ordered]


def um_text(value: float | None) -> str:
    """A correction in words; null or NaN as "not known"."""
    return "not known" if value is None or math.isnan(value) else f"{round(value, 2) + 0.0:+.2f}"  # no -0.00


def _age(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
