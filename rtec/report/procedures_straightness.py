"""Reports of straightness and parallelism."""

import numpy as np

from rtec import __version__
from rtec.metrology.procedures.straightness import Parallelism, Straightness
from rtec.report import procedures_figures as draw
from rtec.report.page import Figure, Page, Section, Table
from rtec.report.procedures import number

TITLES = {
    "reversal": "Straightness by reversal of the arbor",
    "pair": "Straightness by a pair of probes and reversal",
    "face": "Straightness and orthogonality on a face",
}
SLOPES = {"reversal": "misalignment of the arbor", "pair": "misalignment of the arbor", "face": "orthogonality"}
FORMULAS = {
    "reversal": "m1 = a - s [G 3.1], m2 = a + s [G 3.2], s = (m2 - m1)/2 [G 3.3]; best-fit line taken out.",
    "pair": "s = (p2 after - p1 before)/2 and (p2 before - p1 after)/2 [G 3.3], their mean; best-fit line taken out.",
    "face": "δ = -(m1 + m2)/2 [G 3.8]; best-fit line taken out, its slope is the orthogonality.",
}


def straightness_page(name: str, axis: str, r: Straightness, figures: bool = True) -> Page:
    """The page for one straightness; without figures it is what the terminal shows."""
    se = f" ± {2 * r.point_se_um:.2f} µm a point" if np.isfinite(r.point_se_um) else ""
    numbers = [(f"{r.peak_to_valley_um:.2f}\u00a0µm", "straightness, largest minus smallest")]
    if r.method == "face":
        numbers.append((f"{r.slope_urad:+.1f}\u00a0µrad", "orthogonality to the spindle's axis"))
    rows = [
        ["straightness, peak to valley", number(r.peak_to_valley_um), "µm"],
        ["straightness, root mean square", number(r.rms_um), "µm"],
        ["standard error of a point", number(r.point_se_um), "µm"],
        [SLOPES[r.method], number(r.slope_urad), "µrad"],
        ["its standard error", number(r.slope_se_urad), "µrad"],
        ["sets of readings", str(r.repeats), ""],
    ]
    points = [
        [f"{x:g}", number(s, 3), number(a, 3)]
        for x, s, a in zip(r.position_mm, r.straightness_um, r.artefact_um, strict=True)
    ]
    other = "tilt of the face e" if r.method == "face" else "profile of the arbor a"
    figure = _figure(axis, r) if figures else None
    return Page(
        title=TITLES[r.method],
        lead=f"{name}: axis {axis} is straight to {r.peak_to_valley_um:.2f} µm{se} over {np.ptp(r.position_mm):g} mm.",
        numbers=numbers,
        sections=[
            Section("Result", [*r.words], Table(["", "value", "unit"], rows, words=(0, 2)), figure),
            Section("Place by place", [], Table([f"{axis.lower()}, mm", "straightness, µm", other], points, words=())),
        ],
        foot=[FORMULAS[r.method], f"rtec {__version__}, rtec straightness."],
    )


def _figure(axis: str, r: Straightness) -> Figure:
    below = "Tilt of the face, e" if r.method == "face" else "Profile of the arbor, best-fit line taken out"
    title = f"Straightness of {axis}: {r.peak_to_valley_um:.2f} µm"
    png = draw.straightness(
        title, f"{axis.lower()}, mm", r.position_mm, r.straightness_um, r.point_se_um, (below, r.artefact_um)
    )
    return Figure("straightness.png", png, f"{title}, over position, and below it what the artefact adds.")


def parallelism_page(name: str, axis: str, r: Parallelism, figures: bool = True) -> Page:
    """The page for one parallelism; without figures it is what the terminal shows."""
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
    head = [f"{axis.lower()}, mm", "R probe 1, µm", "R probe 2", "left of circle 1", "left of circle 2"]
    figure = None
    if figures:
        radius = r.radius_um
        png = draw.parallelism(
            f"{axis.lower()}, mm", r.position_mm, (radius[0] - radius[1]) / 2, r.alpha_urad * 1e-3, list(radius)
        )
        shows = f"The spindle's axis seen from the motion over {axis}, and the radii of the best-fit circles."
        figure = Figure("parallelism.png", png, shows)
    return Page(
        title=f"Parallelism of {axis} to the spindle's axis",
        lead=f"{name}: α_p = {r.alpha_urad:+.2f} µrad over {np.ptp(r.position_mm):g} mm, positive where the spindle's "
        "axis comes nearer to probe 1 as the position grows.",
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
