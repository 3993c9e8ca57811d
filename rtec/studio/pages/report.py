"""Report: the step that is shown, as one self-contained HTML file and as a PDF."""

from functools import partial

from nicegui import ui

from rtec.studio import actions, tasks
from rtec.studio.parts import Words, button, heading, lacking, trouble
from rtec.studio.session import TabSession
from rtec.studio.tasks import ReportFiles


def build(session: TabSession) -> None:
    """The page."""
    heading("Report")
    trouble(session)
    if lacking(session):
        return
    step = session.step
    if step is None or step.compared is None:
        Words("p", "The model is being compared with the measurements.", "lead")
        if not session.trouble:
            ui.timer(0.05, partial(actions.compare, session), once=True)
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
