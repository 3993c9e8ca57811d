"""Logs found by time, over the files of a folder. Oracles: the numbered rows; pyarrow's own Parquet reader."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

import rtec.cli.log as log_cli
from rtec.errors import LogError
from rtec.log.export import export
from rtec.log.folder import first_name, look_at
from rtec.log.packed import pack
from rtec.log.reader import open_log
from rtec.log.recording import free_path
from rtec.log.stretch import LogStretch, instant_ns, segments_of, utc_text
from rtec.log.writer import LogWriter
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Layout
from tests.support.log_rig import LAYOUT, NOON_NS, rows, write

runner = CliRunner()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run from 12:00:00 on in three files of 20 s (at 1 Hz), the second packed; then, after the computer was started
    anew and its clock set back to 11:00:00, a run of 20 s whose monotonic time begins at 0 again."""
    names = [first_name(tmp_path, "mill", "20260309T120000Z")]
    names += [free_path(names[0]), names[0].with_name(names[0].stem + "-3.arrows")]
    for k, path in enumerate(names):
        write(path, 20_000 * k, 20_000, noon_at_ns=0, flush=5000)
    later = first_name(tmp_path, "mill", "20260309T110000Z")
    write(later, 0, 20_000, noon_at_ns=3600 * 10**9, flush=5000)
    with open_log(names[1]) as log:
        pack(log, names[1].with_suffix(".parquet"))
    names[1].unlink()
    return tmp_path


