"""`rtec demo`: the first thing to see."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rtec.demo.story import Stage, Story


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for report, figures and result.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Another seed is another day.")] = 1,
    model_out: Annotated[
        Path | None, typer.Option("--model-out", help="Write the fitted model here too, as `rtec run` reads it.")
    ] = None,
    configs: Annotated[
        Path | None, typer.Option("--configs", help="Folder with machines/ and sim/; by default that of the clone.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Show a machine tool being corrected; needs no hardware and takes under a minute.

    A simulated turning centre works for 8 hours from cold and cools overnight, once uncorrected and once through the
    same loop as `rtec run`, with a model fitted to another day. Writes an HTML report, PNGs and result.json.

    Example: `rtec demo --out out/demo --seed 1`

    The model in configs/models was made by: `rtec demo --model-out configs/models/turning-centre.toml`
    """
    from rtec.demo.page import write_report
    from rtec.demo.story import config_folder, tell_story
    from rtec.model import save_model

    with _stages() as stage:
        story = tell_story(seed, config_folder(configs), stage)
        stage("drawing the report", 0, 1)
        page = write_report(story, out)
    if model_out is not None:
        save_model(story.model, model_out)
    if as_json:
        typer.echo(json.dumps(story.facts() | {"report": str(page)}, indent=2))
    else:
        _show(story, page, model_out)


@contextmanager
def _stages() -> Iterator["Stage"]:
    """One bar, which names the stage that it is of; on standard error, so that results can be piped."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description:<32}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("getting ready", total=None)

        def tell(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total if done else None)

        yield tell


def _show(story: "Story", page: Path, model_out: Path | None) -> None:
    from rich.console import Console
    from rich.table import Table

    from rtec.demo.page import error_rows, left_sentences

    console = Console()
    console.print(
        f"Seed {story.seed}: {len(story.sizes[0].hours)} parts, cut in {story.plan.warm_h:g} h of warming up and "
        f"{story.plan.night_h:g} h of cooling; "
        f"model fitted to another day (seed {story.measuring_seed}).\n"
    )
    table = Table("error, µm", "uncorrected", "corrected", "factor", "NIST", title="Uncorrected against corrected")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in error_rows(story):
        table.add_row(f"{row[0]}, largest", *row[1:4], row[7])
        table.add_row(f"{' ' * len(row[0])}  typical", *row[4:7], "", end_section=True)
    console.print(table)
    console.print(
        "Diameter and length count from the first, cold part; typical: root mean square; "
        "NIST: what its guidelines report [G 4].\n",
        markup=False,
    )
    rest = Table("left uncorrected", "rms, µm", "largest, µm", "why", title="What is left, at the tool tip")
    facts = story.facts()["left_uncorrected"]
    for row in facts:
        rest.add_row(row["part"], f"{row['rms_um']:.2f}", f"{row['largest_um']:.2f}", row["why"])
    console.print(rest)
    for sentence in left_sentences(story):
        console.print(f"- {sentence}", markup=False, highlight=False)
    console.print(f"\nReport: {page}", markup=False, highlight=False)
    if model_out is not None:
        console.print(f"Model: {model_out}", markup=False, highlight=False)
