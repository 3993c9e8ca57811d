"""What a ball-bar report says of the servo phase: one angle in all tests or one time, and what hangs on it."""

from rtec.metrology.ball_bar.diagnosis import Diagnosis
from rtec.report.ball_bar_beyond import UNITS
from rtec.report.procedures import number


def phase_lines(d: Diagnosis) -> list[str]:
    """Lines over the table of parameters; none where the question does not arise or nothing hangs on it."""
    a, b, _ = d.circles[0].setup.letters
    if d.phase.decided and d.phase.reason:
        return [f"Servo phase {a}-{b}: taken as one {d.phase.taken} in all tests, because: {d.phase.reason}."]
    if not d.if_time:
        return []
    then = "; ".join(f"{s.taken.title} {number(s.if_time)} {UNITS[s.taken.unit]}" for s in d.if_time)
    return [
        f"Servo phase {a}-{b}: taken as one angle in all tests [BB]. Feed over radius differs between them, and they "
        f"do not tell whether it is one time, as a lag of an axis is. If it is (--phase time), then: {then}. Tests "
        f"with feeds in proportion to their radii ({_feeds(d)}) leave nothing open."
    ]


def phase_facts(d: Diagnosis) -> dict[str, object]:
    """The same as plain data, for JSON."""
    return {
        "taken_as": d.phase.taken,
        "decided": d.phase.decided,
        "reason": d.phase.reason,
        "if_one_time": {s.taken.name: s.if_time for s in d.if_time},
    }


def _feeds(d: Diagnosis) -> str:
    """The first test's feed, for every radius in proportion."""
    first = d.circles[0].setup
    radii = dict.fromkeys(c.setup.radius_mm for c in d.circles)
    return ", ".join(f"radius {r:g} mm at {first.feed_mm_min * r / first.radius_mm:.4g} mm/min" for r in radii)
