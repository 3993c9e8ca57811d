"""What `rtec log` shows on a terminal."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from rtec.correction.guard import Flag
from rtec.log.folder import Segment
from rtec.log.reader import Log
from rtec.log.stretch import utc_text
from rtec.loop.records import Commands, Layout, Samples

MODES = {0: "off", 1: "on", 2: "hold", 3: "taken over"}
DAY_S = 86_400.0
LONGEST = 160


def print_facts(facts: Mapping[str, Any]) -> None:
    """Print names and values; a table within is shown by its own names."""
    table = _table(["", ""], header=False)
    for name, value in facts.items():
        if isinstance(value, dict):
            for key, text in value.items():
                table.add_row(key, _shown(text))
        else:
            table.add_row(name, _shown(value))
    _console().print(table)


def print_segments(segments: list[Segment]) -> None:
    """Print a line a file, then their sum, then what is wrong."""
    table = _table(["from (UTC)", "to (UTC)", "rows", "MB", "state", "log"], header=True)
    for s in segments:
        dates = ["" if t is None else utc_text(t).removesuffix("Z") for t in (s.from_ns, s.to_ns)]
        table.add_row(*dates, str(s.rows), f"{s.bytes * 1e-6:.1f}", s.state, s.path.name)
    console = _console()
    console.print(table)
    rows, size = sum(s.rows for s in segments), sum(s.bytes for s in segments)
    console.print(f"{len(segments)} logs, {rows} rows, {size * 1e-9:.2f} GB{_per_day(segments)}")
    for s in segments:
        if s.why:
            console.print(s.why)


def _per_day(segments: list[Segment]) -> str:
    """What a day of packed logs takes."""
    packed = [s for s in segments if s.state == "packed" and s.from_ns is not None and s.to_ns is not None]
    seconds = sum((s.to_ns - s.from_ns) * 1e-9 for s in packed if s.from_ns is not None and s.to_ns is not None)
    if seconds <= 0:
        return ""
    return f"; packed: {sum(s.bytes for s in packed) * 1e-9 * DAY_S / seconds:.2f} GB a day of logging"


def _shown(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    text = f"{value:.3f}" if isinstance(value, float) else str(value)
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}… ({len(text)} characters; all of it with --json)"


def print_rows(reader: Log, first: int, *, degc: bool, header: bool) -> None:
    """Print all rows from `first` on; without new rows only the heading, if wanted."""
    table = _table(_headings(reader.layout, degc=degc), header=header)
    for block in reader.blocks(start=first):
        for cells in _cells(*block, degc=degc):
            table.add_row(*cells)
    if header or table.row_count:
        _console().print(table)


def _headings(layout: Layout, *, degc: bool) -> list[str]:
    titles = ("counts {}", "requested {} µm", "applied {} µm", "output {}")
    per_axis = [title.format(axis) for axis in layout.axes for title in titles]
    temperatures = [f"{sensor} °C" for sensor in layout.sensors] if degc else []
    return ["time s", "mode", *per_axis, *temperatures, "flags"]


def _cells(samples: Samples, commands: Commands, *, degc: bool) -> Iterator[list[str]]:
    for i in range(len(samples)):
        mode = int(samples.mode[i])
        cells = [f"{samples.time_ns[i] * 1e-9:.6f}", MODES.get(mode, str(mode))]
        per_axis = zip(
            samples.counts[i], commands.requested_um[i], commands.applied_um[i], commands.output[i], strict=True
        )
        for counts, requested_um, applied_um, output in per_axis:
            cells += [str(counts), f"{requested_um:.3f}", f"{applied_um:.3f}", str(output)]
        temperatures = [f"{t:.3f}" for t in samples.degc[i]] if degc else []
        yield [*cells, *temperatures, _flags(int(commands.flags[i]))]


def _flags(bits: int) -> str:
    return ",".join(f.name.lower() for f in Flag if bits & f and f.name) or "-"


def _table(headings: list[str], *, header: bool) -> Table:
    table = Table(box=None, show_header=header, pad_edge=False)
    *headings, last = headings
    for heading in headings:
        # As wide as usual values, so that the rows that follow later stand below the first ones.
        width = max(12, len(heading)) if heading else None
        # Text: a sensor name with brackets is no markup.
        table.add_column(Text(heading), justify="right" if heading else "left", min_width=width, no_wrap=bool(heading))
    table.add_column(Text(last), no_wrap=bool(last))
    return table


def _console() -> Console:
    """A console that never folds a table when its output goes to a file or a program."""
    console = Console(markup=False, highlight=False)
    return console if console.is_terminal else Console(markup=False, highlight=False, width=100_000)
