"""The layout of an unknown text table: encoding, lines before it, delimiter or fixed widths, header, decimal sign.

Every conclusion is from the text itself and has its reason; nothing is converted here. Ambiguities are reported, so
that the user can be asked.
"""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rtec.errors import MeasurementError
from rtec.metrology.files.table import LONGEST_LINE, MARKS
from rtec.metrology.readers.base import MINUS, SourceOptions, with_unit
from rtec.metrology.readers.delimited import DELIMITERS, NANS, split, unit_named
from rtec.text import clean
from rtec.tomlfile import validated

SAMPLE_BYTES = 4 << 20
"""Number of bytes of a long file that are examined."""
SAMPLE_LINES = 2000
COMMENTS = ("#", "//", "%", "!")
NUMBER = re.compile(r"[+-]?(\d+[.,]?\d*|[.,]\d+)([eE][+-]?\d+)?", re.ASCII)
GROUPED = re.compile(r"[+-]?\d{1,3}([.,' \u00a0\u202f]\d{3})+([.,]\d+)?", re.ASCII)
CLOCK = r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[AaPp][Mm])?"
DATE = r"\d{1,4}[-/.]([A-Za-z]{3}|\d{1,2})[-/.]\d{1,4}"
MOMENT = re.compile(rf"{CLOCK}|{DATE}([ T_,-]+{CLOCK} ?(Z|UTC|[+-]\d\d:?\d\d)?)?", re.ASCII)
NO_VALUE = {
    "-",
    "--",
    "---",
    "n/a",
    "na",
    "#n/a",
    "null",
    "none",
    "ol",
    "err",
    "error",
    "inf",
    "-inf",
    *map(str.lower, NANS),
}
BY_THREE = re.compile(r"[+-]?[1-9]\d{0,2}([.,]\d{3})+", re.ASCII)
NEAR = 0.1
"""The largest number without a mark is at least this share of the smallest one with a mark in a column of thousands."""
WHOLE = 3
"""Different whole numbers, and numbers with a mark before three digits, that show a column of thousands."""
DELIMITER_WORDS = {";": "semicolons", ",": "commas", "\t": "tabs", "|": "bars", " ": "blanks"}


@dataclass(frozen=True)
class Guess:
    """One conclusion.

    Attributes:
        key: place in a map, such as "source.decimal" or "column.x_mm".
        value: the proposed value.
        reason: in words, for people.
    """

    key: str
    value: Any
    reason: str


@dataclass(frozen=True)
class TextLayout:
    """The layout of a text.

    Attributes:
        source: options that read it.
        guesses: conclusions, with reasons.
        doubts: ambiguities: key, the other possible values, and why.
        text: the sample.
        cut: whether the file is longer than the sample.
    """

    source: SourceOptions
    guesses: tuple[Guess, ...]
    doubts: tuple[Guess, ...]
    text: str
    cut: bool


def layout(path: Path, preset: Mapping[str, Any]) -> TextLayout:
    """Detect the layout of a text table.

    Args:
        path: path of the text.
        preset: known keys of `[source]`, which are not changed.

    Raises:
        MeasurementError: the file cannot be read, is no text, or no table with at least one number a row.
    """
    text, encoding, cut = _sample(path, preset.get("encoding"))
    out: dict[str, Any] = {}
    guesses = [] if encoding is None else [encoding]
    if encoding is not None:
        out["encoding"] = encoding.value
    lines = text.split("\n")
    comment = _comment(lines, preset)
    known = out | dict(preset) | ({"comment": comment.value} if comment else {})
    guesses += [comment] if comment else []
    rows = _numbered(lines, known)
    if not rows:
        raise MeasurementError(f"{path}: no lines" + (" beside comments" if comment else ""))
    known, shape = _shape(path, rows, known)
    body = _Body(rows, known)
    if body.first is None:
        raise MeasurementError(f"{path}: no row with a number or a time in it; is this a table of readings?")
    head, names = _header(lines, rows, body, known)
    doubts: list[Guess] = []
    known |= names
    for guess in (*shape, *head, *_numbers(body, known, doubts)):
        if guess.key.removeprefix("source.") not in preset:
            guesses.append(guess)
    concluded = {g.key.removeprefix("source."): g.value for g in guesses if g.value is not None}
    everything = {**known, **concluded, **preset, "reader": "delimited"}
    source = validated(SourceOptions, everything, f"{path}: [source]", MeasurementError)
    return TextLayout(source, tuple(guesses), tuple(doubts), text, cut)


