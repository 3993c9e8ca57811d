"""What all tests share: hypothesis without a clock and with a fixed seed; a short folder for sockets."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("rtec", deadline=None, derandomize=True)
settings.load_profile("rtec")


@pytest.fixture
def runtime_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime folder of its own for daemons; its path is short, as the address of a local socket must be."""
    with tempfile.TemporaryDirectory(prefix="rtec-") as name:
        monkeypatch.setenv("RUNTIME_DIRECTORY", name)
        yield Path(name)
