"""What the reports of the procedures share: the page in a folder, and results as JSON."""

import json
import math
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rtec.errors import RtecError
from rtec.report.page import Page, Section, render


def plain(value: Any) -> Any:
    """A result as JSON holds it: arrays become lists; what is not finite becomes null."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def number(value: float, digits: int = 2) -> str:
    """A number for a table; a dash for none."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "–"


def note_words(notes: Mapping[str, Sequence[str]]) -> list[str]:
    """What was said of measurements as they were read, a sentence each: nothing missing or accepted stays unsaid."""
    return [f"{name}: {'; '.join(said)}." for name, said in notes.items() if said]


def with_notes(page: Page, notes: Mapping[str, Sequence[str]]) -> Page:
    """The page with what was said of its measurements at the end; the same page where nothing was."""
    words = note_words(notes)
    return replace(page, sections=[*page.sections, Section("Said of the measurements", words)]) if words else page


def write_page(page: Page, facts: object, folder: Path) -> Path:
    """Write `report.html`, `result.json` and the figures; give the page's path.

    Everything is made in a hidden folder first, and each file then moved to its place, the page last.

    Raises:
        RtecError: the folder cannot be written.
    """
    files = {s.figure.name: s.figure.png for s in page.sections if s.figure}
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
