"""Report of a characterisation: the residual, the coefficients, the choice of effects, the warnings; with figures."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rtec.arrays import Floats
from rtec.characterise import Characterisation
from rtec.characterise.result import Coefficient
from rtec.diagnosis.doubts.not_read import unread_beside
from rtec.diagnosis.words import spoken
from rtec.estimation.outliers import left_out
from rtec.report.figures import LINES, OFF, ON, Png, as_png, stacked
from rtec.report.page import Figure, Page, Section, Table, note_words, shell_command
from rtec.version import __version__
from rtec.wording import ERROR_UNITS, NONE, counted, decimals, number, significant, sizes, with_error

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

WORTH_TELLING = 0.3
"""Correlations nearer to zero than this are not shown."""
SURE = 3.0
"""A coefficient is not significant within this many standard errors of zero."""


def fit_page(r: Characterisation, figures: bool = True) -> Page:
    """The page.

    Args:
        r: the characterisation.
        figures: whether to draw.
    """
    unit = ERROR_UNITS[r.unit]
    held, inside, floor = sizes(r.held_out_rms, r.inside_rms, r.judged.noise_floor)
    warnings = [f"{w.text}. What to do: {w.remedy}." for w in r.warnings]
    shown = [w for w in r.warnings if w.code != "outliers"]
    first = f" {counted(len(warnings), 'warning')}; the first: {shown[0].text.split(';')[0]}." if shown else ""
    return Page(
        title=f"Model of {r.model.machine.name}",
        lead=f"{counted(len(r.model.effects), 'effect')}, {counted(len(r.coefficients), 'coefficient')}: the residual "
        f"is {held} {unit} on held-out readings and {inside} {unit} in sample "
        f"(root mean square); the noise floor is {floor} {unit}.{left_out(r.outliers)}{first}"
        f"{unread_beside(r.judged.readings.measurements)}",
        numbers=[
            (f"{held}\u00a0{unit}", "residual on held-out readings"),
            (f"{inside}\u00a0{unit}", "residual in sample"),
            (f"{len(r.model.effects)}", "effects"),
            (f"{len(r.warnings)}", "warnings"),
        ],
        sections=[
            Section("Warnings", warnings or ["None."]),
            Section(
                "Residual by measurement",
                note_words(r.notes) if figures else [],
                _measurements(r),
                _residual_figure(r) if figures else None,
            ),
            Section("Coefficients", _number_words(r), _coefficients(r)),
            *_search(r, figures),
            *_correlations(r),
        ],
        foot=[
            "Standard errors come from holding out block by block: they hold for readings correlated within a block.",
            "Held out: blocks are dealt into eight parts in turn; each part is predicted by the fit to all others.",
            f"rtec {__version__}, rtec fit; procedure of [G 3.6].",
        ],
        brief=Section("", [], _brief(r)),
        next=[shell_command("rtec", "compare", *r.files)] if r.files else [],
    )


def _brief(r: Characterisation) -> Table:
    digits = _digits(r)
    rows = [
        [m.name, *(number(v, digits) for v in (m.measured, m.inside, m.held_out, m.floor)), ERROR_UNITS[m.unit]]
        for m in r.measurements
    ]
    head = ("measurement", "measured", "residual", "held out", "noise floor", "unit")
    return Table(head, rows, "Root mean squares, as rtec compare has them.", words=(0, 5))


def _digits(r: Characterisation) -> int:
    """Decimals of errors in tables."""
    return decimals(*(m.floor for m in r.measurements))


def _measurements(r: Characterisation) -> Table:
    digits = _digits(r)
    rows = [
        [
            m.name,
            m.instrument,
            f"{m.readings}",
            *(number(v, digits) for v in (m.measured, m.inside, m.held_out, m.floor)),
            ERROR_UNITS[m.unit],
            m.blocks,
        ]
        for m in r.measurements
    ]
    head = (
        "measurement", "instrument", "readings", "measured", "residual", "held out", "noise floor", "unit",
        "held-out blocks",
    )  # fmt: skip
    return Table(head, rows, "Root mean squares, as rtec compare has them; nuisances removed.", words=(0, 1, 7, 8))


def _number_words(r: Characterisation) -> list[str]:
    unsure = [c for c in r.coefficients if c.t is not None and abs(c.t) < SURE]
    out = [f"Condition number {number(r.condition, 1)} (1 is ideal; above 30 some effects are hard to separate)."]
    if unsure:
        names = ", ".join(f"{c.effect} {c.name}" for c in unsure)
        out.append(f"Within {SURE:g} standard errors of zero: {names}.")
    return out


def _coefficients(r: Characterisation) -> Table:
    rows = [[c.effect, c.name, *with_error(c.value, c.se), _t(c), spoken(c.unit)] for c in r.coefficients]
    return Table(("effect", "coefficient", "value", "standard error", "t", "unit"), rows, words=(0, 1, 5))


def _t(c: Coefficient) -> str:
    return NONE if c.t is None else number(c.t, 1)


def _search(r: Characterisation, figures: bool) -> list[Section]:
    if not r.steps:
        return []
    rows = [[s.added, number(100 * s.inside, 1), number(100 * s.held_out, 1)] for s in r.steps]
    table = Table(
        ("added", "in sample, %", "held out, %"), rows, "Residual (root mean square) in % of that without a model."
    )
    words = [
        "Each step adds the term that lowers the held-out error most. The smallest model within one standard error of "
        "the best is taken. Then terms are exchanged, joined or dropped where the error does not rise, so the model "
        "may differ from the last step.",
    ]
    picture = (
        Figure("search.png", _search_figure(r), "Error against number of terms, in sample and held out")
        if figures and len(r.steps) > 1
        else None
    )
    return [Section("Choice of the effects", words, table, picture)]


def _search_figure(r: Characterisation) -> Png:

    terms, *errors = np.array([(s.terms, 100 * s.inside, 100 * s.held_out) for s in r.steps]).T
    return falling(terms, *errors)


def _residual_figure(r: Characterisation) -> Figure:

    panels = [(m.name, ERROR_UNITS[m.unit], *r.residuals[m.name]) for m in r.measurements]
    return Figure("residuals.png", residuals(panels), "Residual of each reading over time")


def _correlations(r: Characterisation) -> list[Section]:
    if not r.correlations:
        return []
    worth = [c for c in r.correlations if abs(c.r) >= WORTH_TELLING]
    rows = [[c.component, c.feature, c.effect, number(c.r, sign=True), significant(100 * c.left, 2)] for c in worth]
    head = ("component", "correlates with", "as", "r", "own share, %")
    caption = "Own share: of its variation that geometry and nuisances do not explain; if small, r is uncertain."
    silent = [
        name for name in dict.fromkeys(c.component for c in r.correlations) if name not in {c.component for c in worth}
    ]
    words = [f"No temperature correlates with {', '.join(silent)} (below {WORTH_TELLING:g})."] if silent else []
    return [
        Section("Correlations with temperatures", words, Table(head, rows, caption, words=(0, 1, 2)) if rows else None)
    ]


@as_png
def falling(terms: Floats, inside: Floats, held_out: Floats) -> "MplFigure":
    """Error against number of terms, in sample and held out, % of that without terms, on a logarithmic scale."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    figure, (ax,) = stacked(4.6)
    ax.semilogy(terms, held_out, color=OFF, marker="s", linestyle="--", label="held out")
    ax.semilogy(terms, inside, color=ON, marker="o", label="in sample")
    ax.set_title("Error as terms were added")
    ax.set_xlabel("number of terms")
    ax.set_ylabel("error, % of that with no term")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(frameon=False)
    return figure


@as_png
def residuals(panels: Sequence[tuple[str, str, Floats, Floats]]) -> "MplFigure":
    """Residuals of all readings, one panel a measurement.

    Args:
        panels: measurement, unit, hours (n,), residuals (readings, n).
    """
    figure, axes = stacked(*[3.0] * len(panels))
    for ax, (name, unit, hours, values) in zip(axes, panels, strict=True):
        for row, colour in zip(values, LINES, strict=False):
            ax.plot(hours, row, linestyle="", marker=".", markersize=3, color=colour)
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(name)
        ax.set_ylabel(f"residual, {unit}")
    axes[-1].set_xlabel("time since the first reading, hours")
    return figure
