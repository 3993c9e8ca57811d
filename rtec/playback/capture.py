"""Replay of a logic-analyser capture: real encoder lines in, the same step, corrected lines out."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Bools, Floats, Ints
from rtec.correction.flags import Flag
from rtec.correction.insertion import InsertionSettings, correct_capture
from rtec.correction.quadrature import Edges, counts_at, decode_edges, pack
from rtec.correction.sinks import PulseSink
from rtec.errors import ConfigError, LogError
from rtec.files import most_bytes, write_text
from rtec.loop.records import MODES_BY_NAME, Layout, Samples
from rtec.loop.run_file import CaptureAxis, CaptureTable, Setup
from rtec.loop.step import Step
from rtec.machine import Axis
from rtec.playback import sigrok

MOST_CYCLES: Final = 4_000_000
EXPANSION: Final = 48
"""Largest memory, bytes, for a byte of the capture: with an edge at every sample."""
Column = Floats | Ints


@dataclass(frozen=True)
class CaptureAxisReport:
    """Result for one axis of a capture.

    Attributes:
        raw_counts, inserted_counts, corrected_counts: at the end of the record; the first two sum to the third.
        illegal: transitions of both lines at once in the capture; they pass unchanged.
        illegal_out: the same in the corrected stream.
        waiting_counts: counts that could not be inserted for lack of room.
    """

    raw_counts: int
    inserted_counts: int
    corrected_counts: int
    illegal: int
    illegal_out: int
    waiting_counts: int


@dataclass(frozen=True)
class CaptureReport:
    """Result of a capture's replay.

    Attributes:
        samples, duration_s: of the capture.
        cycles: number of cycles of the step.
        flags_seen: share of cycles with each flag, by the flag's name.
        axes: by name.
        capture_out, table_out: paths of the written files.
    """

    samples: int
    duration_s: float
    cycles: int
    flags_seen: dict[str, float]
    axes: dict[str, CaptureAxisReport]
    capture_out: Path
    table_out: Path


def replay_capture(
    setup: Setup, path: Path, out: Path, table: Path, progress: Callable[[int, int], None] | None = None
) -> CaptureReport:
    """Run a capture through decoder, step and pulse insertion.

    Args:
        setup: setup with a `[capture]` section that names the channels.
        path: the capture.
        out: path of the corrected capture; every line but A and B of the named axes is unchanged.
        table: path of a CSV with counts, corrections and flags of each cycle. A row in which counts lacked room has the
            flag OUTPUT_SATURATED, and the inserted counts as its applied correction.
        progress: called with the number of stages done, and of all.

    Raises:
        ConfigError: no `[capture]` section, an axis' sink that does not insert pulses, or a file that exists.
        LogError: the capture cannot be read, lacks the channels, or a result cannot be written.
    """
    _check_names(path, out, table)
    section = _capture_section(setup)
    tell = progress or (lambda *_: None)
    stages = 3 + len(section.axis)
    capture = sigrok.read(path, min(sigrok.MAX_LOGIC_BYTES, most_bytes(EXPANSION)))
    _check_length(capture, setup)
    tell(1, stages)
    edges = {name: decode_edges(*capture.pair(a.a, a.b)) for name, a in section.axis.items()}
    step = Step(setup.step_settings())
    samples = _samples(setup, section, capture, edges, step.layout)
    commands = step.run(samples)
    tell(2, stages)
    at = _sample_index(setup, capture, len(samples))
    words = capture.samples.copy()
    reports: dict[str, CaptureAxisReport] = {}
    columns: dict[str, Column] = {"time_s": np.asarray(samples.time_ns * 1e-9, dtype=np.float64)}
    for k, (name, lines) in enumerate(section.axis.items()):
        i = step.layout.axes.index(name)
        output = commands.output[:, i]
        axis_report, corrected = _correct(setup, name, lines, capture, at, output, words)
        reports[name] = axis_report
        raw = counts_at(edges[name], at)
        inserted = counts_at(corrected, at) - raw
        sink = _sink(setup, name)
        ends = np.append(at[1:] - 1, len(words) - 1)
        short = _short(output, counts_at(corrected, ends) - counts_at(edges[name], ends), sink)
        commands.flags[short] |= int(Flag.OUTPUT_SATURATED)
        held = inserted / sink.scale(setup.machine.axis(name)).units_per_um
        columns |= {
            f"raw_{name}_counts": raw,
            f"inserted_{name}_counts": inserted,
            f"corrected_{name}_counts": counts_at(corrected, at),
            f"requested_{name}_um": commands.requested_um[:, i],
            f"applied_{name}_um": np.where(short, held, commands.applied_um[:, i]),
        }
        tell(3 + k, stages)
    columns["flags"] = np.asarray(commands.flags, dtype=np.int64)
    sigrok.write(out, sigrok.Capture(capture.samplerate_hz, capture.channels, words, out.name))
    _write_table(table, columns)
    tell(stages, stages)
    n = len(capture.samples)
    return CaptureReport(n, n / capture.samplerate_hz, len(samples), _flags_seen(commands.flags), reports, out, table)


def _check_length(capture: sigrok.Capture, setup: Setup) -> None:
    """Refuse captures with less than a sample a cycle, or with more cycles than fit into memory."""
    rate_hz = setup.file.run.rate_hz
    if capture.samplerate_hz < rate_hz:
        raise LogError(
            f"{capture.source}: sampled at {capture.samplerate_hz} Hz, and [run] rate_hz of {setup.path} is "
            f"{rate_hz:g}; a capture has at least one sample a cycle"
        )
    cycles = len(capture.samples) / capture.samplerate_hz * rate_hz
    if cycles > MOST_CYCLES:
        raise LogError(
            f"{capture.source}: {len(capture.samples) / capture.samplerate_hz:.0f} s are {cycles:.0f} cycles of "
            f"{rate_hz:g} Hz; at most {MOST_CYCLES} are replayed; divide the capture"
        )


def _sink(setup: Setup, name: str) -> PulseSink:
    sink = setup.file.output.get(name, PulseSink())
    return sink if isinstance(sink, PulseSink) else PulseSink()


def _short(output: Ints, inserted: Ints, sink: PulseSink) -> Bools:
    """Cycles that ended with counts that lacked room; a part of a whole cycle of lines waits for the rest of it."""
    rest = sink.quantum_counts // 2 if sink.quantum_counts > 1 else 0
    return np.asarray(np.abs(output - inserted) > rest)


def _flags_seen(flags: Ints) -> dict[str, float]:
    shares = {flag.name or str(flag): float(np.mean((flags & int(flag)) != 0)) for flag in Flag}
    return {name: share for name, share in shares.items() if share > 0.0}


def _check_names(path: Path, out: Path, table: Path) -> None:
    if out.suffix != ".sr":
        raise ConfigError(f"{out}: a corrected capture ends in .sr; its table of counts gets the same name with .csv")
    for new in (out, table):
        if new.exists() and new.samefile(path):
            raise ConfigError(f"{new}: is the capture itself, which is never overwritten; choose another name")


def _capture_section(setup: Setup) -> CaptureTable:
    if setup.file.capture is None:
        raise ConfigError(
            f"{setup.path}: a capture needs a [capture] section that names the channels, for example\n"
            '[capture.axis.X]\na = "A"\nb = "B"'
        )
    for name in setup.file.capture.axis:
        sink = setup.file.output.get(name, PulseSink())
        if not isinstance(sink, PulseSink):
            raise ConfigError(f"{setup.path}: [output.{name}] kind {sink.kind!r}: a capture's correction is by 'pulse'")
    return setup.file.capture


def _sample_index(setup: Setup, capture: sigrok.Capture, cycles: int) -> Ints:
    """The capture's sample at each cycle."""
    time_s = np.arange(cycles) * setup.period_ns * 1e-9
    return np.minimum((time_s * capture.samplerate_hz).astype(np.int64), len(capture.samples) - 1)


