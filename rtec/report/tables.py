"""What `rtec table` says: the table that was written, or how one that is there differs from a model."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rtec.correction.tables.predict import TableResidual
from rtec.correction.tables.table import CompensationTable, TableFormat
from rtec.report.page import Page, Section, Table

SHOWN_UM = 0.005
"""What is smaller is not listed."""


def written_page(
    table: CompensationTable, form: TableFormat, residuals: Sequence[TableResidual], path: Path | None
) -> Page:
    """The page of a table that was written."""
    low, high = float(table.positions_mm[0]), float(table.positions_mm[-1])
    values = np.concatenate([table.forward_um, table.backward_um])
    what = table.axis if table.axis == table.corrects else f"{table.corrects} along {table.axis}"
    worst = residuals[0]
    lead = (
        f"{form.title}: axis {what}, {len(table.positions_mm)} points from {low:g} to {high:g} mm, errors from "
        f"{values.min():+.2f} to {values.max():+.2f} µm. Largest residual: {worst.largest_um:.2f} µm, {worst.what}."
    )
    rows = [(r.what, f"{r.largest_um:.2f}") for r in residuals if r.largest_um >= SHOWN_UM] or [("nothing", "0.00")]
    left = Section("What the table cannot express", (), Table(("alone", "residual, µm"), rows))
    facts = [f"Columns: {form.sign}.", f"Use: {form.use.replace('= FILE', f'= {path.name}' if path else '= FILE')}."]
    sections = [Section("", facts), left]
    return Page("Compensation table", lead, (), sections)


def compared_page(table: CompensationTable, model: CompensationTable, form: TableFormat, source: Path) -> Page:
    """The page of a table that is there, beside what a model predicts at its points."""
    forward, backward = model.forward_um - table.forward_um, model.backward_um - table.backward_um
    both = np.abs(np.concatenate([forward, backward]))
    k = int(both.argmax()) % len(table.positions_mm)
    shift = float(np.concatenate([forward, backward]).mean())
    rms = float(np.sqrt((both**2).mean()))
    lead = (
        f"{source.name}: {form.title}, axis {table.axis}, {len(table.positions_mm)} points. The model "
        f"differs from it by up to {both.max():.2f} µm (at {table.positions_mm[k]:g} mm), rms {rms:.2f} µm, "
        f"mean {shift:+.2f} µm."
    )
    rows = [
        (f"{q:g}", f"{a:+.2f}", f"{m:+.2f}", f"{b:+.2f}", f"{n:+.2f}")
        for q, a, m, b, n in zip(
            table.positions_mm, table.forward_um, model.forward_um, table.backward_um, model.backward_um, strict=True
        )
    ]
    head = ("position, mm", "table +, µm", "model +, µm", "table -, µm", "model -, µm")
    caption = "Error, actual minus nominal: + arriving in positive direction, - in negative."
    return Page("Compensation table", lead, (), [Section("", (), Table(head, rows, caption, words=()))])
