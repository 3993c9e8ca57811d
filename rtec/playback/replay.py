"""Replay: a log, or every log of a folder, through the same step as in the run, without waiting; and its result.

Each log is replayed from its own beginning; memory does not grow with its length. For a log of an older version that
lacks an entry, that version's behaviour holds: a gap between two cycles then counted as at most ten cycles, now as one.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Ints
from rtec.correction.flags import MODE_TAKEN_OVER, ORDER_MASK
from rtec.errors import ConfigError, LogError
from rtec.files import check_named
from rtec.log.folder import REPLAYED, log_files, model_copy
from rtec.log.format import Log
from rtec.log.reader import open_log
from rtec.log.writer import LogWriter
from rtec.loop.records import Commands, Layout, Samples
from rtec.loop.run_file import Setup, load_setup
from rtec.loop.state import state_from_text, structure_of
from rtec.loop.step import Step
from rtec.playback.capture import CaptureReport, replay_capture
from rtec.result import Result

MOST_DIFFERENCES = 20
BLOCK_ROWS = 65_536


@dataclass
class Difference:
    """One field of one row that differs from the log; `log` is the file in a folder, "" where there is one file."""

    row: int
    field: str
    logged: str
    replayed: str
    log: str = ""


@dataclass
class ReplayReport:
    """Result of a replay.

    Attributes:
        rows: number of replayed rows.
        different: number of rows with a field that differs from the log, when checked.
        differences: the first few of them.
        unchecked: rows that cannot be checked: rows before them were lost, so the step's memory is unknown.
        notes: differences between the present run file and that of the log.
        torn_bytes: bytes after the log's last whole batch.
        unread: files of a folder that could not be read, and why.
        out: path of the written commands.
    """

    rows: int = 0
    different: int = 0
    differences: list[Difference] = field(default_factory=list)
    unchecked: int = 0
    notes: list[str] = field(default_factory=list)
    torn_bytes: int = 0
    unread: list[str] = field(default_factory=list)
    out: Path | None = None


def replay_log(
    setup: Setup,
    log: Path,
    out: Path | None = None,
    check: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ReplayReport:
    """Step through a log.

    Args:
        setup: setup with model, limits and machine.
        log: a log of `rtec run`.
        out: path of a new log with the same samples and the recomputed commands.
        check: compare every field of every command, bit for bit.
        progress: called with the number of rows done, and of all.

    Raises:
        LogError: the log cannot be read, or its machine has other axes or sensors.
    """
    report = ReplayReport()
    with open_log(log) as reader:
        step = Step(replace(setup.step_settings(), longest_cycle_s=_longest_cycle_s(reader.header, setup, log)))
        _check_layout(reader, step.layout, log)
        report.notes = _notes(reader.header, setup, log)
        _begin_as(reader.header, step, setup, log)
        total = reader.rows
        writer = None if out is None else LogWriter(out, step.layout, {**setup.log_header(), "replay_of": log.name})
        memory = Commands.empty(step.layout, BLOCK_ROWS)
        try:
            for samples, logged in reader.blocks(BLOCK_ROWS):
                commands = _stepped(step, samples, logged, memory)
                if check and "rows_lost_before" in reader.header:
                    report.unchecked += len(samples)
                elif check:
                    _compare(report, logged, commands)
                if writer is not None:
                    writer.write(samples, commands)
                report.rows += len(samples)
                if progress is not None:
                    progress(report.rows, total)
        finally:
            if writer is not None:
                writer.close()
        report.torn_bytes = reader.torn_bytes
    report.out = out
    return report


def _stepped(step: Step, samples: Samples, logged: Commands, memory: Commands) -> Commands:
    """Step through rows; in a row in which the run took over a ledger from the device, take over the logged one."""
    commands = memory.rows(0, len(samples))
    taken_over = (samples.mode & ORDER_MASK) == MODE_TAKEN_OVER
    starts = [0, *np.flatnonzero(taken_over).tolist(), len(samples)]
    for k, (start, stop) in enumerate(pairwise(starts)):
        if k:
            step.resume(logged.output[start])
        step.run(samples.rows(start, stop), commands.rows(start, stop))
        if k:
            commands.output[start] = logged.output[start]
    return commands


def _longest_cycle_s(header: dict[str, str], setup: Setup, log: Path) -> float:
    """Longest time that a cycle of the run counted as, s."""
    try:
        longest_s = float(header.get("longest_cycle_s", 10.0 / setup.file.run.rate_hz))
    except ValueError:
        longest_s = -1.0
    if not 0.0 < longest_s <= 3600.0:
        raise LogError(f"{log}: header longest_cycle_s is not a time between 0 and 3600 s")
    return longest_s


def _check_layout(reader: Log, layout: Layout, log: Path) -> None:
    for what in ("axes", "sensors"):
        logged, expected = getattr(reader.layout, what), getattr(layout, what)
        if logged != expected:
            raise LogError(
                f"{log}: has {what} {', '.join(logged) or 'none'}; the machine of this run file has "
                f"{', '.join(expected) or 'none'}"
            )


def _notes(header: dict[str, str], setup: Setup, log: Path) -> list[str]:
    """Which of machine, model and run file have changed since the log was written, in words."""
    now = setup.log_header()
    out = []
    if "rows_lost_before" in header:
        out.append("rows before this log were lost; what the step remembered is not known, so nothing can be checked")
    for key, what in (
        ("machine_sha256", "machine"),
        ("model_sha256", "model"),
        ("config_sha256", "run file"),
        ("rtec_version", "version of rtec"),
    ):
        if header.get(key) != now[key]:
            copy = model_copy(log.parent, header.get(key, ""))
            there = f"; [run] model = {str(copy)!r} is" if what == "model" and copy.is_file() else ""
            out.append(f"the {what} is not the one that the log was made with{there}")
    return out


def _begin_as(header: dict[str, str], step: Step, setup: Setup, log: Path) -> None:
    """Restore the step's state before the log's first row: its whole memory, or at least its ledger.

    Another version describes its step's structure in other words; equal machine and model are then sufficient.
    """
    try:
        initial = json.loads(header.get("initial_state", "null"))
    except ValueError:
        initial = None
    state = state_from_text(initial, step.state)
    now = setup.log_header()
    same_model = all(header.get(key) == now[key] for key in ("machine_sha256", "model_sha256"))
    if state is not None and (same_model or initial.get("structure") == structure_of(step).hex()):
        step.restore(state)
    else:
        step.resume(_initial_output(header, step.layout, log))


def _initial_output(header: dict[str, str], layout: Layout, log: Path) -> Ints:
    """The ledger at the run's beginning; zeros where the log does not have it."""
    try:
        values = json.loads(header.get("initial_output", "[]")) or [0] * len(layout.axes)
        out = np.array(values, dtype=np.int64)
        if out.shape != (len(layout.axes),):
            raise ValueError("wrong length")
    except (ValueError, TypeError, OverflowError) as e:
        raise LogError(f"{log}: header initial_output is not one integer an axis") from e
    return out


