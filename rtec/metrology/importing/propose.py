"""A map proposed from the file itself: what each column is, why, and what only people can know.

`propose` looks at the first rows. What the file says is concluded, each with its reason; what it does not say becomes a
question. A question with a usual answer takes that one until it is answered, and the measurement's notes say that it
was assumed; a question without one must be answered first.
"""

import itertools
import re
import tomllib
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import numpy as np
import tomli_w

from rtec.errors import MeasurementError
from rtec.machine import Machine
from rtec.metrology.importing.apply import chosen
from rtec.metrology.importing.map import ImportMap
from rtec.metrology.importing.roles import LEAVE, ColumnRoles
from rtec.metrology.importing.rows import from_events
from rtec.metrology.importing.words import has
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.metrology.readers import detect, read_tables
from rtec.metrology.readers.base import ForeignTable, SourceOptions, number_or_none
from rtec.metrology.readers.delimited import bracketed, table_of
from rtec.metrology.readers.layout import Guess, layout
from rtec.metrology.readers.registry import READERS
from rtec.text import clean
from rtec.tomlfile import nearest, validated
from rtec.wholefile import write_text

FIRST = 4
"""Values shown of each column."""
ODD = 0.1
"""Up to this share of cells that are no numbers, a column is one of numbers."""
NO_VALUE = "no value"
NUMBERS: Final = re.compile(r"\[\n((?: +[-+.0-9e]+,\n)+)\]")
NEEDED = {
    "straightness": ("direction",),
    "level": ("about",),
    "squareness": ("reference_axis",),
}
"""Keys of `[setup]` that an instrument needs unless a component is named, beside those that its set-up demands."""
EXAMPLES = {"probe": 'such as {z={direction="Z"}}: name and direction of each'}


@dataclass(frozen=True)
class ImportQuestion:
    """What the file does not say.

    Attributes:
        key: that an answer is given for, such as "axis", "setup.beam_offset_mm" or "unit of Weg".
        text: for people.
        choices: answers that are possible; empty: any text, or TOML for a set-up.
        default: usual answer, assumed until another is given; None: it must be answered.
        hint: what an answer may be, where there are no choices.
    """

    key: str
    text: str
    choices: tuple[str, ...] = ()
    default: str | None = None
    hint: str = ""


@dataclass(frozen=True)
class ForeignColumn:
    """A column of the file.

    Attributes:
        name: in the file.
        unit: that its name or the reader says; "" where none does.
        first: its first values, as texts.
        empty: rows looked at that have no value.
        becomes: column of the measurement; "" where it is not used.
        reason: why.
    """

    name: str
    unit: str
    first: tuple[str, ...]
    empty: int
    becomes: str = ""
    reason: str = ""


