"""Parts of the pages: sentences, tables, commands to copy. Every text is plain text, never HTML."""

import contextlib
import re
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final, TypeVar

from nicegui import background_tasks, events, ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement
from nicegui.elements.mixins.validation_element import ValidationElement

from rtec.errors import RtecError
from rtec.studio.parts.session import TabSession
from rtec.tasks.jobs import fault
from rtec.text import clean_lines

if TYPE_CHECKING:
    from rtec.report.page import Section, Table

SENT_S: Final = 0.05
POINTS_OF_THOUSANDS = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*|[+-]?\d{1,3}(\.\d{3}){2,}")
COMMAS_OF_THOUSANDS = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*|[+-]?\d{1,3}(,\d{3}){2,}")


class Words(TextElement):
    """An HTML element with a plain text."""

    def __init__(self, tag: str, text: str, kind: str = "") -> None:
        super().__init__(tag=tag, text=clean_lines(text))
        if kind:
            self.classes(kind)


def number(text: str) -> float:
    """Read a number in German or English notation: 12,5 and 12.5, 1.234,5 and 1,234.5.

    A single mark is the decimal one.

    Raises:
        RtecError: the text is no number.
    """
    plain = re.sub(r"[\s\u00a0\u202f']", "", text).replace("−", "-")
    if POINTS_OF_THOUSANDS.fullmatch(plain):
        plain = plain.replace(".", "").replace(",", ".")
    elif COMMAS_OF_THOUSANDS.fullmatch(plain):
        plain = plain.replace(",", "")
    else:
        plain = plain.replace(",", ".")
    if not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", plain):
        raise RtecError(f"{text!r} is no number, for example 12.5 or 12,5")
    return float(plain)


def from_home(path: str) -> str:
    """A path with `~` for the user's home folder, if it is in that."""
    with contextlib.suppress(ValueError, RuntimeError):
        return str("~" / Path(path).relative_to(Path.home()))
    return path


MOST_COLUMNS = 4
"""Of more columns, a table on a telephone has a line for each cell."""


class Area:
    """A part of a page that is rebuilt alone, so that the rest keeps its position, its texts and the focus.

    Args:
        build: adds its content.
    """

    def __init__(self, build: Callable[[], None]) -> None:
        self._build, self._box = build, ui.element("div").classes("area")
        with self._box:
            build()

    @property
    def is_gone(self) -> bool:
        """Whether its page is no longer shown."""
        return self._box.is_deleted

    def redo(self) -> None:
        """Rebuild the content."""
        if not self._box.is_deleted:
            self._box.clear()
            with self._box:
                self._build()


def draft(session: TabSession, key: str, label: str, value: str = "", placeholder: str = "") -> ui.input:
    """A text field whose text the session keeps for later visits of the page.

    Args:
        session: keeps the text.
        key: key of the text in the session.
        label: label of the field.
        value: initial text.
        placeholder: an example.
    """

    def keep(event: events.ValueChangeEventArguments[str | None]) -> None:
        session.drafts[key] = event.value or ""

    made = ui.input(label, value=session.drafts.get(key, value), placeholder=placeholder, on_change=keep)
    return at_fault(session, key, made.props("outlined"))


Field = TypeVar("Field", bound=ValidationElement[Any])


def at_fault(session: TabSession, key: str, field: Field) -> Field:
    """The field, with the reason of the last failure if it belongs to this field."""
    if message := session.trouble_at(key):
        field.error = clean_lines(message)
        field.classes("at-fault")
    return field


def heading(text: str, session: TabSession | None = None, part: str = "") -> None:
    """The heading of the page.

    Args:
        text: the heading.
        session: the tab, for a button beside the heading that leads to the report; None: without it.
        part: the part of the report that shows what this page shows.
    """
    with ui.element("div").classes("row head"):
        Words("h1", text)
        if session is not None:
            report = button("Report", lambda: _go_to_report(session, part))
            label(report, f"Report of the page {text}")


def _go_to_report(session: TabSession, part: str) -> None:
    session.reported = frozenset({part})
    session.go("report")


def trouble(session: TabSession, place: str) -> None:
    """Show the reason of the last failure if it belongs to this place of the page."""
    if message := session.trouble_at(place):
        with ui.element("div").classes("card bad at-fault").props('role="alert"'):
            Words("p", message, "trouble")


