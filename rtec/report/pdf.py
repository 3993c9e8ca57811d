"""A report as a PDF: sentences, tables and figures on pages of A4, drawn by matplotlib.

The report is a list of items: lines, gaps and pictures. A page takes as many of them as fit with its pictures at their
smallest; then its pictures grow into the room that is there.
"""

from dataclasses import dataclass, replace
from io import BytesIO
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtec.report.page import Page, Section, Table
from rtec.text import clean_lines

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

Pixels = NDArray[np.uint8]
WIDE_IN, HIGH_IN, EDGE_IN = 8.27, 11.69, 0.8
LEAD, HEAD, TEXT, CELL = 14.0, 13.0, 10.0, 8.0
"""Font sizes, points."""
LINE: Final = 1.35
"""Line spacing, in font sizes."""
GAP_IN: Final = 0.15
"""Space above a heading."""
SMALLEST: Final = 0.7
"""Smallest scale of a picture that is shrunk to fit on a page."""
FEW, TOGETHER = 6, 24
"""Up to so many lines are kept with the table or picture below them; up to so many lines of a table are on one page."""
POINTS_PER_IN, WORDS_WIDE, MONO_WIDE = 72.0, 0.52, 0.602
"""Mean width of a letter, and width of a monospaced one, in font sizes."""


