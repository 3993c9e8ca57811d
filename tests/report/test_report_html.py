"""The HTML page. Oracle: the standard library's HTML parser reads back the texts that were put in."""

from html.parser import HTMLParser

from rtec.report.page import Page, Section, Table, render

HOSTILE = '<script>alert("1 < 2 & 3")</script>'


class _Read(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        del attrs
        self.tags.add(tag)

    def handle_data(self, data: str) -> None:
        self.texts.append(data.strip())


def test_every_text_is_text() -> None:
    """A name from a file (a machine, a sensor) may hold anything; it is shown, never taken for HTML."""
    table = Table((HOSTILE, "b"), ((HOSTILE, "2"),), HOSTILE)
    page = Page(HOSTILE, HOSTILE, ((HOSTILE, HOSTILE),), (Section(HOSTILE, (HOSTILE,), table),), (HOSTILE,))
    read = _Read()
    read.feed(render(page))
    assert "script" not in read.tags
    assert read.texts.count(HOSTILE) >= 10