def _compare(report: ReplayReport, logged: Commands, replayed: Commands) -> None:
    wrong = np.zeros(len(logged), dtype=bool)
    for name, ours in replayed.arrays().items():
        theirs = getattr(logged, name)
        if np.array_equal(_bits(ours), _bits(theirs)):
            continue
        rows = (_bits(ours) != _bits(theirs)).reshape(len(ours), -1).any(axis=1)
        for row in np.flatnonzero(rows)[: MOST_DIFFERENCES - len(report.differences)]:
            difference = Difference(report.rows + int(row), name, str(theirs[row].tolist()), str(ours[row].tolist()))
            report.differences.append(difference)
        wrong |= rows
    report.different += int(np.count_nonzero(wrong))


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    """The same memory as integers, so that a NaN equals itself and -0 is not 0."""
    return np.ascontiguousarray(array).view(np.int64) if array.dtype == np.float64 else array


def replay_logs(
    setup: Setup,
    path: Path,
    out: Path | None = None,
    check: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ReplayReport:
    """Step through a log, or through all logs of a folder.

    Args:
        setup: setup with model, limits and machine.
        path: log or folder.
        out: as for `rtec.playback.replay.replay_log`; not for a folder.
        check: compare with the commands in the log; for a folder always.
        progress: called with the number of rows (of a folder: files) done, and of all.

    Returns:
        for a folder the sum; differences and notes name their file.

    Raises:
        LogError: the log cannot be read, the folder has none, or `out` was given for a folder.
    """
    if not path.is_dir():
        return replay_log(setup, path, out, check, progress)
    if out is not None:
        raise LogError(f"{path}: is a folder; its logs are checked, nothing is written: leave --out away")
    paths = log_files(path)
    if not paths:
        raise LogError(f"{path}: no logs in this folder")
    total = ReplayReport()
    for k, each in enumerate(paths):
        try:
            _add(total, replay_log(setup, each, None, True), each.name)
        except LogError as error:
            total.unread.append(str(error))
        if progress is not None:
            progress(k + 1, len(paths))
    return total


def _add(total: ReplayReport, one: ReplayReport, name: str) -> None:
    named: list[Difference] = [replace(d, log=name) for d in one.differences]
    total.differences = (total.differences + named)[:MOST_DIFFERENCES]
    total.rows += one.rows
    total.different += one.different
    total.unchecked += one.unchecked
    total.torn_bytes += one.torn_bytes
    total.notes += [f"{name}: {note}" for note in one.notes]


@dataclass(frozen=True)
class Replayed(Result):
    """Result of a replay.

    Attributes:
        report: report on the log, or on the capture.
        checked: were the commands compared with the logged ones?
    """

    page_maker: ClassVar[str] = "rtec.report.playback:replay_page"

    report: ReplayReport | CaptureReport
    checked: bool

    @property
    def identical(self) -> bool:
        """Were the commands compared, all of them, and is each identical to the logged one?"""
        return self.checked and self.well

    @property
    def well(self) -> bool:
        """Was everything read, and was no difference found? Where nothing was compared, none is."""
        return isinstance(self.report, CaptureReport) or not (self.report.different or self.report.unread)

    def facts(self) -> dict[str, Any]:
        """The result as plain data; keys as in the documented JSON."""
        r = self.report
        if isinstance(r, CaptureReport):
            return asdict(r) | {"capture_out": str(r.capture_out), "table_out": str(r.table_out)}
        return asdict(r) | {"out": str(r.out) if r.out else None, "checked": self.checked}

    def rows(self) -> Sequence[Mapping[str, Any]]:
        """For a log the first differences, for a capture its axes."""
        if isinstance(self.report, CaptureReport):
            return [{"axis": name, **asdict(axis)} for name, axis in self.report.axes.items()]
        return [asdict(d) for d in self.report.differences]


def replayed(
    config: Path, log: Path, out: Path | None, *, check: bool, progress: Callable[[str, int, int], None] | None = None
) -> Replayed:
    """Replay a log, a folder of logs (always checked) or a capture (`.sr`).

    Raises:
        ConfigError, LogError: the run file, the log or the capture cannot be used.
    """
    setup = load_setup(config, needs_devices=False)
    tell = (lambda done, total: progress(log.name, done, total)) if progress else None
    if log.suffix == ".sr":
        if check:
            raise ConfigError("--check compares with logged commands; a capture has none, leave it out")
        target = out or log.with_name(f"{log.stem}.replay.sr")
        check_named(target, LogError)
        return Replayed(replay_capture(setup, log, target, target.with_suffix(".csv"), tell), checked=False)
    checked = check or log.is_dir()
    target_log = out or (None if checked else log.with_name(f"{log.stem}{REPLAYED}.arrows"))
    return Replayed(replay_logs(setup, log, target_log, checked, tell), checked)
