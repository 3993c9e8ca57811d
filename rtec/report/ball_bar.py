"""Report of ball-bar tests: causes, their shares of the circle's error, their uncertainty, and which test to add."""

from collections.abc import Iterator, Sequence
from typing import get_args

import numpy as np

from rtec.arrays import Floats
from rtec.metrology.ball_bar.causes import CURVE_PER_BEND, UNITS, causes, feeds_of
from rtec.metrology.ball_bar.design import SETTING_UP, NotLookedFor
from rtec.metrology.ball_bar.diagnosis import RESIDUAL, BallBarDiagnosis
from rtec.metrology.ball_bar.fit import FittedValue, OfHeight
from rtec.metrology.ball_bar.iso230_4 import CircleHarmonic
from rtec.metrology.ball_bar.search import NotFound
from rtec.metrology.instruments.ball_bar import Plane
from rtec.report import ball_bar_figures as draw
from rtec.report.page import Figure, Page, Section, Table, shell_command
from rtec.version import __version__
from rtec.wording import NONE, number, percent, significant

RAREST = 1e-6
BRIEF, LEAST_BRIEF = 5, 0.01
"""Largest number of causes in the short table, and smallest share of each."""
SERVO = ("delay", "gain_")


def beyond_section(d: BallBarDiagnosis) -> Section:
    """The section on causes beyond [BB]'s parameters."""
    text = [*_servo(d), *_rivals(d), *_left_out(d), *_further_tests(d)]
    return Section("Dynamic effects and the drive", text, _table(d))


def _servo(d: BallBarDiagnosis) -> list[str]:
    """Sentences on servo parameters that one feed does not separate from scale and squareness."""
    open_ = [n for n in d.found.left_out if n.candidate.name.startswith(SERVO) and n.twins and not n.rival]
    feeds = feeds_of(d.circles)
    one = f"All tests were run at one feed, {feeds[0]:g} mm/min, which"
    why = "These tests" if len(feeds) > 1 else one
    pairs = "; ".join(f"{n.candidate.title} from {_titles(d, n)}" for n in open_)
    return [f"{why} cannot separate {pairs}. Their sum is in the table above."] if open_ else []


def _rivals(d: BallBarDiagnosis) -> list[str]:
    """Sentences on alternatives that explain the readings nearly as well as a significant cause."""
    out: dict[str, list[str]] = {}
    for n in d.found.left_out:
        if n.rival and n.candidate.like not in n.twins:
            out.setdefault(_titles(d, n), []).append(n.candidate.title)
    return [
        f"Instead of {found} it may be {' and '.join(other)}: the readings do not decide."
        for found, other in out.items()
    ]


def _left_out(d: BallBarDiagnosis) -> list[str]:
    """Sentences on causes that these tests cannot show, without the servo's."""
    out: dict[str, list[str]] = {}
    for n in d.found.left_out:
        if not n.rival and not (n.candidate.name.startswith(SERVO) and n.twins):
            why = f"not separated from {_titles(d, n)}" if n.twins else n.why
            out.setdefault(why, []).append(n.candidate.title)
    return [f"Not tested: {', '.join(titles)}: {why}." for why, titles in out.items()]


def _titles(d: BallBarDiagnosis, untested: NotLookedFor) -> str:
    known = _all_titles(d)
    return " and ".join(known.get(t, t) for t in untested.twins)


def _all_titles(d: BallBarDiagnosis) -> dict[str, str]:
    """Title of every parameter and of every cause beyond [BB]'s, fitted or not, by its name."""
    titles = {c.name: c.title for c in causes(d.circles[0], bent=True)} | {v.name: v.title for v in d.fitted.values}
    open_ = [*(x.candidate for x in d.found.left_out), *(x.candidate for x in d.found.not_found)]
    return titles | {c.name: c.title for c in open_}


def _further_tests(d: BallBarDiagnosis) -> list[str]:
    title = {n.candidate.name: n.candidate.title for n in d.found.left_out}
    return [f"To separate them: {w.test}; it shows {', '.join(title[n] for n in w.names)}." for w in d.wanted]


def _table(d: BallBarDiagnosis) -> Table | None:
    """Results of the tested candidates."""
    rows = [[p.candidate.title, "yes", _chance(p.chance), NONE, ""] for p in d.found.beyond.picks]
    rows += [[_with(n), "no", NONE, significant(n.limit), UNITS[n.unit]] for n in d.found.not_found]
    head = ["tested", "found", "probability under noise alone", "would be found from", "unit"]
    return Table(head, rows, words=(0, 1, 4)) if rows else None


