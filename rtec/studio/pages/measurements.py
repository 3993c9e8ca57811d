"""Measurements: drop or choose files, show their content, choose the machine and the model to compare with."""

import asyncio
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final
from weakref import proxy

from nicegui import events, ui
from nicegui.element import Element

from rtec.commission.example import SHIPPED
from rtec.errors import RtecError
from rtec.studio.parts.controls import Area, Named, Words, button, command, draft, heading, label, shell, soon, trouble
from rtec.studio.parts.session import ForeignFile, TabSession
from rtec.tasks.folder import Summary
from rtec.tasks.jobs import Job
from rtec.text import clean
from rtec.wording import counted

LARGEST_UPLOAD = 512 * 1024 * 1024
FEW = 2
"""Remarks that are not folded away."""
COLUMNS: Final = ("Use", "File", "Instrument", "Runs", "Readings", "Span", "Temperatures, remarks")
PICK: Final = """(event) => {
  const input = event.target.closest(".q-uploader").querySelector("input[type=file]");
  if (event.target !== input) input.click();  // a finger or a mouse clicks the input itself, which lies on the button
}"""


def build(session: TabSession) -> None:
    """The page."""
    heading("Measurements", session, "measurements")
    there = session.listing
    if not (there.machines or there.measurements or there.foreign):
        _empty(session)
    _drop(session)
    _unread(session)
    with ui.element("div").classes("pair"):
        _machine(session)

    with ui.element("div").classes("card"):
        Words("h2", "Measurements in the folder")
        rows = _measurements(session, lambda: model.refresh())  # noqa: PLW0108 - made below
    with ui.element("div").classes("card"):
        Words("h2", "Model")
        model = _ModelCard(session)
    soon(lambda: _look(session, rows))


def _empty(session: TabSession) -> None:
    with ui.element("div").classes("card good"):
        Words("h2", "This folder has no measurements yet")
        Words(
            "p",
            "Drop your files below. Or try it with a simulated turning centre: two laser measurements of a machine "
            "with errors that its model does not know.",
        )
        with ui.element("div").classes("row"):
            button("Try it with an example", lambda: _try_it(session), main=True)
        trouble(session, "try")


async def _try_it(session: TabSession) -> None:
    from rtec.tasks import example
    from rtec.tasks import model as model_tasks

    await session.work("Making the example", model_tasks.try_it, session.folder.root, beside="try")
    if not session.trouble:
        session.look()
        beams = tuple(f"{n}.csv" for n in example.BEAMS)
        session.choose(machine=example.MACHINE, model=example.MODEL, chosen=beams)
        session.on_change()


def _drop(of_tab: TabSession) -> None:
    session = proxy(of_tab)  # FastAPI remembers the functions of uploads for ever; the tab must not stay with them

    async def take(event: events.MultiUploadEventArguments) -> None:
        refused = []
        with TemporaryDirectory() as beside:
            for file in event.files:
                dropped = Path(beside) / "dropped"
                await file.save(dropped)
                try:
                    # In a thread: a large file takes seconds, and the pages answer meanwhile.
                    await asyncio.to_thread(session.folder.write, file.name, dropped)
                except RtecError as e:
                    refused.append(str(e))
        session.fail("\n".join(refused), "drop")
        session.look()
        session.on_change()

    def too_large() -> None:
        session.fail(f"a file has more than {LARGEST_UPLOAD >> 20} MB; copy it into the folder instead", "drop")
        session.on_change()

    # All files in one request: the page is rebuilt after it, and a second request under way would be lost.
    drop = ui.upload(
        multiple=True,
        auto_upload=True,
        max_file_size=LARGEST_UPLOAD,
        on_multi_upload=take,
        on_rejected=too_large,
    ).props('flat aria-label="Drop files"')
    _drop_header(drop)
    trouble(of_tab, "drop")


