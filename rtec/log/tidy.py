"""Packs closed logs and removes the oldest where they take too much of the disk: once through a folder.

    python -m rtec.log.tidy FOLDER DISK_SHARE PACK

The daemon starts this as a process of its own at the lowest priority: packing takes the processor for a second or so,
and removing a large file can hold its caller up for as long as the disk likes. What came of it stands on standard
output as one line of JSON. A file that is being written is locked, and left alone.
"""

import fcntl
import json
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

from rtec.errors import LogError
from rtec.log.events import events_path
from rtec.log.folder import WRITTEN, being_written, log_files, look_at, place_of
from rtec.log.packed import PACKED, pack
from rtec.log.reader import open_log

NICE: Final = 19
MOST_TOLD: Final = 20


@dataclass
class Tidied:
    """What was done.

    Attributes:
        packed: names of files that are Parquet now.
        removed: names of files that are gone, for their disk space.
        troubles: what could not be done, and why.
    """

    packed: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)


def tidy(folder: Path, most_bytes: int, wants_pack: bool = True) -> Tidied:
    """Remove what is too much, then pack what is closed; does nothing while another process does it.

    Args:
        folder: of the logs.
        most_bytes: all of its logs may have.
        wants_pack: pack too.
    """
    done = Tidied()
    with _alone(folder) as alone:
        if alone:
            for part in folder.glob(f".*{PACKED}.part"):  # of one that was killed
                part.unlink(missing_ok=True)
            _thin(folder, most_bytes, done)
            for path in [p for p in log_files(folder) if p.suffix == WRITTEN] if wants_pack else []:
                _pack_one(path, done)
    return done


def _thin(folder: Path, most_bytes: int, done: Tidied) -> None:
    """Remove the oldest; never one that is being written, never the newest."""
    paths = log_files(folder)
    sizes = {path: _bytes(path) for path in paths}
    left = sum(sizes.values())
    for path in paths[:-1]:
        if left <= most_bytes:
            return
        if being_written(path):
            continue
        try:
            path.unlink()
            left -= sizes[path]
            done.removed.append(path.name)
            _remove_events(path, log_files(folder))
        except OSError as error:
            done.troubles.append(f"{path}: cannot be removed: {error.strerror}")


def _remove_events(path: Path, left: list[Path]) -> None:
    """The events of a run go with the last of its files."""
    run = place_of(path).name
    events = events_path(path.with_name(run + WRITTEN))
    if events is not None and all(place_of(other).name != run for other in left):
        events.unlink(missing_ok=True)


def _pack_one(path: Path, done: Tidied) -> None:
    """Pack a file that is closed, by its writer or by a kill; one that is damaged inside stays as it is."""
    segment = look_at(path)
    if segment.state not in ("whole", "torn") or not segment.rows:
        return
    target = path.with_suffix(PACKED)
    try:
        with open_log(path) as log:
            if not target.exists():
                pack(log, target)
            with open_log(target) as packed:
                same = (packed.header, packed.rows, packed.layout) == (log.header, log.rows, log.layout)
        if not same:
            raise LogError(f"log {target}: holds something else than {path.name}; move one of them away")
        path.unlink()
        done.packed.append(target.name)
    except OSError as error:
        done.troubles.append(f"{path}: packed, but cannot be removed: {error.strerror}")
    except LogError as error:
        done.troubles.append(str(error))


@contextmanager
def _alone(folder: Path) -> Iterator[bool]:
    """Take the folder's lock; False where another has it, or there is no folder."""
    try:
        fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        yield False
        return
    try:
        with suppress(BlockingIOError):
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield True
            return
        yield False
    finally:
        os.close(fd)


def _bytes(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_size
    return 0


def main(arguments: list[str]) -> int:
    """Do it as a process of its own."""
    import pyarrow as pa

    folder, share, wants_pack = Path(arguments[0]), float(arguments[1]), arguments[2] == "pack"
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the daemon; what is half done here is soon done
    with suppress(OSError):
        os.nice(NICE)
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)
    done = tidy(folder, round(share * shutil.disk_usage(folder).total), wants_pack)
    told = {key: value[:MOST_TOLD] for key, value in asdict(done).items()}
    sys.stdout.write(json.dumps(told) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
