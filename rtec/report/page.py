"""One self-contained HTML file: figures inlined, no scripts, no network; prints well."""

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources


@dataclass(frozen=True)
class Table:
    """A table; the columns in `words` are text, set left, the others numbers, set right."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    words: Sequence[int] = (0,)


@dataclass(frozen=True)
class Figure:
    """A picture: file name beside the page, PNG, and what it shows, in words for those who can't see it."""

    name: str
    png: bytes
    shows: str

    @property
    def inline(self) -> str:
        """The picture as a data address."""
        return "data:image/png;base64," + b64encode(self.png).decode("ascii")


@dataclass(frozen=True)
class Section:
    """A heading, paragraphs, then table and figure where given."""

    heading: str
    text: Sequence[str] = field(default_factory=tuple)
    table: Table | None = None
    figure: Figure | None = None


@dataclass(frozen=True)
class Page:
    """A report: title, the one sentence that matters, big numbers, sections, small print."""

    title: str
    lead: str
    numbers: Sequence[tuple[str, str]]
    sections: Sequence[Section]
    foot: Sequence[str] = field(default_factory=tuple)


def render(page: Page) -> str:
    """Give the page as HTML; every text is escaped."""
    from jinja2 import Environment, StrictUndefined

    source = resources.files("rtec.report").joinpath("page.html").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(source).render(page=page)