def _drop_header(drop: ui.upload) -> None:
    """What the drop zone says, and its button.

    Quasar's own header has a button whose name is that of its icon. The parts are elements of the page: a template
    would be made again at every change of the page, and the button would lose the focus of the keyboard.
    """
    with drop.add_slot("header"), ui.element("div").classes("q-uploader__header-content row no-wrap items-center"):
        text = "Drop files here, or press + to choose them: measurements, tables, machine and model files"
        Words("div", text, "col q-uploader__title")
        with label(ui.element("q-btn").props("flat dense round icon=add_box"), "Choose files").on(
            "click", js_handler=PICK
        ):
            ui.element("q-uploader-add-trigger")


def _unread(session: TabSession) -> None:
    """Files of machines, models or measurements that cannot be read, with the reason."""
    if not session.listing.unread:
        return
    with ui.element("div").classes("card bad").props('role="status"'):
        Words("h2", "Files that cannot be read")
        for _, why in session.listing.unread:
            Words("p", why)


def _import(session: TabSession, name: str) -> None:
    if session.foreign is None or session.foreign.name != name:
        session.foreign = ForeignFile(name)
    session.go("import")


async def _look(session: TabSession, shown: list[Callable[[], None]]) -> None:
    """Read what has not been read yet, and show it."""
    known = {s.file for s in session.summaries.values()}
    todo = [n for n in session.listing.measurements if n not in known]
    if not session.machine or not todo:
        return
    from rtec.tasks import model as model_tasks

    machine = session.machine
    try:
        # In parallel with other jobs, so that they do not wait for the list.
        found = await Job("Reading", lambda: None).run(
            model_tasks.summaries, session.folder.root, todo, session.machine_path
        )
    except RtecError as e:
        found = tuple(Summary(name, trouble=str(e)) for name in todo)
    if session.machine == machine:
        session.summaries |= {s.file: s for s in found}
        for show in shown:
            show()


def _measurements(session: TabSession, used: Callable[[], None]) -> list[Callable[[], None]]:
    """The list of measurements and of tables to import; gives what shows again what is known of them."""
    there = session.listing
    if not there.measurements:
        Words(
            "p", "None yet. A measurement is a table (CSV or Parquet) with a TOML of the same name beside it.", "small"
        )
    elif not session.machine:
        Words("p", "Choose the machine above; then they can be read.", "small")
    shown = [row.show for row in _list(session, used)] if there.measurements else []
    if there.foreign:
        Words("h2", "Tables of other programs")
        for name in there.foreign:
            shown.append(_Foreign(session, name).show)
    if there.more:
        Words("p", f"{counted(there.more, 'more file')} in the folder; only the first are listed.", "small")
    return shown


class _Foreign:
    """A table of another program in the list, and the measurements that were made from it."""

    def __init__(self, session: TabSession, name: str) -> None:
        self._session, self._name = session, name
        with ui.element("div").classes("row"):
            Words("span", name).style("min-width: 16rem; overflow-wrap: anywhere")
            self._button = button("Import", partial(_import, session, name))
            label(self._button, f"Import {name}")
            self._said = Words("span", "", "small")
        self.show()

    def show(self) -> None:
        """Show what was made from it."""
        if self._said.is_deleted:
            return
        note = f"imported from {self._name}"
        made = [clean(s.file) for s in self._session.summaries.values() if note in s.notes]
        self._said.set_text(f"imported as {', '.join(made)}" if made else "")
        self._button.classes(add="plain" if made else "main", remove="main" if made else "plain")


def _list(session: TabSession, used: Callable[[], None]) -> "list[_Row]":
    with ui.element("div").classes("scroll"), ui.element("table").classes("plain stacks"):
        with ui.element("thead"), ui.element("tr"):
            for name in COLUMNS:
                Words("th", name, "" if name in ("Runs", "Readings") else "words").props("scope=col")
        with ui.element("tbody"):
            return [_Row(session, name, used) for name in session.listing.measurements]


