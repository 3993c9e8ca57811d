"""`rtec hil`: the daemon against a simulated machine behind real buses."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtec.cli.common import Json, completes, print_json, writable_folder

if TYPE_CHECKING:
    from rtec.hil import Bench, HilOrder, HilResult, SoakOrder, SoakResult
    from rtec.report.page import Page

STOPPED = 130
"""Exit status after Ctrl-C."""


def _faults() -> list[str]:
    from rtec.hil import load_bench

    return ["list", *load_bench().faults()]


def hil(
    config: Annotated[
        Path | None, typer.Argument(metavar="CONFIG", help="Run file with a section [hil].", show_default=False)
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            "--fault",
            metavar="NAME@30s[+10s]",
            help="A fault, its begin after the correction is on, its duration; repeatable. `list` lists them.",
            show_default=False,
            autocompletion=completes(_faults),
        ),
    ] = None,
    off_s: Annotated[
        float | None,
        typer.Option("--off", min=1.0, max=1e6, help="Seconds uncorrected.", show_default="of the run file"),
    ] = None,
    on_s: Annotated[
        float | None, typer.Option("--on", min=1.0, max=1e6, help="Seconds corrected; extended as faults need.")
    ] = None,
    soak: Annotated[
        float | None,
        typer.Option(
            "--soak",
            metavar="MINUTES",
            min=0.5,
            max=1e6,
            help="Make one long corrected run with random faults instead.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the faults of --soak.")] = 1,
    shared: Annotated[
        bool,
        typer.Option("--shared", help="Others use this PC too: report what depends on its clock, do not judge it."),
    ] = False,
    gateware: Annotated[
        Path | None,
        typer.Option(
            "--gateware",
            metavar="LIBRARY",
            help="Simulated gateware as the encoder box; see docs/encoder-box.md.",
            show_default=False,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            "--report",
            metavar="FOLDER",
            callback=writable_folder,
            help="Write figure, report.html, result.json and the log here.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Runs the daemon against simulated hardware behind real serial, Modbus and CAN lines, on the real clock.

    Example: `rtec hil configs/hil.toml --off 40 --on 40 --fault modbus-silent@8s+8s --report out/hil`

    Only the ports of the run file's devices change. Behind them an encoder box, Modbus slaves and a CAN adapter run as
    processes of their own. The machine runs uncorrected, then corrected, for some 80 seconds. A run in which everything
    is simulated, of the same machine and programme, is the reference.

    Exit status 1 if a check fails: ledger, log, no jump, recovery, improvement within 10 % of the reference; with
    --soak also memory, open files, threads, deadlines. Ctrl-C in the corrected run ends it: the verdict and the report
    are those of the time until then.
    """
    from rtec.hil import HilOrder, SoakOrder, load_bench, parse_fault

    bench = load_bench()
    if "list" in (fault or ()):
        _list(bench, as_json)
        return
    if config is None:
        raise typer.BadParameter("which run file? For example configs/hil.toml", param_hint="CONFIG")
    known = bench.faults()
    if soak is not None:
        if fault or off_s or on_s:
            raise typer.BadParameter("draws its own faults and has no uncorrected part", param_hint="--soak")
        _soak(bench, SoakOrder(config, soak, seed, report, shared, gateware), as_json)
        return
    faults = [parse_fault(text, known) for text in fault or ()]
    _run(bench, HilOrder(config, off_s, on_s, faults, report, shared, gateware), as_json)


def _run(bench: "Bench", order: "HilOrder", as_json: bool) -> None:
    """Run uncorrected, then corrected."""
    from rtec.cli.common import interruptible, stages
    from rtec.report.hil import hil_facts, hil_page

    with interruptible(lambda: "the corrected run had not begun, so there is no result"), stages() as stage:
        found = bench.run(order, stage)
    page = hil_page(found, figures=order.keep is not None)
    _show(page, hil_facts(found), order.keep, as_json, found)


def _soak(bench: "Bench", order: "SoakOrder", as_json: bool) -> None:
    """Make one long corrected run with random faults."""
    from rtec.cli.common import interruptible, stages
    from rtec.report.hil import soak_facts, soak_page

    with interruptible(lambda: "it had run for less than a second, so there is no result"), stages() as stage:
        found = bench.soak(order, stage)
    _show(soak_page(found), soak_facts(found), order.keep, as_json, found)


def _show(page: "Page", facts: Any, folder: Path | None, as_json: bool, found: "HilResult | SoakResult") -> None:
    from rtec.cli.common import give

    give(lambda _: page, facts, as_json=as_json, report=folder)
    if found.stopped:
        raise typer.Exit(STOPPED)
    if not found.passed:
        raise typer.Exit(1)


def _list(bench: "Bench", as_json: bool) -> None:
    """List all faults."""
    from rtec.cli.common import show_page
    from rtec.report.page import Page, Section, Table

    known = bench.faults()
    if as_json:
        print_json(dict(known))
        return
    text = ("NAME@30s lasts 5 s, NAME@30s+10s ten; seconds count from the start of the correction.",)
    table = Table(("fault", "what happens"), list(known.items()), words=(0, 1))
    show_page(Page("Faults", "What `rtec hil --fault` can make happen.", (), [Section("Faults", text, table)]))
