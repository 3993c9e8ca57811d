"""Reports of `rtec add` and `rtec improve`: the error before and after one change, and after each of several."""

import math

from rtec.diagnosis.extend.add import Added
from rtec.diagnosis.extend.improve import Improved
from rtec.diagnosis.extend.record_event import words
from rtec.diagnosis.words import UNITS, sentence
from rtec.report.history import history_sections
from rtec.report.page import Page, Section, Table, shell_command
from rtec.wording import counted, decimals, number, percent, sizes, two_numbers

WHY_ENDED = {
    "nothing_missing": "no effect is missing that these readings could show",
    "undecided": "these readings do not decide what is missing, see the last diagnosis",
    "unknown_effect": "the effect that is missing is not in the catalogue",
    "ambiguous": "the next effect cannot be determined from these data",
    "stopped": "you stopped it",
    "at_floor": "the residual is at the noise floor",
    "no_gain": "the next effect would lower the error on held-out runs by less than 2 %",
    "steps": "one call adds no more effects than these",
}


def added_page(a: Added, figures: bool = True) -> Page:
    """The error before and after an addition.

    Args:
        a: the addition.
        figures: whether to draw.
    """
    section = _before_and_after(a)
    what = ", ".join(a.labels) or "refitted numbers"
    before, after = two_numbers(a.before.held_out, a.after.held_out)
    unit = UNITS[a.unit]
    lead = (
        f"With {what} the residual on held-out runs is {after} {unit}, before it was {before} {unit}; the noise floor "
        f"is {sizes(a.floor)[0]} {unit}."
    )
    return Page(
        "Before and after",
        lead,
        [],
        [section, *history_sections(a.model, figures)],
        brief=Section("", [], section.table),
        next=[shell_command("rtec", "diagnose", *a.files)] if a.files else [],
    )


def _before_and_after(a: Added) -> Section:
    unit = UNITS[a.unit]
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


def _refit_words(refit: Added) -> str:
    """The error before and after a refit of the model's own numbers."""
    before, after = two_numbers(refit.before.held_out, refit.after.held_out)
    unit = UNITS[refit.unit]
    return f"The model's own numbers were out of date; refitted, the residual fell from {before} to {after} {unit}. "


def improved_page(r: Improved, figures: bool = True) -> Page:
    """All steps of an improvement.

    Args:
        r: the improvement.
        figures: whether to draw.
    """
    refit = _refit_words(r.refit) if r.refit else ""
    if not r.steps:
        lead = f"{refit}No effect was added: {_why_ended(r)}. {_last_verdict(r)}"
    else:
        first, last = r.steps[0], r.steps[-1]
        unit = UNITS[last.unit]
        before, after = two_numbers(first.before.held_out, last.after.held_out)
        added = counted(sum(len(s.labels) for s in r.steps), "effect")
        lead = (
            f"{refit}{added} added: the residual on held-out runs fell from {before} to "
            f"{after} {unit}; the noise floor is {sizes(last.floor)[0]} {unit}. It ended because {_why_ended(r)}."
        )
    if r.events:
        lead = f"{lead} {words(r.events)}"
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
        brief=Section("", [], history[0].table if history else None),
        next=[shell_command("rtec", "history", r.files[0], "--report", "out/history")] if r.files else [],
    )


def _why_ended(r: Improved) -> str:
    """Why the improvement ended, in words."""
    if r.reason == "no_gain" and r.cancelling:
        return f"these readings determine only what {' and '.join(r.cancelling)} make together"
    return WHY_ENDED[r.reason]


def _last_verdict(r: Improved) -> str:
    """The verdict of the last diagnosis; an effect that is too small is named as such."""
    verdict = sentence(r.diagnoses[-1].sentence)
    if r.reason != "no_gain":
        return verdict
    return f"{'Not' if r.cancelling else 'Too small to be'} added: {verdict}"
