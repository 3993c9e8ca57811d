"""A report as a PDF: sentences, tables and figures on pages of A4, drawn by matplotlib."""

from io import BytesIO
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtec.report.page import Page, Section, Table
from rtec.text import clean_lines

if TYPE_CHECKING:
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure as MplFigure

Pixels = NDArray[np.float32]
WIDE_IN, HIGH_IN, EDGE_IN = 8.27, 11.69, 0.8
LEAD, HEAD, TEXT, CELL = 14.0, 13.0, 10.0, 8.0
"""Font sizes, points."""
LINE: Final = 1.35
"""Line spacing, in font sizes."""
SMALLEST: Final = 0.7
"""Smallest scale of a figure that is shrunk to fit on the present page."""
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
        _Sheet(pages).fill(page)
    return out.getvalue()


class _Sheet:
    """The page that is being filled; a full one is saved and a new one begins."""

    def __init__(self, pages: "PdfPages") -> None:
        self._pages, self._figure, self._left = pages, self._new(), HIGH_IN - 2.0 * EDGE_IN

    def fill(self, page: Page) -> None:
        """Write the whole report."""
        self._text(page.title, 18.0, weight="bold")
        self._text(page.lead, LEAD)
        for value, meaning in page.numbers:
            self._text(f"{value}   {meaning}", TEXT)
        for section in page.sections:
            self._section(section)
        for line in page.foot:
            self._text(line, CELL)
        self._pages.savefig(self._figure)  # type: ignore[no-untyped-call]

    def _section(self, section: Section) -> None:
        heading = 2.0 * LINE * HEAD / POINTS_PER_IN + 0.5
        picture = _picture(section.figure.png) if section.figure is not None else None
        # A heading stays with its figure.
        alone = picture is not None and not section.text and section.table is None
        self._need(heading + (SMALLEST * _height_in(picture) if alone and picture is not None else 0.0))
        self._left -= 0.15
        self._text(section.heading, HEAD, weight="bold")
        for sentence in section.text:
            self._text(sentence, TEXT)
        if section.table is not None:
            self._table(section.table)
        if picture is not None:
            self._image(picture)

    def _new(self) -> "MplFigure":
        from matplotlib.figure import Figure

        return Figure(figsize=(WIDE_IN, HIGH_IN))

    def _need(self, inches: float) -> None:
        if self._left < inches:
            self._pages.savefig(self._figure)  # type: ignore[no-untyped-call]
            self._figure, self._left = self._new(), HIGH_IN - 2.0 * EDGE_IN

    def _text(self, words: str, size: float, **style: Any) -> None:
        most = int((WIDE_IN - 2.0 * EDGE_IN) * POINTS_PER_IN / (WORDS_WIDE * size))
        for paragraph in clean_lines(words).split("\n"):
            for line in wrap(paragraph, most) or [""]:
                self._line(line, size, **style)

    def _line(self, words: str, size: float, **style: Any) -> None:
        high = LINE * size / POINTS_PER_IN
        self._need(high)
        self._left -= high
        y = (self._left + EDGE_IN) / HIGH_IN
        self._figure.text(EDGE_IN / WIDE_IN, y, words, fontsize=size, va="bottom", **style)

    def _table(self, table: Table) -> None:
        """Write a table in monospaced letters; columns of words are cut if it is too wide."""
        rows = [[clean_lines(c).replace("\n", " ") for c in row] for row in (table.head, *table.rows)]
        widths = [max(len(row[k]) for row in rows) for k in range(len(table.head))]
        most = int((WIDE_IN - 2.0 * EDGE_IN) * POINTS_PER_IN / (MONO_WIDE * CELL))
        while sum(widths) + 2 * len(widths) > most and max(widths) > 8:
            widths[widths.index(max(widths))] -= 1
        for row in rows:
            cells = [_cut(c, w).ljust(w) if k in table.words else _cut(c, w).rjust(w)
                     for k, (c, w) in enumerate(zip(row, widths, strict=True))]  # fmt: skip
            self._line("  ".join(cells), CELL, family="monospace")
        if table.caption:
            self._text(table.caption, CELL)

    def _image(self, picture: Pixels) -> None:
        """Place a picture in the width of the page, or smaller if that saves a new page."""
        full = _height_in(picture)
        self._need(SMALLEST * full)
        high = min(full, self._left)
        self._left -= high
        wide = high * picture.shape[1] / picture.shape[0]
        place = (EDGE_IN / WIDE_IN, (self._left + EDGE_IN) / HIGH_IN, wide / WIDE_IN, high / HIGH_IN)
        axes = self._figure.add_axes(place)
        axes.imshow(picture, aspect="equal", interpolation="lanczos")
        axes.set_axis_off()


def _picture(png: bytes) -> Pixels:
    from matplotlib.image import imread

    return np.asarray(imread(BytesIO(png), format="png"))


def _height_in(picture: Pixels) -> float:
    """Height of a picture in the width of the page, at most that of the page."""
    wide = WIDE_IN - 2.0 * EDGE_IN
    return float(min(wide * picture.shape[0] / picture.shape[1], HIGH_IN - 2.0 * EDGE_IN - 1.0))


def _cut(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"