def _sample(path: Path, declared: str | None) -> tuple[str, Guess | None, bool]:
    """The first lines as text, a guess of the encoding, and whether the file is longer."""
    try:
        with path.open("rb") as file:
            data = file.read(SAMPLE_BYTES + 1)
    except FileNotFoundError as e:
        raise MeasurementError(f"{path}: no such file") from e
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be read: {e.strerror}") from e
    cut = len(data) > SAMPLE_BYTES
    name, guess = (declared, None) if declared else _encoding(path, data[:SAMPLE_BYTES])
    decoder = codecs.getincrementaldecoder(name)(errors="strict")
    try:
        text = decoder.decode(data[:SAMPLE_BYTES], final=not cut)
    except UnicodeDecodeError as e:
        raise MeasurementError(
            f"{path}: byte {e.start} is no {name} text; is this a text table? (spreadsheets: save as CSV)"
        ) from e
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace(*MINUS)
    if any(ord(c) < 32 and c not in "\t\n\f\v\x1a" for c in text[:65536]):
        raise MeasurementError(f"{path}: has control characters; is this a text table? (spreadsheets: save as CSV)")
    longest = max(map(len, text.split("\n")))
    if longest > LONGEST_LINE:
        raise MeasurementError(f"{path}: a line is longer than {LONGEST_LINE} characters; is this a table?")
    return (text[: text.rfind("\n")] if cut else text), guess, cut


def _encoding(path: Path, data: bytes) -> tuple[str, Guess | None]:
    """Python's name of the encoding, and a guess where the text does not prove it."""
    for mark, name in MARKS:
        if data.startswith(mark):
            return name, None
    if b"\0" in data[:4096]:
        even, odd = data[:4096:2].count(0), data[1:4096:2].count(0)
        if max(even, odd) < len(data[:4096]) // 8:
            raise MeasurementError(f"{path}: holds zero bytes; is this a text table? (spreadsheets: save as CSV)")
        name = "utf-16-le" if odd >= even else "utf-16-be"
        return name, Guess("source.encoding", name, "every other byte is zero")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(data, final=False)
    except UnicodeDecodeError as e:
        try:
            data.decode("cp1252")
            name = "cp1252"
        except UnicodeDecodeError:
            name = "latin-1"
        start = data.rfind(b"\n", 0, e.start) + 1
        shown = clean(data[start : e.start + 12].split(b"\n")[0].decode(name)[-24:].strip())
        line = data[: e.start].count(b"\n") + 1
        return name, Guess("source.encoding", name, f"line {line} is no UTF-8; in {name} it reads {shown!r}")
    return "utf-8", None


def _comment(lines: Sequence[str], preset: Mapping[str, Any]) -> Guess | None:
    if "comment" in preset:
        return None
    for mark in COMMENTS:
        marked = [i + 1 for i, line in enumerate(lines) if line.startswith(mark)]
        if marked and sum(1 for line in lines if line.strip() and not line.startswith(mark)) > 1:
            which = f"line {marked[0]}" if len(marked) == 1 else f"{len(marked)} lines, the first line {marked[0]},"
            return Guess("source.comment", mark, f"{which} begin{'s' if len(marked) == 1 else ''} with it")
    return None


Rows = list[tuple[int, str]]


def _numbered(lines: Sequence[str], known: Mapping[str, Any]) -> Rows:
    mark, skip = known.get("comment"), int(known.get("skip_rows") or 0)
    rows = [(i, line) for i, line in enumerate(lines) if i >= skip and line.strip()]
    return [(i, line) for i, line in rows if not (mark and line.startswith(mark))][:SAMPLE_LINES]


