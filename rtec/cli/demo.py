"""`rtec demo`: the day of a simulated machine, uncorrected and corrected, and a hidden effect."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtec.cli.common import Json, print_json, writable_file, writable_folder

if TYPE_CHECKING:
    from rtec.cli.screen import Console
    from rtec.demo.second_story import Later
    from rtec.demo.story import Story


def demo(
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="FOLDER", callback=writable_folder, help="Folder of report, figures and result."
        ),
    ] = Path("out/demo"),
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the day.")] = 1,
    hours: Annotated[
        float, typer.Option("--hours", min=0.5, max=24.0, help="Hours of work; the night is twice as long.")
    ] = 8.0,
    model_out: Annotated[
        Path | None,
        typer.Option("--model-out", callback=writable_file, help="Write the fitted model here, for `rtec run`."),
    ] = None,
    configs: Annotated[
        Path | None,
        typer.Option(
            "--configs", metavar="FOLDER", help="Folder with machines/ and sim/.", show_default="those of rtec"
        ),
    ] = None,
    hidden_seed: Annotated[
        int | None,
        typer.Option("--hidden-seed", min=0, help="Seed of the hidden effect.", show_default="random, printed"),
    ] = None,
    hidden: Annotated[
        str | None, typer.Option("--hidden", metavar="NAME", help="Hide this effect: gear, worn-screw, hot-nut, …")
    ] = None,
    no_hidden: Annotated[bool, typer.Option("--no-hidden", help="Hide no effect.")] = False,
    as_json: Json = False,
) -> None:
    """Corrects a simulated machine tool and improves its model; needs no hardware and takes under a minute.

    Example: `rtec demo --out out/demo --seed 1 --hidden-seed 7`

    Example, how the model of the shipped example was made: `rtec demo --model-out configs/models/turning-centre.toml`

    A turning centre works for 8 hours from cold and cools overnight: once uncorrected, once corrected by the same loop
    as `rtec run`. The model was fitted to another day. Then an effect is hidden in the machine. rtec finds it in the
    residual and adds it, and the error falls.
    """
    from secrets import randbelow

    from rtec.cli.common import stages
    from rtec.demo.day import Plan
    from rtec.demo.page import write_report
    from rtec.demo.story import config_folder, tell_story
    from rtec.model import save_model
    from rtec.result import plain

    if hidden_seed is None and not no_hidden:
        hidden_seed = randbelow(10_000)
    with stages() as stage:
        story = tell_story(
            seed,
            config_folder(configs),
            stage,
            Plan(warm_h=hours, night_h=2.0 * hours),
            hidden_seed=None if no_hidden else hidden_seed,
            hidden=hidden,
        )
        stage("drawing the report", 0, 1)
        page = write_report(story, out)
    if model_out is not None:
        save_model(story.model, model_out)
    if as_json:
        print_json(plain(story.facts()) | {"report": str(page)})
    else:
        _show(story, page, model_out)


def _show(story: "Story", page: Path, model_out: Path | None) -> None:
    from rich.table import Table

    from rtec.cli.screen import Console
    from rtec.demo.page import error_rows, limits_in_words

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
        "Diameter and length count from the first, cold part. Typical: root mean square. NIST: its guidelines [G 4].\n",
        markup=False,
    )
    rest = Table("source", "rms, µm", "largest, µm", "why", title="What stays uncorrected at the tool tip")
    facts = story.facts()["left_uncorrected"]
    for row in facts:
        rest.add_row(row["part"], f"{row['rms_um']:.2f}", f"{row['largest_um']:.2f}", row["why"])
    console.print(rest)
    for sentence in limits_in_words(story):
        console.print(f"- {sentence}", markup=False, highlight=False)
    if story.later is not None:
        _show_later(console, story.later)
    console.print(f"\nReport: {page}", markup=False, highlight=False)
    if model_out is not None:
        console.print(f"Model: {model_out}", markup=False, highlight=False)


def _show_later(console: "Console", later: "Later") -> None:
    from rich.table import Table

    from rtec.demo.second_story import TIP_HEAD, TITLE, later_words, tip_rows

    console.print(f"\n{TITLE}", style="bold")
    for sentence in later_words(later):
        console.print(f"- {sentence}", markup=False, highlight=False)
    table = Table(*TIP_HEAD)
    for column in table.columns[1:]:
        column.justify = "right"
    for row in tip_rows(later):
        table.add_row(*row)
    console.print(table)
