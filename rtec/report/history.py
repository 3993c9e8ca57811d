"""Reports of changes of a model, by `rtec add`, `rtec improve` and `rtec history`: the error before and after each."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rtec.diagnosis.doubts.not_read import not_logged_beside, unread_beside
from rtec.diagnosis.extend.add import CLEARLY, Added, not_determined
from rtec.diagnosis.extend.history import Errors
from rtec.diagnosis.extend.improve import NEAREST, SHAPE, Improved
from rtec.diagnosis.extend.record_event import words
from rtec.diagnosis.words import REFITS, drifts, of_changes, of_sensors, of_warmth, sentence, spoken
from rtec.model import Model
from rtec.model.history import History, rescaled, steps_of
from rtec.report.diagnosis import by_expression
from rtec.report.figures import OFF, ON, as_png, log_ticks, stacked
from rtec.report.page import Figure, Page, Section, Table, shell_command
from rtec.wording import (
    ERROR_UNITS,
    NONE,
    counted,
    decimals,
    number,
    percent,
    significant,
    sizes,
    two_numbers,
    with_error,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

HALF = 0.5
"""A number has changed if at least this share of what a refit found remains beside the effects that were added."""
FAR_ABOVE = 2.0
"""Held-out runs are met where they are met to less than this many times the noise floor: each run drifts."""
MOST_RIVALS = 3
"""Effects in the text on a step that cannot be distinguished from the added one."""
WHY_ENDED = {
    "nothing_missing": "no effect is missing that these readings could show",
    "undecided": "these readings do not decide what is missing",
    "unknown_effect": "the effect that is missing is not in the catalogue",
    "ambiguous": "the next effect cannot be determined from these data",
    "stopped": "you stopped it",
    "at_floor": "the residual is at the noise floor",
    "no_gain": "the next effect would lower the error on held-out runs by less than 2 %",
    "narrow_range": "the next effect follows a temperature that varied by less than 1 °C: measure over a wider range, "
    "or add it with rtec add",
    "steps": "one call adds no more effects than these",
}


NOW, NEAR = "now, these measurements", 0.05
"""Name of the present residual; share by which it may differ from the last step's and still be the same."""


@dataclass(frozen=True)
class Present:
    """The residual of the measurements that a model is compared with now.

    Attributes:
        rms: root mean square residual.
        floor: noise floor; None where it is unknown.
        unit: unit of both, as in a history.
    """

    rms: float
    floor: float | None
    unit: str


@dataclass(frozen=True)
class Stairs:
    """A staircase of the error.

    Attributes:
        names, errors: of the steps.
        floor: noise floor; None where it is unknown.
        unit: of the errors, as in a history.
        at: index of the current step.
        ends_now: whether the last is no step but the present residual of other measurements.
    """

    names: list[str]
    errors: list[float]
    floor: float | None
    unit: str
    at: int
    ends_now: bool = False


def fell(before: Errors, after: Errors, unit: str) -> str:
    """How the residual on held-out runs fell, in words: beyond slow drift, where only that did.

    Args:
        before, after: the errors.
        unit: of both, as in words.
    """
    one, two = two_numbers(before.held_out, after.held_out)
    if after.held_out <= before.held_out:
        return f"fell from {one} to {two} {unit}"
    sharp, sharper = two_numbers(before.beyond_drift, after.beyond_drift)
    return (
        f"is {two} {unit}, as before mostly slow drift that no recorded channel explains; beyond that drift it fell "
        f"from {sharp} to {sharper} times the noise"
    )


def added_page(a: Added, figures: bool = True) -> Page:
    """The error before and after an addition.

    Args:
        a: the addition.
        figures: whether to draw.
    """
    section = _before_and_after(a)
    what = ", ".join(a.labels) or "refitted numbers"
    before, after = two_numbers(a.before.held_out, a.after.held_out)
    unit = ERROR_UNITS[a.unit]
    lead = (
        f"With {what} the residual on held-out runs is {after} {unit}, before it was {before} {unit}; the noise floor "
        f"is {sizes(a.floor)[0]} {unit}."
    )
    if a.better and a.after.held_out > a.before.held_out:
        lead = f"With {what} the residual on held-out runs {fell(a.before, a.after, unit)}."
    lead = " ".join([lead, *(f"{u.words}: {u.advice}." for u in a.unmeasured)])
    return Page(
        "Before and after",
        lead,
        [],
        [section, *history_sections(a.model, figures)],
        brief=Section("", [], section.table),
        next=[shell_command("rtec", "diagnose", *a.files)] if a.files else [],
    )


