"""The report as a PDF. Oracle: the sheets that matplotlib is given, with their texts and places of pictures."""

from dataclasses import replace
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rtec.report.figures import Png
from rtec.report.page import Figure, Page, Section, Table
from rtec.report.pdf import pdf_of


def _page(pictures: int) -> Page:
    out = BytesIO()
    Image.fromarray(np.zeros((520, 1000, 3), dtype=np.uint8)).save(out, format="png")
    sections = [Section(f"Figure {k}", figure=Figure("f.png", Png(out.getvalue()), "nothing")) for k in range(pictures)]
    return Page("Title", "Lead.", [], sections, [])


def test_a_heading_stays_with_its_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """No sheet ends with the heading of a figure that is on the next one."""
    sheets: list[Any] = []
    monkeypatch.setattr("matplotlib.backends.backend_pdf.PdfPages.savefig", lambda _, figure: sheets.append(figure))
    pdf_of(_page(7))
    headings = [[t.get_text() for t in s.texts if t.get_text().startswith("Figure")] for s in sheets]
    assert [len(h) for h in headings] == [len(s.axes) for s in sheets]
    assert [name for h in headings for name in h] == [f"Figure {k}" for k in range(7)]
    assert len(sheets) < 5
    for sheet in sheets:
        boxes = sorted(a.get_position().bounds for a in sheet.axes)
        assert all(y >= 0.0 and x + w <= 1.0 for x, y, w, _ in boxes)


def test_pictures_share_their_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of seven pictures of three tenths of a page, three are on each sheet but the last, each with its words."""
    sheets: list[Any] = []
    monkeypatch.setattr("matplotlib.backends.backend_pdf.PdfPages.savefig", lambda _, figure: sheets.append(figure))
    page = _page(7)
    pdf_of(replace(page, sections=[replace(s, text=["A sentence."]) for s in page.sections]))
    assert [len(s.axes) for s in sheets] == [3, 3, 1]
    for sheet in sheets:
        assert sum(t.get_text() == "A sentence." for t in sheet.texts) == len(sheet.axes)
        assert min(a.get_position().y0 for a in sheet.axes) > 0.0


def test_a_wide_table_has_all_its_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the words of its cells; a row is not parted by the end of a page."""
    sheets: list[Any] = []
    monkeypatch.setattr("matplotlib.backends.backend_pdf.PdfPages.savefig", lambda _, figure: sheets.append(figure))
    cell = " ".join(f"word{k}" for k in range(40))
    rows = [(f"row{k:03d}", cell, cell) for k in range(40)]
    pdf_of(Page("Title", "Lead.", [], [Section("Wide", [], Table(("name", "one", "two"), rows, words=(0, 1, 2)))], []))
    assert len(sheets) > 2
    starts = [next(t.get_text() for t in s.texts if "word" in t.get_text()) for s in sheets]
    assert all(line.startswith("row") for line in starts)
    said = [w for s in sheets for t in s.texts for w in t.get_text().split()]
    assert sum(w.startswith("word") for w in said) == 2 * 40 * 40


def test_a_table_is_cut_only_where_it_must_be_and_has_its_head_on_every_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the rows: 18 go to the next page together; of 150 each page begins with the head."""
    sheets: list[Any] = []
    monkeypatch.setattr("matplotlib.backends.backend_pdf.PdfPages.savefig", lambda _, figure: sheets.append(figure))

    def table(name: str, rows: int) -> Section:
        return Section(name, [], Table(("input", "value"), [(f"{name}{k:03d}", "1") for k in range(rows)]))

    pdf_of(replace(_page(2), sections=[*_page(2).sections, table("small", 18), table("large", 150)]))
    lines = [[t.get_text() for t in s.texts] for s in sheets]
    assert [sum("small" in line for line in page) for page in lines if any("small0" in line for line in page)] == [19]
    shown = [page for page in lines if any("large0" in line or "large1" in line for line in page)]
    assert len(shown) > 1
    for page in shown:
        rows = [k for k, line in enumerate(page) if line.startswith("large") and line != "large"]
        assert page[rows[0] - 1].split() == ["input", "value"]
    assert sum(line.split() == ["input", "value"] for page in lines for line in page) == 1 + len(shown)


def test_the_same_report_gives_the_same_bytes() -> None:
    """And it is a PDF."""
    assert pdf_of(_page(1)) == pdf_of(_page(1))
    assert pdf_of(_page(1)).startswith(b"%PDF-")


def test_small_print_is_alone_on_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the texts of the last sheet, with pictures that fill each sheet to its end."""
    sheets: list[Any] = []
    monkeypatch.setattr("matplotlib.backends.backend_pdf.PdfPages.savefig", lambda _, figure: sheets.append(figure))
    for pictures in range(1, 9):
        sheets.clear()
        pdf_of(replace(_page(pictures), foot=["Small print.", "More of it."]))
        assert [t.get_text() for t in sheets[-1].texts][-2:] == ["Small print.", "More of it."]
        assert sheets[-1].axes
