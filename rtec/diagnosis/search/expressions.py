"""An error without a name as an expression for `--expr`: a hump, a step, a polynomial or a wave, and where.

Simple forms over the variables of the best shape without a name are weighed for each component error that the
readings see, as the effects of the catalogue are. The one with the best evidence is proposed for `rtec add --expr`.

Forms are polynomials, a hump, a step and a wave, over one variable or two.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from rtec.arrays import Floats
from rtec.diagnosis.search.confounded import STEPS
from rtec.diagnosis.search.screen import Projected
from rtec.diagnosis.search.shapes import SHARP, Ground, LocalPlace, Shape, in_gap, weigh
from rtec.diagnosis.search.unnamed import Shaped
from rtec.diagnosis.words import A_STEP, A_STEP_BETWEEN, named, spoken, unit_of_channel
from rtec.effects import Effect
from rtec.effects.base import component_kind
from rtec.effects.expression import expression_from_text
from rtec.errors import ModelError
from rtec.estimation.candidates import visible
from rtec.estimation.gls import solve
from rtec.estimation.noise import Whitener
from rtec.estimation.readings import Readings, looked_at
from rtec.wording import significant

DEGREES = (1, 2, 3, 4)
LETTERS = "ABCDEFGH"
CENTRES, WIDTHS = 24, 7
NARROWEST, WIDEST = 0.02, 0.5
"""Widths of humps and steps in the grid, as shares of the span."""
SAMPLED, TURNS, PERIODS = 2.1, 1.5, 60
"""Shortest period over the step between targets; fewest turns of a wave over the span; periods in the grid."""
AROUND = 4.0
"""The proposed bounds of a width are this factor below and above it."""


@dataclass(frozen=True)
class Span:
    """A variable as an expression uses it.

    Attributes:
        name: of the channel.
        low, high: of the readings; of a temperature, above the reference.
        step: between neighbouring values.
        zero: of a temperature, the reference; it is added in texts for people.
    """

    name: str
    low: float
    high: float
    step: float
    zero: float

    @property
    def scaled(self) -> str:
        """The variable scaled to about -1 … +1, as text; a direction is that already."""
        if self.name.startswith("d_"):
            return self.name
        middle, half = _short(0.5 * (self.low + self.high)), _short(0.5 * (self.high - self.low))
        return (
            f"(({self.name} - {middle})/{half})" if float(middle) >= 0.0 else f"(({self.name} + {middle[1:]})/{half})"
        )


@dataclass(frozen=True)
class ExpressionSearch:
    """A non-linear parameter: its range and its grid; `ratio` where steps are ratios."""

    name: str
    low: float
    high: float
    grid: tuple[float, ...]
    ratio: bool = False

    @property
    def start(self) -> float:
        """The middle of the grid."""
        return self.grid[len(self.grid) // 2]

    def between(self, value: float) -> float:
        """The step of the grid at a value."""
        if len(self.grid) < 2:
            return 0.1 * (self.high - self.low)
        return value * (self.grid[1] / self.grid[0] - 1.0) if self.ratio else self.grid[1] - self.grid[0]

    def text(self, value: float) -> str:
        """The parameter, with this start, as `--param` takes it."""
        low, high = (max(self.low, value / AROUND), min(self.high, value * AROUND)) if self.ratio else (
            self.low, self.high)  # fmt: skip
        return f"{self.name}={_short(value)}:{_short(min(low, value))}..{_short(max(high, value))}"


@dataclass(frozen=True)
class Form:
    """An expression with its non-linear parameters; the words describe variable `along`; a wave may grow.

    Sharp steps are in the middle of the gap between two targets, which is all that the readings show of their place.
    """

    kind: Literal["polynomial", "hump", "step", "steps", "wave"]
    expression: str
    searched: tuple[ExpressionSearch, ...] = ()
    along: int = 0
    grows: int | None = None
    sharp: bool = False


def forms_of(spans: Sequence[Span], period: float | None, harmonics: int = 0) -> Iterator[Form]:
    """Forms over one variable or two.

    Args:
        spans: the variables.
        period: of a wave along the first, in its unit; None where there is none.
        harmonics: of the wave, beyond the first.
    """
    if period is not None:
        yield from _waves(spans, period, harmonics)
        return
    if len(spans) == 1:
        yield from _of_one(spans[0])
        yield from _waves(spans, None)
        return
    for along, other in ((0, 1), (1, 0)):
        if not spans[along].name.startswith("d_"):
            yield from _grown(spans, along, spans[other].scaled)
    one, two = (s.scaled for s in spans[:2])
    terms = [one, two, f"{one}*{two}"]
    yield Form("polynomial", _sum(terms))


def _of_one(span: Span) -> Iterator[Form]:
    u = span.scaled
    powers = [u, *(f"{u}**{k}" for k in DEGREES[1:])]
    for degree in DEGREES:
        yield Form("polynomial", _sum(powers[:degree]))
    for kind, text, searched in _local(span):
        yield Form(kind, _sum([text]), searched)
        yield Form(kind, _sum([text, u]), searched)


def _stepped(span: Span, places: Sequence[LocalPlace], sharp: bool) -> list[Form]:
    """One step, also beside a slope, or several; each may be anywhere between the values beside it.

    Args:
        span: the variable.
        places: of the steps.
        sharp: whether each is in the middle between two targets.
    """
    names = ["centre"] if len(places) == 1 else [f"centre{i}" for i in range(1, len(places) + 1)]
    terms = [f"tanh(({span.name} - {n})/{_short(p.width)})" for n, p in zip(names, places, strict=True)]
    searched = tuple(
        ExpressionSearch(n, p.centre - 0.5 * p.width / SHARP, p.centre + 0.5 * p.width / SHARP, (p.centre,))
        for n, p in zip(names, places, strict=True)
    )
    if len(places) > 1:
        return [Form("steps", _sum(terms), searched, sharp=sharp)]
    return [Form("step", _sum(t), searched, sharp=sharp) for t in (terms, [*terms, span.scaled])]


def _grown(spans: Sequence[Span], along: int, factor: str) -> Iterator[Form]:
    """Forms along one variable whose height is proportional to the other."""
    u = spans[along].scaled
    powers = [factor, *(f"{factor}*{u}" if k == 1 else f"{factor}*{u}**{k}" for k in DEGREES[:3])]
    for count in range(2, len(powers) + 1):
        yield Form("polynomial", _sum(powers[:count]), along=along)
    for kind, text, searched in _local(spans[along]):
        yield Form(kind, _sum([f"{factor}*{text}"]), searched, along)
        yield Form(kind, _sum([text, f"{factor}*{text}"]), searched, along)


def _local(span: Span) -> Iterator[tuple[Literal["hump", "step"], str, tuple[ExpressionSearch, ...]]]:
    span_length = span.high - span.low
    narrow = max(NARROWEST * span_length, span.step)
    if narrow >= WIDEST * span_length:
        return
    centre = ExpressionSearch("centre", span.low, span.high, tuple(np.linspace(span.low, span.high, CENTRES + 2)[1:-1]))
    widths = tuple(np.geomspace(narrow, WIDEST * span_length, WIDTHS))
    width = ExpressionSearch("width", 0.5 * narrow, span_length, widths, ratio=True)
    yield "hump", f"exp(-(({span.name} - centre)/width)**2)", (centre, width)
    yield "step", f"tanh(({span.name} - centre)/width)", (centre, width)


def _waves(spans: Sequence[Span], period: float | None, harmonics: int = 0) -> Iterator[Form]:
    """An even wave, also with harmonics, and waves whose height grows with a variable or along their own axis."""
    first = spans[0]
    span_length = first.high - first.low
    if period is not None:
        # At a larger deviation the wave would be out of phase at the ends.
        off = 0.5 * period / max(span_length, period)
        searched = ExpressionSearch("period", period * (1.0 - off), period * (1.0 + off), (period,))
    else:
        shortest, longest = max(SAMPLED * first.step, NARROWEST * span_length), span_length / TURNS
        if shortest >= longest:
            return
        grid = tuple(1.0 / np.linspace(1.0 / longest, 1.0 / shortest, PERIODS))
        searched = ExpressionSearch("period", shortest, longest, grid)
    waves = [f"{f}(2*pi*{first.name}/period)" for f in ("sin", "cos")]
    yield Form("wave", _sum(waves), (searched,))
    if harmonics:
        more = [f"{f}({2 * k}*pi*{first.name}/period)" for k in range(2, harmonics + 2) for f in ("sin", "cos")]
        yield Form("wave", _sum([*waves, *more]), (searched,))
    for place, span in enumerate(spans):
        yield Form("wave", _sum([*waves, *(f"{span.scaled}*{w}" for w in waves)]), (searched,), grows=place)


def _sum(terms: Sequence[str]) -> str:
    return " + ".join(f"{letter}*{term}" for letter, term in zip(LETTERS, terms, strict=False))


def _short(value: float) -> str:
    return f"{value:.4g}"


LEADING = 2
"""Component errors for which forms are weighed."""
ALIKE = 1e-6
"""Forms whose evidence differs by less are equally likely."""
HALVINGS = 4
FWHM = 2.0 * math.sqrt(math.log(2.0))
"""Width of exp(-(x/w)²) at half its height, over w."""


@dataclass(frozen=True)
class Typed:
    """A proposed expression.

    Attributes:
        expression, parameters, component: as `--expr`, `--param` and `--component` take them.
        where: in words; empty where there is nothing to report.
        effect, theta: the same as an effect, and its non-linear parameters to the precision of a grid.
    """

    expression: str
    parameters: tuple[str, ...]
    component: str
    where: str
    effect: Effect
    theta: Mapping[str, float]


@dataclass(frozen=True)
class _Weighed:
    form: Form
    component: str
    effect: Effect
    theta: Mapping[str, float]
    evidence: float


def propose(readings: Readings, base: Floats, shaped: Shaped) -> Typed | None:
    """The best simple form for a shape without a name; None where no form is likelier than nothing.

    Args:
        readings: the readings.
        base: columns of the current model, (m, p).
        shaped: the shape.
    """
    spans = _spans(readings, shaped)
    if spans is None:
        return None
    keep = looked_at(readings)
    few = readings if keep.all() else readings.without(~keep)
    harmonics = shaped.shape.fine[0] if len(shaped.shape.over) == 1 else 0
    known = shaped.fit.whitener
    whitener = known if few is readings else replace(known, readings=few)
    projected = Projected.of(whitener, base[keep], few.values)
    shape = shaped.shape
    steps = shape.place is not None and shape.place.form == "step"
    stepped = _stepped(spans[0], shape.places, _in_gaps(readings, shape)) if steps else []
    forms = stepped if shape.more else [*stepped, *forms_of(spans, shape.period, harmonics)]
    weighed = [
        t
        for component in _components(few, projected, shaped)
        for form in forms
        if (t := _best(few, projected, form, component)) is not None
    ]
    top = max((t.evidence for t in weighed), default=0.0)
    if top <= 0.0:
        return None
    # A term that the model already has adds nothing: the form without it comes first.
    best = next(t for t in weighed if t.evidence > top - ALIKE)
    best = best if best.form.sharp else _refined(few, projected, best)
    parameters = tuple(p.text(best.theta[p.name]) for p in best.form.searched)
    text = best.form.expression
    return Typed(text, parameters, best.component, _where(few, base[keep], whitener, best, spans), best.effect,
                 best.theta)  # fmt: skip


def _spans(readings: Readings, shaped: Shaped) -> list[Span] | None:
    """The variables as an expression uses them; None where it cannot."""
    machine, group = readings.machine, Ground(readings).groups[shaped.shape.group]
    out = []
    for name in shaped.shape.variables:
        if name not in machine.channel_names:
            return None
        value = readings.channel(name)[group]
        zero = readings.states[0].reference_degc if name in machine.sensor_names else 0.0
        levels = np.unique(np.round(value, 3))
        step = float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0
        out.append(Span(name, float(value.min()) - zero, float(value.max()) - zero, step, zero))
    return out if all(s.high > s.low for s in out) else None


def _in_gaps(readings: Readings, shape: Shape) -> bool:
    """Whether each step of a shape is in the middle between two places."""
    places = np.unique(np.round(readings.channel(shape.over[0])[Ground(readings).groups[shape.group]], 3))
    return all(in_gap(p, places) for p in shape.places)


def _components(readings: Readings, projected: Projected, shaped: Shaped) -> list[str]:
    """Component errors through which the shape explains most of the readings, best first."""
    ground = Ground(readings)
    free = sum(ground.columns(replace(shaped.shape, group=g)) for g in ground.groups)
    mine = {m.instrument.component for m in readings.measurements}
    scored = []
    for seen in visible(readings):
        found = weigh(projected, readings.arms(seen.name)[:, None] * np.asarray(free))
        if found is not None:
            # Of those that the readings cannot separate: first what the instrument measures, then the most direct.
            steps = STEPS.get(component_kind(seen.name, readings.machine), len(STEPS))
            scored.append((-round(found[2], 2), seen.name not in mine, not seen.moves, steps, seen.name))
    return [name for *_, name in sorted(scored)[:LEADING]]


def _best(readings: Readings, projected: Projected, form: Form, component: str) -> _Weighed | None:
    try:
        texts = [p.text(p.start) for p in form.searched]
        effect = expression_from_text(form.expression, texts, component, readings.machine)
    except ModelError:  # an axis or sensor has the name of a parameter
        return None
    grids = itertools.product(*(p.grid for p in form.searched))
    thetas = (dict(zip((p.name for p in form.searched), map(float, values), strict=True)) for values in grids)
    weighed = (_weighed(readings, projected, form, component, effect, theta) for theta in thetas)
    return max((t for t in weighed if t is not None), key=lambda t: t.evidence, default=None)


def _weighed(
    readings: Readings, projected: Projected, form: Form, component: str, effect: Effect, theta: Mapping[str, float]
) -> _Weighed | None:
    found = weigh(projected, readings.columns(effect, theta), len(theta))
    return None if found is None else _Weighed(form, component, effect, theta, found[2])


def _refined(readings: Readings, projected: Projected, best: _Weighed) -> _Weighed:
    """The parameters refined between grid points, by steps that halve."""
    for step in (0.5**k for k in range(1, HALVINGS + 1)):
        for theta in _about(best, step):
            other = _weighed(readings, projected, best.form, best.component, best.effect, theta)
            if other is not None and other.evidence > best.evidence:
                best = other
    return best


def _about(best: _Weighed, step: float) -> Iterator[dict[str, float]]:
    for p in best.form.searched:
        for way in (-1.0, 1.0):
            value = best.theta[p.name] + way * step * p.between(best.theta[p.name])
            if p.low < value < p.high:
                yield {**best.theta, p.name: value}


def _where(readings: Readings, base: Floats, whitener: Whitener, best: _Weighed, spans: Sequence[Span]) -> str:
    """Place of the proposed form, in words."""
    first, unit = spans[best.form.along], spoken(unit_of_channel(spans[best.form.along].name))
    name, theta = named(first.name), best.theta
    columns = readings.columns(best.effect, theta)
    whole = whitener(np.concatenate([base, columns], axis=1))
    values = solve(whole, whitener(readings.values))[base.shape[1] :]
    if best.form.kind == "hump":
        what = "hump" if values[0] > 0.0 else "dip"
        full_width = significant(FWHM * theta["width"], 2)
        return (
            f"a {what} at {name} ≈ {significant(theta['centre'] + first.zero)} {unit}, about {full_width} {unit} wide"
        )
    if best.form.kind == "step" and best.form.sharp:
        low, high = (significant(v + first.zero) for v in (best.form.searched[0].low, best.form.searched[0].high))
        return f"{A_STEP_BETWEEN} {name} = {low} and {high} {unit}"
    if best.form.kind == "step":
        return f"{A_STEP} {name} ≈ {significant(theta['centre'] + first.zero)} {unit}"
    if best.form.kind == "steps":
        places = [significant(theta[p.name] + first.zero) for p in best.form.searched]
        return f"steps at {name} ≈ {', '.join(places[:-1])} and {places[-1]} {unit}"
    if best.form.kind == "wave":
        grows = best.form.grows
        searched = len(best.form.searched[0].grid) > 1
        parts = [f"a wave with a period of {significant(theta['period'])} {unit}"] if searched else []
        parts += [] if grows is None else [f"its height changing with {named(spans[grows].name)}"]
        return ", ".join(parts)
    made = np.abs(columns @ values)
    at = [f"{named(s.name)} ≈ {significant(float(readings.channel(s.name)[int(np.argmax(made))]))} "
          f"{spoken(unit_of_channel(s.name))}".rstrip() for s in spans if not s.name.startswith("d_")]  # fmt: skip
    return f"largest at {', '.join(at)}" if at else ""
