"""Every page has its place in the site. Oracle: the folder `docs` itself."""

from collections import Counter

from tests.site.build import BESIDE, ROOT, SECTIONS, decisions, pages


def test_every_page_is_in_one_section() -> None:
    """A new page: add it to `SECTIONS` in tests/site/build.py."""
    listed = Counter(name for names in SECTIONS.values() for name in names)
    assert max(listed.values()) == 1
    there = {str(p.relative_to(ROOT / "docs")) for p in pages()} - {f"adr/{p.name}" for p in decisions()}
    there |= {f"notebooks/{p.stem}.md" for p in (ROOT / "docs" / "notebooks").glob("*.ipynb")}
    assert set(listed) == there | {"reference/api.md"} | set(BESIDE.values()) - {"index.md"}