@dataclass(frozen=True)
class ImportProposal:
    """A map that is proposed for a file.

    Attributes:
        path: of the file.
        reader: that reads it.
        tables: names of the tables in it.
        rows: looked at.
        whole: are these all rows of the file?
        columns: of the file.
        content: the map as nested tables; without what is not answered.
        guesses: what was concluded, with reasons.
        questions: what was not, answered ones left out.
        assumed: usual answers that were taken: question and answer.
        notes: of the reader.
        machine, told, answers: that it was made with.
    """

    path: Path
    reader: str
    tables: tuple[str, ...]
    rows: int
    whole: bool
    columns: tuple[ForeignColumn, ...]
    content: Mapping[str, Any]
    guesses: tuple[Guess, ...]
    questions: tuple[ImportQuestion, ...]
    assumed: tuple[tuple[ImportQuestion, str], ...]
    notes: tuple[str, ...]
    machine: Machine | None = None
    told: Mapping[str, Any] = field(default_factory=dict)
    answers: Mapping[str, str] = field(default_factory=dict)

    @property
    def open(self) -> tuple[ImportQuestion, ...]:
        """Questions that must be answered before anything is imported."""
        return tuple(q for q in self.questions if q.default is None)

    @property
    def conclusions(self) -> tuple[str, ...]:
        """What was concluded about the file, in words: how it is written, its time, its runs."""
        return tuple(_said(g) for g in self.guesses)

    def answered(self, answers: Mapping[str, str]) -> "ImportProposal":
        """The proposal with more answers; they may open other questions.

        Raises:
            MeasurementError: an answer to no question, or one that is not possible.
        """
        return propose(self.path, self.machine, self.told, {**self.answers, **answers})

    def import_map(self) -> ImportMap:
        """The map.

        Raises:
            MeasurementError: questions are not answered; names them and how to answer.
        """
        if self.open:
            ways = [f"{self.path}: {q.text} Answer: {_way(q)}" for q in self.open]
            raise MeasurementError("\n".join(ways))
        return validated(ImportMap, self.content, str(self.path), MeasurementError)

    def facts(self) -> dict[str, Any]:
        """Everything, as plain values for JSON."""
        one = ("path", "reader", "tables", "rows", "whole", "content", "notes")
        return {name: getattr(self, name) for name in one} | {
            "path": str(self.path),
            "columns": [asdict(c) for c in self.columns],
            "guesses": [asdict(g) for g in self.guesses],
            "questions": [asdict(q) for q in self.questions],
        }

    def toml(self) -> str:
        """The map as a file, with what is known of it in comments; valid TOML whatever the file holds."""
        lines = [part for line in self._lines() for part in _folded(clean(line))]
        content = {k: v for k, v in self.content.items() if v != {}}
        return "\n".join([*(f"# {x}".rstrip() for x in lines), "", NUMBERS.sub(_one_line, tomli_w.dumps(content))])

    def _lines(self) -> list[str]:
        more = "" if self.whole else " (the first; there are more)"
        out = [f"{self.path.name} read as {self.reader}: {self.rows} rows{more}, {len(self.columns)} columns"]
        if len(self.tables) > 1:
            out.append(f"tables in it: {', '.join(self.tables)}")
        out += self.notes
        out += self.conclusions
        out += ["", "Columns of the file, their first values, what they become:"]
        for c in self.columns:
            values = "  ".join(v[:24] for v in c.first)
            unit = f" [{c.unit}]" if c.unit and not bracketed(c.name) else ""
            empty = f"; {c.empty} without value" if c.empty else ""
            out.append(f"  {c.name}{unit}: {values}{empty}")
            out.append(f"      {c.becomes or 'not used'}{': ' if c.reason else ''}{c.reason}")
        if self.assumed:
            out += ["", "Assumed; say otherwise if not so:"]
            out += [f"  {q.text} {answer!r}: {_way(q)}" for q, answer in self.assumed]
        if self.open:
            out += ["", "Not known yet:"]
            out += [f"  {q.text} {_way(q)}" for q in self.open]
        return out


def _folded(line: str) -> list[str]:
    """A line in lines of at most 78 characters; what follows is set in."""
    indent = " " * (len(line) - len(line.lstrip(" ")))
    return wrap(line, 78, subsequent_indent=f"{indent}    ", break_on_hyphens=False) or [""]


def _one_line(found: re.Match[str]) -> str:
    return f"[{', '.join(found.group(1).replace(',', ' ').split())}]"


def _said(guess: Guess) -> str:
    name = guess.key.removeprefix("source.").replace("_", " ")
    shown = "" if guess.value is None or guess.value is True else f" {guess.value!r}"
    return f"{name}{shown}: {guess.reason}"


def _way(question: ImportQuestion) -> str:
    key = f"--answer '{question.key}={question.choices[0] if len(question.choices) == 1 else '…'}'"
    key = f"--machine FILE, or {key}" if question.key == "machine" else key
    hint = ", ".join(question.choices) if len(question.choices) > 1 else question.hint
    return f"{key} ({hint})" if hint else key


