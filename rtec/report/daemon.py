"""Report of a running daemon: what is corrected and what is not, its inputs and events, and the last hours."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtec.control.facts import AXIS_COLUMNS, axis_rows, footer, input_rows, state_word, troubles
from rtec.report.figures import Zoom, zoom_words
from rtec.report.page import Figure, Section, Table

MINUTE_S, HOUR_S = 60.0, 3600.0


@dataclass(frozen=True)
class Moment:
    """One point of a daemon's past.

    Attributes:
        time_s: time since the first row of the daemon, or of the first of its runs.
        applied_um: applied correction by axis; None where it is not known.
        degc: temperatures, °C, by sensor; None where it is not read.
    """

    time_s: float
    applied_um: Mapping[str, float | None]
    degc: Mapping[str, float | None]

    @property
    def is_gap(self) -> bool:
        """Whether it has no values: it separates two runs."""
        return not self.applied_um


def since(runs: int) -> str:
    """The beginning of the time, for the title of an axis; `runs`: how many runs of the daemon were seen."""
    return "since the daemon began" if runs < 2 else f"since the first of {runs} runs began"


def named(kept: Sequence[Moment], *, temperatures: bool) -> list[str]:
    """Names of all axes, or of all temperatures, in order: another run may have others."""
    return list(dict.fromkeys(n for m in kept for n in (m.degc if temperatures else m.applied_um)))


@dataclass(frozen=True)
class DaemonMoment:
    """A daemon's status, and its past.

    Attributes:
        utc: date and time of the status.
        status: the answer of the daemon (`docs/control.md`).
        limits_um: by axis: correction above which it is flagged, and above which it is not followed.
        minutes, hours: the last ten minutes and the last day.
        runs: how many runs of the daemon were seen.
    """

    utc: str
    status: Mapping[str, Any]
    limits_um: Mapping[str, tuple[float, float]]
    minutes: Sequence[Moment]
    hours: Sequence[Moment]
    runs: int = 1


def daemon_lead(m: DaemonMoment) -> str:
    """The state of the correction, the machine, the model and the time, in words."""
    word, why = state_word(m.status["status"])
    reason = f": {why}" if why else ""
    at = m.utc.replace("T", " ").removesuffix("Z")
    return f"Correction: {word}{reason}. {m.status['machine']}, model {m.status['model']}, {at} UTC."


def daemon_sections(m: DaemonMoment, figures: bool = True, zooms: Mapping[str, Zoom] | None = None) -> list[Section]:
    """Sections on a daemon: what is wrong, its axes, inputs and events, and its past.

    Args:
        m: the daemon.
        figures: whether to draw.
        zooms: visible part of each plot of the past, by "live minutes applied", "live minutes degc", "live hours …".
    """
    found, out = m.status, []
    wrong = troubles(found) + [f"why: {r}" for r in found["status"]["reasons"]]
    if wrong:
        out.append(Section("What is wrong", wrong))
    out.append(Section("Correction of each axis", footer(found), Table(AXIS_COLUMNS, axis_rows(found)),
                       _bars(m) if figures else None))  # fmt: skip
    if figures:
        out += [*_past("last 10 minutes", m.minutes, MINUTE_S, f"minutes {since(m.runs)}", zooms or {}),
                *_past("last 24 hours", m.hours, HOUR_S, f"hours {since(m.runs)}", zooms or {})]  # fmt: skip
    rows = input_rows(found) if found["status"]["cycles"] else []
    out.append(Section("Inputs and their ages", [], Table(("input", "value", "age"), rows)))
    events = [[e["utc"][:19].replace("T", " "), e["what"], e["text"], e["who"]] for e in reversed(found["events"])]
    table = Table(("UTC", "what", "text", "by"), events, words=(0, 1, 2, 3)) if events else None
    return [*out, Section("Events, newest first", [] if events else ["None yet."], table)]


def _bars(m: DaemonMoment) -> Figure:
    from rtec.report.daemon_figures import AxisBars, axis_bars

    status, residual = m.status["status"], m.status["left"]["axes"]
    rows = [
        AxisBars(
            axis,
            status["requested_um"][axis],
            status["applied_um"][axis],
            residual.get(axis, {}).get("rms_um"),
            *m.limits_um.get(axis, (0.0, 0.0)),
        )
        for axis in status["applied_um"]
    ]
    return Figure("axes.png", axis_bars(rows), "requested, applied and residual correction of each axis in its limits")


def _past(what: str, kept: Sequence[Moment], unit_s: float, below: str, zooms: Mapping[str, Zoom]) -> list[Section]:
    from rtec.report.daemon_figures import past

    if len(kept) < 2:
        return []
    corrections = {n: [m.applied_um.get(n) for m in kept] for n in named(kept, temperatures=False)}
    degc = {n: [m.degc.get(n) for m in kept] for n in named(kept, temperatures=True)}
    unit = below.partition(" ")[0]
    both = [zooms.get(f"live {unit} {of}", {}) for of in ("applied", "degc")]
    png = past([m.time_s / unit_s for m in kept], below, corrections, degc, both)
    names = ("Applied correction", "Temperatures")
    words = [f"{name}: {zoom_words(zoom)}" for name, zoom in zip(names, both, strict=True) if zoom]
    return [Section(f"Applied correction and temperatures, {what}", words, None,
                    Figure(f"{unit}.png", png, f"applied correction and temperatures over the {what}"))]  # fmt: skip
