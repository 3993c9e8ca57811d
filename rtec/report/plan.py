"""Report of a plan: which parameters the tests separate, which stay confounded, which test to add."""

import math
from collections.abc import Sequence
from dataclasses import replace

from rtec.diagnosis.plan.answer import Answer
from rtec.diagnosis.plan.plan import WEAK, Proposal, Separation
from rtec.diagnosis.plan.separating import Pair, Separator
from rtec.diagnosis.words import spoken
from rtec.report.page import Page, Section, Table
from rtec.version import __version__
from rtec.wording import duration, number, significant

SHOWN, BRIEF = 8, 4
HARDLY = math.log(2.0)
"""A test is not listed if its odds are smaller than this for every pair."""
NO_TEST = (
    "No single test on this machine separates any two of them at these sizes. Two tests together may: add another to "
    "the planned ones and run this again; or vary the drivers more (longer, hotter, faster, more load)."
)


def plan_page(a: Answer, figures: bool = True) -> Page:
    """The page, which has no figures."""
    del figures  # it has none
    s = a.separation
    return Page(
        title="What these tests separate",
        lead=_lead(a),
        numbers=_numbers(a),
        sections=[
            Section("Tests", [", ".join(a.tests)]),
            *_troubles(s),
            *_hopeless(a),
            Section("Smallest detectable size", [], _sizes(s)),
            *_proposals(a.proposals),
            *separator_sections(a.separators),
            *_setups([*a.route, *a.proposals[:SHOWN]], _helpful(a.separators)),
        ],
        foot=[
            f"Three standard errors, white noise of {a.noise:g} µm or µrad.",
            f"rtec {__version__}, rtec plan.",
        ],
        brief=_brief(a),
    )


def _brief(a: Answer) -> Section:
    """Confounded parameters and the tests to add; detectable sizes where no test is proposed."""
    words = [word for section in (*_troubles(a.separation), *_hopeless(a)) for word in section.text]
    if a.rivals:
        return _brief_of_rivals(a, words)
    if a.proposals:
        n = len(a.separation.parameters)
        rows = [[p.test.name, _minutes(p.test.hours), f"{p.after.rank} of {n}"] for p in a.proposals[:BRIEF]]
        return Section("", words, Table(("test to add", "time, min", "then separated"), rows))
    for section in separator_sections(a.separators):
        if section.table:
            return Section("", words, replace(section.table, rows=section.table.rows[:BRIEF]))
    return Section("", words, _sizes(a.separation))


def _brief_of_rivals(a: Answer, words: Sequence[str]) -> Section:
    """Tests that separate the rivals in question; if there is none, the words of why."""
    (section,) = separator_sections(a.separators) or [Section("", [])]
    if section.table is None:
        return Section("", [*words, *section.text])
    return Section("", words, replace(section.table, rows=section.table.rows[:BRIEF]))


def _numbers(a: Answer) -> list[tuple[str, str]]:
    """Pairs of rivals that are separated where rivals are in question; else parameters."""
    s = a.separation
    if a.rivals:
        return [(f"{sum(p.clear for p in a.rivals)} of {len(a.rivals)}", "pairs of rivals separated")]
    return [(f"{s.rank} of {len(s.parameters)}", "parameters separated"), (_condition(s), "condition number")]


def _minutes(hours: float) -> str:
    return number(60.0 * hours, 0)


def _condition(s: Separation) -> str:
    return number(s.condition, 1)


def _lead(a: Answer) -> str:
    if a.rivals:
        return _lead_of_rivals(a)
    s, n = a.separation, len(a.separation.parameters)
    if s.complete:
        weak = f", but only weakly (condition number {s.condition:.0f})" if s.condition > WEAK else ""
        return f"These tests separate all {n} parameters{weak}."
    verdict = f"These tests separate {s.rank} of {n} parameters."
    if not a.route:
        return verdict
    first, *more = [f"{p.test.name} ({duration(3600.0 * p.test.hours)})" for p in a.route]
    after = a.route[-1].after.rank
    which = f"all {n}" if after == n else f"{after} of {n}"
    return f"{verdict} Add: {', then '.join([first, *more])}; then {which} are separated."


def _lead_of_rivals(a: Answer) -> str:
    """Whether the tests separate the rivals in question, and the first test to add."""
    alike = [p for p in a.rivals if not p.clear]
    if not alike:
        return (
            f"These tests separate the rivals at white noise: {_odds(a.rivals)} or better for the true one of each "
            "two. Slow drift is not counted. Where `rtec diagnose` says that such readings cannot distinguish them, "
            "take a test of the table in addition."
        )
    worst = min(alike, key=lambda p: p.gain)
    verdict = f"These tests do not separate {worst.one} from {worst.other}: expected odds {_odds([worst])}."
    if len(a.rivals) > 1:
        verdict = f"These tests separate {len(a.rivals) - len(alike)} of {len(a.rivals)} pairs of rivals. " + (
            f"They do not separate {worst.one} from {worst.other}: expected odds {_odds([worst])}."
        )
    before = len(a.rivals) - len(alike)
    best = next((s for s in a.separators if s.clear > before), None)
    if best is None:
        return f"{verdict} No single test on this machine does." if a.separators else verdict
    all_of = "they are" if len(a.rivals) == 1 else f"{best.clear} of {len(a.rivals)} pairs are"
    return f"{verdict} Add: {best.test.name} ({duration(3600.0 * best.test.hours)}); then {all_of} separated."


