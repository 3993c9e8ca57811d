"""Reports of the procedures: positioning after ISO 230-2, thermal drift, straightness and parallelism."""

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.procedures.drift import Approach, Drift, PhaseFit, SpeedPhase, Trace
from rtec.metrology.procedures.iso230_2 import Positioning, PositioningTests
from rtec.metrology.procedures.straightness import ParallelismResult, StraightnessResult
from rtec.report import procedures_figures as draw
from rtec.report.page import Figure, Page, Section, Table, note_words
from rtec.version import __version__
from rtec.wording import number

ISO230_FORMULAS = (
    "x̄ᵢ mean and sᵢ standard deviation of the deviations at target i; Bᵢ = x̄ᵢ↑ - x̄ᵢ↓; B = max|Bᵢ|.",
    "R↑ = max 4sᵢ↑; Rᵢ = max(2sᵢ↑ + 2sᵢ↓ + |Bᵢ|, 4sᵢ↑, 4sᵢ↓); R = max Rᵢ.",
    "E: largest minus smallest mean of both directions; M: the same of the bidirectional means (x̄ᵢ↑ + x̄ᵢ↓)/2.",
    "A: largest x̄ + 2s minus smallest x̄ - 2s of both directions. Coverage factor 2.",
)


def iso230_page(r: PositioningTests, figures: bool = True) -> Page:
    """The page for one or more tests; without figures for the terminal."""
    return Page(
        title="Positioning after ISO 230-2",
        lead="; ".join(f"{t.visits.name}: {_lead(t)}" for t in r.tests) + ".",
        numbers=_numbers(r.tests[0]) if len(r.tests) == 1 else [],
        sections=[s for i, t in enumerate(r.tests) for s in _sections(t, i, figures)],
        foot=[*note_words(r.notes), *ISO230_FORMULAS, f"rtec {__version__}, rtec iso230."],
    )


def _lead(r: Positioning) -> str:
    if r.both:
        return f"accuracy A = {r.both.A_um:.2f} µm, reversal B = {r.both.B_um:.2f} µm"
    one = r.up or r.down
    return f"accuracy A = {one.A_um:.2f} µm in one direction" if one else "nothing"


def _numbers(r: Positioning) -> list[tuple[str, str]]:
    if not r.both:
        return []
    b = r.both
    named = {"accuracy A": b.A_um, "repeatability R": b.R_um, "systematic E": b.E_um, "reversal B": b.B_um}
    return [(f"{v:.2f}\u00a0µm", k) for k, v in named.items()]


def _sections(r: Positioning, index: int, figures: bool) -> list[Section]:
    drift = [r.drift.words] if r.drift else []
    return [
        Section(r.visits.name, [*drift, *(f"Warning: {w}" for w in r.warnings)], _axis_table(r)),
        Section("Target by target", [], _target_table(r), _iso230_figure(r, index) if figures else None),
    ]


def _axis_table(r: Positioning) -> Table:
    def row(name: str, key: str) -> list[str]:
        values = (getattr(way, key, float("nan")) if way else float("nan") for way in (r.both, r.up, r.down))
        return [name, *(number(v) for v in values)]

    rows = [
        row("A  accuracy", "A_um"), row("R  repeatability", "R_um"), row("E  systematic deviation", "E_um"),
        row("M  mean systematic deviation", "M_um"), row("B  reversal, largest", "B_um"),
        row("B̄  reversal, mean (↑ - ↓)", "B_mean_um"),
    ]  # fmt: skip
    return Table(["µm", "both", "↑", "↓"], rows)


def _target_table(r: Positioning) -> Table:
    nothing = np.full(len(r.visits.target_mm), np.nan)
    columns = [
        *((w.mean_um, w.s_um) if w else (nothing, nothing) for w in (r.up, r.down)),
        (r.both.B_i_um, r.both.R_i_um) if r.both else (nothing, nothing),
    ]
    values = np.concatenate([np.stack(pair) for pair in columns]).T
    rows = [[f"{t:g}", *(number(float(v)) for v in line)] for t, line in zip(r.visits.target_mm, values, strict=True)]
    return Table(["target, mm", "x̄↑, µm", "s↑", "x̄↓", "s↓", "B", "R"], rows, words=())


def _iso230_figure(r: Positioning, index: int) -> Figure:
    ways = {n: x for n, x in (("up", r.visits.up_um), ("down", r.visits.down_um)) if not np.isnan(x).all()}
    known = [w for w in (r.up, r.down) if w]
    limits = (
        min(float((w.mean_um - 2 * w.s_um).min()) for w in known),
        max(float((w.mean_um + 2 * w.s_um).max()) for w in known),
    )
    cycles = r.drift.cycle_um if r.drift else None
    return Figure(
        f"positioning-{index + 1}.png",
        draw.positioning(f"Positioning: {r.visits.name}", r.visits.target_mm, ways, limits, cycles),
        f"Deviation over target for {r.visits.name}, both directions, with means and twice the standard deviation.",
    )