def propose(
    path: Path,
    machine: Machine | None = None,
    told: Mapping[str, Any] | None = None,
    answers: Mapping[str, str] | None = None,
) -> ImportProposal:
    """Propose a map for a file of another program.

    Args:
        path: of the file.
        machine: that it was measured on; its axes and sensors are looked for.
        told: tables of a map that are known (`{"source": {"decimal": ","}}`); they are taken as they are.
        answers: to questions, by key; texts.

    Raises:
        MeasurementError: the file cannot be read, is no table; or an answer to no question, or not possible.
    """
    told, answers = told or {}, answers or {}
    asked = _Answers(str(path), answers)
    read = _read(path, dict(told.get("source", {})), asked)
    tables, guesses = read.tables, read.guesses
    name = told.get("source", {}).get("table")
    if name is None and len(tables) > 1:
        choices = tuple(t.name for t in tables)
        name = asked.ask("table", "Which of the tables?", choices, choices[0])
    table = chosen(tables, name, str(path))
    content: dict[str, Any] = {"source": read.source | ({"table": name} if name else {})}
    table, events = _events(table, told.get("events"), str(path))
    if events is not None:
        content["events"] = events
        guesses = (*guesses, Guess("events", events["channel"], "one value a line: each channel becomes a column"))
    roles = ColumnRoles(table, machine, told, asked.ask, is_log=events is not None or read.name == "json_lines")
    content |= roles.content()
    content["setup"] = dict(told.get("setup", {})) | _setup(content["measurement"], told, asked)
    content["column"] = _of_probes(content["column"], content["setup"])
    asked.check(content["measurement"])
    if asked.assumed:
        notes = [f"assumed on import, not known: {q.text} {a}" for q, a in asked.assumed]
        content["measurement"]["notes"] = [*content["measurement"].get("notes", ()), *notes]
    return ImportProposal(
        path, read.name, tuple(t.name for t in tables), len(table), read.whole, _columns(table, roles), content,
        (*guesses, *roles.guesses), tuple(asked.open), tuple(asked.assumed), table.notes, machine, told, answers,
    )  # fmt: skip


@dataclass(frozen=True)
class _Read:
    """What a reader gave: its name, the tables, whether that is all of the file, `[source]`, and what was concluded."""

    name: str
    tables: list[ForeignTable]
    whole: bool
    source: dict[str, Any]
    guesses: tuple[Guess, ...] = ()


def _read(path: Path, told: dict[str, Any], asked: "_Answers") -> _Read:
    """The tables of a file; of a text table its first rows, in the layout that it seems to have."""
    reader = told.get("reader")
    if reader is not None and reader not in READERS:
        raise MeasurementError(f"{path}: there is no reader {reader!r}{nearest(reader, READERS)}")
    if (reader or detect(path, told.get("encoding"))) != "delimited":
        options = validated(SourceOptions, told, f"{path}: [source]", MeasurementError)
        name, tables = read_tables(path, options)
        return _Read(name, tables, True, {"reader": name, **told})
    found = layout(path, {k: v for k, v in told.items() if k not in ("table", "swap_directions")})
    more: dict[str, Any] = {}
    for doubt in found.doubts:
        if (key := doubt.key.removeprefix("source.")) not in told:
            more[key] = asked.ask(key, f"{doubt.reason}: which?", tuple(doubt.value), str(doubt.value[0]))
    if more.get("decimal") == ".":
        more["thousands"] = ","
    source = found.source.model_copy(update=more)
    if not source.header and source.names is None:
        usual = ", ".join(table_of(path, found.text, source).columns)
        hint = "with units: time s, x mm, dev um, T_nut degC"
        names = asked.ask("names", "What are the columns called?", (), usual, hint) or usual
        more["names"] = [n.strip() for n in names.split(",")]
    source = validated(SourceOptions, _plain(found.source) | more, f"{path}: [source]", MeasurementError)
    table = table_of(path, found.text, source)
    if words := () if _log_columns(table) else _odd_cells(table, asked):
        source = source.model_copy(update={"missing": (*source.missing, *words)})
        table = table_of(path, found.text, source)
    return _Read("delimited", [table], not found.cut, _plain(source), found.guesses)


def _odd_cells(table: ForeignTable, asked: "_Answers") -> list[str]:
    """Cells that are no number in columns of numbers; each such column is asked for, and is numbers unless left out."""
    words: list[str] = []
    for name, values in table.columns.items():
        odd, right = _odd_of(table, name)
        if not odd:
            continue
        more = f", nor are {len(odd) - 1} more" if len(odd) > 1 else ""
        text = f"Line {table.lines[odd[0]]}, column {name!r}: {clean(str(values[odd[0]]))!r} is no number{more}; "
        text += f"{right} cells are. Correct the file, or is it no value?"
        if asked.ask(f"odd cell of {name}", text, (NO_VALUE, LEAVE)) != LEAVE:
            words += [str(values[i]) for i in odd]
    return list(dict.fromkeys(words))


