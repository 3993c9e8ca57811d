"""Import: preview of a file of another program, and questions that only the user can answer."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from nicegui import events, ui

from rtec.errors import RtecError
from rtec.studio.parts import figures
from rtec.studio.parts.chart import zoomable
from rtec.studio.parts.controls import (
    Area,
    Named,
    Words,
    at_fault,
    button,
    command,
    draft,
    heading,
    label,
    number,
    shell,
    trouble,
    waiting,
)
from rtec.studio.parts.session import ForeignFile, TabSession
from rtec.tasks import foreign
from rtec.tasks.foreign import ImportView
from rtec.text import clean
from rtec.wording import counted

if TYPE_CHECKING:
    from rtec.metrology.importing import ForeignColumn, ImportQuestion

NOT_USED: Final = ""
SIGNS: Final = {"+1": "+1: actual minus nominal", "-1": "-1: nominal minus actual"}
"""Label of each answer on the sign of a reading."""
LONGEST_STEM: Final = 80
"""Largest number of characters of a table's name in the suggested name of its measurement."""
THOUSANDS: Final = re.compile(r"[+-]?\d{1,3}(\s\d{3})+([.,]\d*)?")
UNITS: Final = ("", "mm", "um", "nm", "m", "in", "s", "ms", "min", "h", "degC", "degF", "K", "urad", "arcsec", "deg",
                "rpm", "mm/min", "mm/s", "kg")  # fmt: skip
OTHERS: Final = ("reading_um", "reading_urad", "reading_x_um", "reading_y_um", "reading_z_um", "angle_deg",
                 "spindle_rpm", "feed_mm_min", "load_kg")  # fmt: skip


def build(session: TabSession) -> None:
    """The page."""
    file = session.foreign
    if file is not None and file.looked is not None and file.machine != session.machine:
        file = session.foreign = ForeignFile(file.name, temperatures=file.temperatures)
    heading(
        f"Import {clean(file.name)}" if file is not None else "Import", session if file is not None else None, "import"
    )
    if file is None:
        Words("p", "Choose a table of another program on the page Measurements.")
        button("Measurements", partial(session.go, "measurements"), main=True)
        return
    if file.looked is None:
        waiting(session, "The file is being read.", _look)
        button("Measurements", partial(session.go, "measurements"))
        return
    _page(session, file, file.looked)


async def _look(session: TabSession, other: ForeignFile | None = None, beside: str = "") -> None:
    """Preview the file with other answers or columns, which are kept only if the file can be read with them."""
    file = other or session.foreign
    if file is None:
        return
    machine = session.machine
    path = session.folder.existing(file.name)
    given = path, session.machine_path if machine else None, file.answers, file.edited, file.temperatures
    found = await session.work("Reading", foreign.look_at_foreign, *given, beside=beside)
    if found is None:
        return
    if session.foreign is not None and session.foreign.name == file.name:
        session.foreign = replace(file, looked=found, machine=machine)
        session.unzoom("import")
    session.on_change()  # another file that was opened meanwhile is looked at now


def _page(session: TabSession, file: ForeignFile, view: ImportView) -> None:
    p = view.proposal
    if not session.machine:
        with ui.element("div").classes("card bad"):
            Words(
                "p",
                "Choose the machine on the page Measurements first: its axes and sensors are looked for in the file.",
            )
            button("Measurements", partial(session.go, "measurements"), main=True)
    with ui.element("div").classes("card"):
        Words("h2", f"Read as {p.reader}: {counted(p.rows, 'row')}{'' if p.whole else ' looked at'}, "
                    f"{counted(len(p.columns), 'column')}")  # fmt: skip
        for line in (*p.notes, *p.conclusions):
            Words("p", line, "small")
        _temperatures(session, file)
    if file.answers or any(_is_asked(q) for q in p.questions):
        _questions(session, file, view)
    _columns(session, file, view)
    _preview(session, view)
    _finish(session, file, view)


def _temperatures(session: TabSession, file: ForeignFile) -> None:
    """A menu of the other tables in the folder, of which one may be the log of temperatures."""
    others = {n: clean(n) for n in session.listing.foreign if n != file.name}
    if not others:
        return

    async def choose(event: events.ValueChangeEventArguments[str]) -> None:
        await _look(session, replace(file, temperatures=event.value), "temperatures")

    names = {"": "in this file, or none", **others}
    chosen = file.temperatures if file.temperatures in names else ""
    made = ui.select(names, value=chosen, label="Temperatures", on_change=choose)
    at_fault(session, "temperatures", made.props("outlined").style("min-width: min(22rem, 100%)"))


def _is_asked(question: "ImportQuestion") -> bool:
    """Whether it is asked here; the machine is chosen on another page, as the head of the page says."""
    return question.key != "machine"


