"""Report of `rtec table`: the written table, or the difference of an existing one from a model."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtec.correction.tables.predict import TableResidual
from rtec.correction.tables.table import CompensationTable, TableFormat
from rtec.report.page import Page, Section, Table

SHOWN_UM = 0.005
"""Smaller differences are not listed."""
NEAR_MM = 0.01
"""Largest accepted distance from the end of a table to the end of the travel."""


def written_page(
    table: CompensationTable,
    form: TableFormat,
    residuals: Sequence[TableResidual],
    path: Path | None,
    beyond: Sequence[str] = (),
) -> Page:
    """The page of a written table."""
    low, high = float(table.positions_mm[0]), float(table.positions_mm[-1])
    values = np.array([table.forward_um, table.backward_um])
    points = f"{len(table.positions_mm)}{f' x {len(table.second_mm)}' if table.second else ''} points"
    worst = residuals[0]
    lead = (
        f"{form.title}: axis {table.what}, {points} from {low:g} to {high:g} mm, errors from "
        f"{values.min():+.2f} to {values.max():+.2f} µm. Largest residual: {worst.largest_um:.2f} µm, {worst.what}."
    )
    rows = [(r.what, f"{r.largest_um:.2f}") for r in residuals if r.largest_um >= SHOWN_UM] or [("nothing", "0.00")]
    left = Section("What the table cannot express", (), Table(("alone", "residual, µm"), rows))
    facts = [f"Columns: {form.sign}.", f"Use: {form.use.replace('= FILE', f'= {path.name}' if path else '= FILE')}."]
    sections = [Section("", [*_warned(beyond), *facts]), left, *_heat_section(table)]
    return Page("Compensation table", lead, (), sections)


def _warned(beyond: Sequence[str]) -> list[str]:
    """Sentence where the model does not know the conditions; else none."""
    return [f"Beware: {'; '.join(beyond)}. No measurement has been there, and the loop would hold."] if beyond else []


def _heat_section(table: CompensationTable) -> list[Section]:
    """Section with the numbers that a control with temperature compensation needs."""
    if not table.heat:
        return []
    rows = [(h.sensor, f"{h.offset_um:+.3f}", f"{h.slope_um_per_m:+.3f}", f"{h.residual_um:.3f}") for h in table.heat]
    head = ("each °C of", f"at {table.heat[0].reference_mm:g} mm, µm", "slope, µm/m", "not straight, µm")
    note = "For a control that adds temperature as a straight line; from the temperatures of the table on."
    return [Section("What temperature adds to the error", [note], Table(head, rows))]


def compared_page(
    table: CompensationTable,
    model: CompensationTable,
    form: TableFormat,
    source: Path,
    travel_mm: tuple[float, float],
    beyond: Sequence[str] = (),
) -> Page:
    """The page of an existing table, with a model's prediction at its points."""
    differences = np.array([model.forward_um - table.forward_um, model.backward_um - table.backward_um])
    worst = np.unravel_index(np.abs(differences).argmax(), differences.shape)
    place = f"{table.positions_mm[worst[-1]]:g} mm"
    if table.second:
        place += f", {table.second} {table.second_mm[worst[1]]:g} mm"
    rms = float(np.sqrt((differences**2).mean()))
    lead = (
        f"{source.name}: {form.title}, axis {table.what}, {table.forward_um.size} points. The model differs from it by "
        f"up to {np.abs(differences).max():.2f} µm (at {place}), rms {rms:.2f} µm, mean {differences.mean():+.2f} µm."
    )
    across = table.second_mm.tolist() if table.second else [0.0]
    columns = [np.atleast_2d(v) for v in (table.forward_um, model.forward_um, table.backward_um, model.backward_um)]
    rows = [
        (*([f"{y:g}"] if table.second else []), f"{q:g}", *(f"{c[j, i]:+.2f}" for c in columns))
        for j, y in enumerate(across)
        for i, q in enumerate(table.positions_mm.tolist())
    ]
    head: tuple[str, ...] = ("position, mm", "table +, µm", "model +, µm", "table -, µm", "model -, µm")
    head = (f"{table.second}, mm", f"{table.axis}, mm", *head[1:]) if table.second else head
    caption = "Error, actual minus nominal: + arriving in positive direction, - in negative."
    covers, zero = _covers(table, travel_mm), model.zero_um
    without = [f"The format has a zero: the model is compared without its {zero:+.2f} µm there."] if zero else []
    facts = [*_warned(beyond), *([covers] if covers else []), *without]
    return Page("Compensation table", lead, (), [Section("", facts, Table(head, rows, caption, words=()))])


def _covers(table: CompensationTable, travel_mm: tuple[float, float]) -> str | None:
    """Sentence where the table ends before the travel does; else None."""
    low, high = float(table.positions_mm[0]), float(table.positions_mm[-1])
    if low <= travel_mm[0] + NEAR_MM and high >= travel_mm[1] - NEAR_MM:
        return None
    return (
        f"The table covers {low:g} to {high:g} mm of the travel, {travel_mm[0]:g} to {travel_mm[1]:g} mm. Beyond its "
        "ends a control holds its last value, or none."
    )
