"""A report: its parts, their self-contained HTML file (no scripts, no network), and its folder."""

import json
import re
import shutil
import tempfile
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import count
from pathlib import Path
from shlex import quote
from typing import Any

from rtec.errors import RtecError
from rtec.report.figures import Png
from rtec.result import plain
from rtec.text import clean_lines


@dataclass(frozen=True)
class Table:
    """A table; columns in `words` are text, aligned left; the others are numbers, aligned right."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    words: Sequence[int] = (0,)


@dataclass(frozen=True)
class Figure:
    """A picture: file name beside the page, PNG, and a description for people who cannot see it."""

    name: str
    png: Png
    shows: str

    @property
    def inline(self) -> str:
        """The picture as a data URL."""
        return "data:image/png;base64," + b64encode(self.png).decode("ascii")


@dataclass(frozen=True)
class Section:
    """A heading and paragraphs, then a table and a figure, if any."""

    heading: str
    text: Sequence[str] = field(default_factory=tuple)
    table: Table | None = None
    figure: Figure | None = None


@dataclass(frozen=True)
class Page:
    """A report.

    Attributes:
        title: title of the page.
        lead: the verdict, in one or two sentences.
        numbers: big numbers, each with its meaning.
        sections: sections of the page.
        foot: small print.
        brief: one short table, which a terminal shows below the verdict instead of the sections.
        next: commands for the next step, best first.
    """

    title: str
    lead: str
    numbers: Sequence[tuple[str, str]]
    sections: Sequence[Section]
    foot: Sequence[str] = field(default_factory=tuple)
    brief: Section | None = None
    next: Sequence[str] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        """Give a figure whose name another one has, on a disk that may not tell "X" from "x", a name of its own."""
        taken: set[str] = set()
        sections = [replace(s, figure=_apart(s.figure, taken)) if s.figure else s for s in self.sections]
        object.__setattr__(self, "sections", sections)

    @property
    def first_figure(self) -> Figure | None:
        """The first figure of the page; None where there is none."""
        return next((s.figure for s in self.sections if s.figure), None)


def _apart(figure: Figure, taken: set[str]) -> Figure:
    """The figure under a name that is not taken yet, which is then taken."""
    stem, dot, kind = figure.name.rpartition(".")
    names = (figure.name if i == 1 else f"{stem}-{i}{dot}{kind}" for i in count(1))
    name = next(n for n in names if n.lower() not in taken)
    taken.add(name.lower())
    return replace(figure, name=name)


def name_of_file(title: str) -> str:
    """A title as the beginning of a file's name: its letters, digits and signs that every disk takes."""
    return re.sub(r"[^\w.+-]+", "-", title).strip(".-") or "measurement"


def shell_command(*words: object) -> str:
    """A command as text for a shell, with the necessary quotes."""
    return " ".join(quote(str(word)) for word in words)


def render(page: Page) -> str:
    """The page as HTML; every text is escaped."""
    from jinja2 import Environment, StrictUndefined

    source = resources.files("rtec.report").joinpath("page.html").read_text(encoding="utf-8")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, finalize=_cleaned
    )
    return environment.from_string(source).render(page=page)


def _cleaned(value: Any) -> Any:
    return clean_lines(value) if isinstance(value, str) else value


def note_words(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """One sentence for each measurement with its notes: what is missing in it, and what was accepted."""
    return [f"{name}: {'; '.join(said)}." for name, said in notes.items() if said]


def write_page(page: Page, facts: object, folder: Path) -> Path:
    """Write `report.html`, `result.json` and the figures; give the page's path.

    All files are written into a hidden folder first, then moved to their places, the page last.

    Raises:
        RtecError: the folder cannot be written.
    """
    files: dict[str, bytes] = {s.figure.name: s.figure.png for s in page.sections if s.figure}
    files["result.json"] = (json.dumps(plain(facts), indent=2) + "\n").encode()
    files["report.html"] = render(page).encode()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        hidden = Path(tempfile.mkdtemp(prefix=".report-", dir=folder))
        try:
            for name, content in files.items():
                (hidden / name).write_bytes(content)
            for name in files:
                (hidden / name).replace(folder / name)
        finally:
            shutil.rmtree(hidden, ignore_errors=True)
    except OSError as e:
        raise RtecError(f"{folder}: the report cannot be written: {e.strerror}") from e
    return folder / "report.html"
