"""Rows of a foreign table: selects them by a condition, and builds them from an event log."""

import ast
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rtec.arrays import Bools, Floats, Ints
from rtec.errors import MeasurementError
from rtec.metrology.readers.base import ForeignTable, Texts, number_or_none
from rtec.metrology.units import logged

MAX_CONDITION = 2000
QUOTED = re.compile(r"`([^`]*)`")
COMPARE: dict[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: lambda a, b: a == b,
    ast.NotEq: lambda a, b: a != b,
    ast.Lt: lambda a, b: a < b,
    ast.LtE: lambda a, b: a <= b,
    ast.Gt: lambda a, b: a > b,
    ast.GtE: lambda a, b: a >= b,
}
ALLOWED = "columns, numbers and quoted words with == != < <= > >=, joined by and, or, not"


@dataclass(frozen=True)
class Condition:
    """A condition on rows: its text and its tree; `odd` has the columns in backquotes by their substitute names."""

    text: str
    tree: ast.expr
    odd: dict[str, str]

    def holds(self, table: ForeignTable, source: str) -> Bools:
        """Whether it holds in each row, (n,); a missing value fulfils no comparison but `!=`.

        Raises:
            MeasurementError: a column is missing, or numbers are compared with words.
        """
        return self._of(self.tree, table, source)

    def _of(self, node: ast.expr, table: ForeignTable, source: str) -> Bools:
        if isinstance(node, ast.BoolOp):
            parts = np.array([self._of(v, table, source) for v in node.values])
            merge = np.logical_and if isinstance(node.op, ast.And) else np.logical_or
            return np.asarray(merge.reduce(parts), dtype=np.bool_)
        if isinstance(node, ast.UnaryOp):
            return ~self._of(node.operand, table, source)
        assert isinstance(node, ast.Compare)  # noqa: S101 (`condition` lets nothing else through)
        sides = [self._side(n, table, source) for n in (node.left, *node.comparators)]
        held = np.ones(len(table), dtype=np.bool_)
        for op, a, b in zip(node.ops, sides, sides[1:], strict=False):
            held &= self._compared(op, a, b, len(table), source)
        return held

    def _side(self, node: ast.expr, table: ForeignTable, source: str) -> Floats | Texts | float | str:
        if isinstance(node, ast.Name):
            return table.column(self.odd.get(node.id, node.id), f"{source}: [rows] where")
        value = ast.literal_eval(node)
        return value if isinstance(value, str) else float(value)

    def _compared(self, op: ast.cmpop, a: Any, b: Any, n: int, source: str) -> Bools:
        words = [isinstance(x, str) or getattr(x, "dtype", None) == np.object_ for x in (a, b)]
        if words[0] != words[1]:
            raise MeasurementError(f"{source}: [rows] where = {self.text!r} compares numbers with words")
        if words[0] and not isinstance(op, ast.Eq | ast.NotEq):
            raise MeasurementError(f"{source}: [rows] where = {self.text!r}: words are compared by == and != only")
        out: Bools = np.broadcast_to(np.asarray(COMPARE[type(op)](a, b), dtype=np.bool_), (n,))
        return out


def condition(text: str) -> Condition:
    """Read a condition; names of columns that are no plain words need backquotes: `` `Soll [mm]` > 5 ``.

    Raises:
        ValueError: the text is no condition.
    """
    if len(text) > MAX_CONDITION:
        raise ValueError(f"a condition has at most {MAX_CONDITION} characters")
    odd: dict[str, str] = {}

    def plain(found: re.Match[str]) -> str:
        odd[name := f"column_{len(odd)}_"] = found.group(1)
        return name

    try:
        tree = ast.parse(QUOTED.sub(plain, text), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as e:
        hint = "; equality is ==" if re.search(r"[^=!<>]=[^=]", text) else ""
        raise ValueError(f"{text!r} is no condition{hint}; allowed: {ALLOWED}") from e
    if not _is_condition(tree, 0):
        raise ValueError(f"{text!r} is no condition; allowed: {ALLOWED}")
    return Condition(text, tree, odd)


def _is_condition(node: ast.expr, depth: int) -> bool:
    if depth > 50:
        return False
    if isinstance(node, ast.BoolOp):
        return all(_is_condition(v, depth + 1) for v in node.values)
    if isinstance(node, ast.UnaryOp):
        return isinstance(node.op, ast.Not) and _is_condition(node.operand, depth + 1)
    return (
        isinstance(node, ast.Compare)
        and all(type(op) in COMPARE for op in node.ops)
        and all(map(_is_side, (node.left, *node.comparators)))
    )


def _is_side(node: ast.expr) -> bool:
    if isinstance(node, ast.UnaryOp):
        return (
            isinstance(node.op, ast.USub | ast.UAdd)
            and isinstance(node.operand, ast.Constant)
            and _is_side(node.operand)
        )
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float | str) and not isinstance(node.value, bool)
    return isinstance(node, ast.Name)


