"""Diagnose: the missing effect, with its curve through the residual, its rivals, and effects that were not testable."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from nicegui import ui

from rtec.diagnosis.result import Diagnosis, Finding, Verdict
from rtec.diagnosis.words import fitted_numbers, indistinguishable, labels
from rtec.effects import Effect
from rtec.studio.parts import actions, figures
from rtec.studio.parts.chart import zoomable
from rtec.studio.parts.controls import Area, Words, button, heading, lacking, section, table, tiles, trouble
from rtec.studio.parts.session import TabSession
from rtec.tasks.model import SHOWN, SHOWN_CURVES, DiagnosisView, EffectRequest
from rtec.wording import ERROR_UNITS, counted, odds, percent, probability, sizes

FIRST = 3
"""Number of candidates that are shown unfolded."""
ODDS: Final = (
    "Held-out error: the error on held-out runs, without which the model was fitted. Odds and probability: among these "
    "candidates and 'nothing is missing'. An effect that none of them describes is not counted."
)
WIDE, HIGH = 220, 100
"""Size of the picture of an effect."""
NOT_A_BUTTON: Final = '(event) => event.target.closest("button") || emit()'
SEE_CURVE: Final = """if (matchMedia("(max-width: 1100px)").matches)
  document.querySelector(".stick").scrollIntoView({ block: "nearest" })"""
"""On a narrow window the curve is above the cards, and may be out of sight."""


VERDICTS: Final[Mapping[Verdict, tuple[str, str]]] = {
    "missing_effect": ("An effect is missing", "bad"),
    "ambiguous": ("One of several effects is missing", "bad"),
    "unknown_effect": ("Something is missing that the catalogue does not have", "bad"),
    "undecided": ("These readings do not decide what is missing", "open"),
    "nothing_missing": ("Nothing is missing", "good"),
}
"""Heading and kind of the card, by kind of answer."""


def build(session: TabSession) -> None:
    """The page."""
    heading("Diagnose", session, "diagnose")
    if lacking(session):
        return
    step = session.step
    view = step.diagnosed if step is not None else None
    if view is None:
        Words(
            "p",
            "Every effect of the catalogue is tested on all measurements at once. It takes some seconds; the pages "
            "stay usable, and you can cancel it.",
            "lead",
        )
        with ui.element("div").classes("row"):
            button(
                "Find the missing effect",
                lambda: actions.diagnose(session),
                main=True,
                off="" if session.job is None else "other work is not finished",
            )
        trouble(session, "diagnose")
        return
    _verdict(view)
    tiles(view.page.numbers)
    if view.found.findings or 0 in view.curves:
        with ui.element("div").classes("split"):
            _Candidates(session, view).build()
    _rest(view)
    with ui.element("div").classes("row"):
        button("Test again", lambda: actions.diagnose(session))
    trouble(session, "diagnose")


def verdict(d: Diagnosis) -> tuple[str, str]:
    """The answer of a diagnosis as a heading, and the kind of its card."""
    if len(d.together) > 1:
        return "Several effects are missing", "bad"
    if d.verdict == "nothing_missing" and d.out_of_date:
        return "No effect is missing, but the model's numbers are out of date", "bad"
    return VERDICTS[d.verdict]


def _verdict(view: DiagnosisView) -> None:
    d = view.found
    text, kind = verdict(d)
    if d.verdict == "missing_effect" and len(d.together) < 2:
        text = ": ".join([text, *(type(f.effect).about.title for f in d.findings[:1])])
    with ui.element("div").classes(f"card {kind}").props('role="status"'):
        Words("h2", text)
        Words("p", view.page.lead, "lead")


class _Candidates:
    """The candidates as cards; beside them the curve of the chosen one, which alone changes with the choice."""

    def __init__(self, session: TabSession, view: DiagnosisView) -> None:
        self._session, self._view = session, view
        self._shown: dict[int, ui.element] = {}
        d = view.found
        self._alike = len(indistinguishable(d)) if d.group and not d.together else 1

    def build(self) -> None:
        with ui.element("div").classes("card stick"):
            self._curve = Area(self._draw)
        with ui.element("div").style("display: grid; gap: 1rem"):
            self._cards()

    def _draw(self) -> None:
        curves = self._view.curves
        rank = self._session.rank if self._session.rank in curves else next(iter(curves), None)
        if rank is None:
            Words("p", "There is no curve to show.")
            return
        for k, e in enumerate(curves[rank][:SHOWN_CURVES]):
            Words("h2", e.title)
            shows = f"Residual and fitted effect: {e.title}"
            zoomable(self._session, f"diagnose {rank} {k}", figures.evidence_figure(e), shows)

    def _choose(self, rank: int) -> None:
        self._session.rank = rank
        for of, card in self._shown.items():
            card.classes(add="chosen" if of == rank else "", remove="" if of == rank else "chosen")
        self._curve.redo()
        ui.run_javascript(SEE_CURVE)

    def _cards(self) -> None:
        session, d = self._session, self._view.found
        shown = d.findings[:SHOWN]
        cards = list(zip(shown, labels(shown), strict=True))
        for f, label in cards[:FIRST]:
            self._card(f, label)
        if cards[FIRST:]:
            with ui.element("details").props("open" if session.rank > FIRST else ""):
                Words("summary", counted(len(cards) - FIRST, "more candidate"))
                with ui.element("div").style("display: grid; gap: 1rem; margin-top: .6rem"):
                    for f, label in cards[FIRST:]:
                        self._card(f, label)
        if cards:
            Words("p", ODDS, "small")
        u = d.unknown
        if u is not None and u.expression:
            with self._frame(0):
                Words("h2", "The nearest simple expression")
                Words("p", f"{u.expression}, feeds {u.feeds}")
                Words("p", "It describes the shape of the error, not its cause.", "small")
                request = EffectRequest("", u.feeds, (), u.expression, u.parameters)
                with ui.element("div").classes("row"):
                    if 0 in self._view.curves:
                        button("Show its curve", lambda: self._choose(0))
                    button("Add", lambda: _add(session, request, 0), main=not (shown and shown[0].accepted))
                trouble(session, "add_0")

    def _frame(self, rank: int) -> ui.element:
        """The card of a candidate; a click anywhere on it shows its curve."""
        card = self._shown[rank] = ui.element("div").classes("card")
        card.classes("chosen" if self._session.rank == rank else "")
        if rank in self._view.curves:
            card.classes("pick").on("click", lambda: self._choose(rank), js_handler=NOT_A_BUTTON)
        return card

    def _card(self, f: Finding, label: str) -> None:
        session, unit = self._session, ERROR_UNITS[self._view.found.unit]
        about = type(f.effect).about
        with self._frame(f.rank):
            Words("h2", f"{f.rank}. {about.title}")
            Words("p", f"{label}: {about.equation}")
            with ui.element("div").classes("row start"):
                _picture(type(f.effect))
                with ui.element("div"):
                    fall = percent(f.heldout_drop) if f.heldout_drop > 0.005 else "does not fall"
                    Words("p", f"Size: {sizes(f.size_um)[0]} {unit}")
                    Words("p", f"Fitted: {fitted_numbers(f)}")
                    Words("p", f"Held-out error: {'falls by ' if f.heldout_drop > 0.005 else ''}{fall}")
                    if not (f.group and self._alike > 1):
                        Words("p", f"Odds: {odds(f.confidence)}, probability {probability(f.confidence)}")
                    elif f.rank == 1:
                        Words("p", f"One of {self._alike} effects that these data cannot distinguish")
            if f.why_not:
                Words("p", f.why_not, "small")
            for alike in [a for a in f.confused_with if not a.apart][:3]:
                test = f" To separate them: {alike.separating_test}." if alike.separating_test else ""
                Words("p", f"Cannot be distinguished from {alike.label} by these data.{test}", "small")
            with ui.element("div").classes("row"):
                if f.rank in self._view.curves:
                    button("Show its curve", lambda: self._choose(f.rank))
                if f.partner is None:
                    button("Add", lambda: _add(session, EffectRequest.of(f), f.rank), main=f.accepted and f.rank == 1)
                else:
                    only = f"Only together with {f.partner.label}: Improve on the page Add and watch adds both."
                    Words("p", only, "small")
            trouble(session, f"add_{f.rank}")


def _picture(kind: type[Effect]) -> None:
    """Show the shape of an effect of the catalogue with its usual size; curves after the first are dashed."""
    from rtec.report.effects_figures import shape_of

    shape = shape_of(kind)
    if shape is None:
        return
    x, curves = shape.x, [np.broadcast_to(c.error, shape.x.shape) for c in shape.curves]
    low, high = min(float(np.min(c)) for c in curves), max(float(np.max(c)) for c in curves)
    across = WIDE * (x - x.min()) / max(float(np.ptp(x)), 1e-12)
    with ui.element("figure").style("margin: 0"):
        with ui.element("svg").classes("shape").props(f'viewBox="-4 -4 {WIDE + 8} {HIGH + 8}" role="img"') as svg:
            svg.props["aria-label"] = f"Shape of the effect over {shape.over}"
            for k, c in enumerate(curves):
                down = HIGH * (high - c) / max(high - low, 1e-12)
                d = "M" + " L".join(f"{a:.1f},{b:.1f}" for a, b in zip(across[::4], down[::4], strict=True))
                path = ui.element("path").classes(f"line{k % 3}")
                path.props["d"] = d
        Words("figcaption", f"over {shape.over}", "small")


async def _add(session: TabSession, request: EffectRequest, rank: int) -> None:
    if await actions.add(session, request, f"add_{rank}"):
        session.moving = True
        session.go("add")


def _rest(view: DiagnosisView) -> None:
    titles = {
        "Tested and absent": "Looked for and not there",
        "Not testable with these readings": "What could not be seen",
    }
    for part in view.page.sections:
        if part.heading in titles:
            with ui.element("div").classes("card"):
                Words("h2", titles[part.heading])
                Words("p", part.text[0] if part.text else "")
                if part.table is not None:
                    with ui.element("details"):
                        Words("summary", f"{len(part.table.rows)} effects")
                        table(part.table)
        else:
            section(part)
