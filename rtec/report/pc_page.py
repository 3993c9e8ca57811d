"""What people are told about this computer, and how it becomes fit for real time."""

from rtec.doctor.found import Finding, PcFound
from rtec.report.page import Page, Section, Table

STATES = {"good": "good", "better": "could be better", "wrong": "wrong", "unknown": "not known"}


def pc_page(found: PcFound) -> Page:
    """What was found in one table; then what to write where."""
    wrong = [f for f in found.findings if f.state == "wrong"]
    better = [f for f in found.findings if f.state == "better"]
    lead = "This computer: " + _verdict(wrong, better)
    rows = [(f.topic, STATES[f.state], f.found) for f in found.findings]
    sections = [Section("This computer", (), Table(("what", "", "found"), rows, words=(0, 1, 2)))]
    why = [f"{f.topic}: {f.why}" for f in found.findings if f.why]
    if why:
        sections.append(Section("What that does", why))
    how = _how(found)
    if how:
        sections.append(Section("How to get what it lacks, the most needed first", how))
    return Page("This computer", lead, (), sections)


def _verdict(wrong: list[Finding], better: list[Finding]) -> str:
    if wrong:
        return f"not fit for real time yet: {', '.join(f.topic for f in wrong)}."
    return (
        f"fit for real time; could be better: {', '.join(f.topic for f in better)}." if better else "fit for real time."
    )


def _how(found: PcFound) -> list[str]:
    out = []
    limits, unit, kernel = found.lines("limits"), found.lines("unit"), found.lines("kernel")
    if limits:
        out.append(_block("into /etc/security/limits.d/rtec.conf:", limits))
    if unit:
        out.append(_block("or, started by systemd, into the unit's [Service] section:", unit))
    out += found.lines("commands")
    if kernel:
        line = f'GRUB_CMDLINE_LINUX="{" ".join(kernel)}"'
        out.append(
            _block("into /etc/default/grub (keep what stands there), then sudo update-grub and restart:", [line])
        )
    return out


def _block(head: str, lines: list[str]) -> str:
    return "\n    ".join([head, *lines])
