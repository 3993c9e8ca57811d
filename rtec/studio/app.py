"""The application with the pages: one process for all tabs, one session a tab, with one page at a time."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import import_module, resources
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Final

from fastapi import FastAPI
from nicegui import Client, events, ui
from nicegui import app as pages_app

from rtec.studio import jobs
from rtec.studio.address import BESIDE, PAGES
from rtec.studio.folder import Folder
from rtec.studio.jobs import Job
from rtec.studio.parts import Words, button, from_home, trouble
from rtec.studio.session import TabSession
from rtec.text import clean, clean_lines
from rtec.wording import counted

if TYPE_CHECKING:
    from rtec.control.messages import Role
    from rtec.studio.live import LiveLink

MOST_TABS: Final = 32
WARM_UP_S: Final = 0.5
"""Time after a page is sent in which the server leaves the processor to the browser, s."""
MODULES: Final = {"import": "importing"}
STYLE: Final = resources.files("rtec.studio").joinpath("studio.css")


class Studio:
    """All tabs of one start.

    Args:
        folder: the opened folder.
        live: connection to a daemon, or None.
    """

    def __init__(self, folder: Folder, live: "LiveLink | None") -> None:
        self._folder, self._live = folder, live
        self._sessions: dict[str, TabSession] = {}

    async def page(self, name: str = "") -> None:
        """One page of one tab."""
        if name not in (*PAGES, *BESIDE):
            name = "live" if self._live is not None else "measurements"
        ui.add_css(STYLE.read_text(encoding="utf-8"))
        dark = ui.dark_mode(None)
        shell = ui.element("div").classes("shell")
        client = ui.context.client
        loading = asyncio.create_task(asyncio.to_thread(_module, name))
        # The first page of a start is sent with the answer. Later ones wait for the tab's identity, as it may
        # have a session; the server loads meanwhile what the page needs.
        first = not self._sessions
        tab = None if first else await _tab(client)
        await loading
        if tab is None and not first:
            return
        session = TabSession(self._folder, live=self._live) if tab is None else self._session(tab)
        session.look()
        with shell:
            _Frame(session, name, dark)
            ui.timer(WARM_UP_S, _warm_up, once=True)
        if first and (tab := await _tab(client)) is not None:
            self._sessions.setdefault(tab, session)

    def _session(self, tab: str) -> TabSession:
        """The session of a tab; the same one after a reload."""
        if tab not in self._sessions:
            while len(self._sessions) >= MOST_TABS:
                oldest = self._sessions.pop(next(iter(self._sessions)))
                if oldest.job is not None:
                    oldest.job.cancel()
            self._sessions[tab] = TabSession(self._folder, live=self._live)
        return self._sessions[tab]


async def _tab(client: Client) -> str | None:
    """Identity of the tab that shows a page; None if the page is closed first."""
    while client.tab_id is None and not client.is_deleted:
        await client.connected()
    return client.tab_id


class _Frame:
    """Frame of a page: names at the top, progress below them, the list of pages at the side."""

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
        self._job: Job | None = None
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
        self._session.fail("")
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
        with self._client:
            self._main.clear()
            with self._main:
                _module(self._name).build(self._session)
                self._show_trouble()

    def _show_trouble(self) -> None:
        """Show why a job failed at the head of the page, unless the error belongs to a place or field."""
        s = self._session
        if not s.trouble:
            return
        if not any("at-fault" in e.classes for e in self._main.descendants()):
            with ui.element("div") as head:
                trouble(s, s.beside)
            head.move(target_index=1)
        ui.run_javascript("document.querySelector('.at-fault').scrollIntoView({block: 'nearest'})")

    def _show_names(self) -> None:
        s = self._session
        names = [from_home(str(s.folder.root)), s.machine, s.model, counted(len(s.chosen), "measurement")]
        self._what.set_text(clean(" · ".join(n for n in names if n)))

    def _show_progress(self) -> None:
        if self._client.is_deleted:
            return
        job = self._session.job
        if job is None or job is not self._job:
            self._job = job
            self._progress.clear()
            with self._progress:
                self._build_progress(job)
        if job is not None:  # the button stays during the job: a click may take longer than a stage
            share = f'value="{job.done}" max="{job.total}"'
            self._bar.props(share) if job.total > 1 else self._bar.props(remove="value max")
            self._doing.set_text(clean_lines(job.what))

    def _build_progress(self, job: Job | None) -> None:
        if job is None:
            Words("span", "Ready.", "small")
            return
        Words("b", f"{clean(job.title)}:")
        self._bar = ui.element("progress").props('aria-label="progress"')
        self._doing = Words("span", "")
        button("Cancel", job.cancel, bad=True)


def made(folder: Path, attach: Path | None, role: "Role") -> FastAPI:
    """Make the application with the pages.

    Args:
        folder: the opened folder.
        attach: run file of a daemon to connect to, or None.
        role: rights of the pages on it.
    """
    link = None
    if attach is not None:
        from rtec.studio.live import LiveLink

        link = LiveLink(attach, role)

    @asynccontextmanager
    async def follow(_: FastAPI) -> AsyncIterator[None]:
        following = asyncio.create_task(link.follow()) if link is not None else None
        yield
        if following is not None:
            following.cancel()

    studio = Studio(Folder(folder), link)
    outer = FastAPI(openapi_url=None, lifespan=follow)
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
    return outer


FAVICON: Final = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 32 32"><rect width="32" height="32" rx="6" fill="#0072b2"/>'
    '<path d="M5 8h8v7h7v6h7" fill="none" stroke="#fff" stroke-width="4"/></svg>'
)


async def _warm_up() -> None:
    """Load the modules of jobs and of the other pages, so that nobody waits for them later."""
    jobs.warm_up()
    for name in PAGES:
        await asyncio.to_thread(_module, name)


def _module(name: str) -> ModuleType:
    """The module of a page, loaded at its first use."""
    return import_module(f"rtec.studio.pages.{MODULES.get(name, name)}")
