"""Executes the notebooks of `docs/notebooks`: `python -m tests.notebooks.run` writes what they print into them.

Each runs in an empty folder, as for a reader who has nothing but rtec.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
LONGEST_S = 300


def notebooks() -> list[Path]:
    """All of them."""
    return sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path, folder: Path) -> Any:
    """The notebook with what its cells print now.

    Raises:
        CellExecutionError: a cell failed; with its traceback.
    """
    book = nbformat.read(path, as_version=4)
    NotebookClient(book, timeout=LONGEST_S, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in book.cells:
        cell.metadata.pop("execution", None)  # when it ran, which changes with every run
    return book


if __name__ == "__main__":
    for each in notebooks():
        with tempfile.TemporaryDirectory() as scratch:
            nbformat.write(executed(each, Path(scratch)), each)
        sys.stdout.write(f"{each.name}\n")
