"""What a ball-bar report says of causes beyond [BB]'s: found or not, not to be seen, and which test would show them."""

from rtec.metrology.ball_bar.causes import feeds_of
from rtec.metrology.ball_bar.design import NotLookedFor
from rtec.metrology.ball_bar.diagnosis import Diagnosis
from rtec.report.page import Section, Table

UNITS = {
    "um": "µm",
    "um_per_m": "µm/m",
    "urad": "µrad",
    "per_km": "1/km",
    "urad_per_m": "µrad/m",
    "ms": "ms",
    "um_s2_per_m": "µm per m/s²",
    "um_per_m2": "µm/m²",
    "deg": "°",
    "mm": "mm",
}
RAREST = 1e-6
SERVO = ("delay", "gain_")


def beyond_section(d: Diagnosis) -> Section:
    """The section of the page."""
    return Section("Dynamic effects and the drive", [*_servo(d), *_left_out(d), *_wanted(d)], _table(d))


def beyond_facts(d: Diagnosis) -> dict[str, object]:
    """The same as plain data, for JSON."""
    return {
        "found": [
            {
                "name": p.candidate.name, "title": p.candidate.title, "group": p.candidate.group,
                "effect": p.candidate.effect, "chance": p.chance,
            }
            for p in d.found.beyond.picks
        ],
        "not_found": [
            {"name": n.candidate.name, "title": n.candidate.title, "effect": n.candidate.effect,
             "would_be_found_from": n.limit, "unit": n.unit}
            for n in d.found.not_found
        ],
        "not_looked_for": [
            {"name": n.candidate.name, "title": n.candidate.title, "why": n.why, "not_separated_from": list(n.twins)}
            for n in d.found.left_out
        ],
        "tests_to_add": [
            {"test": w.test, "feed_mm_min": w.feed_mm_min, "separates": list(w.names)} for w in d.wanted
        ],
    }  # fmt: skip


def _servo(d: Diagnosis) -> list[str]:
    """That one feed does not tell a servo's part from scale and squareness, in words."""
    open_ = [n for n in d.found.left_out if n.candidate.name.startswith(SERVO) and n.twins]
    feeds = feeds_of(d.circles)
    one = f"All tests were run at one feed, {feeds[0]:g} mm/min, which"
    why = "These tests" if len(feeds) > 1 else one
    told = "; ".join(f"{n.candidate.title} from {_titles(d, n)}" for n in open_)
    return [f"{why} cannot tell {told}. What they do together stands above."] if open_ else []


def _left_out(d: Diagnosis) -> list[str]:
    """What these tests cannot show, other than the servo's."""
    out: dict[str, list[str]] = {}
    for n in d.found.left_out:
        if not (n.candidate.name.startswith(SERVO) and n.twins):
            why = f"not separated from {_titles(d, n)}" if n.twins else n.why
            out.setdefault(why, []).append(n.candidate.title)
    return [f"Not looked for: {', '.join(titles)}: {why}." for why, titles in out.items()]


def _titles(d: Diagnosis, left: NotLookedFor) -> str:
    known = {v.name: v.title for v in d.fitted.values}
    return " and ".join(known.get(t, t) for t in left.twins)


def _wanted(d: Diagnosis) -> list[str]:
    title = {n.candidate.name: n.candidate.title for n in d.found.left_out}
    return [f"To tell them apart: {w.test}; it shows {', '.join(title[n] for n in w.names)}." for w in d.wanted]


def _table(d: Diagnosis) -> Table | None:
    """What was looked for."""
    rows = [[p.candidate.title, "yes", _chance(p.chance), "–", ""] for p in d.found.beyond.picks]
    rows += [[n.candidate.title, "no", "–", f"{n.limit:.3g}", UNITS[n.unit]] for n in d.found.not_found]
    head = ["looked for", "found", "as much by chance", "would be found from", "unit"]
    return Table(head, rows, words=(0, 1, 4)) if rows else None


def _chance(share: float) -> str:
    return f"< {RAREST:.0e}" if share < RAREST else f"{share:.1g}"
