"""The Arrow log. Oracles: the rows that were written; pyarrow's own stream, Parquet and CSV readers; Python's csv."""

import csv
import itertools
import json
import random
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from numpy.typing import NDArray

from rtec.errors import LogError
from rtec.log.export import export, flat_names
from rtec.log.format import schema_of
from rtec.log.reader import LogReader
from rtec.log.writer import LogWriter
from rtec.loop.records import Commands, Layout, Samples

LAYOUT = Layout(("X", "Z"), ("T_spindle", "T_bed", "T_air"))
HEADER = {"rtec_version": "0.1.0", "config_sha256": "ab" * 32, "host": "büro", "start": "2026-01-01T00:00:00Z"}
Block = tuple[Samples, Commands]


def random_rows(n: int, layout: Layout = LAYOUT, seed: int = 1) -> Block:
    """Rows with every bit pattern that matters: full-range integers, NaN, infinities, minus zero."""
    rng = np.random.default_rng(seed)
    block = Samples.empty(layout, n), Commands.empty(layout, n)
    for array in (*block[0].arrays().values(), *block[1].arrays().values()):
        if array.dtype == np.float64:
            array[:] = rng.normal(size=array.shape) * 10.0 ** rng.integers(-200, 200, array.shape)
            array.reshape(-1)[::7] = np.nan
            array.reshape(-1)[3::11] = -0.0
            array.reshape(-1)[5::13] = np.inf
        else:
            limits = np.iinfo(array.dtype)
            array[:] = rng.integers(limits.min, limits.max, array.shape, endpoint=True)
    block[0].time_ns[:] = np.arange(n) * 1_000_000
    return block


def part(block: Block, start: int, stop: int) -> Block:
    return block[0].rows(start, stop), block[1].rows(start, stop)


def all_of(reader: LogReader, max_rows: int = 65_536, start: int = 0) -> dict[str, NDArray[Any]]:
    parts = [s.arrays() | c.arrays() for s, c in reader.blocks(max_rows, start)]
    if not parts:
        return Samples.empty(reader.layout, 0).arrays() | Commands.empty(reader.layout, 0).arrays()
    return {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}


def assert_same(found: dict[str, NDArray[Any]], wanted: Block) -> None:
    """Bit for bit, so that NaN and -0.0 count."""
    arrays = wanted[0].arrays() | wanted[1].arrays()
    assert list(found) == list(arrays)
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        assert found[name].shape == array.shape, name
        assert found[name].tobytes() == array.tobytes(), name


def write_log(path: Path, block: Block, flush_at: tuple[int, ...] = (), layout: Layout = LAYOUT) -> list[int]:
    """Write rows with flushes after these row numbers; give the file size after the header and after each flush."""
    edges = [0, *flush_at, len(block[0])]
    with LogWriter(path, layout, HEADER) as log:
        sizes = [path.stat().st_size]
        for start, stop in itertools.pairwise(edges):
            log.write(*part(block, start, stop))
            log.flush()
            sizes.append(path.stat().st_size)
    return sizes


@pytest.mark.parametrize("layout", [LAYOUT, Layout(("X",), ()), Layout(("X", "Y", "Z"), ("A", "µ [°]"))])
@pytest.mark.parametrize(("batch_rows", "chunk"), [(8192, 1000), (1, 3), (7, 5), (64, 64), (100, 1)])
def test_round_trip(tmp_path: Path, layout: Layout, batch_rows: int, chunk: int) -> None:
    block = random_rows(150, layout)
    path = tmp_path / "a.arrows"
    with LogWriter(path, layout, HEADER, batch_rows) as log:
        for start in range(0, 150, chunk):
            log.write(*part(block, start, start + chunk))
    assert log.rows == 150
    with LogReader(path) as reader:
        assert (reader.layout, reader.header) == (layout, HEADER)
        assert (reader.rows, reader.torn_bytes, reader.complete) == (150, 0, True)
        assert_same(all_of(reader), block)
        assert_same(all_of(reader, max_rows=11), block)
        for start in (0, 1, 63, 64, 65, 149, 150, 1000):
            assert_same(all_of(reader, 9, start), part(block, start, 150))


