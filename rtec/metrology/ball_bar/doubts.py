"""Doubts about ball-bar readings themselves.

A ball that was set again between tests, a cause that changes from run to run, and wrong readings.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.arrays import Floats, robust_sigma
from rtec.metrology.ball_bar.causes import UNITS, Cause, causes, tip_um
from rtec.metrology.ball_bar.circle import CircleTest
from rtec.metrology.ball_bar.design import SETTING_UP, Centre
from rtec.metrology.ball_bar.fit import Fitted, chance_of, fit
from rtec.metrology.ball_bar.noise import NOISE_UM
from rtec.metrology.procedures.fitting import correlation_time
from rtec.wording import counted, number, significant, two_numbers

SURE = 1e-3
"""Accepted false-positive rate of a ball that was set again, and of a cause that changes from run to run (F test)."""
LESS = 0.9
"""The residual must fall below this share."""
NUISANCES = 4
"""Numbers that each run has of its own: radius, drift along the circle, and centre."""
FLAT = 1e-6
"""A cause whose column is smaller than this share (in squares) of the largest is not shown by a run."""
ALIKE = 0.95
"""A cause that explains more than this share of what the best one explains may be the one that changes."""
BESIDE = 3
"""Readings to each side with which a reading is compared."""
WRONG = 10.0
"""Deviation from this median, in multiples of its robust standard deviation, from which a reading is wrong."""


def doubts_of(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float, centre: Centre) -> tuple[str, ...]:
    """All doubts, in words.

    Args:
        circles: the tests.
        fitted: their fit.
        window_deg, centre: see `fit`.
    """
    moved = _ball_moved(circles, fitted, window_deg) if centre == "shared" and len(circles) > 1 else ()
    changing = _runs_differ(circles, fitted, window_deg)
    return (
        *moved,
        *changing,
        *(w for c, left in zip(circles, fitted.left_um, strict=True) for w in _wrong(c, left, window_deg)),
    )


def _ball_moved(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> tuple[str, ...]:
    """Doubt where a centre for each test leaves much less."""
    bent = fitted.model == "non-linear"
    each = fit(circles, bent=bent, window_deg=window_deg, centre="each", beyond=fitted.beyond)
    before, after = (_residual(circles, f, window_deg) for f in (fitted, each))
    if after > LESS * before or chance_of(fitted, each) >= SURE:
        return ()
    one, two = two_numbers(before, after)
    return (
        f"The tests do not have one centre: with a centre for each the residual falls from {one} to {two} µm. If the "
        "ball on the table was set again between them, give --centre each. If it was not, it moved: measure again.",
    )


@dataclass(frozen=True)
class _Run:
    """One run beyond the fit of all runs, without its own radius, drift and centre: only the shape of a cause tells.

    Attributes:
        name: of the run and its test.
        shapes: of the causes, (n, causes), µm per unit.
        left: residual, (n,), µm.
    """

    name: str
    shapes: Floats
    left: Floats


def _change(runs: Sequence[_Run]) -> tuple[Floats, Floats]:
    """Change of each cause alone in some runs together, and the sum of squares that it takes away, (causes,) each."""
    power = np.sum([(r.shapes**2).sum(axis=0) for r in runs], axis=0)
    along = np.sum([r.shapes.T @ r.left for r in runs], axis=0)
    seen = power > FLAT * power.max(initial=0.0)
    change = np.where(seen, along / np.where(seen, power, 1.0), 0.0)
    return change, change * along


def _runs_differ(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> tuple[str, ...]:
    """Doubt where a cause is not the same in all runs of a test: the cause that explains most of what differs.

    Each test may have a value of its own, by its feed and place; only its runs among themselves must agree.
    """
    from scipy.special import fdtrc

    values = {v.name: v.value for v in fitted.values if np.isfinite(v.value) and v.group != SETTING_UP}
    of = [c for c in causes(circles[0], bent=fitted.model == "non-linear") if c.name in values and c.centre is None]
    tests = [list(_runs(circles, i, fitted, of, window_deg)) for i in range(len(circles))]
    tests = [runs for runs in tests if len(runs) > 1]
    if not of or not tests:
        return ()
    runs = [run for test in tests for run in test]
    together, alone = [_change(test)[1] for test in tests], [_change([run]) for run in runs]
    gained = np.sum([g for _, g in alone], axis=0) - np.sum(together, axis=0)
    best = int(np.argmax(gained))
    after = [r.left - r.shapes[:, best] * change[best] for r, (change, _) in zip(runs, alone, strict=True)]
    left, readings = sum(float(a @ a) for a in after), sum(len(a) for a in after)
    rows, numbers = max(correlation_time(a) for a in after), (NUISANCES + 1) * len(runs)
    free, count = readings / rows - numbers, len(runs) - len(tests)
    if free <= 1.0 or left > LESS**2 * (left + float(gained[best])):
        return ()
    noise = max(left / (readings - numbers), NOISE_UM**2) * rows
    if len(of) * float(fdtrc(count, free, gained[best] / count / noise)) >= SURE:
        return ()
    what = _changes(of, gained, values, runs, [change for change, _ in alone])
    return (
        f"{what} The table has one value for all runs, and its interval does not contain this change. `rtec diagnose` "
        "tells what it follows, such as a temperature.",
    )


def _changes(
    of: Sequence[Cause], gained: Floats, values: Mapping[str, float], runs: Sequence[_Run], change: Sequence[Floats]
) -> str:
    """What changes, and from where to where; causes that one run does not separate are named together."""
    best = int(np.argmax(gained))
    sizes = [float(c[best]) for c in change]
    first, last = sorted((sizes.index(min(sizes)), sizes.index(max(sizes))))
    alike = [c for c, g in zip(of, gained, strict=True) if g > ALIKE * gained[best]]
    titles, unit = " or ".join(c.title for c in alike), UNITS[of[best].unit]
    title = titles[0].upper() + titles[1:]
    if len(alike) > 1:
        by = f"{number(abs(sizes[last] - sizes[first]), 1)} {unit}"
        return f"{title} changes from run to run, by {by} between {runs[first].name} and {runs[last].name}."
    ends = (f"{number(values[of[best].name] + sizes[i], 1)} {unit} in {runs[i].name}" for i in (first, last))
    return f"{title} changes from run to run: {' and '.join(ends)}."


def _runs(
    circles: Sequence[CircleTest], test: int, fitted: Fitted, of: Sequence[Cause], window_deg: float
) -> Iterator[_Run]:
    circle = circles[test]
    looked = ~circle.near_quadrant(window_deg)
    for run in np.unique(circle.run):
        mine = looked & (circle.run == run)
        part = circle.rows(mine)
        if len(part) < 2 * (NUISANCES + 1):
            continue
        angle = part.angle_rad
        own = np.stack([np.ones(len(part)), part.travel_deg / 360.0, np.cos(angle), np.sin(angle)], axis=1)
        shapes = [np.einsum("nd,nd->n", tip_um(c, part, circles[0]), part.along) for c in of]
        both = np.column_stack([*shapes, fitted.left_um[test][mine]])
        basis = np.linalg.qr(own)[0]
        both -= basis @ (basis.T @ both)
        yield _Run(f"run {run} of {circle.name}", both[:, :-1], both[:, -1])


def _residual(circles: Sequence[CircleTest], fitted: Fitted, window_deg: float) -> float:
    """Root mean square of a fit's residual away from the quadrants, µm."""
    left = [v[~c.near_quadrant(window_deg)] for c, v in zip(circles, fitted.left_um, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(left) ** 2)))