def pdf_of(page: Page) -> bytes:
    """A report as a PDF; the same report gives the same bytes."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import PdfPages

    out = BytesIO()
    # Names from files are no formulas.
    style: Any = {"pdf.fonttype": 42, "text.parse_math": False}
    with rc_context(style), PdfPages(out, metadata={"CreationDate": None, "Title": page.title}) as pages:
        for sheet in _sheets(_items(page)):
            pages.savefig(_drawn(sheet))
    return out.getvalue()


@dataclass(frozen=True)
class _Item:
    """A line, a gap, or a picture.

    Attributes:
        high_in: height; of a picture in the width of the page.
        words, style: of a line.
        picture: of a picture.
        keep: whether the next item is on the same page.
        head: of a row of a table: the lines of its head, which a page repeats that begins with this row.
    """

    high_in: float
    words: str = ""
    style: tuple[tuple[str, Any], ...] = ()
    picture: Pixels | None = None
    keep: bool = False
    head: "tuple[_Item, ...]" = ()

    @property
    def least_in(self) -> float:
        """Smallest height."""
        return self.high_in * (SMALLEST if self.picture is not None else 1.0)


def _items(page: Page) -> list[_Item]:
    """The whole report."""
    out = [*_text(page.title, 18.0, weight="bold"), *_text(page.lead, LEAD)]
    for value, meaning in page.numbers:
        out += _text(f"{value}   {meaning}", TEXT)
    for section in page.sections:
        out += _section(section)
    foot = [item for line in page.foot for item in _text(line, CELL)]
    if foot and len(foot) <= FEW:  # small print alone would fill no page
        out[-1:] = [replace(item, keep=True) for item in out[-1:]]
        foot[:-1] = [replace(item, keep=True) for item in foot[:-1]]
    return [*out, *foot]


def _section(section: Section) -> list[_Item]:
    out = [_Item(GAP_IN, keep=True), *_text(section.heading, HEAD, keep=True, weight="bold")]
    words = [item for sentence in section.text for item in _text(sentence, TEXT)]
    if len(words) <= FEW and (section.table is not None or section.figure is not None):
        words = [replace(w, keep=True) for w in words]
    out += words
    if section.table is not None:
        out += _table(section.table)
    if section.figure is not None:
        if section.table is not None:
            out.append(_Item(GAP_IN))
        picture = _picture(section.figure.png)
        out.append(_Item(_height_in(picture), picture=picture))
    return out


def _text(words: str, size: float, *, keep: bool = False, **style: Any) -> list[_Item]:
    most = int((WIDE_IN - 2.0 * EDGE_IN) * POINTS_PER_IN / (WORDS_WIDE * size))
    lines = [line for paragraph in clean_lines(words).split("\n") for line in wrap(paragraph, most) or [""]]
    return [_line(line, size, keep=keep, **style) for line in lines]


def _line(words: str, size: float, *, keep: bool = False, **style: Any) -> _Item:
    return _Item(LINE * size / POINTS_PER_IN, words, (("fontsize", size), *style.items()), keep=keep)


def _table(table: Table) -> list[_Item]:
    """A table in monospaced letters; the widest columns are on several lines if it is too wide."""
    rows = [[clean_lines(c).replace("\n", " ") for c in row] for row in (table.head, *table.rows)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(table.head))]
    most = int((WIDE_IN - 2.0 * EDGE_IN) * POINTS_PER_IN / (MONO_WIDE * CELL))
    while sum(widths) + 2 * (len(widths) - 1) > most and max(widths) > 8:
        widths[widths.index(max(widths))] -= 1
    out: list[_Item] = []
    head: tuple[_Item, ...] = ()
    lines = [[wrap(c, w) or [""] for c, w in zip(row, widths, strict=True)] for row in rows]
    together = sum(max(map(len, cells)) for cells in lines) <= TOGETHER
    for number, cells in enumerate(lines):
        high = max(map(len, cells))
        for k in range(high):
            parts = [c[k] if k < len(c) else "" for c in cells]
            shown = [p.ljust(w) if i in table.words else p.rjust(w)
                     for i, (p, w) in enumerate(zip(parts, widths, strict=True))]  # fmt: skip
            # A row, the head with the first row, and a short table with its caption are on one page.
            keep = number == 0 or k < high - 1 or (together and (number < len(rows) - 1 or bool(table.caption)))
            line = _line("  ".join(shown).rstrip(), CELL, keep=keep, family="monospace")
            out.append(replace(line, head=head if k == 0 else ()))
        head = head or tuple(out)
    return [*out, *(_text(table.caption, CELL) if table.caption else [])]


def _sheets(items: list[_Item]) -> list[list[_Item]]:
    """The items of each page."""
    room, out, first = HIGH_IN - 2.0 * EDGE_IN, [], 0
    while first < len(items):
        head = items[first].head if first else ()
        end, used = first, sum(item.high_in for item in head)
        while end < len(items) and (used := used + items[end].least_in) <= room:
            end += 1
        last = end
        while end < len(items) and end > first and items[end - 1].keep:
            end -= 1  # what is kept with the next one goes there with it
        end = max(end if end > first else last, first + 1)
        # The rows of a table that goes on have its head above them; its first row has it anyhow.
        out.append([*(head if items[first - 1] not in head else ()), *items[first:end]])
        first = end
    return out


def _drawn(sheet: list[_Item]) -> "MplFigure":
    """A page."""
    from matplotlib.figure import Figure

    figure, left = Figure(figsize=(WIDE_IN, HIGH_IN)), HIGH_IN - EDGE_IN
    pictures = sum(i.high_in for i in sheet if i.picture is not None)
    others = sum(i.high_in for i in sheet if i.picture is None)
    scale = min(1.0, (HIGH_IN - 2.0 * EDGE_IN - others) / pictures) if pictures else 1.0
    for item in sheet:
        high = item.high_in * (scale if item.picture is not None else 1.0)
        left -= high
        if item.picture is not None:
            wide = high * item.picture.shape[1] / item.picture.shape[0]
            axes = figure.add_axes((EDGE_IN / WIDE_IN, left / HIGH_IN, wide / WIDE_IN, high / HIGH_IN))
            # Pixel by pixel, to be scaled by whoever shows it: to resample them took longer than all the rest.
            axes.imshow(item.picture, aspect="equal", interpolation="none")
            axes.set_axis_off()
        elif item.words:
            figure.text(EDGE_IN / WIDE_IN, left / HIGH_IN, item.words, va="bottom", **dict(item.style))
    return figure


def _picture(png: bytes) -> Pixels:
    from PIL import Image

    with Image.open(BytesIO(png)) as picture:
        return np.asarray(picture.convert("RGB"))


def _height_in(picture: Pixels) -> float:
    """Height of a picture in the width of the page, at most that of the page."""
    wide = WIDE_IN - 2.0 * EDGE_IN
    return float(min(wide * picture.shape[0] / picture.shape[1], HIGH_IN - 2.0 * EDGE_IN - 1.0))
