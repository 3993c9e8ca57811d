"""The map in `docs/architecture.md` against the tree.

Oracle: the modules and folders themselves, and Python's own import machinery.
"""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
WALKS = re.findall(r"^\| `([\w.]+)` \|", PAGE, flags=re.MULTILINE)


@pytest.mark.parametrize("module", sorted(set(WALKS)))
def test_every_module_of_the_walks_exists(module: str) -> None:
    """And says in its first line what it is for."""
    assert importlib.import_module(module).__doc__


def test_every_package_is_on_the_map() -> None:
    """Folders of rtec and of the drivers, by their names in the picture."""
    folders = [p.parent for top in ("rtec", "drivers/rtec_drivers") for p in (ROOT / top).glob("*/__init__.py")]
    picture = PAGE.split("## The folders")[1].split("## A count")[0]
    missing = [folder.name for folder in folders if not re.search(rf"\b{folder.name}\b", picture)]
    assert folders
    assert missing == []


def test_each_module_is_visited_once_but_the_driver() -> None:
    """Forward only: the count goes back to the device that it came from, and to no other room twice."""
    twice = {module for module in WALKS if WALKS.count(module) > 1}
    assert twice == {"rtec_drivers.box.driver"}
