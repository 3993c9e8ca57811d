"""The server of the pages: it answers at once, and loads the application while the browser loads.

The answer to the first page begins immediately with the names of the files that every page needs. So the browser
already has them when the page itself follows.
"""

import asyncio
import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

import uvicorn
from starlette.types import Message, Receive, Scope, Send

from rtec.studio.server.address import BESIDE, PAGES, OpenPort
from rtec.studio.server.guard import Guard

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from rtec.control.messages import Role

MODULE: Final = "script; crossorigin"
"""Attributes of requests for modules; the browser would load a file again that was requested with others."""
FILES: Final = {
    "vue.esm-browser.prod.js": MODULE,
    "quasar.umd.prod.js": "script",
    "nicegui.js": "script",
    "socket.io.min.js": "script",
    "lang/en-US.umd.prod.js": "script",
    "dompurify.mjs": MODULE,
    "fonts.css": "style",
    "quasar.unimportant.prod.css": "style",
    "quasar.important.prod.css": "style",
    "nicegui.css": "style",
}
"""Files of NiceGUI on every page, by name in its folder of static files. Missing ones are omitted."""
TYPES: Final = {".js": b"text/javascript; charset=utf-8", ".mjs": b"text/javascript; charset=utf-8",
                ".css": b"text/css; charset=utf-8"}  # fmt: skip
SWITCH_S: Final = 0.0005
"""Longest wait of an answer for the interpreter while modules are loaded, s."""


class Front:
    """Sends the files of every page; begins a page while the application is being loaded.

    Attributes:
        app: the application; None until it is loaded.
        failure: why it could not be loaded; else None.

    Args:
        load: gives the application; called in a thread when the server starts.
        failed: called if the application could not be loaded.
    """

    def __init__(self, load: "Callable[[], Starlette]", failed: Callable[[], None]) -> None:
        self.app: Starlette | None = None
        self.failure: Exception | None = None
        self._load, self._failed = load, failed
        self._loaded = asyncio.Event()
        self._files = _files()
        links = ", ".join(f"<{path}>; rel=preload; as={FILES[name]}" for path, (name, _) in self._files.items())
        self._begun = [
            (b"content-type", b"text/html; charset=utf-8"), (b"cache-control", b"no-store"), (b"link", links.encode())
        ]  # fmt: skip

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request, or the server's lifespan."""
        kind = scope["type"]
        if kind == "lifespan":
            await self._live(receive, send)
            return
        if kind == "http" and scope["path"] in self._files:
            await self._send_file(scope["path"], send)
            return
        asks = kind == "http" and scope["method"] == "GET" and scope["path"].strip("/") in ("", *PAGES, *BESIDE)
        if asks and not self._loaded.is_set():
            await send({"type": "http.response.start", "status": 200, "headers": self._begun})
            send = _without_start(send)
        await self._loaded.wait()
        if self.app is None or self.failure is not None:
            raise RuntimeError("the pages could not be loaded")
        await self.app(scope, receive, send)

    async def _live(self, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "lifespan.startup.complete"})
        try:
            with _loading():
                self.app = await asyncio.to_thread(self._load)
            async with self.app.router.lifespan_context(self.app):
                self._loaded.set()
                await receive()
        except Exception as e:  # noqa: BLE001 - `serve` raises it
            self.failure = e
            self._failed()
        self._loaded.set()
        await send({"type": "lifespan.shutdown.complete"})

    async def _send_file(self, path: str, send: Send) -> None:
        _, file = self._files[path]
        head = [(b"content-type", TYPES[file.suffix]), (b"content-length", str(file.stat().st_size).encode()),
                (b"cache-control", b"public, max-age=31536000, immutable")]  # fmt: skip
        await send({"type": "http.response.start", "status": 200, "headers": head})
        await send({"type": "http.response.body", "body": file.read_bytes()})


def serve(folder: Path, opened: OpenPort, attach: Path | None = None, role: "Role" = "read") -> None:
    """Serve the pages until the process is interrupted.

    Args:
        folder: the opened folder.
        opened: the address.
        attach: run file of a daemon to connect to, or None.
        role: rights of the pages on it.
    """

    def load() -> "Starlette":
        # Also later: FastAPI would look for models of an old form when the first page gets its place for files.
        sys.modules.setdefault("pydantic.v1", None)  # type: ignore[arg-type]
        with _without("aiohttp", "tornado", "tornado.web"), _deferred():
            from rtec.studio.server.app import made

            return made(folder, attach, role)

    def failed() -> None:
        server.should_exit = True

    front = Front(load, failed)
    address = opened.address
    config = uvicorn.Config(
        Guard(front, address.token, opened.port),
        log_level="warning",
        lifespan="on",
        access_log=False,
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
    )
    server = uvicorn.Server(config)
    asyncio.run(server.serve(sockets=[opened.socket]))
    if front.failure is not None:
        raise front.failure


def _files() -> dict[str, tuple[str, Path]]:
    """Name and path of each of `FILES`, by the path of its request."""
    found = find_spec("nicegui")
    if found is None or found.origin is None:
        return {}
    folder, prefix = Path(found.origin).parent / "static", f"/_nicegui/{version('nicegui')}/static"
    return {f"{prefix}/{name}": (name, folder / name) for name in FILES if (folder / name).is_file()}


def _without_start(send: Send) -> Send:
    """A `send` for the rest of an answer that has begun."""

    async def rest(message: Message) -> None:
        if message["type"] != "http.response.start":
            await send(message)

    return rest


@contextmanager
def _loading() -> Iterator[None]:
    """Context for loading modules in a thread: other threads run often, and garbage collection skips the modules."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
        sys.setswitchinterval(before)


@contextmanager
def _without(*names: str) -> Iterator[None]:
    """Import as if packages were not installed.

    The socket library would load a client and another server; neither is used here.
    """
    # For an import, None means that there is no such package.
    absent = [n for n in names if n not in sys.modules]
    sys.modules.update(dict.fromkeys(absent))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in absent:
            del sys.modules[name]


@contextmanager
def _deferred() -> Iterator[None]:
    """Import modules with pydantic models that are built at their first use.

    FastAPI declares the models of a whole description of the server, which is not used here.
    """
    from pydantic import BaseModel, ConfigDict

    before = BaseModel.model_config
    BaseModel.model_config = ConfigDict(defer_build=True)
    try:
        yield
    finally:
        BaseModel.model_config = before
