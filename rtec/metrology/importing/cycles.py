"""Protocols of ISO 230-2 with one row a target and one column a run and direction, as rows in order of measuring."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np

from rtec.errors import MeasurementError
from rtec.metrology.importing.words import WORDS, axis_letter, bare_unit, direction_meant, has, is_nominal
from rtec.metrology.readers.base import ForeignTable
from rtec.metrology.readers.delimited import bracketed
from rtec.metrology.units import UNITS

SIGNS = "+-−–↑↓→←"
FILLERS = (
    WORDS["run"]
    | WORDS["deviation"]
    | WORDS["actual"]
    | WORDS["direction"]
    | {"messung", "measurement", "nr", "no", "r", *"xyzuvw"}
)
SIGNED = {
    "pos", "neg", "positive", "negative", "positiv", "negativ", "plus", "minus", "up", "down", "auf", "ab", "inc",
    "dec", "increasing", "decreasing",
}  # fmt: skip
"""Words that tell the sign of the motion, not which way came first."""
NEAR = 0.1
"""Actual positions differ from the targets by less than this share of the travel."""


def run_and_direction(name: str) -> tuple[int, int] | None:
    """Run and direction of a column such as `Run 1 +`, `↑2`, `Forward`; None where it is no such column.

    Returns:
        The run's number, or 0 where the name has none but tells a direction other than by + or -; and -1 or +1, or 0
        where the name (`Run 1`) does not tell the direction.
    """
    unit = bare_unit(name)
    bare = name[: -len(unit)] if unit else re.sub(r"[\[(][^\])]*[\])]\s*$", "", name) if bracketed(name) else name
    parts = re.findall(rf"\d+|[^\W\d_]+|[{re.escape(SIGNS)}]", bare.lower())
    numbers = [p for p in parts if p.isdigit()]
    words = [p for p in parts if p.isalpha()]
    # A hyphen between a word and the number is no sign.
    signs = [p for i, p in enumerate(parts) if p in SIGNS and (p in "+↑↓→←" or i in (0, len(parts) - 1))]
    told = [p for p in words if direction_meant(p) and p != "r"] or (["r"] if words == ["r"] else [])
    ways = {direction_meant(p) or 0 for p in signs or told}
    if len(numbers) > 1 or len(ways) > 1 or any(w not in FILLERS and not direction_meant(w) for w in words):
        return None
    if not numbers:
        return (0, ways.pop()) if any(len(p) > 1 or p in "↑↓→←" for p in signs or told) else None
    if not ways and not set(words) & (WORDS["run"] | {"messung", "measurement"}):
        return None
    return int(numbers[0]), ways.pop() if ways else 0


def cycles_of(table: ForeignTable, ask: Any) -> dict[str, Any]:
    """`[cycles]` of a protocol; empty where the table is none. Asks for directions that no name tells."""
    numbers = [n for n, v in table.columns.items() if v.dtype != np.object_]
    ways = {n: way for n in numbers if (way := run_and_direction(n))}
    if {n for _, n in ways.values()} == {-1} and all(re.match(r"(?i)r\W?\d", n) for n in ways):
        ways = {n: (run, 0) for n, (run, _) in ways.items()}
    place = next((n for n in numbers if n not in ways and _is_target(table, n)), None)
    ways = _there_and_back(table, ways, [n for n in numbers if n != place])
    if place is None or len(ways) < 2 or len(set(ways.values())) < len(ways) or any(has(n, "time") for n in numbers):
        return {}
    names = sorted(ways, key=lambda n: ways[n][0])
    told = {sign: [n for n in names if ways[n][1] == sign] for sign in (-1, 0, 1)}
    if told[0] and (told[1] or told[-1]):
        return {}
    if told[0]:
        text = f"How did the axis go through the targets in {', '.join(map(repr, names[:2]))} …?"
        answer = ask("runs", text, ("forward", "backward", "there and back"), None)
        told[1] = {"backward": [], "there and back": names[::2]}.get(answer or "", names)
        told[-1] = {"backward": names, "there and back": names[1::2]}.get(answer or "", [])
    at = table.columns[place].astype(np.float64)
    if at[0] > at[-1] and any(_tells_order(n) for n in names):
        first, usual = (told[1][0], "positive") if told[1] else (told[-1][0], "negative")
        text = f"The targets fall from row to row. In which direction did the axis go in {first!r}?"
        if ask("forward", text, ("positive", "negative"), None) not in {usual, None}:
            told[1], told[-1] = told[-1], told[1]
    off = np.stack([table.columns[n].astype(np.float64) - at for n in names])
    is_actual = np.nanmax(np.abs(off), initial=0.0) < NEAR * np.ptp(at)
    out = {"position": place, "forward": told[1], "backward": told[-1]}
    return out | ({"reading": "actual"} if is_actual else {})


def _tells_order(name: str) -> bool:
    """Whether a name says which way was the first, as `there` or `Forward`, and no sign: `+`, `up`, `positive`."""
    ways = [p for p in re.findall(rf"[^\W\d_]+|[{re.escape(SIGNS)}]", name.lower()) if direction_meant(p)]
    return bool(ways) and not any(p in SIGNS or p in SIGNED for p in ways)


def _there_and_back(
    table: ForeignTable, ways: dict[str, tuple[int, int]], numbers: Sequence[str]
) -> dict[str, tuple[int, int]]:
    """The columns of runs with a number; else the two of one run, of which one may be named as a mere reading."""
    numbered = {n: way for n, way in ways.items() if way[0]}
    if numbered:
        return numbered
    if [way for _, way in ways.values()] == [-1]:
        (back,) = ways
        readings = [n for n in numbers if n != back and (has(n, "deviation") or has(n, "actual"))]
        ways = ways | {n: (0, 1) for n in readings if table.units.get(n) == table.units.get(back)}
    return ways if sorted(way for _, way in ways.values()) == [-1, 1] else {}


def _is_target(table: ForeignTable, name: str) -> bool:
    """Whether a column has the targets in order."""
    unit = table.units.get(name) or bare_unit(name)
    steps = np.diff(table.columns[name].astype(np.float64))
    named = is_nominal(name) or axis_letter(name) or unit
    ordered = len(steps) > 0 and bool((steps > 0).all() or (steps < 0).all())
    return bool(named) and ordered and (not unit or UNITS[unit].kind == "length")


def from_cycles(
    table: ForeignTable, position: str, forward: Sequence[str], backward: Sequence[str], reading: str, source: str
) -> ForeignTable:
    """Turn a protocol into rows: of each run first the way forward, with rising targets, then the way back.

    Args:
        table: table of the protocol.
        position: column of the targets.
        forward, backward: columns of the runs, in order.
        reading: name of the column of the readings.
        source: name of the file, for messages.

    Returns:
        The other columns, repeated, then `run`, `direction` (-1 or +1) and the readings.

    Raises:
        MeasurementError: a column is missing or holds no numbers, or the runs differ in unit.
    """
    rising = np.argsort(table.numbers(position, source), kind="stable")
    ways = [
        (name, run + 1, sign)
        for run, pair in enumerate(zip_longest(forward, backward))
        for name, sign in zip(pair, (1, -1), strict=True)
        if name is not None
    ]
    units = {table.units.get(name, "") for name, _, _ in ways}
    if len(units) != 1:
        raise MeasurementError(
            f"{source}: [cycles] the runs are in {', '.join(sorted(units)) or 'no column'}; in one unit"
        )
    rows = np.concatenate([rising[::sign] for _, _, sign in ways])
    taken = {reading, "run", "direction"} | {name for name, _, _ in ways}
    columns: dict[str, Any] = {n: v[rows] for n, v in table.columns.items() if n not in taken}
    columns["run"] = np.repeat([float(run) for _, run, _ in ways], len(table))
    columns["direction"] = np.repeat([float(sign) for _, _, sign in ways], len(table))
    columns[reading] = np.concatenate([table.numbers(name, source)[rising[::sign]] for name, _, sign in ways])
    unit = units.pop()
    known = {n: u for n, u in table.units.items() if n in columns} | ({reading: unit} if unit else {})
    note = f"{len(ways)} ways through {len(table)} targets, in the order of ISO 230-2: each run forward, then back"
    return replace(table, columns=columns, units=known, lines=table.lines[rows], notes=(*table.notes, note), wrong={})