def kind_of(cell: str) -> str:
    """Kind of a cell: "number", "time", "" for no value, or "text"."""
    if not cell or cell.lower() in NO_VALUE:
        return ""
    plain = bare(cell)
    if NUMBER.fullmatch(plain) or GROUPED.fullmatch(plain):
        return "number"
    return "time" if MOMENT.fullmatch(cell) else "text"


def bare(cell: str) -> str:
    """The cell without a unit behind its number."""
    found = with_unit(cell)
    return cell if found is None else found[0]


def _cut_into(rows: Rows, options: Mapping[str, Any]) -> list[list[str]]:
    source = SourceOptions.model_construct(**options)
    out = []
    for _, line in rows:
        try:
            out.append(split(line, source))
        except csv.Error:
            out.append([])
    return out


def _score(rows: Rows, options: Mapping[str, Any]) -> float:
    """Share of lines with the same number of cells, times the share of numbers and times in them; 0 for one column."""
    cells = _cut_into(rows, options)
    width, often = Counter(map(len, cells)).most_common(1)[0]
    if width < 2:
        return 0.0
    kinds = Counter(kind_of(c) for row in cells if len(row) == width for c in row)
    plain = kinds["number"] + kinds["time"] + 0.5 * kinds[""]
    return often / len(rows) * plain / max(kinds.total(), 1)


def _shape(path: Path, rows: Rows, known: dict[str, Any]) -> tuple[dict[str, Any], list[Guess]]:
    """Options that divide a line into cells, and guesses."""
    if known.get("delimiter") or known.get("widths"):
        return known, []
    # The head of a file is often not part of the table: the end of the file decides.
    body = rows[_after_head(rows) :]
    ways: list[dict[str, Any]] = [{"delimiter": d} for d in ("\t", ";", "|", ",", " ")]
    fixed = _places(body)
    ways += [{"widths": fixed}] if fixed else []
    scores = [_score(body, w) for w in ways]
    best = max(range(len(ways)), key=lambda i: (round(scores[i], 6), -i))
    if scores[best] == 0.0:
        return known | {"delimiter": ","}, []
    way = ways[best]
    if fixed and "widths" not in way and way["delimiter"] == " " and _widths_vary(body):
        way = ways[-1]
    if way.get("delimiter") == "," and _commas_twice(rows, body):
        raise MeasurementError(
            f"{path}: line {body[0][0] + 1}: commas divide cells and decimals alike: {clean(body[0][1])[:60]!r}; "
            "export it with semicolons or tabs, or with decimal points"
        )
    return known | way, [_shape_guess(way, body)]


def _after_head(rows: Rows) -> int:
    """A row after which the file certainly consists of its table."""
    return len(rows) // 3 if len(rows) > 3 else min(1, len(rows) - 1)


def _widths_vary(body: Rows) -> bool:
    return len({len(line.split()) for _, line in body}) > 1


def _shape_guess(way: Mapping[str, Any], body: Rows) -> Guess:
    if "widths" in way:
        return Guess("source.widths", way["widths"], "the same places are blank in every line")
    mark = way["delimiter"]
    n = len(_cut_into(body[-1:], way)[0])
    return Guess("source.delimiter", mark, f"{DELIMITER_WORDS[mark]} divide the lines into {n} cells")


def _commas_twice(rows: Rows, body: Rows) -> bool:
    """Whether rows have twice as many commas as the header has names (`x,y` over `1,5,2,5`)."""
    cells = _cut_into(body, {"delimiter": ","})
    head = next((c for c in _cut_into(rows, {"delimiter": ","}) if all(kind_of(x) == "text" for x in c)), None)
    return head is not None and len(head) > 1 and all(len(c) == 2 * len(head) for c in cells)