HEAD = ("1/min", "hours", "from", "moved", "at once", "goes to", "τ, min", "95 %", "rms", "remark")
MEANS = (
    "Moved: last reading minus the last one of the phase before. At once: jump at the start of the phase, which is not "
    "thermal. Goes to: change at which the curve ends.",
    "τ: time constant with its 95 % interval. It has two values where a quick and a slow part describe the drift "
    "better, and a ? where it is not known to a factor of two.",
    "Remarks: not settled: τ has no upper bound; rest has a shape: the residual of the curve is ripple, or the drift "
    "does not approach an end.",
)


SETTLED = 0.75
"""The final value of a slow part is not determined if its time constant is a larger share of the phase than this."""


def drift_page(r: Drift, figures: bool = True) -> Page:
    """The page for one drift test; without figures for the terminal."""
    spread = {t.name: float(np.nanmax(t.values) - np.nanmin(t.values)) for t in r.traces}
    units = {t.name: t.unit for t in r.traces}
    largest = ", ".join(f"{n} {v:.1f} {units[n]}" for n, v in spread.items())
    return Page(
        title="Spindle thermal drift",
        lead=f"{r.name}: over {r.time_h[-1] - r.time_h[0]:.1f} h and {len(r.phases)} phases, the range is {largest}.",
        numbers=[(f"{v:.1f}\u00a0{units[n]}", f"range of {n}") for n, v in spread.items()],
        sections=[
            Section("Over time", [*r.words, *MEANS], figure=_drift_figure(r) if figures else None),
            *(_section(r, trace) for trace in r.traces),
        ],
        foot=[
            *note_words(r.notes),
            "Each phase of constant speed: y = start + change · (1 - exp(-t/τ)), or two such; intervals from an F test "
            "that counts readings as far as they are independent.",
            f"rtec {__version__}, rtec drift; procedure of [G 3.5].",
        ],
    )


def _section(r: Drift, trace: Trace) -> Section:
    rows = [_row(r.phases[f.phase], f) for f in trace.fits]
    return Section(f"{trace.name}, {trace.unit}", [], Table(HEAD, rows, words=(9,)))


def _row(phase: SpeedPhase, fit: PhaseFit) -> list[str]:
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


