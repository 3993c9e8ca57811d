"""The published values of all protocols: quantities with units, and the reasons of the guard as conditions.

They come from the newest status, by the local socket of the daemon that only reads the status.
"""

import asyncio
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, Literal

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
    """The values of each axis, by `OF_AXIS`; None where unknown."""
    status, residual = report["status"], report["left"]["axes"]
    return {
        axis: {
            "position_mm": status["position_mm"].get(axis),
            "requested_um": status["requested_um"].get(axis),
            "applied_um": status["applied_um"].get(axis),
            "residual_um": residual.get(axis, {}).get("rms_um"),
        }
        for axis in report["axes"]
    }


def sensors(report: Mapping[str, Any]) -> dict[str, dict[str, float | None]]:
    """The values of each temperature sensor, by `OF_SENSOR`."""
    status = report["status"]
    degc, age_s = status["degc"], status["degc_age_s"]
    return {
        name: {
            "temperature_degc": degc.get(name),
            "age_s": None if degc.get(name) is None else age_s.get(name),
        }
        for name in report["sensors"]
    }


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