def _odd_of(table: ForeignTable, name: str) -> tuple[list[int], int]:
    """Rows of the cells that are no number in a column of numbers, none in one of words; and how many cells are."""
    values = table.columns[name]
    filled = np.flatnonzero(values != "").tolist() if values.dtype == np.object_ else []
    odd = [i for i in filled if number_or_none(str(values[i]), table.decimal) is None]
    return (odd if len(odd) <= ODD * len(filled) else []), len(filled) - len(odd)


def _plain(source: SourceOptions) -> dict[str, Any]:
    return source.model_dump(mode="json", exclude_defaults=True)


def _events(
    table: ForeignTable, told: Mapping[str, Any] | None, source: str
) -> tuple[ForeignTable, dict[str, Any] | None]:
    """The table of an event log, and `[events]`; the table itself where it is none."""
    events = dict(told) if told else _log_columns(table)
    if not events:
        return table, None
    return from_events(table, events["channel"], events["value"], events.get("unit"), source), events


def _log_columns(table: ForeignTable) -> dict[str, Any]:
    """Which columns are channel and value of a log; empty where it is none.

    A log has three columns, or four with the units: words that come again and again beside one column of values.
    """
    if not 3 <= len(table.columns) <= 4 or len(table) < 4:
        return {}
    texts = {n: v.astype(str) for n, v in table.columns.items() if v.dtype == np.object_}
    often = [
        n
        for n, v in texts.items()
        if 2 <= len(set(v)) <= len(v) / 2 and not has(n, "direction") and not _odd_of(table, n)[0]
    ]
    unit = next((n for n in often if has(n, "unit")), None)
    channels = [n for n in often if n != unit and not _moments(table.columns[n])]
    named = [n for n in channels if has(n, "channel")] or channels
    values = [n for n in table.columns if n not in (*named, unit) and (has(n, "value") or n not in texts)]
    values = [n for n in values if has(n, "value")] or values[-1:]
    if len(named) != 1 or len(values) != 1 or len(table.columns) - (unit is not None) != 3:
        return {}
    if not (has(named[0], "channel") or _takes_turns(texts[named[0]], table, values[0])):
        return {}
    return {"channel": named[0], "value": values[0]} | ({"unit": unit} if unit else {})


def _moments(values: Any) -> bool:
    from rtec.metrology.readers.layout import kind_of

    return all(kind_of(str(v)) in ("time", "") for v in values[:50])


def _takes_turns(channel: Any, table: ForeignTable, value: str) -> bool:
    """Without a name that says so: at least three channels, or the values of two that differ more than within one."""
    if len(set(channel)) >= 3:
        return True
    values = table.columns[value]
    if values.dtype == np.object_:
        return False
    groups = [values[channel == c].astype(np.float64) for c in sorted(set(channel))]
    spread = max(float(np.nanmax(g) - np.nanmin(g)) for g in groups)
    return abs(float(np.nanmean(groups[0]) - np.nanmean(groups[1]))) > 3.0 * spread


class _Answers:
    """Questions as they come up: answered, assumed by their usual answer, or open."""

    def __init__(self, source: str, answers: Mapping[str, str]) -> None:
        self.source = source
        self.answers = answers
        self.asked: list[str] = []
        self.open: list[ImportQuestion] = []
        self.assumed: list[tuple[ImportQuestion, str]] = []

    def ask(
        self, key: str, text: str, choices: tuple[str, ...] = (), default: str | None = None, hint: str = ""
    ) -> str | None:
        """The answer, or the usual one; None where neither is there."""
        question = ImportQuestion(key, text, choices, default, hint)
        if question.key in self.asked:
            return self.answers.get(question.key, question.default)
        self.asked.append(question.key)
        if (given := self.answers.get(question.key)) is None:
            self.open.append(question)
            if question.default is not None:
                self.assumed.append((question, question.default))
            return question.default
        if question.choices and given not in question.choices:
            raise MeasurementError(
                f"{self.source}: {question.key}: {given!r} is not possible{nearest(given, question.choices)}"
            )
        return given

    def check(self, known: Mapping[str, Any]) -> None:
        """Refuse answers that nobody asked for, unless they are what the file says itself."""
        for key, answer in self.answers.items():
            if key not in self.asked and known.get(key) != answer:
                raise MeasurementError(f"{self.source}: {key!r} is no question here{nearest(key, self.asked)}")


