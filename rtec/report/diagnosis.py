"""Reports of a diagnosis, and of what was added."""

import math

from rtec import __version__
from rtec.diagnosis.add import Added
from rtec.diagnosis.improve import Improved
from rtec.diagnosis.result import Diagnosis, Finding
from rtec.diagnosis.words import UNITS
from rtec.report.html import Figure, Page, Section, Table
from rtec.report.model_history import history_sections
from rtec.report.procedures import number

SHOWN_ABSENT = 14
WHY_ENDED = {
    "nothing_missing": "nothing more that these readings could show is missing",
    "unknown_effect": "something is left that no effect of the catalogue describes",
    "ambiguous": "these readings cannot say which effect comes next",
    "stopped": "stopped as asked",
    "at_floor": "the error is at the noise floor",
    "no_gain": "the next effect would not have lowered the error on runs left out by 2 %",
    "steps": "as many steps as it takes at a time",
}


def diagnosis_page(d: Diagnosis, figures: bool = True) -> Page:
    """The page; without figures it is what the terminal shows."""
    unit = UNITS[d.unit]
    return Page(
        title="What the model misses",
        lead=d.sentence[0].upper() + d.sentence[1:] + ".",
        numbers=[
            (f"{d.rms_residual:.3g}\u00a0{unit}", "left by the model"),
            (f"{d.noise_floor:.3g}\u00a0{unit}", "noise of the measurement"),
            *([(f"{d.findings[0].confidence:.0%}", "sure of rank 1")] if d.group else []),
        ],
        sections=[
            *_evidence(d, figures),
            *_confused(d),
            *_absent(d),
            *_untestable(d),
            Section("How the readings were treated", [_sentence(n) for n in (*d.notes, *d.noise)]),
        ],
        foot=[
            "Left out: each part of the runs predicted by the fit to all others.",
            f"rtec {__version__}, rtec diagnose, seed {d.seed} of the draws of chance.",
        ],
    )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def _evidence(d: Diagnosis, figures: bool) -> list[Section]:
    out = []
    if d.picture is not None and d.picture.drivers and figures:
        p = d.picture
        from rtec.report import diagnosis_figures

        png = diagnosis_figures.against_drivers(p.label, UNITS[p.unit], p.residual, p.part, p.drivers[:3], p.direction)
        shows = "What the model leaves against what drives it, with what the finding says of it."
        out.append(
            Section("What is left, and what the finding says of it", [], None, Figure("evidence.png", png, shows))
        )
    if not d.findings:
        return [*out, Section("Candidates", ["Chance alone would look as good as the best of them."])]
    figure = None
    if figures:
        from rtec.report import diagnosis_figures

        rows = [(f.label, f.heldout_drop, f.group) for f in d.findings[:8]]
        figure = Figure("rivals.png", diagnosis_figures.rivals(rows), "Fall of the error with each candidate.")
    return [*out, Section("Candidates, best first", _candidate_words(d), _candidates(d), figure)]


def _candidate_words(d: Diagnosis) -> list[str]:
    first, out = d.findings[0], []
    chance = f"Chance alone looks as good in {first.p:.1%} of draws, over the whole catalogue."
    if first.accepted:
        out.append(chance)
        if d.adequacy is not None and d.adequacy < 1.0:
            out.append(
                f"It explains {d.adequacy:.0%} of what the best smooth or periodic shape without a name would explain."
            )
    else:
        out.append(f"None of them passed. {chance}")
    return out


def _candidates(d: Diagnosis) -> Table:
    unit = UNITS[d.unit]
    rows = [
        [
            f"{f.rank}",
            f.label,
            _numbers(f),
            number(f.size_um),
            f"{f.heldout_drop:.0%}",
            f"{f.confidence:.1%}",
            "found" if f.accepted else f.why_not or "not sure enough",
        ]
        for f in d.findings
    ]
    head = ("", "effect", "numbers", f"makes, {unit}", "error falls by", "probability", "")
    return Table(head, rows, "Error falls by: share of the mean square on runs that were not used.", words=(1, 2, 6))


def _numbers(f: Finding) -> str:
    parts = []
    for name, n in f.parameters.items():
        se = f" ± {n.se:.2g}" if n.se is not None and math.isfinite(n.se) else ""
        parts.append(f"{name} {n.value:.4g}{se} {n.unit if n.unit != '1' else ''}".strip())
    return "; ".join(parts[:4]) + (" …" if len(parts) > 4 else "")


