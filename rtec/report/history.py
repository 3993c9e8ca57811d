"""The history of a model: every change, what it bought, and the staircase of the error falling."""

from collections.abc import Mapping, Sequence
from typing import Any

from rtec.diagnosis.usable import apart
from rtec.diagnosis.words import UNITS
from rtec.model import Model
from rtec.report.page import Figure, Page, Section, Table, number


def history_page(model: Model, figures: bool = True) -> Page:
    """Every change of a model and what it bought."""
    steps = steps_of(model)
    if not steps:
        lead = "This model has no history: it was written by hand, or fitted before histories were kept."
        return Page(f"History of {model.name}", lead, [], [])
    last, errors = steps[-1], rescaled(steps)
    # A refit alone begins with what the model left as it stood.
    begun = errors[0] if len(steps) > 1 or steps[0]["before"] is None else steps[0]["before"]
    unit = UNITS.get(last["unit"], last["unit"])
    fell = f"{errors[-1]:.3g} {unit}" if begun == errors[-1] else f"from {begun:.3g} to {errors[-1]:.3g} {unit}"
    lead = f"{len(steps)} {'entry' if len(steps) == 1 else 'entries'}: {fell} on runs left out of the fit."
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
        same = _same_data(entry, model, out)
        out.append(
            {
                "name": ", ".join(entry.get("effects", ())) or str(entry.get("change", "change")),
                "before": None if before is None else float(before),
                "error": float(after),
                "floor": entry.get("noise_floor"),
                "unit": str(entry.get("unit", "um")),
                "measurements": sorted(entry.get("measurements", ())),
                "inside": entry.get("rms_inside"),
                "other_data": moved and not same,
                "noise_anew": moved and same,
                "passed_over": [dict(r) for r in entry.get("passed_over", ())],
            }
        )
    return out


def _same_data(entry: Mapping[str, Any], model: Model, before: Sequence[Mapping[str, Any]]) -> bool:
    """Whether an entry was judged on the measurements of the one before it."""
    if not before:
        return False
    if "same_measurements" in entry:
        return bool(entry["same_measurements"])
    now, last = sorted(entry.get("measurements", ())), before[-1]
    # A fit does not name its measurements; where the model knows no others, they are those of this entry.
    return now == (last["measurements"] or sorted(model.measurements))


def rescaled(steps: Sequence[Mapping[str, Any]]) -> list[float]:
    """Errors after each step, all in the yardstick of the last.

    In multiples of the noise the yardstick is found anew at every step: a model that misses much takes a part of it
    for noise. What the step before left is then what this one began with.
    """
    out = [float(s["error"]) for s in steps]
    for i in range(len(steps) - 1, 0, -1):
        s = steps[i]
        if s["unit"] == "noise" and s["noise_anew"] and steps[i - 1]["unit"] == "noise":
            factor = s["before"] / max(steps[i - 1]["error"], 1e-12)
            out[:i] = [v * factor for v in out[:i]]
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
    words += [f"{s['name']}: {said} {_anew(steps, i)}" for i, s in enumerate(steps) if s["noise_anew"]]
    words += [_passed_over(s) for s in steps if s["passed_over"]]
    return [Section("The error falling", words, table, _staircase(steps) if figures else None)]


def _anew(steps: Sequence[Mapping[str, Any]], i: int) -> str:
    """Why the same measurements give another error before this step than after the last."""
    now, last = steps[i], steps[i - 1]
    if now["unit"] == "noise":
        return (
            "the noise that errors are counted in was found anew, without what the model missed; "
            f"{last['error']:.3g} times the noise as known then are {now['before']:.3g} times the noise as known now."
        )
    if last["name"] == "fit":
        return "the same measurements, but a fit leaves out other parts of them and weighs them otherwise."
    return "the same measurements, but their noise, and so their weights, were found anew."


def _passed_over(s: Mapping[str, Any]) -> str:
    names = ", ".join(str(r.get("effect", "?")) for r in s["passed_over"])
    tests = dict.fromkeys(str(r["separating_test"]) for r in s["passed_over"] if r.get("separating_test"))
    tell = f" What tells them apart: {'; '.join(list(tests)[:2])}." if tests else ""
    return f"{s['name']}: these readings cannot tell it from {names}, passed over.{tell}"


def _step_row(s: Mapping[str, Any]) -> list[str]:
    before = s["before"]
    fall = "–" if not before else f"{1.0 - (s['error'] / before) ** 2:.0%}"
    floor = "–" if s["floor"] is None else number(float(s["floor"]), 3)
    unit = UNITS.get(s["unit"], s["unit"])
    return [s["name"], "–" if before is None else number(before, 3), number(s["error"], 3), fall, floor, unit]


def _bought(s: Mapping[str, Any]) -> str:
    unit = UNITS.get(s["unit"], s["unit"])
    before, after = apart(s["before"], s["error"])
    return f"{s['name']}: {before} {unit} became {after}."


def _staircase(steps: Sequence[Mapping[str, Any]]) -> Figure:
    from rtec.report.history_figures import staircase

    unit = steps[-1]["unit"]
    same = [{**s, "error": e} for s, e in zip(steps, rescaled(steps), strict=True) if s["unit"] == unit]
    names: list[str] = []
    errors: list[float] = []
    for i, s in enumerate(same):
        if s["before"] is not None and (i == 0 or s["other_data"]):
            names.append("as it was" if i == 0 else "on the new measurements")
            errors.append(s["before"])
        names.append(s["name"])
        errors.append(s["error"])
    floor = next((float(s["floor"]) for s in reversed(same) if s["floor"] is not None), None)
    png = staircase(UNITS.get(unit, unit), names, errors, floor)
    return Figure("history.png", png, "The residual on held-out runs after each change, and the noise floor.")
