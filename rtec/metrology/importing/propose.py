"""Proposes a map from the file itself: the meaning of each column with the reason, and questions to the user.

`propose` reads the first rows. Each conclusion has its reason; what the file does not show becomes a question. If a
question has a default, this is assumed until the user answers, and the measurement's notes have the assumption. A
question without a default must be answered first.
"""

import itertools
import re
import tomllib
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from textwrap import wrap
from typing import Any, Final

import numpy as np
import tomli_w

from rtec.errors import MeasurementError
from rtec.files import write_text
from rtec.machine import Machine
from rtec.metrology.importing.apply import chosen
from rtec.metrology.importing.clock import summer_time_ends
from rtec.metrology.importing.cycles import cycles_of, from_cycles
from rtec.metrology.importing.diameters import halve_diameters
from rtec.metrology.importing.map import Cycles, ImportMap, TemperatureLog
from rtec.metrology.importing.roles import BAR_VARIES, LEAVE, ColumnRoles, sensors_of
from rtec.metrology.importing.rows import from_events
from rtec.metrology.importing.words import has, unknown_unit
from rtec.metrology.importing.zones import SUCH_AS, said_zone, zone_of
from rtec.metrology.instruments.base import Instrument
from rtec.metrology.instruments.registry import INSTRUMENTS
from rtec.metrology.readers import detect, read_tables
from rtec.metrology.readers.base import ForeignTable, SourceOptions, number_or_none
from rtec.metrology.readers.delimited import bracketed, table_of, unit_named
from rtec.metrology.readers.layout import Guess, layout
from rtec.metrology.readers.registry import READERS
from rtec.text import clean
from rtec.tomlfile import fault_of_key, nearest, validated

FIRST = 4
"""Number of values that are shown of each column."""
ODD = 0.1
"""A column counts as numeric if at most this share of its cells are no numbers."""
NO_VALUE = "no value"
NUMBERS: Final = re.compile(r"\[\n((?: +[-+.0-9e]+,\n)+)\]")
EXAMPLES = {
    "probe": 'such as {z={direction="Z"}}: name and direction of each',
    "reference_axis": "an axis of the machine",
    "centre_mm": "such as [100, 50, 20]",
    "origin_mm": "such as [100, 50, 20]",
    "direction": "as in the machine's directions; of a diagonal such as [500, 400, 300]",
}


@dataclass(frozen=True)
class ImportQuestion:
    """A question about something that the file does not show.

    Attributes:
        key: key of the answer, such as "axis", "setup.beam_offset_mm" or "unit of Weg".
        text: for people.
        choices: possible answers; empty: any text, or TOML for a set-up.
        default: answer that is assumed until another is given; None: it must be answered.
        hint: form of the answer, where there are no choices.
        source: path of the file that it is about, where that is another one than the imported file.
    """

    key: str
    text: str
    choices: tuple[str, ...] = ()
    default: str | None = None
    hint: str = ""
    source: str = ""

    @property
    def words(self) -> str:
        """The text, with the name of another file that it is about."""
        return f"{Path(self.source).name}: {self.text}" if self.source else self.text


@dataclass(frozen=True)
class ForeignColumn:
    """A column of the file.

    Attributes:
        name: name in the file.
        unit: unit from its name or from the reader; "" where unknown.
        first: its first values, as texts.
        empty: number of the examined rows without a value.
        becomes: column of the measurement; "" where it is not used.
        reason: the reason, in words.
    """

    name: str
    unit: str
    first: tuple[str, ...]
    empty: int
    becomes: str = ""
    reason: str = ""


