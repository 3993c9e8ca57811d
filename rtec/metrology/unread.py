"""Columns of a file that nothing reads and that vary: above all the angle of a rotary axis, which no model has."""

import math
import re
from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np

from rtec.arrays import Floats
from rtec.wording import listed, significant

PER_UNIT: Final[Mapping[str, float]] = {
    "mrad": 1e-3, "rad": 1.0, "gon": math.pi / 200.0, "arcmin": math.pi / 10800.0, "arcsec": math.pi / 648000.0,
    "turn": 2.0 * math.pi, "turns": 2.0 * math.pi,
}  # fmt: skip
"""Radians in a unit that may end a column's name; else it is in degrees."""
UNIT: Final = re.compile(rf"(?:.*[\W_])?({'|'.join(PER_UNIT)}|deg|degrees?|°)[\])]?")
WORDS: Final = "angle|winkel|rotary|rotation|drehtisch|rundtisch|tisch|table|swivel|trunnion|phi|theta"
ROLES: Final = "axis|achse|pos|cmd|soll|ist|act|rot"
ROTARY: Final = re.compile(
    rf"(({ROLES})[ _-]?)?[abc]\d?([ _-]?({ROLES}))?|(axis|achse)[ _-]?[4-6]|[45]th[ _-](axis|achse)|({WORDS})([ _-].*)?"
)
WARM: Final = re.compile(r"t([ _-]|\d).*|.*temp.*")
FEWEST = 3
MOST_NAMED = 4


def is_rotary(name: str) -> bool:
    """Whether a column is an angle of a rotary axis by its name: `c_deg`, `C [°]`, `B axis`; not a temperature."""
    tidy = name.strip().lower()
    return (UNIT.fullmatch(tidy) or ROTARY.fullmatch(tidy)) is not None and WARM.fullmatch(tidy) is None


def radians(name: str, values: Floats) -> Floats:
    """An angle in radians, by the unit in its name; without one it is in degrees."""
    found = UNIT.fullmatch(name.strip().lower())
    return values * PER_UNIT.get(found.group(1) if found else "", math.pi / 180.0)


def varies(name: str, values: Floats) -> bool:
    """Whether a column varies, (n,). One that only rises or falls, as a time does, counts if it is an angle."""
    known = values[np.isfinite(values)]
    if len(known) < FEWEST or known.min() == known.max():
        return False
    up, down = known[1:] > known[:-1], known[1:] < known[:-1]
    return is_rotary(name) or not (up.all() or down.all())


def not_read(columns: Mapping[str, Floats]) -> str:
    """A sentence on columns that vary and that nothing reads, with their ranges; empty where there are none."""
    if not columns:
        return ""
    named = sorted(columns, key=lambda n: not is_rotary(n))
    parts = [ranged(n, columns[n]) for n in named[:MOST_NAMED]]
    parts += [f"{len(named) - MOST_NAMED} more"] if len(named) > MOST_NAMED else []
    vary, on = ("varies", "it") if len(named) == 1 else ("vary", "them")
    why = "rtec has no rotary axes, so " if is_rotary(named[0]) else ""
    looks = f"a dependence of the readings on {on} will look like something else"
    return f"Not read: {listed(parts)}, which {vary}; {why}{looks}."


def ranged(name: str, values: Floats) -> str:
    """A column and its range: `c_deg (0 to 350)`."""
    low, high = (f"{float(significant(float(v), 4)):.10g}" for v in (np.nanmin(values), np.nanmax(values)))
    return f"{name} ({low} to {high})"


def joined(parts: Iterable[Mapping[str, Floats]]) -> dict[str, Floats]:
    """The columns of several files, by name."""
    out: dict[str, list[Floats]] = {}
    for part in parts:
        for name, values in part.items():
            out.setdefault(name, []).append(values)
    return {name: np.concatenate(values) for name, values in out.items()}
