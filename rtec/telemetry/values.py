"""The published values of all protocols: quantities with units, and the reasons of the guard as conditions.

They come from the newest status, by the local socket of the daemon that only reads the status.
"""

import asyncio
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

from rtec.control.facts import positions_unknown
from rtec.control.messages import RequestError, read_answer, request
from rtec.control.places import status_of_config
from rtec.correction.flags import HOLD_REASONS, REASONS, Flag
from rtec.errors import RtecError
from rtec.loop.clock import wall_clock_ns
from rtec.text import clean

STALLED_S: Final = 1.0
"""Age, s, of the newest row above which the loop counts as stalled, and its values as outdated."""
ORDERED: Final = Flag.ORDERED_HOLD | Flag.ORDERED_OFF
Level = Literal["fault", "warning"]


@dataclass(frozen=True)
class Quantity:
    """One kind of value.

    Attributes:
        key: its name; ends with the unit if it has one.
        unit: "mm", "um", "degc", "s", "rpm"; "" without one.
        words: description, for people.
    """

    key: str
    unit: str
    words: str


OF_AXIS: Final = (
    Quantity("position_mm", "mm", "Position by the encoder counts, without the correction"),
    Quantity("requested_um", "um", "Correction that the model asks for"),
    Quantity("applied_um", "um", "Correction that is applied"),
    Quantity("residual_um", "um", "Residual of the last measurement, root mean square"),
)
OF_SENSOR: Final = (
    Quantity("temperature_degc", "degc", "Temperature"),
    Quantity("age_s", "s", "Age of the temperature"),
)
OF_MACHINE: Final = (
    Quantity("spindle_rpm", "rpm", "Spindle speed"),
    Quantity("mode", "", "Mode that is ordered: on, hold or off"),
    Quantity("cycles", "", "Cycles of the loop"),
    Quantity("deadlines_missed", "", "Deadlines that the loop missed"),
)


@dataclass(frozen=True)
class StatusCondition:
    """A reason for which the applied correction is not the requested one, or a part that does not work.

    Attributes:
        code: constant while it lasts: name of a flag, "device NAME" or "part NAME".
        level: "fault": the correction is held, or a device or part is in trouble; else "warning".
        text: description in words.
    """

    code: str
    level: Level
    text: str


def axes(report: Mapping[str, Any]) -> dict[str, dict[str, float | None]]:
    """The values of each axis, by `OF_AXIS`; None where unknown. A position that is stale or has no zero is unknown."""
    status, residual = report["status"], report["left"]["axes"]
    current = Flag.STALE_COUNTS.name not in status["flags"] and not positions_unknown(status)
    return {
        axis: {
            "position_mm": _rounded(status["position_mm"].get(axis)) if current else None,
            "requested_um": _rounded(status["requested_um"].get(axis)),
            "applied_um": _rounded(status["applied_um"].get(axis)),
            "residual_um": _rounded(residual.get(axis, {}).get("rms_um")),
        }
        for axis in report["axes"]
    }


def sensors(report: Mapping[str, Any]) -> dict[str, dict[str, float | None]]:
    """The values of each temperature sensor, by `OF_SENSOR`; a temperature that the guard calls stale is unknown.

    As for the guard, an instant of the future is as old as it is ahead.
    """
    status, most_s = report["status"], report["temperature_max_age_s"]
    out: dict[str, dict[str, float | None]] = {}
    for name in report["sensors"]:
        degc, age_s = status["degc"].get(name), status["degc_age_s"].get(name)
        age_s = None if degc is None or age_s is None else abs(age_s)
        current = age_s is not None and age_s <= most_s
        out[name] = {"temperature_degc": degc if current else None, "age_s": _rounded(age_s, 3)}
    return out


def _rounded(value: float | None, digits: int = 6) -> float | None:
    """Without the digits that only arithmetic has made."""
    return None if value is None else round(value, digits)


def machine(report: Mapping[str, Any]) -> dict[str, float | str | None]:
    """The values of the whole machine, by `OF_MACHINE`."""
    status = report["status"]
    return {
        "spindle_rpm": status["spindle_rpm"],
        "mode": status["mode"] or None,
        "cycles": status["cycles"],
        "deadlines_missed": status["misses"],
    }


