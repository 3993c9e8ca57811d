"""The history of a model: every change, the error before and after it, and the staircase of falling errors."""

from collections.abc import Mapping, Sequence
from typing import Any

from rtec.diagnosis.words import UNITS, spoken
from rtec.model import Model
from rtec.model.history import History, rescaled, steps_of
from rtec.report.page import Figure, Page, Section, Table
from rtec.wording import NONE, counted, decimals, number, percent, sizes, two_numbers, with_error


def history_page(h: History, figures: bool = True) -> Page:
    """Every change of a model with the error before and after it."""
    model, steps = h.model, h.steps
    if not steps:
        lead = "This model has no history: it was written by hand, or fitted by an old version."
        return Page(f"History of {model.name}", lead, [], [])
    unit = UNITS.get(steps[-1]["unit"], steps[-1]["unit"])
    errors = stairs(steps)[1]
    fell = sizes(errors[-1])[0] if errors[0] == errors[-1] else " to ".join(two_numbers(errors[0], errors[-1]))
    went = "is" if errors[0] == errors[-1] else "fell from"
    lead = f"{counted(len(steps), 'change')}: the residual on held-out runs {went} {fell} {unit}."
    return Page(f"History of {model.name}", lead, [], history_sections(model, figures))


def model_page(model: Model, figures: bool = True) -> Page:
    """Overview of a model: its numbers and its history."""
    lead = f"{model.name}: {counted(len(model.effects), 'effect')} on {model.machine.name}."
    rows = [[r["effect"], r["name"], *with_error(r["value"], r["se"]), spoken(r["unit"])] for r in model.rows()]
    table = Table(("effect", "number", "value", "standard error", "unit"), rows, words=(0, 1, 4))
    return Page(f"Model {model.name}", lead, [], [Section("Numbers", [], table), *history_sections(model, figures)])


def history_sections(model: Model, figures: bool) -> list[Section]:
    """Sections on every change; empty where the model has no history."""
    steps = steps_of(model)
    if not steps:
        return []
    digits = decimals(*(s[key] for s in steps for key in ("error", "floor") if s[key] is not None))
    rows = [_step_row(s, digits) for s in steps]
    head = ("change", "before", "after", "falls by", "noise floor", "unit")
    table = Table(head, rows, "Root mean squares on held-out runs; falls by: of the mean square.", words=(0, 5))
    words = [_changed(s) for s in steps if s["before"] is not None]
    words += [f"{s['name']}: {OTHER_START} other measurements were used." for s in steps if s["other_data"]]
    words += [f"{s['name']}: {OTHER_START} {_moved(steps, i)}" for i, s in enumerate(steps) if s["noise_anew"]]
    words += [_passed_over(s) for s in steps if s["passed_over"]]
    return [Section("The error falling", words, table, _staircase(steps) if figures else None)]


OTHER_START = "'before' differs from 'after' in the row above:"


def _moved(steps: Sequence[Mapping[str, Any]], i: int) -> str:
    """Reason why the same measurements have another error before this step than after the last one."""
    now, last = steps[i], steps[i - 1]
    if now["unit"] == "noise":
        return (
            "the noise was re-estimated without the effect that the model lacked; "
            f"{number(last['error'])} × the noise of then is {number(now['before'])} × the noise of now."
        )
    if last["name"] == "fit":
        return "a fit holds out other parts of the same measurements and weighs them otherwise."
    return "the noise of the same measurements, and so their weights, were re-estimated."


def _passed_over(s: Mapping[str, Any]) -> str:
    names = ", ".join(str(r.get("effect", "?")) for r in s["passed_over"])
    tests = dict.fromkeys(str(r["separating_test"]) for r in s["passed_over"] if r.get("separating_test"))
    way = f" To separate them: {'; '.join(list(tests)[:2])}." if tests else ""
    return f"{s['name']}: cannot be distinguished from {names} by these data.{way}"


def _step_row(s: Mapping[str, Any], digits: int) -> list[str]:
    before = s["before"]
    fall = NONE if not before else percent(1.0 - (s["error"] / before) ** 2)
    floor = NONE if s["floor"] is None else number(float(s["floor"]), digits)
    unit = UNITS.get(s["unit"], s["unit"])
    start, end = (NONE if before is None else number(before, digits)), number(s["error"], digits)
    return [s["name"], start, end, fall, floor, unit]


def _changed(s: Mapping[str, Any]) -> str:
    unit = UNITS.get(s["unit"], s["unit"])
    before, after = two_numbers(s["before"], s["error"])
    return f"{s['name']}: {before} {unit} before, {after} {unit} after."


def stairs(steps: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[float], float | None]:
    """Steps of the staircase: names and residuals, and the noise floor.

    Errors on other measurements are not comparable, so that it begins with the first step on the last measurements.
    """
    unit = steps[-1]["unit"]
    same = [{**s, "error": e} for s, e in zip(steps, rescaled(steps), strict=True) if s["unit"] == unit]
    begin = max((i for i, s in enumerate(same) if s["other_data"]), default=0)
    names, errors = [s["name"] for s in same[begin:]], [s["error"] for s in same[begin:]]
    before = same[begin]["before"]
    if before is not None:
        names, errors = ["before, same measurements" if begin else "as it was", *names], [before, *errors]
    return names, errors, next((float(s["floor"]) for s in reversed(same) if s["floor"] is not None), None)


def _staircase(steps: Sequence[Mapping[str, Any]]) -> Figure:
    from rtec.report.history_figures import staircase

    unit = steps[-1]["unit"]
    png = staircase(UNITS.get(unit, unit), *stairs(steps))
    return Figure("history.png", png, "The residual on held-out runs after each change, and the noise floor.")
