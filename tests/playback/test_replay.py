"""`rtec replay`: logs to the bit, captures through decoder, step and pulse insertion."""

import csv
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.correction.flags import Flag
from rtec.errors import ConfigError, LogError
from rtec.log.reader import LogReader, open_log
from rtec.log.writer import LogWriter
from rtec.loop.clock import VirtualClock
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.step import Step
from rtec.playback import sigrok
from rtec.playback.capture import replay_capture
from rtec.playback.replay import Replayed, replay_log, replay_logs, replayed
from rtec.report.playback import replay_lines
from tests.loop.test_loop import run
from tests.support import setups
from tests.support.real_data import real_file

BEFORE = Path(__file__).parent / "before"
GRAY = {(0, 0): 0, (1, 0): 1, (1, 1): 2, (0, 1): 3}


def logged(tmp_path: Path, cycles: int = 2000) -> tuple[Setup, Path]:
    """A log of a run on the virtual clock."""
    made = setups.setup(tmp_path)
    samples, commands, loop, _ = run(made, VirtualClock(10**9), cycles)
    log = tmp_path / "run.arrows"
    header = {**made.log_header(), "initial_output": json.dumps([0, 0])}
    with LogWriter(log, loop_layout(made), header) as writer:
        for start in range(0, cycles, 300):
            writer.write(samples.rows(start, start + 300), commands.rows(start, start + 300))
            writer.flush()
    assert loop.stats.cycles == cycles
    return made, log


def loop_layout(made: Setup) -> Layout:
    return Layout(made.machine.axis_names, made.machine.sensor_names)


def test_a_log_replays_to_the_same_bits(tmp_path: Path) -> None:
    made, log = logged(tmp_path)
    seen: list[tuple[int, int]] = []
    report = replay_log(made, log, tmp_path / "new.arrows", True, lambda done, total: seen.append((done, total)))
    assert (report.rows, report.different, report.notes) == (2000, 0, [])
    assert seen[-1] == (2000, 2000)
    with LogReader(log) as old, LogReader(tmp_path / "new.arrows") as new:
        olds = np.concatenate([c.applied_um for _, c in old.blocks()])
        news = np.concatenate([c.applied_um for _, c in new.blocks()])
    np.testing.assert_array_equal(olds.view(np.int64), news.view(np.int64))


@pytest.mark.parametrize("name", ["first", "behind"])
def test_logs_of_an_older_version_replay_to_the_same_bits(name: str) -> None:
    """Oracle: two files of one run, written before the guard became functions, with every reason to hold in them.

    A gap then counted as ten cycles; the second file begins with a step's memory under the older name of its structure.
    """
    made = load_setup(BEFORE / "run.toml", needs_devices=False)  # as `rtec replay` does
    report = replay_log(made, BEFORE / f"{name}.parquet", check=True)
    assert report.rows == {"first": 1120, "behind": 880}[name]
    assert (report.different, report.differences, report.unchecked) == (0, [], 0)
    with open_log(BEFORE / f"{name}.parquet") as reader:
        flags = np.concatenate([commands.flags for _, commands in reader.blocks()])
    seen = {flag for flag in Flag if (flags & int(flag)).any()}
    assert {Flag.STALE_COUNTS, Flag.STALE_TEMPERATURE, Flag.OUT_OF_RANGE, Flag.ORDERED_HOLD, Flag.ORDERED_OFF} <= seen
    assert {Flag.FADING, Flag.LIMITED, Flag.HELD, Flag.OUTPUT_SATURATED} <= seen


def test_one_changed_bit_is_found(tmp_path: Path) -> None:
    """Flip the lowest bit of one number in the file; oracle: the row and field that were changed."""
    made, log = logged(tmp_path)
    with LogReader(log) as reader:
        wanted = np.concatenate([c.applied_um for _, c in reader.blocks()])
    data = bytearray(log.read_bytes())
    at = data.find(wanted[1400:1404].tobytes())
    assert at > 0
    data[at] ^= 1
    log.write_bytes(data)
    report = replay_log(made, log, check=True)
    assert report.different == 1
    assert [(d.row, d.field) for d in report.differences] == [(1400, "applied_um")]


