"""`rtec log`: finds logs by time, describes one, follows it, exports a stretch as a table."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from rtec.cli.common import Json, print_json
from rtec.cli.help import App
from rtec.cli.screen import Console
from rtec.loop.clock import Clock, RealClock
from rtec.wording import counted

if TYPE_CHECKING:
    from rtec.log.folder import Segment
    from rtec.log.format import Log
    from rtec.loop.records import Commands, Layout, Samples


LONGEST = 160


def print_facts(facts: Mapping[str, Any]) -> None:
    """Print names and values; a nested table is printed by its own names."""
    table = _table(["", ""], header=False)
    for name, value in facts.items():
        if isinstance(value, dict):
            for key, text in value.items():
                table.add_row(key, _shown(text))
        else:
            table.add_row(name, _shown(value))
    _console().print(table)


def print_segments(segments: "list[Segment]") -> None:
    """Print a line a file, then their sum, then faults."""
    from rtec.log.stretch import utc_text

    table = _table(["from (UTC)", "to (UTC)", "rows", "MB", "state", "log"], header=True)
    for s in segments:
        dates = ["" if t is None else utc_text(t).removesuffix("Z") for t in (s.from_ns, s.to_ns)]
        table.add_row(*dates, str(s.rows), f"{s.bytes * 1e-6:.1f}", s.state, s.path.name)
    console = _console()
    console.print(table)
    rows, size = sum(s.rows for s in segments), sum(s.bytes for s in segments)
    console.print(f"{counted(len(segments), 'log')}, {counted(rows, 'row')}, {size * 1e-9:.2f} GB{_per_day(segments)}")
    for s in segments:
        if s.why:
            console.print(s.why)


def _per_day(segments: "list[Segment]") -> str:
    """Size of packed logs per day, in words."""
    from rtec.quantities import DAY_S

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


def print_rows(reader: "Log", first: int, *, degc: bool, header: bool) -> None:
    """Print all rows from `first` on; without new rows only the heading, with `header`."""
    table = _table(_headings(reader.layout, degc=degc), header=header)
    for block in reader.blocks(start=first):
        for cells in _cells(*block, degc=degc):
            table.add_row(*cells)
    if header or table.row_count:
        _console().print(table)


def _headings(layout: "Layout", *, degc: bool) -> list[str]:
    titles = ("counts {}", "requested {} µm", "applied {} µm", "output {}")
    per_axis = [title.format(axis) for axis in layout.axes for title in titles]
    temperatures = [f"{sensor} °C" for sensor in layout.sensors] if degc else []
    return ["time s", "mode", *per_axis, *temperatures, "flags"]


def _cells(samples: "Samples", commands: "Commands", *, degc: bool) -> Iterator[list[str]]:
    from rtec.correction.flags import MODE_HOLD, MODE_OFF, MODE_ON, MODE_TAKEN_OVER, ORDER_MASK

    modes = {MODE_OFF: "off", MODE_ON: "on", MODE_HOLD: "hold", MODE_TAKEN_OVER: "taken over"}
    for i in range(len(samples)):
        cells = [f"{samples.time_ns[i] * 1e-9:.6f}", modes[int(samples.mode[i]) & ORDER_MASK]]
        per_axis = zip(
            samples.counts[i], commands.requested_um[i], commands.applied_um[i], commands.output[i], strict=True
        )
        for counts, requested_um, applied_um, output in per_axis:
            cells += [str(counts), f"{requested_um:.3f}", f"{applied_um:.3f}", str(output)]
        temperatures = [f"{t:.3f}" for t in samples.degc[i]] if degc else []
        yield [*cells, *temperatures, _flags(int(commands.flags[i]))]


def _flags(bits: int) -> str:
    from rtec.correction.flags import Flag

    return ",".join(f.name.lower() for f in Flag if bits & f and f.name) or "-"


def _table(headings: list[str], *, header: bool) -> Table:
    table = Table(box=None, show_header=header, pad_edge=False)
    *headings, last = headings
    for heading in headings:
        # As wide as usual values, so that later rows are aligned with the first ones.
        width = max(12, len(heading)) if heading else None
        # As Text: brackets in a sensor's name are no markup.
        table.add_column(Text(heading), justify="right" if heading else "left", min_width=width, no_wrap=bool(heading))
    table.add_column(Text(last), no_wrap=bool(last))
    return table


def _console() -> Console:
    """A console that does not break lines of a table if its output goes to a file or a program."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=100_000)


app = App(help="Finds logs by time, describes one, follows it while it grows, exports it as a table.")

_FOLLOW_NS = 250_000_000
_clock: Clock = RealClock()
_Log = Annotated[Path, typer.Argument(metavar="LOG", help="A log written by `rtec run`.", show_default=False)]
_Logs = Annotated[Path, typer.Argument(metavar="LOG", help="A log, or the folder of all of them.", show_default=False)]
_From = Annotated[
    str | None,
    typer.Option("--from", metavar="TIME", help="From this date and time on, as 2026-03-09T14:30; add Z for UTC."),
]
_To = Annotated[str | None, typer.Option("--to", metavar="TIME", help="Before this date and time.")]


@app.command("list")
def list_(logs: _Logs, from_: _From = None, to: _To = None, as_json: Json = False) -> None:
    """Lists the logs of a stretch of time, each with its dates, rows and size, and whether it is whole.

    Example: `rtec log list logs --from 2026-03-09T06:00 --to 2026-03-09T14:00`

    Logs are in the order of writing, even if the wall clock was set meanwhile. A damaged log is listed, loses its own
    rows only, and gives exit status 1. A folder that does not exist or has no logs gives exit status 2.
    """
    segments = _segments(logs, from_, to)
    if as_json:
        print_json([_segment_facts(s) for s in segments])
    else:
        print_segments(segments)
    if any(s.state == "damaged" for s in segments):
        raise typer.Exit(1)


