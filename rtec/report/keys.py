"""Keys of files for people: one explained on a terminal, all of them as a page of the documentation."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from textwrap import fill

from rtec.reference.keys import Key

FILES = {
    "machine": "Machine file",
    "run": "Run file",
    "model": "Model file",
    "measurement": "Measurement, the TOML beside its table",
    "map": "Map of `rtec import`",
    "answers": "Answers of `rtec init`",
}
HEAD = """\
# Every key of every file

Written by `rtec explain --all` from the models that check the files; `make reference` writes it again. On the command
line, `rtec explain stop_um` explains one key. How the files work together: [files](../files.md).

NAME is a name of your choice: of an axis, a link, a sensor, a device. A key without a default, not required, may
be left out. Numbers outside their limits are refused.
"""


def explained(key: Key, width: int = 79) -> str:
    """One key on a terminal."""
    place = f"[{key.table}] {key.name}" if key.table else key.name
    lines = [f"{place}   ({key.file} file{f', where {key.when}' if key.when else ''})"]
    meaning = key.option.meaning.replace("`", "")
    if meaning:
        lines.append(fill(meaning[0].upper() + meaning[1:], width, initial_indent="  ", subsequent_indent="  "))
    facts = (("unit", key.unit), ("value", key.option.kind), ("default", _default(key)), ("example", key.example))
    lines += [f"  {name:<8} {text}" for name, text in facts if text]
    return "\n".join(lines)


def overview(tables: Sequence[tuple[str, str, str, int]]) -> str:
    """The tables, a line each."""
    lines = ["rtec explain KEY, or a table or a file with all its keys. The tables:", ""]
    for file, rows in groupby(tables, key=lambda row: row[0]):
        lines.append(f"{file} file")
        lines += [f"  {f'[{table}]' if table else '(top)':<44} {when} ({n})" for _, table, when, n in rows]
    return "\n".join(lines)


def reference(keys: Sequence[Key]) -> str:
    """All keys as Markdown."""
    return HEAD + "".join(_file_part(file, list(part)) for file, part in groupby(keys, key=lambda k: k.file))


def _file_part(file: str, keys: Sequence[Key]) -> str:
    parts = groupby(keys, key=lambda k: (k.table, k.when))
    return f"\n## {FILES[file]}\n" + "".join("\n".join(_table(t, w, list(part))) for (t, w), part in parts)


def _table(table: str, when: str, keys: Sequence[Key]) -> Iterator[str]:
    yield f"\n### `[{table}]`{f', {when}' if when else ''}\n" if table else ""
    yield "| key | unit | value | default | example | meaning |"
    yield "|---|---|---|---|---|---|"
    for key in keys:
        cells = (key.unit, key.option.kind, _default(key), f"`{key.example}`", key.option.meaning)
        yield f"| `{key.name}` | {' | '.join(_cell(cell) for cell in cells)} |"
    yield ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|") or "-"


def _default(key: Key) -> str:
    return "required" if key.option.required else key.option.default