def _before_and_after(a: Added) -> Section:
    unit = ERROR_UNITS[a.unit]
    fall = 1.0 - (a.after.held_out / a.before.held_out) ** 2 if a.before.held_out > 0 else 0.0
    what = ", ".join(a.labels) or "refitted numbers"
    errors = [
        ("as given", a.before.as_given or math.nan, math.nan),
        *([("refitted", a.before.inside, a.before.held_out)] if a.labels else []),
        (f"with {what}", a.after.inside, a.after.held_out),
        ("noise floor", a.floor, a.floor),
    ]
    digits = decimals(a.floor, a.after.held_out)
    rows = [[name, number(inside, digits), number(held_out, digits)] for name, inside, held_out in errors]
    table = Table(("model", f"fitted readings, {unit}", f"held-out runs, {unit}"), rows)
    words = [
        f"The mean square on held-out runs {'falls' if fall > 0 else 'rises'} by {percent(abs(fall))}.",
        *(
            [
                "With temperatures smoothed both ways in time, which the loop cannot do, the residual would be "
                f"{number(a.smoothed, digits)} {unit}."
            ]
            if any(set(f.effect.channels(a.model.machine)) & set(a.model.machine.sensor_names) for f in a.model.effects)
            else []
        ),
        *map(sentence, a.notes),
    ]
    return Section("Before and after", words, table)


def _refit_words(refit: Added, model: Model) -> str:
    """The error before and after a refit of the model's own numbers, and which of them have changed.

    A number that made up for a missing effect, and is as before beside it, has not changed.

    Args:
        refit: the refit.
        model: in the end.
    """
    went = fell(refit.before, refit.after, ERROR_UNITS[refit.unit])
    values = {(f.label, n): v for f in model.effects for n, v in f.values.items()}
    ends = [replace(c, now=values.get((c.effect, c.name), c.now)) for c in refit.changed]
    changed = [e for e, c in zip(ends, refit.changed, strict=True) if abs(e.now - e.was) > HALF * abs(c.now - c.was)]
    why = of_changes(changed) if changed else "These readings refine the model's own numbers"
    return f"{why}; refitted, the residual on held-out runs {went}.{of_warmth(changed)}{of_sensors(changed)} "


def improved_page(r: Improved, figures: bool = True) -> Page:
    """All steps of an improvement.

    Args:
        r: the improvement.
        figures: whether to draw.
    """
    refit = _refit_words(r.refit, r.model) if r.refit else ""
    if not r.steps:
        lead = f"{refit}No effect was added: {_why_ended(r)}."
        said = r.reason in ("unknown_effect", "nothing_missing")  # by the verdict
        lead = f"{refit}No effect was added." if said else lead
        lead = f"{lead} {_last_verdict(r)}"
    else:
        first, last = r.steps[0], r.steps[-1]
        unit = ERROR_UNITS[last.unit]
        went = fell(first.before, last.after, unit)
        added = counted(sum(len(s.labels) for s in r.steps), "effect")
        lead = (
            f"{refit}{added} added: the residual on held-out runs {went}; "
            f"the noise floor is {sizes(last.floor)[0]} {unit}. It ended because {_why_ended(r)}."
        )
        lead += f" {_last_verdict(r)}" if r.reason in ("undecided", "ambiguous") else ""
        near = [", ".join(s.labels) for s in r.steps if any(n.startswith(NEAREST) for n in s.notes)]
        lead += f" {' and '.join(near)}: only the nearest of the catalogue to what was missing." if near else ""
        shapes = [", ".join(s.labels) for s in r.steps if any(n.startswith(SHAPE) for n in s.notes)]
        are = "is" if len(shapes) == 1 else "are"
        lead += (
            f" {' and '.join(shapes)} {are} the shape of what no effect of the catalogue describes." if shapes else ""
        )
    lead = " ".join([lead, *(sentence(s.notes[0]) for s in r.steps if s.in_place_of and s.notes)])
    lead = " ".join([lead, *(f"{u.words}: {u.advice}." for s in r.steps for u in s.unmeasured)])
    if r.events:
        lead = f"{words(r.events)} {lead}"
    judged = r.diagnoses[-1].judged if r.diagnoses else None
    if judged:
        read = judged.readings.measurements
        lead += "".join(f" {d.words}" for d in r.diagnoses[-1].doubts if d.kind == "warm_start")
        lead += unread_beside(read, r.diagnoses[-1].doubts) + not_logged_beside(read)
    steps = [
        Section(f"Step {i}: {', '.join(s.labels)}", _before_and_after(s).text, _before_and_after(s).table)
        for i, s in enumerate(r.steps, 1)
    ]
    tail = [Section("Last diagnosis", [_last_verdict(r)])] if r.diagnoses else []
    history = history_sections(r.model, figures)
    return Page(
        "The model improved",
        lead,
        [],
        [*history, *steps, *tail],
        brief=Section("", _not_distinguished(r), history[0].table if history else None),
        next=_next(r),
    )


