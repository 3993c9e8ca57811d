"""Reports of `rtec hil`: accuracy compared with the all-simulated run, timing, faults, checks; and of its long run."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from rtec.arrays import Floats
from rtec.hil import Accuracy, Check, FaultFound, HilResult, SoakResult, tally
from rtec.report.figures import GREY, KINDS, MOST_DOTS, as_png, room_above, stacked
from rtec.report.page import Figure, Page, Section, Table
from rtec.result import plain
from rtec.wording import number, significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MplFigure

FAULT = "#F0E442"


@as_png
def tip_errors(
    time_s: Floats, panels: Sequence[tuple[str, Floats, Floats]], faults: Sequence[tuple[str, float, float]]
) -> "MplFigure":
    """One panel a direction, uncorrected and corrected; a band for every fault, with its name in the first panel.

    Args:
        time_s: (n,).
        panels: direction, then uncorrected and corrected error, µm, (n,); NaN where there is none.
        faults: name, begin, end, s.
    """
    figure, axes = stacked(*[4.2] * len(panels))
    thin = slice(None, None, max(1, len(time_s) // MOST_DOTS))
    for place, (ax, (direction, *both)) in enumerate(zip(axes, panels, strict=True)):
        for name, begin_s, end_s in faults:
            ax.axvspan(begin_s, end_s, color=FAULT, alpha=0.45, linewidth=0, zorder=0)
            if place == 0:
                ax.text(begin_s, 0.97, f" {name}", va="top", ha="left", color=GREY, fontsize=14,
                        transform=ax.get_xaxis_transform())  # fmt: skip
        for values, style, name in zip(both, KINDS, ("uncorrected", "corrected"), strict=True):
            ax.plot(time_s[thin], values[thin], color=style["color"], linestyle=style["linestyle"], label=name)
        ax.axhline(0.0, color="black", linewidth=1)
        ax.set_title(f"Tool-tip error in {direction}, behind real buses")
        ax.set_ylabel("tool-tip error, µm")
        ax.set_xlim(0.0, float(time_s[-1]))
        if faults and place == 0:
            room_above(ax, 0.12)
        if place == len(panels) - 1:
            ax.legend(frameon=True, facecolor="white", framealpha=0.9, fontsize=14, loc="best")
    axes[-1].set_xlabel("time since the start, s; yellow: a fault is on" if faults else "time since the start, s")
    return figure


NOT_YET = "never"
NOT_JUDGED = "not judged"


def hil_facts(found: HilResult) -> Any:
    """The result as plain data, without the errors over time, which only the figure shows."""
    facts = plain(
        {f.name: getattr(found, f.name) for f in dataclasses.fields(found) if f.name not in ("course", "log")}
    )
    factors = [c.factor if found.comparable else math.nan for c in (found.buses, found.simulated)]
    facts["buses"]["factor"], facts["simulated"]["factor"] = plain(factors)
    facts["factor_ratio"] = plain(factors[0] / factors[1])
    return facts | {"passed": found.passed, "log": str(found.log) if found.log else None}


def hil_page(found: HilResult, figures: bool = True) -> Page:
    """The report; without figures for the terminal."""
    sections = [_accuracy(found), _timing(found)]
    if found.faults:
        sections.append(_faults(found))
    sections.append(_checks(found))
    if found.warnings:
        sections.append(Section("Messages of the system", found.warnings))
    if figures:
        sections.insert(0, _accuracy_figure(found))
    off, on = (f"{a.rms_um:.1f} µm" if found.comparable else NOT_JUDGED for a in (found.buses.off, found.buses.on))
    numbers = [(off, "uncorrected, rms"), (on, "corrected, rms"), _passed(found.checks)]
    return Page("Hardware in the loop", _lead(found), numbers, sections)


def _passed(checks: Sequence[Check]) -> tuple[str, str]:
    """The card of the checks: how many passed; its name says how many were not judged."""
    passed, comma, rest = tally(checks).partition(",")
    return passed, f"checks passed{comma}{rest}"


def _lead(found: HilResult) -> str:
    stopped = f"stopped after {significant(found.on_s)} s of the corrected run; " if found.stopped else ""
    failed = [c.name for c in found.checks if not c.good]
    end = f" FAILED: {', '.join(failed)}." if failed else ""
    if not found.comparable:
        return (
            f"{found.machine}: {stopped}the improvement was not judged: only {found.compared_s:.1f} s of both runs can "
            f"be compared.{end}"
        )
    shared = "" if found.checks[-1].judged else " (reported, not judged, as this PC is shared)"
    return (
        f"{found.machine}: {stopped}{found.buses.factor:.1f} times more accurate with correction behind real buses, "
        f"{found.simulated.factor:.1f} times all simulated{shared}.{end}"
    )


def _accuracy(found: HilResult) -> Section:
    together = ", ".join(found.course.directions)
    wires = "; ".join(f"{device}: {bus}" for device, bus in found.wiring.items())
    picks: list[tuple[str, Callable[[Accuracy], float]]] = [(f"{together} together, rms", attrgetter("rms_um"))]
    picks.append((f"{together} together, largest", attrgetter("largest_um")))
    picks += [(f"{d}, rms", partial(_rms_in, d)) for d in found.course.directions]
    rows = [_row(name, _of(found, pick), factors=found.comparable) for name, pick in picks]
    head = ("tool-tip error, µm", "buses: off", "on", "factor", "simulated: off", "on", "factor")
    text = (
        f"Behind real buses ({wires}), and the same machine and programme without any bus on a virtual clock. "
        f"{found.off_s:g} s off, {found.on_s:g} s on. All are over the same {found.compared_s:.1f} s of the programme: "
        "what both runs have, without the times of settling, faults and holds.",
        "Together: length of the error vector, over these directions.",
    )
    return Section("Accuracy", text, Table(head, rows))


def _of(found: HilResult, pick: Callable[[Accuracy], float]) -> list[float]:
    return [pick(a) for c in (found.buses, found.simulated) for a in (c.off, c.on)]


def _rms_in(direction: str, accuracy: Accuracy) -> float:
    return accuracy.axis_rms_um[direction]


def _row(name: str, um: Sequence[float], *, factors: bool) -> tuple[str, ...]:
    cells = [name]
    for off, on in (um[:2], um[2:]):
        cells += [number(off), number(on), number(off / on if factors and on else math.nan, 1)]
    return tuple(cells)


def _timing(found: HilResult) -> Section:
    rows = [_timing_row("off", found.off_timing), _timing_row("on", found.on_timing)]
    head = ("", "wake-up p50, µs", "p99", "max", "cycle p50, µs", "p99", "max", "deadlines missed", "of cycles")
    text = [
        f"The loop at {found.rate_hz:g} Hz. A cycle asks the box, waits for its answer, works out the correction and "
        "commands it.",
        *_device_lines("off", found.off_timing),
        *_device_lines("on", found.on_timing),
    ]
    return Section("Timing", text, Table(head, rows))


def _timing_row(name: str, of: Mapping[str, Any]) -> tuple[str, ...]:
    times = [f"{of[key][p]:.0f}" for key in ("wake_up", "compute") for p in ("p50_us", "p99_us", "max_us")]
    return (name, *times, str(of["deadline_misses"]), str(of["cycles"]))


def _device_lines(mode: str, of: Mapping[str, Any]) -> list[str]:
    return [f"{mode}: device {name} failed in {f['times']} cycles" for name, f in of["devices"].items()]


def _faults(found: HilResult) -> Section:
    head = (
        "fault",
        "at, s",
        "for, s",
        "reported after, s",
        "held for, s",
        "follows again after, s",
        "largest error, µm",
    )
    text = [f"{f.order.name}: {f.what}. {_fault_words(f)}" for f in found.faults]
    return Section("Faults", text, Table(head, [_fault_row(f) for f in found.faults]))


def _fault_words(fault: FaultFound) -> str:
    if not fault.told:
        return "The daemon reported nothing."
    return "Reported: " + "; ".join(f"{device}: {text}" for device, text in fault.told.items()) + "."


def _fault_row(fault: FaultFound) -> tuple[str, ...]:
    return (
        fault.order.name,
        number(fault.order.at_s, 1),
        number(fault.order.length_s, 1),
        NOT_YET if math.isnan(fault.noticed_s) else number(fault.noticed_s),
        number(fault.held_s),
        NOT_YET if math.isnan(fault.recovered_s) else number(fault.recovered_s),
        number(fault.largest_um, 1),
    )


def _checks(found: HilResult | SoakResult) -> Section:
    rows = [("-" if not c.judged else "yes" if c.passed else "NO", c.name, c.words) for c in found.checks]
    return Section("Checks", (), Table(("passed", "check", "result"), rows, words=(0, 1, 2)))


def _accuracy_figure(found: HilResult) -> Section:
    course = found.course
    png = tip_errors(
        course.time_s,
        [(d, course.off_um[:, k], course.on_um[:, k]) for k, d in enumerate(course.directions)],
        [(f.order.name, f.order.at_s, f.order.end_s) for f in found.faults],
    )
    shows = "Tool-tip error over time, uncorrected and corrected, behind real buses; faults shaded."
    return Section("Tool-tip error over time", (), None, Figure("tip-error.png", png, shows))


def soak_facts(found: SoakResult) -> Any:
    """The result as plain data."""
    facts = plain({f.name: getattr(found, f.name) for f in dataclasses.fields(found) if f.name != "log"})
    return facts | {"passed": found.passed, "log": str(found.log) if found.log else None}


def soak_page(found: SoakResult) -> Page:
    """The report."""
    times = sum(f.times for f in found.faults)
    failed = [c.name for c in found.checks if not c.good]
    verdict = f"FAILED: {', '.join(failed)}" if failed else f"checks passed: {tally(found.checks)}"
    minutes = significant(found.duration_s / 60.0)
    if found.stopped:
        minutes = f"stopped after {minutes} of {significant(found.ordered_s / 60.0)}"
    lead = (
        f"{found.machine}: {minutes} minutes at {found.rate_hz:g} Hz behind real buses, "
        f"{times} faults (seed {found.seed}): {verdict}."
    )
    sections = [_resources(found), _soak_timing(found), _soak_faults(found), _checks(found)]
    if found.warnings:
        sections.append(Section("Messages of the system", found.warnings))
    numbers = [
        (str(times), "faults"),
        (f"{found.deadlines.lost} of {found.timing['cycles']}", "deadlines lost"),
        _passed(found.checks),
    ]
    return Page("Long run against simulated hardware", lead, numbers, sections)


def _resources(found: SoakResult) -> Section:
    rows = [
        (
            r.process,
            f"{r.what}, {r.unit}" if r.unit else r.what,
            *(significant(v, 4) for v in (r.first, r.middle, r.last)),
        )
        for r in found.resources
    ]
    head = ("process", "what", "first third", "second", "last")
    text = ("The largest in each third of the run. Memory is what belongs to the process alone.",)
    return Section("Memory, files, threads", text, Table(head, rows, words=(0, 1)))


def _soak_timing(found: SoakResult) -> Section:
    timing, lost = found.timing, found.deadlines
    rows = [
        (name, *(f"{timing[key][p]:.0f}" for p in ("p50_us", "p99_us", "p99_9_us", "max_us")))
        for key, name in (("wake_up", "wake-up, µs"), ("compute", "cycle, µs"))
    ]
    text = (
        f"Deadlines lost: {lost.lost} of {timing['cycles']}. {lost.own} of them while the loop itself used more "
        f"processor time than usual ({lost.usual_cpu_us:.0f} µs a cycle), {lost.taken_away} while another process or "
        f"the host had its processor, {lost.behind_worker} while a thread of its process had none and may have held "
        "the interpreter; at the others it waited for the host or for the box.",
    )
    return Section("Timing", text, Table(("", "p50", "p99", "p99.9", "max"), rows))


def _soak_faults(found: SoakResult) -> Section:
    rows = [(f.name, str(f.times), str(f.told), number(f.latest_s)) for f in found.faults]
    return Section("Faults", (), Table(("fault", "times", "reported", "at the latest after, s"), rows))
