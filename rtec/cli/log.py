"""`rtec log`: look into a log, follow it, turn it into a table."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtec.runtime.clock import Clock, RealClock

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rtec.runtime.log import LogReader
    from rtec.runtime.records import Commands, Layout, Samples

app = typer.Typer(no_args_is_help=True, help="Look into a log, follow it while it grows, turn it into a table.")

_FOLLOW_NS = 250_000_000
_MODES = {0: "off", 1: "on", 2: "hold"}
_clock: Clock = RealClock()
_Log = Annotated[Path, typer.Argument(metavar="LOG", help="A log written by `rtec run`.", show_default=False)]


@app.command()
def info(
    log: _Log,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """What is in a log: versions and hashes, axes and sensors, rows, duration, and whether its end is whole.

    Example: rtec log info run.arrows --json
    """
    from rtec.runtime.log import LogReader

    with LogReader(log) as reader:
        facts = _facts(reader)
    if as_json:
        typer.echo(json.dumps(facts))
        return
    table = _table(["", ""], header=False)
    for name, value in facts.items():
        if isinstance(value, dict):
            for key, text in value.items():
                table.add_row(key, _shown(text))
        else:
            table.add_row(name, _shown(value))
    _console().print(table)


@app.command()
def export(
    log: _Log,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Table to write: NAME.parquet or NAME.csv.")],
) -> None:
    """Turn a log into a table with one column a number: counts_X, degc_T_spindle, applied_um_X, ...

    The table appears whole or not at all. Parquet (zstd) keeps the header of the log; CSV has columns only.

    Example: rtec log export run.arrows run.parquet
    """
    from rtec.cli.progress import bar
    from rtec.runtime.log import LogReader
    from rtec.runtime.log_export import export as export_log

    with LogReader(log) as reader, bar(out.name) as progress:
        total = reader.rows
        rows = export_log(reader, out, lambda done: progress(done, total))
    typer.echo(f"{rows} rows written to {out}")


@app.command()
def tail(
    log: _Log,
    n: Annotated[int, typer.Option("-n", "--lines", min=0, help="Rows from the end.")] = 20,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on as the log grows, until Ctrl-C.")] = False,
    degc: Annotated[bool, typer.Option("--degc", help="Show the temperatures too.")] = False,
) -> None:
    """Show the last rows of a log: per axis the counts, the requested and applied correction, and the output.

    Example: rtec log tail run.arrows -n 5 --follow
    """
    from rtec.runtime.log import LogReader

    try:
        with LogReader(log) as reader:
            first = max(0, reader.rows - n)
            _print_rows(reader, first, degc=degc, header=True)
            while follow:
                first = reader.rows
                _clock.sleep_until_ns(_clock.now_ns() + _FOLLOW_NS)
                reader.refresh()
                _print_rows(reader, first, degc=degc, header=False)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def _facts(reader: "LogReader") -> dict[str, Any]:
    """The content of `info`; these names are the keys of its JSON."""
    rows = reader.rows
    first_ns, last_ns = (_time_ns(reader, 0), _time_ns(reader, rows - 1)) if rows else (0, 0)
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


def _time_ns(reader: "LogReader", row: int) -> int:
    samples, _ = next(reader.blocks(1, start=row))
    return int(samples.time_ns[0])


def _shown(value: object) -> str:
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _print_rows(reader: "LogReader", first: int, *, degc: bool, header: bool) -> None:
    """Print all rows from `first` on; without new rows only the heading, if wanted."""
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
    for i in range(len(samples)):
        mode = int(samples.mode[i])
        cells = [f"{samples.time_ns[i] * 1e-9:.6f}", _MODES.get(mode, str(mode))]
        per_axis = zip(
            samples.counts[i], commands.requested_um[i], commands.applied_um[i], commands.output[i], strict=True
        )
        for counts, requested_um, applied_um, output in per_axis:
            cells += [str(counts), f"{requested_um:.3f}", f"{applied_um:.3f}", str(output)]
        temperatures = [f"{t:.3f}" for t in samples.degc[i]] if degc else []
        yield [*cells, *temperatures, _flags(int(commands.flags[i]))]


def _flags(bits: int) -> str:
    from rtec.correction.guard import Flag

    return ",".join(f.name.lower() for f in Flag if bits & f and f.name) or "-"


def _table(headings: list[str], *, header: bool) -> "Table":
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, show_header=header, pad_edge=False)
    *headings, last = headings
    for heading in headings:
        # As wide as usual values, so that the rows that follow later stand below the first ones.
        width = max(12, len(heading)) if heading else None
        # Text: a sensor name with brackets is no markup.
        table.add_column(Text(heading), justify="right" if heading else "left", min_width=width, no_wrap=bool(heading))
    table.add_column(Text(last), no_wrap=bool(last))
    return table


def _console() -> "Console":
    """A console that never folds a table when its output goes to a file or a program."""
    from rich.console import Console

    console = Console(markup=False, highlight=False)
    return console if console.is_terminal else Console(markup=False, highlight=False, width=100_000)
