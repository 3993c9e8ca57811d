"""Prints a report's sentences and tables in the terminal: the same page as the HTML, without its figures."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table as Grid

    from rtec.report.html import Page, Table

PIPED_WIDTH = 120


def show_page(page: "Page") -> None:
    """Print a page; wide enough for its tables where the output is piped."""
    from rich.console import Console

    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console = Console(markup=False, highlight=False, width=PIPED_WIDTH)
    console.print(page.lead + "\n")
    for section in page.sections:
        if section.table is None and not section.text:
            continue
        console.print(section.heading, style="bold")
        for sentence in section.text:
            console.print(f"- {sentence}")
        if section.table is not None:
            console.print(grid(section.table))
        console.print()


def grid(table: "Table") -> "Grid":
    """A table as the terminal shows it."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as Grid
    from rich.text import Text

    out = Grid(box=SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate(table.head):
        out.add_column(Text(name), justify="left" if k in table.words else "right")
    for row in table.rows:
        out.add_row(*(Text(cell) for cell in row))
    return out