@dataclass(frozen=True)
class ImportProposal:
    """A proposed map for a file.

    Attributes:
        path: path of the file.
        reader: name of the reader.
        tables: names of the tables in the file.
        rows: number of examined rows.
        whole: whether these are all rows of the file.
        columns: columns of the file.
        content: the map as nested tables, without unanswered parts.
        guesses: conclusions, with reasons.
        questions: unanswered questions.
        assumed: questions with the default that was assumed.
        notes: notes of the reader.
        machine, preset, answers: the arguments of `propose`.
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
    preset: Mapping[str, Any] = field(default_factory=dict)
    answers: Mapping[str, str] = field(default_factory=dict)

    @property
    def open(self) -> tuple[ImportQuestion, ...]:
        """Questions that must be answered before the import."""
        return tuple(q for q in self.questions if q.default is None)

    @property
    def conclusions(self) -> tuple[str, ...]:
        """Conclusions about the file, in words: its format, its time, its runs."""
        return tuple(_conclusion(g) for g in self.guesses)

    def answered(self, answers: Mapping[str, str]) -> "ImportProposal":
        """The proposal with more answers; they may lead to other questions.

        Raises:
            MeasurementError: an answer belongs to no question, or is not possible.
        """
        return propose(self.path, self.machine, self.preset, {**self.answers, **answers})

    def with_columns(self, columns: Mapping[str, Mapping[str, Any]]) -> "ImportProposal":
        """The proposal with other columns in its map.

        Args:
            columns: the `[column.…]` tables of the map, by the name that each column becomes.
        """
        moved = {t: c for t, c in columns.items() if "from" in c}
        columns = {t: c for t, c in self.content.get("column", {}).items() if "from" not in c} | moved
        becomes = {str(c["from"]): target for target, c in columns.items() if "from" in c}
        changed = tuple(
            c if becomes.get(c.name, "") == c.becomes else replace(c, becomes=becomes.get(c.name, ""), reason="given")
            for c in self.columns
        )
        content = {**self.content, "column": dict(columns)}
        # Where the place of an axis now comes from a column, it is no longer asked.
        gone = [(q, a) for q, a in self.assumed if q.key in moved]
        if gone:
            head, notes = self.content["measurement"], [_assumption(q, a) for q, a in gone]
            content["measurement"] = {**head, "notes": [n for n in head["notes"] if n not in notes]}
        questions, assumed = (
            (q for q in self.questions if q.key not in moved),
            (x for x in self.assumed if x not in gone),
        )
        return replace(self, content=content, columns=changed, questions=tuple(questions), assumed=tuple(assumed))

    def import_map(self) -> ImportMap:
        """The map.

        Raises:
            MeasurementError: questions are not answered; the message names them and how to answer.
        """
        if self.open:
            ways = [f"{q.source or self.path}: {q.text} Answer: {_way(q)}" for q in self.open]
            columns = self.content.get("column", {})
            if columns and all(n.endswith("_degc") for n in columns):
                way = f"import the file of the readings, with --temperatures {self.path.name}"
                ways.append(f"{self.path}: only temperatures are in it; {way}")
            raise MeasurementError("\n".join(ways))
        return validated(ImportMap, self.content, str(self.path), MeasurementError)

    def facts(self) -> dict[str, Any]:
        """The proposal as plain values for JSON."""
        one = ("path", "reader", "tables", "rows", "whole", "content", "notes")
        return {name: getattr(self, name) for name in one} | {
            "path": str(self.path),
            "columns": [asdict(c) for c in self.columns],
            "guesses": [asdict(g) for g in self.guesses],
            "questions": [asdict(q) for q in self.questions],
        }

    def toml(self) -> str:
        """The map as TOML, with reasons and questions in comments; valid TOML whatever the foreign file contains."""
        lines = [part for line in self._lines() for part in _wrapped(clean(line))]
        content = {k: v for k, v in self.content.items() if v != {}}
        return "\n".join([*(f"# {x}".rstrip() for x in lines), "", NUMBERS.sub(_one_line, tomli_w.dumps(content))])

    def __str__(self) -> str:
        return self.toml()

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
            out += [f"  {q.words} {answer!r}: {_way(q)}" for q, answer in self.assumed]
        if self.open:
            out += ["", "Not known yet:"]
            out += [f"  {q.words} {_way(q)}" for q in self.open]
        return out


def _assumption(question: ImportQuestion, answer: str) -> str:
    return f"assumed on import, not known: {question.words} {answer}"


def _wrapped(line: str) -> list[str]:
    """A line as lines of at most 78 characters; continuation lines are indented."""
    indent = " " * (len(line) - len(line.lstrip(" ")))
    return wrap(line, 78, subsequent_indent=f"{indent}    ", break_on_hyphens=False) or [""]


def _one_line(found: re.Match[str]) -> str:
    return f"[{', '.join(found.group(1).replace(',', ' ').split())}]"


def _conclusion(guess: Guess) -> str:
    name = guess.key.removeprefix("source.").replace("_", " ")
    shown = "" if guess.value is None or guess.value is True else f" {guess.value!r}"
    return f"{name}{shown}: {guess.reason}"


def _way(question: ImportQuestion) -> str:
    key = f"--answer '{question.key}={question.choices[0] if len(question.choices) == 1 else '…'}'"
    key = f"--machine FILE, or {key}" if question.key == "machine" else key
    hint = (
        (" or " if "," in question.choices else ", ").join(question.choices)
        if len(question.choices) > 1
        else question.hint
    )
    return f"{key} ({hint})" if hint else key


@np.errstate(over="ignore", invalid="ignore")  # huge numbers are like nothing
def propose(
    path: Path,
    machine: Machine | None = None,
    preset: Mapping[str, Any] | None = None,
    answers: Mapping[str, str] | None = None,
) -> ImportProposal:
    """Propose a map for a file of another program.

    Args:
        path: path of the file.
        machine: the measured machine; its axes and sensors are matched to columns.
        preset: known tables of a map (`{"source": {"decimal": ","}}`), which are not changed.
        answers: answers as texts, by key of the question.

    Raises:
        MeasurementError: the file cannot be read or is no table; or an answer belongs to no question or is not
            possible.
    """
    preset, answers = preset or {}, answers or {}
    asker = _Answers(str(path), answers)
    read = _read(path, dict(preset.get("source", {})), asker)
    tables, guesses = read.tables, read.guesses
    name = preset.get("source", {}).get("table")
    if name is None and len(tables) > 1:
        choices = tuple(t.name for t in tables)
        name = asker.ask("table", "Which of the tables?", choices, choices[0])
    table = chosen(tables, name, str(path))
    content: dict[str, Any] = {"source": read.source | ({"table": name} if name else {})}
    table, events = _events(table, preset.get("events"), str(path))
    if events is not None:
        content["events"] = events
        guesses = (*guesses, Guess("events", events["channel"], "one value a line: each channel becomes a column"))
    if cycles := dict(preset.get("cycles", {})) or ({} if events else cycles_of(table, asker.ask)):
        known = validated(Cycles, cycles, f"{path}: [cycles]", MeasurementError)
        content["cycles"] = known.model_dump(exclude_defaults=True)
        table = from_cycles(table, **known.model_dump(), source=str(path))
        guesses = (*guesses, Guess("cycles", known.position, "one row a target, one column a run"))
    head = dict(preset.get("measurement", {}))
    given = {
        k: v
        for k, v in answers.items()
        if k not in head and (k == "component" or (k == "instrument" and v in INSTRUMENTS))
    }
    asker.keys += given
    preset = {**preset, "measurement": given | head}
    is_log = events is not None or read.name == "json_lines"
    roles = ColumnRoles(table, machine, preset, asker.ask, is_log=is_log, remarks=read.remarks)
    content |= roles.content()
    measurement = content["measurement"]
    halve_diameters(roles, measurement, preset.get("column", {}), asker.ask)
    kind = INSTRUMENTS.get(measurement.get("instrument", ""))
    if kind is not None and kind.axis_use == "optional" and "axis" in answers and "axis" not in measurement:
        measurement["axis"] = answers["axis"]
        asker.keys.append("axis")
    content["setup"] = dict(preset.get("setup", {})) | _setup(content["measurement"], preset, asker, roles)
    if roles.bar_mm is not None:
        guesses = (*guesses, *_less_the_bar(content["column"]["reading_um"], content["setup"], roles.bar_mm, str(path)))
    content["column"] = _of_probes(content["column"], content["setup"])
    if summer_time_ends(table, content["time"], str(path)):
        _ask_zone("zone", "Local time falls by an hour, as at the end of summer time.", content["time"], asker)
    in_log, logged = _temperatures(preset.get("temperatures"), path, content, roles, asker)
    content["column"] |= _constants(content["column"] | in_log, measurement, machine, asker)
    letters = [n[8].upper() for n in content["column"] if re.fullmatch(r"reading_[xyz]_um", n)]
    if kind is INSTRUMENTS["tool_tip"] and 0 < len(letters) < 3:
        content["setup"].setdefault("directions", letters)
    shown = {**roles.settled, **{f"setup.{k}": v for k, v in content["setup"].items()}, **measurement}
    shown |= {n: c.get("value", f"column {c.get('from')}") for n, c in content["column"].items()}
    guesses = (*guesses, *logged, *asker.unasked(shown, kind))
    if asker.assumed:
        notes = [_assumption(q, a) for q, a in asker.assumed]
        content["measurement"]["notes"] = [*content["measurement"].get("notes", ()), *notes]
    return ImportProposal(
        path, read.name, tuple(t.name for t in tables), len(table), read.whole, _columns(table, roles), content,
        (*guesses, *roles.guesses), tuple(asker.open), tuple(asker.assumed), table.notes, machine, preset, answers,
    )  # fmt: skip


@dataclass(frozen=True)
class _Read:
    """Result of a reader: its name, the tables, whether they are the whole file, `[source]`, and conclusions.

    Also the lines that are no rows, with their numbers.
    """

    name: str
    tables: list[ForeignTable]
    whole: bool
    source: dict[str, Any]
    guesses: tuple[Guess, ...] = ()
    remarks: tuple[tuple[int, str], ...] = ()


def _read(path: Path, preset: dict[str, Any], asker: "_Answers") -> _Read:
    """The tables of a file; of a text table the first rows, in the likeliest layout."""
    reader = preset.get("reader")
    if reader is not None and reader not in READERS:
        raise MeasurementError(f"{path}: there is no reader {reader!r}{nearest(reader, READERS)}")
    if (reader or detect(path, preset.get("encoding"))) != "delimited":
        options = validated(SourceOptions, preset, f"{path}: [source]", MeasurementError)
        name, tables = read_tables(path, options)
        return _Read(name, tables, True, {"reader": name, **preset})
    found = layout(path, {k: v for k, v in preset.items() if k not in ("table", "swap_directions")})
    more: dict[str, Any] = {}
    for doubt in found.doubts:
        if (key := doubt.key.removeprefix("source.")) not in preset:
            answer = asker.ask(key, doubt.reason, tuple(doubt.value))
            more |= {} if answer is None else {key: answer}
    if more.get("decimal") == ".":
        more["thousands"] = ","
    source = found.source.model_copy(update=more)
    if not source.header and source.names is None:
        usual = ", ".join(table_of(path, found.text, source).columns)
        hint = "with units: time s, x mm, dev um, T_nut degC"
        names = asker.ask("names", "What are the columns called?", (), usual, hint) or usual
        more["names"] = [n.strip() for n in names.split(",")]
    source = validated(SourceOptions, _plain(found.source) | more, f"{path}: [source]", MeasurementError)
    table = table_of(path, found.text, source)
    if words := () if _log_columns(table) else _odd_cells(table, asker):
        source = source.model_copy(update={"missing": (*source.missing, *words)})
        table = table_of(path, found.text, source)
    rows = set(table.lines.tolist())
    remarks = tuple((i, line) for i, line in enumerate(found.text.split("\n"), 1) if i not in rows and line.strip())
    return _Read("delimited", [table], not found.cut, _plain(source), found.guesses, remarks)


def _odd_cells(table: ForeignTable, asker: "_Answers") -> list[str]:
    """Notes on cells without a number in numeric columns; asks about each such column, which is numeric by default."""
    words: list[str] = []
    for name, values in table.columns.items():
        odd, right = _odd_of(table, name)
        if not odd:
            continue
        more = f", nor are {len(odd) - 1} more" if len(odd) > 1 else ""
        text = f"Line {table.lines[odd[0]]}, column {name!r}: {clean(str(values[odd[0]]))!r} is no number{more}; "
        text += f"{right} cells are. Correct the file, or is it no value?"
        if asker.ask(f"odd cell of {name}", text, (NO_VALUE, LEAVE)) != LEAVE:
            words += [str(values[i]) for i in odd]
    return list(dict.fromkeys(words))


def _odd_of(table: ForeignTable, name: str) -> tuple[list[int], int]:
    """Rows of the cells without a number in a numeric column (none in a column of words), and the number of cells."""
    values = table.columns[name]
    filled = np.flatnonzero(values != "").tolist() if values.dtype == np.object_ else []
    odd = [i for i in filled if number_or_none(str(values[i]), table.decimal) is None]
    return (odd if len(odd) <= ODD * len(filled) else []), len(filled) - len(odd)


def _plain(source: SourceOptions) -> dict[str, Any]:
    return source.model_dump(mode="json", exclude_defaults=True)


def _events(
    table: ForeignTable, preset: Mapping[str, Any] | None, source: str
) -> tuple[ForeignTable, dict[str, Any] | None]:
    """An event log as a table, and `[events]`; any other table as it is."""
    events = dict(preset) if preset else _log_columns(table)
    if not events:
        return table, None
    return from_events(table, events["channel"], events["value"], events.get("unit"), source), events


def _log_columns(table: ForeignTable) -> dict[str, Any]:
    """`channel` and `value` of a log; empty where the table is no log.

    A log has three columns, or four with the units: words that repeat, beside one column of values.
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
    """Whether a column looks like channel names: three or more, or two whose values differ more than those of one."""
    if len(set(channel)) >= 3:
        return True
    values = table.columns[value]
    if values.dtype == np.object_:
        return False
    groups = [values[channel == c].astype(np.float64) for c in sorted(set(channel))]
    spread = max(float(np.nanmax(g) - np.nanmin(g)) for g in groups)
    return abs(float(np.nanmean(groups[0]) - np.nanmean(groups[1]))) > 3.0 * spread


