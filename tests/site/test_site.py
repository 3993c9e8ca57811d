"""The documentation's site: whole, and without any address outside of it.

Oracles: Zensical's strict build, which refuses a link that leads nowhere; the built files, read as text.
"""

import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest

import rtec
from tests.site.build import ROOT, SECTIONS, build

FETCHED = {"src", "srcset", "data", "poster", "action"}
LAZY = ("mermaid", "glightbox", "pyodide", 'data-md-component="source"', "ace-editor")
"""Words in a page for which the theme's script would fetch a program from a network."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "docs"
    build(folder)
    return folder


class Addresses(HTMLParser):
    """Everything that a browser fetches by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [v or "" for k, v in attrs if k in FETCHED or (tag == "link" and k == "href")]


def outside(addresses: list[str]) -> list[str]:
    return [a for a in addresses if re.match(r"(\w+:)?//", a)]


def texts(site: Path, ending: str) -> Iterator[tuple[Path, str]]:
    found = sorted(site.rglob(f"*{ending}"))
    assert found
    return ((path, path.read_text(encoding="utf-8")) for path in found)


def test_no_page_fetches_anything_from_outside(site: Path) -> None:
    """Oracle: the tags of every page, and the addresses in the style sheets."""
    for path, text in texts(site, ".html"):
        seen = Addresses()
        seen.feed(text)
        assert seen.found
        assert not outside(seen.found), path.name
        assert not [word for word in LAZY if word in text], path.name
        assert "fonts.g" not in text
    for path, text in texts(site, ".css"):
        assert not outside(re.findall(r"url\(['\"]?([^)'\"]+)", text)), path.name
        assert "@import" not in text


def test_every_page_and_figure_is_there(site: Path) -> None:
    """Oracle: the sections; every figure that a page shows."""
    for name in (n for names in SECTIONS.values() for n in names):
        page = site / (name.replace("README", "index").removesuffix(".md") + ".html")
        assert page.is_file(), name
        shown = re.findall(r'<img[^>]*src="([^"]+)"', page.read_text(encoding="utf-8"))
        assert all((page.parent / figure).is_file() for figure in shown), name


def test_a_notebook_is_a_page_with_its_tables_and_figures(site: Path) -> None:
    """Oracle: the notebook itself: its first heading, the code and the outputs, by their kinds."""
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        outputs = [o.get("data", {}) for c in cells for o in c.get("outputs", ())]
        page = (site / "notebooks" / f"{path.stem}.html").read_text(encoding="utf-8")
        assert page.count('<img alt="figure of the cell above"') == sum("image/png" in o for o in outputs)
        tables = sum("text/html" in o and "image/png" not in o for o in outputs)
        assert page.count("<table") == tables, path.stem
        assert page.count('class="language-python highlight"') == sum(c["cell_type"] == "code" for c in cells)
        assert (site / "notebooks" / path.name).read_bytes() == path.read_bytes()


def test_the_api_has_every_function(site: Path) -> None:
    """Oracle: the list of `import rtec`."""
    text = (site / "reference" / "api.html").read_text(encoding="utf-8")
    for name in set(rtec.__all__) - {"__version__", "RtecError"}:
        assert f"<code>rtec.{name}</code>" in text, name
