"""What `rtec status` shows."""

import json
from typing import TYPE_CHECKING, Any, Final

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rtec.cli.show import PIPED_WIDTH
from rtec.control.facts import axis_rows, footer, headline, input_rows, troubles

if TYPE_CHECKING:
    from rtec.control.client import Client
    from rtec.loop.clock import Clock

PERIOD_NS: Final = 250_000_000
PAGE_NS: Final = 1_000_000_000


def show(found: dict[str, Any]) -> None:
    """Print a status."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=PIPED_WIDTH)
    console.print(page(found))


def watched(client: "Client", clock: "Clock", as_json: bool) -> None:
    """Show the status again and again; with `as_json` a line each time; where no terminal is, page below page."""
    console = Console(highlight=False)
    while as_json or not console.is_terminal:
        if as_json:
            typer.echo(json.dumps(client.status(), ensure_ascii=False))
        else:
            show(client.status())
        clock.sleep_until_ns(clock.now_ns() + (PERIOD_NS if as_json else PAGE_NS))
    with Live(page(client.status()), console=console, auto_refresh=False) as live:
        while True:
            clock.sleep_until_ns(clock.now_ns() + PERIOD_NS)
            live.update(page(client.status()), refresh=True)


def page(found: dict[str, Any]) -> RenderableType:
    """Everything in one piece."""
    axes = _table(("axis", "requested, µm", "applied, µm", "left, µm", "output, units", "counts"), axis_rows(found))
    inputs = _table(("input", "value", "age"), input_rows(found) if found["status"]["cycles"] else [])
    return Group(
        *(Text(line) for line in headline(found)),
        *(Text(line, style="bold red") for line in troubles(found)),
        *(Text(f"why: {reason}", style="yellow") for reason in found["status"]["reasons"]),
        axes,
        inputs,
        *(Text(line) for line in footer(found)),
    )


def _table(head: tuple[str, ...], rows: list[list[str]]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate(head):
        table.add_column(Text(name), justify="right" if k else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table