def _with(n: NotFound) -> str:
    others = " and ".join(x.title for x in n.with_)
    return f"{n.candidate.title}, together with {others}" if others else n.candidate.title


def _chance(share: float) -> str:
    return f"< {significant(RAREST, 1)}" if share < RAREST else significant(share, 1)


def phase_lines(d: BallBarDiagnosis) -> list[str]:
    """Lines on the servo phase above the table of parameters; empty where its choice makes no difference."""
    a, b, _ = d.circles[0].setup.letters
    late = []
    if d.lag_s:
        late = [
            f"Both axes are {significant(1e3 * d.lag_s)} ms late, as position loops of K_v = {1.0 / d.lag_s:.0f} 1/s "
            "without feed-forward are: what happens at a reversal is looked for so much after the commanded quadrant."
        ]
    return [*late, *_phase(d, a, b)]


def _phase(d: BallBarDiagnosis, a: str, b: str) -> list[str]:
    if d.phase.decided and d.phase.reason:
        return [f"Servo phase {a}-{b}: taken as one {d.phase.taken} in all tests, because: {d.phase.reason}."]
    if not d.changed:
        return []
    both = "; ".join(
        f"{s.angle.title} {number(s.angle.value)} as an angle, {number(s.time)} {UNITS[s.angle.unit]} as a time"
        for s in d.changed
    )
    return [
        f"Servo phase {a}-{b}: feed over radius differs between the tests, and they do not determine whether it is one "
        "angle in all of them [BB] or one time, as the lag of an axis is; intervals hold both, values are those of one "
        f"{d.phase.taken}: {both}. --phase time or --phase angle settles it. Tests with feeds in proportion to their "
        f"radii ({_feeds(d)}) avoid the question."
    ]


def _feeds(d: BallBarDiagnosis) -> str:
    """The first test's feed, and the one in proportion for every other radius, in words."""
    first = d.circles[0].setup
    radii = dict.fromkeys(c.setup.radius_mm for c in d.circles)
    return ", ".join(f"radius {r:g} mm at {first.feed_mm_min * r / first.radius_mm:.0f} mm/min" for r in radii)


FORMULAS = (
    "ISO 230-4, about the least-squares circle: G largest minus smallest deviation of one path; G(b) of both paths; H "
    "largest difference of the two at one angle; D least-squares radius of both minus nominal; F radial deviation.",
    "Causes after [BB Table 1], columns from the machine's own chain, fitted to the exact length of the bar. Intervals "
    "are 95 %, widened by how long readings in a row err together.",
    "Scale: positive where the axis moves too far. Servo phase: positive where the first axis leads. Squareness and "
    "perpendicularity are right-handed rotations; the note says which way the axis leans.",
    "Clearance: the axis lags half of it behind on either flank; it is minus the reversal value B of ISO 230-2.",
    "Reversal spike: positive where the axis comes late, drawn outwards. Lateral play: place of the slide moving to "
    "plus minus that moving to minus.",
)
LARGER = 1.05
"""An undetermined cause is named beside the largest one if it may be larger by this factor."""
SMALLEST_UM = 0.01
"""A cause whose curve on the circle is smaller than this has no panel."""


def ball_bar_page(d: BallBarDiagnosis, figures: bool = True) -> Page:
    """The page.

    Args:
        d: the diagnosis.
        figures: whether to draw.
    """
    plane = d.circles[0].setup.plane
    sections = [
        Section("Circle", [*d.doubts, *_notes(d)], _rounds(d), _polar(d) if figures else None),
        *([Section("Both senses", [], _pairs(d))] if d.pairs else []),
        Section("Causes, largest first", _explained(d), _shares(d), _linear(d) if figures else None),
        *(_one_by_one(d) if figures else []),
        Section(
            "Parameters", [f"Model: {d.fitted.model}, because {d.reason}.", *phase_lines(d), *_apart(d)], _values(d)
        ),
        *([beyond_section(d)] if d.dynamic else []),
    ]
    if any(s.measured for s in d.spectra):
        sections.append(Section("Harmonics", [], _spectra(d), _spectrum_figure(d) if figures else None))
    lead = f"Plane {plane}: " + "; ".join(f"{r.name} G = {number(r.g_um)} µm" for r in d.rounds) + "."
    lead += _largest(d)
    return Page(
        title=f"Ball bar, plane {plane}",
        lead=lead,
        numbers=[(f"{number(r.g_um)}\u00a0µm", f"G, {r.name}") for r in d.rounds][:4],
        sections=sections,
        foot=[*FORMULAS, f"rtec {__version__}, rtec ballbar."],
        brief=Section("", [*d.doubts, *(_height(d, h) for h in d.fitted.heights)], _brief(d)),
        next=_next(d),
    )


