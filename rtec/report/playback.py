"""Report of a replay: comparisons and differences."""

from collections.abc import Mapping

from rtec.playback.capture import CaptureReport
from rtec.playback.replay import Replayed, ReplayReport
from rtec.report.page import Page, Section, Table
from rtec.wording import counted, percent

MORE = "and {} more rows"


def replay_page(r: Replayed, figures: bool = True) -> Page:
    """The verdict, and below it the differences or the axes."""
    del figures  # it has none
    first, *lines = replay_lines(r)
    title = "Replay of a capture" if isinstance(r.report, CaptureReport) else "Replay of a log"
    return Page(title, first, [], [Section("", lines, _table(r))])


def replay_lines(r: Replayed) -> list[str]:
    """Lines of a replay's result for a terminal."""
    return _capture_lines(r.report) if isinstance(r.report, CaptureReport) else _log_lines(r.report, r.checked)


def _table(r: Replayed) -> Table | None:
    rows = [[str(v) for v in row.values()] for row in r.rows()]
    return Table(list(r.rows()[0]), rows, words=(0, 1)) if rows else None


def _log_lines(report: ReplayReport, checked: bool) -> list[str]:
    out = [f"note: {note}" for note in report.notes]
    if report.torn_bytes:
        out.append(f"note: the log ends torn; {report.torn_bytes} bytes after its last whole batch are skipped")
    for d in report.differences:
        where = f"{d.log}, row" if d.log else "row"
        out.append(f"{where} {d.row}: {d.field} was {d.logged}, is now {d.replayed}")
    if report.different > len(report.differences):
        out.append(MORE.format(report.different - len({(d.log, d.row) for d in report.differences})))
    if checked:
        verdict = "all bit-identical" if not report.different else f"{report.different} differ"
        if report.rows > report.unchecked or not (report.rows or report.unread):
            out.append(f"{counted(report.rows - report.unchecked, 'command')} checked: {verdict}")
        if report.unchecked:
            out.append(f"{counted(report.unchecked, 'command')} not checkable: rows before were lost")
    if report.out:
        out.append(f"{counted(report.rows, 'command')} written to {report.out}")
    return out + [f"not checked: {text}" for text in report.unread]


def _capture_lines(report: CaptureReport) -> list[str]:
    out = [f"{report.samples} samples, {report.duration_s:g} s, {report.cycles} cycles"]
    out += flag_lines(report.flags_seen)
    for name, axis in report.axes.items():
        out.append(
            f"axis {name}: raw {axis.raw_counts:+d}, inserted {axis.inserted_counts:+d}, "
            f"corrected {axis.corrected_counts:+d} counts"
        )
        if axis.illegal:
            out.append(f"  {axis.illegal} illegal transitions in the capture (both lines at once), passed as they are")
        if axis.waiting_counts:
            out.append(f"  {axis.waiting_counts:+d} counts found no room before the end")
    return [*out, f"written: {report.capture_out} and {report.table_out}"]


def flag_lines(flags_seen: Mapping[str, float]) -> list[str]:
    """One line a flag with its share of the cycles; LIMITED is omitted, since every correction begins with it."""
    return [
        f"{name.lower().replace('_', ' ')}: {percent(share)} of cycles"
        for name, share in flags_seen.items()
        if name != "LIMITED"
    ]