def _not_distinguished(r: Improved) -> list[str]:
    """What each step passed over."""
    now = steps_of(r.model)[-len(r.steps) :] if r.steps else []
    return [_passed_over(s) for s in now if s["passed_over"]]


def _next(r: Improved) -> list[str]:
    """The command that adds or shows what is still missing, and the one that shows the steps."""
    if not r.files:
        return []
    shown = [shell_command("rtec", "history", r.files[0], "--report", "out/history")] if r.steps or r.refit else []
    if r.reason == "unknown_effect" and (typed := by_expression(r.diagnoses[-1], r.files, r.machine_option)):
        return [*typed, *shown]
    asks = r.reason in ("unknown_effect", "ambiguous")
    return [*([shell_command("rtec", "diagnose", *r.files, *r.machine_option)] if asks else []), *shown]


def _why_ended(r: Improved) -> str:
    """Why the improvement ended, in words."""
    if r.impossible:
        return "; ".join(r.impossible)
    if r.reason == "no_gain" and r.cancelling:
        return not_determined(r.cancelling)
    last = r.diagnoses[-1].findings[:1] if r.reason == "no_gain" else ()
    if last and last[0].heldout_drop > 1.0 - (1.0 - CLEARLY) ** 2:
        return (
            f"{WHY_ENDED[r.reason]} with the temperatures that the loop has and near the model's earlier numbers; in "
            f"`rtec diagnose`, with smoothed temperatures and free numbers, it removes {percent(last[0].heldout_drop)} "
            "of the mean square"
        )
    if r.reason == "unknown_effect" and r.steps:
        return "what is still missing is not in the catalogue"
    if r.reason == "nothing_missing" and r.steps:
        return _beside(r, _unexplained(r.steps[-1]) or WHY_ENDED[r.reason]) + drifts(r.diagnoses[-1])
    return WHY_ENDED[r.reason]


def _unexplained(last: Added) -> str:
    """That held-out runs are far above the noise although no effect is named, in words; else empty."""
    times = last.after.held_out / last.floor if last.floor > 0.0 else 0.0
    if times < FAR_ABOVE:
        return ""
    return (
        f"no effect of the catalogue predicts the rest, {significant(times, 2)} times the noise floor on held-out "
        "runs: what drives it may not be recorded, or may be two channels together"
    )


def _beside(r: Improved, verdict: str) -> str:
    """A verdict on the readings without what happened in their record, in words."""
    return f"beside {'that' if len(r.events) == 1 else 'these'} {verdict}" if r.events else verdict


def _last_verdict(r: Improved) -> str:
    """The verdict of the last diagnosis; an effect that was tried and not added is named as that.

    What the diagnosis says of the error on held-out runs is of smoothed temperatures and of its own weights.
    """
    last = r.diagnoses[-1]
    if r.reason not in ("no_gain", "narrow_range") or not last.findings:
        return sentence(_beside(r, last.sentence.replace(f" {REFITS}", "")))
    return f"Not added: {last.findings[0].label}, which `rtec diagnose` names first."


def history_page(h: History, figures: bool = True) -> Page:
    """Every change of a model with the error before and after it."""
    model, steps = h.model, h.steps
    if not steps:
        lead = "This model has no history: it was written by hand, or fitted by an old version."
        return Page(f"History of {model.name}", lead, [], [])
    unit = ERROR_UNITS.get(steps[-1]["unit"], steps[-1]["unit"])
    errors = stairs(steps)[1]
    now = sizes(errors[-1])[0] if errors[0] == errors[-1] else " to ".join(two_numbers(errors[0], errors[-1]))
    went = "is" if errors[0] == errors[-1] else "fell from" if errors[-1] < errors[0] else "went from"
    lead = f"{counted(len(steps), 'change')}: the residual on held-out runs {went} {now} {unit}."
    return Page(f"History of {model.name}", lead, [], history_sections(model, figures))


def model_page(model: Model, figures: bool = True) -> Page:
    """Overview of a model: its numbers and its history."""
    lead = f"{model.name}: {counted(len(model.effects), 'effect')} on {model.machine.name}."
    rows = [[r["effect"], r["name"], *with_error(r["value"], r["se"]), spoken(r["unit"])] for r in model.rows()]
    table = Table(("effect", "number", "value", "standard error", "unit"), rows, words=(0, 1, 4))
    return Page(f"Model {model.name}", lead, [], [Section("Numbers", [], table), *history_sections(model, figures)])