@pytest.mark.parametrize("field", ["requested_um", "applied_um", "output", "flags"])
def test_a_change_in_any_field_is_found(tmp_path: Path, field: str) -> None:
    """Oracle: the row and field that were changed before the log was written."""
    made = setups.setup(tmp_path)
    samples, commands = taken_over(made, [0, 0])
    getattr(commands, field)[7] += 1
    log = tmp_path / "run.arrows"
    with LogWriter(log, loop_layout(made), made.log_header()) as writer:
        writer.write(samples, commands)
    report = replay_log(made, log, check=True)
    assert [(d.row, d.field) for d in report.differences] == [(7, field)]


def test_in_a_folder_a_difference_names_its_file_and_its_row_there(tmp_path: Path) -> None:
    """Oracle: the second of two equal files was changed in row 7."""
    made, folder = setups.setup(tmp_path), tmp_path / "logs"
    folder.mkdir()
    for name, more in (("mill-20260309T120000Z.arrows", 0), ("mill-20260309T120010Z.arrows", 1)):
        samples, commands = taken_over(made, [0, 0])
        commands.output[7] += more
        with LogWriter(folder / name, loop_layout(made), made.log_header()) as writer:
            writer.write(samples, commands)
    report = replay_logs(made, folder)
    assert [(d.log, d.row, d.field) for d in report.differences] == [("mill-20260309T120010Z.arrows", 7, "output")]
    lines = replay_lines(Replayed(report, checked=True))
    assert any(line.startswith("mill-20260309T120010Z.arrows, row 7: output was ") for line in lines)


def test_rows_behind_a_gap_are_not_called_different(tmp_path: Path) -> None:
    """Nobody knows what the step remembered at the gap. Oracle: the same rows differ where the header hides the gap."""
    made, log = logged(tmp_path)
    with LogReader(log) as reader:
        block = next(iter(reader.blocks(start=500)))
        layout = reader.layout
    for name, header in (("gap", {"rows_lost_before": "500"}), ("hidden", {})):
        with LogWriter(tmp_path / f"{name}.arrows", layout, {**made.log_header(), **header}) as writer:
            writer.write(*block)
    rows = len(block[0])
    gap = replay_log(made, tmp_path / "gap.arrows", check=True)
    assert (gap.rows, gap.unchecked, gap.different) == (rows, rows, 0)
    assert "nothing can be checked" in gap.notes[0]
    hidden = replay_log(made, tmp_path / "hidden.arrows", check=True)
    assert (hidden.unchecked, hidden.different > 0) == (0, True)


def test_what_a_replay_wrote_is_no_log_of_the_folder(tmp_path: Path) -> None:
    """Oracle: the logs that were there before; the commands of another run file, which differ, are beside them."""
    made, log = logged(tmp_path, 300)
    lower = made.path.with_name("lower.toml")
    text = made.path.read_text(encoding="utf-8")
    lower.write_text(text.replace("slew_um_s = 50", "slew_um_s = 20"), encoding="utf-8")
    assert text != lower.read_text(encoding="utf-8")
    alone = replayed(lower, log, None, check=False)
    assert (tmp_path / "run.replay.arrows").exists()
    assert (alone.checked, alone.identical, alone.well) == (False, False, True), "nothing was compared"
    assert not replayed(lower, log, None, check=True).well
    whole = replayed(made.path, tmp_path, None, check=True)
    assert (whole.identical, whole.report.rows) == (True, 300)  # type: ignore[union-attr]


def test_another_machine_is_refused(tmp_path: Path) -> None:
    made, log = logged(tmp_path, 10)
    content = setups.tables(tmp_path)
    text = Path(content["run"]["machine"]).read_text(encoding="utf-8").replace("T_air", "T_room")
    (tmp_path / "machine.toml").write_text(text, encoding="utf-8")
    content["run"]["machine"] = str(tmp_path / "machine.toml")
    (tmp_path / "other").mkdir()
    with pytest.raises(LogError, match=r"has sensors .*T_air; the machine of this run file has .*T_room"):
        replay_log(load_setup(setups.write(tmp_path / "other", content)), log)
    del made


