"""`rtec bench discovery`: hidden effects to find, for this program and for others."""

from pathlib import Path
from typing import Annotated

import typer

from rtec.cli.common import Json
from rtec.cli.help import App

app = App(help="Benchmarks that other programs can take part in.")


@app.callback()
def _bench() -> None:
    """A group needs a callback, else typer makes its only command the group itself."""


@app.command()
def discovery(
    folder: Annotated[
        Path | None,
        typer.Option(
            "--score",
            metavar="MYTOOL",
            help="Folder of another program: an empty one gets the data sets, a filled-in answers.csv is scored.",
        ),
    ] = None,
    seeds: Annotated[
        str, typer.Option(metavar="FIRST:END", help="Seeds of the data sets, the end not included.")
    ] = "1:3",
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="GROUP", help="This group of data sets; repeatable.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    as_json: Json = False,
) -> None:
    """Scores a diagnosis on machines whose hidden effects are known: rtec's own, or that of another program.

    Example: `rtec bench discovery --score mytool --seeds 1:11`

    Without --score it diagnoses the data sets itself, some 70 for each seed, about a second each. With --score MYTOOL
    it writes them into the folder MYTOOL, without the truth, and a table answers.csv to fill in; called again, it
    scores that table. Predictions are held against the noise, and against the true law fitted to the same readings.
    `docs/benchmark.md` describes the files.
    """
    from rtec.bench.folder import ANSWERS, SETS, BenchmarkRange, read_answers, read_range, write_sets
    from rtec.bench.own import own_answers
    from rtec.bench.score import bench_page, score
    from rtec.bench.trials import GROUPS
    from rtec.cli.common import bar, give

    groups = tuple(only or GROUPS)
    for name in groups:
        if name not in GROUPS:
            raise typer.BadParameter(f"{name!r} is none of {', '.join(GROUPS)}", param_hint="--only")
    wanted = BenchmarkRange(*_seeds(seeds), groups)
    there = read_range(folder) if folder is not None else None
    if folder is not None and there is None:
        if folder.exists() and any(folder.iterdir()):
            raise typer.BadParameter(f"{folder} is not empty, and holds no benchmark", param_hint="--score")
        count = write_sets(folder, wanted)
        typer.echo(f"{count} data sets: {folder / SETS}. Fill in {folder / ANSWERS}, then call the same command again.")
        return
    made = (there or wanted).trials()
    if folder is not None:
        answers = read_answers(folder, made)
        if not answers:
            raise typer.BadParameter(f"{folder / ANSWERS} is not filled in", param_hint="--score")
    else:
        with bar(f"{len(made)} data sets") as tell:
            answers = own_answers(made, jobs, tell)
    rows = score(made, answers)
    facts = {
        "seeds": [(there or wanted).first, (there or wanted).end],
        "rows": [{**vars(r), "met": r.met} for r in rows],
    }
    give(lambda _: bench_page(rows, len(made)), facts, as_json=as_json)


def _seeds(text: str) -> tuple[int, int]:
    first, _, end = text.partition(":")
    if not (first.isdigit() and end.isdigit() and int(first) < int(end)):
        raise typer.BadParameter(f"{text!r} is no range of seeds; write FIRST:END, such as 1:11", param_hint="--seeds")
    return int(first), int(end)
