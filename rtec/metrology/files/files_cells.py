"""One cell: a number, or what is wrong with it and what to do."""

import math
import re
from array import array
from collections.abc import Sequence

from rtec.metrology.files.faults import Faults
from rtec.metrology.files.toml import Leniency

NANS = ("nan", "NaN", "NAN", "-nan", "-NaN")
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
# Of these letters `float` makes what `NUMBER` allows, or nothing.
PLAIN_ROW = re.compile(r"[0-9eE.+-]*", re.ASCII)
INFINITE = re.compile(r"[+-]?inf(inity)?", re.IGNORECASE)


class Cells:
    """Turns cells into numbers and tells those that are none."""

    def __init__(self, leniency: Leniency, faults: Faults, where: str) -> None:
        self.decimal = leniency.decimal
        self.delimiter = leniency.delimiter
        self.empty = {"", *NANS, *(str(w) for w in leniency.missing_codes if isinstance(w, str))}
        self.faults = faults
        self.where = where

    def row(
        self,
        row: Sequence[str],
        line: int,
        width: int,
        places_of: Sequence[tuple[str, int]],
        values: dict[str, "array[float]"],
    ) -> bool:
        """Append one row to `values`; is it bad?"""
        if len(row) != width:
            for column in values.values():
                column.append(math.nan)
            self.faults.row("width", line, f"has {len(row)} cells, the header has {width}", self._width_way(row, width))
            return True
        if self.decimal == "." and PLAIN_ROW.fullmatch("".join(row)):
            try:
                found = [float(row[i]) for _, i in places_of]
            except ValueError:
                pass
            else:
                for (name, _), value in zip(places_of, found, strict=True):
                    values[name].append(value)
                return False
        bad = False
        for name, i in places_of:
            value, fault = self._number(row[i])
            values[name].append(value)
            if fault:
                bad = True
                kind, way = fault
                self.faults.row(f"{name} {kind}", line, f"{name}: {row[i]!r} {kind}", way)
        return bad

    def _number(self, cell: str) -> tuple[float, tuple[str, str] | None]:
        text = cell.strip()
        if text in self.empty:
            return math.nan, None
        # "1.234" among decimal commas may be a thousand or one and a bit: it is not read at all.
        dotted = text if self.decimal == "." else text.replace(".", "?").replace(",", ".")
        if NUMBER.fullmatch(dotted):
            return float(dotted), None
        if INFINITE.fullmatch(text):
            return math.inf, None
        return math.nan, self._wrong(text)

    def _wrong(self, text: str) -> tuple[str, str]:
        if self.decimal == "." and re.fullmatch(r"[+-]?\d*,\d+([eE][+-]?\d+)?", text):
            return (
                "has a decimal comma or a thousands separator",
                f'a decimal comma: {self.where} decimal = ","; a thousands separator: write numbers without',
            )
        if self.decimal == "," and NUMBER.fullmatch(text):
            return "has a decimal point where decimal = ',' was said", "make the table use one of the two"
        if re.fullmatch(r"[+-]?\d{1,3}([,.' \u00a0\u202f’]\d{3})+([.,]\d+)?", text):
            return "has thousands separators", "write numbers without, or convert with `rtec import` (thousands = …)"
        if re.fullmatch(r"\d{1,4}[-/.:]\d{1,2}[-/.:T ].*|\d{1,2}:\d{2}.*", text):
            return "is a date or time of day", "`rtec import` turns it into seconds (a map with [time] unit = …)"
        shown = text.replace('"', "'")
        return (
            "is no number",
            f'correct it, or if it stands for "no value": {self.where} missing_codes = ["{shown}"], '
            "or leave such rows out: drop_bad_rows = true",
        )

    def _width_way(self, row: Sequence[str], width: int) -> str:
        if self.delimiter == "," and len(row) > width:
            return 'decimal commas? write points, or divide cells by ";" and say so ' + (
                f'({self.where} delimiter = ";", decimal = ",")'
            )
        return f"complete it, or leave such rows out: {self.where} drop_bad_rows = true"
