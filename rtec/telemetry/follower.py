"""Follows a daemon by the local socket that only reads the status, and keeps the newest status."""

import asyncio
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from rtec.control.messages import RequestError, read_answer, request
from rtec.control.places import status_of_config
from rtec.errors import RtecError
from rtec.telemetry.values import stands

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