def test_log_without_rows(tmp_path: Path) -> None:
    write_log(tmp_path / "a", random_rows(0))
    with LogReader(tmp_path / "a") as reader:
        assert (reader.rows, reader.torn_bytes, list(reader.blocks())) == (0, 0, [])


def test_other_arrow_programs_can_read_it(tmp_path: Path) -> None:
    """Oracle: pyarrow's own stream reader, which knows nothing of rtec."""
    block = random_rows(20)
    write_log(tmp_path / "a", block, (5,))
    with pa.ipc.open_stream((tmp_path / "a").read_bytes()) as stream:
        table = stream.read_all()
    table.validate(full=True)
    for name, array in (block[0].arrays() | block[1].arrays()).items():
        np.testing.assert_array_equal(np.array(table[name].to_pylist()), array)
    assert table.schema.metadata is not None
    assert table.schema.metadata[b"host"].decode() == "büro"
    degc = table.schema.field("degc").metadata
    assert degc is not None
    assert (json.loads(degc[b"names"]), degc[b"unit"]) == (list(LAYOUT.sensors), b"degC")


def test_views_share_the_mapped_file(tmp_path: Path) -> None:
    """Every array lies inside the mapping; writing to one changes no file."""
    path = tmp_path / "a"
    block = random_rows(40)
    write_log(path, block, (20,))
    with LogReader(path) as reader:
        views = next(reader.blocks())
        again = next(reader.blocks())
        reader._source.seek(0)
        mapped = np.frombuffer(memoryview(reader._source.read_buffer(reader.bytes)), np.uint8)
    arrays = views[0].arrays() | views[1].arrays()
    for name, array in arrays.items():
        assert np.shares_memory(array, mapped), name
        assert np.shares_memory(array, (again[0].arrays() | again[1].arrays())[name])
        assert array.flags.writeable  # one array type, so one machine code, for live and logged samples
    before = path.read_bytes()
    arrays["counts"][0, 0] += 1
    assert path.read_bytes() == before


def whole_batches(sizes: list[int], flush_at: list[int], cut: int) -> tuple[int, int]:
    """Rows, and bytes left over, of a file cut at `cut`: from the sizes seen while writing alone."""
    fitting = [i for i, size in enumerate(sizes) if size <= cut]
    rows, end = flush_at[fitting[-1]], sizes[fitting[-1]]
    return rows, cut - end


def test_cut_anywhere(tmp_path: Path) -> None:
    """A file cut at every byte of its last two batches, and at random earlier ones, gives the whole batches before."""
    path, cut_path = tmp_path / "a", tmp_path / "cut"
    block = random_rows(12)
    flush_at = [0, 3, 5, 8, 10, 12]
    sizes = write_log(path, block, tuple(flush_at[1:-1]))
    content = path.read_bytes()
    assert len(content) == sizes[-1] + 8
    cuts = [*range(sizes[-3], len(content)), *random.Random(2).sample(range(sizes[0], sizes[-3]), 200)]
    for cut in cuts:
        cut_path.write_bytes(content[:cut])
        rows, torn = whole_batches(sizes, flush_at, cut)
        with LogReader(cut_path) as reader:
            assert (reader.rows, reader.torn_bytes, reader.complete) == (rows, torn, False), cut
            assert_same(all_of(reader), part(block, 0, rows))


@pytest.mark.parametrize("tail", [b"\0", b"\0" * 4096, b"\xff" * 100, b"garbage" * 50, b"\xff\xff\xff\xff"])
def test_rubbish_after_the_last_batch_is_counted(tmp_path: Path, tail: bytes) -> None:
    """Some file systems leave zeros, or old blocks, at the end after a power cut."""
    path = tmp_path / "a"
    block = random_rows(9)
    sizes = write_log(path, block, (4,))
    path.write_bytes(path.read_bytes()[: sizes[-1]] + tail)
    with LogReader(path) as reader:
        assert (reader.rows, reader.torn_bytes, reader.complete) == (9, len(tail), False)
        assert_same(all_of(reader), block)


