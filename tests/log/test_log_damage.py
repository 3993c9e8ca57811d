"""Damaged logs: each costs itself only. Oracles: the rows that were written; the sizes of files after each flush."""

import random
from pathlib import Path

import pytest
from typer.testing import CliRunner

import rtec.cli.log as log_cli
from rtec.errors import LogError
from rtec.log.folder import first_name, look_at
from rtec.log.reader import LogReader
from rtec.log.recording import free_path
from rtec.log.stretch import LogStretch, segments_of
from rtec.log.tidy import tidy
from rtec.log.writer import LogWriter
from rtec.loop.records import Layout
from tests.support.log_rig import read, rows, same, write

PLENTY = 1 << 60
runner = CliRunner()


def three(folder: Path) -> list[Path]:
    """Three files of a run, of 20 rows each in batches of 5."""
    out = [first_name(folder, "mill", "20260309T120000Z")]
    out += [free_path(out[0]), out[0].with_name(out[0].stem + "-3.arrows")]
    for k, path in enumerate(out):
        write(path, 20 * k, 20, flush=5)
    return out


def numbers(folder: Path, wants_troubles: int = 0) -> list[int]:
    with LogStretch(folder, segments_of(folder), None, None) as log:
        found = [int(t) // 1_000_000 for s, _ in log.blocks() for t in s.time_ns]
        assert len(log.troubles) == wants_troubles, log.troubles
    return found


def test_torn_at_every_byte_of_its_tail_a_file_costs_its_tail_only(tmp_path: Path) -> None:
    """Cut at every byte of its last batch. Oracle: the sizes that the file had after each flush."""
    layout = Layout(("X",), ())
    paths = [first_name(tmp_path, "mill", "20260309T120000Z")]
    paths.append(free_path(paths[0]))
    sizes = []
    with LogWriter(paths[0], layout, {}) as log:
        for k in range(4):
            log.write(*rows(2 * k, 2, layout=layout))
            log.flush()
            sizes.append(paths[0].stat().st_size)
    write(paths[1], 8, 2, layout=layout)
    content = paths[0].read_bytes()
    for cut in range(sizes[2], len(content)):
        paths[0].write_bytes(content[:cut])
        whole = 2 * sum(size <= cut for size in sizes)
        assert numbers(tmp_path) == [*range(whole), 8, 9], cut


@pytest.mark.parametrize("seed", range(40))
def test_garbage_in_the_middle_of_a_file_costs_that_file_only(tmp_path: Path, seed: int) -> None:
    """64 bytes of noise anywhere in the written file: the others are whole, nothing hangs, nothing else is raised."""
    paths = three(tmp_path)
    rng = random.Random(seed)
    content = bytearray(paths[1].read_bytes())
    at = rng.randrange(len(content) - 64)
    content[at : at + 64] = rng.randbytes(64)
    paths[1].write_bytes(content)
    with LogStretch(tmp_path, segments_of(tmp_path), None, None) as log:
        found = [int(t) // 1_000_000 for s, _ in log.blocks() for t in s.time_ns]
    assert set(range(20)) | set(range(40, 60)) <= set(found)
    tidy(tmp_path, PLENTY)
    assert same(read(paths[2].with_suffix(".parquet")), rows(40, 20))


def test_a_file_damaged_inside_is_told_and_not_packed(tmp_path: Path) -> None:
    """What lies behind the damage may be got back by hand; packing would throw it away."""
    paths = three(tmp_path)
    with LogReader(paths[1]) as log:
        log._index()
        at = log._ends[1]
    content = bytearray(paths[1].read_bytes())
    content[at : at + 16] = bytes(16)
    paths[1].write_bytes(content)
    assert numbers(tmp_path, wants_troubles=1) == [*range(25), *range(40, 60)]
    segment = look_at(paths[1])
    assert (segment.state, segment.rows) == ("damaged", 5)
    assert f"{len(content) - at} bytes behind row 5" in segment.why
    tidy(tmp_path, PLENTY)
    assert paths[1].read_bytes() == bytes(content)
    shown = runner.invoke(log_cli.app, ["list", str(tmp_path)])
    assert shown.exit_code == 1
    assert "damaged" in shown.stdout


@pytest.mark.parametrize("seed", range(25))
def test_a_damaged_packed_file_is_found_out(tmp_path: Path, seed: int) -> None:
    """Any changed byte of a packed file: its rows come out right or not at all; the others are whole."""
    paths = three(tmp_path)
    tidy(tmp_path, PLENTY)
    packed = [p.with_suffix(".parquet") for p in paths]
    rng = random.Random(seed)
    content = bytearray(packed[1].read_bytes())
    at = rng.randrange(4, len(content))
    content[at] ^= 1 << rng.randrange(8)
    packed[1].write_bytes(content)
    log = LogStretch(tmp_path, segments_of(tmp_path), None, None)
    found = list(log.blocks())
    times = [int(t) // 1_000_000 for s, _ in found for t in s.time_ns]
    assert set(range(20)) | set(range(40, 60)) <= set(times)
    assert len(times) == 60 or log.troubles
    if len(times) == 60:
        middle = [b for b in found if 20 <= int(b[0].time_ns[0]) // 1_000_000 < 40]
        assert same(middle, rows(20, 20))


def test_a_folder_of_rubbish_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "mill-000001-20260309T120000Z.arrows").write_bytes(b"no log")
    (tmp_path / "mill-000002-20260309T120000Z.parquet").write_bytes(b"PAR1 no log PAR1")
    with pytest.raises(LogError, match="no rows in it") as caught:
        LogStretch(tmp_path, segments_of(tmp_path), None, None)
    assert "not an Arrow IPC stream" in str(caught.value)
    assert [s.state for s in segments_of(tmp_path)] == ["damaged", "damaged"]


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_damaged_name_of_an_axis_costs_its_file_only(tmp_path: Path, which: int) -> None:
    """One bit of the header: axis X is called Y there. The others of that run say what is right, be it the first."""
    paths = three(tmp_path)
    content = paths[which].read_bytes()
    assert content.count(b'["X", "Z"]') >= 1
    paths[which].write_bytes(content.replace(b'["X", "Z"]', b'["Y", "Z"]'))
    left = [i for k in range(3) for i in range(20 * k, 20 * k + 20) if k != which]
    assert numbers(tmp_path, wants_troubles=1) == left
