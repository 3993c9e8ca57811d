"""Replays a log, or every log of a folder, each from its own beginning."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rtec.errors import LogError
from rtec.log.folder import log_files
from rtec.loop.run_file import Setup
from rtec.replay.replay import MOST_DIFFERENCES, Difference, ReplayReport, replay_log


def replay_logs(
    setup: Setup,
    path: Path,
    out: Path | None = None,
    check: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ReplayReport:
    """Step through a log, or through all logs of a folder.

    Args:
        setup: whose model, limits and machine are used.
        path: log or folder.
        out: as for `rtec.replay.replay.replay_log`; not for a folder.
        check: compare with the commands in the log; for a folder always.
        progress: told rows (of a folder: files) done, and in all.

    Returns:
        for a folder the sum; rows are numbered through, notes name their file.

    Raises:
        LogError: the log cannot be read, the folder has none, or `out` was given for a folder.
    """
    if not path.is_dir():
        return replay_log(setup, path, out, check, progress)
    if out is not None:
        raise LogError(f"{path}: is a folder; its logs are checked, nothing is written: leave --out away")
    paths = log_files(path)
    if not paths:
        raise LogError(f"{path}: no logs in this folder")
    total = ReplayReport()
    for k, each in enumerate(paths):
        try:
            _add(total, replay_log(setup, each, None, True), each.name)
        except LogError as error:
            total.unread.append(str(error))
        if progress is not None:
            progress(k + 1, len(paths))
    return total


def _add(total: ReplayReport, one: ReplayReport, name: str) -> None:
    moved: list[Difference] = [replace(d, row=d.row + total.rows) for d in one.differences]
    total.differences = (total.differences + moved)[:MOST_DIFFERENCES]
    total.rows += one.rows
    total.different += one.different
    total.unchecked += one.unchecked
    total.torn_bytes += one.torn_bytes
    total.notes += [f"{name}: {note}" for note in one.notes]
