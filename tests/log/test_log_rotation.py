"""Logs for months: new files, packing, what may stay on the disk, finding by time, damage.

Oracles: the rows that were written, bit for bit; pyarrow's own Parquet reader; file sizes; the kernel's full disk.
"""

import json
import os
import random
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from rtec.daemon.disk import TIDY_ANYWAY_NS, TIDY_NS, Keeper
from rtec.errors import LogError
from rtec.log.folder import being_written, first_name, log_files, logs_at, look_at, next_log, place_of
from rtec.log.packed import pack
from rtec.log.reader import LogReader, open_log
from rtec.log.recording import RETRY_NS, Begin, Recording, free_path
from rtec.log.stretch import segments_of
from rtec.log.tidy import tidy
from rtec.log.writer import LogWriter
from rtec.loop.clock import Clock, VirtualClock
from rtec.loop.records import Layout
from rtec.loop.run_file import LogTable
from tests.support.log_rig import LAYOUT, NOON_NS, read, rows, same, write

PLENTY = 1 << 60


@pytest.mark.parametrize("layout", [LAYOUT, Layout(("X",), ()), Layout(("X", "Y", "Z"), ("A", "µ [°]"))])
def test_packed_and_read_again_it_is_the_same_to_the_last_bit(tmp_path: Path, layout: Layout) -> None:
    """NaN with and without a payload, infinities, minus zero, full-range integers; header and layout too."""
    path = write(tmp_path / "a.arrows", 0, 700, layout=layout, flush=90)
    with open_log(path) as log:
        assert pack(log, tmp_path / "a.parquet") == 700
        with pytest.raises(LogError, match="exists already"):
            pack(log, tmp_path / "a.parquet")
    with LogReader(path) as log, open_log(tmp_path / "a.parquet") as packed:
        assert (packed.rows, packed.header, packed.layout, packed.span_ns) == (700, log.header, layout, log.span_ns)
        assert (packed.complete, packed.torn_bytes) == (True, 0)
        for start, size in ((0, 65_536), (0, 13), (1, 64), (699, 1), (700, 5)):
            wanted = rows(0, 700, layout=layout)
            assert same(list(packed.blocks(size, start)), (wanted[0].rows(start, 700), wanted[1].rows(start, 700)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.arrows", "a.parquet"]


def test_many_groups_of_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows are found in whichever group they lie. Oracle: pyarrow counts the groups."""
    monkeypatch.setattr("rtec.log.format.CHUNK_ROWS", 100)
    path = write(tmp_path / "a.arrows", 0, 730, flush=30)
    with open_log(path) as log:
        pack(log, tmp_path / "a.parquet")
    assert pq.ParquetFile(tmp_path / "a.parquet").num_row_groups == 7
    block = rows(0, 730)
    with open_log(tmp_path / "a.parquet") as packed:
        for start in (0, 1, 119, 120, 121, 500, 729):
            assert same(list(packed.blocks(64, start)), (block[0].rows(start, 730), block[1].rows(start, 730))), start


def test_any_program_reads_a_packed_log(tmp_path: Path) -> None:
    """Oracle: pyarrow's Parquet reader; an applied correction that is the requested one is an empty cell."""
    with open_log(write(tmp_path / "a.arrows", 0, 300)) as log:
        pack(log, tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    samples, commands = rows(0, 300)
    assert table["counts_Z"].to_numpy().tolist() == samples.counts[:, 1].tolist()
    bits = (commands.applied_um[:, 0].copy().view(np.int64), commands.requested_um[:, 0].copy().view(np.int64))
    assert table["applied_um_X"].null_count == np.count_nonzero(bits[0] == bits[1]) > 200
    column = pq.ParquetFile(tmp_path / "a.parquet").metadata.row_group(0).column(0)
    assert column.compression == "ZSTD"


def test_names_give_the_order_whatever_the_clock_said(tmp_path: Path) -> None:
    """Run 2 was begun after the clock was set back a year; run 10 comes behind run 9, file 10 behind file 9."""
    wanted = [
        "old-20260101T000000Z.arrows",
        "mill-000001-20260309T120000Z.parquet",
        *(f"mill-000001-20260309T120000Z-{k}.parquet" for k in range(2, 12)),
        "mill-000002-20250309T120000Z.arrows",
        "mill-000009-20250310T120000Z.arrows",
        "mill-000010-20250310T120000Z.arrows",
        "mill-1000000-20240310T120000Z.arrows",
    ]
    for name in random.Random(1).sample(wanted, len(wanted)):
        (tmp_path / name).touch()
    (tmp_path / ".mill.parquet.part").touch()
    (tmp_path / "mill.events.jsonl").touch()
    assert [p.name for p in log_files(tmp_path)] == wanted
    assert first_name(tmp_path, "mill", "20260401T000000Z").name == "mill-1000001-20260401T000000Z.arrows"
    assert first_name(tmp_path / "new", "a-b", "20260401T000000Z").name == "a-b-000001-20260401T000000Z.arrows"
    first = tmp_path / wanted[1]
    assert next_log(tmp_path, first) == tmp_path / wanted[2]
    assert logs_at(tmp_path)[-1] == tmp_path / wanted[-1]
    assert next_log(tmp_path, tmp_path / wanted[-1]) is None


def test_the_next_file_of_a_run_comes_behind_it() -> None:
    """`free_path` names it, `place_of` must read it so."""
    path = first_name(Path("/no/such/folder"), "mill-3", "20260309T120000Z")
    second = free_path(path)
    third = free_path(second)
    places = [place_of(p) for p in (path, second, third)]
    assert places == sorted(places)
    assert {(p.run, p.name) for p in places} == {(1, "mill-3-000001-20260309T120000Z")}


# Tidying -----------------------------------------------------------------------------------------------------------


def fill(folder: Path, files: int, n: int = 400) -> list[Path]:
    """A run of so many closed files, and the next being written."""
    folder.mkdir(exist_ok=True)
    path = first_name(folder, "mill", "20260309T120000Z")
    out = [path]
    for k in range(files):
        write(out[-1], k * n, n)
        out.append(free_path(out[-1]))
    return out


def test_tidying_packs_what_is_closed_and_leaves_what_is_written(tmp_path: Path) -> None:
    *closed, newest = fill(tmp_path, 3)
    with LogWriter(newest, LAYOUT, {}) as writer:
        writer.write(*rows(1200, 10))
        writer.flush()
        assert (being_written(newest), being_written(closed[0])) == (True, False)
        done = tidy(tmp_path, PLENTY)
        assert done.packed == [p.with_suffix(".parquet").name for p in closed]
        assert (done.removed, done.troubles) == ([], [])
        assert log_files(tmp_path) == [*(p.with_suffix(".parquet") for p in closed), newest]
        assert [s.state for s in segments_of(tmp_path)] == ["packed"] * 3 + ["being written"]
        assert not tidy(tmp_path, PLENTY).packed
    for k, path in enumerate(closed):
        assert same(read(path.with_suffix(".parquet")), rows(400 * k, 400))
    assert tidy(tmp_path, PLENTY).packed == [newest.with_suffix(".parquet").name]


def test_without_packing_files_stay_as_they_are(tmp_path: Path) -> None:
    *closed, _ = fill(tmp_path, 2)
    assert tidy(tmp_path, PLENTY, wants_pack=False).packed == []
    assert log_files(tmp_path) == closed


def test_the_oldest_go_and_never_the_one_that_is_written(tmp_path: Path) -> None:
    """Oracle: sizes by stat. The file being written is by far the largest, and alone more than is allowed."""
    *closed, newest = fill(tmp_path, 4)
    events = closed[0].with_suffix(".events.jsonl")
    events.write_text("{}\n")
    with LogWriter(newest, LAYOUT, {}) as writer:
        writer.write(*rows(1600, 9000))
        writer.flush()
        sizes = [p.stat().st_size for p in (*closed, newest)]
        assert sizes[-1] > sum(sizes[:-1])
        done = tidy(tmp_path, sum(sizes[2:]), wants_pack=False)
        assert done.removed == [p.name for p in closed[:2]]
        assert log_files(tmp_path) == [*closed[2:], newest]
        tidy(tmp_path, 1, wants_pack=False)
        assert log_files(tmp_path) == [newest]
        assert events.exists(), "events stay as long as a file of their run does"
    write(first_name(tmp_path, "mill", "20260310T120000Z"), 0, 10)
    tidy(tmp_path, 1, wants_pack=False)
    assert [p.name for p in tmp_path.iterdir()] == ["mill-000002-20260310T120000Z.arrows"]


def test_one_that_is_written_by_another_run_is_passed_over(tmp_path: Path) -> None:
    """Two machines may log into one folder: the older run's file is locked, the newer one is closed."""
    with LogWriter(first_name(tmp_path, "a", "20260309T120000Z"), LAYOUT, {}) as writer:
        writer.write(*rows(0, 100))
        writer.flush()
        for k in range(2):
            write(first_name(tmp_path, "b", f"20260309T12000{k}Z"), 0, 100)
        done = tidy(tmp_path, 1, wants_pack=False)
    assert done.removed == ["b-000002-20260309T120000Z.arrows"]


def test_a_killed_tidying_is_taken_up_again(tmp_path: Path) -> None:
    """Killed while it wrote: a piece is left. Killed before it removed the original: both are left. Nothing is lost."""
    *closed, _ = fill(tmp_path, 2)
    (tmp_path / f".{closed[0].stem}.parquet.part").write_bytes(b"PAR1 half")
    with open_log(closed[1]) as log:
        pack(log, closed[1].with_suffix(".parquet"))
    assert log_files(tmp_path) == closed
    tidy(tmp_path, PLENTY)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.with_suffix(".parquet").name for p in closed)
    assert same(read(closed[1].with_suffix(".parquet")), rows(400, 400))


def test_another_file_of_that_name_is_never_taken_for_the_packed_one(tmp_path: Path) -> None:
    *closed, _ = fill(tmp_path, 1)
    other = write(tmp_path / "other.arrows", 5, 400)
    with open_log(other) as log:
        pack(log, closed[0].with_suffix(".parquet"))
    other.unlink()
    (trouble,) = tidy(tmp_path, PLENTY).troubles
    assert "holds something else" in trouble
    assert same(read(closed[0]), rows(0, 400))


def test_tidying_runs_once_at_a_time_and_as_a_process(tmp_path: Path) -> None:
    """Oracle: the process that holds the folder's lock gets it all; JSON of the other says that it did nothing."""
    import fcntl

    fill(tmp_path, 2)
    command = [sys.executable, "-m", "rtec.log.tidy", str(tmp_path), "1.0", "pack"]
    fd = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(fd, fcntl.LOCK_EX)
    busy = subprocess.run(command, capture_output=True, check=True, timeout=600)
    os.close(fd)
    free = subprocess.run(command, capture_output=True, check=True, timeout=600)
    assert json.loads(busy.stdout) == {"packed": [], "removed": [], "troubles": []}
    assert len(json.loads(free.stdout)["packed"]) == 2


# The keeper: a new file by size, by age, by a step of the clock ------------------------------------------------------


class Watches:
    """Both clocks, in the test's hands."""

    def __init__(self) -> None:
        self.clock, self.wall_ns = VirtualClock(), NOON_NS

    def both(self, clock: Clock) -> tuple[int, int]:
        return clock.now_ns(), self.wall_ns + clock.now_ns()


class Kept:
    """A recording with its keeper, fed a second at a time."""

    def __init__(self, folder: Path, rules: LogTable) -> None:
        self.watches, self.told = Watches(), list[tuple[str, str]]()
        self.clock, self.row, self.ahead = self.watches.clock, 0, 6
        self.recording = Recording(first_name(folder, "mill", "20260309T120000Z"), self.clock, self.open)
        self.recording.begin(Begin(0, {}))
        self.keeper = Keeper(folder, rules, self.clock, self.tell, self.watches.both)

    def tell(self, what: str, text: str) -> None:
        self.told.append((what, text))

    def open(self, path: Path, begin: Any) -> LogWriter:
        return LogWriter(path, LAYOUT, dict(begin))

    def seconds(self, n: int) -> None:
        for _ in range(n):
            self.clock.sleep_until_ns(self.clock.now_ns() + 1_000_000_000)
            self.recording.write(*rows(self.row, 100), self.row)
            self.row += 100
            self.recording.flush()
            self.keeper.look(self.recording, self.newest)

    def newest(self) -> Any:
        """The loop is some rows ahead of what reaches the disk."""
        state = SimpleNamespace(floats=np.zeros(0), ints=np.zeros(0, np.int64))
        return SimpleNamespace(row=self.row + self.ahead, structure=b"", output=np.zeros(2, np.int64), state=state)


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands of the processes that a keeper starts; they are not."""
    commands: list[list[str]] = []

    class Ended:
        returncode = 0

        def __init__(self, command: list[str], **_: Any) -> None:
            commands.append(command)

        def poll(self) -> int:
            return 0

        def communicate(self, timeout: float = 0.0) -> tuple[bytes, bytes]:
            del timeout
            return b'{"packed": [], "removed": ["a.parquet"], "troubles": ["no room"]}', b""

        def terminate(self) -> None:
            commands.append(["terminate"])

    monkeypatch.setattr("rtec.daemon.disk.Popen", Ended)
    return commands


def first_rows(folder: Path) -> list[int]:
    return [look_at(p).rows and int(read(p)[0][0].time_ns[0]) // 1_000_000 for p in log_files(folder)]


def test_a_new_file_by_age_and_none_is_lost_between(tmp_path: Path, started: list[list[str]]) -> None:
    """After 10 s each: the order goes out at rows 1100, 2200, …; the file begins behind the loop's newest row."""
    kept = Kept(tmp_path, LogTable(segment_s=10))
    kept.seconds(35)
    kept.recording.close()
    assert first_rows(tmp_path) == [0, 1107, 2207, 3307]
    assert same([b for p in log_files(tmp_path) for b in read(p)], merged(35))
    assert kept.recording.missed == 0
    assert not started


def merged(seconds: int) -> Any:
    parts = [rows(100 * k, 100) for k in range(seconds)]
    samples, commands = type(parts[0][0]), type(parts[0][1])
    names = parts[0][0].arrays(), parts[0][1].arrays()
    return (
        samples(**{k: np.concatenate([getattr(p[0], k) for p in parts]) for k in names[0]}),
        commands(**{k: np.concatenate([getattr(p[1], k) for p in parts]) for k in names[1]}),
    )


def test_a_new_file_on_a_slow_disk(tmp_path: Path, started: list[list[str]]) -> None:
    """The loop is 4.5 s ahead of what reaches the disk: the first order counts, or the change would never come."""
    kept = Kept(tmp_path, LogTable(segment_s=10))
    kept.ahead = 450
    kept.seconds(30)
    kept.recording.close()
    assert first_rows(tmp_path) == [0, 1551]
    assert not started


def test_a_new_file_by_size(tmp_path: Path, started: list[list[str]]) -> None:
    """Oracle: stat. Each file has passed the limit by a second's rows or two at most."""
    kept = Kept(tmp_path, LogTable(segment_mb=0.1))
    kept.seconds(30)
    kept.recording.close()
    sizes = [p.stat().st_size for p in log_files(tmp_path)]
    assert len(sizes) > 3
    assert all(100_000 <= size < 150_000 for size in sizes[:-1])
    assert same([b for p in log_files(tmp_path) for b in read(p)], merged(30))
    assert not started


def test_a_file_elsewhere_is_left_alone(tmp_path: Path, started: list[list[str]]) -> None:
    """`--log FILE`: one file, however old and large."""
    (tmp_path / "logs").mkdir()
    kept = Kept(tmp_path, LogTable(segment_s=1))
    kept.keeper = Keeper(tmp_path / "logs", LogTable(segment_s=1), kept.clock, lambda *_: None, kept.watches.both)
    kept.seconds(100)
    assert len(log_files(tmp_path)) == 1
    assert not started


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 0.7, -31536000.0])
def test_a_step_of_the_clock_begins_a_new_file(tmp_path: Path, started: list[list[str]], step_s: float) -> None:
    """NTP, somebody who sets the clock, suspend: files keep their order, and each has one relation of the clocks."""
    kept = Kept(tmp_path, LogTable())
    kept.seconds(5)
    kept.watches.wall_ns += round(step_s * 1e9)
    kept.seconds(5)
    kept.watches.wall_ns += 100_000_000
    kept.seconds(30)
    kept.recording.close()
    assert first_rows(tmp_path) == [0, 607]
    assert kept.told == [("clock step", f"the date and time of this computer was set by {step_s:+.3f} s")]
    times = np.concatenate([s.time_ns for p in log_files(tmp_path) for s, _ in read(p)])
    assert (np.diff(times) > 0).all()
    assert not started


