"""Report of a characterisation: how good the model is, what is in it, how it was chosen, what to beware of."""

from collections.abc import Sized

import numpy as np

from rtec import __version__
from rtec.characterise import Characterisation
from rtec.characterise.result import Coefficient
from rtec.diagnosis.words import spoken
from rtec.report.page import Figure, Page, Section, Table, note_words, number

UNITS = {"um": "µm", "urad": "µrad", "noise": "× noise"}
WORTH_TELLING = 0.3
"""Correlations nearer to zero are shown as none."""
SURE = 3.0
"""A coefficient within so many standard errors of zero is not sure to be there."""


def fit_page(r: Characterisation, figures: bool = True) -> Page:
    """The page; without figures it is what the terminal shows."""
    unit = UNITS[r.unit]
    return Page(
        title=f"Model of {r.model.machine.name}",
        lead=f"{_count(r.model.effects, 'effect')}, {_count(r.coefficients, 'number')}: "
        f"left is {r.inside_rms:.3g} {unit} in sample and {r.held_out_rms:.3g} {unit} on readings "
        "left out of the fit (standard deviation).",
        numbers=[
            (f"{r.held_out_rms:.3g}\u00a0{unit}", "left on readings not fitted"),
            (f"{r.inside_rms:.3g}\u00a0{unit}", "left in sample"),
            (f"{len(r.model.effects)}", "effects"),
            (f"{len(r.warnings)}", "warnings"),
        ],
        sections=[
            Section("Beware", [f"{w.text}. What to do: {w.remedy}." for w in r.warnings] or ["Nothing stood out."]),
            Section(
                "How well each measurement is met",
                note_words(r.notes),
                _measurements(r),
                _residual_figure(r) if figures else None,
            ),
            Section("The numbers", _number_words(r), _coefficients(r)),
            *_search(r, figures),
            *_correlations(r),
        ],
        foot=[
            "Standard errors come from leaving out block by block: they hold for readings correlated within a block.",
            "Held out: each part predicted by the fit to all others.",
            f"rtec {__version__}, rtec fit; procedure of [G 3.6].",
        ],
    )


def _count(items: Sized, what: str) -> str:
    return f"{len(items)} {what}" + ("" if len(items) == 1 else "s")


def _measurements(r: Characterisation) -> Table:
    rows = [
        [
            m.name,
            m.instrument,
            f"{m.readings}",
            number(m.measured),
            number(m.inside),
            number(m.held_out),
            UNITS[m.unit],
            m.blocks,
        ]
        for m in r.measurements
    ]
    head = ("measurement", "instrument", "readings", "measured", "in sample", "held out", "unit", "left out")
    return Table(head, rows, "Standard deviations, nuisances taken out.", words=(0, 1, 6, 7))


def _number_words(r: Characterisation) -> list[str]:
    unsure = [c for c in r.coefficients if c.t is not None and abs(c.t) < SURE]
    out = [f"Condition number {r.condition:.3g} (1 is ideal, above 30 some effects are hard to tell apart)."]
    if unsure:
        said = ", ".join(f"{c.effect} {c.name}" for c in unsure)
        out.append(f"Within {SURE:g} standard errors of zero: {said}.")
    return out


def _coefficients(r: Characterisation) -> Table:
    rows = [[c.effect, c.name, f"{c.value:.5g}", _error(c), _t(c), spoken(c.unit)] for c in r.coefficients]
    return Table(("effect", "number", "value", "std. error", "t", "unit"), rows, words=(0, 1, 5))


def _error(c: Coefficient) -> str:
    return "–" if c.se is None else f"{c.se:.2g}"


def _t(c: Coefficient) -> str:
    return "–" if c.t is None else f"{c.t:.1f}"


def _search(r: Characterisation, figures: bool) -> list[Section]:
    if not r.steps:
        return []
    rows = [[s.added, f"{100 * s.inside:.1f}", f"{100 * s.held_out:.1f}"] for s in r.steps]
    table = Table(
        ("added", "in sample, %", "held out, %"), rows, "Standard deviation, in % of that of nothing, in sample."
    )
    words = [
        "Each step adds what lowers the held-out error most. The smallest choice within one standard error of the best "
        "is taken; then terms are exchanged, joined or dropped where that costs nothing, so the model may differ from "
        "the last step.",
    ]
    picture = (
        Figure("search.png", _search_figure(r), "Error against number of terms, in sample and held out")
        if figures and len(r.steps) > 1
        else None
    )
    return [Section("How it was chosen", words, table, picture)]


def _search_figure(r: Characterisation) -> bytes:
    from rtec.report.fit_figures import falling

    return falling(np.array([100 * s.inside for s in r.steps]), np.array([100 * s.held_out for s in r.steps]))


def _residual_figure(r: Characterisation) -> Figure:
    from rtec.report.fit_figures import residuals

    panels = [(m.name, UNITS[m.unit], *r.residuals[m.name]) for m in r.measurements]
    return Figure("residuals.png", residuals(panels), "What the fit leaves of each reading, over time")


def _correlations(r: Characterisation) -> list[Section]:
    if not r.correlations:
        return []
    worth = [c for c in r.correlations if abs(c.r) >= WORTH_TELLING]
    rows = [[c.component, c.feature, c.effect, f"{c.r:+.2f}", f"{100 * c.left:.2g}"] for c in worth]
    head = ("component", "goes with", "as", "r", "left, %")
    caption = "Left: share of its own variation that geometry and nuisances leave; little left is little known."
    silent = [
        name for name in dict.fromkeys(c.component for c in r.correlations) if name not in {c.component for c in worth}
    ]
    words = [f"Nothing goes with {', '.join(silent)} (correlation below {WORTH_TELLING:g})."] if silent else []
    return [Section("What goes with what", words, Table(head, rows, caption, words=(0, 1, 2)) if rows else None)]