def with_capture(tmp_path: Path, quantum: int = 1, **axes: dict[str, object]) -> Setup:
    content = setups.tables(tmp_path)
    content["capture"] = {"axis": axes, "degc": {"T_spindle_front": 33.0}}
    content["output"] = {name: {"kind": "pulse", "quantum_counts": quantum} for name in axes}
    return load_setup(setups.write(tmp_path, content))


def walk(a: np.ndarray, b: np.ndarray) -> tuple[int, int]:
    """Count A/B the obvious way, from change to change: net counts, and transitions of both lines at once."""
    at = [0, *(np.flatnonzero((a[1:] != a[:-1]) | (b[1:] != b[:-1])) + 1)]
    phase = np.array([GRAY[pair] for pair in zip(a[at].tolist(), b[at].tolist(), strict=True)])
    change = (np.diff(phase) + 1) % 4 - 1
    return int(change[np.abs(change) == 1].sum()), int(np.count_nonzero(change == 2))


@pytest.mark.parametrize("name", ["fast", "left_right", "up_down"])
@pytest.mark.parametrize("quantum", [1, 4])
def test_a_real_capture_goes_through_the_same_step(tmp_path: Path, name: str, quantum: int) -> None:
    """Real encoder lines. Oracle: a decoder of the test's own over the corrected file, and the table's last row."""
    capture = real_file("quadrature", f"agilent_hdns_2000_move_mouse_{name}.sr")
    x = {"a": "MODE/XA", "b": "RB/XB", "start_mm": 100.0}
    z = {"a": "LB/YA", "b": "MB/YB", "start_mm": 200.0}
    made = with_capture(tmp_path, quantum, X=x, Z=z)
    out, table = tmp_path / "out.sr", tmp_path / "out.csv"
    report = replay_capture(made, capture, out, table)
    before, after = sigrok.read(capture), sigrok.read(out)
    assert after.channels == before.channels
    assert after.samplerate_hz == before.samplerate_hz
    touched = 0
    for axis, lines in (("X", x), ("Z", z)):
        found = report.axes[axis]
        a, b = str(lines["a"]), str(lines["b"])
        touched |= 1 << before.bit(a) | 1 << before.bit(b)
        raw, illegal = walk(before.line(a), before.line(b))
        corrected, illegal_out = walk(after.line(a), after.line(b))
        assert (found.raw_counts, found.corrected_counts) == (raw, corrected)
        assert raw + found.inserted_counts == corrected
        assert illegal_out == illegal == found.illegal
        assert found.inserted_counts % quantum == 0
    assert report.axes["X"].inserted_counts >= 12
    np.testing.assert_array_equal(before.samples & ~np.uint8(touched), after.samples & ~np.uint8(touched))
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3000
    for row in rows:
        for axis in "XZ":
            raw, inserted = int(row[f"raw_{axis}_counts"]), int(row[f"inserted_{axis}_counts"])
            assert raw + inserted == int(row[f"corrected_{axis}_counts"])
    assert int(rows[-1]["corrected_X_counts"]) == pytest.approx(report.axes["X"].corrected_counts, abs=1)


