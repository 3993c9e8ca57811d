"""`rtec replay`: a log or a capture through the same step."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.common import Json, print_json

if TYPE_CHECKING:
    from rtec.loop.run_file import Setup

MORE = "and {} more rows"


def replay(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Run file: machine, model, limits.")],
    log: Annotated[
        Path,
        typer.Argument(metavar="LOG", help="A log of `rtec run`, a folder of logs, or a capture (.sr)."),
    ],
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare with the commands in the log, bit for bit; status 1 if any differs."),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Write here; by default beside the log, with 'replay' in its name."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Replays a log, or a logic-analyser capture, through the same step as the daemon, as fast as it can.

    A log gives a new log with recomputed commands; `--check` compares them with the logged ones. In a folder every log
    is checked, each from its own beginning, packed ones (.parquet) too. A capture (sigrok `.sr`) gives a capture with
    corrected A/B lines that sigrok opens, and a table of counts; `[capture]` in the run file names the channels.

    Examples: `rtec replay configs/turning-centre-sim.toml logs/run.arrows --check`

    `rtec replay configs/mouse-capture.toml mouse.sr --out corrected.sr`
    """
    from rtec.errors import ConfigError
    from rtec.loop.run_file import load_setup

    setup = load_setup(config)
    if log.suffix == ".sr":
        if check:
            raise ConfigError("--check compares with logged commands; a capture has none, leave it out")
        _capture(setup, log, out, as_json)
    else:
        _log(setup, log, out, check or log.is_dir(), as_json)


def _log(setup: "Setup", log: Path, out: Path | None, check: bool, as_json: bool) -> None:
    from rtec.cli.common import bar
    from rtec.replay.replay import replay_logs
    from rtec.wording import counted

    target = out or (None if check or log.is_dir() else log.with_name(f"{log.stem}.replay.arrows"))
    with bar(log.name) as progress:
        report = replay_logs(setup, log, target, check, progress)
    if as_json:
        facts = dataclasses.asdict(report) | {"out": str(report.out) if report.out else None, "checked": check}
        print_json(facts)
    else:
        for note in report.notes:
            typer.echo(f"note: {note}")
        if report.torn_bytes:
            typer.echo(f"note: the log ends torn; {report.torn_bytes} bytes after its last whole batch are skipped")
        for d in report.differences:
            typer.echo(f"row {d.row}: {d.field} was {d.logged}, is now {d.replayed}")
        if report.different > len(report.differences):
            typer.echo(MORE.format(report.different - len({d.row for d in report.differences})))
        if check:
            verdict = "all bit-identical" if not report.different else f"{report.different} differ"
            if report.rows > report.unchecked or not report.rows:
                typer.echo(f"{counted(report.rows - report.unchecked, 'command')} checked: {verdict}")
            if report.unchecked:
                typer.echo(f"{counted(report.unchecked, 'command')} not checkable: rows before were lost")
        if report.out:
            typer.echo(f"{counted(report.rows, 'command')} written to {report.out}")
        for text in report.unread:
            typer.echo(f"not checked: {text}")
    if report.different or report.unread:
        raise typer.Exit(1)


def _capture(setup: "Setup", capture: Path, out: Path | None, as_json: bool) -> None:
    from rtec.cli.common import bar, flag_lines
    from rtec.replay.capture import replay_capture

    target = out or capture.with_name(f"{capture.stem}.replay.sr")
    with bar(capture.name) as progress:
        report = replay_capture(setup, capture, target, target.with_suffix(".csv"), progress)
    if as_json:
        facts = dataclasses.asdict(report) | {
            "capture_out": str(report.capture_out),
            "table_out": str(report.table_out),
        }
        print_json(facts)
        return
    typer.echo(f"{report.samples} samples, {report.duration_s:g} s, {report.cycles} cycles")
    for line in flag_lines(report.flags_seen):
        typer.echo(line)
    for name, axis in report.axes.items():
        typer.echo(
            f"axis {name}: raw {axis.raw_counts:+d}, inserted {axis.inserted_counts:+d}, "
            f"corrected {axis.corrected_counts:+d} counts"
        )
        if axis.illegal:
            typer.echo(f"  {axis.illegal} illegal transitions in the capture (both lines at once), passed as they are")
        if axis.waiting_counts:
            typer.echo(f"  {axis.waiting_counts:+d} counts found no room before the end")
    typer.echo(f"written: {report.capture_out} and {report.table_out}")