class _Answers:
    """Collects questions: answered, assumed by default, or unanswered."""

    def __init__(self, source: str, answers: Mapping[str, str]) -> None:
        self.source = source
        self.log = ""
        """Path of the log of temperatures, while it is read."""
        self.answers = answers
        self.keys: list[str] = []
        self.possible: list[str] = []
        self.open: list[ImportQuestion] = []
        self.assumed: list[tuple[ImportQuestion, str]] = []

    def ask(
        self, key: str, text: str, choices: tuple[str, ...] = (), default: str | None = None, hint: str = ""
    ) -> str | None:
        """The answer, or the default; None where there is neither."""
        if key.startswith("unit of ") and (strange := unknown_unit(key)):
            text, default = f"{text} {strange!r} is no unit that rtec knows.", None
        question = ImportQuestion(key, text, choices, default, hint, self.log)
        if question.key in self.keys:
            return self.answers.get(question.key, question.default)
        self.keys.append(question.key)
        if (given := self.answers.get(question.key)) is None:
            self.open.append(question)
            if question.default is not None:
                self.assumed.append((question, question.default))
            return question.default
        same = [c for c in question.choices if _same(key, given, c)]
        if question.choices and not same:
            said = f"{self.log or self.source}: {question.key}: {given!r} is not possible"
            raise MeasurementError(f"{said}{nearest(given, question.choices)}")
        return same[0] if same else given

    def unasked(self, known: Mapping[str, Any], kind: type[Instrument] | None) -> list[Guess]:
        """Conclusions on answers to questions that were not asked: they repeat the file, or do not apply.

        Args:
            known: what the file shows itself, by question.
            kind: the instrument, if it is known.

        Raises:
            MeasurementError: an answer contradicts the file, or belongs to no question.
        """
        out = []
        for key, answer in self.answers.items():
            if key in self.keys:
                continue
            if key in known:
                if not _same(key, answer, known[key]):
                    said = f"{self.source}: {key!r} is no question here: the file shows {str(known[key])!r}"
                    raise MeasurementError(f"{said}; a map may say otherwise")
                out.append(Guess(f"answer {key}", answer, "as the file shows itself"))
            elif kind is None and self.open and (key == "axis" or key in _setup_keys()):
                continue  # whether it is asked, the answers to the open questions show
            elif kind is not None and _is_of_others(key, kind):
                out.append(Guess(f"answer {key}", answer, f"not used: {kind.name} has no such key"))
            else:
                keys = self.possible if CONSTANT.fullmatch(key) else self.keys
                raise MeasurementError(f"{self.source}: {key!r} is no question here{nearest(key, keys)}")
        return out


