"""Shared by the commands: options, progress on standard error, and the output of results."""

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table as Grid

    from rtec.cli.screen import Console
    from rtec.report.page import Page, Section, Table
    from rtec.result import Result

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Full = Annotated[bool, typer.Option("--full", help="Print all tables, not the verdict and one table.")]


def writable_folder(folder: Path | None) -> Path | None:
    """Callback of an option: refuse a folder that cannot be made or written to, before the work begins."""
    from rtec.files import cannot_be_made

    if folder is not None and (why := cannot_be_made(folder)):
        raise typer.BadParameter(f"{folder} cannot be written: {why}")
    return folder


def writable_file(file: Path | None) -> Path | None:
    """Callback of an option: refuse a file whose folder cannot be made or written to, before the work begins."""
    from rtec.files import cannot_be_made

    if file is not None and (why := cannot_be_made(file.parent)):
        raise typer.BadParameter(f"{file} cannot be written: {why}")
    return file


Report = Annotated[
    Path | None,
    typer.Option(
        "--report",
        metavar="FOLDER",
        callback=writable_folder,
        help="Write figures, report.html and result.json here.",
        show_default=False,
    ),
]
MachineFile = Annotated[Path, typer.Option("--machine", "-m", help="Machine file.", show_default=False)]

PIPED_WIDTH = 120
"""Columns of piped output where the environment does not set COLUMNS."""
GAPS, EDGES = (3, 2), 2
"""Blanks between columns, in a wide and in a narrow table; and at both ends together."""
WITH_UNIT = re.compile(r"(?<=\d) (?=(?:%|µ\S*|°C?|[mµ]?m|ms|s|h|min|K|Hz|1/\w+)(?![\w-]))")
NO_BREAK = "\u00a0"
"""A blank between a number and its unit, and its replacement, at which no line is broken."""
MOST_TURNED = 6
"""Largest number of rows that may become columns."""


@contextmanager
def bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """Show one progress bar; gives a progress callback: steps done, and their total."""
    with stages(title) as stage:
        yield lambda done, total: stage(title, done, total)


