"""`rtec run`: the daemon."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rtec.daemon.supervisor import Report
    from rtec.loop.run_file import Setup


def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="Run file: machine, model, devices, limits.")],
    duration: Annotated[
        float | None, typer.Option("--duration", "-d", min=0.001, max=1e9, help="Seconds; without it, until Ctrl-C.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check every file and device, read each once, command nothing.")
    ] = False,
    log: Annotated[
        Path | None, typer.Option("--log", help="Write the log here, not into the run file's log_folder.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
    step: Annotated[
        str | None,
        typer.Option(
            "--step",
            metavar="AXIS=um",
            help="Sign check: in place of the model, a step of one axis, as X=20um, within its limits; the end takes "
            "it back. No log but with --log.",
        ),
    ] = None,
) -> None:
    """Correct a machine: read, evaluate the model, apply, at a fixed rate on the real clock.

    Ctrl-C holds the correction, flushes the log, closes the devices, and says so.

    Example, on the simulated turning centre: `rtec run configs/turning-centre-sim.toml --duration 10`

    Example of a sign check, ended by Ctrl-C: `rtec run configs/turning-centre-sim.toml --step X=20um`
    """
    from rtec.daemon.sign_check import step_of, with_step
    from rtec.loop.run_file import load_setup

    setup = with_step(load_setup(config), step_of(step) if step else {})
    if dry_run:
        _dry_run(setup, as_json)
        return
    from rtec.cli.run_screen import Screen, show_report
    from rtec.control.server import Control
    from rtec.daemon.run_log import new_log_path
    from rtec.daemon.supervisor import Supervisor
    from rtec.loop.clock import RealClock

    path = log or (None if step else new_log_path(setup))
    for axis, um in setup.step_um.items():
        typer.echo(f"sign check: axis {axis} goes by {um:+g} µm; it goes back when you end this with Ctrl-C", err=True)
    with Screen(setup, duration, path, quiet=as_json) as screen:
        supervisor = Supervisor(setup, path, screen.update, screen.started, on_event=screen.event)
        with Control(setup, supervisor, RealClock()):
            report = supervisor.run(duration)
    if as_json:
        typer.echo(json.dumps(_facts(report), indent=2))
    else:
        show_report(setup, report)
    if report.interrupted:
        raise typer.Exit(130)


def _dry_run(setup: "Setup", as_json: bool) -> None:
    from rtec.daemon.dry_run import dry_run

    found = dry_run(setup)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    from rtec.cli.run_screen import show_dry_run

    show_dry_run(setup, found)


def _facts(report: "Report") -> dict[str, Any]:
    """The summary's JSON."""
    status = dataclasses.asdict(report.status)
    status["flags"] = report.status.reasons
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
        "warnings": report.warnings,
    }
