"""`rtec diagnose`, `rtec add`, `rtec improve`, `rtec history`: what is missing, and the error falling."""

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rtec.diagnosis.extend.add import Added
    from rtec.diagnosis.extend.improve import Choice
    from rtec.diagnosis.result import Finding
    from rtec.report.page import Page

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file.", show_default=False)]
Files = Annotated[
    list[Path], typer.Argument(metavar="MEASUREMENT...", help="Measurements, any instruments.", show_default=False)
]
MachineFile = Annotated[
    Path | None, typer.Option("--machine", metavar="MACHINE", help="Machine file; looked for where not given.")
]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="DIR", help="Write figures, report.html and result.json here.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Seed = Annotated[int, typer.Option(min=0, help="Of the draws of chance; same seed, same answer.")]


def diagnose(
    model: ModelFile,
    files: Files,
    machine: MachineFile = None,
    only: Annotated[str | None, typer.Option(help="Look for these effects only: scale,backlash.")] = None,
    alpha: Annotated[float, typer.Option(min=1e-4, max=0.5, help="Chance of a false name that is put up with.")] = 0.05,
    seed: Seed = 1,
    report: Report = None,
    as_json: AsJson = False,
) -> None:
    """Say which physical effect a model misses: with the evidence, the rivals, and what could not be tested.

    Weighs every effect of the catalogue (`rtec effects`) in all measurements at once against noise that drifts. A
    name is given only where chance is unlikely and runs that were left out get better.

    Example: `rtec diagnose model.toml laser-x.csv drift.csv --report out/diagnosis`
    """
    from rtec.cli.common import stages
    from rtec.diagnosis.search.diagnose import diagnose as find
    from rtec.report.diagnosis import diagnosis_page

    known, measurements = _load(model, files, machine)
    names = _names(only)
    with stages() as stage:
        found = find(known, measurements, seed=seed, alpha=alpha, only=names, explain=True, stage=stage)
    _tell(lambda figures: diagnosis_page(found, figures, [model, *files]), found.facts(), report, as_json)


def add(
    model: ModelFile,
    effect: Annotated[
        str | None, typer.Argument(metavar="EFFECT", help="Name, as in `rtec effects`.", show_default=False)
    ] = None,
    more: Annotated[list[Path] | None, typer.Argument(hidden=True)] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option("--data", metavar="MEASUREMENT...", help="Measurements to refit with.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="MODEL2", help="Write the new model here.", show_default=False)
    ] = None,
    component: Annotated[str | None, typer.Option(help="Component error that it feeds, for example EXX.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="What else it needs: sensor=T_bed; repeatable."),
    ] = None,
    expr: Annotated[
        str | None, typer.Option(metavar="TEXT", help="An effect of your own: `A*sin(2*pi*x/p + phi)`.")
    ] = None,
    param: Annotated[
        list[str] | None, typer.Option(metavar="NAME=START:LOW..HIGH", help="A parameter of it to search for.")
    ] = None,
    refit: Annotated[
        bool, typer.Option("--refit", help="Add nothing; fit the model's own numbers anew to these measurements.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write even if the error on runs left out rises.")] = False,
    machine: MachineFile = None,
    report: Report = None,
    as_json: AsJson = False,
) -> None:
    """Add an effect, refit everything on the channels as the loop sees them, and show what it bought.

    Refuses, with status 1 and nothing written, where the error on runs left out of the fit does not fall by 0.1 %.

    Example: `rtec add model.toml axis_expansion --component EXX --set sensor=T_x_nut --data laser-x.csv -o better.toml`

    `rtec add model.toml --expr "A*sin(2*pi*x/p + phi)" --param p=37:3..200 --component EXX --data x.csv -o b.toml`

    `rtec add model.toml --refit --data laser-x.csv -o newer.toml`
    """
    from rtec.cli.common import stages, told_when_stopped
    from rtec.diagnosis.extend.add import add as add_effects
    from rtec.diagnosis.extend.add import check_one, refused
    from rtec.model import save_model
    from rtec.report.additions import added_page

    # `--data A B C`: B and C arrive as arguments.
    check_one(effect, expr, refit)
    rest = [*([Path(effect)] if effect and (expr or refit) else []), *(more or [])]
    files = [*(data or []), *rest]
    if not files:
        raise typer.BadParameter("say on which measurements it is to be refitted: --data laser-x.csv")
    if out is None:
        raise typer.BadParameter("say where the new model is to be written: -o MODEL2")
    known, measurements = _load(model, files, machine)
    new = [] if refit else [_asked(known, None if expr else effect, expr, param or [], component, settings or [])]
    with told_when_stopped(), stages() as stage:
        added = add_effects(known, new, measurements, stage=stage)
    good = added.better or force
    if good:
        save_model(added.model, out)
    facts = added.facts() | {"model_file": str(out) if good else None}
    _tell(lambda figures: added_page(added, figures), facts, report, as_json)
    if not good:
        typer.echo(f"Not written: {refused(added)}. --force writes it nonetheless.", err=True)
        raise typer.Exit(1)
    if not as_json:
        typer.echo(f"Model: {out}")


def improve(
    model: ModelFile,
    files: Files,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="MODEL2", help="Write here.  [default: MODEL-improved.toml]"),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Add what is found without asking.")] = False,
    seed: Seed = 1,
    machine: MachineFile = None,
    report: Report = None,
    as_json: AsJson = False,
) -> None:
    """Diagnose and add, again and again, until nothing significant is left or the error is at the noise floor.

    First it fits the model's own numbers anew, where that lowers the error on runs left out by 2 % or more.

    Asks before each effect, unless --yes. What was added is written after every step, so that nothing is lost.

    Example: `rtec improve model.toml laser-x.csv drift.csv -o better.toml --yes --report out/improved`
    """
    from rtec.cli.common import kept, stages, told_when_stopped
    from rtec.diagnosis.extend.improve import improve as go_on
    from rtec.model import save_model
    from rtec.report.additions import improved_page

    if not yes and not sys.stdin.isatty():
        raise typer.BadParameter(
            "asks before each effect, and nobody is there to answer; say --yes to add what is found"
        )
    target = out or model.with_name(f"{model.stem}-improved.toml")
    known, measurements = _load(model, files, machine)
    done: list[str] = []

    def keep(added: "Added") -> None:
        save_model(added.model, target)
        done.append("refit" if not added.labels else "step")

    with told_when_stopped(lambda: kept(target, done)), stages() as stage:
        result = go_on(
            known,
            measurements,
            ask=None if yes else _ask,
            ask_refit=None if yes else _ask_refit,
            seed=seed,
            stage=stage,
            step=keep,
        )
    written = str(target) if done else None
    facts = result.facts() | {"model_file": written}
    _tell(lambda figures: improved_page(result, figures), facts, report, as_json)
    if not as_json:
        typer.echo(f"Model: {written}" if written else "Model: nothing to write")


