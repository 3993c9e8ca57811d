"""Report of a diagnosis."""

import math
from collections.abc import Sequence
from pathlib import Path
from shlex import quote

from rtec import __version__
from rtec.diagnosis.result import Diagnosis, Finding, NotTestable
from rtec.diagnosis.words import UNITS, hardly, labels, sentence, spoken
from rtec.report.evidence import evidence
from rtec.report.page import Figure, Page, Section, Table, number

SHOWN, WHERE, MOST_NUMBERS = 8, 5, 4
BETTER = 0.005
"""Share of the mean square; falls of less are none."""


def diagnosis_page(d: Diagnosis, figures: bool = True, files: Sequence[Path] = ()) -> Page:
    """The page; without figures it is what the terminal shows.

    Args:
        d: the diagnosis.
        figures: whether to draw.
        files: the model and the measurements, for commands that can be typed as they stand.
    """
    unit = UNITS[d.unit]
    return Page(
        title="What the model misses",
        lead=sentence(d.sentence),
        numbers=[
            (f"{d.rms_residual:.3g}\u00a0{unit}", "left by the model"),
            (f"{d.noise_floor:.3g}\u00a0{unit}", "noise of the measurement"),
            *([(f"{d.findings[0].confidence:.0%}", "sure of rank 1")] if d.group else []),
        ],
        sections=[
            *_to_type(d, files),
            *_evidence(d, figures),
            *_confused(d),
            *_absent(d),
            *_untestable(d),
            Section("How the readings were treated", [*map(sentence, d.notes), *(f"{n}." for n in d.noise)]),
        ],
        foot=[
            "Left out: each part of the runs predicted by the fit to all others.",
            f"rtec {__version__}, rtec diagnose, seed {d.seed} of the draws of chance.",
        ],
    )


def _evidence(d: Diagnosis, figures: bool) -> list[Section]:
    out = []
    if d.picture is not None and d.picture.drivers and figures:
        p = d.picture
        from rtec.report import diagnosis_figures

        png = diagnosis_figures.evidence_figure([evidence(q) for q in (p, *p.others) if q.drivers])
        shows = "The residual against what drives it, and what the finding explains of it."
        out.append(Section("The residual, and what the finding explains", [], None, Figure("evidence.png", png, shows)))
    if not d.findings:
        return [*out, Section("Candidates", ["Chance alone would look as good as the best of them."])]
    figure = None
    if figures:
        from rtec.report import diagnosis_figures

        shown = d.findings[:SHOWN]
        rows = [(n, f.heldout_drop, f.group, _short(d, f)) for f, n in zip(shown, labels(shown), strict=True)]
        figure = Figure("rivals.png", diagnosis_figures.rivals(rows), "Fall of the error with each candidate.")
    return [*out, Section("Candidates, best first", _candidate_words(d), _candidates(d), figure)]


def _to_type(d: Diagnosis, files: Sequence[Path]) -> list[Section]:
    """The command that adds what has no name as an expression."""
    if d.unknown is None or not d.unknown.expression:
        return []
    u = d.unknown
    model, *data = files or (Path("MODEL"), Path("MEASUREMENT"))
    given = ["rtec", "add", str(model), "--expr", u.expression]
    given += [word for p in u.parameters for word in ("--param", p)]
    given += ["--component", u.feeds, "--data", *map(str, data), "-o", f"{model.with_suffix('')}-more.toml"]
    words = [
        "The nearest simple expression; it is refused where it does not make runs left out better:",
        " ".join(map(quote, given)),
        "It says what the error looks like, not what makes it: look for the cause there.",
    ]
    return [Section("To add it without a name", words)]


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
        out.append(f"None of them passed: rank 1 {_doubt(d, first)}.")
    if any(n.se is None for f in d.findings for n in list(f.parameters.values())[:MOST_NUMBERS]):
        out.append("A number that is open makes no difference here, or numbers of the model could take its place.")
    return out