def _brief(d: BallBarDiagnosis) -> Table:
    """The largest causes."""
    shown = [s for s in d.shares if s.share >= LEAST_BRIEF][:BRIEF] or d.shares[:BRIEF]
    rows = [[s.group, number(s.g_um), number(100.0 * s.share, 1), _sizes(d, s.group)] for s in shown]
    return Table(["cause", "G by itself, µm", "share, %", "size, and its 95 % interval"], rows, words=(0, 3))


def _next(d: BallBarDiagnosis) -> list[str]:
    """Commands: a plan of tests where causes are confounded, else a fit."""
    if not d.files:
        return []
    if d.wanted or d.fitted.rank.confounded:
        return [shell_command("rtec", "plan", *d.files, "--ball-bar", "non-linear")]
    return [shell_command("rtec", "fit", *d.files, "-o", "model.toml")]


def _largest(d: BallBarDiagnosis) -> str:
    """Sentence on the largest determined cause, and on an undetermined one that may be larger."""
    top = next((s for s in d.shares if s.group != RESIDUAL), None)
    if d.named is None:
        open_ = f"; {top.group} may be {number(top.g_um)} µm" if top and top.g_um > SMALLEST_UM else ""
        return f" No cause is determined beyond doubt{open_}."
    sure = [v for v in (*d.fitted.values, *d.fitted.combinations) if np.isfinite(v.value)]
    others = dict.fromkeys(n for v in sure if v.group == d.named.group for n in v.with_)
    titles = {n.candidate.name: n.candidate.title for n in d.found.left_out}
    also = " and ".join(titles[n] for n in others if n in titles)
    joined = any(v.group != d.named.group for v in d.fitted.combinations)
    larger = top is not None and top.g_um > LARGER * d.named.g_um
    out = (
        f" The largest cause {'that these tests determine ' if joined or larger else ''}is {d.named.group}"
        f"{f' (or {also})' if also else ''}: {number(d.named.g_um)} µm by itself."
    )
    return out + (f" Not determined: {top.group}, up to {number(top.g_um)} µm." if top and larger else "")


def _notes(d: BallBarDiagnosis) -> list[str]:
    out = [f"{c.name}: {c.left_out} readings are missing or outside the arc" for c in d.circles if c.left_out]
    for c in d.circles:
        ends = [[c.setup.start_deg + c.setup.sense * way for way in gap] for gap in c.gaps]
        out += [
            f"{c.name}: no readings from {low:.0f} to {high:.0f}°; so no least-squares centre for F and no harmonics"
            if c.closed else f"{c.name}: no readings from {low:.0f} to {high:.0f}°"
            for low, high in ends
        ]  # fmt: skip
    high = [c.name for c in d.circles if abs(c.setup.height_mm) > 1e-9]
    if high:
        out.append(f"{', '.join(high)}: readings are along the bar, which leans (height is not zero)")
    return out


def _rounds(d: BallBarDiagnosis) -> Table:
    rows = [
        [
            r.name, "ccw" if c.setup.sense > 0 else "cw", f"{c.setup.radius_mm:g}", f"{c.setup.height_mm:g}",
            f"{c.setup.feed_mm_min:g}", number(r.g_um), number(r.f_max_um), number(r.f_min_um), r.about,
        ]
        for r, c in zip(d.rounds, d.circles, strict=True)
    ]  # fmt: skip
    head = ["test", "sense", "r, mm", "h, mm", "mm/min", "G, µm", "F max, µm", "F min, µm", "F about"]
    return Table(head, rows, words=(0, 1, 8))


def _pairs(d: BallBarDiagnosis) -> Table:
    rows = [
        [" and ".join(p.names), number(p.g_b_um), number(p.h_um), f"{p.h_at_deg:.0f}", number(p.d_um)] for p in d.pairs
    ]
    return Table(["tests", "G(b), µm", "H, µm", "H at, °", "D, µm"], rows)


