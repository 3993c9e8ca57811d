"""Actions on the session that several pages have: each starts one job and stores its result."""

from collections.abc import Mapping

from rtec.studio.parts.session import NO_FIELDS, ModelStep, TabSession
from rtec.tasks import model as model_tasks
from rtec.tasks.model import EffectRequest


async def read_model(session: TabSession) -> bool:
    """Read the chosen model if that has not been done; gives whether there is one."""
    if session.lacks:
        return False
    if not session.steps:
        read = session.stamps()
        model = await session.work(
            "Reading the model", model_tasks.load_model, session.model_path, session.machine_path
        )
        if model is None:
            return False
        session.steps, session.at = (ModelStep(model, f"{session.model} as it is"),), 0
        session.read = read
    return True


async def compare(session: TabSession) -> None:
    """Compare the model of this step."""
    if not await read_model(session):
        return
    step = session.step
    if step is None or step.compared is not None:
        return
    view = await session.work("Comparing", model_tasks.compare, step.model, session.files, session.model_path)
    if view is not None and session.step is not None and session.step.model is step.model:
        session.keep(compared=view, residual=())
        if not session.on_compared():
            session.on_change()


async def diagnose(session: TabSession) -> None:
    """Diagnose the model of this step."""
    if not await read_model(session):
        return
    step = session.step
    if step is None:
        return
    given = step.model, session.files, session.model_path, session.machine_path
    view = await session.work("Diagnosis", model_tasks.diagnose, *given, beside="diagnose")
    if view is not None and session.step is step:
        session.keep(diagnosed=view)
        session.rank = 1 if 1 in view.curves else 0
        session.unzoom("diagnose")
        session.on_change()


async def add(
    session: TabSession, request: EffectRequest | None, beside: str = "", fields: Mapping[str, str] = NO_FIELDS
) -> bool:
    """Add an effect to the model of this step, or refit it if `request` is None; gives whether that succeeded.

    Args:
        session: the tab.
        request: the effect.
        beside, fields: places of the page for an error, as for `TabSession.work`.
    """
    if not await read_model(session):
        return False
    await compare(session)
    step = session.step
    if step is None:
        return False
    title = f"Adding {request.label}" if request else "Refitting"
    given = step.model, request, session.files, session.model_path
    view = await session.work(title, model_tasks.add, *given, beside=beside, fields=fields)
    if view is None:
        return False
    if not view.added.better:
        from rtec.diagnosis.extend.add import refused

        session.fail(f"Not added: {refused(view.added)}.", beside)
        session.on_change()
        return False
    words = ("add", *request.words) if request else ("add", "--refit")
    label = ", ".join(view.added.labels) or "numbers refitted"
    session.push(ModelStep(view.added.model, label, words, view, view.compared))
    session.on_change()
    return True


async def improve(session: TabSession) -> None:
    """Improve step by step, asking at each."""
    if not await read_model(session):
        return
    await compare(session)
    step = session.step
    if step is None:
        return
    given = step.model, session.files, session.model_path, session.machine_path
    ended = await session.work("Improving", model_tasks.improve, *given, beside="improve")
    if ended is not None:
        session.improved = ended
        session.on_change()