@pytest.mark.parametrize(
    ("start", "end", "wanted"),
    [
        ("2026-03-09T12:00:15Z", "2026-03-09T12:00:25Z", [range(15_000, 25_000)]),
        ("2026-03-09T12:00:20Z", "2026-03-09T12:00:40Z", [range(20_000, 40_000)]),
        ("2026-03-09T12:00:55Z", None, [range(55_000, 60_000)]),
        (None, "2026-03-09T12:00:01Z", [range(1000), range(20_000)]),
        ("2026-03-09T11:00:05Z", "2026-03-09T11:00:06Z", [range(5000, 6000)]),
        (None, None, [range(60_000), range(20_000)]),
    ],
)
def test_a_stretch_of_time_over_all_files(
    folder: Path, start: str | None, end: str | None, wanted: list[range]
) -> None:
    """Rows in the order in which they were written, also where the clock on the wall had been set back."""
    a, b = (None if t is None else instant_ns(t) for t in (start, end))
    with LogStretch(folder, segments_of(folder, a, b), a, b) as log:
        found = [int(t) // 1_000_000 for s, _ in log.blocks() for t in s.time_ns]
    assert found == [i for part in wanted for i in part]


def test_list_shows_the_files_of_a_stretch(folder: Path) -> None:
    done = runner.invoke(
        log_cli.app, ["list", str(folder), "--from", "2026-03-09T12:00:19.5Z", "--to", "2026-03-09T12:00:21Z", "--json"]
    )
    assert done.exit_code == 0
    found = json.loads(done.stdout)
    assert [(f["state"], f["from"], f["to"], f["rows"]) for f in found] == [
        ("whole", "2026-03-09 12:00:00Z", "2026-03-09 12:00:19Z", 20_000),
        ("packed", "2026-03-09 12:00:20Z", "2026-03-09 12:00:39Z", 20_000),
    ]
    upto = ["--from", "2026-03-09T12:00:01Z", "--to", "2026-03-09T12:00:20Z", "--json"]
    found = json.loads(runner.invoke(log_cli.app, ["list", str(folder), *upto]).stdout)
    assert len(found) == 1, "the file that begins at --to has nothing of that stretch"
    shown = runner.invoke(log_cli.app, ["list", str(folder)])
    assert "4 logs, 80000 rows" in shown.stdout
    assert shown.stdout.index("12:00:00") < shown.stdout.index("11:00:00")


def test_export_of_a_stretch_with_date_and_time(folder: Path, tmp_path: Path) -> None:
    """Oracle: pyarrow's Parquet reader; 12:00:19 to 12:00:21 is two seconds of rows of two files."""
    out = tmp_path / "shift.parquet"
    arguments = ["--from", "2026-03-09 13:00:19+01:00", "--to", "2026-03-09T12:00:21Z", "--utc"]
    done = runner.invoke(log_cli.app, ["export", str(folder), str(out), *arguments], catch_exceptions=False)
    assert done.stdout == f"2000 rows written to {out}\n"
    table = pq.read_table(out)
    assert table["time_ns"].to_numpy().tolist() == [i * 1_000_000 for i in range(19_000, 21_000)]
    utc = table["utc"].to_numpy().astype("datetime64[ns]").astype(np.int64)
    assert (utc[0], utc[-1]) == (NOON_NS + 19_000_000_000, NOON_NS + 20_999_000_000)


def test_a_row_without_known_date_has_none(tmp_path: Path) -> None:
    """A log of an older version says only when it was started; one that says nothing is exported all the same."""
    path = write(tmp_path / "a.arrows", 0, 10, noon_at_ns=None)
    with LogStretch(path, segments_of(path), None, None) as log:
        assert export(log, tmp_path / "a.parquet", utc=True) == 10
    assert pq.read_table(tmp_path / "a.parquet")["utc"].null_count == 10
    with LogWriter(tmp_path / "b.arrows", LAYOUT, {"started": "2026-03-09T12:00:00Z"}) as log_b:
        log_b.write(*rows(5000, 10))
    assert look_at(tmp_path / "b.arrows").from_ns == NOON_NS


def test_files_of_different_machines_are_not_one_table(tmp_path: Path) -> None:
    write(first_name(tmp_path, "a", "20260309T120000Z"), 0, 10)
    write(first_name(tmp_path, "b", "20260309T120000Z"), 0, 10, layout=Layout(("X",), ()))
    with pytest.raises(LogError, match="axes and sensors are not those of"):
        LogStretch(tmp_path, segments_of(tmp_path), None, None)


@pytest.mark.parametrize("text", ["yesterday", "2026-13-01", "12:00", "", "0001-01-01T00:00:00+23:00"])
def test_what_is_no_date_is_told_with_examples(text: str) -> None:
    with pytest.raises(LogError, match="is no date and time; give 2026-03-09"):
        instant_ns(text)


def test_dates_both_ways() -> None:
    assert instant_ns("2026-03-09T13:00:00+01:00") == instant_ns("2026-03-09T12:00Z") == NOON_NS
    assert utc_text(NOON_NS + 999_999_999) == "2026-03-09 12:00:00Z"
    assert utc_text(1 << 70) == ""


def test_a_folder_where_one_log_is_wanted(folder: Path) -> None:
    """`info` is of one log; `tail` shows the newest of a folder."""
    wrong = runner.invoke(log_cli.app, ["info", str(folder)])
    assert isinstance(wrong.exception, LogError)
    assert "rtec log list" in str(wrong.exception)
    shown = runner.invoke(log_cli.app, ["tail", str(folder), "-n", "1"], catch_exceptions=False)
    assert shown.stdout.splitlines()[1].split()[0] == "19.999000"


def test_tail_follows_into_the_next_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows that came before the change, and those of the next file, once each and in order."""
    names = [first_name(tmp_path, "mill", "20260309T120000Z")]
    names.append(free_path(names[0]))
    writers = [LogWriter(names[0], LAYOUT, {})]
    writers[0].write(*rows(0, 5))
    writers[0].flush()

    def change() -> None:
        writers[0].write(*rows(5, 3))
        writers[0].close()
        writers.append(LogWriter(names[1], LAYOUT, {}))
        writers[1].write(*rows(8, 2))
        writers[1].flush()

    events = [lambda: None, change]

    class Eventful(VirtualClock):
        def sleep_until_ns(self, instant_ns: int) -> None:
            del instant_ns
            if not events:
                raise KeyboardInterrupt
            events.pop(0)()

    monkeypatch.setattr(log_cli, "_clock", Eventful())
    shown = runner.invoke(log_cli.app, ["tail", str(tmp_path), "-n", "2", "--follow"])
    assert shown.exit_code == 130
    assert [line.split()[0] for line in shown.stdout.splitlines()[1:]] == [f"{i / 1000:.6f}" for i in range(3, 10)]
    writers[1].close()
