"""The tables that the benchmark prints."""

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from rich.table import Table

from rtec.cli.screen import Console
from tests.discovery.figures import cut, figures, seconds
from tests.discovery.generator.noise import FORMS
from tests.discovery.intervals import share
from tests.discovery.score import Outcome

Column = tuple[str, Callable[[Outcome], bool]]

NAMED: tuple[Column, ...] = (
    ("first", lambda o: o.right == 1),
    ("three", lambda o: 1 <= o.right <= 3),
    ("claimed", lambda o: o.answer.accepted),
    ("in group", lambda o: o.in_group),
    ("found", lambda o: bool(o.case.hidden) and o.found == len(o.case.hidden)),
    ("≤ 1.1 floor", lambda o: o.at_floor),
)
NAMELESS: tuple[Column, ...] = (
    ("true only", lambda o: o.names_true_only),
    ("blamed", lambda o: o.answer.accepted),
    ("silent", lambda o: not o.answer.accepted and not o.answer.unknown),
)


def show(console: Console, outcomes: Sequence[Outcome], title: str) -> None:
    """Print everything."""
    console.print(_figures(outcomes, title))
    own, oracle = cut(outcomes)
    if np.isfinite(own):
        went = f"{100 * own:.0f} % of the held-out model error went; {100 * oracle:.0f} % with the true shapes fitted"
        console.print(f"singles improved: {went}")
    median, late = seconds(outcomes)
    console.print(f"one diagnosis: {median:.2f} s, one in twenty over {late:.2f} s")
    for group, columns, what in (
        ("singles", NAMED, "singles by effect"),
        ("pairs", NAMED, "pairs"),
        ("outside", NAMELESS, "outside the catalogue"),
        ("passive", NAMED, "passive"),
    ):
        sets = [o for o in outcomes if o.case.group == group]
        if sets:
            console.print(_by(sets, columns, what, lambda o: " + ".join(o.case.hidden) or "nothing"))
    singles = [o for o in outcomes if o.case.group == "singles"]
    if singles:
        console.print(_by(singles, NAMED, "singles by noise", lambda o: o.case.noise, FORMS))
    for text, count in Counter(o.failure for o in outcomes if o.failure).most_common(5):
        console.print(f"{count} × {text}", style="red", markup=False)


def _figures(outcomes: Sequence[Outcome], title: str) -> Table:
    table = Table(title=title, title_justify="left", expand=True)
    for column in ("what", "sets", "share, 95 % interval", "goal"):
        table.add_column(column, justify="left" if column == "what" else "right")
    for f in figures(outcomes):
        if not f.share.total:
            continue
        goal = "" if f.goal is None else f"{'≤' if f.at_most else '≥'} {100 * f.goal:.0f} %"
        if f.met is not None:
            goal += " met" if f.met else " MISSED"
        table.add_row(f.name, str(f.share.total), str(f.share), goal)
    return table


def _by(
    sets: Sequence[Outcome],
    columns: Sequence[Column],
    title: str,
    key: Callable[[Outcome], str],
    order: Sequence[str] | None = None,
) -> Table:
    """One line for each key: how many sets, and of how many each column is true."""
    table = Table(title=title, title_justify="left", expand=True)
    table.add_column("hidden" if order is None else "noise")
    for name in ("sets", *(name for name, _ in columns), "left µm"):
        table.add_column(name, justify="right")
    table.add_column("taken for", ratio=1)
    for text in order or sorted({key(o) for o in sets}):
        part = [o for o in sets if key(o) == text]
        if not part:
            continue
        counts = [str(share([test(o) for o in part]).hits) for _, test in columns]
        left = [x for o in part for x in o.left]
        size = f"{np.mean(left):.1f}" if left else ""
        table.add_row(text, str(len(part)), *counts, size, _taken_for(part))
    return table


def _taken_for(part: Sequence[Outcome]) -> str:
    """What was said instead, most often first."""
    said: Counter[str] = Counter()
    for o in part:
        if o.right != 1 and o.answer.accepted:
            said[str(o.answer.names[0])] += 1
        elif o.answer.unknown:
            said["unknown of " + ", ".join(o.answer.unknown)] += 1
        elif o.right != 1 or not o.answer.accepted:
            said["nothing" if not o.failure else "crash"] += 1
    return "; ".join(f"{count} × {name}" if count > 1 else name for name, count in said.most_common(3))