def _same(key: str, answer: str, known: Any) -> bool:
    """Whether an answer is a known value: of units the names may differ, of numbers the writing."""
    if key.startswith("unit of ") and (unit := unit_named(answer)) and unit == unit_named(str(known)):
        return True
    if isinstance(known, int | float):
        return number_or_none(answer) == known
    return answer.lstrip("+") == str(known).lstrip("+")


def _is_of_others(key: str, kind: type[Instrument]) -> bool:
    """Whether a key belongs to other instruments than this one."""
    return (key == "axis" and kind.axis_use == "none") or key in _setup_keys()


def _setup_keys() -> set[str]:
    return {f"setup.{name}" for k in INSTRUMENTS.values() for name in k.setup_model.model_fields}


def _setup(
    measurement: Mapping[str, Any], preset: Mapping[str, Any], asker: _Answers, roles: ColumnRoles
) -> dict[str, Any]:
    """`[setup]`: the required keys, and the instrument's offset unless a component is named.

    The radius of a ball bar's circle is proposed from the length of the bar, unless the bar leans; the direction of a
    diagonal from the positions. Of measured coordinates the turn of their frame is taken as unknown.
    """
    instrument = measurement.get("instrument")
    if instrument not in INSTRUMENTS:
        return {}
    out: dict[str, Any] = {}
    direct = measurement.get("component") is not None
    kind = INSTRUMENTS[instrument]
    for name, info in kind.setup_model.model_fields.items():
        offset = name.endswith("offset_mm") and not direct
        needed = info.is_required() or (name in kind.needs and not direct)
        turned = name == "alignment" and kind is INSTRUMENTS["tool_tip"] and bool(roles.coordinates) and not direct
        given = f"setup.{name}" in asker.answers
        if name in preset.get("setup", {}) or not (needed or offset or turned or given):
            continue
        choices = {str(c): c for a in (info.annotation, *typing.get_args(info.annotation)) for c in _literals(a)}
        default = str(list(info.default)) if offset and not needed else None
        leans = "height_mm" in preset.get("setup", {}) or "setup.height_mm" in asker.answers
        if name == "radius_mm" and roles.bar_mm is not None and not leans:
            default = f"{round(roles.bar_mm)}"
        if name == "direction" and instrument == "laser_diagonal" and roles.line is not None:
            default = str(list(roles.line))
        if name == "feature" and roles.reads_diameter:
            default = "diameter"
        text = f"{name} of the {instrument}?"
        if offset and not needed:
            text = f"Where does the {instrument} read, as X, Y and Z from the tool tip ({name})?"
        if turned:
            text = f"May the fit turn its frame by a small angle ({name}): once (setup), in every run, or not (none)?"
            default = "setup"
        answer = asker.ask(f"setup.{name}", text, tuple(choices), default, EXAMPLES.get(name, ""))
        if answer is not None:
            out[name] = choices[answer] if choices else _value(answer, name, asker.source)
            if fault := fault_of_key(kind.setup_model, name, out[name], f"{asker.source}: [setup]"):
                raise MeasurementError(fault)
    return out