def test_cut_header_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "a"
    sizes = write_log(path, random_rows(3))
    content = path.read_bytes()
    for cut in range(0, sizes[0], 8):
        path.write_bytes(content[:cut])
        with pytest.raises(LogError) as caught:
            LogReader(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


_WRITE_FOREVER = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_log import LAYOUT, HEADER, part, random_rows
from rtec.log.writer import LogWriter
block = random_rows(5000)
log = LogWriter(Path(sys.argv[1]), LAYOUT, HEADER)
for start in range(0, 5000, 50):
    log.write(*part(block, start, start + 50))
    if start % 100 == 50:
        log.flush()
        print(start + 50, flush=True)
"""


@pytest.mark.parametrize("lines", [1, 5, 17])
def test_killed_while_writing(tmp_path: Path, lines: int) -> None:
    """SIGKILL at some instant: all rows that the process said were flushed are there, whole and in order."""
    path = tmp_path / "a"
    here = str(Path(__file__).parent)
    command = [sys.executable, "-c", _WRITE_FOREVER, str(path), here]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        flushed = [int(writer.stdout.readline()) for _ in range(lines)][-1]
        writer.send_signal(signal.SIGKILL)
    with LogReader(path) as reader:
        assert reader.rows >= flushed
        assert not reader.complete
        assert_same(all_of(reader), part(random_rows(5000), 0, reader.rows))


def test_flushed_rows_are_in_the_file_at_once(tmp_path: Path) -> None:
    """A second reader, opened while the writer is at work, and refreshed as it goes on."""
    path = tmp_path / "a"
    block = random_rows(10)
    with LogWriter(path, LAYOUT, HEADER) as log:
        reader = LogReader(path)
        assert (reader.rows, reader.torn_bytes, reader.complete) == (0, 0, False)
        for n in range(10):
            log.write(*part(block, n, n + 1))
            log.flush()
            reader.refresh()
            assert reader.rows == n + 1
            assert_same(all_of(reader, start=n), part(block, n, n + 1))
    reader.refresh()
    assert reader.complete
    reader.close()


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_text("precious")
    with pytest.raises(LogError, match="exists already"):
        LogWriter(path, LAYOUT, HEADER)
    assert path.read_text() == "precious"
    with pytest.raises(LogError, match="cannot be made"):
        LogWriter(tmp_path / "no" / "a", LAYOUT, HEADER)
    with pytest.raises(LogError, match=r"rtec\.axes"):
        LogWriter(tmp_path / "b", LAYOUT, {"rtec.axes": "[]"})
    assert not (tmp_path / "b").exists()


def test_full_disk(tmp_path: Path) -> None:
    """The kernel's file size limit stands for the full disk: a piece of the batch is written, then refused."""
    path = tmp_path / "a"
    block = random_rows(200)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    log = LogWriter(path, LAYOUT, HEADER)
    log.write(*part(block, 0, 50))
    log.flush()
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 1000, hard))
    try:
        log.write(*part(block, 50, 200))
        with pytest.raises(LogError, match="its 50 rows are kept"):
            log.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    with pytest.raises(LogError, match="its 50 rows are kept"):
        log.flush()
    log.close()
    with LogReader(path) as reader:
        assert (reader.rows, reader.torn_bytes) == (50, 0)
        assert_same(all_of(reader), part(block, 0, 50))
    with pa.ipc.open_stream(path.read_bytes()) as stream:
        assert stream.read_all().num_rows == 50


def test_a_file_that_somebody_removes_is_noticed(tmp_path: Path) -> None:
    """The kernel takes rows for it as before; all of them are lost, and that is what the writer says."""
    path, rows = tmp_path / "run.arrows", random_rows(10)
    writer = LogWriter(path, LAYOUT, HEADER)
    writer.write(*rows)
    writer.flush()
    path.rename(tmp_path / "elsewhere.arrows")
    writer.flush()
    (tmp_path / "elsewhere.arrows").unlink()
    with pytest.raises(LogError, match="somebody removed it while it was written; its 10 rows are lost"):
        writer.flush()
    assert writer.rows == 0
    writer.close()
    assert list(tmp_path.iterdir()) == []


