"""Fitted parameters of a ball-bar diagnosis as they are told: value, error, interval, and what it comes to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rtec.metrology.ball_bar.beyond import HALF_WAYS, WIDTH, Candidate
from rtec.metrology.ball_bar.causes import ALIKE_FEED, Cause, same_feed
from rtec.metrology.ball_bar.circle import Circle
from rtec.metrology.ball_bar.rank import Rank

Number = tuple[float, float]
"""A value and its standard error."""
UNKNOWN: Number = (float("nan"), float("nan"))


@dataclass(frozen=True)
class Value:
    """A fitted parameter.

    Attributes:
        name, title, unit, group: as `Cause`.
        value: NaN where it cannot be found.
        se: standard error.
        low, high: 95 % confidence interval.
        with_: parameters that it cannot be separated from; the value is then what they do together.
        note: what it comes to, in words.
    """

    name: str
    title: str
    unit: str
    group: str
    value: float
    se: float
    low: float
    high: float
    with_: tuple[str, ...] = ()
    note: str = ""


def of_cause(cause: Cause, number: Number | None, wide: float, rank: Rank, note: str = "") -> Value:
    """A parameter that is one cause's size.

    Args:
        cause: which.
        number: value and standard error; None where it was not fitted.
        wide: standard errors in half of a 95 % interval.
        rank: tells what it is not separated from.
        note: in words.
    """
    together = tuple(n for group in rank.confounded if cause.name in group for n in group if n != cause.name)
    return _value((cause.name, cause.title, cause.unit, cause.group), number or UNKNOWN, wide, together, note)


def of_wave(candidate: Candidate, sine: Number, cosine: Number, wide: float) -> tuple[Value, Value]:
    """Amplitude and phase of a wave."""
    (s, es), (c, ec) = sine, cosine
    size = float(np.hypot(s, c))
    se = float(np.hypot(s * es, c * ec) / size) if size > 0 else float(np.hypot(es, ec))
    turn_se = float(np.rad2deg(np.hypot(c * es, s * ec)) / size**2) if size > 0 else float("nan")
    phase = float(np.rad2deg(np.arctan2(c, s)))
    note = f"one wave every {candidate.wave_mm:g} mm"
    if candidate.effect == "coupling_misalignment":
        # [BB 22]: amplitude p γ² / 8π.
        gamma = np.rad2deg(np.sqrt(8.0 * np.pi * size * 1e-3 / (2.0 * candidate.wave_mm)))
        note += f"; as of shafts {gamma:.1f}° out of line [BB 22]"
    name, title, group = candidate.name, candidate.title, candidate.group
    return (
        _value((f"{name}_amplitude", f"{title}, amplitude", "um", group), (size, se), wide, (), note),
        _value((f"{name}_phase", f"{title}, phase at position 0", "deg", group), (phase, turn_se), wide, (), ""),
    )


def of_width(candidate: Candidate, way_mm: float, way_se: float, circles: Sequence[Circle], wide: float) -> Value:
    """Width of a spike at half its height, on the axis' way; the note has it as an angle and as a time."""
    words = {}
    for c in circles:
        if candidate.feed_mm_min and not same_feed(c.setup.feed_mm_min, candidate.feed_mm_min, ALIKE_FEED):
            continue
        ends = [np.arccos(max(1.0 - u * way_mm / c.setup.radius_mm, -1.0)) for u in HALF_WAYS]
        angle = float(ends[1] - ends[0])
        words[c.name] = f"{np.rad2deg(angle):.1f}°, {1e3 * angle / c.omega_rad_s:.0f} ms"
    called = (f"{candidate.name}_width", f"{candidate.title}, width at half height", "mm", candidate.group)
    return _value(called, (WIDTH * way_mm, WIDTH * way_se), wide, (), _by_test(words))


def note_of(cause: Cause, numbers: Mapping[str, Number], circles: Sequence[Circle]) -> str:
    """What a servo's parameter comes to at the feeds of the tests; which way a squareness leans."""
    value = numbers.get(cause.name, UNKNOWN)[0]
    if not np.isfinite(value) or value == 0.0:
        return ""
    if cause.name == "squareness" or cause.name.startswith("perpendicularity"):
        return _leans(cause, value, circles[0])
    if cause.name == "phase":
        words = {c.name: f"{1e-3 * value * c.phase_rate / c.omega_rad_s:.3g} ms" for c in circles}
    elif cause.name == "delay":
        words = {c.name: f"{1e3 * value * c.omega_rad_s:.3g} µrad" for c in circles}
    elif cause.name.startswith("gain_"):
        radius = {c.name: -value * c.omega_rad_s**2 * c.setup.radius_mm * 1e-3 for c in circles}
        words = {name: f"radius {um:+.2g} µm" for name, um in radius.items()}
    else:
        return ""
    loop = ""
    if cause.name.startswith("gain_") and value > 0.0:
        # A loop of first order without feed-forward is ½ τ² a short, K_v = 1/τ.
        loop = f"; as of a position loop of K_v = {1e3 / np.sqrt(2.0 * value):.0f} 1/s without feed-forward"
    return _by_test(words) + loop


def _leans(cause: Cause, value: float, circle: Circle) -> str:
    """Which way an axis leans that is turned so: `ε × d`; the sign of a turn alone says it to nobody."""
    a, b, n = circle.setup.letters
    unit = dict(zip("XYZ", np.eye(3), strict=True))
    turn = value * unit["XYZ"["ABC".index(cause.component[1])]]
    if cause.name == "squareness":
        less = float(np.cross(turn, unit[a]) @ unit[b]) > 0.0
        return f"the angle between +{a} and +{b} is {'less' if less else 'more'} than 90°"
    own = cause.name[-1].upper()
    return f"towards +{own} the line {'climbs' if float(np.cross(turn, unit[own]) @ unit[n]) > 0.0 else 'falls'} in {n}"


def _by_test(words: Mapping[str, str]) -> str:
    """What was said of each test, the same words once."""
    names: dict[str, list[str]] = {}
    for name, said in words.items():
        names.setdefault(said, []).append(name)
    return "; ".join(f"{said} in {', '.join(of)}" for said, of in names.items())


def quantile(free: float) -> float:
    """Standard errors in half of a 95 % interval."""
    from scipy.special import stdtrit

    return float(stdtrit(free, 0.975))


def _value(
    called: tuple[str, str, str, str], number: Number, wide: float, together: tuple[str, ...], note: str
) -> Value:
    value, se = (float(v) for v in number)
    return Value(*called, value, se, value - wide * se, value + wide * se, together, note)
