"""Causes beyond [BB]'s parameters that a ball bar shows: effects of motion and of the drive, from the catalogue.

[BB] excludes the reversals and the servo loops, and names them as the likely other half of the error. Every candidate
here is an effect of `rtec effects` in the axes of the plane. Its basis functions, the machine's chain and the bar's
geometry give its columns in any test.

A curved positioning error, `k p²`, is none of motion or drive, but [BB] has no place for it.

Signs: a spike is positive where the axis lags (it sticks; the plot goes outwards). A lateral play is the position of
the slide when it moves to plus, minus that when it moves to minus. A delay is the time by which the plane's first axis
leads. A curve is positive where the axis goes too far at its plus end and not far enough at its minus end, µm/m².
"""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rtec.arrays import Floats
from rtec.effects import Effect
from rtec.effects.derived import FAR_MM
from rtec.metrology.ball_bar.causes import ALIKE_FEED, At, Cause, Shape, along, axis_of, feeds_of, shape_of, square_of
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.wording import significant

Kind = Literal["plain", "wave", "spike"]
WIDEST_DEG = 15.0
"""Largest angle from the reversal to the top of a spike: smooth causes look the same farther away."""
SHORTEST_MM = 0.02
"""Distance from the reversal to the top of the narrowest spike that is tried."""
PER_WAVE = 2.0
"""Readings that a wave needs where its axis is fastest."""
HALF_WAYS = (0.2319610, 2.6783470)
"""Arguments at which `u exp(1 - u)` is a half: there a spike has half its height."""
WIDTH = HALF_WAYS[1] - HALF_WAYS[0]
End = tuple[str, str, float]
ENDS: tuple[End, ...] = (("plus", "+", 1.0), ("minus", "-", -1.0))
"""Ends of an axis: word, mark, and the sign of the way towards it."""


@dataclass(frozen=True)
class ExtraCause:
    """A candidate beyond [BB]'s parameters; it may have several parameters.

    Attributes:
        name: short and fixed.
        title: for people.
        group: candidates of one group are shown as one cause.
        effect: name in the catalogue.
        kind: "plain": each parameter is a size; "wave": sine and cosine; "spike": heights, and the distance to its top.
        make: gives its causes; the argument is the distance to a spike's top, mm, and has no effect for other kinds.
        ways_mm: distances to the top that the search tries.
        missing: why the tests cannot show it at all, in words; else empty.
        axis: place of its axis in the plane, 0 or 1.
        feed_mm_min: feed of the tests that it is for; 0: all tests.
        wave_mm: length of its wave.
        like: parameter of [BB] that makes the same readings where the tests do not separate it.
    """

    name: str
    title: str
    group: str
    effect: str
    kind: Kind
    make: Callable[[float], tuple[Cause, ...]]
    ways_mm: tuple[float, ...] = ()
    missing: str = ""
    axis: int = 0
    feed_mm_min: float = 0.0
    wave_mm: float = 0.0
    like: str = ""


def candidates(circles: Sequence[CircleTest]) -> tuple[ExtraCause, ...]:
    """Every candidate beyond [BB]'s parameters for tests of one plane."""
    return (*_servo(circles), *_both(circles), *_change_over(circles), *_curves(circles))


def _curves(circles: Sequence[CircleTest]) -> Iterator[ExtraCause]:
    """Positioning error that is curved along its axis: with the centre it may look like a bend of the other axis."""
    for place, letter in enumerate(circles[0].setup.letters[:2]):
        other = circles[0].setup.letters[1 - place]
        component = f"E{letter}{axis_of(circles[0], place).name}"
        cause = Cause(f"curve_{letter}".lower(), f"curved positioning error of {letter}", "um_per_m2",
                      f"curved positioning {letter}", component, square_of(place, 1e-6))  # fmt: skip
        yield ExtraCause(cause.name, cause.title, cause.group, "polynomial_position", "plain", _only(cause), axis=place,
                         like=f"yaw_{other}".lower())  # fmt: skip


def _both(circles: Sequence[CircleTest]) -> Iterator[ExtraCause]:
    for place in (0, 1):
        yield from _spikes(circles, place)
        yield from _plays(circles, place)
        yield from _positions(circles, place)
        yield from _waves(circles, place)