def history(
    model: ModelFile,
    machine: MachineFile = None,
    report: Report = None,
    as_json: AsJson = False,
) -> None:
    """Every change of a model and what it bought: the staircase of the error falling to the noise floor.

    Example: `rtec history better.toml --report out/history`
    """
    from rtec.diagnosis.machine_file import load_with_machine
    from rtec.report.history import history_page, steps_of

    known = load_with_machine(model, machine)
    facts: dict[str, Any] = {"model": known.name, "history": [dict(h) for h in known.history], "steps": steps_of(known)}
    _tell(lambda figures: history_page(known, figures), facts, report, as_json)


def _load(model: Path, files: list[Path], machine: Path | None) -> tuple[Any, Any]:
    from rtec.diagnosis.machine_file import load_with_machine
    from rtec.metrology.files.load import load_measurements

    known = load_with_machine(model, machine)
    return known, load_measurements(files, known.machine)


def _names(only: str | None) -> list[str] | None:
    if only is None:
        return None
    from rtec.effects import effect_class

    names = [n.strip() for n in only.split(",") if n.strip()]
    if not names:
        raise typer.BadParameter("name at least one effect: --only scale,backlash", param_hint="--only")
    for name in names:
        effect_class(name, "--only")
    return names


def _asked(
    known: Any, effect: str | None, expr: str | None, param: list[str], component: str | None, settings: list[str]
) -> Any:
    from rtec.diagnosis.extend.add import asked_effect, new_effect

    if expr is not None:
        from rtec.effects.expression import expression_from_text

        if component is None:
            raise typer.BadParameter("say which component error the expression feeds: --component EXX")
        return new_effect(expression_from_text(expr, param, component, known.machine), known)
    if effect is None:
        raise typer.BadParameter("name an effect (`rtec effects` lists them), or write one with --expr")
    return asked_effect(effect, component, settings, known)


def _ask(choice: "Choice") -> "Finding | None":
    """Show what was found and ask; the number of another candidate may be given instead."""
    from rtec.cli.common import show_page
    from rtec.report.diagnosis import diagnosis_page

    page = diagnosis_page(choice.diagnosis, figures=False)
    show_page(type(page)(page.title, page.lead, page.numbers, page.sections[:2]))
    allowed = {str(f.rank): f for f in choice.diagnosis.findings}
    while True:
        answer = typer.prompt(
            f"Add {choice.finding.label}? [y]es, [n]o and stop, or the number of another", default="y"
        )
        if answer.lower() in ("y", "yes"):
            return choice.finding
        if answer.lower() in ("n", "no", "q", "stop"):
            return None
        if answer in allowed:
            return allowed[answer]
        typer.echo(f"{answer!r} is none of y, n, {', '.join(allowed)}")


def _ask_refit(made: "Added") -> bool:
    """Show what fitting the model's own numbers anew buys, and ask."""
    from rtec.cli.common import show_page
    from rtec.report.additions import added_page

    page = added_page(made, False)
    show_page(type(page)(page.title, page.lead, page.numbers, page.sections[:1]))
    return typer.confirm("Fit the model's own numbers anew?", default=True)


def _tell(page: Any, facts: Any, report: Path | None, as_json: bool) -> None:
    from rtec.cli.common import show_page
    from rtec.report.page import plain, write_page

    written = write_page(page(True), facts, report) if report else None
    if as_json:
        typer.echo(
            json.dumps(plain(facts) | {"report": str(written) if written else None}, indent=2, ensure_ascii=False)
        )
        return
    shown: Page = page(False)
    show_page(shown)
    if written:
        typer.echo(f"Report: {written}")
