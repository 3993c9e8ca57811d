"""`rtec plan`: what planned tests can tell apart, and what to add."""

import json
from pathlib import Path
from typing import Annotated

import typer


def plan(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE", help="Machine file.", show_default=False)],
    tests: Annotated[
        list[Path],
        typer.Argument(metavar="TEST...", help="Measurements, or TOML files of planned ones.", show_default=False),
    ],
    effects: Annotated[
        str | None,
        typer.Option(help="What is to be found: scale:EXX,backlash:EXX,axis_expansion:EXX:sensor=T_bed."),
    ] = None,
    model: Annotated[Path | None, typer.Option(metavar="MODEL", help="The effects of this model instead.")] = None,
    noise: Annotated[float, typer.Option(min=1e-4, help="White noise of a reading, µm or µrad.")] = 0.5,
    suggest: Annotated[bool, typer.Option("--suggest/--no-suggest", help="Look for tests to add.")] = True,
    report: Annotated[Path | None, typer.Option(metavar="DIR", help="Write report.html and result.json here.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Say which parameters a set of tests separates, which stay confounded, and what test to add.

    Nothing needs to have been measured: a planned test is a TOML file with [measurement] and [setup] as beside a
    measurement, and [targets] and [[phase]] as `rtec simulate --settings` takes them.

    Example: `rtec plan configs/machines/turning-centre.toml laser-x.toml --effects scale:EXX,guide_curvature:EBX`
    """
    from rtec.cli.progress import stages
    from rtec.cli.show import show_page
    from rtec.diagnosis.plan import propose, separation
    from rtec.diagnosis.plan_tests import extra_tests, load_test, thinned, wanted_effects
    from rtec.machine import load_machine
    from rtec.report.plan import plan_page
    from rtec.report.procedures import plain, write_page

    known = load_machine(machine)
    with stages() as stage:
        stage("reading the tests", 0, 1)
        given = [thinned(load_test(t, known)) for t in tests]
        asked = wanted_effects(effects, model, given, known)
        sizes = {m.name: noise for m in given}
        found = separation(asked, given, sizes)
        proposals = []
        if suggest and (not found.complete or found.condition > 30.0):
            stage("looking for tests to add", 0, 1)
            proposals = propose(asked, given, extra_tests(known), sizes)
    page = plan_page(found, proposals, [m.name for m in given])
    facts = found.facts() | {
        "tests": [m.name for m in given],
        "proposals": [
            {"test": p.test.name, "hours": p.test.hours, "rank": p.after.rank, "gained": list(p.gained),
             "condition_number": p.after.condition}
            for p in proposals
        ],
    }  # fmt: skip
    written = write_page(page, facts, report) if report else None
    if as_json:
        typer.echo(json.dumps(plain(facts), indent=2, ensure_ascii=False))
        return
    show_page(page)
    if written:
        typer.echo(f"Report: {written}")
