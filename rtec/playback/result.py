"""A replay as one result, for a log, a folder of logs, or a capture."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from rtec.errors import ConfigError
from rtec.loop.run_file import load_setup
from rtec.playback.capture import CaptureReport, replay_capture
from rtec.playback.replay import ReplayReport, replay_logs
from rtec.result import Result


@dataclass(frozen=True)
class Replayed(Result):
    """Result of a replay.

    Attributes:
        report: report on the log, or on the capture.
        checked: were the commands compared with the logged ones?
    """

    page_maker: ClassVar[str] = "rtec.report.playback:replay_page"

    report: ReplayReport | CaptureReport
    checked: bool

    @property
    def identical(self) -> bool:
        """Was everything read, and is every compared command identical to the logged one?"""
        return isinstance(self.report, CaptureReport) or not (self.report.different or self.report.unread)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        r = self.report
        if isinstance(r, CaptureReport):
            return asdict(r) | {"capture_out": str(r.capture_out), "table_out": str(r.table_out)}
        return asdict(r) | {"out": str(r.out) if r.out else None, "checked": self.checked}

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """For a log the first differences, for a capture its axes."""
        if isinstance(self.report, CaptureReport):
            return [{"axis": name, **asdict(axis)} for name, axis in self.report.axes.items()]
        return [asdict(d) for d in self.report.differences]


def replayed(
    config: Path, log: Path, out: Path | None, *, check: bool, progress: Callable[[str, int, int], None] | None = None
) -> Replayed:
    """Replay a log, a folder of logs (always checked) or a capture (`.sr`).

    Raises:
        ConfigError, LogError: the run file, the log or the capture cannot be used.
    """
    setup = load_setup(config, needs_devices=False)
    tell = (lambda done, total: progress(log.name, done, total)) if progress else None
    if log.suffix == ".sr":
        if check:
            raise ConfigError("--check compares with logged commands; a capture has none, leave it out")
        target = out or log.with_name(f"{log.stem}.replay.sr")
        return Replayed(replay_capture(setup, log, target, target.with_suffix(".csv"), tell), checked=False)
    checked = check or log.is_dir()
    target_log = out or (None if checked else log.with_name(f"{log.stem}.replay.arrows"))
    return Replayed(replay_logs(setup, log, target_log, checked, tell), checked)
