"""The server of the pages: one process for all tabs, one session for each, one page at a time in it."""

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module, resources
from pathlib import Path
from typing import Final

import uvicorn
from fastapi import FastAPI
from nicegui import app as pages_app
from nicegui import events, ui

from rtec.errors import RtecError
from rtec.studio import jobs
from rtec.studio.folder import Folder
from rtec.studio.guard import Guard
from rtec.studio.live import LiveLink
from rtec.studio.parts import Words, button
from rtec.studio.session import TabSession
from rtec.text import clean
from rtec.wording import counted

PAGES: Final = {
    "measurements": "Measurements",
    "compare": "Compare",
    "diagnose": "Diagnose",
    "add": "Add and watch",
    "explore": "Explore",
    "live": "Live",
    "report": "Report",
}
BESIDE: Final = ("import",)
"""Pages that another page leads to."""
MOST_TABS: Final = 32
MODULES: Final = {"import": "importing"}
STYLE: Final = resources.files("rtec.studio").joinpath("studio.css")


@dataclass(frozen=True)
class Address:
    """Where the pages are served.

    Attributes:
        host, port: as asked; port 0 takes a free one.
        token: the key of this start.
        certificate, key: files for TLS; None: without.
    """

    host: str
    port: int
    token: str
    certificate: Path | None = None
    key: Path | None = None


class Studio:
    """All tabs of one start.

    Args:
        folder: that is opened.
        live: the daemon that is attached; None: none.
    """

    def __init__(self, folder: Folder, live: LiveLink | None) -> None:
        self._folder, self._live = folder, live
        self._sessions: dict[str, TabSession] = {}

    def session(self, tab: str) -> TabSession:
        """The session of a tab; its own again after a reload."""
        if tab not in self._sessions:
            while len(self._sessions) >= MOST_TABS:
                oldest = self._sessions.pop(next(iter(self._sessions)))
                if oldest.job is not None:
                    oldest.job.cancel()
            self._sessions[tab] = TabSession(self._folder, live=self._live)
        return self._sessions[tab]

    async def page(self, name: str = "") -> None:
        """One page of one tab."""
        name = name or ("live" if self._live is not None else "measurements")
        ui.add_css(STYLE.read_text(encoding="utf-8"))
        ui.colors(primary="#005a94")
        dark = ui.dark_mode(None)
        shell = ui.element("div").classes("shell")
        await ui.context.client.connected()
        session = self.session(str(ui.context.client.tab_id))
        session.look()
        with shell:
            _Frame(session, name if name in (*PAGES, *BESIDE) else "measurements", dark)