def _wrong(circle: CircleTest, left: Floats, window_deg: float) -> tuple[str, ...]:
    """Doubt where single readings deviate far from those before and after them.

    Args:
        circle: the test.
        left: residual of its fit, (n,) µm.
        window_deg: readings nearer than this to a quadrant are not looked at: reversals have peaks there.
    """
    from scipy.ndimage import median_filter

    off = np.zeros(len(left))
    for run in np.unique(circle.run):
        mine = circle.run == run
        off[mine] = left[mine] - median_filter(left[mine], 2 * BESIDE + 1)
    looked = ~circle.near_quadrant(window_deg)
    steps = np.diff(np.unique(circle.reading_um))
    least = max(NOISE_UM, 0.5 * float(np.median(steps)) if len(steps) else 0.0)
    noise = max(robust_sigma(off[looked]), least)
    wrong = np.flatnonzero(looked & (np.abs(off) > WRONG * noise))
    if not len(wrong):
        return ()
    worst = wrong[np.argmax(np.abs(off[wrong]))]
    return (
        f"{circle.name} has {counted(len(wrong), 'reading')} far from the neighbouring ones, the farthest by "
        f"{significant(abs(off[worst]), 2)} µm at {np.degrees(circle.angle_rad[worst]) % 360.0:.0f}°. G and the fit "
        "include such readings: remove these rows, or measure again.",
    )
