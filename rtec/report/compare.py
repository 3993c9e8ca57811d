"""Report of a comparison: one sentence, a table, where it is worst, what it is made of."""

import math
from collections.abc import Sequence

from rtec import __version__
from rtec.diagnosis.compare.result import Compared, Comparison, Outside
from rtec.diagnosis.words import UNITS, named, spoken
from rtec.report.compare_pictures import pictures
from rtec.report.page import Page, Section, Table
from rtec.report.procedures import number

MOST_PARTS, MOST_SAME, MOST_SEEN, MOST_LEAD = 8, 3, 5, 4
AT_FLOOR = 1.1
TAKES_ALL = 0.99
"""Of what is left: more than this in a fitted noise model is all of it."""


def compare_page(c: Comparison, figures: bool = True) -> Page:
    """The page; without figures it is what the terminal shows."""
    return Page(
        title=f"How wrong the model {c.model} is, and where",
        lead=_lead(c),
        numbers=_numbers(c),
        sections=[
            _table(c),
            _worst(c),
            *_outside(c),
            _parts(c),
            _noise(c),
            *(pictures(c) if figures else []),
        ],
        foot=[
            "What the instruments cannot know (zero of a run, misalignment) is taken out of all numbers.",
            f"rtec {__version__}, rtec compare, seed {c.seed} of the draws of chance.",
        ],
    )


def _lead(c: Comparison) -> str:
    """A sentence for each reading column, the worst news first."""
    order = sorted(c.items, key=_badness)
    more = [f"{len(order) - MOST_LEAD} more: see the table."] if len(order) > MOST_LEAD else []
    return "\n".join([*(_said(i, c) for i in order[:MOST_LEAD]), *more])


def _badness(i: Compared) -> tuple[bool, float]:
    """Key for sorting: worse than no model first, then what is left over the noise."""
    return (i.explained or 0.0) >= 0.0, -i.left.rms / max(i.floor, 1e-9)


def _said(first: Compared, c: Comparison) -> str:
    unit = UNITS[first.unit]
    of = f"{_name(first, c)}: " if len(c.items) > 1 else ""
    worse = "the model makes it worse than no model; " if (first.explained or 0.0) < 0.0 else ""
    said = (
        f"{of}{worse}{first.left.rms:.3g} {unit} of {first.measured.rms:.3g} {unit} are left (root mean square), "
        f"noise is {first.floor:.2g} {unit}"
    )
    if first.worst and first.worst[0].apart is not None:
        return f"{said}; {first.worst[0].words}."
    if first.worst:
        w = first.worst[0]
        return f"{said}; worst at {w.words}, {w.rms:.2g} {unit} against {w.elsewhere:.2g} {unit} elsewhere."
    if first.left.rms <= AT_FLOOR * first.floor:
        return f"{said}: the model is at the noise floor."
    return f"{said}; no place stands out beyond chance. `rtec diagnose` looks for what is missing."


def _name(item: Compared, c: Comparison) -> str:
    several = sum(i.name == item.name for i in c.items) > 1
    return f"{item.name} {item.column}" if several else item.name


def _numbers(c: Comparison) -> list[tuple[str, str]]:
    first = min(c.items, key=_badness)
    unit = UNITS[first.unit]
    out = [
        (f"{first.measured.rms:.3g}\u00a0{unit}", "measured"),
        (f"{first.left.rms:.3g}\u00a0{unit}", "left by the model"),
        (f"{first.floor:.2g}\u00a0{unit}", "noise"),
    ]
    return out if first.explained is None else [*out, (_share(first), "of the explainable explained")]


def _share(item: Compared) -> str:
    if item.explained is None:
        return "–"
    if item.explained <= -1.0:
        return "worse"
    # 99.97 % is not all of it.
    return "100 %" if item.explained >= 1.0 else f"{min(100.0 * item.explained, 99.9):.3g} %"


def _table(c: Comparison) -> Section:
    rows = [
        [
            _name(i, c), f"{i.n}", f"{number(i.measured.rms)} / {number(i.measured.most, 1)}",
            f"{number(i.predicted.rms)} / {number(i.predicted.most, 1)}",
            f"{number(i.left.rms)} / {number(i.left.most, 1)}", number(i.floor), _share(i), UNITS[i.unit],
        ]
        for i in c.items
    ]  # fmt: skip
    head = ("measurement", "readings", "measured", "predicted", "left", "noise floor", "explained", "unit")
    caption = "Root mean square / largest. Explained: share of the mean square above the noise floor."
    bad = [f"{_name(i, c)}: the model makes it worse than no model." for i in c.items if (i.explained or 0.0) < 0.0]
    none = [
        f"{_name(i, c)}: nothing to explain, what is measured is hardly more than noise."
        for i in c.items
        if i.explained is None
    ]
    return Section("How wrong", [*bad, *none, *(_sentence(n) for n in c.notes)], Table(head, rows, caption, (0, 7)))


