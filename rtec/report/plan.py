"""Report of a plan: what the tests tell apart, what stays confounded, what to add."""

import math
from collections.abc import Sequence

from rtec import __version__
from rtec.diagnosis.plan.answer import Answer
from rtec.diagnosis.plan.parameters import hours_in_words
from rtec.diagnosis.plan.plan import WEAK, Proposal, Separation
from rtec.diagnosis.plan.separating import Pair, Separator
from rtec.diagnosis.words import spoken
from rtec.report.page import Page, Section, Table

SHOWN = 8
HARDLY = math.log(2.0)
"""A test that gives smaller odds for no pair is not worth naming."""
NO_TEST = (
    "No single test of this machine tells any two of them apart at these sizes. Two tests together may: add another to "
    "the planned ones and ask again; or take what drives them further (longer, hotter, faster, more load)."
)


def plan_page(a: Answer) -> Page:
    """The page; the terminal shows the same."""
    s = a.separation
    return Page(
        title="What these tests can tell",
        lead=_lead(a),
        numbers=[(f"{s.rank} of {len(s.parameters)}", "parameters told apart"), (_condition(s), "condition number")],
        sections=[
            Section("Tests", [", ".join(a.tests)]),
            *_troubles(s),
            *_hopeless(a),
            Section("Smallest size that would be found", [], _sizes(s)),
            *_proposals(a.proposals),
            *separator_sections(a.separators),
            *_setups([*a.route, *a.proposals[:SHOWN]], _helpful(a.separators)),
        ],
        foot=[
            f"Three standard errors, white noise of {a.noise:g} µm or µrad.",
            f"rtec {__version__}, rtec plan.",
        ],
    )


def _condition(s: Separation) -> str:
    return f"{s.condition:.1f}" if math.isfinite(s.condition) else "–"


def _lead(a: Answer) -> str:
    s, n = a.separation, len(a.separation.parameters)
    if s.complete:
        weak = f", but only just (condition number {s.condition:.0f})" if s.condition > WEAK else ""
        return f"These tests tell all {n} parameters apart{weak}."
    told = f"These tests tell {s.rank} of {n} parameters apart."
    if not a.route:
        return told
    first, *more = [f"{p.test.name} ({hours_in_words(p.test.hours)})" for p in a.route]
    after = a.route[-1].after.rank
    return f"{told} Add: {', then '.join([first, *more])}; that makes {'all' if after == n else after} of {n}."


def _troubles(s: Separation) -> list[Section]:
    words = [f"Never seen: {name}." for name in s.never]
    words += [f"Only together: {', '.join(group)}." for group in s.confounded]
    return [Section("What stays open", words)] if words else []


def _hopeless(a: Answer) -> list[Section]:
    """What no test helps with; said also where the tests at hand leave nothing open."""
    tests = "circle in this plane" if a.circles else "usual test on this machine"
    words = [
        f"No {tests} sees {group[0]}."
        if len(group) == 1
        else f"No {tests} tells these apart: {', '.join(group)}. What is found is what they make together."
        for group in a.hopeless
    ]
    return (
        [Section("What no further circle would tell" if a.circles else "What no further test would tell", words)]
        if words
        else []
    )


def _sizes(s: Separation) -> Table:
    rows = []
    for p in s.parameters:
        size = s.detectable[p.name]
        together = any(p.name in group for group in s.confounded)
        blind = "only with others" if together else "never"
        enough = blind if not math.isfinite(size) else "yes" if size < p.typical else "only if large"
        rows.append([p.name, f"{size:.3g}" if math.isfinite(size) else "∞", f"{p.typical:.3g}", spoken(p.unit), enough])
    return Table(("parameter", "found from", "usual size", "unit", "seen?"), rows, words=(0, 3, 4))


def _proposals(proposals: Sequence[Proposal]) -> list[Section]:
    if not proposals:
        return []
    rows = [
        [
            p.test.name,
            hours_in_words(p.test.hours),
            f"{p.after.rank}",
            _condition(p.after),
            ", ".join(p.gained[:4]) + (f" and {len(p.gained) - 4} more" if len(p.gained) > 4 else ""),
        ]
        for p in proposals[:SHOWN]
    ]
    head = ("test to add", "takes", "told apart", "condition", "newly found")
    return [Section("What to add, best first", [], Table(head, rows, words=(0, 1, 4)))]


def separator_sections(separators: Sequence[Separator]) -> list[Section]:
    """Tests by the odds that they would give for the right one of each two rivals."""
    if not separators:
        return []
    helpful = _helpful(separators)
    rows = [
        [s.test.name, hours_in_words(s.test.hours), f"{s.clear} of {len(s.pairs)}", _worst(s.pairs)] for s in helpful
    ]
    names = dict.fromkeys(n for p in separators[0].pairs for n in (p.one, p.other))
    said = [
        f"Rivals: {', '.join(names)}. Each is taken to be true at its usual size, the others are fitted to what it "
        "would show in all tests together; told apart means 20 to 1 or better."
    ]
    if not any(s.clear for s in separators):
        said.append(NO_TEST)
    if not rows:
        return [Section("What tells the rivals apart", said)]
    head = ("test to add", "takes", "pairs told apart", "odds of the worst pair")
    return [Section("What tells the rivals apart, best first", said, Table(head, rows, words=(0, 1, 2, 3)))]


def _helpful(separators: Sequence[Separator]) -> list[Separator]:
    return [s for s in separators if max(p.gain for p in s.pairs) > HARDLY][:SHOWN]


def _setups(proposals: Sequence[Proposal], separators: Sequence[Separator]) -> list[Section]:
    """Where the tests that were named are made: what a planned test's file has under `[setup]`."""
    tests = {t.name: t for t in (*(p.test for p in proposals), *(s.test for s in separators))}
    rows = [
        [name, ", ".join(f"{key} = {_key(value)}" for key, value in test.setup.items())]
        for name, test in tests.items()
        if test.setup
    ]
    if not rows:
        return []
    words = ["Keys of [setup], as a file of a planned test and `rtec simulate --set` take them."]
    return [Section("How they are set up", words, Table(("test", "setup"), rows, words=(0, 1)))]


def _key(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_key(v) for v in value)}]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _worst(pairs: Sequence[Pair]) -> str:
    worst = min(pairs, key=lambda p: p.gain)
    odds = "more than 1000 to 1" if worst.gain > math.log(1000.0) else f"{math.exp(worst.gain):.3g} to 1"
    return odds if len(pairs) == 1 else f"{odds} ({worst.one} or {worst.other})"