def test_tidying_is_started_when_there_is_something_to_do(tmp_path: Path, started: list[list[str]]) -> None:
    """A minute after the start, then where a file was closed since, and once an hour in any case."""
    fill(tmp_path, 1, n=10)
    kept = Kept(tmp_path, LogTable(disk_share=0.25))
    kept.seconds(round(TIDY_NS * 1e-9) - 1)
    assert not started
    kept.seconds(3)
    assert started == [[sys.executable, "-m", "rtec.log.tidy", str(tmp_path), "0.25", "pack"]]
    assert kept.keeper.trouble == "no room"
    assert kept.told == [("logs removed", "for their disk space: a.parquet")]
    kept.seconds(200)
    assert len(started) == 1
    kept.watches.wall_ns += 10**10
    kept.seconds(70)
    assert len(started) == 2
    kept.clock.sleep_until_ns(kept.clock.now_ns() + TIDY_ANYWAY_NS)
    kept.seconds(65)
    assert len(started) >= 3
    kept.keeper.close()


# Full disk -----------------------------------------------------------------------------------------------------------


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A file system of its own, of that size."""
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    if mounted.returncode:
        pytest.skip(f"no right to mount a small disk: {mounted.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to mount a small disk")
def test_a_really_full_disk_drops_counts_and_goes_on(tmp_path: Path, started: list[list[str]]) -> None:
    """Oracle: the kernel's ENOSPC; every row is either in a file or counted."""
    disk = tmp_path / "disk"
    with small_disk(disk, "300k"):
        kept = Kept(disk, LogTable())
        filler = disk / "filler"
        kept.seconds(5)
        filler.write_bytes(bytes(150_000))
        kept.seconds(15)
        assert "No space left on device" in kept.recording.trouble
        assert kept.recording.warnings[0].startswith("logging stopped, the correction went on")
        many = sorted(p.name for p in disk.iterdir())
        for _ in range(6):  # tried again and again: nothing new lies there afterwards
            kept.clock.sleep_until_ns(kept.clock.now_ns() + RETRY_NS)
            assert kept.recording.wants_to_try_again()
            kept.recording.cut(Begin(kept.row, {}))
            kept.seconds(1)
        assert sorted(p.name for p in disk.iterdir()) == many
        filler.unlink()
        kept.clock.sleep_until_ns(kept.clock.now_ns() + RETRY_NS)
        kept.recording.cut(Begin(kept.row + 50, {}))
        kept.seconds(3)
        kept.recording.close()
        assert kept.recording.trouble == ""
        found = np.concatenate([s.time_ns for p in log_files(disk) for s, _ in read(p)]) // 1_000_000
    assert started, "tidying is started on a full disk too: it may make room"
    assert kept.recording.missed == kept.row - len(found) > 1000
    assert len(set(found.tolist())) == len(found)
    assert found[-1] == kept.row - 1
    assert kept.recording.warnings[-1].endswith(f"{kept.recording.missed} rows are in no log")


def test_a_full_disk_leaves_no_empty_files(tmp_path: Path) -> None:
    """The kernel's file size limit stands for the full disk: the header still fits, the rows do not."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    log = LogWriter(tmp_path / "a.arrows", LAYOUT, {})
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "a.arrows").stat().st_size + 100, hard))
    try:
        log.write(*rows(0, 100))
        with pytest.raises(LogError, match="cannot be written"):
            log.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    log.close()
    assert list(tmp_path.iterdir()) == []


def test_packing_on_a_full_disk_keeps_the_original(tmp_path: Path) -> None:
    *closed, _ = fill(tmp_path, 1, n=4000)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        (trouble,) = tidy(tmp_path, PLENTY).troubles
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "cannot be written" in trouble
    assert list(tmp_path.iterdir()) == closed
    assert tidy(tmp_path, PLENTY).packed
