"""The readers by name. Each module has `read(path, source)`; the sniffers see the first lines of a text."""

import importlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rtec.errors import MeasurementError
from rtec.tomlfile import nearest

if TYPE_CHECKING:
    from rtec.metrology.readers.base import ForeignTable, SourceOptions

HEAD_BYTES = 8192


@dataclass(frozen=True)
class FileReader:
    """One reader.

    Attributes:
        module: module with its `read`.
        title: kind of its files, for people.
        gives: its columns.
        looks_like: whether the first characters of a text look like one of its files.
    """

    module: str
    title: str
    gives: str
    looks_like: Callable[[str], bool]


def _json_lines(head: str) -> bool:
    first = head.lstrip().split("\n", 1)[0]
    if not first.startswith("{"):
        return False
    try:
        return isinstance(json.loads(first), dict)
    except (ValueError, RecursionError):
        return False


def _isg(head: str) -> bool:
    rows = [r.split("//")[0].replace(";", " ").split() for r in head.splitlines()]
    first = next((r for r in rows if r and r != ["#"]), [])
    known = re.compile(r"[XYZABC]|E[XYZABC]{2}|[XYZABC]0[XYZABC]|[PNV][0XYZ][XYZABC]")
    return any(len(n) == 3 for n in first) and all(known.fullmatch(n) for n in first)


READERS: dict[str, FileReader] = {
    "ecmc_iso230": FileReader(
        "rtec.metrology.readers.ecmc_iso230",
        "ecmc ISO 230-2 data (.dat: TGT_DATA, REF_DATA_FWD, REF_DATA_BWD)",
        "order, cycle, position, direction, target, reference, deviation",
        lambda head: bool(re.search(r"^(TGT_DATA|REF_DATA_[FB]WD)\[", head, re.MULTILINE)),
    ),
    "twincat_scope": FileReader(
        "rtec.metrology.readers.twincat_scope",
        "TwinCAT Scope export to CSV",
        "time, and each channel by its name",
        lambda head: head.startswith("Name") and bool(re.search(r"^Data-Type|^SampleTime", head, re.MULTILINE)),
    ),
    "json_lines": FileReader(
        "rtec.metrology.readers.json_lines",
        "JSON lines: one object a line",
        "each key; keys inside of objects and lists joined by points",
        _json_lines,
    ),
    "isg_csv": FileReader(
        "rtec.metrology.readers.isg_csv",
        "ISG / Beckhoff volumetric compensation (ISG CSV: EXX … ECX against position)",
        "per block: X Y Z A B C as arguments, component errors by their names",
        _isg,
    ),
    "delimited": FileReader(
        "rtec.metrology.readers.delimited",
        "any text table: comma, semicolon, tab, bar, blanks, fixed width",
        "the names in its header",
        lambda _: True,
    ),
}


def detect(path: Path, encoding: str | None = None) -> str:
    """Name of the reader whose files look like this one; `delimited` where none does.

    Raises:
        MeasurementError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            data = file.read(HEAD_BYTES)
    except FileNotFoundError as e:
        raise MeasurementError(f"{path}: no such file") from e
    except OSError as e:
        raise MeasurementError(f"{path}: cannot be read: {e.strerror}") from e
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    head = data.decode(encoding or ("utf-16" if wide else "utf-8-sig"), errors="replace").replace("\r\n", "\n")
    return next(name for name, reader in READERS.items() if reader.looks_like(head))


def read_tables(path: Path, source: "SourceOptions | None" = None) -> tuple[str, "list[ForeignTable]"]:
    """Read a file with the reader that `source` names, or with the one that fits.

    Returns:
        Name of the reader, and the tables.

    Raises:
        MeasurementError: there is no such reader, or the file is wrong; the message names file and line.
    """
    from rtec.metrology.readers.base import SourceOptions

    source = source or SourceOptions()
    name = source.reader or detect(path, source.encoding)
    if name not in READERS:
        raise MeasurementError(f"{path}: there is no reader {name!r}{nearest(name, READERS)}")
    return name, importlib.import_module(READERS[name].module).read(path, source)