def _less_the_bar(column: dict[str, Any], setup: Mapping[str, Any], bar_mm: float, source: str) -> list[Guess]:
    """Subtract a ball bar's nominal length from its measured one, once the set-up is known.

    Raises:
        MeasurementError: the lengths differ by far more than a bar of that nominal length can.
    """
    radius, height = setup.get("radius_mm"), setup.get("height_mm", 0.0)
    if not (isinstance(radius, int | float) and isinstance(height, int | float)):
        return []
    nominal_mm = float(np.hypot(radius, height))
    if abs(bar_mm - nominal_mm) > BAR_VARIES * nominal_mm:
        said = f"{source}: {column['from']!r} is the length of the bar, {bar_mm:.6g} mm"
        raise MeasurementError(f"{said}, but radius_mm and height_mm make it {nominal_mm:.6g} mm; correct the answers")
    column["offset"] = -1000.0 * nominal_mm
    return [
        Guess(
            "reading", column["from"], f"the length of the bar: its nominal length, {nominal_mm:.10g} mm, is taken off"
        )
    ]


def _temperatures(
    preset: Any, beside: Path, content: dict[str, Any], own: ColumnRoles, asker: "_Answers"
) -> tuple[dict[str, Any], tuple[Guess, ...]]:
    """Add `[temperatures]`, a log in a file of its own, to a map; give the log's columns, and conclusions.

    One that says where the time and the columns come from is kept as it is.

    Args:
        preset: known keys of `[temperatures]`, `file` at least; None: there is no log.
        beside: the imported file; a relative path of the log starts at its folder.
        content: the map; columns that the imported file has itself are not taken from the log.
        own: roles of the imported file's columns, which get what the log shows itself.
        asker: asks for sensors that the names do not tell.

    Raises:
        MeasurementError: the log has no times, or no temperature, spindle speed, feed or load.
    """
    if preset is None:
        return {}, ()
    if not isinstance(preset, Mapping) or not isinstance(preset.get("file"), str):
        raise MeasurementError(f"{beside}: [temperatures] file is missing: the path of the log")
    path = beside.parent / preset["file"]
    there = content["column"]
    if {"time", "column"} <= preset.keys():
        known = validated(TemperatureLog, preset, f"{beside}: [temperatures]", MeasurementError)
        taken = {n: c for n, c in preset["column"].items() if n not in there}
        content["temperatures"] = {**preset, "column": taken}
        own.settled |= sensors_of(preset["column"])
        return taken, _from_log({n: c.from_ for n, c in known.column.items()}, there, path)
    asker.log = str(path)
    read = _read(path, dict(preset.get("source", {})), asker)
    table = chosen(read.tables, preset.get("source", {}).get("table"), str(path))
    table, events = _events(table, preset.get("events"), str(path))
    is_log = events is not None or read.name == "json_lines"
    roles = ColumnRoles(table, own.machine, preset, asker.ask, is_log=is_log)
    found = roles.log()
    shown = said_zone(own.table, content["time"]), said_zone(table, found["time"])
    turned = summer_time_ends(table, found["time"], str(path))
    if turned or (shown[1] == "" and shown[0]):
        why = (
            "Local time falls by an hour, as at the end of summer time."
            if turned
            else f"No time zone is in it; {beside.name} says {shown[0]}."
        )
        _ask_zone("zone of log", why, found["time"], asker)
    asker.log = ""
    if shown[0] == "" and (shown[1] or found["time"].get("zone")):
        why = f"No time zone is in {beside.name}; {path.name} says {found['time'].get('zone') or shown[1]}."
        _ask_zone("zone", why, content["time"], asker)
    if "column" not in found["time"]:
        raise MeasurementError(f"{path}: no column of times; a log of temperatures has one, with the time of day")
    asked = any(q.key.startswith(("sensor of", "unit of")) for q in asker.open)
    if not found["column"] and not asked:
        raise MeasurementError(f"{path}: no column of temperatures of a sensor, of a spindle speed, feed or load")
    taken = {n: c for n, c in found["column"].items() if n not in there}
    source = {"file": preset["file"], "source": read.source, **({"events": events} if events else {})}
    content["temperatures"] = source | found | {"column": taken}
    own.settled |= roles.settled
    return taken, _from_log({n: c["from"] for n, c in found["column"].items()}, there, path)


