"""Packs closed logs and removes the oldest where they take too much of the disk: once through a folder.

    python -m rtec.log.tidy FOLDER DISK_SHARE PACK

The daemon starts this as a process of its own at the lowest priority: packing takes the processor for a second or so,
and removing a large file can block for any length of time. The result is one line of JSON on standard output. A file
that is being written is locked, and is skipped.
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
from rtec.log.folder import WRITTEN, being_written, log_files, look_at, place_of
from rtec.log.packed import PACKED, pack
from rtec.log.reader import open_log
from rtec.log.recording import events_path

NICE: Final = 19
MOST_REPORTED: Final = 20


@dataclass
class Tidied:
    """Result.

    Attributes:
        packed: names of files that are now Parquet.
        removed: names of files that were removed to free space.
        troubles: failures, with their reasons.
    """

    packed: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)


def tidy(folder: Path, most_bytes: int, wants_pack: bool = True) -> Tidied:
    """Remove the oldest logs beyond the limit, then pack closed ones; does nothing while another process does it.

    Args:
        folder: folder of the logs.
        most_bytes: largest size of all logs together.
        wants_pack: pack, too?
    """
    done = Tidied()
    with _alone(folder) as alone:
        if alone:
            for part in folder.glob(f".*{PACKED}.part"):  # from a process that was killed
                part.unlink(missing_ok=True)
            _thin(folder, most_bytes, done)
            for path in [p for p in log_files(folder) if p.suffix == WRITTEN] if wants_pack else []:
                _pack_one(path, done)
    return done


def _thin(folder: Path, most_bytes: int, done: Tidied) -> None:
    """Remove the oldest; never one that is being written, never the newest."""
    paths = log_files(folder)
    sizes = {path: _bytes(path) for path in paths}
    total = sum(sizes.values())
    for path in paths[:-1]:
        if total <= most_bytes:
            return
        if being_written(path):
            continue
        try:
            path.unlink()
            total -= sizes[path]
            done.removed.append(path.name)
            _remove_events(path, log_files(folder))
        except OSError as error:
            done.troubles.append(f"{path}: cannot be removed: {error.strerror}")


def _remove_events(path: Path, remaining: list[Path]) -> None:
    """Remove the events of a run with the last of its files."""
    run = place_of(path).name
    events = events_path(path.with_name(run + WRITTEN))
    if events is not None and all(place_of(other).name != run for other in remaining):
        events.unlink(missing_ok=True)


def _pack_one(path: Path, done: Tidied) -> None:
    """Pack a file that was closed, by its writer or by a kill; one that is damaged inside stays unchanged."""
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
    """Take the folder's lock; False where another process has it, or the folder does not exist."""
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
    """Run as a process of its own."""
    import pyarrow as pa

    folder, share, wants_pack = Path(arguments[0]), float(arguments[1]), arguments[2] == "pack"
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the daemon; this process ends soon
    with suppress(OSError):
        os.nice(NICE)
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)
    done = tidy(folder, round(share * shutil.disk_usage(folder).total), wants_pack)
    result = {key: value[:MOST_REPORTED] for key, value in asdict(done).items()}
    sys.stdout.write(json.dumps(result) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