def conditions(report: Mapping[str, Any]) -> Iterator[StatusCondition]:
    """All present faults and orders."""
    status = report["status"]
    for flag, text in REASONS.items():
        if flag.name in status["flags"]:
            held = int(flag) & HOLD_REASONS and not flag & ORDERED
            yield StatusCondition(str(flag.name), "fault" if held else "warning", text)
    for name, texts in status["devices"].items():
        yield StatusCondition(clean(f"device {name}"), "fault", clean("; ".join(texts)))
    for name, text in status["parts"].items():
        yield StatusCondition(clean(f"part {name}"), "fault", clean(text))
    if status["log"]:
        yield StatusCondition("log", "warning", clean(status["log"]))


_DURATION: Final = re.compile(r"\d+(\.\d+)?(?= (ms|s|min|h)\b)")


def steady(new: Iterable[StatusCondition], before: Mapping[str, StatusCondition]) -> dict[str, StatusCondition]:
    """Conditions by code; one of which only durations have changed stays as it was.

    "No message for 1.2 s" would else be another one ten times a second, and push all else out of a client's history.
    """
    out: dict[str, StatusCondition] = {}
    for one in new:
        old = before.get(one.code)
        same = old is not None and (old.level, _DURATION.sub("", old.text)) == (one.level, _DURATION.sub("", one.text))
        out[one.code] = old if same and old is not None else one
    return out


def stands(report: Mapping[str, Any]) -> bool:
    """Is the loop stalled, or not started? Then a status has no current values."""
    age_s = report["status_age_s"]
    return age_s is None or age_s > STALLED_S


def instant(report: Mapping[str, Any] | None = None) -> str:
    """Date and time of a status' newest row, or of now: UTC, ISO 8601 with milliseconds."""
    age_s = 0.0 if report is None else report["status_age_s"] or 0.0
    at = datetime.fromtimestamp(wall_clock_ns() * 1e-9 - age_s, UTC)
    return at.strftime("%Y-%m-%dT%H:%M:%S.") + f"{at.microsecond // 1000:03d}Z"


LARGEST_STATUS: Final = 4 * 1024 * 1024
SILENT_S: Final = 15.0
"""A daemon that sends no status for this time, s, is lost; `status_hz` is at least 0.1."""
AGAIN_S: Final = 0.5
"""Wait, s, before the next attempt to reach a daemon that does not run."""


class Follower:
    """Keeps the newest status while `follow` runs.

    Args:
        config: run file of the daemon.
        name: name of the protocol in the daemon's events.

    Attributes:
        report: newest status; None where no daemon answers.
    """

    def __init__(self, config: Path, name: str) -> None:
        self._config, self._name = config, name
        self.report: Mapping[str, Any] | None = None

    @property
    def live(self) -> Mapping[str, Any] | None:
        """The newest status if its values are current; else None."""
        return None if self.report is None or stands(self.report) else self.report

    @property
    def state(self) -> str:
        """State in words: "running", "loop stands" or "no daemon"."""
        return "no daemon" if self.report is None else "running" if self.live else "loop stands"

    async def follow(self) -> None:
        """Follow until cancelled, through restarts of the daemon."""
        while True:
            for path in status_of_config(self._config):
                try:
                    await self._read(path)
                except (OSError, RequestError, RtecError, EOFError, TimeoutError, asyncio.LimitOverrunError):
                    continue
                finally:
                    self.report = None
            await asyncio.sleep(AGAIN_S)

    async def _read(self, path: Path) -> None:
        reader, writer = await asyncio.open_unix_connection(path, limit=LARGEST_STATUS)
        try:
            writer.write(request("as", 0, name=self._name, role="read") + b"\n" + request("watch", 1) + b"\n")
            while True:
                async with asyncio.timeout(SILENT_S):
                    answer = read_answer(await reader.readuntil(b"\n"))
                if "error" in answer or "refused" in answer:
                    raise RtecError(str(answer))
                if "status" in answer:
                    self.report = answer
        finally:
            writer.close()