def _servo(circles: Sequence[CircleTest]) -> Iterator[ExtraCause]:
    first, (a, b, _) = circles[0], circles[0].setup.letters
    delay = along(first, "servo_lag", 0)
    # A time τ ahead is `p(t + τ)`: its second order is ½ τ² a.
    late = along(first, "inertia", 0)
    cause = Cause("delay", f"servo delay mismatch: time by which {a} leads {b}", "ms", "servo delay", delay.component,
                  shape_of(delay), square=shape_of(late, gain=0.5))  # fmt: skip
    yield ExtraCause("delay", f"servo delay mismatch {a}-{b}", cause.group, "servo_lag", "plain", _only(cause))
    for place, letter in enumerate((a, b)):
        gain = along(first, "inertia", place)
        name = f"gain_{letter}".lower()
        size = Cause(name, f"servo gain error of {letter}: too short by, for each m/s²", "um_s2_per_m",
                     f"servo gain {letter}", gain.component, shape_of(gain))  # fmt: skip
        yield ExtraCause(name, f"servo gain error of {letter}", size.group, "inertia", "plain", _only(size), axis=place)


def _change_over(circles: Sequence[CircleTest]) -> Iterator[ExtraCause]:
    first, (a, b, _) = circles[0], circles[0].setup.letters
    one = along(first, "change_over", 0, other=axis_of(first, 1).name)
    two = along(first, "change_over", 1, other=axis_of(first, 0).name)
    cause = Cause("change_over", f"master-slave change-over {a}-{b}: the slower axis late by", "ms",
                  "master-slave change-over", one.component, shape_of(one, gain=-1.0),
                  also=((two.component, shape_of(two, gain=-1.0)),))  # fmt: skip
    coarse = max(c.step_rad for c in circles) > np.deg2rad(5.0)
    why = "readings are more than 5° apart: steps at 45° do not show" if coarse else ""
    yield ExtraCause(
        "change_over",
        f"master-slave change-over {a}-{b}",
        cause.group,
        "change_over",
        "plain",
        _only(cause),
        missing=why,
    )


def _spikes(circles: Sequence[CircleTest], place: int) -> Iterator[ExtraCause]:
    """One spike at each feed, as the way an axis sticks depends on the feed."""
    letter = circles[0].setup.letters[place]
    feeds = feeds_of(circles, ALIKE_FEED)
    effect = along(circles[0], "reversal_spike", place)
    grid = effect.nonlinear(circles[0].machine)[0].grid
    for feed in feeds:
        here = [c for c in circles if _at_feed(feeds, feed)(c)]
        most = min(c.setup.radius_mm for c in here) * (1.0 - np.cos(np.deg2rad(WIDEST_DEG)))
        least = min(c.setup.radius_mm * (1.0 - np.cos(c.step_rad)) for c in here)
        # Half a step of the catalogue's grid apart, so that a spike between two of them has a small residual.
        whole = (SHORTEST_MM, *grid)
        finer = sorted({*whole, *(float(np.sqrt(u * w)) for u, w in itertools.pairwise(whole))})
        ways = tuple(w for w in finer if least <= w <= most)
        at = f" at {feed:g} mm/min" if len(feeds) > 1 else ""
        suffix = f"_f{feed:g}" if len(feeds) > 1 else ""
        ends = tuple(end for end in ENDS if any(_turns(c, place, end[2]) for c in here))
        missing = "" if ways else "readings are too far apart for a spike"
        yield ExtraCause(
            f"spike_{letter}{suffix}".lower(), f"reversal spike (stick-slip) of {letter}{at}",
            f"reversal spike {letter}", "reversal_spike", "spike",
            _spike(effect, letter, place, suffix, at, ends, _at_feed(feeds, feed)), ways,
            missing if ends else f"{letter} does not turn round on the arc{at}", place, feed,
        )  # fmt: skip


def _at_feed(feeds: Sequence[float], feed: float) -> Callable[[CircleTest], bool]:
    """A function: whether a feed is the nearest one of a list to the feed of a test."""
    return lambda c: min(feeds, key=lambda f: abs(f - c.setup.feed_mm_min)) == feed


def _turns(circle: CircleTest, place: int, sign: float) -> bool:
    """Whether there are readings just after the axis reversed at that end."""
    near = circle.since_turn_rad(place) < np.deg2rad(WIDEST_DEG)
    seen = circle.since_reversal_mm(place) < FAR_MM
    return bool((near & seen & (circle.way(place) * sign < 0.0)).any())


