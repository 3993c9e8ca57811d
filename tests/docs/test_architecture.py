"""The map in `docs/architecture.md` against the tree.

Oracle: the modules and folders themselves, and Python's own import machinery.
"""

import ast
import importlib
import re
from collections import Counter
from graphlib import TopologicalSorter
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
    """Folders of rtec and of the drivers by their names in the picture, each where a line or a column begins."""
    picture = PAGE.split("## The folders")[1].split("## A count")[0]
    rooms = set(re.findall(r"(?:^ |│ )([a-z]+)", picture, re.MULTILINE))
    (drivers,) = re.findall(r"^ drivers/rtec_drivers +(.*):", picture, re.MULTILINE)
    folders = {p.parent.name for p in (ROOT / "rtec").glob("*/__init__.py")}
    assert folders
    assert folders - rooms == set()
    assert {p.parent.name for p in (ROOT / "drivers/rtec_drivers").glob("*/__init__.py")} == set(drivers.split())
    modules = {p.stem for p in (ROOT / "rtec").glob("*.py")} - {"__init__", "__main__"} - rooms
    assert modules <= set(picture.split())


def test_each_module_is_visited_once_but_the_driver() -> None:
    """Forward only: the count goes back to the device that it came from, and to no other room twice."""
    twice = {module for module in WALKS if WALKS.count(module) > 1}
    assert twice == {"rtec_drivers.box.driver"}


@pytest.fixture(scope="module")
def modules() -> dict[str, ast.Module]:
    """The source of every module by its name."""
    return {
        ".".join(path.relative_to(ROOT / top).with_suffix("").parts): ast.parse(path.read_text(encoding="utf-8"))
        for top in (".", "drivers")
        for path in sorted((ROOT / top).glob("rtec*/**/*.py"))
    }


def imported(tree: ast.Module) -> set[str]:
    """What a module imports, anywhere in it, for types too."""
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    return {name for node in froms for a in node.names for name in (f"{node.module}.{a.name}", str(node.module))}


def test_no_modules_import_each_other_in_a_circle(modules: dict[str, ast.Module]) -> None:
    """Imports for types count. Oracle: a topological order, which no circle has."""
    imports = {name: imported(tree) & modules.keys() - {name} for name, tree in modules.items()}
    assert len(list(TopologicalSorter(imports).static_order())) == len(modules) > 200


def test_each_public_class_name_is_used_once(modules: dict[str, ast.Module]) -> None:
    """A name that two classes have says of neither what it is."""
    names = [n.name for tree in modules.values() for n in tree.body if isinstance(n, ast.ClassDef)]
    assert len(names) > 400
    assert [name for name, times in Counter(names).items() if times > 1 and not name.startswith("_")] == []
