"""Which further ball-bar test would separate what the given ones do not."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from rtec.metrology.ball_bar.causes import same_feed
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.design import Centre, NotLookedFor, table_of, with_setup
from rtec.metrology.ball_bar.phase import by_time

SAME_MM = 1.0
FASTER = 3.0
FAST_MM_MIN = 6000.0
"""From here on the other feed is the slower one."""


@dataclass(frozen=True)
class Wanted:
    """One more test.

    Attributes:
        test: in words.
        feed_mm_min: of it.
        names: causes that it separates.
    """

    test: str
    feed_mm_min: float
    names: tuple[str, ...]


def wanted(
    circles: Sequence[Circle], left_out: Sequence[NotLookedFor], centre: Centre, *, in_time: bool = False
) -> tuple[Wanted, ...]:
    """Tests, one at a time added to the given ones, that show causes which these do not; each cause once.

    Args:
        circles: the given tests.
        left_out: causes that they do not show.
        centre: see `design_of`.
        in_time: the servo phase is taken as one time in all tests.
    """
    open_ = [x.candidate.name for x in left_out if not x.candidate.missing]
    out = []
    for words, circle in _ideas(circles) if open_ else ():
        if any(_same_test(circle, c) for c in circles):
            continue
        # A spike has its own name at each feed; those are not what a new test is for.
        shown = _shown((*circles, circle), centre, in_time=in_time)
        names = tuple(n for n in open_ if n in shown)
        if names:
            out.append(Wanted(words, circle.setup.feed_mm_min, names))
            open_ = [n for n in open_ if n not in names]
    return tuple(out)


def _shown(circles: Sequence[Circle], centre: Centre, *, in_time: bool) -> set[str]:
    """Names of the causes that some tests show."""
    if not in_time:
        return {c.name for c in table_of(circles, centre).tried}
    # A delay is told from one angle, not from one time, which is the same thing.
    one_angle = _shown([replace(c, phase_rate=1.0) for c in circles], centre, in_time=False)
    return {c.name for c in table_of(by_time(circles), centre).tried} | (one_angle & {"delay"})


def _same_test(one: Circle, other: Circle) -> bool:
    a, b = one.setup, other.setup
    return (
        a.direction == b.direction
        and same_feed(a.feed_mm_min, b.feed_mm_min)
        and abs(a.radius_mm - b.radius_mm) < SAME_MM
        and abs(a.height_mm - b.height_mm) < SAME_MM
    )


def _ideas(circles: Sequence[Circle]) -> Iterator[tuple[str, Circle]]:
    first = circles[0]
    setup = first.setup
    feed = setup.feed_mm_min * (FASTER if setup.feed_mm_min * FASTER <= FAST_MM_MIN else 1.0 / FASTER)
    yield f"{first.name} again at {feed:g} mm/min", with_setup(first, feed_mm_min=float(f"{feed:.3g}"))
    other = "cw" if setup.sense > 0 else "ccw"
    yield f"{first.name} again {other}", with_setup(first, direction=other)
    flat = next((c for c in circles if abs(c.setup.height_mm) < 1e-9), None)
    if flat is not None:
        length = flat.setup.length_mm
        # At the same angular speed a lag of an axis is the same angle.
        feed = float(f"{0.8 * flat.setup.feed_mm_min:.3g}")
        leaning = with_setup(flat, height_mm=round(0.6 * length, 1), radius_mm=round(0.8 * length, 1), feed_mm_min=feed)
        where = f"height {0.6 * length:.0f} mm, radius {0.8 * length:.0f} mm, {feed:g} mm/min"
        words = f"{flat.name} again with {where}"
        yield words, leaning
