"""The report as a PDF. Oracle: the sheets that matplotlib is given, with their texts and places of pictures."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rtec.report.figures import Png
from rtec.report.page import Figure, Page, Section
from rtec.studio.pdf import pdf_of


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


def test_the_same_report_gives_the_same_bytes() -> None:
    """And it is a PDF."""
    assert pdf_of(_page(1)) == pdf_of(_page(1))
    assert pdf_of(_page(1)).startswith(b"%PDF-")
