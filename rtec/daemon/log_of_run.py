"""Where the log of a run goes, and what stands at the beginning of each of its files."""

import os
import platform
from collections.abc import Mapping
from pathlib import Path

from rtec.errors import LogError
from rtec.log.folder import first_name, time_header
from rtec.log.reader import LogWriter
from rtec.loop.clock import Clock, wall_clock_iso
from rtec.loop.records import Layout
from rtec.loop.run_file import Setup


def log_folder(setup: Setup) -> Path | None:
    """Folder of the logs of a run file, else the one that systemd gives (LOGS_DIRECTORY); None: no log is asked for."""
    folder = setup.file.run.log_folder
    if folder is None:
        given = os.environ.get("LOGS_DIRECTORY", "").split(":", maxsplit=1)[0]
        return Path(given).resolve() if given else None
    return (setup.base / folder).resolve()


def new_log_path(setup: Setup) -> Path | None:
    """Name of the log of a run that starts now: by number, date and time, in the run file's log folder.

    Raises:
        LogError: the folder cannot be made.
    """
    folder = log_folder(setup)
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise LogError(f"{folder}: cannot be made: {e.strerror}") from e
    return first_name(folder, setup.path.stem, wall_clock_iso().replace(":", "").replace("-", ""))


def new_log(path: Path, setup: Setup, layout: Layout, clock: Clock, begin: Mapping[str, str]) -> LogWriter:
    """Begin a file of the log.

    Args:
        path: of the file.
        setup: what is in force.
        layout: axes and sensors.
        clock: monotonic; its relation to date and time stands in the header.
        begin: what else the header says: everything that the step remembers.

    Raises:
        LogError: the file cannot be made.
    """
    header = {
        **setup.log_header(),
        "host": platform.node(),
        "python": platform.python_version(),
        "started": wall_clock_iso(),
        **time_header(clock),
        **begin,
    }
    return LogWriter(path, layout, header)