class _Row:
    """A measurement in the list. Its check box stays the same after the file is read, so that no click is lost."""

    def __init__(self, session: TabSession, name: str, used: Callable[[], None]) -> None:
        self._session, self._name, self._used = session, name, used
        self._cells: list[Element] = []
        with ui.element("tr").classes("picked" if name in session.chosen else "") as self._row:
            with ui.element("td").classes("words"):
                self._box = ui.checkbox(value=name in session.chosen, on_change=self._use)
                self._box.props["aria-label"] = f"use {clean(name)}"
            Words("td", name, "words file")
            self.show()

    def show(self) -> None:
        """Show the present knowledge about the file."""
        if self._row.is_deleted:
            return
        for cell in self._cells:
            cell.delete()
        with self._row:
            self._cells = _cells(self._session.summaries.get(self._name, Summary(self._name)), self._box)

    def _use(self, event: events.ValueChangeEventArguments[bool | None]) -> None:
        s = self._session
        chosen = {*s.chosen, self._name} if event.value else set(s.chosen) - {self._name}
        s.choose(chosen=tuple(n for n in s.listing.measurements if n in chosen))
        self._row.classes(add="picked" if event.value else "", remove="" if event.value else "picked")
        s.on_names()
        self._used()


def _cells(s: Summary, box: ui.checkbox) -> list[Element]:
    """Cells of a measurement's row; a measurement that cannot be read cannot be used."""
    if s.trouble:
        box.disable()
        return [Words("td", s.trouble, "words trouble").props("colspan=5")]
    warm = s.temperatures
    cells: list[Element] = [
        Words("td", s.read_by or "…", "words"),
        Words("td", str(s.runs) if s.rows else ""),
        Words("td", str(s.rows) if s.rows else ""),
        Words("td", "\n".join(s.spans), "words").style("white-space: pre"),
    ]
    with ui.element("td").classes("words") as remarks:
        if warm:
            with ui.element("details"):
                low, high = min(v[0] for v in s.sensors.values()), max(v[1] for v in s.sensors.values())
                Words("summary", f"{counted(len(warm), 'sensor')}, {low:.1f} to {high:.1f} °C")
                for line in warm:
                    Words("div", line, "small")
        if len(s.notes) <= FEW:
            _notes(s)
        else:
            with ui.element("details"):
                Words("summary", counted(len(s.notes), "remark"))
                _notes(s)
    cells.append(remarks)
    for cell, name in zip(cells, COLUMNS[2:], strict=True):
        cell.props["data-label"] = name
    return cells


def _notes(s: Summary) -> None:
    for note in s.notes:
        Words("div", note, "small")


def _machine(session: TabSession) -> None:
    def choose(event: events.ValueChangeEventArguments[str | None]) -> None:
        session.summaries = {}
        session.choose(machine=event.value or "")
        session.on_change()

    def take(event: events.ValueChangeEventArguments[str | None]) -> None:
        name = str(event.value)
        try:
            if name in below:
                name = session.folder.take(name)
            else:
                session.folder.write(name, (SHIPPED / "machines" / name).read_bytes())
        except RtecError as e:
            session.fail(str(e), "machine")
        session.look()
        session.machine = name if name in session.listing.machines else session.machine
        session.on_change()

    below = () if session.listing.machines else session.folder.machines_below()
    with ui.element("div").classes("card"):
        Words("h2", "Machine")
        with ui.element("div").classes("row"):
            if session.listing.machines:
                names = {n: clean(n) for n in session.listing.machines}
                made = ui.select(names, value=session.machine or None, label="Machine file", on_change=choose)
            else:
                shipped = sorted(p.name for p in (SHIPPED / "machines").glob("*.toml"))
                names = {n: f"{clean(n)}, one folder below" for n in below}
                names |= {n: f"{n}, comes with rtec" for n in shipped}
                way = "Drop one above (rtec init writes one), or take a copy of one of these:"
                Words("p", f"No machine file beside the measurements. {way}")
                made = ui.select(names, label="Machine to copy", on_change=take)
            made.props("outlined").style("min-width: min(22rem, 100%)")
        trouble(session, "machine")


