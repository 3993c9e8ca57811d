"""Which further ball-bar test would separate what the given ones do not."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rtec.metrology.procedures.ball_bar_circle import Circle
from rtec.metrology.procedures.ball_bar_columns import NotLookedFor, table_of, with_setup
from rtec.metrology.procedures.ball_bar_design import Centre

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


def wanted(circles: Sequence[Circle], left_out: Sequence[NotLookedFor], centre: Centre) -> tuple[Wanted, ...]:
    """Tests, one at a time added to the given ones, that show causes which these do not; each cause once.

    Args:
        circles: the given tests.
        left_out: causes that they do not show.
        centre: see `design_of`.
    """
    open_ = [x.candidate.name for x in left_out if not x.candidate.missing]
    out = []
    for words, circle in _ideas(circles) if open_ else ():
        # A spike has its own name at each feed; those are not what a new test is for.
        shown = {c.name for c in table_of([*circles, circle], centre).tried}
        names = tuple(n for n in open_ if n in shown)
        if names:
            out.append(Wanted(words, circle.setup.feed_mm_min, names))
            open_ = [n for n in open_ if n not in names]
    return tuple(out)


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
        leaning = with_setup(flat, height_mm=round(0.6 * length, 1), radius_mm=round(0.8 * length, 1))
        words = f"{flat.name} again with height {0.6 * length:.0f} mm and radius {0.8 * length:.0f} mm"
        yield words, leaning
