"""Reports of what was added to a model, and of a model that was improved step by step."""

import math

from rtec.diagnosis.extend.add import Added
from rtec.diagnosis.extend.improve import Improved
from rtec.diagnosis.usable import apart, share
from rtec.diagnosis.words import UNITS, sentence
from rtec.report.history import history_sections
from rtec.report.page import Page, Section, Table, number

WHY_ENDED = {
    "nothing_missing": "nothing more that these readings could show is missing",
    "unknown_effect": "something is left that no effect of the catalogue describes",
    "ambiguous": "these readings cannot say which effect comes next",
    "stopped": "stopped as asked",
    "at_floor": "the error is at the noise floor",
    "no_gain": "the next effect would not have lowered the error on runs left out by 2 %",
    "steps": "as many steps as it takes at a time",
}


def added_page(a: Added, figures: bool = True) -> Page:
    """What an addition bought."""
    unit = UNITS[a.unit]
    fall = 1.0 - (a.after.held_out / a.before.held_out) ** 2 if a.before.held_out > 0 else 0.0
    what = ", ".join(a.labels) or "numbers fitted anew"
    before, after = apart(a.before.held_out, a.after.held_out)
    lead = f"With {what}, {after} {unit} are left on runs that were not used, before {before}; noise is {a.floor:.3g}."
    rows = [
        ["as given", number(a.before.as_given or math.nan, 3), "–"],
        *([["refitted", number(a.before.inside, 3), number(a.before.held_out, 3)]] if a.labels else []),
        [f"with {what}", number(a.after.inside, 3), number(a.after.held_out, 3)],
        ["noise floor", number(a.floor, 3), number(a.floor, 3)],
    ]
    table = Table(("model", f"fitted readings, {unit}", f"runs left out, {unit}"), rows)
    words = [
        f"The mean square on runs left out {'falls' if fall > 0 else 'rises'} by {share(fall)}.",
        f"With temperatures smoothed both ways in time, which the loop cannot do, it would be {a.smoothed:.3g} {unit}.",
        *map(sentence, a.notes),
    ]
    return Page(
        "What it bought", lead, [], [Section("Before and after", words, table), *history_sections(a.model, figures)]
    )


def _refit_words(refit: Added) -> str:
    """What fitting the model's own numbers anew bought."""
    before, after = apart(refit.before.held_out, refit.after.held_out)
    unit = UNITS[refit.unit]
    what = "The model's own numbers were out of date and were fitted anew"
    return f"{what}: {before} {unit} left became {after}, noise is {refit.floor:.3g}. "


def improved_page(r: Improved, figures: bool = True) -> Page:
    """All steps of an improvement."""
    anew = _refit_words(r.refit) if r.refit else ""
    if not r.steps:
        added = f"No effect was added: {WHY_ENDED[r.reason]}." if anew else f"Nothing was added: {WHY_ENDED[r.reason]}."
        lead = f"{anew}{added} {_left(r)}"
    else:
        first, last_step = r.steps[0], r.steps[-1]
        unit = UNITS[last_step.unit]
        lead = (
            f"{anew}{len(r.steps)} {'effect' if len(r.steps) == 1 else 'effects'} added: "
            f"{first.before.held_out:.3g} {unit} left on runs not used became {last_step.after.held_out:.3g}, "
            f"noise is {last_step.floor:.3g}. "
            f"It ended because {WHY_ENDED[r.reason]}."
        )
    sections = [
        Section(
            f"Step {i}: {', '.join(s.labels)}",
            added_page(s, False).sections[0].text,
            added_page(s, False).sections[0].table,
        )
        for i, s in enumerate(r.steps, 1)
    ]
    tail = [Section("What is left", [_left(r)])] if r.diagnoses else []
    return Page("The model improved", lead, [], [*history_sections(r.model, figures), *sections, *tail])


def _left(r: Improved) -> str:
    """What the last diagnosis says, in one sentence; of what was seen and not added, that it is so."""
    said = sentence(r.diagnoses[-1].sentence)
    return f"Seen, and too little to be added: {said}" if r.reason == "no_gain" else said
