"""Report of a plan: what the tests tell apart, what stays confounded, what to add."""

import math
from collections.abc import Sequence

from rtec import __version__
from rtec.diagnosis.plan import WEAK, Proposal, Separation
from rtec.report.html import Page, Section, Table

SHOWN = 8


def plan_page(s: Separation, proposals: Sequence[Proposal], tests: Sequence[str]) -> Page:
    """The page; the terminal shows the same."""
    return Page(
        title="What these tests can tell",
        lead=_lead(s, proposals),
        numbers=[(f"{s.rank} of {len(s.parameters)}", "parameters told apart"), (_condition(s), "condition number")],
        sections=[
            Section("Tests", [", ".join(tests)]),
            *_troubles(s),
            Section("Smallest size that would be found", [], _sizes(s)),
            *_proposals(proposals),
        ],
        foot=[
            "Three standard errors, white noise of 0.5 µm or µrad unless said otherwise.",
            f"rtec {__version__}, rtec plan.",
        ],
    )


def _condition(s: Separation) -> str:
    return f"{s.condition:.1f}" if math.isfinite(s.condition) else "–"


def _lead(s: Separation, proposals: Sequence[Proposal]) -> str:
    n = len(s.parameters)
    if s.complete:
        weak = f", but only just (condition number {s.condition:.0f})" if s.condition > WEAK else ""
        return f"These tests tell all {n} parameters apart{weak}."
    best = next((p for p in proposals if p.gained), None)
    way = f" Add: {best.test.name} ({_hours(best.test.hours)}), then {best.after.rank} of {n}." if best else ""
    return f"These tests tell {s.rank} of {n} parameters apart.{way}"


def _hours(hours: float) -> str:
    return f"{60 * hours:.0f} min" if hours < 1.5 else f"{hours:.1f} h"


def _troubles(s: Separation) -> list[Section]:
    words = [f"Never seen: {name}." for name in s.never]
    words += [f"Only together: {', '.join(group)}." for group in s.confounded]
    return [Section("What stays open", words)] if words else []


def _sizes(s: Separation) -> Table:
    rows = []
    for p in s.parameters:
        size = s.detectable[p.name]
        together = any(p.name in group for group in s.confounded)
        blind = "only with others" if together else "never"
        enough = blind if not math.isfinite(size) else "yes" if size < p.typical else "only if large"
        rows.append([p.name, f"{size:.3g}" if math.isfinite(size) else "∞", f"{p.typical:.3g}", p.unit, enough])
    return Table(("parameter", "found from", "usual size", "unit", "seen?"), rows, words=(0, 3, 4))


def _proposals(proposals: Sequence[Proposal]) -> list[Section]:
    if not proposals:
        return []
    rows = [
        [
            p.test.name,
            _hours(p.test.hours),
            f"{p.after.rank}",
            _condition(p.after),
            ", ".join(p.gained[:4]) + (f" and {len(p.gained) - 4} more" if len(p.gained) > 4 else ""),
        ]
        for p in proposals[:SHOWN]
    ]
    head = ("test to add", "takes", "told apart", "condition", "newly found")
    return [Section("What to add, best first", [], Table(head, rows, words=(0, 1, 4)))]
