"""`rtec run`: the daemon, with a live table and a summary at the end; `rtec replay`: its log through the same step."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rtec.cli.common import Json, print_json, writable_file
from rtec.cli.screen import Console
from rtec.control.facts import um_text
from rtec.text import joined
from rtec.wording import listed

if TYPE_CHECKING:
    from rtec.daemon.supervisor import Report, Status
    from rtec.log.recording import Event
    from rtec.loop.run_file import Setup

REFRESH_S = 0.2


class RunScreen:
    """A live table on a terminal, else a line when the loop begins; and a line for every event."""

    def __init__(self, setup: "Setup", duration_s: float | None, log: Path | None, quiet: bool) -> None:
        from rtec.daemon.process import LinePrinter

        self._setup, self._duration_s, self._log = setup, duration_s, log
        console = Console(stderr=True)
        self._live = Live(console=console, refresh_per_second=5, transient=True)
        self._on = console.is_terminal and not quiet
        self._shown_s = -1.0
        self._aloud = LinePrinter(self._say)

    def __enter__(self) -> Self:
        self._aloud.__enter__()
        if self._on:
            self._live.start()
            self._live.update(Text(f"{self._setup.machine.name}: starting (compiling the model, opening devices)…"))
        return self

    def __exit__(self, *error: object) -> None:
        self._aloud.__exit__(*error)
        if self._on:
            self._live.stop()

    def started(self) -> None:
        """Report that the loop runs."""
        if not self._on:
            where = f", log {self._log}" if self._log else ""
            typer.echo(
                f"{self._setup.machine.name}: running at {self._setup.file.run.rate_hz:g} Hz{where}",
                err=True,
            )

    def event(self, event: "Event") -> None:
        """Print an event; callable from any thread, does not block."""
        by = "" if event.who == "rtec" else f", by {event.who}"
        text = event.text.removeprefix(f"{event.what}: ").removeprefix(f"{event.what}, ")
        self._aloud.line(": ".join(part for part in (f"{event.utc} {event.what}{by}", text) if part))

    def _say(self, line: str) -> None:
        if self._on:
            self._live.console.print(line, style="yellow", markup=False, highlight=False)
        else:
            typer.echo(line, err=True)

    def update(self, status: "Status") -> None:
        """Show a status, at most a few times a second."""
        if self._on and status.cycles and abs(status.time_s - self._shown_s) >= REFRESH_S:
            self._shown_s = status.time_s
            self._live.update(Group(_axes(status), self._foot(status)))

    def _foot(self, status: "Status") -> Text:
        of = f" of {self._duration_s:g}" if self._duration_s else ""
        text = f"{status.time_s:.0f}{of} s   {status.cycles} cycles, {status.misses} deadlines missed   Ctrl-C ends"
        why = "   ".join(status.reasons)
        wrong = [f"device {name}: {joined(texts)}" for name, texts in status.devices.items()]
        wrong += [f"{name}: {text}" for name, text in status.parts.items()]
        lines = "".join(f"\n{line}" for line in (*wrong, status.reload, status.log) if line)
        return Text.assemble(text, ("\n" + why if why else "", "bold yellow"), (lines, "bold red"))


def show_report(setup: "Setup", report: "Report") -> None:
    """Print the summary of a run."""
    from rtec.report.playback import flag_lines

    console = Console()
    summary = report.summary
    title = f"{setup.machine.name}: {summary['cycles']} cycles at {setup.file.run.rate_hz:g} Hz"
    table = Table(title=title, title_justify="left")
    for name in ("", "p50", "p99", "p99.9", "max"):
        table.add_column(name, justify="left" if not name else "right")
    for key, label in (("wake_up", "wake-up latency, µs"), ("compute", "cycle time, µs")):
        times = summary[key]
        table.add_row(label, *(f"{times[k]:.1f}" for k in ("p50_us", "p99_us", "p99_9_us", "max_us")))
    console.print(table)
    console.print(_axes(report.status, report.largest_um))
    missed = summary["deadline_misses"]
    console.print(f"deadlines missed: {missed}", style="bold red" if missed else "green", highlight=False)
    for line in flag_lines(report.flags_seen):
        console.print(line, style="yellow", highlight=False)
    if summary["driver_errors"]:
        for line in device_lines(summary["devices"]):
            console.print(line, style="bold red", markup=False, highlight=False)
    for warning in report.warnings:
        console.print(f"note: {warning}", style="yellow", highlight=False)
    if report.overruns:
        console.print(f"rows that did not reach the log: {report.overruns}", style="bold red")
    if report.unfinished:
        console.print(report.unfinished, style="bold red", highlight=False, soft_wrap=True)
    if report.interrupted:
        did = "correction held" if report.unfinished or not setup.step_um else "output at zero"
        console.print(f"interrupted: {did}, {'log flushed, ' if report.log else ''}devices closed")
    if report.log:
        console.print(f"log: {report.log}", highlight=False, soft_wrap=True)


def device_lines(devices: dict[str, dict[str, Any]]) -> list[str]:
    """One line a device: number of failures, and the last reason for each of its functions."""
    lines = []
    for name, found in devices.items():
        reasons = "; ".join(dict.fromkeys(found["last"].values()))
        lines.append(f"device {name}: {found['times']} errors, the last: {reasons}")
    return lines


def show_dry_run(setup: "Setup", found: dict[str, Any]) -> None:
    """Print what a dry run read."""
    console = Console()
    console.print(f"{setup.machine.name}: dry run, nothing was commanded", highlight=False)
    table = Table()
    for name in ("input", "value", "age"):
        table.add_column(name, justify="left" if name == "input" else "right")
    for name, value, age in found["inputs"]:
        table.add_row(name, value, age)
    console.print(table)
    for axis, um in found["requested_um"].items():
        console.print(f"axis {axis}: the model would ask for {um_text(um)} µm", highlight=False)
    if found["unread"]:
        console.print(
            f"the correction cannot be computed: the model reads {listed(found['unread'])}, never read here",
            style="yellow",
            markup=False,
            highlight=False,
        )
    for reason in found["reasons"]:
        console.print(f"would hold: {reason}", style="yellow")
    for trouble in found["troubles"]:
        console.print(trouble, style="bold red", markup=False, highlight=False)
    for note in found["notes"]:
        console.print(f"note: {note}", style="yellow", markup=False, highlight=False)
    console.print("not ready: see above" if found["reasons"] or found["troubles"] else "ready to run")


def _axes(status: "Status", largest_um: dict[str, float] | None = None) -> Table:
    table = Table()
    table.add_column("axis")
    for name in ("requested, µm", "applied, µm", "output, units"):
        table.add_column(name, justify="right")
    if largest_um:
        table.add_column("largest applied, µm", justify="right")
    for axis in status.applied_um:
        row = [
            axis,
            um_text(status.requested_um[axis]),
            um_text(status.applied_um[axis]),
            f"{status.output[axis]:+d}",
        ]
        table.add_row(*row, *([f"{largest_um[axis]:.2f}"] if largest_um else []))
    return table


def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Run file: machine, model, devices, limits.")],
    duration: Annotated[
        float | None,
        typer.Option(
            "--duration", "-d", min=0.001, max=1e9, help="Run for this many seconds.", show_default="until Ctrl-C"
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Check files and devices, wait up to 3 s for readings, command nothing. Exit status 1: not ready.",
        ),
    ] = False,
    log: Annotated[
        Path | None, typer.Option("--log", help="Write the log here, instead of into the run file's log_folder.")
    ] = None,
    as_json: Json = False,
    step: Annotated[
        str | None,
        typer.Option(
            "--step",
            metavar="AXIS=STEP",
            help="Sign check: instead of the model, step one axis within its limits, as X=20um. The step is taken back "
            "at the end. A log is written with --log only.",
        ),
    ] = None,
) -> None:
    """Corrects a machine: reads counts and temperatures, evaluates the model, applies the correction, at a fixed rate.

    Ctrl-C holds the correction, flushes the log and closes the devices.

    Example, on the simulated turning centre: `rtec run configs/turning-centre-sim.toml --duration 10`

    Example, a sign check, ended by Ctrl-C: `rtec run configs/turning-centre-sim.toml --step X=20um`
    """
    from rtec.daemon.sign_check import load_stepped, step_of
    from rtec.errors import LogError
    from rtec.files import check_named

    setup = load_stepped(config, step_of(step) if step else {})
    if log is not None:
        check_named(log, LogError)
    if dry_run:
        _dry_run(setup, as_json)
        return
    from rtec.control.server import Control
    from rtec.daemon.disk import new_log_path
    from rtec.daemon.supervisor import Supervisor
    from rtec.loop.clock import RealClock

    path = log or (None if step else new_log_path(setup))
    for axis, um in setup.step_um.items():
        typer.echo(f"sign check: axis {axis} goes by {um:+g} µm; it goes back when you end this with Ctrl-C", err=True)
    screen = RunScreen(setup, duration, path, quiet=as_json)
    supervisor = Supervisor(setup, path, screen.update, screen.started, on_event=screen.event, forks=True)

    with closing(Control(setup, supervisor, RealClock())) as control:
        control.listen()  # a second daemon is refused before it opens a device

        @contextmanager
        def beside() -> Iterator[None]:
            with screen, control:
                yield

        report = supervisor.run(duration, beside())
    if as_json:
        print_json(_facts(report))
    else:
        show_report(setup, report)
    if report.interrupted:
        raise typer.Exit(130)


def _dry_run(setup: "Setup", as_json: bool) -> None:
    from rtec.daemon.dry_run import dry_run

    found = dry_run(setup)
    if as_json:
        print_json(found)
    else:
        show_dry_run(setup, found)
    if found["reasons"] or found["troubles"]:
        raise typer.Exit(1)


def _facts(report: "Report") -> dict[str, Any]:
    """The summary's JSON."""
    return {
        **report.summary,
        "requested_um": report.status.requested_um,
        "applied_um": report.status.applied_um,
        "largest_um": report.largest_um,
        "flags_seen": report.flags_seen,
        "degc": report.status.degc,
        "log": str(report.log) if report.log else None,
        "rows_not_logged": report.overruns,
        "interrupted": report.interrupted,
        "warnings": [*report.warnings, *filter(None, [report.unfinished])],
    }


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
        typer.Option(
            "--out",
            "-o",
            callback=writable_file,
            help="Write here; by default beside the log, with 'replay' in its name.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Replays a log, or a logic-analyser capture, through the same step as the daemon, as fast as it can.

    Example: `rtec replay configs/turning-centre-sim.toml logs/run.arrows --check`

    `rtec replay configs/capture.toml scale.sr --out corrected.sr`

    A log gives a new log with recomputed commands; `--check` compares them with the logged ones. In a folder every log
    is checked, each from its own beginning, packed ones (.parquet) too. A capture (sigrok `.sr`) gives a capture with
    corrected A/B lines that sigrok opens, and a table of counts; `[capture]` in the run file names the channels.
    Neither needs `[role]` or `[device]` there.
    """
    from rtec import api
    from rtec.cli.common import stages
    from rtec.report.playback import replay_lines

    with stages(log.name) as stage:
        result = api.replay(config, log, check=check, out=out, progress=stage)
    if as_json:
        print_json(result.to_dict())
    else:
        typer.echo("\n".join(replay_lines(result)))
    if not result.well:
        raise typer.Exit(1)