def as_toml(text: str) -> str:
    """Numbers as people write them, as a list in TOML or as one number; anything else as it is.

    "0; 0; 150", "0 0 150" and "0, 0, 150" are three numbers, "12,5" is one; "100 200 300" may be one or three.
    """
    try:
        tomllib.loads(f"a = {text}")
    except tomllib.TOMLDecodeError:
        if THOUSANDS.fullmatch(text.strip()):
            return text
        parts = re.split(r"\s*;\s*|,?\s+", text.strip().strip("[]").strip())
        try:
            numbers = [f"{number(part):.12g}" for part in parts]
        except RtecError:
            return text
        return numbers[0] if len(numbers) == 1 else f"[{', '.join(numbers)}]"
    return text


def _questions(session: TabSession, file: ForeignFile, view: ImportView) -> None:
    async def answer(key: str, field: Any) -> None:
        given = str(field.value or "").strip()
        if given and given != file.answers.get(key):
            session.drafts[f"typed {file.name} {key}"] = given
            value = as_toml(given) if key.startswith("setup.") else given
            answered = replace(file, answers={**file.answers, key: value})
            await _look(session, answered, f"answer {key}")

    with ui.element("div").classes("card"):
        Words("h2", "What the file does not say")
        with ui.element("div").classes("cards"):
            for q in filter(_is_asked, view.proposal.questions):
                with ui.element("div").style("display: grid; gap: .3rem"):
                    Words("p", q.words)
                    if q.choices:
                        shown = SIGNS if q.key == "sign" else {c: clean(c) for c in q.choices}
                        field: Any = ui.select(shown, value=q.default)
                        field.on_value_change(partial(answer, q.key, field))
                    else:
                        wrong = bool(session.trouble_at(f"answer {q.key}"))
                        typed = session.drafts.get(f"typed {file.name} {q.key}", "") if wrong else q.default
                        field = ui.input(value=typed or "", placeholder=q.hint)
                        for event in ("keydown.enter", "blur"):
                            field.on(event, partial(answer, q.key, field))
                    label(at_fault(session, f"answer {q.key}", field.props("outlined")), q.words)
                    open_ = q.default is None
                    needed = "must be answered" if open_ else "assumed, unless you say otherwise"
                    Words("p", needed + _how(q), "small trouble" if open_ else "small")
        if file.answers:
            given = "; ".join(f"{k}: {v}" for k, v in file.answers.items())
            with ui.element("div").classes("row"):
                Words("p", f"Answered: {given}", "small")
                button("Ask again", partial(_forget_answers, session, file))


def _how(question: "ImportQuestion") -> str:
    """How an answer is written, where the question does not say it."""
    three = (question.default or "").count(",") == 2 and question.key.endswith("_mm")
    return "; X, Y and Z in mm, for example 0; 0; 150" if three else ""


async def _forget_answers(session: TabSession, file: ForeignFile) -> None:
    await _look(session, ForeignFile(file.name, temperatures=file.temperatures))


def _columns(session: TabSession, file: ForeignFile, view: ImportView) -> None:
    p = view.proposal
    used: Mapping[str, Mapping[str, Any]] = p.content.get("column", {})
    target_of = {str(c["from"]): t for t, c in used.items() if "from" in c}
    with ui.element("div").classes("card"):
        Words("h2", "The columns, and what they become")
        with ui.element("div").classes("scroll"), ui.element("table").classes("plain"):
            with ui.element("thead"), ui.element("tr"):
                for name in ("Column", "First values", "Becomes", "Unit", "Sign", "Why"):
                    Words("th", name, "words").props("scope=col")
            with ui.element("tbody"):
                for c in p.columns:
                    target = target_of.get(c.name, NOT_USED)
                    with ui.element("tr").classes("picked" if target or c.becomes else ""):
                        Words("td", c.name, "words file")
                        Words("td", " · ".join(v[:20] for v in c.first[:3]), "words")
                        _choices(session, file, view, c, target)
                        with ui.element("td").classes("words small why"):
                            Words("span", c.reason)
                            trouble(session, f"column {c.name}")


def _choices(session: TabSession, file: ForeignFile, view: ImportView, column: "ForeignColumn", target: str) -> None:
    """Menus for a column's target, unit and sign; time and run have tables of their own in the map."""
    name = column.name
    if column.becomes and not target:
        Words("td", column.becomes, "words")
        Words("td", "")
        Words("td", "")
        return
    entry = view.proposal.content.get("column", {}).get(target, {})

    async def change(key: str, event: events.ValueChangeEventArguments[Any]) -> None:
        edited = edit(view, name, {key: event.value})
        await _look(session, replace(file, edited=edited), f"column {name}")

    machine = view.proposal.machine
    axes = [f"{a.name.lower()}_mm" for a in machine.axes] if machine else []
    ways = [f"dir_{a.name.lower()}" for a in machine.axes] if machine else []
    sensors = [f"{s}_degc" for s in machine.sensor_names] if machine else []
    options = list(dict.fromkeys([*([target] if target else []), *OTHERS[:2], *axes, *ways, *sensors, *OTHERS[2:]]))
    with ui.element("td").classes("words"):
        shown = {NOT_USED: "not used", **{o: o for o in options}}
        label(
            ui.select(shown, value=target, on_change=partial(change, "target"))
            .props("outlined dense")
            .style("min-width: 10.5rem"),
            f"{name} becomes",
        )
    with ui.element("td").classes("words"):
        unit = str(entry.get("unit") or "")
        units = {
            u: u or (f"{column.unit} (file)" if column.unit else "not known") for u in dict.fromkeys([unit, *UNITS])
        }
        if target:
            label(
                ui.select(units, value=unit, on_change=partial(change, "unit"))
                .props("outlined dense")
                .style("min-width: 9rem"),
                f"unit of {name}",
            )
    with ui.element("td").classes("words"):
        if target:
            signs = ui.toggle({1: "+", -1: "−"}, value=int(entry.get("sign", 1)), on_change=partial(change, "sign"))
            label(signs.props("no-caps unelevated toggle-color=primary"), f"sign of {name}")