def _setup(measurement: Mapping[str, Any], told: Mapping[str, Any], asked: _Answers) -> dict[str, Any]:
    """`[setup]`: what the instrument needs, and where its point is, unless a component is named."""
    instrument = measurement.get("instrument")
    if instrument not in INSTRUMENTS:
        return {}
    out: dict[str, Any] = {}
    direct = measurement.get("component") is not None
    for name, info in INSTRUMENTS[instrument].setup_model.model_fields.items():
        offset = name.endswith("offset_mm") and not direct
        needed = info.is_required() or (name in NEEDED.get(instrument, ()) and not direct)
        if name in told.get("setup", {}) or not (needed or offset):
            continue
        choices = tuple(str(c) for a in (info.annotation, *typing.get_args(info.annotation)) for c in _literals(a))
        default = None if needed else str(list(info.default))
        text = (
            f"{name} of the {instrument}?" if needed else f"{name}, from the tool tip to where the {instrument} reads?"
        )
        answer = asked.ask(f"setup.{name}", text, choices, default, EXAMPLES.get(name, ""))
        if answer is not None:
            out[name] = answer if choices else _value(answer, name, asked.source)
    return out


def _of_probes(columns: Mapping[str, Any], setup: Mapping[str, Any]) -> dict[str, Any]:
    """The columns; readings named by the probes of a set-up, in their order, where there are as many of them."""
    probes = setup.get("probe")
    readings = [name for name in columns if name.startswith("reading")]
    if not isinstance(probes, dict) or len(probes) != len(readings):
        return dict(columns)
    names = [f"reading_{p}_um" for p in probes]
    renamed = {} if set(names) == set(readings) else dict(zip(readings, names, strict=True))
    return {renamed.get(name, name): column for name, column in columns.items()}


def _literals(annotation: Any) -> tuple[Any, ...]:
    return typing.get_args(annotation) if typing.get_origin(annotation) is typing.Literal else ()


def _value(answer: str, name: str, source: str) -> Any:
    """An answer as TOML, or as the word that it is."""
    try:
        return tomllib.loads(f"a = {answer}")["a"]
    except tomllib.TOMLDecodeError:
        if answer.isidentifier():
            return answer
        raise MeasurementError(f"{source}: setup.{name}: {answer!r} is no number, list or word") from None


def _columns(table: ForeignTable, roles: ColumnRoles) -> tuple[ForeignColumn, ...]:
    out = []
    for name, values in table.columns.items():
        texts = values.dtype == np.object_
        empty = int((values == "").sum() if texts else np.isnan(values.astype(np.float64)).sum())
        first = itertools.islice((v for v in values if v not in ("", None) and v == v), FIRST)  # noqa: PLR0124
        shown = tuple(clean(str(v)) if texts else f"{v:.10g}" for v in first)
        becomes, reason = roles.use.get(name, ("", ""))
        unit = roles.units.get(name, "")
        out.append(ForeignColumn(name, unit, shown, empty, becomes, reason))
    return tuple(out)


def map_of(table: Path) -> Path:
    """Where the map of a measurement is written."""
    return table.with_name(f"{table.stem}-map.toml")


def save_map(proposal: ImportProposal, table: Path) -> Path:
    """Write the map beside a measurement, as NAME-map.toml; appears whole or not at all.

    Args:
        proposal: whose map it is.
        table: of the measurement.

    Raises:
        MeasurementError: it cannot be written.
    """
    path = map_of(table)
    write_text(proposal.toml(), path, MeasurementError)
    return path
