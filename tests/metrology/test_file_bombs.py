"""Files that are larger inside than outside: refused before they are unpacked, with one message."""

import resource
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from rtec import files
from rtec.errors import LogError, MeasurementError
from rtec.loop.run_file import load_setup
from rtec.metrology.files.load import load_measurement
from rtec.metrology.readers import SourceOptions, read_tables
from rtec.playback import sigrok
from rtec.playback.capture import MOST_CYCLES, replay_capture
from tests.support import measurement_examples as examples
from tests.support import setups


def test_a_size_is_compared_with_this_computers_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: 4 GiB of pages, half of it, four bytes a byte: 512 MiB."""
    monkeypatch.setattr("os.sysconf", {"SC_PHYS_PAGES": 2**20, "SC_PAGE_SIZE": 2**12}.__getitem__)
    assert files.most_bytes(4) == 2**29
    files.check_size(Path("a"), 2**29, 4, MeasurementError)
    with pytest.raises(MeasurementError, match=r"a: 5\.37e\+08 bytes, and this computer's memory holds 5\.37e\+08"):
        files.check_size(Path("a"), 2**29 + 1, 4, MeasurementError)


@pytest.mark.parametrize("tail", ["", "\n1,2.5"])
def test_a_gigantic_line_is_refused_by_its_number(tail: str, tmp_path: Path) -> None:
    path = examples.write(tmp_path, examples.text() + "1" * (3 << 20) + tail)
    with pytest.raises(MeasurementError, match="line 14: longer than 1048576 bytes"):
        load_measurement(path, examples.machine())
    with pytest.raises(MeasurementError, match="line 14: longer than"):
        read_tables(path)


def test_a_parquet_bomb_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """3·10^6 rows of one value pack to a few kB; on a computer of 1 GiB they are not read."""
    columns = {name: pa.array(np.zeros(3_000_000)) for name in ("run", "time_s", "x_mm", "reading_um")}
    path = examples.write(tmp_path, examples.text()).with_suffix(".parquet")
    path.with_suffix(".csv").unlink()
    parquet.write_table(pa.table(columns), path)
    assert path.stat().st_size < 1_000_000
    monkeypatch.setattr("os.sysconf", {"SC_PHYS_PAGES": 2**18, "SC_PAGE_SIZE": 2**12}.__getitem__)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(MeasurementError, match=r"9\.6e\+07 bytes, and this computer's memory holds"):
        load_measurement(path, examples.machine())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 40_000


@pytest.mark.parametrize(
    "line",
    ['{"a": ' + "[" * 100_000, '{"a": ' + "9" * 5000 + "}", '{"a": 1e999}', '{"a": NaN, "b": ' + "9" * 400 + "}"],
)
def test_hostile_json_lines_are_read_or_refused(line: str, tmp_path: Path) -> None:
    path = tmp_path / "x.jsonl"
    path.write_text('{"t": 1, "x": 2}\n' + line + "\n", encoding="utf-8")
    with suppress(MeasurementError):
        assert len(read_tables(path, SourceOptions(reader="json_lines"))[1][0]) == 2


@pytest.mark.parametrize(
    ("samples", "rate_hz", "said"),
    [(4000, 1, "sampled at 1 Hz, and .* rate_hz .* 1000"), (2 * MOST_CYCLES, 1000, "are 8000000 cycles .* divide")],
)
def test_a_capture_of_ages_is_refused(samples: int, rate_hz: int, said: str, tmp_path: Path) -> None:
    tables = setups.tables(tmp_path)
    tables["capture"] = {"axis": {"X": {"a": "A", "b": "B"}}}
    made, path = load_setup(setups.write(tmp_path, tables)), tmp_path / "a.sr"
    sigrok.write(path, sigrok.Capture(rate_hz, ("A", "B"), np.zeros(samples, np.uint8), "a"))
    with pytest.raises(LogError, match=said):
        replay_capture(made, path, tmp_path / "out.sr", tmp_path / "out.csv")


def test_a_capture_that_fills_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """64 MB of nothing pack to 64 kB; on a computer of 1 GiB they are not unpacked."""
    tables = setups.tables(tmp_path)
    tables["capture"] = {"axis": {"X": {"a": "A", "b": "B"}}}
    made, path = load_setup(setups.write(tmp_path, tables)), tmp_path / "a.sr"
    sigrok.write(path, sigrok.Capture(10**6, ("A", "B"), np.zeros(64_000_000, np.uint8), "a"))
    monkeypatch.setattr("os.sysconf", {"SC_PHYS_PAGES": 2**18, "SC_PAGE_SIZE": 2**12}.__getitem__)
    with pytest.raises(LogError, match="logic data unpack to 64000000 bytes; the limit is"):
        replay_capture(made, path, tmp_path / "out.sr", tmp_path / "out.csv")