def test_closed_log_takes_no_more(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a", LAYOUT, HEADER)
    log.close()
    log.close()
    log.write(*random_rows(1))
    with pytest.raises(LogError, match="closed"):
        log.flush()


def flat(block: Block) -> dict[str, NDArray[Any]]:
    """The table that an export must hold, written out by hand."""
    s, c = block
    table: dict[str, NDArray[Any]] = {"time_s": (s.time_ns - s.time_ns[0]) * 1e-9, "time_ns": s.time_ns}
    table |= {"mode": s.mode, "counts_time_ns": s.counts_time_ns}
    table |= {"counts_X": s.counts[:, 0], "counts_Z": s.counts[:, 1]}
    for i, name in enumerate(("T_spindle", "T_bed", "T_air")):
        table[f"degc_{name}"] = s.degc[:, i]
    for i, name in enumerate(("T_spindle", "T_bed", "T_air")):
        table[f"degc_time_ns_{name}"] = s.degc_time_ns[:, i]
    table["spindle_rpm"] = s.spindle_rpm
    table |= {"requested_um_X": c.requested_um[:, 0], "requested_um_Z": c.requested_um[:, 1]}
    table |= {"applied_um_X": c.applied_um[:, 0], "applied_um_Z": c.applied_um[:, 1]}
    return table | {"output_X": c.output[:, 0], "output_Z": c.output[:, 1], "flags": c.flags}


@pytest.fixture
def log_path(tmp_path: Path) -> Path:
    write_log(tmp_path / "a.arrows", random_rows(300), (10, 11, 200))
    return tmp_path / "a.arrows"


def test_export_to_parquet(tmp_path: Path, log_path: Path) -> None:
    """Oracle: pyarrow's Parquet reader."""
    out = tmp_path / "out.parquet"
    told: list[int] = []
    with LogReader(log_path) as reader:
        assert export(reader, out, told.append) == 300
    assert told[-1] == 300
    table = pyarrow.parquet.read_table(out)
    wanted = flat(random_rows(300))
    assert table.column_names == list(wanted)
    for name, array in wanted.items():
        found = table[name].to_numpy()
        assert found.dtype == array.dtype
        assert found.tobytes() == array.tobytes(), name
    assert {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()} == HEADER
    assert pyarrow.parquet.ParquetFile(out).metadata.row_group(0).column(0).compression == "ZSTD"
    assert pyarrow.parquet.ParquetFile(out).metadata.num_row_groups == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.arrows", "out.parquet"]


def test_export_to_csv(tmp_path: Path, log_path: Path) -> None:
    """Oracle: Python's csv module and float(), which take back every bit of a number."""
    out = tmp_path / "out.csv"
    with LogReader(log_path) as reader:
        assert export(reader, out) == 300
    with out.open(newline="") as file:
        rows = list(csv.reader(file))
    wanted = flat(random_rows(300))
    assert rows[0] == list(wanted)
    for i, (name, array) in enumerate(wanted.items()):
        kind: Callable[[str], float] = float if array.dtype == np.float64 else int
        found = np.array([kind(row[i]) for row in rows[1:]], array.dtype)
        np.testing.assert_array_equal(found, array, err_msg=name)


def test_export_to_mcap(tmp_path: Path, log_path: Path) -> None:
    """Oracle: the reader of the mcap package, and Python's JSON; what is not a number is null."""
    reader_of = pytest.importorskip("mcap.reader").make_reader
    out = tmp_path / "out.mcap"
    with LogReader(log_path) as reader:
        assert export(reader, out) == 300
    wanted = flat(random_rows(300))
    with out.open("rb") as file:
        made = reader_of(file)
        messages = [(channel.topic, message) for _, channel, message in made.iter_messages()]
        assert {m.name: m.metadata for m in made.iter_metadata()} == {"rtec": HEADER}
    assert {topic for topic, _ in messages} == {"rtec"}
    assert [m.log_time for _, m in messages] == wanted["time_ns"].tolist()
    rows = [json.loads(m.data) for _, m in messages]
    for name, array in wanted.items():
        found = np.array([np.nan if row[name] is None else row[name] for row in rows], array.dtype)
        np.testing.assert_array_equal(found, np.where(np.isfinite(array), array, np.nan), err_msg=name)


def test_export_refuses_and_leaves_nothing_behind(tmp_path: Path, log_path: Path) -> None:
    parquet = tmp_path / "same.parquet"
    parquet.hardlink_to(log_path)
    before = sorted(tmp_path.iterdir())
    with LogReader(log_path) as reader:
        with pytest.raises(LogError, match=r"'.parquet', '.csv' or '.mcap'"):
            export(reader, tmp_path / "out.xlsx")
        with pytest.raises(LogError, match="the log itself"):
            export(reader, parquet)
        with pytest.raises(LogError, match="cannot be made"):
            export(reader, tmp_path / "no" / "out.csv")

        def stop(rows: int) -> None:
            raise KeyboardInterrupt(rows)

        with pytest.raises(KeyboardInterrupt):
            export(reader, tmp_path / "out.csv", stop)
    assert sorted(tmp_path.iterdir()) == before


def test_two_columns_of_one_name_are_refused() -> None:
    with pytest.raises(LogError, match="degc_time_ns_A"):
        flat_names(Layout(("X",), ("A", "time_ns_A")))


def stream(schema: pa.Schema, columns: dict[str, Any] | None = None) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, schema) as writer:
        if columns is not None:
            writer.write_table(pa.table(columns, schema=schema))
    return sink.getvalue().to_pybytes()