def waiting(session: TabSession, sentence: str, begin: Callable[[TabSession], Awaitable[Any]]) -> None:
    """Begin a job, and show a sentence until it ends; after a failure a button begins it again.

    Args:
        session: the tab.
        sentence: description of the job.
        begin: begins the job.
    """
    if session.trouble:
        with ui.element("div").classes("row"):
            button("Try again", lambda: begin(session), main=True)
        return
    Words("p", sentence, "lead")
    if session.job is None:
        soon(lambda: _or_say_why(session, begin))


async def _or_say_why(session: TabSession, begin: Callable[[TabSession], Awaitable[Any]]) -> None:
    """Begin a job; on any failure the page shows the reason: otherwise it would wait for ever."""
    try:
        await begin(session)
    except Exception as e:  # noqa: BLE001 - see above
        session.fail(str(e) if isinstance(e, RtecError) else fault(e))
        session.on_change()


def soon(begin: Callable[[], Awaitable[Any]]) -> None:
    """Begin a job after the page is sent. It continues even if its part of the page is removed."""

    def start() -> None:
        background_tasks.create(begin(), name="begun by a page")

    ui.timer(SENT_S, start, once=True)


def lacking(session: TabSession) -> bool:
    """Show what the page lacks (measurements, machine, model); gives whether it lacks something."""
    if not session.lacks:
        return False
    with ui.element("div").classes("card"):
        Words("p", session.lacks, "lead")
        button("Measurements", lambda: session.go("measurements"), main=True)
    return True


def button(text: str, action: Callable[[], Any], *, main: bool = False, off: str = "", bad: bool = False) -> ui.button:
    """A button.

    Args:
        text: its label.
        action: called on a click.
        main: whether it is the suggested next step.
        off: why it is disabled; empty where it is enabled.
        bad: whether it removes something.
    """
    made = ui.button(text, on_click=action, color=None).props("no-caps unelevated")
    made.classes("main" if main else "plain bad" if bad else "plain")
    if off:
        made.disable()
        made.tooltip(clean_lines(off))
    return made


def label(element: Element, text: str) -> Element:
    """Name an element for people who cannot see it."""
    element.props["aria-label"] = clean_lines(text)
    return element


def tiles(numbers: Sequence[tuple[str, str]]) -> None:
    """Big numbers, each with its meaning."""
    if not numbers:
        return
    with ui.element("div").classes("tiles"):
        for value, meaning in numbers:
            with ui.element("div").classes("tile"):
                Words("b", value)
                Words("span", meaning)


def table(content: "Table") -> None:
    """A table of texts."""
    kind = "plain stacks" if len(content.head) > MOST_COLUMNS else "plain"
    with ui.element("div").classes("scroll"), ui.element("table").classes(kind):
        if content.caption:
            Words("caption", content.caption, "small").style("caption-side: bottom; text-align: left")
        with ui.element("thead"), ui.element("tr"):
            for k, name in enumerate(content.head):
                Words("th", name, "words" if k in content.words else "").props("scope=col")
        with ui.element("tbody"):
            for row in content.rows:
                with ui.element("tr"):
                    for k, cell in enumerate(row):
                        made = Words("td", cell, "words" if k in content.words else "")
                        made.props["data-label"] = clean_lines(content.head[k])


def section(content: "Section", *, opened: bool = False) -> None:
    """A section of a report, folded unless `opened`."""
    if content.table is None and not content.text:
        return
    with ui.element("details").classes("card").props("open" if opened else ""):
        Words("summary", content.heading)
        for sentence in content.text:
            if sentence.startswith("rtec "):
                command(sentence)
            else:
                Words("p", sentence)
        if content.table is not None:
            table(content.table)


class Named(str):
    """Name of a file in a command."""

    __slots__ = ()


def shell(words: Sequence[str]) -> str:
    """A command of a shell. A file of the folder whose name begins with a dash is no option.

    Args:
        words: the command, its options and files; files are `Named`.
    """
    return " ".join(quote(f"./{w}" if isinstance(w, Named) and w.startswith("-") else w) for w in words)


def command(text: str, label: str = "") -> None:
    """A command that can be copied."""
    if label:
        Words("p", label, "small")
    with ui.element("div").classes("row"):
        Words("div", text, "command").props('tabindex=0 aria-label="command"')
        button("Copy", lambda: ui.clipboard.write(text))
