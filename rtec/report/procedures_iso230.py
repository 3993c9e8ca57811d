"""Report of a positioning test after ISO 230-2."""

import numpy as np

from rtec import __version__
from rtec.metrology.procedures.iso230_2 import Positioning
from rtec.report import procedures_figures as draw
from rtec.report.page import Figure, Page, Section, Table
from rtec.report.procedures import number

FORMULAS = (
    "x̄ᵢ mean and sᵢ standard deviation of the deviations at target i; Bᵢ = x̄ᵢ↑ - x̄ᵢ↓; B = max|Bᵢ|.",
    "R↑ = max 4sᵢ↑; Rᵢ = max(2sᵢ↑ + 2sᵢ↓ + |Bᵢ|, 4sᵢ↑, 4sᵢ↓); R = max Rᵢ.",
    "E: largest minus smallest mean of both directions; M: the same of the bidirectional means (x̄ᵢ↑ + x̄ᵢ↓)/2.",
    "A: largest x̄ + 2s minus smallest x̄ - 2s of both directions. Coverage factor 2.",
)


def iso230_page(results: list[Positioning], figures: bool = True) -> Page:
    """The page for one or more tests; without figures it is what the terminal shows."""
    first = results[0]
    return Page(
        title="Positioning after ISO 230-2",
        lead="; ".join(f"{r.visits.name}: {_lead(r)}" for r in results) + ".",
        numbers=_numbers(first) if len(results) == 1 else [],
        sections=[s for i, r in enumerate(results) for s in _sections(r, i, figures)],
        foot=[*FORMULAS, f"rtec {__version__}, rtec iso230."],
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
        Section("Target by target", [], _target_table(r), _figure(r, index) if figures else None),
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


def _figure(r: Positioning, index: int) -> Figure:
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
