"""The application with the pages: one process for all tabs, one session a tab, with one page at a time."""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import import_module, resources
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Final

from fastapi import FastAPI
from nicegui import Client, background_tasks, events, ui
from nicegui import app as pages_app

from rtec.studio.parts.controls import Words, button, from_home, trouble
from rtec.studio.parts.session import TabSession
from rtec.studio.server.address import BESIDE, PAGES
from rtec.tasks import jobs
from rtec.tasks.folder import Folder
from rtec.tasks.jobs import Job
from rtec.text import clean, clean_lines
from rtec.wording import counted

if TYPE_CHECKING:
    from rtec.control.messages import Role
    from rtec.tasks.daemon import LiveLink

MOST_TABS: Final = 32
WARM_UP_S: Final = 0.5
"""Time after a page is sent in which the server leaves the processor to the browser, s."""
MODULES: Final = {"import": "importing"}
STEP_PAGES: Final = ("compare", "diagnose", "add", "explore", "report")
"""Pages on what was made from the chosen files."""
WENT: Final = "went"
"""Event of a browser that went back or forward, with the path."""
TELL_OF_BACK: Final = f'window.addEventListener("popstate", () => emitEvent("{WENT}", location.pathname))'
LOAD_PLOTS: Final = '(window.requestIdleCallback ?? setTimeout)(() => import("nicegui-plotly"))'
"""Loads what draws the plots while the browser has nothing else to do: it takes about a second on a slow computer."""
STYLE: Final = resources.files("rtec.studio.parts").joinpath("studio.css")


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
        name = named(name, self._live is not None)
        ui.add_css(STYLE.read_text(encoding="utf-8"))
        ui.add_body_html(f"<script>{TELL_OF_BACK}</script>")
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
            _Frame(session, name)
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


def named(name: str, live: bool) -> str:
    """Name of the page of an address; the first page where the address names none.

    Args:
        name: path of the address, without slashes.
        live: whether a daemon is attached.
    """
    if name in (*PAGES, *BESIDE):
        return name
    return "live" if live else "measurements"


async def _tab(client: Client) -> str | None:
    """Identity of the tab that shows a page; None if the page is closed first."""
    while client.tab_id is None and not client.is_deleted:
        await client.connected()
    return client.tab_id


THEMES: Final = {
    "auto": ("Theme: as the system", "'auto'", "light dark"),
    "light": ("Light", "false", "light"),
    "dark": ("Dark", "true", "dark"),
}
"""Words, value for Quasar, and scheme for the browser's own bars and fields."""


class _Frame:
    """Frame of a page: names at the top, progress below them, the list of pages at the side."""

    def __init__(self, session: TabSession, name: str) -> None:
        self._session, self._name = session, name
        self._client = ui.context.client
        with ui.element("header").classes("top"):
            Words("span", "rtec studio", "brand")
            self._what = Words("span", "", "what")
            ui.select({k: words for k, (words, *_) in THEMES.items()}, value="auto", on_change=self._theme).props(
                'dense outlined options-dense aria-label="Theme"'
            )
        self._progress = ui.element("div").classes("progress").props('role="status" aria-live="polite"')
        self._job: Job | None = None
        self._links: dict[str, ui.element] = {}
        with ui.element("nav").classes("side").props('aria-label="Pages"'):
            for key, title in PAGES.items():
                link = Words("a", title).props(f'href="/{key}"')
                link.on("click.prevent", lambda key=key: self._follow_list(key))
                self._links[key] = link
        self._main = ui.element("div").classes("page")
        session.on_progress, session.on_change, session.go = self._show_progress, self._build, self.go
        session.on_names = self._show_names
        ui.on(WENT, lambda event: self._follow(str(event.args)))
        self._build()
        self._show_progress()

    def go(self, name: str) -> None:
        """Show another page."""
        with self._client:
            ui.navigate.history.push(f"/{name}")
            ui.run_javascript("window.scrollTo(0, 0)")
        self._show(name)

    def _follow_list(self, name: str) -> None:
        """Show a page of the list; the page Report then offers all that there is."""
        self._session.reported = None
        self.go(name)

    def _follow(self, path: str) -> None:
        """Show the page of an address to which the browser went back or forward."""
        self._show(named(path.strip("/"), self._session.live is not None))

    def _show(self, name: str) -> None:
        self._name = name
        self._session.fail("")
        if name == "measurements":
            self._session.look()  # the folder may have changed since the tab was opened
        else:
            self._session.look_at_chosen()
        if _is_loaded(name):
            self._build()
        else:
            background_tasks.create(self._load_and_build(name), name=f"page {name}")

    async def _load_and_build(self, name: str) -> None:
        """Show a page whose module is not loaded yet; the server answers meanwhile."""
        await asyncio.to_thread(_module, name)
        if self._name == name:
            self._build()

    def _theme(self, event: events.ValueChangeEventArguments[str]) -> None:
        # Not by `ui.dark_mode`: at each change of a page it sets the theme again, and all styles are computed again.
        _, dark, scheme = THEMES[event.value]
        ui.run_javascript(f"Quasar.Dark.set({dark}); document.documentElement.style.colorScheme = '{scheme}'")

    def _build(self) -> None:
        if self._client.is_deleted:
            return
        self._show_names()
        for key, link in self._links.items():
            here = key == self._name
            marked = here or (key == "measurements" and self._name in BESIDE)
            link.classes(add="here" if marked else "", remove="" if marked else "here")
            link.props('aria-current="page"' if here else "", remove="" if here else "aria-current")
        with self._client:
            self._main.clear()
            with self._main:
                _module(self._name).build(self._session)
                self._show_outdated()
                self._show_trouble()

    def _show_outdated(self) -> None:
        """Show at the head of a page which files were changed since it was made from them."""
        s = self._session
        names = s.outdated if self._name in STEP_PAGES else ()
        if not names:
            return
        with ui.element("div").classes("card bad").props('role="alert"') as head:
            were = "was" if len(names) == 1 else "were"
            Words("p", f"{', '.join(names)} {were} changed by another program. This page shows what was made before.")
            with ui.element("div").classes("row"):
                button("Begin again with the changed files", self._begin_again)
            if s.at > 0 and s.at not in s.saved:
                Words("p", "What was added is put aside then; the page Measurements brings it back.", "small")
        head.move(target_index=1)

    def _begin_again(self) -> None:
        self._session.choose()
        self._build()

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
        from rtec.tasks.daemon import LiveLink

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
    """Load the modules of jobs, of the other pages, and of the plots, so that nobody waits for them later."""
    client = ui.context.client
    jobs.warm_up()
    for name in PAGES:
        await asyncio.to_thread(_module, name)
    if not client.is_deleted:
        client.run_javascript(LOAD_PLOTS)


def _module(name: str) -> ModuleType:
    """The module of a page, loaded at its first use."""
    return import_module(_module_name(name))


def _module_name(name: str) -> str:
    return f"rtec.studio.pages.{MODULES.get(name, name)}"


def _is_loaded(name: str) -> bool:
    """Whether the module of a page was executed to its end: another thread may be loading it."""
    spec = getattr(sys.modules.get(_module_name(name)), "__spec__", None)
    return spec is not None and not getattr(spec, "_initializing", False)
