"""`make bench`: every figure of speed, each with its ratio and what it is measured against in the same run."""

import argparse
import platform
import sys

from rich.table import Table

from rtec.cli.screen import Console
from tests.bench import boxlink, cycle, diagnose, disturb, fit, linuxcnc, logs, quadrature, startup, wakeup
from tests.bench.table import Row

PARTS = {
    "boxlink": boxlink.rows,
    "cycle": cycle.rows,
    "diagnose": diagnose.rows,
    "disturb": disturb.rows,
    "fit": fit.rows,
    "linuxcnc": linuxcnc.rows,
    "logs": logs.rows,
    "quadrature": quadrature.rows,
    "startup": startup.rows,
    "wakeup": wakeup.rows,
}


def main(words: list[str]) -> None:
    """Print the parts that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description="Figures of speed, each beside another.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"only these: {', '.join(PARTS)}")
    wanted: list[str] = parser.parse_args(words).parts
    if unknown := [name for name in wanted if name not in PARTS]:
        parser.error(f"no part {unknown[0]!r}; there are {', '.join(PARTS)}")
    console = Console(width=150)
    for name in wanted or list(PARTS):
        console.print(_table(name, PARTS[name]()))
    console.print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}")


def _table(name: str, rows: list[Row]) -> Table:
    table = Table(title=name, title_justify="left", expand=True)
    for column in ("what", "here", "ratio", "against", "goal"):
        table.add_column(column, justify="right" if column in ("here", "ratio") else "left")
    for row in rows:
        goal = f"{row.goal} {'met' if row.met else 'MISSED'}" if row.goal else ""
        ratio = "" if row.ratio is None else f"{row.ratio:.3g} ×"
        table.add_row(row.name, row.value, ratio, row.against, goal)
    return table


if __name__ == "__main__":
    main(sys.argv[1:])