def _places(body: Rows) -> list[int]:
    """Widths of columns that end where every line changes from a character to a blank; empty for less than two."""
    length = max(len(line) for _, line in body)
    ink = [False] * length
    for _, line in body:
        if "\t" in line:
            return []
        for i, c in enumerate(line):
            ink[i] = ink[i] or c != " "
    ends = [i + 1 for i in range(length) if ink[i] and (i + 1 == length or not ink[i + 1])]
    if len(ends) < 2:
        return []
    return [b - a for a, b in zip([0, *ends], ends, strict=False)]


class _Body:
    """The rows of the table itself, and the kind of each column."""

    def __init__(self, rows: Rows, known: Mapping[str, Any]) -> None:
        self.rows = rows
        self.cells = _cut_into(rows, known)
        sure = self.cells[_after_head(rows) :]
        self.width = Counter(map(len, sure)).most_common(1)[0][0]
        whole = [c for c in sure if len(c) == self.width]
        self.kinds = [self._column(k, whole) for k in range(self.width)]
        self.plain = [2 * sum(with_unit(row[k]) is not None for row in whole) < len(whole) for k in range(self.width)]
        self.first = next((i for i, c in enumerate(self.cells) if self._fits(c)), None)

    def _column(self, k: int, rows: Sequence[Sequence[str]]) -> str:
        kinds = Counter(kind_of(row[k]) for row in rows)
        filled = kinds.total() - kinds[""]
        best = max(("number", "time", "text"), key=lambda w: kinds[w])
        return best if filled and kinds[best] >= 0.6 * filled else "text" if filled else ""

    def _fits(self, cells: Sequence[str]) -> bool:
        """Whether this is a row of the table: it has a number or time in a column of that kind."""
        if len(cells) != self.width:
            return False
        if any(plain and with_unit(c) is not None for c, plain in zip(cells, self.plain, strict=True)):
            return False  # names of columns such as 50 mm
        pairs = [(kind_of(c), k) for c, k in zip(cells, self.kinds, strict=True) if k in ("number", "time")]
        return any(c == k for c, k in pairs) and all(c in (k, "") for c, k in pairs)

    def of(self, kind: str) -> list[list[str]]:
        """Cells of each column of a kind, from the first row on."""
        rows = [c for c in self.cells[self.first or 0 :] if len(c) == self.width]
        return [[row[k] for row in rows] for k in range(self.width) if self.kinds[k] == kind]


def _header(
    lines: Sequence[str], rows: Rows, body: _Body, known: Mapping[str, Any]
) -> tuple[list[Guess], dict[str, Any]]:
    """The line of names above the first row, if any, and its keys in `[source]`."""
    first = body.first or 0
    line = rows[first][0]
    if known.get("names") or known.get("header") is False:
        return [_before(line)] if first else [], {}
    above = [i for i in (first - 1, first - 2) if i >= 0]
    units = bool(above) and _units(body.cells[above[0]]) and len(above) > 1
    at = above[1] if units else above[0] if above else None
    unit_row = {"unit_row": True} if units else {}
    more = [Guess("source.unit_row", True, f"line {rows[above[0]][0] + 1} holds units only")] if units else []
    if (
        at is not None
        and len(body.cells[at]) == body.width
        and len(set(filter(None, body.cells[at]))) == len([c for c in body.cells[at] if c])
    ):
        skip = rows[at][0]
        why = f"line {skip + 1} is taken for the header: no numbers where the rows below have them"
        begin = (
            [Guess("source.skip_rows", skip, f"{skip} lines before it are not read")]
            if at > 0 and _skips(rows, skip)
            else []
        )
        return [Guess("source.header", None, why), *begin, *more], unit_row
    number, names = _names_over(lines, rows, at, line, body, known)
    if not names and at:
        number, names = rows[at][0] + 1, _grouped(body.cells[at - 1], body.cells[at], body.width)
    over = [_before(line)] if line else []
    if names:
        why = f"line {number} is taken for the header: its words are over the columns"
        return [Guess("source.names", names, why), *over], {"header": False, "names": names, "skip_rows": line}
    why = f"line {line + 1} has numbers as the rows below it: it is taken for a row, not for a header"
    if at is not None:
        why = f"line {rows[at][0] + 1} over the rows does not have a name for each of {body.width} cells"
    return [Guess("source.header", False, f"{why}; the columns are c1, c2, …"), *over], {"header": False}


