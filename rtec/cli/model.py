"""`rtec fit`, `compare`, `diagnose`, `add`, `improve`, `history`: a model from measurements, and what it lacks."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.common import Full, Json, Report, writable_file

if TYPE_CHECKING:
    from rtec.diagnosis.extend.add import Added
    from rtec.diagnosis.extend.improve import ProposedStep
    from rtec.diagnosis.result import Finding


def fit(
    machine: Annotated[Path, typer.Argument(metavar="MACHINE", help="Machine file.", show_default=False)],
    files: Annotated[
        list[Path],
        typer.Argument(metavar="MEASUREMENT...", help="Measurements made on it, any instruments.", show_default=False),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="MODEL", callback=writable_file, help="Write the model here.", show_default=False
        ),
    ],
    effects: Annotated[
        str | None,
        typer.Option("--effects", help="Fit these and no others: scale,backlash or mount_expansion:EXX:sensor=T_bed."),
    ] = None,
    leave_out_h: Annotated[
        float | None,
        typer.Option("--leave-out", min=1e-3, help="Hold out stretches of this many hours instead of runs."),
    ] = None,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Characterises a machine: chooses effects and temperatures on held-out runs, fits them, and writes a model.

    Example: `rtec fit configs/machines/turning-centre.toml laser-x.csv laser-z.csv -o model.toml --report out/fit`

    `rtec fit machine.toml laser-x.csv -o model.toml --effects scale,backlash,axis_expansion`

    `rtec fit machine.toml drift.csv -o model.toml --effects mount_expansion:EX0spindle:sensor=*`

    It tries every temperature, temperature difference and lag for each component error. It warns of sensors that are
    collinear, choices that are undecided, ranges that were not visited, and a model that is over-fitted. `rtec effects`
    lists the effects.
    """
    from rtec import api
    from rtec.cli.common import interruptible, show, stages

    with interruptible(), stages() as stage:
        result = api.fit(
            machine, files, effects=effects, leave_out_h=leave_out_h, out=out, report=report, progress=stage
        )
    show(result, as_json=as_json, full=full, written={"Model": out})


