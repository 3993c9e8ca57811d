"""Report: the current step as one self-contained HTML file and as a PDF."""

from functools import partial

from nicegui import ui

from rtec.studio import actions, tasks
from rtec.studio.parts import Words, button, heading, lacking, waiting
from rtec.studio.session import TabSession
from rtec.studio.tasks import ReportFiles


def build(session: TabSession) -> None:
    """The page."""
    heading("Report")
    if lacking(session):
        return
    step = session.step
    if step is None or step.compared is None:
        waiting(session, "The model is being compared with the measurements.", actions.compare)
        return
    Words("p", step.compared.page.lead, "lead")
    with ui.element("div").classes("card"):
        Words("h2", "What it holds")
        Words("p", "The comparison of the model with the measurements, with all figures and tables.")
        diagnosed = "The diagnosis." if step.diagnosed is not None else "No diagnosis: none was made of this model yet."
        Words("p", diagnosed)
        Words("p", "The history of the model, with the error before and after each change.")
        Words("p", "Both files hold everything themselves: they load nothing from anywhere.", "small")
        with ui.element("div").classes("row"):
            button("HTML", partial(_give, session, "html"), main=True)
            button("PDF", partial(_give, session, "pdf"), main=True)


async def _give(session: TabSession, kind: str) -> None:
    step = session.step
    if step is None:
        return
    if session.report is None or session.report[0] is not step:
        found = step.diagnosed.found if step.diagnosed is not None else None
        made = await session.work("Report", tasks.report, step.model, session.files, session.model_path, found)
        if made is None:
            return
        session.report = step, made
    files: ReportFiles = session.report[1]
    if kind == "html":
        ui.download.content(files.html, "report.html", "text/html")
    else:
        ui.download.content(files.pdf, "report.pdf", "application/pdf")
