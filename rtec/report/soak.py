"""What a long run against simulated hardware tells."""

import dataclasses
from typing import Any

from rtec.hil import SoakResult
from rtec.report.page import Page, Section, Table
from rtec.report.procedures import number, plain


def soak_facts(found: SoakResult) -> Any:
    """The result as JSON holds it."""
    facts = plain({f.name: getattr(found, f.name) for f in dataclasses.fields(found) if f.name != "log"})
    return facts | {"passed": found.passed, "log": str(found.log) if found.log else None}


def soak_page(found: SoakResult) -> Page:
    """The report."""
    times = sum(f.times for f in found.faults)
    failed = [c.name for c in found.checks if not c.passed]
    verdict = f"NOT SO: {', '.join(failed)}" if failed else "all that must be so is so"
    lead = (
        f"{found.machine}: {found.duration_s / 60.0:.3g} minutes at {found.rate_hz:g} Hz behind real buses, "
        f"{times} faults (seed {found.seed}): {verdict}."
    )
    sections = [_resources(found), _timing(found), _faults(found), _checks(found)]
    if found.warnings:
        sections.append(Section("Said by the system", found.warnings))
    numbers = [
        ("faults", str(times)),
        ("deadlines lost", f"{found.deadlines.lost} of {found.timing['cycles']}"),
        ("checks passed", f"{sum(c.passed for c in found.checks)} of {len(found.checks)}"),
    ]
    return Page("Long run against simulated hardware", lead, numbers, sections)


def _resources(found: SoakResult) -> Section:
    rows = [
        (r.process, f"{r.what}, {r.unit}" if r.unit else r.what, *(f"{v:.4g}" for v in (r.first, r.middle, r.last)))
        for r in found.resources
    ]
    head = ("process", "what", "first third", "second", "last")
    text = ("The largest in each third of the run. Memory is what belongs to the process alone.",)
    return Section("Memory, files, threads", text, Table(head, rows, words=(0, 1)))


def _timing(found: SoakResult) -> Section:
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


def _faults(found: SoakResult) -> Section:
    rows = [(f.name, str(f.times), str(f.told), number(f.latest_s)) for f in found.faults]
    return Section("Faults", (), Table(("fault", "times", "told", "at the latest after, s"), rows))


def _checks(found: SoakResult) -> Section:
    rows = [("yes" if c.passed else "NO", c.name, c.found) for c in found.checks]
    return Section("What must be so", (), Table(("is so", "what", "found"), rows, words=(0, 1, 2)))
