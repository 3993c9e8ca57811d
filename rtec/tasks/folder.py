"""The opened folder: its files by kind. No name can reach a file outside of it."""

import contextlib
import filecmp
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from rtec.errors import RtecError
from rtec.files import whole
from rtec.text import clean
from rtec.tomlfile import read_toml

if TYPE_CHECKING:
    from rtec.model import Model

FOREIGN: Final = (
    ".csv",
    ".txt",
    ".tsv",
    ".dat",
    ".xlsx",
    ".parquet",
    ".json",
    ".jsonl",
    ".mcap",
    ".tdms",
    ".log",
    ".xml",
)
TABLES: Final = (".csv", ".parquet")
LARGEST_TOML: Final = 4_000_000
MOST_FILES: Final = 2000
LONGEST_NAME: Final = 120
FORBIDDEN: Final = frozenset('/\\:*?"<>|\0')

Kind = Literal["machine", "model", "measurement", "foreign"]


@dataclass(frozen=True)
class Listing:
    """Names of the folder's files by kind, in order.

    Attributes:
        machines, models: TOML files.
        measurements: tables with a TOML beside them.
        foreign: tables of other programs.
        unread: names of TOML files that cannot be read, with the reason.
        more: number of files that were not examined, because there are too many.
    """

    machines: tuple[str, ...] = ()
    models: tuple[str, ...] = ()
    measurements: tuple[str, ...] = ()
    foreign: tuple[str, ...] = ()
    unread: tuple[tuple[str, str], ...] = ()
    more: int = 0


@dataclass(frozen=True)
class Summary:
    """A measurement in a list.

    Attributes:
        file: name of its table.
        instrument, axis: instrument and its axis; `reads` are its reading columns.
        rows, runs: number of rows and runs.
        hours: time from first to last reading.
        sensors: lowest and highest value of each recorded temperature, °C.
        span: lowest and highest position of each axis that moved, mm.
        notes: notes of its reader, in words.
        trouble: why it cannot be used, in words; else empty.
    """

    file: str
    instrument: str = ""
    axis: str = ""
    reads: tuple[str, ...] = ()
    rows: int = 0
    runs: int = 0
    hours: float = 0.0
    sensors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    span: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    trouble: str = ""

    @property
    def read_by(self) -> str:
        """Instrument and axis, in words; empty where they are not known yet."""
        return " ".join([self.instrument, self.axis]).strip()

    @property
    def spans(self) -> tuple[str, ...]:
        """Positions of each axis that moved, and the time, in words."""
        moved = [f"{axis} {low:.0f} to {high:.0f} mm" for axis, (low, high) in self.span.items()]
        return (*moved, *([f"{self.hours:.1f} h"] if self.rows else []))

    @property
    def temperatures(self) -> tuple[str, ...]:
        """Lowest and highest value of each temperature, in words."""
        return tuple(f"{sensor} {low:.1f} to {high:.1f} °C" for sensor, (low, high) in self.sensors.items())


