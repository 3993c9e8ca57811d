"""Names of the files of logs, and the only order they have: run by run, file by file as they were begun.

`mill-000012-20260309T133000Z-3.arrows` is the third file of the twelfth run logged into that folder. The date is for
people; where the clock was set back between two runs the numbers still tell which came first.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from rtec.errors import LogError
from rtec.log.log_open import PACKED

WRITTEN: Final = ".arrows"
_NAME: Final = re.compile(r"(?P<stem>.*?)(-(?P<run>\d{6,}))?-(?P<date>\d{8}T\d{6}Z)(-(?P<file>\d{1,7}))?", re.ASCII)


@dataclass(frozen=True, order=True)
class Place:
    """Where a file stands among the others.

    Attributes:
        run: number of its run; 0 for a file that has none.
        name: of its run.
        file: number within the run.
    """

    run: int
    name: str
    file: int


def place_of(path: Path) -> Place:
    """Read a file's place from its name."""
    found = _NAME.fullmatch(path.stem)
    if found is None:
        return Place(0, path.stem, 1)
    run, name = int(found["run"] or 0), path.stem[: found.end("date")]
    return Place(run, name, int(found["file"] or 1))


def log_files(folder: Path) -> list[Path]:
    """All logs of a folder, by their names alone, oldest first; where both forms of one are there, the written one."""
    try:
        found = [p for p in folder.iterdir() if p.suffix in (WRITTEN, PACKED) and not p.name.startswith(".")]
    except OSError:
        return []
    return sorted((p for p in found if p.suffix == WRITTEN or p.with_suffix(WRITTEN) not in found), key=place_of)


def newest_log(path: Path) -> Path:
    """Give the newest log of a folder; a log stands for itself.

    Raises:
        LogError: the folder has none.
    """
    if not path.is_dir():
        return path
    if not (found := log_files(path)):
        raise LogError(f"log {path}: no logs in this folder")
    return found[-1]


def next_log(folder: Path, path: Path) -> Path | None:
    """Give the log that was begun after this one; None where there is none, or no folder."""
    return next((p for p in log_files(folder) if place_of(p) > place_of(path)), None) if folder.is_dir() else None


def first_name(folder: Path, stem: str, started: str) -> Path:
    """Name of the first file of a run.

    Args:
        folder: of the logs.
        stem: of the run file.
        started: date and time, as in `20260309T133000Z`.
    """
    run = 1 + max((place_of(path).run for path in log_files(folder)), default=0)
    return folder / f"{stem}-{run:06d}-{started}{WRITTEN}"