def history_sections(model: Model, figures: bool, now: Present | None = None) -> list[Section]:
    """Sections on every change; empty where the model has no history.

    Args:
        model: the model.
        figures: whether to draw.
        now: residual of the measurements that it is compared with now.
    """
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
    return [Section("The error falling", words, table, _staircase(steps, now) if figures else None)]


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
    rivals = [str(r.get("effect", "?")) for r in s["passed_over"]]
    more = [f"{len(rivals) - MOST_RIVALS} more"] if len(rivals) > MOST_RIVALS + 1 else []
    names = ", ".join([*rivals[: MOST_RIVALS if more else None], *more])
    tests = dict.fromkeys(str(r["separating_test"]) for r in s["passed_over"] if r.get("separating_test"))
    way = f" To separate them: {'; '.join(list(tests)[:2])}." if tests else ""
    return f"{s['name']}: cannot be distinguished from {names} by these data.{way}"


def _step_row(s: Mapping[str, Any], digits: int) -> list[str]:
    before = s["before"]
    fall = NONE if not before else percent(1.0 - (s["error"] / before) ** 2)
    if _beyond_drift(s):
        sharp, sharper = s["beyond_drift"]
        fall = f"{percent(1.0 - (sharper / sharp) ** 2)} beyond drift"
    floor = NONE if s["floor"] is None else number(float(s["floor"]), digits)
    unit = ERROR_UNITS.get(s["unit"], s["unit"])
    start, end = (NONE if before is None else number(before, digits)), number(s["error"], digits)
    return [s["name"], start, end, fall, floor, unit]


def _changed(s: Mapping[str, Any]) -> str:
    unit = ERROR_UNITS.get(s["unit"], s["unit"])
    before, after = two_numbers(s["before"], s["error"])
    fall = _beyond_drift(s)
    beyond = f"; beyond slow drift {fall[0]} times the noise before, {fall[1]} after" if fall else ""
    return f"{s['name']}: {before} {unit} before, {after} {unit} after{beyond}."


def stairs(steps: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[float], float | None]:
    """Steps of the staircase: names and residuals, and the noise floor.

    Errors on other measurements are not comparable, so that it begins with the first step on the last measurements.
    """
    unit = steps[-1]["unit"]
    same = [{**s, "error": e} for s, e in zip(steps, rescaled(steps), strict=True) if s["unit"] == unit]
    begin = max((i for i, s in enumerate(same) if s["other_data"]), default=0)
    names, errors = [_named(s) for s in same[begin:]], [s["error"] for s in same[begin:]]
    before = same[begin]["before"]
    if before is not None:
        names, errors = ["before, same measurements" if begin else "as it was", *names], [before, *errors]
    return names, errors, next((float(s["floor"]) for s in reversed(same) if s["floor"] is not None), None)


def stairs_to(now: Present | None, steps: Sequence[Mapping[str, Any]], undone: int = 0) -> Stairs | None:
    """The staircase of a model, and the present residual at its end where its last step has another.

    Args:
        now: the present residual.
        steps: changes of the model, the undone ones too.
        undone: number of the last steps that were undone.
    """
    if now is not None and (not steps or now.unit != steps[-1]["unit"]):
        return Stairs([NOW], [now.rms], now.floor, now.unit, 0, ends_now=True)
    if not steps:
        return None
    names, errors, floor = stairs(steps)
    at = len(names) - 1 - undone
    out = Stairs(names, [float(e) for e in errors], floor, str(steps[-1]["unit"]), at)
    if now is None:
        return out
    if at >= 0 and abs(now.rms / max(out.errors[at], 1e-12) - 1.0) < NEAR:
        return replace(out, floor=floor or now.floor)
    return replace(out, names=[*names, NOW], errors=[*out.errors, now.rms], floor=now.floor or floor, ends_now=True)


def _named(s: Mapping[str, Any]) -> str:
    """Name of a step; where a drift hides what it gains, also how the error beyond that drift fell."""
    fall = _beyond_drift(s)
    return f"{s['name']}\nbeyond slow drift: {' to '.join(fall)} × noise" if fall else str(s["name"])


def _beyond_drift(s: Mapping[str, Any]) -> tuple[str, str] | None:
    """The error beyond slow drift before and after a step, where only that fell."""
    before, after = s["beyond_drift"]
    if before is None or after is None or s["before"] is None or s["error"] < s["before"] or after >= before:
        return None
    return two_numbers(before, after)