def test_counts_without_room_are_flagged_in_their_row(tmp_path: Path) -> None:
    """Oracle: by hand. Edges every 10 µs and a separation of 8 µs leave no room; then the lines stand still."""
    made = with_capture(tmp_path, X={"a": "A", "b": "B", "start_mm": 100.0, "min_edge_separation_us": 8.0})
    phase = np.concatenate([np.arange(200_000) // 10, np.full(200_000, 19_999)]) % 4
    words = (np.isin(phase, (1, 2)) + 2 * np.isin(phase, (2, 3))).astype(np.uint8)
    capture = tmp_path / "own.sr"
    sigrok.write(capture, sigrok.Capture(1_000_000, ("A", "B"), words, capture.name))
    report = replay_capture(made, capture, tmp_path / "o.sr", tmp_path / "o.csv")
    assert report.axes["X"].inserted_counts != 0
    assert 0.3 < report.flags_seen["OUTPUT_SATURATED"] < 0.7
    with (tmp_path / "o.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    flagged = [bool(int(row["flags"]) & int(Flag.OUTPUT_SATURATED)) for row in rows]
    assert flagged[len(rows) // 4]
    assert not flagged[-1]
    moving = rows[len(rows) // 4]
    assert (int(moving["inserted_X_counts"]), float(moving["applied_X_um"])) == (0, 0.0)
    count_um = 1e3 / made.machine.axis("X").counts_per_mm
    assert float(rows[-1]["applied_X_um"]) == pytest.approx(
        -count_um * int(rows[-1]["inserted_X_counts"]), abs=count_um
    )


def test_counts_that_found_room_at_once_are_not_flagged(tmp_path: Path) -> None:
    """Oracle: by hand. One edge each 100 µs leaves room for each count within a cycle of 1000 µs."""
    made = with_capture(tmp_path, X={"a": "A", "b": "B", "start_mm": 100.0})
    phase = np.arange(400_000) // 100 % 4
    words = (np.isin(phase, (1, 2)) + 2 * np.isin(phase, (2, 3))).astype(np.uint8)
    sigrok.write(tmp_path / "own.sr", sigrok.Capture(1_000_000, ("A", "B"), words, "own.sr"))
    report = replay_capture(made, tmp_path / "own.sr", tmp_path / "o.sr", tmp_path / "o.csv")
    assert abs(report.axes["X"].inserted_counts) > 3
    assert "OUTPUT_SATURATED" not in report.flags_seen


def test_the_shipped_run_file_of_a_capture_needs_no_device(tmp_path: Path) -> None:
    """Oracle: the ledger; and `rtec run` still asks for devices."""
    phase = np.arange(20_000) // 100 % 4
    words = (np.isin(phase, (1, 2)) + 2 * np.isin(phase, (2, 3))).astype(np.uint8)
    sigrok.write(tmp_path / "scale.sr", sigrok.Capture(100_000, ("A", "B"), words, "scale.sr"))
    config = Path(__file__).parents[2] / "configs/capture.toml"
    assert status(["replay", str(config), str(tmp_path / "scale.sr"), "--out", str(tmp_path / "o.sr")]) == 0
    with (tmp_path / "o.csv").open(encoding="utf-8") as file:
        last = list(csv.DictReader(file))[-1]
    assert int(last["raw_X_counts"]) + int(last["inserted_X_counts"]) == int(last["corrected_X_counts"]) > 0
    with pytest.raises(ConfigError, match="key 'role' is missing"):
        load_setup(config)


def test_the_command_line_on_a_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = real_file("quadrature", "rotary-sin.sr")
    made = with_capture(tmp_path, X={"a": "0", "b": "1", "start_mm": 100.0})
    assert status(["replay", str(made.path), str(capture), "--out", str(tmp_path / "o.sr"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    axis = facts["axes"]["X"]
    assert axis["raw_counts"] + axis["inserted_counts"] == axis["corrected_counts"]
    assert (tmp_path / "o.csv").exists()
    assert "HELD" not in facts["flags_seen"]


def test_a_capture_begins_where_the_run_file_says(tmp_path: Path) -> None:
    """Oracle: the model's scale, 30 µm/m, asks for -3 µm more at 100 mm than at 0."""
    capture, asked = real_file("quadrature", "rotary-sin.sr"), {}
    for start_mm in (0.0, 100.0):
        folder = tmp_path / f"{start_mm:g}"
        folder.mkdir()
        made = with_capture(folder, X={"a": "0", "b": "1", "start_mm": start_mm})
        replay_capture(made, capture, folder / "o.sr", folder / "o.csv")
        with (folder / "o.csv").open(encoding="utf-8") as file:
            asked[start_mm] = float(next(csv.DictReader(file))["requested_X_um"])
    assert asked[100.0] - asked[0.0] == pytest.approx(-3.0, abs=1e-5)


def test_a_capture_whose_correction_was_held_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is inserted where a sensor is said to read what it cannot; the reader must learn why."""
    capture = real_file("quadrature", "rotary-sin.sr")
    made = with_capture(tmp_path, X={"a": "0", "b": "1", "start_mm": 100.0})
    text = made.path.read_text(encoding="utf-8").replace("T_spindle_front = 33.0", "T_spindle_front = 1372.0")
    made.path.write_text(text, encoding="utf-8")
    assert status(["replay", str(made.path), str(capture), "--out", str(tmp_path / "o.sr")]) == 0
    said = capsys.readouterr().out
    assert "sensor fault: 100 % of cycles" in said
    assert "inserted +0" in said


def test_a_capture_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = with_capture(tmp_path, X={"a": "0", "b": "1"})
    capture = tmp_path / "own.sr"
    capture.write_bytes(real_file("quadrature", "rotary-sin.sr").read_bytes())
    kept = capture.read_bytes()
    command = ["replay", str(made.path), str(capture)]
    for more, message in (
        (["--out", str(capture)], "is the capture itself"),
        (["--out", str(tmp_path / "o.csv")], "a corrected capture ends in .sr"),
        (["--check"], "--check compares with logged commands"),
    ):
        assert status([*command, *more]) == 2
        assert message in capsys.readouterr().err
    assert capture.read_bytes() == kept
    assert not (tmp_path / "o.csv").exists()


def test_a_replay_begins_with_the_ledger_that_the_run_began_with(tmp_path: Path) -> None:
    """Oracle: the log's own first commands, of a run that took over 40 and -30 counts, its correction ordered off."""
    made = setups.setup(tmp_path)
    log = tmp_path / "run.arrows"
    samples, commands = taken_over(made, [40, -30])
    header = {**made.log_header(), "initial_output": "[40, -30]"}
    with LogWriter(log, loop_layout(made), header) as writer:
        writer.write(samples, commands)
    assert commands.output[0].tolist() == [40, -30]
    assert replay_log(made, log, check=True).different == 0
    without = tmp_path / "without.arrows"
    with LogWriter(without, loop_layout(made), {**made.log_header(), "initial_output": "[0, 0]"}) as writer:
        writer.write(samples, commands)
    assert replay_log(made, without, check=True).different > 0


def taken_over(made: Setup, output: list[int]) -> tuple[Samples, Commands]:
    step = Step(made.step_settings())
    step.resume(np.array(output))
    samples = Samples.empty(step.layout, 20)
    samples.time_ns[:] = samples.counts_time_ns[:] = 10**9 + np.arange(20) * 1_000_000
    samples.degc[:] = 20.0
    samples.degc_time_ns[:] = 10**9
    return samples, step.run(samples)


def test_a_capture_needs_its_section_and_its_channels(tmp_path: Path) -> None:
    capture = real_file("quadrature", "rotary-sin.sr")
    with pytest.raises(ConfigError, match=r"needs a \[capture\] section"):
        replay_capture(setups.setup(tmp_path), capture, tmp_path / "o.sr", tmp_path / "o.csv")
    wrong = with_capture(tmp_path, X={"a": "A", "b": "1"})
    with pytest.raises(LogError, match="no channel named 'A'; the channels are '0', '1'"):
        replay_capture(wrong, capture, tmp_path / "o.sr", tmp_path / "o.csv")
    assert not (tmp_path / "o.sr").exists()


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    """Peak of what Python and numpy allocate; oracle: a log twenty times as long needs no more."""
    made, log = logged(tmp_path, 2000)
    long = tmp_path / "long.arrows"
    with LogReader(log) as reader, LogWriter(long, reader.layout, reader.header) as writer:
        blocks = list(reader.blocks())
        for _ in range(20):
            for samples, commands in blocks:
                writer.write(samples, commands)
    peaks = []
    for path in (log, log, long):  # the first run also compiles and imports
        tracemalloc.start()
        replay_log(made, path)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.1 * peaks[1] + 50_000