def _odds(pairs: Sequence[Pair]) -> str:
    """Expected odds of the worst pair."""
    gain = min(p.gain for p in pairs)
    return "> 1000 to 1" if gain > math.log(1000.0) else f"{significant(math.exp(gain))} to 1"


def _troubles(s: Separation) -> list[Section]:
    words = [f"Not determined: {name}." for name in s.never]
    words += [f"Confounded: {', '.join(group)}." for group in s.confounded]
    return [Section("Not separated", words)] if words else []


def _hopeless(a: Answer) -> list[Section]:
    """Parameters that no further test separates."""
    tests = "circle in this plane" if a.circles else "usual test on this machine"
    words = [
        f"No {tests} determines {group[0]}."
        if len(group) == 1
        else f"No {tests} separates these: {', '.join(group)}. Only their joint effect can be determined."
        for group in a.hopeless
    ]
    return (
        [
            Section(
                "What no further circle would separate" if a.circles else "What no further test would separate", words
            )
        ]
        if words
        else []
    )


def _sizes(s: Separation) -> Table:
    rows = []
    for p in s.parameters:
        size = s.detectable[p.name]
        together = any(p.name in group for group in s.confounded)
        blind = "confounded" if together else "no"
        enough = blind if not math.isfinite(size) else "yes" if size < p.typical else "only if large"
        rows.append([p.name, enough, significant(size), significant(p.typical), spoken(p.unit)])
    searched = any(part.theta for p in s.parameters for part in p.parts)
    caption = "Periods and time constants are taken as known." if searched else ""
    return Table(("parameter", "detectable", "from", "usual size", "unit"), rows, caption, words=(0, 1, 4))


def _proposals(proposals: Sequence[Proposal]) -> list[Section]:
    if not proposals:
        return []
    rows = [
        [
            p.test.name,
            _minutes(p.test.hours),
            f"{p.after.rank}",
            _condition(p.after),
            ", ".join(p.gained[:4]) + (f" and {len(p.gained) - 4} more" if len(p.gained) > 4 else ""),
        ]
        for p in proposals[:SHOWN]
    ]
    head = ("test to add", "time, min", "separated", "condition number", "newly separated")
    return [Section("Tests to add, best first", [], Table(head, rows, words=(0, 4)))]


def separator_sections(separators: Sequence[Separator]) -> list[Section]:
    """Tests, ranked by the odds that they give for the true one of each two rivals."""
    if not separators:
        return []
    helpful = _helpful(separators)
    rows = [[s.test.name, _minutes(s.test.hours), f"{s.clear} of {len(s.pairs)}", _worst(s.pairs)] for s in helpful]
    names = dict.fromkeys(n for p in separators[0].pairs for n in (p.one, p.other))
    text = [
        f"Rivals: {', '.join(names)}. Each is taken as true at its usual size, or that given, and the others are "
        "fitted to its readings in all tests together. Separated means odds of 20 to 1 or better."
    ]
    if not any(s.clear for s in separators):
        text.append(NO_TEST)
    if not rows:
        return [Section("Tests that separate the rivals", text)]
    head = ("test to add", "time, min", "pairs separated", "odds of the worst pair")
    return [Section("Tests that separate the rivals, best first", text, Table(head, rows, words=(0, 3)))]


def _helpful(separators: Sequence[Separator]) -> list[Separator]:
    return [s for s in separators if max(p.gain for p in s.pairs) > HARDLY][:SHOWN]


def _setups(proposals: Sequence[Proposal], separators: Sequence[Separator]) -> list[Section]:
    """Set-ups of the named tests: `[setup]` of a planned test's file."""
    tests = {t.name: t for t in (*(p.test for p in proposals), *(s.test for s in separators))}
    rows = [
        [name, ", ".join(f"{key} = {_key(value)}" for key, value in test.setup.items())]
        for name, test in tests.items()
        if test.setup
    ]
    if not rows:
        return []
    words = ["Keys of [setup] in the file of a planned test, and of `rtec simulate --set`."]
    return [Section("Set-up of the tests", words, Table(("test", "setup"), rows, words=(0, 1)))]


def _key(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_key(v) for v in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _worst(pairs: Sequence[Pair]) -> str:
    worst, odds = min(pairs, key=lambda p: p.gain), _odds(pairs)
    return odds if len(pairs) == 1 else f"{odds} ({worst.one} or {worst.other})"