def _sentence(text: str) -> str:
    return text + ("" if text.endswith(".") else ".")


def _worst(c: Comparison) -> Section:
    rows = [
        [
            _name(i, c),
            r.words,
            number(r.rms),
            number(r.elsewhere),
            _signed(r.mean).replace("-0.00", "+0.00"),
            f"{r.n}",
            UNITS[i.unit],
        ]
        for i in c.items
        for r in i.worst
        if r.apart is None
    ]
    apart = [
        f"{_name(i, c)}: {r.words}; with that taken out, {r.elsewhere:.2g} {UNITS[i.unit]} are left."
        for i in c.items
        for r in i.worst
        if r.apart is not None
    ]
    if not rows and apart:
        return Section("Where it is worst", apart)
    if not rows:
        return Section("Where it is worst", ["No place stands out: chance alone looks as uneven as what is left."])
    head = ("measurement", "where", "left there", "elsewhere", "mean there", "readings", "unit")
    words = [
        f"{_name(i, c)}, {r.words}: nearly the same readings as {'; '.join(r.same[:MOST_SAME])}."
        for i in c.items
        for r in i.worst
        if r.same
    ]
    if words:
        words.append("Where channels name the same readings, these data cannot say which of them it is.")
    caption = "Best evidence first; root mean squares, the mean with its sign. Elsewhere: in none of these places."
    return Section("Where it is worst", [*apart, *words], Table(head, rows, caption, (0, 1, 6)))


def _signed(value: float) -> str:
    text = f"{value:+.2f}".replace("-", "−")
    return "0.00" if text[1:] == "0.00" else text


def _outside(c: Comparison) -> list[Section]:
    rows = [
        [_name(i, c), named(o.channel), f"{o.low:.5g} to {o.high:.5g}", _beyond(o), f"{o.n} of {i.n}", spoken(o.unit)]
        for i in c.items
        for o in i.outside
    ]
    if not rows:
        return []
    words = ["There the model guesses, and in the loop the correction is held."]
    head = ("measurement", "channel", "range of the fit", "readings go to", "readings outside", "unit")
    return [Section("Outside the range that the model was fitted in", words, Table(head, rows, "", (0, 1, 5)))]


def _beyond(o: Outside) -> str:
    ends = [f"{o.lowest:.5g}"] if o.lowest < o.low else []
    return " and ".join([*ends, *([f"{o.highest:.5g}"] if o.highest > o.high else [])])


def _parts(c: Comparison) -> Section:
    rows = []
    for i in c.items:
        parts = i.parts[:MOST_PARTS]
        rows += [[_name(i, c), p.label, number(p.rms), number(p.most, 1), UNITS[i.unit]] for p in parts]
    words = [f"{_name(i, c)} sees {_seen(i.sees)}." for i in c.items]
    if not rows:
        return Section("What the model says", [*words, "The model has no effect that these readings see."])
    head = ("measurement", "effect", "root mean square", "largest", "unit")
    return Section("What the model says", words, Table(head, rows, "", (0, 1, 4)))


def _noise(c: Comparison) -> Section:
    words = []
    for i in c.items:
        unit = UNITS[i.unit]
        if i.floor_repeats is None:
            said = f"from a fitted noise model, {i.floor_fitted:.2g} {unit}: too few readings were repeated to tell"
        else:
            said = f"from repeats, {i.floor:.2g} {unit}"
            if not math.isclose(i.floor, i.floor_fitted, rel_tol=0.15):
                said += f" ({_fitted(i)})"
        words.append(f"{_name(i, c)}: {said}.")
    return Section("Where the noise floor comes from", words)


def _fitted(i: Compared) -> str:
    """What the fitted noise model says where repeats decide: drift that they do not see, and all that it may hold."""
    if i.floor_fitted >= i.left.rms * TAKES_ALL:
        return "a fitted noise model, which cannot tell slow drift from what the model misses, takes all that is left"
    slow = ", drift slower than the repeats with it," if i.floor_fitted > i.floor else ""
    return f"a fitted noise model{slow} says {i.floor_fitted:.2g} {UNITS[i.unit]}"


def _seen(sees: Sequence[str]) -> str:
    more = f" and {len(sees) - MOST_SEEN} more" if len(sees) > MOST_SEEN else ""
    return (", ".join(sees[:MOST_SEEN]) or "no component error") + more