def _before(line: int) -> Guess:
    return Guess("source.skip_rows", line, f"the first {line} lines are not read as rows")


def _skips(rows: Rows, skip: int) -> bool:
    return rows[0][0] < skip


def _units(cells: Sequence[str]) -> bool:
    words = [c.strip("[]() ") for c in cells]
    known = [w for w in words if w and unit_named(w)]
    # Columns without a unit (date, remark) are empty in such a line: two units and nothing else are enough.
    enough = len(known) >= min(2, len(words) / 2)
    return enough and all(not w or unit_named(w) or w == "-" for w in words)


def _names_over(
    lines: Sequence[str], rows: Rows, at: int | None, first: int, body: _Body, known: Mapping[str, Any]
) -> tuple[int, list[str]]:
    """Line number and names from a line with another layout: a comment, or words above fixed-width columns."""
    mark = known.get("comment")
    places = [i for i in range(first - 1, max(first - 4, -1), -1) if lines[i].strip()]
    units: list[str] = []
    for i in places:
        text = lines[i].removeprefix(mark) if mark and lines[i].startswith(mark) else lines[i]
        if not units and len(text.split()) == body.width and _units(text.split()):
            units = [w.strip("[]() ") for w in text.split()]
            continue
        if at is not None and not units and i != rows[at][0] and not (mark and lines[i].startswith(mark)):
            continue
        for cells in [*_other_cuts(text, known), _over(lines[i], mark, known)]:
            clear = all(kind_of(c) == "text" for c in cells) and len(set(cells)) == len(cells)
            if len(cells) == body.width and clear:
                return i + 1, [f"{n} [{u}]" if u else n for n, u in zip(cells, units or [""] * len(cells), strict=True)]
    return 0, []


def _grouped(groups: Sequence[str], cells: Sequence[str], width: int) -> list[str]:
    """Names in groups (`1, 2, 1, 2` under `Forward, , Reverse, `); empty where the lines are no such two."""
    if len(cells) != width or not 2 <= len(groups) <= width or len(list(filter(None, groups))) < 2:
        return []
    group, names = "", []
    for above, name in zip([*groups, *[""] * (width - len(groups))], cells, strict=True):
        group = above or group
        bare = re.sub(r"\s*[\[(][^\])]*[\])]$", "", group)
        names.append(f"{bare} {name}{group.removeprefix(bare)}".strip())
    clear = all(map(bool, names)) and len(set(names)) == width and not any(kind_of(g) == "number" for g in groups)
    return names if clear else []


def _other_cuts(text: str, known: Mapping[str, Any]) -> list[list[str]]:
    delimiter = known.get("delimiter")
    cuts = [[c.strip() for c in text.split(d)] for d in (delimiter, *DELIMITERS) if d and d != " " and d in text]
    return [*cuts, re.split(r"\s{2,}|\t", text.strip()), text.split()]


def _over(line: str, mark: str | None, known: Mapping[str, Any]) -> list[str]:
    """The words of a line, assigned to the fixed-width columns with the largest overlap."""
    widths = known.get("widths")
    if not widths:
        return []
    text = line.replace(mark, " " * len(mark), 1) if mark and line.startswith(mark) else line
    spans, at = [], 0
    for w in widths:
        spans.append((at, at + w))
        at += w
    names = [""] * len(spans)
    for word in re.finditer(r"\S+(?: \S+)*", text):
        shared = [min(word.end(), b) - max(word.start(), a) for a, b in spans]
        k = max(range(len(spans)), key=lambda i: shared[i])
        names[k] = f"{names[k]} {word.group()}".strip()
    return names


