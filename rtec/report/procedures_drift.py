"""Report of the spindle's thermal drift."""

import numpy as np
from numpy.typing import NDArray

from rtec import __version__
from rtec.metrology.procedures.drift import Approach, Drift, Phase, PhaseFit, Trace
from rtec.report import procedures_figures as draw
from rtec.report.page import Figure, Page, Section, Table
from rtec.report.procedures import number

Floats = NDArray[np.float64]
HEAD = ("1/min", "hours", "from", "moved", "at once", "goes to", "τ, min", "95 %", "rms", "remark")
MEANS = (
    "Moved: last reading minus the last of the phase before. At once: how far the curve starts from that reading; not "
    "thermal. Goes to: change at which the curve ends.",
    "τ with its 95 % interval; two where a quick and a slow part describe it better; ? where not even a factor of two "
    "is known. Not settled: τ has no upper bound. Rest has a shape: ripple, or a form that is no approach.",
)


SETTLED = 0.75
"""A slow part whose time constant is a larger share of the phase than this has no end that can be told."""


def drift_page(r: Drift, figures: bool = True) -> Page:
    """The page for one drift test; without figures it is what the terminal shows."""
    spread = {t.name: float(np.nanmax(t.values) - np.nanmin(t.values)) for t in r.traces}
    units = {t.name: t.unit for t in r.traces}
    largest = ", ".join(f"{n} {v:.1f} {units[n]}" for n, v in spread.items())
    return Page(
        title="Spindle thermal drift",
        lead=f"{r.name}: over {r.time_h[-1] - r.time_h[0]:.1f} h and {len(r.phases)} phases, the range is {largest}.",
        numbers=[(f"{v:.1f}\u00a0{units[n]}", f"range of {n}") for n, v in spread.items()],
        sections=[
            Section("Over time", [*r.words, *MEANS], figure=_figure(r) if figures else None),
            *(_section(r, trace) for trace in r.traces),
        ],
        foot=[
            "Each phase of constant speed: y = start + change · (1 - exp(-t/τ)), or two such; intervals from an F test "
            "that counts readings as far as they are independent.",
            f"rtec {__version__}, rtec drift; procedure of [G 3.5].",
        ],
    )


def _section(r: Drift, trace: Trace) -> Section:
    rows = [_row(r.phases[f.phase], f) for f in trace.fits]
    return Section(f"{trace.name}, {trace.unit}", [], Table(HEAD, rows, words=(9,)))


def _row(phase: Phase, fit: PhaseFit) -> list[str]:
    start = [f"{phase.rpm:.0f}", f"{phase.hours:.1f}", f"{phase.start_h:.1f}", number(fit.measured, 1)]
    if fit.approach is None:
        return [*start, "–", "–", "–", "–", "–", fit.why]
    a = fit.approach
    if a.pair is not None:
        quick, slow = (f"{tau / 60:.0f}" for tau in a.pair.taus_s)
        settled = a.pair.taus_s[1] < SETTLED * phase.hours * 3600.0
        changes = " ".join(f"{c:+.1f}" for c in a.pair.changes) if settled else "–"
        errors = ", ".join(
            f"±{2 * e / 60:.0f}" if 2 * e < tau else "?" for e, tau in zip(a.pair.taus_se_s, a.pair.taus_s, strict=True)
        )
        return [*start, number(fit.instant, 1), changes, f"{quick}, {slow}", errors, number(a.pair.rms), a.words]
    known = np.isfinite(a.tau_high_s) and a.tau_low_s > 0
    return [
        *start,
        number(fit.instant, 1),
        number(a.change, 1) if known else "–",
        f"{a.tau_s / 60:.0f}" if known else "–",
        _interval(a),
        number(a.rms),
        a.words,
    ]


def _interval(a: Approach) -> str:
    low, high = a.tau_low_s / 60, a.tau_high_s / 60
    if np.isfinite(high):
        return f"{low:.0f}–{high:.0f}" if low > 0 else f"< {high:.0f}"
    return f"> {low:.0f}" if low > 0 else "any"


def _figure(r: Drift) -> Figure:
    groups = []
    for unit, title in (("µm", "Drift of the probes"), ("µrad", "Tilt")):
        traces = {t.name: (t.values - _first(t.values), _curve(r, t)) for t in r.traces if t.unit == unit}
        if traces:
            groups.append((title, unit, traces))
    if r.temperatures_degc:
        nothing = np.full(len(r.time_h), np.nan)
        most = sorted(r.temperatures_degc.items(), key=lambda item: -float(np.nanmax(item[1]) - np.nanmin(item[1])))[:4]
        groups.append(("Temperatures that change most", "°C above start", {
            n: (v - _first(v), nothing) for n, v in most
        }))  # fmt: skip
    phases = [draw.Stretch(p.start_h, p.start_h + p.hours, p.rpm) for p in r.phases]
    return Figure(
        "drift.png", draw.drift(r.time_h, phases, groups), "Drift over time with speeds and fitted approaches."
    )


def _curve(r: Drift, trace: Trace) -> Floats:
    """Fitted approaches of all phases, from the same zero as the drawn values."""
    out = np.full(len(r.time_h), np.nan)
    for fit in trace.fits:
        if fit.approach is not None:
            rows = slice(r.phases[fit.phase].first, r.phases[fit.phase].end)
            out[rows] = fit.approach.values((r.time_h[rows] - r.time_h[rows][0]) * 3600.0)
    return out - _first(trace.values)


def _first(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return float(known[0]) if len(known) else 0.0
