"""Report of a diagnosis."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from shlex import quote

from rtec.diagnosis.result import Diagnosis, Finding, NotTestable, OnCircle, Picture
from rtec.diagnosis.search.not_found import ALPHA
from rtec.diagnosis.words import MOST_NUMBERS, UNITS, fitted_numbers, hardly, labels, sentence
from rtec.effects import Effect
from rtec.report.evidence import evidence
from rtec.report.page import Figure, Page, Section, Table, shell_command
from rtec.version import __version__
from rtec.wording import NONE, counted, decimals, number, percent, probability, sizes

SHOWN, WHERE, BRIEF = 8, 5, 3
BETTER = 0.005
"""Smallest relative fall of the mean square that is shown."""


def diagnosis_page(d: Diagnosis, figures: bool = True) -> Page:
    """The page.

    Args:
        d: the diagnosis.
        figures: whether to draw.
    """
    unit = UNITS[d.unit]
    residual, floor = sizes(d.rms_residual, d.noise_floor)
    return Page(
        title="Which effect is missing",
        lead=sentence(d.sentence),
        numbers=[
            (f"{residual}\u00a0{unit}", "residual of the model"),
            (f"{floor}\u00a0{unit}", "noise floor"),
            *([(probability(d.findings[0].confidence), "probability of the first candidate")] if d.group else []),
        ],
        sections=[
            *_to_type(d),
            *_evidence(d, figures),
            *_confused(d),
            *_undetected(d),
            *_untestable(d),
            Section("How the readings were treated", [*map(sentence, d.notes), *(f"{n}." for n in d.noise)]),
        ],
        foot=[
            "Held-out runs: each part of the runs is predicted by the fit to all others.",
            f"rtec {__version__}, rtec diagnose, seed {d.seed} of the random draws.",
        ],
        brief=Section("", [], _brief(d)),
        next=_next(d),
    )


def _brief(d: Diagnosis) -> Table | None:
    """Table of the first candidates; None where there are none, or the record is in doubt."""
    if not d.findings or any(b.blames_no_effect for b in d.doubts):
        return None
    shown = d.findings[:BRIEF]
    rows = [
        [
            label,
            number(f.size_um, decimals(d.noise_floor)),
            percent(max(f.heldout_drop, 0.0)),
            probability(f.confidence),
        ]
        for f, label in zip(shown, labels(shown), strict=True)
    ]
    head = ("candidate", f"explains, {UNITS[d.unit]}", "held-out error falls by", "probability")
    more = f" {counted(len(d.findings) - BRIEF, 'more candidate')} with --full." if len(d.findings) > BRIEF else ""
    return Table(head, rows, f"Falls by: share of the mean square.{more}")


def _next(d: Diagnosis) -> list[str]:
    """Commands that add the effect, separate the rivals, or refit the model."""
    if not d.files:
        return []
    model, *data = d.files
    better = f"{model.with_suffix('')}-more.toml"
    sure = d.verdict == "missing_effect"
    if d.verdict == "ambiguous" and d.findings[0].confused_with:
        first = d.findings[0]
        names = [(first.effect.effect, first.effect.component)]
        names += [(a.effect, a.component) for a in first.confused_with if not a.apart]
        rivals = [":".join(name) for name in dict.fromkeys(names)]
        if len(rivals) > 1:
            chosen = ",".join(rivals[:BRIEF])
            return [shell_command("rtec", "plan", d.machine_file or "MACHINE", *data, "--rivals", chosen)]
        sure = not d.together  # together: forms of one effect, which is missing in any case
    if sure and d.findings[0].partner is None:
        return [shell_command("rtec", "add", model, *as_typed(d.findings[0].effect), "--data", *data, "-o", better)]
    if d.verdict == "unknown_effect":
        return [line for section in _to_type(d) for line in section.text if line.startswith("rtec ")]
    if d.verdict == "undecided" or (d.verdict == "nothing_missing" and not d.out_of_date):
        return []
    return [shell_command("rtec", "improve", *d.files, "-o", better)]


def as_typed(effect: Effect) -> list[str]:
    """An effect as arguments of `rtec add`."""
    given = effect.model_dump(mode="json", exclude={"effect", "component"}, exclude_none=True, exclude_defaults=True)
    if given.get("axis") == effect.component[2:].removeprefix("0"):
        del given["axis"]
    settings = [f"{k}={v if isinstance(v, str) else json.dumps(v)}" for k, v in given.items()]
    return [effect.effect, "--component", effect.component, *(word for text in settings for word in ("--set", text))]


def _evidence(d: Diagnosis, figures: bool) -> list[Section]:
    out = []
    if d.picture is not None and d.picture.drivers and figures:
        p = d.picture
        from rtec.report import diagnosis_figures

        png = diagnosis_figures.evidence_figure([evidence(q) for q in (p, *p.others) if q.drivers])
        shows = "The residual against its driver, with the fitted effect."
        out.append(Section("Residual and fitted effect", [], None, Figure("evidence.png", png, shows)))
        out += [on_its_circle(q, q.circle) for q in (p, *p.others) if q.circle is not None]
    if not d.findings:
        return [*out, Section("Candidates", ["Noise alone would give as good a fit as the best of them."])]
    figure = None
    if figures:
        from rtec.report import diagnosis_figures

        shown = d.findings[:SHOWN]
        rows = [(n, f.heldout_drop, f.group, _short(d, f)) for f, n in zip(shown, labels(shown), strict=True)]
        figure = Figure("rivals.png", diagnosis_figures.rivals(rows), "Fall of the held-out error with each candidate.")
    return [*out, Section("Candidates, best first", _candidate_words(d), _candidates(d), figure)]


def on_its_circle(p: Picture, circle: OnCircle) -> Section:
    """The residual of a ball bar on its circle."""
    from rtec.report.ball_bar_figures import CircleTrace
    from rtec.report.compare_figures import polar_pair

    trace = CircleTrace("", circle.sense, circle.angle_rad, p.residual, p.part)
    names = ("residual before", "fitted effect", "residual after")
    png = polar_pair(p.title, circle.letters, trace, names)
    shows = "Residual and fitted effect drawn outwards from the circle; beside it what is then the residual."
    file = re.sub(r"[^A-Za-z0-9_.-]+", "-", p.title.rpartition(", in ")[2])
    return Section(f"On the circle: {p.title}", [], None, Figure(f"polar-{file}.png", png, shows))


def _to_type(d: Diagnosis) -> list[Section]:
    """The command that adds an effect without a name as an expression."""
    if d.unknown is None or not d.unknown.expression:
        return []
    u = d.unknown
    model, *data = d.files or (Path("MODEL"), Path("MEASUREMENT"))
    given = ["rtec", "add", str(model), "--expr", u.expression]
    given += [word for p in u.parameters for word in ("--param", p)]
    given += ["--component", u.feeds, "--data", *map(str, data), "-o", f"{model.with_suffix('')}-more.toml"]
    words = [
        "The nearest simple expression; `rtec add` refuses it if the error on held-out runs does not fall:",
        " ".join(map(quote, given)),
        "It describes the shape of the error, not its cause.",
    ]
    return [Section("To add it without a name", words)]


def _candidate_words(d: Diagnosis) -> list[str]:
    first, out = d.findings[0], []
    chance = f"Of random draws under noise alone, {percent(first.p)} give as good a fit of any effect of the catalogue."
    if first.accepted:
        out.append(chance)
        if d.adequacy is not None and d.adequacy < 1.0:
            out.append(f"It explains {percent(d.adequacy)} of what the best smooth or periodic shape would explain.")
    else:
        out.append(f"None of them passed: rank 1 {_doubt(d, first)}.")
    if any(n.se is None for f in d.findings for n in list(f.parameters.values())[:MOST_NUMBERS]):
        out.append(f"A number shown as {NONE} is not determined by these data.")
    return out


def _candidates(d: Diagnosis) -> Table:
    unit = UNITS[d.unit]
    rows = [
        [
            f"{f.rank}",
            label,
            fitted_numbers(f),
            number(f.size_um, decimals(d.noise_floor)),
            percent(f.heldout_drop) if f.heldout_drop >= BETTER else "does not fall",
            probability(f.confidence),
            "accepted" if f.accepted else f.why_not or f"not accepted: {_doubt(d, f)}",
        ]
        for f, label in zip(d.findings, labels(d.findings), strict=True)
    ]
    head = ("", "effect", "numbers", f"explains, {unit}", "held-out error falls by", "probability", "")
    caption = (
        "Held-out error: mean square on held-out runs. Probability: among these candidates and 'nothing is missing'; "
        "an effect that none of them describes is not in it."
    )
    return Table(head, rows, caption, words=(1, 2, 6))


def _doubt(d: Diagnosis, f: Finding) -> str:
    """Reason why a candidate was not accepted."""
    if f.heldout_drop <= 0.0:
        return "does not lower the error on held-out runs or targets"
    if d.unknown is not None and d.adequacy is not None:
        return f"explains only {percent(max(d.adequacy, 0.0))} of what a shape without a name does"
    if any(b.blames_no_effect for b in d.doubts):
        return "no effect is named beside a record in doubt"
    if f.p >= ALPHA:
        return f"is as good in {percent(f.p)} of random draws under noise alone"
    return "the evidence for it is below 20 to 1 beyond that of any effect at all"


def _short(d: Diagnosis, f: Finding) -> str:
    """Short reason why a candidate is preferred or not, for its bar."""
    if f.rank == 1 and f.accepted:
        return f"probability {probability(f.confidence)}"
    return (f.why_not or _doubt(d, f)).removesuffix(" than rank 1").removesuffix(" from these data")


def _confused(d: Diagnosis) -> list[Section]:
    if not d.group or not d.findings[0].confused_with:
        return []
    alikes, head = d.findings[0].confused_with, ("effect", "why", "test")
    rivals = [[a.label, a.why, a.separating_test] for a in alikes if not a.apart]
    beside = [[a.label, a.why, a.separating_test] for a in alikes if a.apart]
    words = ["These effects cannot be distinguished from rank 1 by these data; the test on the right separates them."]
    out = [Section("Confounded with rank 1", words, Table(head, rivals, words=(0, 1, 2)))] if rivals else []
    if beside:
        table = Table(("effect", "why", "what to do"), beside, words=(0, 1, 2))
        out.append(Section("What may be missing besides", [], table))
    return out


def _undetected(d: Diagnosis) -> list[Section]:
    if not d.absent:
        return []
    smallest: dict[str, tuple[float, float, set[str]]] = {}
    for a in d.absent:
        low, high, where = smallest.get(a.effect, (math.inf, 0.0, set()))
        smallest[a.effect] = (min(low, a.smallest), max(high, a.smallest), {*where, a.component})
    rows = [
        [name, number(low), number(high), ", ".join(sorted(where)[:WHERE]) + (" …" if len(where) > WHERE else "")]
        for name, (low, high, where) in sorted(smallest.items())
    ]
    unit = UNITS[d.unit]
    head = ("effect", f"found from, {unit}", f"to, {unit}", "tested in")
    words = ["Tested and not found, with the size in the readings (root mean square) from which it would be found."]
    return [Section("Tested and absent", words, Table(head, rows, words=(0, 3)))]


def _untestable(d: Diagnosis) -> list[Section]:
    if not d.not_testable:
        return []
    seen: dict[tuple[str, str], list[str]] = {}
    faint: dict[str, list[NotTestable]] = {}
    for n in d.not_testable:
        if n.usual is None or n.smallest is None:
            seen.setdefault((n.why, n.test), []).append(n.effect)
        else:
            faint.setdefault(n.effect, []).append(n)
    rows = [[", ".join(dict.fromkeys(names)), why, test] for (why, test), names in seen.items()]
    rows += [_hardly(name, of, d.unit) for name, of in faint.items()]
    words = ["These readings could not show them, or only at far more than their usual size."]
    head = ("effect", "why not", "what would show it")
    return [Section("Not testable with these readings", words, Table(head, rows, words=(0, 1, 2)))]


def _hardly(name: str, of: Sequence[NotTestable], unit: str) -> list[str]:
    """One row for an effect, for all its components together."""
    where = sorted({n.component for n in of})
    named = f"{name}({', '.join(where[:WHERE])}{' …' if len(where) > WHERE else ''})"
    usual, smallest = [n.usual or 0.0 for n in of], [n.smallest or 0.0 for n in of]
    return [named, hardly(usual, smallest, unit), of[0].test]
