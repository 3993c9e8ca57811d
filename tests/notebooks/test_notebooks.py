"""The notebooks run as they are, in an empty folder; what they show is what they print now.

Oracle: Jupyter's own client, which fails at a cell that raises; and the outputs that the pages have.
"""

import re
from pathlib import Path
from typing import Any

import pytest

from tests.notebooks.run import executed, notebooks

LARGEST = 200_000


def texts(book: Any) -> list[str]:
    """What the cells print, without digits and blanks, which a machine's linear algebra may change."""
    streams = [o.text for cell in book.cells for o in cell.get("outputs", ()) if o.output_type == "stream"]
    return [re.sub(r"[\d.\s]+", "#", text) for text in streams]


@pytest.mark.parametrize("path", notebooks(), ids=lambda p: p.stem)
def test_it_runs_and_prints_what_it_shows(path: Path, tmp_path: Path) -> None:
    """Oracle: the outputs in the file; a figure where it has one."""
    import nbformat

    shown = nbformat.read(path, as_version=4)
    now = executed(path, tmp_path)
    assert texts(now) == texts(shown)
    kinds = [[sorted(o.get("data", {})) for o in cell.get("outputs", ())] for cell in shown.cells]
    assert [[sorted(o.get("data", {})) for o in cell.get("outputs", ())] for cell in now.cells] == kinds
    assert path.stat().st_size < LARGEST


def test_there_are_three() -> None:
    """Oracle: the names by which the documentation links them."""
    assert [p.stem for p in notebooks()] == ["files-to-a-missing-effect", "predict-and-plot", "write-an-effect"]