ModelFile = Annotated[
    Path, typer.Argument(metavar="MODEL", help="Model file, or machine file: no effects.", show_default=False)
]
Files = Annotated[
    list[Path], typer.Argument(metavar="MEASUREMENT...", help="Measurements, any instruments.", show_default=False)
]
MachineFile = Annotated[
    Path | None,
    typer.Option("--machine", "-m", metavar="MACHINE", help="Machine file.", show_default="the one beside the model"),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the random draws; same seed, same result.")]


def diagnose(
    model: ModelFile,
    files: Files,
    machine: MachineFile = None,
    only: Annotated[str | None, typer.Option(help="Test these effects only: scale,backlash.")] = None,
    alpha: Annotated[float, typer.Option(min=1e-4, max=0.5, help="Accepted false-positive rate.")] = 0.05,
    seed: Seed = 1,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Names the physical effect that a model lacks, with the evidence, the rivals and what could not be tested.

    Example: `rtec diagnose model.toml laser-x.csv drift.csv --report out/diagnosis`

    Tests every effect of the catalogue (`rtec effects`) on all measurements at once, against noise that drifts. It
    names an effect only if noise alone is an unlikely cause, its odds are 20 to 1 beyond those of finding any effect at
    all, and the error on held-out runs falls.
    """
    from rtec import api
    from rtec.cli.common import show, stages

    names = _names(only)
    with stages() as stage:
        diagnosis = api.diagnose(
            model, files, machine=machine, only=names, alpha=alpha, seed=seed, report=report, progress=stage
        )
    show(diagnosis, as_json=as_json, full=full)


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
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="MODEL2",
            callback=writable_file,
            help="Write the new model here.",
            show_default=False,
        ),
    ] = None,
    component: Annotated[str | None, typer.Option(help="Component error that it feeds, for example EXX.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Another argument of it: sensor=T_bed; repeatable."),
    ] = None,
    expr: Annotated[
        str | None, typer.Option(metavar="TEXT", help="An effect of your own: `A*sin(2*pi*x/p + phi)`.")
    ] = None,
    param: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=START:LOW..HIGH", help="A parameter of it, and its range."),
    ] = None,
    refit: Annotated[
        bool, typer.Option("--refit", help="Add nothing; refit the model's own numbers to these measurements.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write even if the error on held-out runs rises.")] = False,
    machine: MachineFile = None,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Adds an effect to a model, refits all of it, and shows the error before and after.

    Example: `rtec add model.toml axis_expansion --component EXX --set sensor=T_x_nut --data laser-x.csv -o better.toml`

    `rtec add model.toml --expr "A*sin(2*pi*x/p + phi)" --param p=37:3..200 --component EXX --data x.csv -o b.toml`

    `rtec add model.toml --refit --data laser-x.csv -o newer.toml`

    Refits on the channels as the loop sees them. Writes nothing and ends with status 1 if the error on held-out runs
    does not fall by 0.1 %, nor clearly beyond slow drift, or if only the sum of two effects is determined.
    """
    from rtec import api
    from rtec.cli.common import interruptible, show, stages
    from rtec.diagnosis.extend.add import check_one, refused, settings_of

    # `--data A B C`: B and C arrive as arguments.
    check_one(effect, expr, refit)
    rest = [*([Path(effect)] if effect and (expr or refit) else []), *(more or [])]
    files = [*(data or []), *rest]
    if not files:
        raise typer.BadParameter("name the measurements for the refit: --data laser-x.csv")
    if out is None:
        raise typer.BadParameter("name a file for the new model: -o MODEL2")
    if not (effect or expr or refit):
        raise typer.BadParameter("name an effect (`rtec effects` lists them), or write one with --expr")
    with interruptible(), stages() as stage:
        added = api.add(
            model,
            files,
            None if expr or refit else effect,
            component=component,
            expr=expr,
            params=param or [],
            arguments=settings_of(settings or [], f"effect {effect!r}"),
            machine=machine,
            out=out,
            force=force,
            report=report,
            progress=stage,
        )
    show(added, as_json=as_json, full=full, written={"Model": added.written["model_file"]})
    if added.written["model_file"] is None:
        typer.echo(f"Not written: {refused(added)}. --force writes it nonetheless.", err=True)
        raise typer.Exit(1)


def improve(
    model: ModelFile,
    files: Files,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="MODEL2",
            callback=writable_file,
            help="Write here.",
            show_default="MODEL-improved.toml",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Add each effect without asking.")] = False,
    seed: Seed = 1,
    machine: MachineFile = None,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Diagnoses and adds, one effect after the other, until no significant effect is missing.

    Example: `rtec improve model.toml laser-x.csv drift.csv -o better.toml --yes --report out/improved`

    First it refits the model's own numbers if that lowers the error on held-out runs by 2 % or more, or clearly beyond
    slow drift. It asks before each effect, unless --yes is given, and writes the model after each step. Where it
    gains nothing more, it looks once more, with the numbers as these readings have them. With --yes it adds the nearest
    effect to what has no name, or its shape along the axes, if that removes most of it.
    """
    from rtec import api
    from rtec.cli.common import interruptible, kept, show, stages

    if not yes and not sys.stdin.isatty():
        raise typer.BadParameter(
            "asks before each effect, but the input is no terminal; --yes adds them without asking"
        )
    target = out or (model.with_name(f"{model.stem}-improved.toml") if model.name else model)
    done: list[str] = []

    with interruptible(lambda: kept(target, done)), stages() as stage:
        result = api.improve(
            model,
            files,
            ask=None if yes else _ask,
            ask_made=None if yes else _ask_made,
            step=lambda added: done.append("step" if added.labels else "refit"),
            seed=seed,
            machine=machine,
            out=target,
            report=report,
            progress=stage,
        )
    show(result, as_json=as_json, full=full, written={"Model": result.written["model_file"] or "nothing to write"})


def history(
    model: ModelFile,
    machine: MachineFile = None,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Shows every change of a model with the error before and after it, down to the noise floor.

    Example: `rtec history better.toml --report out/history`
    """
    from rtec import api
    from rtec.cli.common import show

    show(api.history(model, machine=machine, report=report), as_json=as_json)


def _names(only: str | None) -> list[str] | None:
    if only is None:
        return None
    names = [n.strip() for n in only.split(",") if n.strip()]
    if not names:
        raise typer.BadParameter("name at least one effect: --only scale,backlash", param_hint="--only")
    return names


def _ask(choice: "ProposedStep") -> "Finding | None":
    """Show the candidates and ask; the answer may be the number of another candidate."""
    from rtec.cli.common import show_page
    from rtec.report.diagnosis import diagnosis_page

    show_page(diagnosis_page(choice.diagnosis, figures=False), full=False)
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


def _ask_made(made: "Added") -> bool:
    """Show the error before and after a change that names no cause (a refit, a further temperature), and ask."""
    from rtec.cli.common import show_page
    from rtec.report.history import added_page

    show_page(added_page(made, figures=False), full=False)
    return typer.confirm(made.question, default=True)


def compare(
    model: ModelFile,
    files: Files,
    machine: MachineFile = None,
    seed: Seed = 1,
    full: Full = False,
    report: Report = None,
    as_json: Json = False,
) -> None:
    """Compares a model with measurements: the residual, how much of it is noise, and where it is largest.

    The model is taken as it is; nothing is refitted. Readings outside the range of its fit are reported.

    Example: `rtec compare model.toml laser-x.csv drift.csv --report out/compare`
    """
    from rtec import api
    from rtec.cli.common import show, stages

    with stages() as stage:
        comparison = api.compare(model, files, machine=machine, seed=seed, report=report, progress=stage)
    show(comparison, as_json=as_json, full=full)
