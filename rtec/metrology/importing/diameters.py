"""Columns of a lathe in diameter: halved, because positions of the machine and readings are radii."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from rtec.metrology.importing.roles import Asks, ColumnRoles
from rtec.metrology.importing.words import axis_letter, in_diameter
from rtec.metrology.travel import RADIAL, half_fits
from rtec.metrology.units import convert

SIZES: Final = ("ball_bar", "work_piece")
"""Instruments whose reading is a length of its own: a work piece's diameter counts twice there."""


def halve_diameters(roles: ColumnRoles, head: Mapping[str, Any], given: Mapping[str, Any], ask: Asks) -> None:
    """Halve positions and readings that are diameters by their names, as far as the user agrees.

    Where the position along a direction and the reading in it differ in that, which of them is a diameter is asked.

    Args:
        roles: its columns are changed.
        head: `[measurement]`.
        given: columns of the user's own map, which are not changed.
        ask: asks the user.
    """
    columns = {n: c for n, c in roles.columns.items() if "from" in c and n not in given}
    readings = {n: _along(n, c, head) for n, c in columns.items() if n.startswith("reading") and n.endswith("_um")}
    if head.get("instrument") in SIZES:
        readings = {}
    marked = {n for n, c in columns.items() if in_diameter(c["from"]) or in_diameter(c.get("minus", ""))}
    pairs = [(place, n) for n, place in readings.items() if place in columns]
    mixed = [pair for pair in pairs if len(marked & set(pair)) == 1]
    concerned = marked.union(*mixed)
    unmarked = () if concerned or "x_mm" not in columns else _unmarked(roles, readings)
    concerned = concerned.union(unmarked)
    kinds = {
        "position": [n for n in columns if n in concerned and n.endswith("_mm")],
        "error": [n for n in readings if n in concerned],
    }
    choices = [kind for kind, names in kinds.items() if names]
    if not choices:
        roles.settled["diameter"] = "none"
        return
    choices = ["both", *choices] if len(choices) == 2 else choices
    names = [[repr(columns[n]["from"]) for n in columns if n in of] for of in (marked, concerned - marked)]
    text = "By name a diameter: " + "; not by name: ".join(" and ".join(n) for n in names if n)
    text += ". Which of position and error is halved to a radius?"
    default = None if mixed else choices[0]
    if unmarked:
        fits = _half_fits(roles)
        text = f"X of a lathe may be a diameter; {' and '.join(names[1])} {'do' if names[1][1:] else 'does'} not tell"
        text += ": half of it is within the travel, all of it is not" if fits else ""
        text += ". Which of position and error is halved to a radius?"
        default = None if fits else "none"
    answer = ask("diameter", text, (*choices, "none"), default)
    halved = {"both": [*kinds["position"], *kinds["error"]], **kinds}.get(answer or "none", [])
    for name in halved:
        column = roles.columns[name]
        column["scale"] = 0.5 * column.get("scale", 1.0)
        target, reason = roles.use[column["from"]]
        roles.use[column["from"]] = (target, f"{reason}; a diameter, halved")


def _unmarked(roles: ColumnRoles, readings: Mapping[str, str]) -> tuple[str, ...]:
    """On a lathe: the positions of X and readings along it, whose names do not tell whether they are diameters."""
    if roles.machine is None or not roles.machine.turns_work:
        return ()
    return ("x_mm", *(n for n, place in readings.items() if place in ("x_mm", "_mm")))


def _half_fits(roles: ColumnRoles) -> bool:
    """Whether half of X is within its travel, and X is not."""
    column, machine = roles.columns["x_mm"], roles.machine
    axis = next((a for a in machine.axes if a.name == RADIAL), None) if machine is not None else None
    values = roles.table.columns[column["from"]]
    if axis is None or values.dtype == np.object_ or not np.isfinite(values.astype(np.float64)).any():
        return False
    at = convert(values.astype(np.float64), column.get("unit") or "mm", "mm")
    return half_fits(axis, (float(np.nanmin(at)), float(np.nanmax(at))))


def _along(name: str, column: Mapping[str, Any], head: Mapping[str, Any]) -> str:
    """The position along the direction in which a reading is taken, as a column; empty where it is not known."""
    letter = axis_letter(column["from"]) if name == "reading_um" else name[8].upper()
    if not letter and head.get("instrument") in ("laser_linear", None):
        letter = head.get("axis") or ""
    return f"{letter.lower()}_mm"
