"""What the server sends while the pages are still being loaded. Oracle: ASGI's order of messages, NiceGUI's files."""

import asyncio
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

nicegui = pytest.importorskip("nicegui")

from rtec.studio.server.front import FILES, Front  # noqa: E402 - needs NiceGUI

STATIC = Path(nicegui.__file__).parent / "static"


class _Pages:
    """An application whose only page is one word."""

    def __init__(self) -> None:
        self.life: list[str] = []
        self.router = SimpleNamespace(lifespan_context=self._lifespan)

    @asynccontextmanager
    async def _lifespan(self, app: Any) -> AsyncIterator[None]:
        assert app is self
        self.life.append("began")
        yield
        self.life.append("ended")

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        del scope, receive
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/html")]})
        await send({"type": "http.response.body", "body": b"page"})


class _Life:
    """The server's side of a life: begun at once, ended when `over` is set."""

    def __init__(self) -> None:
        self.over = asyncio.Event()
        self.sent: list[str] = []
        self._received = 0

    async def receive(self) -> dict[str, str]:
        self._received += 1
        if self._received > 1:
            await self.over.wait()
        return {"type": "lifespan.startup" if self._received == 1 else "lifespan.shutdown"}

    async def send(self, message: Any) -> None:
        self.sent.append(message["type"])


async def _asked(front: Front, path: str, kind: str = "http", sent: list[Any] | None = None) -> list[Any]:
    answer: list[Any] = [] if sent is None else sent

    async def send(message: Any) -> None:
        answer.append(message)

    async def receive() -> dict[str, Any]:
        return {"type": "http.request"}

    await front({"type": kind, "method": "GET", "path": path}, receive, send)
    return answer


async def _turns() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


def test_a_page_is_begun_before_it_can_be_made() -> None:
    """Its head names the files, which are sent; its body follows once the application is there. That ends in order."""
    pages, loaded, failed = _Pages(), threading.Event(), list[str]()

    def load() -> Any:
        assert loaded.wait(60)
        return pages

    async def story() -> None:
        front, life = Front(load, lambda: failed.append("failed")), _Life()
        living = asyncio.create_task(front({"type": "lifespan"}, life.receive, life.send))
        await _turns()
        assert life.sent == ["lifespan.startup.complete"]
        page: list[Any] = []
        other: list[Any] = []
        asking = [
            asyncio.create_task(_asked(front, "/compare", sent=page)),
            asyncio.create_task(_asked(front, "/some/thing", sent=other)),
        ]
        await _turns()
        assert ([m["type"] for m in page], other) == (["http.response.start"], [])
        links = dict(page[0]["headers"])[b"link"].decode()
        paths = [link.partition(">")[0].removeprefix("<") for link in links.split(", ")]
        assert [path.partition("/static/")[2] for path in paths] == list(FILES)
        for path, name in zip(paths, FILES, strict=True):
            (start, body) = await _asked(front, path)
            assert (start["status"], body["body"]) == (200, (STATIC / name).read_bytes())
        loaded.set()
        await asyncio.gather(*asking)
        assert [m["type"] for m in page] == ["http.response.start", "http.response.body"]
        assert page[1]["body"] == b"page"
        assert [m["type"] for m in other] == ["http.response.start", "http.response.body"]
        assert [m["type"] for m in await _asked(front, "/")] == ["http.response.start", "http.response.body"]
        assert pages.life == ["began"]
        life.over.set()
        await living
        assert (pages.life, life.sent[-1]) == (["began", "ended"], "lifespan.shutdown.complete")

    asyncio.run(story())
    assert failed == []


def test_pages_that_cannot_be_loaded_end_the_server_and_whoever_waits() -> None:
    """Oracle: the exception itself."""
    failed: list[str] = []

    def load() -> Any:
        raise ImportError("no such package")

    async def story() -> None:
        front, life = Front(load, lambda: failed.append("failed")), _Life()
        life.over.set()
        asking = asyncio.create_task(_asked(front, "/"))
        await front({"type": "lifespan"}, life.receive, life.send)
        with pytest.raises(RuntimeError, match="could not be loaded"):
            await asking
        assert isinstance(front.failure, ImportError)

    asyncio.run(story())
    assert failed == ["failed"]