class _ModelCard:
    """The model, and the form for a first one, whose fields stay while measurements are chosen."""

    def __init__(self, session: TabSession) -> None:
        self._session = session
        there = session.listing.models
        if there or session.model:
            names = {n: clean(n) for n in there}
            if session.model and session.model not in there:
                names[session.model] = f"{clean(session.model)}, deleted meanwhile; what was added to it is kept here"
            ui.select(names, value=session.model or None, label="Model file", on_change=self._choose).props("outlined")
        else:
            Words("p", "No model in the folder yet. Fit a first one:", "small")
        wrong = any(session.trouble_at(place) for place in ("fit", "fit_effects"))
        with ui.element("details").props("" if there and not wrong else "open"):
            Words("summary", "Fit a first model")
            self._name = draft(session, "fit_out", "File for the model", _free_name(session))
            self._effects = draft(
                session, "fit_effects", "Effects (empty: chosen on held-out runs)", "", "scale,backlash"
            )
            button("Fit", self._fit, main=not there)
            trouble(session, "fit")
            self._command = Area(self._show_command)
        self._next = Area(self._show_next)
        for field in (self._name, self._effects):
            field.on_value_change(self._command.redo)

    def refresh(self) -> None:
        """Update the card after other measurements were chosen."""
        self._command.redo()
        if self._shown != (self._session.lacks, self._session.aside):
            self._next.redo()  # else a click that is under way would find its button gone

    def _choose(self, event: events.ValueChangeEventArguments[str | None]) -> None:
        self._session.choose(model=event.value or "")
        self._session.on_change()

    def _show_command(self) -> None:
        s = self._session
        if not (s.machine and s.chosen):
            Words("p", "Choose the machine and at least one measurement first.", "small")
            return
        more = ["--effects", self._effects.value] if self._effects.value else []
        files = [*map(Named, (s.machine, *s.chosen)), "-o", Named(self._name.value or "model.toml")]
        command(shell(["rtec", "fit", *files, *more]), "The same on the command line:")

    def _show_next(self) -> None:
        s = self._session
        self._shown = s.lacks, s.aside
        if not s.lacks:
            button("Compare the model with the measurements", partial(s.go, "compare"), main=True)
        if s.aside:
            last = s.aside[-1]
            with ui.element("div").classes("card open").props('role="status"'):
                Words("p", f"Not saved, and put aside because other files were chosen: {last.words}, added to "
                           f"{last.model} with {', '.join(last.chosen)}.")  # fmt: skip
                button("Bring it back", self._bring_back)

    def _bring_back(self) -> None:
        self._session.bring_back()
        self._session.on_change()

    async def _fit(self) -> None:
        from rtec.tasks import model as model_tasks

        s = self._session
        if not (s.machine and s.chosen):
            s.fail("Choose the machine and at least one measurement first.", "fit")
            s.on_change()
            return
        try:
            out = _checked(s, self._name.value or "")
        except RtecError as e:
            self._name.error = str(e)
            return
        effects = (self._effects.value or "").strip()
        fields = {"--effects": "fit_effects"}
        verdict = await s.work(
            "Fitting", model_tasks.fit, s.machine_path, s.files, out, effects, beside="fit", fields=fields
        )
        if verdict is not None:
            s.look()
            s.drafts.pop("fit_out", None)
            s.choose(model=out.name)
            s.on_change()


def _checked(session: TabSession, name: str) -> Path:
    """Path of a new model file.

    Raises:
        RtecError: why there can be none.
    """
    out = session.folder.path(name)
    if out.suffix != ".toml":
        raise RtecError(f"{name}: a model file ends in .toml")
    if out.exists():
        raise RtecError(f"{name}: another file of that name is in the folder; give the model a new name")
    return out


def _free_name(session: TabSession) -> str:
    taken = {*session.listing.models, *session.listing.machines}
    return next(n for n in ("model.toml", *(f"model-{k}.toml" for k in range(2, 999))) if n not in taken)
