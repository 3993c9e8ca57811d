"""Columns of a lathe in diameter: halved, because positions of the machine and readings are radii."""

from collections.abc import Mapping
from typing import Any, Final

from rtec.metrology.importing.roles import Asks, ColumnRoles
from rtec.metrology.importing.words import axis_letter, in_diameter

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
    answer = ask("diameter", text, (*choices, "none"), None if mixed else choices[0])
    halved = {"both": [*kinds["position"], *kinds["error"]], **kinds}.get(answer or "none", [])
    for name in halved:
        column = roles.columns[name]
        column["scale"] = 0.5 * column.get("scale", 1.0)
        target, reason = roles.use[column["from"]]
        roles.use[column["from"]] = (target, f"{reason}; a diameter, halved")


def _along(name: str, column: Mapping[str, Any], head: Mapping[str, Any]) -> str:
    """The position along the direction in which a reading is taken, as a column; empty where it is not known."""
    letter = axis_letter(column["from"]) if name == "reading_um" else name[8].upper()
    if not letter and head.get("instrument") in ("laser_linear", None):
        letter = head.get("axis") or ""
    return f"{letter.lower()}_mm"