@dataclass(frozen=True)
class Folder:
    """A folder of measurements, models and machine files.

    Args:
        root: the folder.
    """

    root: Path
    _real: Path = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_real", self.root.resolve())

    def path(self, name: str) -> Path:
        """Path of a file in this folder.

        Raises:
            RtecError: the name leads out of the folder, or is not allowed here.
        """
        if not name.strip() or name.startswith(".") or len(name) > LONGEST_NAME or not name.isprintable():
            raise RtecError(
                f"{clean(name[:LONGEST_NAME])!r}: a file name has 1 to {LONGEST_NAME} printable characters "
                "and does not begin with a dot"
            )
        if FORBIDDEN & set(name):
            raise RtecError(f'{name!r}: a file name has none of / \\ : * ? " < > |')
        path = self.root / name
        if not path.resolve().is_relative_to(self._real):
            raise RtecError(f"{name!r}: leads out of the opened folder")
        return path

    def existing(self, name: str) -> Path:
        """Path of a listed file; its name need not be one that `path` allows.

        Raises:
            RtecError: it leads out of the folder.
        """
        path = self.root / name
        if path.parent != self.root or not path.resolve().is_relative_to(self._real):
            raise RtecError(f"{clean(name)!r}: leads out of the opened folder")
        return path

    def listing(self) -> Listing:
        """List the folder's own files, without subfolders."""
        try:
            found = sorted(e.name for e in os.scandir(self.root) if not e.name.startswith(".") and self._is_inside(e))
        except OSError as e:
            raise RtecError(f"{self.root}: cannot be read: {e.strerror}") from e
        names, more = found[:MOST_FILES], max(len(found) - MOST_FILES, 0)
        kinds, unread = dict[str, Kind | None](), list[tuple[str, str]]()
        for n in names:
            if n.lower().endswith(".toml"):
                try:
                    kinds[n] = self._toml_kind(n)
                except RtecError as e:
                    unread.append((n, str(e).replace(f"{self.root / n}", n)))
        described = {Path(n).stem for n, kind in kinds.items() if kind == "measurement"}
        tables = [n for n in names if Path(n).suffix in TABLES and Path(n).stem in described]
        foreign = [n for n in names if Path(n).suffix.lower() in FOREIGN and n not in tables]
        return Listing(
            tuple(n for n, k in kinds.items() if k == "machine"),
            tuple(n for n, k in kinds.items() if k == "model"),
            tuple(tables),
            tuple(foreign),
            tuple(unread),
            more,
        )

    def machines_below(self) -> tuple[str, ...]:
        """Machine files one folder below, as `rtec init` writes them: "mill/machine.toml"."""
        try:
            below = [e.name for e in os.scandir(self.root) if e.is_dir() and not e.name.startswith(".")]
        except OSError:
            return ()
        found = []
        for folder in sorted(below)[:MOST_FILES]:
            with contextlib.suppress(RtecError):
                found += [f"{folder}/{name}" for name in Folder(self.path(folder)).listing().machines]
        return tuple(found)

    def take(self, name: str) -> str:
        """Copy one of `machines_below` into this folder; gives its name here.

        Raises:
            RtecError: it leads out of the folder, or cannot be copied.
        """
        below, file = name.split("/")
        source = Folder(self.path(below)).existing(file)
        here = f"{below}.toml" if file == "machine.toml" else file
        self.write(here, source)
        return here

    def write(self, name: str, content: bytes | Path) -> Path:
        """Write a file into the folder: it appears whole or not at all, and replaces no other file.

        Args:
            name: name of the file.
            content: its content, or a file with the content, which may be large.

        Raises:
            RtecError: the name is not possible, another file has it, or the disk is full.
        """
        path = self.path(name)
        if path.exists():
            if filecmp.cmp(path, content, shallow=False) if isinstance(content, Path) else path.read_bytes() == content:
                return path
            raise RtecError(f"{name}: another file of that name is in the folder; rename one of them")
        try:
            with (
                content.open("rb") if isinstance(content, Path) else BytesIO(content) as source,
                whole(path, RtecError, replace=False) as out,
            ):
                shutil.copyfileobj(source, out)
        except FileExistsError as e:
            raise RtecError(f"{name}: another file of that name is in the folder; rename one of them") from e
        return path

    def save_model(self, model: "Model", name: str, known: bytes | None = None) -> bytes:
        """Write a model as the command line does; a file of another tab or program is never replaced.

        Args:
            model: the model.
            name: name of its file.
            known: content that this tab wrote into the file before; None: the file must be new.

        Returns:
            The new content of the file.

        Raises:
            RtecError: the name is not possible, the file belongs to another tab or program, or it cannot be written.
        """
        from rtec.model import save_model

        path = self.path(name)
        if path.suffix != ".toml":
            raise RtecError(f"{name}: a model file ends in .toml")
        if known is not None and path.exists() and path.read_bytes() != known:
            raise RtecError(
                f"{name}: was changed by another tab or program since it was saved here; give the model a new name"
            )
        try:
            save_model(model, path, replace=known is not None)
        except FileExistsError as e:
            raise RtecError(f"{name}: another file of that name is in the folder; give the model a new name") from e
        return path.read_bytes()

    def _is_inside(self, entry: "os.DirEntry[str]") -> bool:
        with contextlib.suppress(OSError):
            return entry.is_file() and Path(entry.path).resolve().is_relative_to(self._real)
        return False

    def _toml_kind(self, name: str) -> Kind | None:
        """Kind of a TOML file; None: a file of other programs.

        Raises:
            RtecError: it cannot be read.
        """
        path = self.root / name
        try:
            data = read_toml(path) if path.stat().st_size < LARGEST_TOML else {}
        except OSError as e:
            raise RtecError(f"{name}: cannot be read: {e.strerror}") from e
        if "measurement" in data and "instrument" in (
            data["measurement"] if isinstance(data["measurement"], dict) else {}
        ):
            return "measurement"
        if isinstance(data.get("model"), dict) and "machine_hash" in data["model"]:
            return "model"
        return "machine" if {"machine", "axis"} <= set(data) else None