def changed(**metadata: str) -> bytes:
    schema = schema_of(LAYOUT, {})
    new: dict[bytes | str, bytes | str] = {}
    for name, old in (schema.metadata or {}).items():
        new[name] = old
    for key, value in metadata.items():
        new[key.replace("_", ".", 1).encode()] = value
    return stream(schema.with_metadata(new))


def retyped(name: str, kind: pa.DataType) -> bytes:
    schema = schema_of(LAYOUT, {})
    at = schema.get_field_index(name)
    return stream(schema.set(at, pa.field(name, kind)))


GOOD = schema_of(LAYOUT, {})
HOSTILE = {
    "empty": (b"", "is empty"),
    "text": (b"time_ns,mode\n1,2\n" * 9, "not an Arrow IPC stream"),
    "zeros": (b"\0" * 4096, "not an Arrow IPC stream"),
    "parquet": (b"PAR1" + b"\0" * 99, "not an Arrow IPC stream"),
    "huge head": (b"\xff\xff\xff\xff\xff\xff\xff\x7f" + b"\0" * 99, "not an Arrow IPC stream"),
    "negative head": (b"\xff\xff\xff\xff\0\0\0\x80" + b"\0" * 99, "not an Arrow IPC stream"),
    "foreign stream": (stream(pa.schema([("a", pa.int64())]), {"a": [1]}), "not a log of rtec"),
    "future format": (changed(rtec_log="99"), "log format '99'"),
    "no axes": (changed(rtec_axes="nonsense"), r"rtec\.axes: a list of different names"),
    "axes no list": (changed(rtec_axes='{"X": 1}'), r"rtec\.axes: a list of different names"),
    "axes twice": (changed(rtec_axes='["X", "X"]'), r"rtec\.axes: a list of different names"),
    "deep names": (changed(rtec_axes="[" * 100_000), r"rtec\.axes: a list of different names"),
    "absurd names": (changed(rtec_sensors=json.dumps(list(map(str, range(5000))))), "5000 names; at most"),
    "other sensors": (changed(rtec_sensors='["A"]'), r"column degc: type .*\[3\] found, .*\[1\] is needed"),
    "missing": (stream(GOOD.remove(3)), "columns missing: counts$"),
    "additional": (stream(GOOD.append(pa.field("more", pa.int64()))), "more.* are needed"),
    "wrong type": (retyped("time_ns", pa.float64()), "column time_ns: type double found, int64 is needed"),
    "wrong entry": (retyped("degc", pa.list_(pa.float32(), 3)), "column degc: type .*float"),
    "open list": (retyped("counts", pa.list_(pa.int64())), "column counts: type list"),
    "absurd width": (retyped("counts", pa.list_(pa.int64(), 2**31 - 1)), r"column counts: type .*\[2147483647\]"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files(tmp_path: Path, case: str) -> None:
    content, message = HOSTILE[case]
    path = tmp_path / "a"
    path.write_bytes(content)
    with pytest.raises(LogError, match=message) as caught:
        LogReader(path)
    assert str(caught.value).startswith(f"log {path}: ")
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none", tmp_path):
        with pytest.raises(LogError, match="cannot be opened"):
            LogReader(path)


@pytest.mark.parametrize("compression", [None, "lz4"])
def test_streams_of_other_writers(tmp_path: Path, compression: Literal["lz4"] | None) -> None:
    """Pyarrow's stream writer (64-byte alignment, an empty batch) is read as well; compressed batches are refused."""
    path = tmp_path / "a"
    block = random_rows(50)
    write_log(path, block)
    with pa.ipc.open_stream(path.read_bytes()) as ours:
        table = ours.read_all()
    with path.open("wb") as file:
        options = pa.ipc.IpcWriteOptions(compression=compression)
        with pa.ipc.new_stream(file, table.schema, options=options) as writer:
            writer.write_table(table, max_chunksize=20)
            writer.write_batch(empty_batch(table))
    with LogReader(path) as reader:
        if compression:
            with pytest.raises(LogError, match="compressed"):
                all_of(reader)
        else:
            assert_same(all_of(reader), block)
            assert (reader.rows, reader.torn_bytes, reader.complete) == (50, 0, True)


def empty_batch(table: pa.Table) -> pa.RecordBatch:
    columns: list[pa.Array[Any]] = [pa.array([], field.type) for field in table.schema]
    return pa.RecordBatch.from_arrays(columns, schema=table.schema)


def test_batch_that_claims_more_rows_than_it_has(tmp_path: Path) -> None:
    """The row counts in a batch's head are raised by hand; nothing outside the file may ever be read."""
    path = tmp_path / "a"
    sizes = write_log(path, random_rows(77))
    content = bytearray(path.read_bytes())
    head = content[sizes[0] :]
    for claim in (78, 10**6, 2**62, -1):
        forged = bytes(head).replace((77).to_bytes(8, "little"), claim.to_bytes(8, "little", signed=True))
        path.write_bytes(bytes(content[: sizes[0]]) + forged)
        with LogReader(path) as reader:
            try:
                assert reader.rows == 0
                assert reader.torn_bytes > 0
            except LogError as error:
                assert "damaged" in str(error)  # noqa: PT017


def test_any_changed_byte_is_survived(tmp_path: Path) -> None:
    """Random damage: rows of the right shape, or one LogError; no other exception, no crash."""
    path = tmp_path / "a"
    sizes = write_log(path, random_rows(6), (3,))
    content = path.read_bytes()
    rng = random.Random(3)
    heads = [*range(sizes[0]), *range(sizes[0], sizes[0] + 1200), *range(sizes[1], sizes[1] + 1200)]
    outcomes = set()
    for _ in range(1500):
        damaged = bytearray(content)
        for at in rng.choices(heads, k=rng.choice([1, 1, 4])):
            damaged[min(at, len(damaged) - 1)] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)])
        path.write_bytes(damaged)
        try:
            with LogReader(path) as reader:
                found = all_of(reader)
                assert len({len(array) for array in found.values()}) == 1
                assert len(found["time_ns"]) == reader.rows
                outcomes.add("torn" if reader.torn_bytes else "whole")
        except LogError as error:
            assert "\n" not in str(error)  # noqa: PT017
            outcomes.add("refused")
    assert outcomes == {"torn", "whole", "refused"}