def edit(view: ImportView, name: str, changed: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The columns of the proposed map with a changed `target`, `unit` or `sign` of one of them."""
    columns = {t: dict(c) for t, c in view.proposal.content.get("column", {}).items()}
    old = next((t for t, c in columns.items() if c.get("from") == name), NOT_USED)
    entry = columns.pop(old, {"from": name})
    target = changed.get("target", old)
    for key in ("unit", "sign"):
        if key in changed:
            entry[key] = changed[key]
    entry = {k: v for k, v in entry.items() if v not in ("", None) and (k, v) != ("sign", 1)}
    if target:
        columns[str(target)] = entry
    return columns


def _preview(session: TabSession, view: ImportView) -> None:
    if view.trouble:
        with ui.element("div").classes("card bad").props('role="alert"'):
            Words("h2", "Like that it cannot be imported")
            Words("p", view.trouble, "trouble")
    if not view.rows:
        return
    with ui.element("div").classes("card"):
        Words("h2", f"What it becomes: {counted(view.rows, 'reading')}")
        zoomable(session, "import", _figure(view), "The readings as they would be imported")
        with ui.element("details"):
            Words("summary", f"What is assumed, and where each value is from: {counted(len(view.notes), 'remark')}")
            for note in view.notes:
                Words("p", note, "small")


def _figure(view: ImportView) -> dict[str, Any]:
    traces = [
        {"type": figures.kind(len(view.place)), "mode": "markers", "name": figures.text(name),
         "x": figures.numbers(view.place), "y": figures.numbers(values),
         "marker": {"size": 6, "color": figures.PALETTE[(2 + k) % 8]}}
        for k, (name, values) in enumerate(view.readings.items())
    ]  # fmt: skip
    up = "reading, µrad" if all(n.endswith("urad") for n in view.readings) else "reading, µm"
    return {
        "data": traces,
        "layout": figures.layout(xaxis=figures.axis(view.title), yaxis=figures.axis(up), dragmode="zoom"),
    }


def _finish(session: TabSession, file: ForeignFile, view: ImportView) -> None:
    stem = "".join(c if c.isalnum() or c in "-_." else "-" for c in Path(file.name).stem).lstrip("-.") or "table"
    with ui.element("div").classes("card"):
        name = draft(session, f"import_{file.name}", "Name of the measurement", f"{stem[:LONGEST_STEM]}-imported")

        def show() -> None:
            command(import_command(session, file, name.value or ""), "The same on the command line, in this folder:")

        async def run() -> None:
            try:
                out = session.folder.path(f"{(name.value or '').removesuffix('.csv')}.csv")
                for path in (out, out.with_suffix(".toml"), out.with_name(f"{out.stem}-map.toml")):
                    if path.exists():
                        raise RtecError(f"{path.name}: is in the folder already; give the measurement another name")
                view.proposal.import_map()
            except RtecError as e:
                name.error = str(e)
                return
            path = session.folder.existing(file.name)
            title = f"Importing {file.name}"
            given = path, view.proposal, out
            if await session.work(title, foreign.import_foreign, *given, beside="import") is None:
                return
            session.foreign = None
            session.look()
            session.choose(chosen=(*session.chosen, out.name))
            session.go("measurements")

        with ui.element("div").classes("row"):
            button("Import", run, main=True)
            button("Back", partial(session.go, "measurements"))
        trouble(session, "import")
        name.on_value_change(Area(show).redo)


def import_command(session: TabSession, file: ForeignFile, out: str) -> str:
    """Equivalent command of the command line; columns that were changed by hand are in the map."""
    machine = ["--machine", Named(session.machine)] if session.machine else []
    answers = [w for k, v in file.answers.items() for w in ("--answer", f"{k}={v}")]
    how = ["--map", Named(f"{out}-map.toml")] if file.edited is not None else answers
    log = ["--temperatures", Named(file.temperatures)] if file.temperatures and file.edited is None else []
    return shell(["rtec", "import", Named(file.name), *log, *how, *machine, "-o", Named(out)])