def _explained(d: BallBarDiagnosis) -> list[str]:
    near = f"readings within {d.window_deg:g}° of the quadrants ({percent(d.near_quadrants)} of all)"
    out = f"The fit explains {percent(d.explained)} of the variance; {near} "
    if not d.found.beyond.picks:
        return [out + "are not fitted but are counted here."]
    weight = "are fitted, except where an axis still crosses its clearance"
    bb = f"Without dynamic effects and the drive, as in [BB], it would be {percent(d.explained_bb)}."
    return [f"{out}{weight}.", bb]


def _shares(d: BallBarDiagnosis) -> Table:
    rows = [[s.group, number(s.g_um), number(100.0 * s.share, 1), _sizes(d, s.group)] for s in d.shares]
    return Table(["cause", "G by itself, µm", "share, %", "size, and its 95 % interval"], rows, words=(0, 3))


def _sizes(d: BallBarDiagnosis, group: str) -> str:
    """The parameters of a cause, each with its unit and interval."""
    known = [v for v in d.fitted.values if v.group == group and np.isfinite(v.value)]
    whole = [v for v in d.fitted.combinations if v.group == group]
    return "; ".join([*(_interval(d, v, len(known) > 1) for v in known), *(_interval(d, v, True) for v in whole)])


def _interval(d: BallBarDiagnosis, v: FittedValue, named: bool) -> str:
    digits = _digits(v)
    name = f"{v.title.split(', ')[-1]} " if named else ""
    size = f"{name}{number(v.value, digits)} {UNITS[v.unit]} ({number(v.low, digits)} … {number(v.high, digits)})"
    return ", ".join([size, *_beside(d, v)])


def _beside(d: BallBarDiagnosis, v: FittedValue) -> list[str]:
    """Causes that a number includes, and alternatives to it."""
    titles, rivals = _all_titles(d), {n.candidate.name for n in d.found.left_out if n.rival}
    together = [titles.get(n, n) for n in v.with_ if n not in rivals]
    instead = [titles.get(n, n) for n in v.with_ if n in rivals]
    both = [f"together with {', '.join(together)}"] if together else []
    return both + ([f"or {' and '.join(instead)} instead"] if instead else [])


def _digits(v: FittedValue) -> int:
    return 4 if v.unit in ("per_km", "ms", "mm") else 2


def _apart(d: BallBarDiagnosis) -> list[str]:
    rank, titles = d.fitted.rank, _all_titles(d)
    out = [f"These tests do not determine: {', '.join(titles[n] for n in rank.never)}."] if rank.never else []
    out += [f"These tests do not separate {' and '.join(titles[n] for n in s)}." for s in rank.confounded]
    return out + [_height(d, h) for h in d.fitted.heights] + [*_curves(d)]


def _curves(d: BallBarDiagnosis) -> Iterator[str]:
    """Sentences on bends in the plane that may be a curved positioning error of the other axis."""
    letters = d.circles[0].setup.letters
    bends = {v.name: v for v in d.fitted.values if v.low > 0.0 or v.high < 0.0}
    for n in d.found.left_out:
        like = n.candidate.like
        if like not in n.twins or like not in bends:
            continue
        own = letters[n.candidate.axis]
        plane = next(p for p in get_args(Plane) if set(p) == {own, letters[2]})
        size = CURVE_PER_BEND * bends[like].value
        yield (
            f"These tests do not separate the {bends[like].title} from a {n.candidate.title} of {significant(size)} "
            f"{UNITS['um_per_m2']}: the ball's place hides the difference. The intervals of the centre offset and the "
            f"perpendicularity of {own} hold both. A circle in plane {plane} shows only the latter again (rtec fit "
            "takes all planes together); a flat circle of another radius about the same ball separates them, too."
        )


def _height(d: BallBarDiagnosis, of: OfHeight) -> str:
    """Sentence on parameters that are confounded with a height of the ball, and the test that separates them."""
    a, b, n = d.circles[0].setup.letters
    titles = {v.name: v.title for v in d.fitted.values}
    planes = {x.lower(): next(p for p in get_args(Plane) if set(p) == {x, n}) for x in (a, b)}
    bends = [planes[name[-1]] for name in of.names if name.startswith("pitch_")]
    if bends:
        test = f"A flat test (height 0) in plane {' and one in plane '.join(bends)} shows them as bends in its plane"
    else:
        test = "A flat test (height 0) in this plane separates them"
    return (
        f"The height of the table ball (known to ±{1e-3 * of.known_um:g} mm) is confounded with "
        f"{' and '.join(titles[name] for name in of.names)}: a ball that is {number(abs(of.height_um))} µm "
        f"{'higher' if of.height_um > 0.0 else 'lower'} has the same effect as the fitted ones. {test}. Or measure the "
        "height and give its uncertainty as [setup] height_uncertainty_mm."
    )