def _staircase(steps: Sequence[Mapping[str, Any]], now: Present | None) -> Figure | None:
    s = stairs_to(now, steps)
    if s is None:
        return None
    png = staircase(ERROR_UNITS.get(s.unit, s.unit), s.names, s.errors, s.floor, ends_now=s.ends_now)
    return Figure("history.png", png, "The residual on held-out runs after each change, and the noise floor.")


LONG, MANY = 18, 5
"""Largest number of letters of a name on one line; number of steps above which names are slanted for lack of room."""
CROWD, WIDE = 9, 1000.0
"""Number of steps above which names are upright; range above which sizes have digits of their own."""


@as_png
def staircase(
    unit: str, names: Sequence[str], errors: Sequence[float], floor: float | None, *, ends_now: bool = False
) -> "MplFigure":
    """The error on a logarithmic scale, change by change, down to the noise floor.

    Args:
        unit: unit of the error, for people.
        names: names of the steps; the first is the initial model.
        errors: root mean square residual on held-out runs after each step.
        floor: noise floor; None where it is unknown.
        ends_now: whether the last is no step but the present residual of other measurements.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    many, crowd = len(names) > MANY, len(names) > CROWD
    figure, (ax,) = stacked(8.6 if crowd else 7.4 if many else 5.8)
    known = [*errors, *([floor] if floor else [])]
    range_ = max(known) / min(known)
    digits = max(0, 1 - math.floor(math.log10(min(known))))
    write = significant if crowd or range_ > WIDE else partial(number, digits=digits)
    low, high = min(known) / 1.5, max(known) * 1.5 * range_**0.1
    ax.set_yscale("log")
    for place, value in enumerate(errors):
        present = ends_now and place == len(errors) - 1
        colour = OFF if present else ON
        ax.fill_between([place, place + 1], low, value, color=colour, alpha=0.14, linewidth=0, zorder=1)
        ax.plot([place, place + 1], [value, value], color=colour, linewidth=4.0, solid_capstyle="butt")
        ax.annotate(write(value), (place + 0.5, value), (0, 6), textcoords="offset points", ha="center",
                    va="bottom", fontsize=10 if crowd else 17, fontweight="bold", color=colour)  # fmt: skip
        if place and not present and value < errors[place - 1]:
            ax.annotate("", (place, value), (place, errors[place - 1]), zorder=3,
                        arrowprops={"arrowstyle": "-|>", "color": OFF, "linewidth": 1.5 if crowd else 3.0,
                                    "mutation_scale": 9 if crowd else 22,
                                    "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    if floor:
        ax.axhline(floor, color="black", linestyle="--", linewidth=2.0)
        ax.annotate(f"noise floor\n{write(floor)} {unit}", (1.0, floor), (8, 0), xycoords=ax.get_yaxis_transform(),
                    textcoords="offset points", ha="left", va="center", fontsize=14, annotation_clip=False)  # fmt: skip
    ax.set_ylim(low, high)
    ax.set_xlim(0.0, len(names))
    shown = [n.replace("(", "\n(", 1) for n in names] if crowd else names if many else [_broken(n) for n in names]
    ax.set_xticks(np.arange(len(names)) + 0.5, shown, fontsize=9 if crowd else 13)
    for label in ax.get_xticklabels() if crowd else []:
        label.set(rotation=90, va="top")
    for label in ax.get_xticklabels() if many and not crowd else []:
        label.set(rotation=30, ha="right", rotation_mode="anchor")
    ax.tick_params(axis="x", length=0)
    ax.yaxis.set_major_locator(FixedLocator(log_ticks(low, high)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.grid(visible=False, axis="x")
    own = errors[: len(errors) - ends_now]
    fell = len(own) > 0 and own[-1] < own[0]
    ax.set_title("The error falls as the model learns" if fell else "The error as the model learns")
    ax.set_ylabel(f"residual{' on held-out runs' if own else ''}, rms, {unit}")
    return figure


def _broken(name: str) -> str:
    """A label with line breaks at the bracket and the commas; in long names at an underscore, too."""
    head, mark, rest = name.partition("(")
    if len(head) > LONG and "_" in head:
        at = head.rindex("_") + 1
        head = f"{head[:at]}\n{head[at:]}"
    return f"{head}\n{_in_lines(mark + rest)}" if mark else name.replace(", ", ",\n", 1)


def _in_lines(text: str) -> str:
    """A text with line breaks after commas, where a line would be longer than `LONG`."""
    lines = [""]
    for word in re.split(r"(?<=, )", text):
        if lines[-1] and len(f"{lines[-1]}{word}".rstrip()) > LONG:
            lines.append("")
        lines[-1] += word
    return "\n".join(line.rstrip() for line in lines)
