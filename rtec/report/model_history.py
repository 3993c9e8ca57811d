"""The history of a model: every change, what it bought, and the staircase of the error falling."""

from collections.abc import Mapping, Sequence
from typing import Any

from rtec.diagnosis.words import UNITS
from rtec.model import Model
from rtec.report.html import Figure, Page, Section, Table
from rtec.report.procedures import number


def history_page(model: Model, figures: bool = True) -> Page:
    """Every change of a model and what it bought."""
    steps = steps_of(model)
    if not steps:
        lead = "This model has no history: it was written by hand, or fitted before histories were kept."
        return Page(f"History of {model.name}", lead, [], [])
    first, last = steps[0], steps[-1]
    lead = (
        f"{len(steps)} {'entry' if len(steps) == 1 else 'entries'}: from {first['error']:.3g} to {last['error']:.3g} "
        f"{UNITS.get(last['unit'], last['unit'])} on runs left out of the fit."
    )
    return Page(f"History of {model.name}", lead, [], history_sections(model, figures))


def steps_of(model: Model) -> list[dict[str, Any]]:
    """Entries of a model's history that know their error on runs left out."""
    out: list[dict[str, Any]] = []
    for entry in model.history:
        after = entry.get("rms_after", entry.get("rms_held_out"))
        if after is None:
            continue
        before = entry.get("rms_before")
        moved = bool(out) and before is not None and abs(float(before) / max(out[-1]["error"], 1e-12) - 1.0) > 0.05
        data = sorted(entry.get("measurements", ()))
        out.append(
            {
                "name": ", ".join(entry.get("effects", ())) or str(entry.get("change", "change")),
                "before": None if before is None else float(before),
                "error": float(after),
                "floor": entry.get("noise_floor"),
                "unit": str(entry.get("unit", "um")),
                "measurements": data,
                "other_data": moved and data != out[-1]["measurements"],
                "noise_anew": moved and data == out[-1]["measurements"],
            }
        )
    return out


def history_sections(model: Model, figures: bool) -> list[Section]:
    """The section of every change; none where the model has no history."""
    steps = steps_of(model)
    if not steps:
        return []
    rows = [_step_row(s) for s in steps]
    head = ("change", "before", "after", "mean square falls by", "noise floor", "unit")
    table = Table(head, rows, "Root mean squares on runs left out of the fit.", words=(0, 5))
    words = [_bought(s) for s in steps if s["before"] is not None]
    said = "'before' is not the 'after' of the row above:"
    words += [f"{s['name']}: {said} it was judged on other measurements." for s in steps if s["other_data"]]
    words += [f"{s['name']}: {said} the noise, and so the weights, were found anew." for s in steps if s["noise_anew"]]
    return [Section("The error falling", words, table, _staircase(steps) if figures else None)]


def _step_row(s: Mapping[str, Any]) -> list[str]:
    before = s["before"]
    fall = "–" if not before else f"{1.0 - (s['error'] / before) ** 2:.0%}"
    floor = "–" if s["floor"] is None else number(float(s["floor"]), 3)
    unit = UNITS.get(s["unit"], s["unit"])
    return [s["name"], "–" if before is None else number(before, 3), number(s["error"], 3), fall, floor, unit]


def _bought(s: Mapping[str, Any]) -> str:
    unit = UNITS.get(s["unit"], s["unit"])
    return f"{s['name']}: {s['before']:.3g} {unit} became {s['error']:.3g}."


def _staircase(steps: Sequence[Mapping[str, Any]]) -> Figure:
    from rtec.report import diagnosis_figures

    unit = steps[-1]["unit"]
    same = [s for s in steps if s["unit"] == unit]
    names: list[str] = []
    errors: list[float] = []
    for i, s in enumerate(same):
        if s["before"] is not None and (i == 0 or s["other_data"]):
            names.append("as it was" if i == 0 else "on the new measurements")
            errors.append(s["before"])
        names.append(s["name"])
        errors.append(s["error"])
    floor = next((float(s["floor"]) for s in reversed(same) if s["floor"] is not None), None)
    png = diagnosis_figures.staircase(UNITS.get(unit, unit), names, errors, floor)
    return Figure("history.png", png, "The error on runs left out after each change, and the noise floor.")