def _drift_figure(r: Drift) -> Figure:
    groups = []
    for unit, title, what in (("µm", "Drift of the probes", "displacement"), ("µrad", "Tilt", "tilt")):
        traces = {t.name: (t.values - _first(t.values), _curve(r, t)) for t in r.traces if t.unit == unit}
        if traces:
            groups.append((title, f"{what}, {unit}", traces))
    if r.temperatures_degc:
        nothing = np.full(len(r.time_h), np.nan)
        most = sorted(r.temperatures_degc.items(), key=lambda item: -float(np.nanmax(item[1]) - np.nanmin(item[1])))[:4]
        groups.append(("Temperatures that change most", "change since the start, K", {
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


TITLES = {
    "reversal": "Straightness by reversal of the arbor",
    "pair": "Straightness by a pair of probes and reversal",
    "face": "Straightness and orthogonality on a face",
    "artefact": "Straightness by turning the artefact over",
}
SLOPES = {
    "reversal": "slope of the line taken out: motion against the spindle's axis",
    "pair": "slope of the line taken out: motion against the spindle's axis",
    "face": "slope of the line taken out: orthogonality to the spindle's axis",
    "artefact": "slope of the line taken out: how the artefact was set up",
}
STRAIGHTNESS_FORMULAS = {
    "reversal": "m1 = a - s [G 3.1], m2 = a + s [G 3.2], s = (m2 - m1)/2 [G 3.3]; best-fit line taken out.",
    "pair": "s = (p2 after - p1 before)/2 and (p2 before - p1 after)/2 [G 3.3], their mean; best-fit line taken out.",
    "face": "δ = -(m1 + m2)/2 [G 3.8]; best-fit line taken out, its slope is the orthogonality.",
    "artefact": "m1 = s + a, turned over m2 = s - a, s = (m1 + m2)/2; best-fit line taken out.",
}
ARTEFACTS = {
    "reversal": "profile of the arbor",
    "pair": "profile of the arbor",
    "face": "tilt of the face",
    "artefact": "profile of the artefact",
}


def straightness_page(r: StraightnessResult, figures: bool = True) -> Page:
    """The page for one straightness; without figures for the terminal."""
    se = f" ± {2 * r.point_se_um:.2f} µm a point (k = 2)" if np.isfinite(r.point_se_um) else ""
    numbers = [(f"{r.peak_to_valley_um:.2f}\u00a0µm", "straightness, largest minus smallest")]
    if r.method == "face":
        numbers.append((f"{r.slope_urad:+.1f}\u00a0µrad", "orthogonality to the spindle's axis"))
    rows = [
        ["straightness, peak to valley", number(r.peak_to_valley_um), "µm"],
        ["straightness, root mean square", number(r.rms_um), "µm"],
        ["standard error of a point", number(r.point_se_um), "µm"],
        [SLOPES[r.method], number(r.slope_urad), "µrad"],
        ["standard error of that slope", number(r.slope_se_urad), "µrad"],
        ["sets of readings" + (", two a run" if r.method == "pair" else ""), str(r.repeats), ""],
    ]
    points = [
        [f"{x:g}", number(s, 3), number(a, 3)]
        for x, s, a in zip(r.position_mm, r.straightness_um, r.artefact_um, strict=True)
    ]
    other = f"{ARTEFACTS[r.method]} {'e' if r.method == 'face' else 'a'}, µm"
    figure = _straightness_figure(r) if figures else None
    head = [f"{r.axis.lower()}, mm", "straightness, µm", other]
    return Page(
        title=TITLES[r.method],
        lead=f"{r.name}: axis {r.axis} is straight to {r.peak_to_valley_um:.2f} µm{se} over "
        f"{np.ptp(r.position_mm):g} mm.",
        numbers=numbers,
        sections=[
            Section("Result", [*r.words], Table(["", "value", "unit"], rows, words=(0, 2)), figure),
            Section("Place by place", [], Table(head, points, words=())),
        ],
        foot=[*note_words(r.notes), STRAIGHTNESS_FORMULAS[r.method], f"rtec {__version__}, rtec straightness."],
    )


def _straightness_figure(r: StraightnessResult) -> Figure:
    below = ARTEFACTS[r.method].capitalize() + (", e" if r.method == "face" else ", best-fit line taken out")
    title = f"Straightness of {r.axis}: {r.peak_to_valley_um:.2f} µm"
    png = draw.straightness(
        title, f"{r.axis.lower()}, mm", r.position_mm, r.straightness_um, r.point_se_um, (below, r.artefact_um)
    )
    return Figure("straightness.png", png, f"{title}, over position, and below it what the artefact adds.")


def parallelism_page(r: ParallelismResult, figures: bool = True) -> Page:
    """The page for one parallelism; without figures for the terminal."""
    rows = [
        ["α_p: spindle's axis seen from the motion [G 3.5]", number(r.alpha_urad), "µrad"],
        ["motion seen from the spindle's axis (-α_p)", number(r.motion_urad), "µrad"],
        ["standard error", number(r.alpha_se_urad), "µrad"],
        ["taper of the arbor (radius)", number(r.taper_urad), "µrad"],
    ]
    places = [
        [f"{z:g}", *(number(v, 3) for v in (one.radius_um, two.radius_um, one.roundness_um, two.roundness_um))]
        for z, one, two in zip(r.position_mm, *r.circles, strict=True)
    ]
    head = [f"{r.axis.lower()}, mm", "R probe 1, µm", "R probe 2", "roundness 1, µm", "roundness 2, µm"]
    figure = None
    if figures:
        radius = r.radius_um
        png = draw.parallelism(
            f"{r.axis.lower()}, mm", r.position_mm, (radius[0] - radius[1]) / 2, r.alpha_urad * 1e-3, list(radius)
        )
        shows = f"The spindle's axis seen from the motion over {r.axis}, and the radii of the best-fit circles."
        figure = Figure("parallelism.png", png, shows)
    return Page(
        title=f"Parallelism of {r.axis} to the spindle's axis",
        lead=f"{r.name}: α_p = {r.alpha_urad:+.2f} µrad over {np.ptp(r.position_mm):g} mm, positive where the "
        "spindle's axis comes nearer to probe 1 as the position grows.",
        numbers=[(f"{r.alpha_urad:+.1f}\u00a0µrad", "parallelism")],
        sections=[
            Section("Result", [*r.words], Table(["", "value", "unit"], rows, words=(0, 2)), figure),
            Section("Circles", [], Table(head, places, words=())),
        ],
        foot=[
            "R = Σ r / n over a turn [G 3.4]; α_p = [(R21 - R11) - (R22 - R12)] / 2Δz [G 3.5].",
            f"rtec {__version__}, rtec parallelism.",
        ],
    )