@app.command()
def info(log: _Log, as_json: Json = False) -> None:
    """Shows what a log holds: versions and hashes, axes and sensors, rows, duration, and whether its end is whole.

    Example: `rtec log info run.arrows --json`
    """
    from rtec.log.reader import open_log

    with open_log(log) as reader:
        facts = _facts(reader)
    if as_json:
        print_json(facts)
        return
    print_facts(facts)


@app.command()
def export(
    log: _Logs,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Table to write: NAME.parquet, NAME.csv or NAME.mcap.")],
    from_: _From = None,
    to: _To = None,
    utc: Annotated[
        bool, typer.Option("--utc", help="A first column `utc` with the date and time of each row.")
    ] = False,
) -> None:
    """Exports a log, or a stretch of time of a folder, as a table: time_s, counts_X, degc_T_spindle, applied_um_X, ...

    The table is written whole or not at all. time_s counts from its first row.

    Example: `rtec log export run.arrows run.parquet`

    Example, one shift: `rtec log export logs shift.parquet --from 2026-03-09T06:00 --to 2026-03-09T14:00 --utc`

    All columns but utc are numbers, as PlotJuggler needs them. Parquet keeps the header of the log. CSV has columns
    only. MCAP, for Foxglove, has a JSON message for each row; it needs pip install 'rtec[mcap]'.
    """
    from rtec.cli.common import bar
    from rtec.log.export import export as export_log

    with _opened(log, from_, to, utc) as reader, bar(out.name) as progress:
        total = reader.rows
        rows = export_log(reader, out, lambda done: progress(done, total), utc=utc)
    typer.echo(f"{counted(rows, 'row')} written to {out}")
    for text in getattr(reader, "troubles", []):
        typer.echo(f"not in it: {text}", err=True)
    if getattr(reader, "troubles", []):
        raise typer.Exit(1)


@app.command()
def tail(
    log: _Logs,
    n: Annotated[int, typer.Option("-n", "--lines", min=0, help="Rows from the end.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Follow the log as it grows, until Ctrl-C.")] = False,
    degc: Annotated[bool, typer.Option("--degc", help="Show the temperatures too.")] = False,
) -> None:
    """Shows the last rows of a log: for each axis counts, requested and applied correction, and output.

    Of a folder it shows the newest log; with `--follow` also the logs after it.

    Example: `rtec log tail run.arrows -n 5 --follow`
    """
    from rtec.log.folder import logs_at
    from rtec.log.reader import open_log

    path: Path | None = logs_at(log)[-1]
    try:
        header = True
        while path is not None:
            with open_log(path) as reader:
                print_rows(reader, max(0, reader.rows - n) if header else 0, degc=degc, header=header)
                header = False
                path = _follow(reader, log, degc=degc) if follow else None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def _facts(reader: "Log") -> dict[str, Any]:
    """The content of `info`; these names are the keys of its JSON."""
    rows = reader.rows
    first_ns, last_ns = reader.span_ns or (0, 0)
    return {
        "log": str(reader.path),
        "header": reader.header,
        "axes": list(reader.layout.axes),
        "sensors": list(reader.layout.sensors),
        "rows": rows,
        "duration_s": (last_ns - first_ns) * 1e-9,
        "bytes": reader.bytes,
        "torn_bytes": reader.torn_bytes,
        "complete": reader.complete,
    }


def _follow(reader: "Log", logs: Path, *, degc: bool) -> Path:
    """Print appended rows until the next file begins; give the path of that file."""
    from rtec.log.folder import next_log

    while True:
        first = reader.rows
        _clock.sleep_until_ns(_clock.now_ns() + _FOLLOW_NS)
        following = next_log(logs, reader.path)  # before reading: once the next file exists, this one has all its rows
        reader.refresh()
        print_rows(reader, first, degc=degc, header=False)
        if following is not None:
            return following


def _segments(logs: Path, from_: str | None, to: str | None) -> "list[Segment]":
    from rtec.cli.common import bar
    from rtec.log.stretch import instant_ns, segments_of

    bounds = [None if text is None else instant_ns(text) for text in (from_, to)]
    with bar(logs.name) as progress:
        return segments_of(logs, bounds[0], bounds[1], progress)


def _opened(logs: Path, from_: str | None, to: str | None, utc: bool) -> "Log":
    """A single file as a log; a folder as a stretch of logs."""
    from rtec.log.reader import open_log
    from rtec.log.stretch import LogStretch, instant_ns

    if not logs.is_dir() and from_ is None and to is None and not utc:
        return open_log(logs)
    bounds = [None if text is None else instant_ns(text) for text in (from_, to)]
    return LogStretch(logs, _segments(logs, from_, to), bounds[0], bounds[1])


def _segment_facts(segment: "Segment") -> dict[str, Any]:
    """A file in `list`; these names are the keys of its JSON."""
    from rtec.log.stretch import utc_text

    return {
        "log": str(segment.path),
        "state": segment.state,
        "from": None if segment.from_ns is None else utc_text(segment.from_ns),
        "to": None if segment.to_ns is None else utc_text(segment.to_ns),
        "rows": segment.rows,
        "bytes": segment.bytes,
        "why": segment.why,
    }