@contextmanager
def stages(title: str = "starting") -> Iterator[Callable[[str, int, int], None]]:
    """Show one progress bar with the name of its stage, on standard error and only if that is a terminal."""
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from rtec.cli.screen import Console

    columns = (SpinnerColumn(), TextColumn("{task.description:<32}", markup=False), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(title, total=None)

        def update(what: str, done: int, total: int) -> None:
            progress.update(task, description=what, completed=done, total=max(total, 1) if done else None)

        yield update


def completes(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Completion of a value in the shell, from names that are read only then."""

    def begun(incomplete: str) -> list[str]:
        return [name for name in names() if name.startswith(incomplete)]

    return begun


def print_json(facts: object, *, on_one_line: bool = False) -> None:
    """Print a result as JSON: arrays as lists, numbers that are not finite as null."""
    from rtec.result import plain

    typer.echo(json.dumps(plain(facts), indent=None if on_one_line else 2, ensure_ascii=False))


def give(
    page_of: "Callable[[bool], Page]",
    facts: object,
    *,
    as_json: bool,
    report: Path | None = None,
) -> None:
    """Write the report if a folder is named; then print the result as JSON, or its page and the paths.

    Args:
        page_of: makes the page, with figures or without.
        facts: the result for JSON; the path of the report is added to it.
        as_json: print JSON, and nothing else.
        report: folder of the report.
    """
    from rtec.report.page import write_page
    from rtec.result import plain

    page = page_of(report is not None)
    path = write_page(page, facts, report) if report else None
    if as_json:
        print_json(plain(facts) | {"report": str(path) if path else None})
    else:
        _show(page, path, full=True, written={})


def show(
    result: "Result", *, as_json: bool, full: bool = True, written: Mapping[str, Path | str | None] | None = None
) -> None:
    """Print a result as JSON, or its page and the paths of written files.

    Args:
        result: the result, with its report where one was written.
        as_json: print JSON, and nothing else.
        full: print all of the page, not its brief form.
        written: what else was written, by what it is.
    """
    if as_json:
        print_json(result.to_dict())
    else:
        report = result.written.get("report")
        _show(result.page(figures=report is not None), report, full=full, written=written or {})


def _show(page: "Page", report: Path | None, *, full: bool, written: Mapping[str, Path | str | None]) -> None:
    """Print a page and the paths of written files, with the first figure of the report."""
    show_page(page, full=full)
    paths: dict[str, Path | str | None] = {**written}
    if report and (figure := page.first_figure):
        paths["Figure"] = report.parent / figure.name
    paths["Report"] = report
    for name, place in paths.items():
        if place:
            typer.echo(f"{name}: {place}")
    for command in page.next:
        typer.echo(f"Next: {command}")
    if page.brief and not (full or report):
        typer.echo("More: --full prints all tables, --report FOLDER writes figures too.")


def print_console() -> "Console":
    """A console for results; if piped, its width is COLUMNS, else `PIPED_WIDTH`."""
    from rtec.cli.screen import Console

    console = Console(highlight=False)
    if console.is_terminal or os.environ.get("COLUMNS", "").isdigit():
        return console
    return Console(highlight=False, width=PIPED_WIDTH)


def show_page(page: "Page", *, full: bool = True) -> None:
    """Print a page, or its brief form: the verdict and one short table."""
    console = print_console()
    console.print(_wrapped(page.lead, console.width) + "\n", soft_wrap=True)
    for section in page.sections if full or page.brief is None else [page.brief]:
        _show_section(section, console)


def _show_section(section: "Section", console: "Console") -> None:
    if section.table is None and not section.text:
        return
    if section.heading:
        console.print(section.heading, style="bold")
    for sentence in section.text:
        # Users copy a command: it stays on one line.
        command = sentence.startswith("rtec ")
        text = f"  {sentence}" if command else _wrapped(sentence, console.width, "- ", "  ")
        console.print(text, soft_wrap=True)
    if section.table is not None:
        print_table(section.table, console)
        if section.table.caption:
            console.print(_wrapped(section.table.caption, console.width), soft_wrap=True)
    console.print()


def _wrapped(text: str, width: int, mark: str = "", hang: str = "") -> str:
    """A text in lines of at most `width` columns, broken between words only; its own line ends stay.

    Args:
        text: the text.
        width: columns.
        mark: start of its first line.
        hang: start of its other lines.
    """
    out: list[str] = []
    for line in text.splitlines():
        first = hang if out else mark
        # Users copy an indented line: it is not broken.
        out += [line] if line.startswith(" ") else _wrapped_line(line, width, first, hang)
    return "\n".join(out)


def _wrapped_line(line: str, width: int, first: str, hang: str) -> list[str]:
    """Lines of at most `width` columns; a number stays with its unit."""
    whole = WITH_UNIT.sub(NO_BREAK, line)
    lines = wrap(
        whole, width, initial_indent=first, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False
    )
    return [one.replace(NO_BREAK, " ") for one in lines]


def print_table(table: "Table", console: "Console") -> None:
    """Print a table: cells are broken between words, never within one.

    If not even the longest words fit beside each other, rows become columns, or each row becomes a short list.
    """
    for shown in (table, _turned(table)):
        if shown and _room(shown, console.width):
            console.print(grid(shown, console.width))
            return
    console.print(_records(table, console.width), soft_wrap=True)


def _turned(table: "Table") -> "Table | None":
    """The table with rows and columns exchanged; None where it has too many rows."""
    from rtec.report.page import Table

    if not 1 < len(table.rows) <= MOST_TURNED:
        return None
    head, *rows = zip(table.head, *table.rows, strict=True)
    return Table(head, rows, table.caption)


def _room(table: "Table", width: int) -> int:
    """Largest number of blanks between columns at which a table fits; 0 where it does not fit."""
    return next((b for b in GAPS if _widths(table, width, b) is not None), 0)


def grid(table: "Table", width: int | None = None) -> "Grid":
    """A table for a terminal with `width` columns; in its natural width where they are too few or not given."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as Grid
    from rich.text import Text

    gap = _room(table, width) if width else GAPS[0]
    widths = _widths(table, width, gap) or [None] * len(table.head)
    out = Grid(box=SIMPLE_HEAD, pad_edge=False, collapse_padding=gap == GAPS[1])
    for k, (name, wide) in enumerate(zip(table.head, widths, strict=True)):
        out.add_column(Text(name), justify="left" if k in table.words else "right", overflow="fold", width=wide)
    for row in table.rows:
        out.add_row(*(Text(cell) for cell in row))
    return out


def _records(table: "Table", width: int) -> str:
    """The rows as a list, with a line for each cell."""
    out = [""]
    for first, *rest in table.rows:
        out.append(_wrapped(first or "-", width))
        lines = (f"{name}: {cell}" if name else cell for name, cell in zip(table.head[1:], rest, strict=True) if cell)
        out += [_wrapped(line, width, "  ", "    ") for line in lines]
    return "\n".join([*out, ""])


def _widths(table: "Table", width: int | None, gap: int) -> "Sequence[int | None] | None":
    """Column widths that break no word; each None: its natural width; None alone: there are no such widths."""
    columns = [[table.head[k], *(row[k] for row in table.rows)] for k in range(len(table.head))]
    full = [max(map(len, column)) for column in columns]
    if width is None:
        return [None] * len(columns)
    room = width - EDGES - gap * (len(columns) - 1)
    if sum(full) <= room:
        return [None] * len(columns)
    wide = [
        max(_longest_word([head]), _longest_word(cells) if k in table.words else max(map(len, cells), default=0))
        for k, (head, *cells) in enumerate(columns)
    ]
    if sum(wide) > room:
        return None
    while sum(wide) < room:
        tightest = max(range(len(wide)), key=lambda k: full[k] / max(wide[k], 1))
        wide[tightest] += 1
    return wide


def _longest_word(cells: "Sequence[str]") -> int:
    return max((len(word) for cell in cells for word in cell.split()), default=0)


@contextmanager
def interruptible(state: Callable[[], str] = lambda: "nothing was written") -> Iterator[None]:
    """Print one line on standard error when the work inside is interrupted; the interruption goes on.

    Args:
        state: gives what is written at that time, in words.
    """
    try:
        yield
    except KeyboardInterrupt as e:
        typer.echo(f"rtec: stopped; {state()}", err=True)
        e.args = (*e.args, "told")
        raise


def kept(target: Path, done: list[str]) -> str:
    """Content of a model file, in words; `done` has "refit" or "step" for each time it was written."""
    from rtec.wording import counted

    steps = done.count("step")
    parts = ["the refit"] * ("refit" in done) + [counted(steps, "step")] * (steps > 0)
    return f"{target} holds {' and '.join(parts)}" if parts else "nothing was written"