class _Frame:
    """What is around a page: names above, progress below them, the list of pages at the side."""

    def __init__(self, session: TabSession, name: str, dark: ui.dark_mode) -> None:
        self._session, self._name, self._dark = session, name, dark
        self._client = ui.context.client
        with ui.element("header").classes("top"):
            Words("span", "rtec studio", "brand")
            self._what = Words("span", "", "what")
            ui.select(
                {"auto": "Theme: as the system", "light": "Light", "dark": "Dark"}, value="auto", on_change=self._theme
            ).props('dense outlined options-dense aria-label="Theme"')
        self._progress = ui.element("div").classes("progress").props('role="status" aria-live="polite"')
        self._links: dict[str, ui.element] = {}
        with ui.element("nav").classes("side").props('aria-label="Pages"'):
            for key, title in PAGES.items():
                link = Words("a", title).props(f'href="/{key}"')
                link.on("click.prevent", lambda key=key: self.go(key))
                self._links[key] = link
        self._main = ui.element("div").classes("page")
        session.on_progress, session.on_change, session.go = self._show_progress, self._build, self.go
        session.on_names = self._show_names
        self._build()
        self._show_progress()

    def go(self, name: str) -> None:
        """Show another page."""
        self._name = name
        self._session.trouble = ""
        with self._client:
            ui.navigate.history.push(f"/{name}")
            ui.run_javascript("window.scrollTo(0, 0)")
        self._build()

    def _theme(self, event: events.ValueChangeEventArguments[str]) -> None:
        self._dark.value = {"auto": None, "light": False, "dark": True}[event.value]

    def _build(self) -> None:
        if self._client.is_deleted:
            return
        self._show_names()
        for key, link in self._links.items():
            here = key == self._name
            link.classes(add="here" if here else "", remove="" if here else "here")
            link.props('aria-current="page"' if here else "", remove="" if here else "aria-current")
        build: Callable[[TabSession], None] = import_module(
            f"rtec.studio.pages.{MODULES.get(self._name, self._name)}"
        ).build
        with self._client:
            self._main.clear()
            with self._main:
                build(self._session)

    def _show_names(self) -> None:
        s = self._session
        names = [str(s.folder.root), s.machine, s.model, counted(len(s.chosen), "measurement")]
        self._what.set_text(clean(" · ".join(n for n in names if n)))

    def _show_progress(self) -> None:
        if self._client.is_deleted:
            return
        job = self._session.job
        with self._client:
            self._progress.clear()
            with self._progress:
                if job is None:
                    Words("span", "Ready.", "small")
                    return
                Words("b", f"{clean(job.title)}:")
                share = f' value="{job.done}" max="{job.total}"' if job.total > 1 else ""
                ui.element("progress").props(f'aria-label="progress"{share}')
                Words("span", job.what)
                button("Cancel", job.cancel, bad=True)


def serve(folder: Path, address: Address, opened: Callable[[str], None], live: LiveLink | None = None) -> None:
    """Serve the pages until the process is interrupted.

    Args:
        folder: that is opened.
        address: where.
        opened: called with the whole address, key included, once the server answers.
        live: the daemon that is attached; None: none.

    Raises:
        RtecError: the folder or the address cannot be used.
    """
    if not folder.is_dir():
        raise RtecError(f"{folder}: is no folder; make it first, or name another")
    listening = _listen(address.host, address.port)
    port = int(listening.getsockname()[1])
    studio = Studio(Folder(folder), live)
    outer = FastAPI(openapi_url=None)
    ui.page("/", title="rtec studio")(studio.page)
    ui.page("/{name}", title="rtec studio")(studio.page)
    pages_app.config.quasar_config["animations"] = []
    ui.run_with(
        outer,
        title="rtec studio",
        dark=None,
        tailwind=False,
        gzip_middleware_factory=None,
        reconnect_timeout=30.0,
        show_welcome_message=False,
        binding_refresh_interval=None,
        favicon=FAVICON,
    )
    config = uvicorn.Config(
        Guard(outer, address.token, port),
        log_level="warning",
        lifespan="on",
        access_log=False,
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
    )
    scheme = "https" if address.certificate else "http"
    host = f"[{address.host}]" if ":" in address.host else address.host
    server = _Server(config, lambda: opened(f"{scheme}://{host}:{port}/?token={address.token}"))
    jobs.warm_up()

    async def both() -> None:
        following = asyncio.create_task(live.follow()) if live is not None else None
        await server.serve(sockets=[listening])
        if following is not None:
            following.cancel()

    asyncio.run(both())


FAVICON: Final = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="6" fill="#0072b2"/>'
    '<path d="M5 8h8v7h7v6h7" fill="none" stroke="#fff" stroke-width="4"/></svg>'
)


class _Server(uvicorn.Server):
    """Says when it answers."""

    def __init__(self, config: uvicorn.Config, answers: Callable[[], None]) -> None:
        super().__init__(config)
        self._answers = answers

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer."""
        await super().startup(sockets)
        if self.started:
            self._answers()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        made.bind((host, port))
    except OSError as e:
        made.close()
        raise RtecError(f"{host}:{port}: cannot be listened at: {e.strerror}; name another with --host, --port") from e
    return made