def _spike(
    effect: Effect,
    letter: str,
    place: int,
    suffix: str,
    at: str,
    ends: Sequence[End],
    mine: Callable[[CircleTest], bool],
) -> Callable[[float], tuple[Cause, ...]]:
    def made(way_mm: float) -> tuple[Cause, ...]:
        def end(sign: float) -> Shape:
            of = shape_of(effect, gain=-2.0, theta={"s0": way_mm})

            def shape(where: At) -> Floats:
                if not mine(where.circle):
                    return np.zeros(len(where.circle))
                # Coming away from the + end the axis moves to minus.
                here = where.circle.way(place) * sign < 0.0
                return np.where(here, of(where), 0.0)

            return shape

        return tuple(
            Cause(f"spike_{letter}_{word}{suffix}".lower(), f"reversal spike of {letter}, {mark} end{at}", "um",
                  f"reversal spike {letter}", effect.component, end(sign))
            for word, mark, sign in ends
        )  # fmt: skip

    return made


def _plays(circles: Sequence[CircleTest], place: int) -> Iterator[ExtraCause]:
    first, letters = circles[0], circles[0].setup.letters
    own = letters[place]
    for across in (letters[1 - place], letters[2]):
        effect = along(first, "backlash", place, towards=across)
        name = f"play_{own}_{across}".lower()
        cause = Cause(name, f"lateral play of {own} along {across}", "um", f"lateral play {own}", effect.component,
                      shape_of(effect))  # fmt: skip
        yield ExtraCause(name, cause.title, cause.group, "backlash", "plain", _only(cause), axis=place)


def _positions(circles: Sequence[CircleTest], place: int) -> Iterator[ExtraCause]:
    """Clearance that changes along its axis; positions count from the first test's centre."""
    first, letter = circles[0], circles[0].setup.letters[place]
    effect = along(first, "backlash_position", place, degree=2)
    axis = axis_of(first, place)
    half_m = 0.5e-3 * (axis.travel_mm[1] - axis.travel_mm[0])
    for degree, name, unit, how in (
        (1, "slope", "um_per_m", "growing along its axis"), (2, "bow", "um_per_m2", "larger away from the middle"),
    ):  # fmt: skip
        # e = -½ δ d as for clearance itself, δ = slope · p.
        shape = shape_of(effect, degree, gain=-0.5 * half_m**degree, middle=place)
        cause = Cause(f"clearance_{name}_{letter}".lower(), f"clearance {letter} {how}", unit,
                      f"clearance {letter} by position", effect.component, shape)  # fmt: skip
        yield ExtraCause(cause.name, cause.title, cause.group, "backlash_position", "plain", _only(cause), axis=place)


def _waves(circles: Sequence[CircleTest], place: int) -> Iterator[ExtraCause]:
    first, letter = circles[0], circles[0].setup.letters[place]
    axis = axis_of(first, place)
    for name, effect_name, turns, words in (
        ("cyclic", "cyclic_screw", 1.0, "at the pitch"),
        ("indexing", "coupling_misalignment", 2.0, "(two waves a turn)"),
    ):
        title, group = f"{name} error of {letter} {words}", f"{name} error {letter}"
        named = f"{name}_{letter}".lower()
        if axis.pitch_mm is None:
            why = f"the machine file names no pitch_mm of axis {axis.name}"
            yield ExtraCause(named, title, group, effect_name, "wave", _only(), missing=why, axis=place)
            continue
        wave = axis.pitch_mm / turns
        step = min(c.setup.radius_mm * c.step_rad for c in circles)
        why = ""
        if step * PER_WAVE > wave:
            apart = f"readings are {significant(step)} mm apart where {letter} is fastest"
            why = f"{apart}; a wave of {wave:g} mm needs {significant(wave / 2)}"
        effect = along(first, effect_name, place)
        theta = {"pitch": wave} if name == "cyclic" else {"period": wave}
        of = tuple(
            Cause(
                f"{named}_{part}", f"{title}, {part}", "um", group, effect.component, shape_of(effect, i, theta=theta)
            )
            for i, part in enumerate(("sine", "cosine"))
        )
        yield ExtraCause(named, title, group, effect_name, "wave", _only(*of), missing=why, axis=place, wave_mm=wave)


def _only(*causes: Cause) -> Callable[[float], tuple[Cause, ...]]:
    return lambda _: causes
