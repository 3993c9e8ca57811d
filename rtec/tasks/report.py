"""Task of a worker process that draws a report of what pages show, as HTML and as PDF."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import rtec
from rtec.arrays import Ints
from rtec.tasks.folder import Summary
from rtec.tasks.foreign import ImportView
from rtec.tasks.jobs import Reporter
from rtec.tasks.model import SHOWN_CURVES, DiagnosisView, PreviewView, SeriesView

if TYPE_CHECKING:
    from rtec.model import Model
    from rtec.report.daemon import DaemonMoment
    from rtec.report.figures import Zoom
    from rtec.report.history import Present
    from rtec.report.machine_state import MachineState
    from rtec.report.page import Page, Section


@dataclass(frozen=True)
class ReportFiles:
    """A report, as one self-contained HTML file and as a PDF."""

    html: bytes
    pdf: bytes


@dataclass(frozen=True)
class DrawnPlot:
    """What the page Compare draws.

    Attributes:
        series: the reading column.
        over, colour: titles of the channels; `colour` is empty for the direction of motion.
        marked: rows of the marked readings, rising, (k,).
        zooms: visible ends of the axes, by plot ("residual", "measured", "time", "map") and axis ("x", "y", "y2").
    """

    series: SeriesView
    over: str
    colour: str
    marked: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    zooms: "Mapping[str, Zoom]" = field(default_factory=dict)

    @property
    def look(self) -> tuple[object, ...]:
        """All of it but the reading column, to be compared."""
        return self.over, self.colour, tuple(self.marked.tolist()), self.zooms


def marked_rows(series: SeriesView, numbers: Sequence[int]) -> Ints:
    """Rows of the marked readings of a column, (k,), of their numbers among those of all columns."""
    return np.array([n - series.first for n in numbers if 0 <= n - series.first < len(series)], dtype=np.int64)


def marked_words(plot: DrawnPlot) -> str:
    """How many readings are marked, their residual, and where they are, in words; empty where none is."""
    from rtec.report.thinning import MOST
    from rtec.wording import counted, decimals, number

    s, rows = plot.series, plot.marked
    if not len(rows):
        return ""
    left = s.residuals[rows]
    rms = float(np.sqrt(np.mean(left**2)))
    spans = [
        f"{t.partition(', ')[0]} {v[rows].min():.5g} to {v[rows].max():.5g} {t.partition(', ')[2]}".strip()
        for t, v in list(s.channels.items())[:4]
    ]
    drawn, digits = " that are drawn" if len(s) > MOST else "", decimals(rms)
    return (
        f"{counted(len(rows), 'reading')}{drawn} marked: residual {number(rms, digits)} {s.unit} root mean square, "
        f"mean {number(float(left.mean()), digits, sign=True)} {s.unit}; {'; '.join(spans)}."
    )


@dataclass(frozen=True)
class ShownResidual:
    """The residual of a reading column as the page Add and watch draws it.

    Attributes:
        series: the reading column.
        most: half of the vertical scale.
        marked: rows of the marked readings, (k,).
    """

    series: SeriesView
    most: float
    marked: Ints


@dataclass(frozen=True)
class ReportParts:
    """What a report is to hold.

    Attributes:
        names: names of the pages whose content it shows.
        listed: summaries of the measurements.
        model: the model; None: nothing of the model is shown but its state.
        files, named: tables of the measurements, and path of the model in commands.
        drawn: the plots of the page Compare, where the user chose how to draw them.
        zooms: zoom of the plots of the other pages, by their names.
        diagnosed: the diagnosis, and `rank` the candidate that is shown.
        added: sections on the last addition.
        residuals: the residuals that the page Add and watch draws.
        now: the present residual, as that page draws it beside the steps.
        previewed: an expression that is being written, and its preview.
        foreign: what the page Import shows.
        state: what the page Explore shows.
        daemon: what the page Live shows.
    """

    names: tuple[str, ...]
    listed: tuple[Summary, ...] = ()
    model: "Model | None" = None
    files: tuple[Path, ...] = ()
    named: Path | None = None
    drawn: DrawnPlot | None = None
    zooms: "Mapping[str, Zoom]" = field(default_factory=dict)
    diagnosed: DiagnosisView | None = None
    rank: int = 1
    added: "Sequence[Section]" = ()
    residuals: tuple["ShownResidual", ...] = ()
    now: "Present | None" = None
    previewed: tuple[str, PreviewView] | None = None
    foreign: ImportView | None = None
    state: "MachineState | None" = None
    daemon: "DaemonMoment | None" = None

    def is_as(self, other: "ReportParts") -> bool:
        """Whether a report of the one is a report of the other, too: the same objects, drawn in the same way."""
        one, two = (
            (
                p.names,
                p.listed,
                p.files,
                p.rank,
                p.zooms,
                p.now,
                p.drawn and p.drawn.look,
                [tuple(r.marked) for r in p.residuals],
            )
            for p in (self, other)
        )
        series = [p.drawn.series if p.drawn else None for p in (self, other)]
        kept = all(
            getattr(self, k) is getattr(other, k)
            for k in ("model", "diagnosed", "previewed", "foreign", "state", "daemon")
        )
        return one == two and series[0] is series[1] and kept


def report(line: Reporter, parts: ReportParts) -> ReportFiles:
    """Draw a report of what pages show, with its figures."""
    from rtec.report.page import Page, render
    from rtec.report.pdf import pdf_of

    line.stage("drawing the report", 0, 0)
    titles: list[str] = []
    leads: list[str] = []
    numbers: list[tuple[str, str]] = []
    sections: list[Section] = []
    foot: list[str] = []
    if parts.listed:
        titles.append("Measurements")
        sections.append(_listed_section(parts.listed))
    if parts.foreign is not None:
        name = parts.foreign.proposal.path.name
        titles.append(f"Import of {name}")
        leads.append(f"{name} is not imported yet: this is how it would be.")
        sections += _foreign_sections(parts.foreign, parts.zooms.get("import", {}))
    if parts.model is not None:
        names = tuple(Path(f.name) for f in ((parts.named or Path("model.toml")), *parts.files))
        titles.insert(0, f"{parts.model.name} on {', '.join(f.stem for f in names[1:])}")
        for page in _model_pages(line, parts, names):
            leads.append(page.lead)
            numbers += page.numbers
            sections += page.sections
            foot += page.foot
    if parts.state is not None:
        from rtec.report.machine_state import machine_state_sections, state_sentence

        titles.append(f"{parts.state.model.name} in one state")
        leads.append(state_sentence(parts.state))
        sections += machine_state_sections(parts.state)
    if parts.daemon is not None:
        from rtec.report.daemon import daemon_lead, daemon_sections

        titles.append(f"{parts.daemon.status['machine']}, running")
        leads.append(daemon_lead(parts.daemon))
        sections += daemon_sections(parts.daemon, zooms=parts.zooms)
    made = Page(titles[0] if titles else "Report", "\n".join(filter(None, leads)), numbers, sections,
                list(dict.fromkeys(foot)))  # fmt: skip
    return ReportFiles(render(made).encode(), pdf_of(made))


def _listed_section(listed: Sequence[Summary]) -> "Section":
    """The measurements, as the page Measurements lists them."""
    from rtec.report.page import Section, Table

    rows = [
        (s.file, s.read_by, str(s.runs), str(s.rows), "; ".join(s.spans), "; ".join((*s.temperatures, *s.notes)))
        for s in listed
    ]
    head = ("file", "instrument", "runs", "readings", "span", "temperatures, remarks")
    return Section("The chosen measurements", [], Table(head, rows, words=(0, 1, 4, 5)))


def _model_pages(line: Reporter, parts: ReportParts, names: "tuple[Path, ...]") -> "Iterator[Page]":
    """Pages on the model: comparison, diagnosis, additions, as far as they are to be shown."""
    from rtec.report.history import history_sections
    from rtec.report.page import Page

    if parts.model is None:
        return
    if "compare" in parts.names:
        compared = replace(rtec.compare(parts.model, parts.files, progress=line.stage), files=names).page()
        line.stage("drawing the report", 0, 0)
        if parts.drawn is not None:
            compared = replace(compared, sections=[*_drawn_sections(parts.drawn), *compared.sections])
        yield compared
    if parts.diagnosed is not None:
        found = parts.diagnosed.found.page()
        yield replace(found, numbers=(), sections=[*found.sections, *_candidate_sections(parts)], foot=())
    if "add" in parts.names:
        drawn = [*_residual_sections(parts), *_preview_sections(parts)]
        yield Page("", "", (), [*parts.added, *history_sections(parts.model, True, parts.now), *drawn])


def _drawn_sections(plot: DrawnPlot) -> "list[Section]":
    """The plots of the page Compare, where they are not drawn as at first: coloured, zoomed, with marked readings."""
    from rtec.report import compare_figures as draw
    from rtec.report.figures import WHOLE, Png, zoom_words
    from rtec.report.page import Figure, Section

    s, marked, out = plot.series, plot.marked, list[Section]()
    x, said = s.channels[plot.over], marked_words(plot)
    time = next(t for t in s.channels if t.startswith("time "))
    places = [t for t in s.channels if t.endswith(", mm")]

    def section(key: str, words: str, draw_it: "Callable[[Zoom], Png]", *, always: bool = False) -> None:
        zoom = plot.zooms.get(key, WHOLE)
        if always or zoom or (said and key != "map"):
            text = [w for w in (said if key != "map" else "", zoom_words(zoom)) if w]
            out.append(Section(words, text, None, Figure(f"drawn-{key}.png", draw_it(zoom), words)))

    def residual(zoom: "Zoom") -> Png:
        shade = (plot.colour, s.channels[plot.colour]) if plot.colour else None
        return draw.over_channel(s.name, s.unit, plot.over, x, s.residuals, s.direction, s.floor, shade,
                                 marked=marked, zoom=zoom)  # fmt: skip

    def measured(zoom: "Zoom") -> Png:
        return draw.over_channel(s.name, s.unit, plot.over, x, s.measured, s.direction, float("nan"),
                                 predicted=s.predicted, marked=marked, zoom=zoom)  # fmt: skip

    def over_time(zoom: "Zoom") -> Png:
        sensors = [(n.removesuffix(", °C"), s.channels[n]) for n in s.sensors]
        return draw.over_time(s.name, s.unit, "h", s.channels[time], s.residuals, None, s.floor, sensors,
                              marked=marked, zoom=zoom)  # fmt: skip

    def cells(zoom: "Zoom") -> Png:
        from rtec.report.thinning import cells_of

        edges, mean = cells_of(s.channels[places[0]], s.channels[places[1]], s.residuals)
        given = (places[0], edges[0]), (places[1], edges[1])
        return draw.residual_map(s.name, s.unit, *given, [("", mean)], s.floor, zoom)

    by = f", coloured by {plot.colour}" if plot.colour else ""
    section("residual", f"The residual over {plot.over}{by}", residual, always=True)
    section("measured", f"Measured and predicted over {plot.over}", measured)
    section("time", "The residual over time, with the temperatures", over_time)
    if len(places) > 1:
        section("map", "The residual over two positions", cells)
    angle = s.angle_rad
    if angle is not None:
        section("polar", "Deviation from the circle, magnified",
                lambda _: draw.around_circle(s.name, s.unit, angle, s.measured, s.predicted, marked))  # fmt: skip
    return out


def _candidate_sections(parts: ReportParts) -> "list[Section]":
    """The curve of the shown candidate, where it is another than that of the diagnosis itself or is zoomed."""
    from rtec.report.diagnosis import evidence_figure
    from rtec.report.figures import WHOLE, zoom_words
    from rtec.report.page import Figure, Section

    view, rank = parts.diagnosed, parts.rank
    if view is None or rank not in view.curves:
        return []
    curves = view.curves[rank][:SHOWN_CURVES]
    zooms = [parts.zooms.get(f"diagnose {rank} {k}", WHOLE) for k in range(len(curves))]
    if rank <= 1 and not any(zooms):
        return []
    f = next((f for f in view.found.findings if f.rank == rank), None)
    name = f"Candidate {f.rank}, {f.label}" if f else "The shape without a name"
    words = [f"{e.title}: {zoom_words(z)}" for e, z in zip(curves, zooms, strict=True) if z]
    heading = f"{name}: residual and fitted effect"
    return [Section(heading, words, None, Figure("candidate.png", evidence_figure(curves, zooms), heading))]


def _residual_sections(parts: ReportParts) -> "list[Section]":
    """The residuals as the page Add and watch draws them."""
    from rtec.report.compare_figures import over_channel
    from rtec.report.figures import WHOLE, zoom_words
    from rtec.report.page import Figure, Section

    out = []
    for k, shown in enumerate(parts.residuals):
        s, over = shown.series, next(iter(shown.series.channels))
        zoom, heading = parts.zooms.get(f"add {s.name}", WHOLE), f"The residual of {s.name}"
        png = over_channel(s.name, s.unit, over, s.channels[over], s.residuals, s.direction, s.floor,
                           marked=shown.marked, zoom={"y": (-shown.most, shown.most)} | dict(zoom))  # fmt: skip
        marked = marked_words(DrawnPlot(s, over, "", shown.marked))
        words = [w for w in (marked, zoom_words(zoom)) if w]
        out.append(Section(heading, words, None, Figure(f"residual-{k}.png", png, heading)))
    return out


def _preview_sections(parts: ReportParts) -> "list[Section]":
    """The curve of an expression that is being written and is not added yet."""
    from rtec.report.diagnosis import evidence_figure
    from rtec.report.figures import WHOLE, zoom_words
    from rtec.report.page import Figure, Section

    if parts.previewed is None:
        return []
    expression, shown = parts.previewed
    zoom = parts.zooms.get("add own", WHOLE)
    heading, words = f"Not added yet: {expression}", [w for w in (shown.words, zoom_words(zoom)) if w]
    return [Section(heading, words, None, Figure("own.png", evidence_figure([shown.evidence], [zoom]), heading))]


def _foreign_sections(view: ImportView, zoom: "Zoom") -> "list[Section]":
    """A file that is being imported: what is known of it, its columns, its questions, and what it becomes."""
    from rtec.report.compare_figures import preview
    from rtec.report.figures import zoom_words
    from rtec.report.page import Figure, Section, Table
    from rtec.wording import counted

    p = view.proposal
    column = {str(c["from"]): (t, c) for t, c in p.content.get("column", {}).items() if "from" in c}
    rows = []
    for c in p.columns:
        target, entry = column.get(c.name, (c.becomes or "not used", {}))
        unit = str(entry.get("unit") or (f"{c.unit} (file)" if c.unit and entry else ""))
        sign = {1: "+", -1: "−"}[int(entry.get("sign", 1))] if entry else ""
        rows.append((c.name, " · ".join(v[:20] for v in c.first[:3]), target, unit, sign, c.reason))
    head = ("column", "first values", "becomes", "unit", "sign", "why")
    read = f"Read as {p.reader}: {counted(p.rows, 'row')}{'' if p.whole else ' looked at'}."
    out = [Section("The columns, and what they become", [read, *p.notes, *p.conclusions],
                   Table(head, rows, words=tuple(range(6))))]  # fmt: skip
    asked = [(q.words, q.default or "not answered") for q in p.questions if q.key != "machine"]
    answers = [*p.answers.items(), *asked]
    if answers:
        out.append(Section("What the file does not say", [], Table(("question", "answer"), answers, words=(0, 1))))
    if view.trouble:
        out.append(Section("Like that it cannot be imported", [view.trouble]))
    if view.rows:
        unit = "µrad" if all(n.endswith("urad") for n in view.readings) else "µm"
        heading = f"What it becomes: {counted(view.rows, 'reading')}"
        png = preview(view.title, unit, view.place, view.readings, zoom)
        words = [w for w in (zoom_words(zoom), *view.notes) if w]
        out.append(Section(heading, words, None, Figure("import.png", png, "the readings as they would be imported")))
    return out