def _samples(
    setup: Setup, section: CaptureTable, capture: sigrok.Capture, edges: dict[str, Edges], layout: Layout
) -> Samples:
    machine = setup.machine
    duration_ns = len(capture.samples) * 1e9 / capture.samplerate_hz
    cycles = max(1, int(duration_ns // setup.period_ns))
    out = Samples.empty(layout, cycles)
    out.time_ns[:] = np.arange(cycles) * setup.period_ns
    out.counts_time_ns[:] = out.time_ns
    out.mode[:] = MODES_BY_NAME[setup.file.run.mode]
    out.degc[:] = [section.degc.get(name, setup.model.reference_degc) for name in machine.sensor_names]
    out.degc_time_ns[:] = out.time_ns[:, None]
    out.spindle_rpm[:] = section.spindle_rpm
    at = _sample_index(setup, capture, cycles)
    for i, axis in enumerate(machine.axes):
        if axis.name in edges:
            out.counts[:, i] = _start(axis, section.axis[axis.name]) + counts_at(edges[axis.name], at)
    return out


def _start(axis: Axis, lines: CaptureAxis) -> int:
    return round(lines.start_mm * axis.counts_per_mm)


def _correct(
    setup: Setup,
    name: str,
    lines: CaptureAxis,
    capture: sigrok.Capture,
    at: Ints,
    output: Ints,
    words: NDArray[np.uint8],
) -> tuple[CaptureAxisReport, Edges]:
    """Insert one axis' counts; writes its corrected lines into `words`."""
    sink = _sink(setup, name)
    settings = InsertionSettings(
        max(1, round(lines.min_edge_separation_us * 1e-6 * capture.samplerate_hz)),
        max(1, round(capture.samplerate_hz / sink.max_counts_per_s)),
        "cycle" if sink.quantum_counts == 4 else "count",
    )
    changes = np.flatnonzero(np.diff(output, prepend=0))
    a, b = capture.line(lines.a), capture.line(lines.b)
    corrected, inserter = correct_capture(a, b, None, settings, target_at=at[changes], target_counts=output[changes])
    for line, channel in ((corrected.a, lines.a), (corrected.b, lines.b)):
        bit = words.dtype.type(1 << capture.bit(channel))
        words &= ~bit
        words |= line.astype(words.dtype) * bit
    edges = decode_edges(pack(corrected.a, corrected.b), 0, 1)
    report = CaptureAxisReport(
        raw_counts=inserter.raw_counts,
        inserted_counts=inserter.inserted_counts,
        corrected_counts=inserter.corrected_counts,
        illegal=inserter.illegal_transitions,
        illegal_out=len(edges.illegal_index),
        waiting_counts=inserter.waiting_counts,
    )
    return report, edges


def _write_table(path: Path, columns: dict[str, Column]) -> None:
    lines = [",".join(columns)]
    forms = ["%d" if c.dtype == np.int64 else "%.6f" for c in columns.values()]
    lines += [
        ",".join(form % value for form, value in zip(forms, row, strict=True))
        for row in zip(*columns.values(), strict=True)
    ]
    write_text("\n".join(lines) + "\n", path, LogError)