def _from_log(columns: Mapping[str, str], there: Mapping[str, Any], path: Path) -> tuple[Guess, ...]:
    """Conclusions on the columns of a log, given with their names in it; those `there` are not taken from it."""
    guesses = [
        Guess("temperatures", name, f"{n}, a column of {path.name}") for n, name in columns.items() if n not in there
    ]
    guesses += [Guess("temperatures", None, f"{n} is in the file itself") for n in columns if n in there]
    return tuple(guesses)


def _ask_zone(key: str, why: str, time: dict[str, Any], asker: _Answers) -> None:
    """Ask in which time zone local times are, and put it into `[time]`."""
    if time.get("zone"):
        return
    answer = asker.ask(key, f"{why} In which time zone are its times?", (), None, SUCH_AS)
    if answer is not None:
        try:
            zone_of(answer)
        except ValueError as e:
            raise MeasurementError(f"{asker.log or asker.source}: {key}: {e}") from e
        time["zone"] = answer


CONSTANT = re.compile(r"[a-z][a-z0-9]*_mm|\w+_degc|dir_\w+")


def _constants(
    columns: Mapping[str, Any], measurement: Mapping[str, Any], machine: Machine | None, asker: _Answers
) -> dict[str, Any]:
    """Columns that the file lacks: the place of each other axis, which is asked; temperatures and directions that are
    answered.

    A ball bar's circle tells where all axes are; to readings that are a component already no lever arm matters.
    """
    kind = INSTRUMENTS.get(measurement.get("instrument", ""))
    if kind is None or (kind.axis_use == "required" and "axis" not in measurement):
        return {}
    followed = f"{measurement['axis']}_mm".lower() if kind.axis_use == "required" else ""
    out: dict[str, Any] = {}
    if machine is not None and kind is not INSTRUMENTS["ball_bar"] and "component" not in measurement:
        for axis in machine.axes:
            name = f"{axis.channel}_mm"
            if name in columns or name == followed:
                continue
            text, usual = f"Where did axis {axis.name} stand, in mm?", float(np.clip(0.0, *axis.travel_mm))
            answer = asker.ask(name, text, (), f"{usual:g}", "as the display showed it")
            out[name] = {"value": _number(name, answer, asker)}
    known = {*columns, *out, followed}
    allowed = machine.columns if machine is not None else asker.answers
    asker.possible = [n for n in allowed if CONSTANT.fullmatch(n) and n not in known]
    for name in asker.possible:
        if name in asker.answers:
            asker.keys.append(name)
            out[name] = {"value": _number(name, asker.answers[name], asker)}
    return out


def _number(name: str, answer: str | None, asker: _Answers) -> float:
    number = number_or_none((answer or "").strip())
    if number is None or not np.isfinite(number):
        unit = "in mm" if name.endswith("_mm") else "in °C" if name.endswith("_degc") else "as -1 or +1"
        said = f"{asker.source}: {name}: {answer!r} is no number"
        raise MeasurementError(f"{said}; give it {unit}, such as {name}={'1' if name.startswith('dir_') else '20.5'}")
    return number


def _of_probes(columns: Mapping[str, Any], setup: Mapping[str, Any]) -> dict[str, Any]:
    """The columns; if there are as many readings as probes in the set-up, readings get the probes' names in order."""
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
    """An answer as a TOML value, else as text."""
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
    """Path of the map beside a measurement: NAME-map.toml."""
    return table.with_name(f"{table.stem}-map.toml")


def save_map(proposal: ImportProposal, table: Path) -> Path:
    """Write the map beside a measurement, as NAME-map.toml; the file appears whole or not at all.

    Args:
        proposal: its map is written.
        table: path of the measurement's table.

    Raises:
        MeasurementError: the file cannot be written.
    """
    path = map_of(table)
    write_text(proposal.toml(), path, MeasurementError)
    return path