def _candidates(d: Diagnosis) -> Table:
    unit = UNITS[d.unit]
    rows = [
        [
            f"{f.rank}",
            label,
            _numbers(f),
            number(f.size_um),
            f"{f.heldout_drop:.0%}" if f.heldout_drop >= BETTER else "no better",
            _probability(f.confidence),
            "found" if f.accepted else f.why_not or f"not sure enough: {_doubt(d, f)}",
        ]
        for f, label in zip(d.findings, labels(d.findings), strict=True)
    ]
    head = ("", "effect", "numbers", f"makes, {unit}", "error falls by", "probability", "")
    caption = (
        "Error falls by: share of the mean square on runs that were not used. Probability: among these candidates and "
        "'nothing is missing'; what none of them describes is not in it."
    )
    return Table(head, rows, caption, words=(1, 2, 6))


def _probability(share: float) -> str:
    """A share as a percentage; neither never nor certain where it is neither."""
    if share > 0.9995:
        return ">99.9%"
    return "<0.1%" if share < 0.0005 else f"{share:.1%}"


def _doubt(d: Diagnosis, f: Finding) -> str:
    """Why the first candidate was not accepted."""
    if f.heldout_drop <= 0.0:
        return "does not lower the error on runs left out"
    if d.unknown is not None and d.adequacy is not None:
        return f"explains only {max(d.adequacy, 0.0):.0%} of what a shape without a name does"
    return f"chance alone looks as good in {f.p:.1%} of draws"


def _short(d: Diagnosis, f: Finding) -> str:
    """Why a candidate is preferred or not, for its bar."""
    if f.rank == 1 and f.accepted:
        return f"{_probability(f.confidence)} probable"
    return (f.why_not or _doubt(d, f)).removesuffix(" than rank 1").removesuffix(" to these readings")


def _numbers(f: Finding) -> str:
    parts = []
    for name, n in f.parameters.items():
        if n.se is None:  # it makes no difference to these readings, or numbers of the model could take its place
            parts.append(f"{name} open")
            continue
        se = f" ± {n.se:.2g}" if math.isfinite(n.se) else ""
        parts.append(f"{name} {n.value:.4g}{se} {spoken(n.unit)}".strip())
    return "; ".join(parts[:MOST_NUMBERS]) + (" …" if len(parts) > MOST_NUMBERS else "")


def _confused(d: Diagnosis) -> list[Section]:
    if not d.group or not d.findings[0].confused_with:
        return []
    alikes, head = d.findings[0].confused_with, ("effect", "why", "test")
    rivals = [[a.label, a.why, a.separating_test] for a in alikes if not a.apart]
    beside = [[a.label, a.why, a.separating_test] for a in alikes if a.apart]
    words = ["These would explain the readings as well. The test on the right tells them apart."]
    out = [Section("What it may be instead", words, Table(head, rivals, words=(0, 1, 2)))] if rivals else []
    if beside:
        table = Table(("effect", "why", "what to do"), beside, words=(0, 1, 2))
        out.append(Section("What may be missing beside it", [], table))
    return out


def _absent(d: Diagnosis) -> list[Section]:
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
    head = ("effect", f"seen from, {unit}", f"to, {unit}", "looked for in")
    words = [
        "Looked for and not found. The numbers say how large it must be in the readings (root mean square) to be found."
    ]
    return [Section("Checked and absent", words, Table(head, rows, words=(0, 3)))]


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
    words = ["These readings could not have shown them, or only if they were far larger than usual."]
    head = ("effect", "why not", "what would show it")
    return [Section("Could not be checked", words, Table(head, rows, words=(0, 1, 2)))]


def _hardly(name: str, of: Sequence[NotTestable], unit: str) -> list[str]:
    """One row for an effect, whatever it feeds."""
    where = sorted({n.component for n in of})
    named = f"{name}({', '.join(where[:WHERE])}{' …' if len(where) > WHERE else ''})"
    usual, smallest = [n.usual or 0.0 for n in of], [n.smallest or 0.0 for n in of]
    return [named, hardly(usual, smallest, unit), of[0].test]
