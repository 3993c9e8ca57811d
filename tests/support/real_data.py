"""Where the recordings made by others are: `RTEC_REAL_DATA`, or `../shared/data` beside the project."""

import os
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("RTEC_REAL_DATA") or Path(__file__).parents[3] / "shared" / "data")


def real_file(folder: str, name: str) -> Path:
    """Give one recording; skips the test where it is absent."""
    path = ROOT / folder / name
    if not path.is_file():
        pytest.skip(f"real data {folder}/{name} is not under RTEC_REAL_DATA or ../shared/data")
    return path
