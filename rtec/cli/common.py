"""One progress bar for all long work: on standard error, so that results can be piped, if that is a terminal.

Prints a report's sentences and tables in the terminal: the same page as the HTML, without its figures.

What is said when somebody stops a command with Ctrl-C.

How the guard's flags are shown to people.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table as Grid

    from rtec.report.page import Page, Table


@contextmanager
def bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Give a function that is told how much is done, of how much."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from rtec.cli.screen import Console

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:.0f} %"))
    console = Console(stderr=True)
    with Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task(title, total=None)

        def tell(done: int, total: int) -> None:
            progress.update(task, completed=done, total=max(total, 1))

        yield tell


@contextmanager
def stages() -> Iterator[Callable[[str, int, int], None]]:
    """One bar, which names the stage that it is of; on standard error, so that results can be piped."""
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from rtec.cli.screen import Console

    columns = (SpinnerColumn(), TextColumn("{task.description:<32}", markup=False), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("getting ready", total=None)

        def tell(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=total if done else None)

        yield tell


PIPED_WIDTH = 120
WHOLE = 30
"""Letters of a word that is not broken where there is any room for it."""
BETWEEN, EDGES = 3, 2
"""Blanks between columns, and at both ends."""


def show_page(page: "Page") -> None:
    """Print a page; wide enough for its tables where the output is piped."""
    from rtec.cli.screen import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=PIPED_WIDTH)
    console.print(page.lead + "\n")
    for section in page.sections:
        if section.table is None and not section.text:
            continue
        console.print(section.heading, style="bold")
        for sentence in section.text:
            # A command to be copied stays on one line, however long.
            command = sentence.startswith("rtec ")
            console.print(f"{'  ' if command else '- '}{sentence}", soft_wrap=command)
        if section.table is not None:
            console.print(grid(section.table, console.width))
        console.print()


def grid(table: "Table", width: int | None = None) -> "Grid":
    """A table as a terminal of so many columns shows it: nothing is cut, what does not fit is folded."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as Grid
    from rich.text import Text

    out = Grid(box=SIMPLE_HEAD, pad_edge=False)
    for k, (name, wide) in enumerate(zip(table.head, _widths(table, width), strict=True)):
        out.add_column(Text(name), justify="left" if k in table.words else "right", overflow="fold", width=wide)
    for row in table.rows:
        out.add_row(*(Text(cell) for cell in row))
    return out


def _widths(table: "Table", width: int | None) -> "Sequence[int | None]":
    """Widths at which words stay whole, and those columns are narrowed that lose least; None leaves it to chance."""
    if width is None:
        return [None] * len(table.head)
    columns = [[table.head[k], *(row[k] for row in table.rows)] for k in range(len(table.head))]
    full = [max(map(len, column)) for column in columns]
    room = width - EDGES - BETWEEN * (len(columns) - 1)
    if sum(full) <= room:
        return [None] * len(columns)
    wide = [
        max(_longest_word([head]), _longest_word(cells) if k in table.words else max(map(len, cells), default=0))
        for k, (head, *cells) in enumerate(columns)
    ]
    if sum(wide) > room:
        return [None] * len(columns)
    while sum(wide) < room:
        tightest = max(range(len(wide)), key=lambda k: full[k] / max(wide[k], 1))
        wide[tightest] += 1
    return wide


def _longest_word(cells: "Sequence[str]") -> int:
    return min(max((len(word) for cell in cells for word in cell.split()), default=0), WHOLE)


@contextmanager
def told_when_stopped(state: Callable[[], str] = lambda: "nothing was written") -> Iterator[None]:
    """Say one line on standard error when the work inside is interrupted; the interruption goes on.

    Args:
        state: gives what has been written by then, in words.
    """
    try:
        yield
    except KeyboardInterrupt:
        import typer

        typer.echo(f"rtec: stopped; {state()}", err=True)
        raise


def kept(target: Path, done: list[str]) -> str:
    """What a model file holds, in words; `done` has "refit" or "step" for each time it was written."""
    steps = done.count("step")
    parts = ["the refit"] * ("refit" in done) + [f"{steps} step{'s' if steps > 1 else ''}"] * (steps > 0)
    return f"{target} holds {' and '.join(parts)}" if parts else "nothing was written"


def flag_lines(flags_seen: Mapping[str, float]) -> list[str]:
    """One line a flag with its share of the cycles; LIMITED is left out, since every correction begins with it."""
    return [
        f"{name.lower().replace('_', ' ')}: {100.0 * share:.3g} % of cycles"
        for name, share in flags_seen.items()
        if name != "LIMITED"
    ]
