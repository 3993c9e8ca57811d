"""What all tests share: hypothesis without a clock and with a fixed seed; a short folder for sockets; who runs what."""

import gc
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# What is compiled once serves each worker and each of the hundreds of rtec processes that tests start.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# A second thread for linear algebra waits for the first by spinning; beside other tests that is time they need.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Files of tests are memory where there is enough of it: on some disks it costs a test 3 ms to remove a file.
MEMORY, ROOM = Path("/dev/shm"), 8 * 2**30  # noqa: S108 (the folder is pytest's, and private)
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > ROOM:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

settings.register_profile("rtec", deadline=None, derandomize=True)
settings.load_profile("rtec")

LONGEST_NAME = 300
"""Characters of a parameter in the name of a test."""
GARBAGE = (20_000, 20, 20)
"""New objects until the next search for garbage among them; searches until the next among older ones."""


@pytest.fixture
def runtime_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A runtime folder of its own for daemons; its path is short, as the address of a local socket must be."""
    with tempfile.TemporaryDirectory(prefix="rtec-") as name:
        monkeypatch.setenv("RUNTIME_DIRECTORY", name)
        yield Path(name)


def pytest_make_parametrize_id(val: object) -> str | None:
    """Cut long texts: the name of a test goes to every worker, and into every report on it."""
    if isinstance(val, str | bytes) and len(val) > LONGEST_NAME:
        return f"{val[:40]!r} and {len(val) - 40} more"
    return None


def pytest_xdist_auto_num_workers() -> int:
    """One worker a core, and two for the tests that mostly wait: for the real clock, and for browsers and LinuxCNC.

    These are the largest two groups, so they begin first; beside them all others use the cores.
    """
    return len(os.sched_getaffinity(0)) + 2


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """The tests, half a million objects in every worker, are no garbage: no search goes through them, now or later.

    Python's own threshold, 700 new objects, makes the search for garbage a twentieth of all work.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(*GARBAGE)
        gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Strip the names of groups from what failed, which a run without workers does not know."""
    cache = getattr(session.config, "cache", None)
    if session.config.getoption("dist", "no") == "loadgroup" and cache is not None:
        failed = cache.get("cache/lastfailed", {})
        cache.set("cache/lastfailed", {re.sub(r"@[^@\]]+$", "", test): True for test in failed})


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share a fixture of their module run in one worker, which makes it once."""
    for item in items:
        if not isinstance(item, pytest.Function) or item.get_closest_marker("xdist_group"):
            continue
        fixtures = item._fixtureinfo.name2fixturedefs.values()
        if any(fixture.scope == "module" and not fixture.params for same in fixtures for fixture in same):
            item.add_marker(pytest.mark.xdist_group(item.path.stem))
