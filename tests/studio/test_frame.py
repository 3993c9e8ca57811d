"""What is around a page and what a page waits for, without a browser. Oracles: the elements that the server keeps."""

import asyncio
import shutil
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from nicegui import Client, events, ui
from starlette.requests import Request

from rtec.errors import RtecError
from rtec.studio.pages import importing, measurements
from rtec.studio.parts.controls import waiting
from rtec.studio.parts.session import ForeignFile, TabSession
from rtec.studio.server.app import Studio, _Frame
from rtec.tasks import foreign
from rtec.tasks.folder import Folder
from rtec.tasks.jobs import Job

pytestmark = pytest.mark.xdist_group("others")


@pytest.fixture
def session(tmp_path: Path) -> Iterator[TabSession]:
    """A tab that shows the page Import."""
    client = Client(ui.page("/"))
    made = TabSession(Folder(tmp_path))
    with client:
        _Frame(made, "import")
        yield made
    client.delete()


def _texts() -> list[str]:
    return [e.text for e in ui.context.client.elements.values() if hasattr(e, "text")]


def test_the_button_that_cancels_stays_while_the_work_goes_on(session: TabSession) -> None:
    """A click may take longer than a stage: its button must not be another one when the mouse is let go."""

    def cancels() -> list[int]:
        return [e.id for e in ui.context.client.elements.values() if isinstance(e, ui.button) and e.text == "Cancel"]

    session.job = Job("Diagnosis", lambda: None)
    session.on_progress()
    (first,) = cancels()
    session.job.what, session.job.done, session.job.total = "second stage", 1, 2
    session.on_progress()
    assert cancels() == [first]
    assert "second stage" in _texts()
    session.job = None
    session.on_progress()
    assert cancels() == []


@pytest.mark.parametrize("others", [0, 1])
def test_a_page_that_no_tab_ever_shows_keeps_no_session(tmp_path: Path, others: int) -> None:
    """A page that is fetched and closed before it connects. Oracle: the sessions of the tabs that there are."""
    studio = Studio(Folder(tmp_path), None)
    studio._sessions.update({f"tab {k}": TabSession(Folder(tmp_path)) for k in range(others)})
    before = dict(studio._sessions)
    client = Client(ui.page("/"), request=Request({"type": "http", "path": "/", "headers": []}))

    async def fetched() -> None:
        with client:
            await studio.page()

    async def closed() -> None:
        page = asyncio.create_task(fetched())
        while not client._waiting_for_connection.is_set():
            await asyncio.sleep(0)
        client.delete()
        await page

    asyncio.run(closed())
    assert studio._sessions == before
    assert not client.elements  # nor is anything made for it


@pytest.mark.parametrize(("error", "said"), [(RtecError("x.csv: leads out"), "x.csv: leads out"), (KeyError("k"), "k")])
def test_a_page_says_why_what_it_waits_for_could_not_begin(
    session: TabSession, error: Exception, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would wait for ever, and only the terminal would say why."""
    begun: list[Any] = []
    monkeypatch.setattr("rtec.studio.parts.controls.soon", begun.append)

    async def begin(_: TabSession) -> None:
        raise error

    waiting(session, "The file is being read.", begin)
    shown = []
    session.on_change = lambda: shown.append(session.trouble)
    asyncio.run(begun[0]())
    assert [said in text for text in shown] == [True]


def test_a_file_that_is_opened_while_another_is_read_is_not_taken_for_it(
    session: TabSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracle: the file that was opened last; the page is built again, so that it is read too."""
    first, second = ForeignFile("a.csv"), ForeignFile("b.csv")
    (session.folder.root / "a.csv").write_text("a;b\n1;2\n")
    session.foreign = first
    seen = foreign.ImportView(None)  # type: ignore[arg-type]

    async def work(*_: Any, **__: Any) -> foreign.ImportView:
        session.foreign = second
        return seen

    monkeypatch.setattr(session, "work", work)
    built = []
    session.on_change = lambda: built.append(session.foreign)
    asyncio.run(importing._look(session))
    assert (session.foreign, built) == (second, [second])
    session.foreign = second
    monkeypatch.setattr(session, "work", lambda *_, **__: asyncio.sleep(0, seen))
    asyncio.run(importing._look(session))
    assert session.foreign == replace(second, looked=seen)


def test_a_file_is_looked_at_again_once_its_machine_is_chosen(
    session: TabSession, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a machine no axis was looked for. Oracle: what the page asks to be read."""
    read: list[Any] = []
    monkeypatch.setattr(importing, "waiting", lambda tab, *_: read.append(tab.foreign))
    monkeypatch.setattr(importing, "_page", lambda *_: read.append("shown"))
    session.foreign = ForeignFile("a.csv", looked=foreign.ImportView(None))  # type: ignore[arg-type]
    importing.build(session)
    session.machine = "mill.toml"
    importing.build(session)
    session.foreign = ForeignFile("a.csv", looked=foreign.ImportView(None), machine="mill.toml")  # type: ignore[arg-type]
    importing.build(session)
    assert read == ["shown", ForeignFile("a.csv"), "shown"]


@pytest.mark.parametrize(
    ("typed", "given"),
    [
        ("0; 0; 150", "[0, 0, 150]"),
        ("0 0 150", "[0, 0, 150]"),
        ("0, 0, 150", "[0, 0, 150]"),
        ("0,5; 0; 150,25", "[0.5, 0, 150.25]"),
        ("[0; 0; 150]", "[0, 0, 150]"),
        ("[0, 0, 150]", "[0, 0, 150]"),
        ("12,5", "12.5"),
        ("12.5", "12.5"),
        ("1234567,25", "1234567.25"),
        ("true", "true"),
        ("0,0,150", "0,0,150"),
        ("100 200 300", "100 200 300"),
        ("head", "head"),
    ],
)
def test_answers_may_be_typed_as_people_write_numbers(typed: str, given: str) -> None:
    """What has more than one meaning stays as it is, and is refused. Oracle: TOML, which the answer is in."""
    assert importing.as_toml(typed) == given


MB = 1 << 20


@dataclass
class _Dropped:
    """A dropped file as NiceGUI gives it."""

    name: str
    path: Path

    async def save(self, path: Path) -> None:
        shutil.copyfile(self.path, path)

    async def read(self) -> bytes:
        return self.path.read_bytes()


def test_a_large_dropped_file_is_never_in_memory_as_a_whole(session: TabSession, tmp_path: Path) -> None:
    """Dropped, and dropped again, which compares it with the one that is there. Oracle: Python's count of memory."""
    session.on_change = lambda: None
    measurements._drop(session)
    (drop,) = [e for e in ui.context.client.elements.values() if isinstance(e, ui.upload)]
    most = {}
    for size in (4 * MB, 40 * MB):
        source = tmp_path.parent / f"{tmp_path.name}-{size}"
        with source.open("wb") as file:
            file.truncate(size)
        files: list[Any] = [_Dropped(f"{size}.csv", source)]
        given = events.MultiUploadEventArguments(sender=drop, client=drop.client, files=files)
        take: Any = drop._multi_upload_handlers[0]
        tracemalloc.start()
        for _ in range(2):
            asyncio.run(take(given))
        most[size] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert (session.folder.root / f"{size}.csv").stat().st_size == size
    assert session.trouble == ""
    assert most[40 * MB] < most[4 * MB] + 4 * MB