def _numbers(body: _Body, known: Mapping[str, Any], doubts: list[Guess]) -> list[Guess]:
    """Decimal sign, thousands, and words for "no value"."""
    columns = [[bare(c) for c in column] for column in body.of("number")]
    numbers = [c for column in columns for c in column if kind_of(c) == "number"]
    decimal, thousands, why = _thousands(columns) or _signs(numbers, doubts)
    out = []
    if decimal == ",":
        out.append(Guess("source.decimal", ",", why))
    if thousands:
        out.append(Guess("source.thousands", thousands, why))
    odd = Counter(c for column in columns for c in column if c and c not in NANS and kind_of(c) in ("", "text"))
    words = [w for w, _ in odd.most_common(8) if not any(ch.isdigit() for ch in w)]
    if words and not known.get("missing"):
        counts = ", ".join(f"{clean(w)!r} {odd[w]} times" for w in words)
        out.append(Guess("source.missing", words, f"no numbers among numbers: {counts}"))
    return out


def _thousands(columns: Sequence[Sequence[str]]) -> tuple[str, str, str] | None:
    """Signs of a table of whole numbers, of which those from 1000 on have a mark, as in 900; 1,050.

    Decimals that end after three digits in some cells and are whole in the others of their column do not occur. Whole
    numbers of the size of the marked ones must be there: 1,250 among 1 to 7 may be anything.
    """
    for mark, decimal in ((",", "."), (".", ",")):
        marked = [c for cells in columns for c in cells if mark in c]
        if (
            not marked
            or not all(BY_THREE.fullmatch(c) for c in marked)
            or any(mark in c and decimal in c for c in marked)
        ):
            continue
        for cells in columns:
            own = [c for c in cells if mark in c]
            whole = [c for c in cells if re.fullmatch(r"[+-]?[1-9]\d{0,2}", c)]
            trailing = any(c.endswith("0") for c in own)  # a form without ",0" has no "1,20" either
            if len(set(whole)) < WHOLE or not (trailing or len(set(own)) >= WHOLE):
                continue
            if max(abs(int(c)) for c in whole) >= NEAR * min(abs(int(c.replace(mark, ""))) for c in own):
                return decimal, mark, f"{own[0]!r} is among whole numbers such as {whole[0]!r}"
    return None


def _signs(numbers: Sequence[str], doubts: list[Guess]) -> tuple[str, str | None, str]:
    """Decimal sign, thousands separator, and the reason."""
    both = next((n for n in numbers if "." in n and "," in n), None)
    if both is not None:
        decimal = max(".,", key=both.rfind)
        return decimal, "," if decimal == "." else ".", f"as in {both!r}"
    group = next((n for n in numbers for c in "' \u00a0\u202f" if c in n), None)
    mark = next((c for c in "' \u00a0\u202f" if group and c in group), None)
    commas = [n for n in numbers if "," in n]
    points = [n for n in numbers if "." in n]
    if not commas:
        if points and all(BY_THREE.fullmatch(n) for n in points) and any(n.count(".") > 1 for n in points):
            return ",", ".", f"as in {points[0]!r}"
        return ".", mark, f"as in {group!r}"
    odd = next((n for n in commas if not BY_THREE.fullmatch(n)), None)
    if odd is None and any(n.count(",") > 1 for n in commas):
        return ".", ",", f"as in {next(n for n in commas if n.count(',') > 1)!r}"
    if odd is None and points and not all(BY_THREE.fullmatch(n) for n in points):
        return ".", ",", f"commas are before three digits only, as in {commas[0]!r}"
    if odd is None:
        question = f"Is the comma in {commas[0]!r} the decimal sign, or does it divide thousands (decimal sign .)?"
        doubts.append(Guess("source.decimal", [",", "."], question))
    if points and all(BY_THREE.fullmatch(n) for n in points):
        return ",", ".", f"decimal commas as in {odd or commas[0]!r}, points before three digits as in {points[0]!r}"
    return ",", mark, f"decimal commas, as in {odd or commas[0]!r}"