def _confused(d: Diagnosis) -> list[Section]:
    if not d.group or not d.findings[0].confused_with:
        return []
    rows = [[a.label, a.why, a.separating_test] for a in d.findings[0].confused_with]
    words = ["These would explain the readings as well. The test on the right tells them apart."]
    return [Section("What it may be instead", words, Table(("effect", "why", "test"), rows, words=(0, 1, 2)))]


def _absent(d: Diagnosis) -> list[Section]:
    if not d.absent:
        return []
    smallest: dict[str, tuple[float, float, set[str]]] = {}
    for a in d.absent:
        low, high, where = smallest.get(a.effect, (math.inf, 0.0, set()))
        smallest[a.effect] = (min(low, a.smallest), max(high, a.smallest), {*where, a.component})
    rows = [
        [name, number(low), number(high), ", ".join(sorted(where)[:5]) + (" …" if len(where) > 5 else "")]
        for name, (low, high, where) in sorted(smallest.items())
    ]
    unit = UNITS[d.unit]
    head = ("effect", f"seen from, {unit}", f"to, {unit}", "looked for in")
    words = [
        "Looked for and not found. The numbers say how large it must be in the readings (root mean square) to be found."
    ]
    return [Section("Checked and absent", words, Table(head, rows, words=(0, 3)))]


def _untestable(d: Diagnosis) -> list[Section]:
    if not d.not_testable:
        return []
    seen: dict[tuple[str, str], list[str]] = {}
    for n in d.not_testable:
        seen.setdefault((n.why, n.test), []).append(n.effect)
    rows = [[", ".join(dict.fromkeys(names)), why, test] for (why, test), names in seen.items()]
    words = ["These readings could not have shown them, whatever their size."]
    head = ("effect", "why not", "what would show it")
    return [Section("Could not be checked", words, Table(head, rows, words=(0, 1, 2)))]


def added_page(a: Added, figures: bool = True) -> Page:
    """What an addition bought."""
    unit = UNITS[a.unit]
    fall = 1.0 - (a.after.held_out / a.before.held_out) ** 2 if a.before.held_out > 0 else 0.0
    what = ", ".join(a.labels) or "nothing"
    lead = (
        f"With {what}, {a.after.held_out:.3g} {unit} are left on runs that were not used, "
        f"before {a.before.held_out:.3g}; noise is {a.floor:.3g}."
    )
    rows = [
        ["as given", number(a.before.as_given or math.nan, 3), "–"],
        ["refitted", number(a.before.inside, 3), number(a.before.held_out, 3)],
        [f"with {what}", number(a.after.inside, 3), number(a.after.held_out, 3)],
        ["noise floor", number(a.floor, 3), number(a.floor, 3)],
    ]
    table = Table(("model", f"fitted readings, {unit}", f"runs left out, {unit}"), rows)
    words = [
        f"The mean square on runs left out {'falls' if fall > 0 else 'rises'} by {abs(fall):.0%}.",
        f"With temperatures smoothed both ways in time, which the loop cannot do, it would be {a.smoothed:.3g} {unit}.",
        *(_sentence(n) for n in a.notes),
    ]
    return Page(
        "What it bought", lead, [], [Section("Before and after", words, table), *history_sections(a.model, figures)]
    )


def improved_page(r: Improved, figures: bool = True) -> Page:
    """All steps of an improvement."""
    if not r.steps:
        last = r.diagnoses[-1]
        lead = f"Nothing was added: {WHY_ENDED[r.reason]}. {_sentence(last.sentence)}"
    else:
        first, last_step = r.steps[0], r.steps[-1]
        unit = UNITS[last_step.unit]
        lead = (
            f"{len(r.steps)} {'effect' if len(r.steps) == 1 else 'effects'} added: {first.before.held_out:.3g} {unit} "
            f"left on runs not used became {last_step.after.held_out:.3g}, noise is {last_step.floor:.3g}. "
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
    last_page = diagnosis_page(r.diagnoses[-1], figures=False) if r.diagnoses else None
    tail = [Section("What is left", [last_page.lead])] if last_page else []
    return Page("The model improved", lead, [], [*history_sections(r.model, figures), *sections, *tail])