def from_events(table: ForeignTable, channel: str, value: str, unit: str | None, source: str) -> ForeignTable:
    """Turn an event log into a table: one column a channel; events with the same other cells become one row.

    Args:
        table: table of the log.
        channel, value, unit: its columns; `unit` may be None.
        source: name of the file, for messages.

    Returns:
        The other columns, then the channels in order of appearance; what an instant did not log is NaN or "".

    Raises:
        MeasurementError: a column is missing, a channel has the name of another column, or a channel has two units or
            an unknown one.
    """
    names = [_word(c) for c in table.column(channel, source)]
    values = table.column(value, source)
    units = None if unit is None else _units(table, names, unit, source)
    keys = [n for n in table.columns if n not in (channel, value, unit)]
    rows, starts = _instants(names, [table.columns[k] for k in keys])
    columns: dict[str, Floats | Texts] = {k: table.columns[k][starts] for k in keys}
    out_units = {k: u for k, u in table.units.items() if k in keys}
    at_all = np.array(names, dtype=np.object_)
    for name in dict.fromkeys(names):
        if not name or name in keys:
            what = "an event has no channel" if not name else f"channel {name!r} is called like another column"
            raise MeasurementError(f"{source}: line {table.lines[names.index(name)]}: {what}")
        at = np.flatnonzero(at_all == name)
        columns[name] = _channel(values[at], rows[at], len(starts), table.decimal)
        if units is not None:
            known = {units[i] for i in at} - {""}
            if len(known) > 1:
                raise MeasurementError(f"{source}: channel {name!r} has the units {', '.join(sorted(known))}")
            out_units |= dict.fromkeys([name], next(iter(known))) if known else {}
    notes = (*table.notes, f"{len(names)} events of {len(dict.fromkeys(names))} channels in {len(starts)} rows")
    return replace(table, columns=columns, units=out_units, lines=table.lines[starts], notes=notes, wrong={})


def _units(table: ForeignTable, channels: Sequence[str], unit: str, source: str) -> list[str]:
    """Unit of each event, as `logged` names it."""
    words = [_word(u) for u in table.column(unit, source)]
    known: dict[str, str] = {}
    faults = []
    for word in dict.fromkeys(words):
        at = words.index(word)
        try:
            known[word] = logged(word)
        except ValueError as e:
            faults.append(f"{source}: line {table.lines[at]}: channel {channels[at]!r}: {e}")
    if faults:
        raise MeasurementError("\n".join([*faults, f"correct {unit!r} in the file; - is a number without a unit"]))
    return [known[word] for word in words]


def _word(cell: Any) -> str:
    return f"{cell:g}" if isinstance(cell, float) else str(cell).strip()


def _instants(names: Sequence[str], keys: Sequence[Floats | Texts]) -> tuple[Ints, Ints]:
    """Row of each event, and the first event of each row; a repeated channel begins another row."""
    n = len(names)
    new = np.ones(n, dtype=np.bool_)
    new[1:] = np.logical_or.reduce([k[1:] != k[:-1] for k in keys]) if keys else False
    seen: set[str] = set()
    for i in range(n):
        if new[i] or names[i] in seen:
            new[i], seen = True, set()
        seen.add(names[i])
    return np.cumsum(new, dtype=np.int64) - 1, np.flatnonzero(new).astype(np.int64)


def _channel(values: Floats | Texts, rows: Ints, n: int, decimal: str) -> Floats | Texts:
    """Values of one channel at its rows, as numbers if all of them are."""
    numbers = [float(v) if isinstance(v, float) else number_or_none(str(v), decimal) for v in values]
    if all(v is not None for v in numbers):
        out: Floats = np.full(n, np.nan)
        out[rows] = numbers
        return out
    texts: Texts = np.full(n, "", dtype=np.object_)
    texts[rows] = [str(v) for v in values]
    return texts