def _values(d: BallBarDiagnosis) -> Table:
    rows = [_row(d, v) for v in (*d.fitted.combinations, *d.fitted.values)]
    return Table(["parameter", "value", "95 % from", "to", "unit", "note"], rows, words=(0, 4, 5))


def _row(d: BallBarDiagnosis, v: FittedValue) -> list[str]:
    digits, notes = _digits(v), _beside(d, v)
    if not np.isfinite(v.value):
        titles = _all_titles(d)
        others = ", ".join(titles.get(n, n) for n in v.with_)
        why = f"not separated from {others}" if others else "not determined by these tests"
        return [v.title, NONE, NONE, NONE, UNITS[v.unit], why]
    if v.unit == "per_km" and v.value != 0.0:
        notes = [f"radius {significant(1.0 / v.value, 3)} km", *notes]
    note = "; ".join([*([v.note] if v.note else []), *notes])
    return [v.title, number(v.value, digits), number(v.low, digits), number(v.high, digits), UNITS[v.unit], note]


def _spectra(d: BallBarDiagnosis) -> Table:
    known = [s for s in d.spectra if s.measured]
    head = ["waves", *(f"{s.name} {kind}, µm" for s in known for kind in ("measured", "fitted"))]
    rows = [
        [
            f"×{k}" if k else "mean",
            *(number(h[k].amplitude_um, 3) for s in known for h in (s.measured, s.fitted)),
        ]
        for k in range(len(known[0].measured))
    ]
    return Table(head, rows)


def _traces(d: BallBarDiagnosis) -> list[draw.CircleTrace]:
    """Measured and fitted, without the position of the ball and the length of the bar: they are no machine error."""
    out, feeds = [], len(feeds_of(d.circles))
    for i, c in enumerate(d.circles):
        name = f"{c.name}, {c.setup.feed_mm_min:g} mm/min" if feeds > 1 else c.name
        place = d.fitted.parts_um.get(SETTING_UP)
        off = place[i] if place is not None else np.zeros(len(c))
        fitted = d.fitted.fitted_um(i) - off
        out.append(draw.CircleTrace(name, c.setup.sense, c.angle_rad, c.reading_um - off, fitted))
    return out


def _polar(d: BallBarDiagnosis) -> Figure:
    a, b, _ = d.circles[0].setup.letters
    png = draw.polar(f"Plane {a}{b}: deviation from the circle, magnified", (a, b), _traces(d))
    return Figure("polar.png", png, "deviation drawn outwards from the circle, measured and fitted, by test")


def _linear(d: BallBarDiagnosis) -> Figure:
    png = draw.linear(_traces(d), d.window_deg, used=bool(d.found.beyond.picks))
    return Figure("linear.png", png, "deviation against angle: measured, fitted and residual, by test")


def _one_by_one(d: BallBarDiagnosis) -> list[Section]:
    """Figures of every cause alone, largest first."""
    shown = [s for s in d.shares if s.group != RESIDUAL and s.g_um > SMALLEST_UM]
    if not shown:
        return []
    curves = [(f"{s.group} ({percent(s.share)})", d.fitted.parts_um[s.group]) for s in shown]
    png = draw.causes(_traces(d), curves, d.window_deg)
    figure = Figure("causes.png", png, "each cause by itself against angle, largest first; all panels have one scale")
    return [Section("Causes one by one", ["What each adds to the length of the bar."], None, figure)]


def _spectrum_figure(d: BallBarDiagnosis) -> Figure:
    tests = [(s.name, _amplitudes(s.measured), _amplitudes(s.fitted)) for s in d.spectra if s.measured]
    return Figure("harmonics.png", draw.spectra(tests), "amplitude by number of waves in a turn, measured and fitted")


def _amplitudes(found: Sequence[CircleHarmonic]) -> Floats:
    """Amplitudes from order 1, µm."""
    return np.array([h.amplitude_um for h in found[1:]], dtype=np.float64)
