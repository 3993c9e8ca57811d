"""Report: what the pages show, as one self-contained HTML file and as a PDF."""

from dataclasses import dataclass
from functools import partial
from typing import Final

from nicegui import ui

from rtec.studio.pages.add import present, shown_residuals
from rtec.studio.pages.compare import shown_plot
from rtec.studio.parts import actions
from rtec.studio.parts.controls import Words, button, heading, label, lacking, waiting
from rtec.studio.parts.session import ModelStep, PlotChoices, TabSession
from rtec.tasks import report as report_task
from rtec.tasks.folder import Summary
from rtec.tasks.foreign import ImportView
from rtec.tasks.report import DrawnPlot, ReportFiles, ReportParts
from rtec.text import clean

OF_THE_MODEL: Final = frozenset({"compare", "diagnose", "add"})
"""Parts that need a comparison."""


@dataclass(frozen=True)
class _Part:
    """A part of the report: description in words, and why it is not there; empty where it is."""

    words: str
    missing: str = ""


def build(session: TabSession) -> None:
    """The page."""
    heading("Report")
    live = session.live is not None and session.live.status is not None
    if not live and not _listed(session) and not _imported(session) and lacking(session):
        return
    step = None if session.lacks else session.step
    asked = session.reported is None or bool(session.reported & OF_THE_MODEL)
    if not session.lacks and asked and (step is None or step.compared is None):
        waiting(session, "The model is being compared with the measurements.", actions.compare)
        return
    if step is not None and step.compared is not None:
        Words("p", step.compared.page.lead, "lead")
    parts = _parts(session, step)
    chosen = chosen_parts(session, step)
    with ui.element("div").classes("card"):
        Words("h2", "What it holds")
        for name, part in parts.items():
            if part.missing:
                Words("p", f"{part.words.partition(':')[0]}: {part.missing}", "small")
                continue
            box = ui.checkbox(part.words, value=name in chosen, on_change=partial(_choose, session, step, name))
            label(box, part.words)
        Words("p", "Both files hold everything themselves: they load nothing from anywhere.", "small")
        with ui.element("div").classes("row"):
            off = "" if chosen else "choose what it holds"
            button("HTML", partial(_give, session, "html"), main=True, off=off)
            button("PDF", partial(_give, session, "pdf"), main=True, off=off)


def _parts(session: TabSession, step: ModelStep | None) -> dict[str, _Part]:
    """The parts of a report, by name; those that are not there say why."""
    no_model = session.lacks or "the model was not compared yet; the page Compare does it."
    compared = step is not None and step.compared is not None
    model = "" if compared else no_model
    diagnosed = step is not None and step.diagnosed is not None
    out = {
        "measurements": _Part("Measurements: instrument, runs, readings, span and temperatures of each that is chosen",
                              "" if _listed(session) else "none is chosen, or they were not read yet."),
        "compare": _Part("Comparison: the model and the measurements, with all figures and tables", model),
        "diagnose": _Part("Diagnosis: which effect is missing, with the evidence",
                          "" if diagnosed else model or "none was made of this model yet."),
        "add": _Part("Add and watch: the error before and after each change of the model", model),
        "explore": _Part("Explore: the machine in the state that is set there, its errors, and the part",
                         "" if _explored(session, step) else "the page was not opened with this model yet."),
    }  # fmt: skip
    if session.foreign is not None:
        words = f"Import: the preview of {clean(session.foreign.name)}, its columns, units and signs"
        out["import"] = _Part(words, "" if _imported(session) else "the file was not read yet.")
    if session.live is not None:
        found = session.live.status
        words = "Live: the running daemon at the moment of the click, with the last minutes and hours"
        out["live"] = _Part(words, "" if found is not None else f"the daemon does not answer: {session.live.trouble}.")
    return out


def _listed(session: TabSession) -> tuple[Summary, ...]:
    """Summaries of the chosen measurements that are known."""
    return tuple(session.summaries[name] for name in session.chosen if name in session.summaries)


def _imported(session: TabSession) -> ImportView | None:
    """The preview of the file that is being imported; None where there is none."""
    return session.foreign.looked if session.foreign is not None else None


def _explored(session: TabSession, step: ModelStep | None) -> bool:
    return step is not None and session.explored is not None and session.explored.model is step.model


def chosen_parts(session: TabSession, step: ModelStep | None) -> frozenset[str]:
    """Names of the parts that the report holds."""
    there = {name for name, part in _parts(session, step).items() if not part.missing}
    return frozenset(there if session.reported is None else there & session.reported)


def _choose(session: TabSession, step: ModelStep | None, name: str, event: object) -> None:
    chosen = chosen_parts(session, step)
    session.reported = chosen | {name} if getattr(event, "value", False) else chosen - {name}
    session.on_change()


async def _give(session: TabSession, kind: str) -> None:
    made = await _made(session)
    if made is None:
        return
    if kind == "html":
        ui.download.content(made.html, "report.html", "text/html")
    else:
        ui.download.content(made.pdf, "report.pdf", "application/pdf")


async def _made(session: TabSession) -> ReportFiles | None:
    """The report; the one of before if nothing changed since."""
    step = None if session.lacks else session.step
    chosen = chosen_parts(session, step)
    model = step is not None and bool(chosen & OF_THE_MODEL)
    compared = step.compared if step is not None else None
    parts = ReportParts(
        names=tuple(sorted(chosen)),
        listed=_listed(session) if "measurements" in chosen else (),
        model=step.model if step is not None and model else None,
        files=tuple(session.files) if model else (),
        named=session.model_path if model else None,
        drawn=_drawn(session, step) if "compare" in chosen else None,
        zooms={k: zoom for k, zoom in session.zooms.items() if not k.startswith("compare")},
        diagnosed=step.diagnosed if step is not None and "diagnose" in chosen else None,
        rank=session.rank,
        added=step.added.page.sections[:1] if step is not None and step.added is not None and "add" in chosen else (),
        residuals=shown_residuals(session, compared) if compared is not None and "add" in chosen else (),
        now=present(compared) if compared is not None and "add" in chosen else None,
        previewed=session.previewed if "add" in chosen else None,
        foreign=_imported(session) if "import" in chosen else None,
        state=session.explored if "explore" in chosen else None,
        daemon=session.live.moment() if session.live is not None and "live" in chosen else None,
    )
    if session.report is not None and session.report[0].is_as(parts):
        return session.report[1]
    made = await session.work("Report", report_task.report, parts)
    if made is not None:
        session.report = parts, made
    return made


def _drawn(session: TabSession, step: ModelStep | None) -> DrawnPlot | None:
    """What the page Compare draws, where the user chose how; None where it is drawn as at first."""
    if step is None or step.compared is None:
        return None
    shown = shown_plot(session, step.compared.series)
    return shown if session.plots != PlotChoices() or shown.zooms else None
