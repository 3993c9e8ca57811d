"""Tasks of a worker process for a page: load, compare, diagnose, add, improve, fit. Results are small and plain.

The first argument of each task is its reporter. The numbers are those of the command line: the same functions with the
same arguments.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import rtec
from rtec.errors import RtecError
from rtec.studio.folder import Summary
from rtec.studio.jobs import Reporter

if TYPE_CHECKING:
    from rtec.diagnosis.compare.result import Comparison, Traces
    from rtec.diagnosis.extend.add import Added
    from rtec.diagnosis.extend.improve import ProposedStep
    from rtec.diagnosis.result import Diagnosis, Finding
    from rtec.estimation.outliers import WrongReading
    from rtec.estimation.readings import Readings, Series
    from rtec.machine import Machine
    from rtec.metrology.importing import ImportProposal
    from rtec.model import Model
    from rtec.report.daemon import DaemonMoment
    from rtec.report.evidence import Evidence
    from rtec.report.figures import Zoom
    from rtec.report.machine_state import MachineState
    from rtec.report.page import Page, Section
    from rtec.result import Result

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class SeriesView:
    """One reading column, reading by reading, for figures.

    Attributes:
        name: name of the measurement, with its column where it has several.
        unit: "µm" or "µrad".
        row, run: row in the file, from 1, and run, (n,).
        channels: values, (n,), of every channel for a horizontal axis, by title with unit, most useful first.
        sensors: titles of the temperatures among them.
        direction: -1, 0, +1, (n,).
        measured, predicted: (n,).
        floor: noise, root mean square; NaN while it is unknown.
        residual: root mean square of the residual.
        first: number of its first reading among those of all columns.
        angle_rad: angles of a ball bar's readings, (n,); None for other instruments.
    """

    name: str
    unit: str
    row: Ints
    run: Ints
    channels: Mapping[str, Floats]
    sensors: tuple[str, ...]
    direction: Floats
    measured: Floats
    predicted: Floats
    floor: float
    residual: float
    first: int
    angle_rad: Floats | None = None

    @property
    def residuals(self) -> Floats:
        """Residual, (n,)."""
        return self.measured - self.predicted

    def __len__(self) -> int:
        return len(self.row)


@dataclass(frozen=True)
class OutlierView:
    """An outlier: its place, its residual with unit, and its channels, by title."""

    measurement: str
    column: str
    row: int
    run: int
    off: float
    unit: str
    channels: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class CompareView:
    """A comparison.

    Attributes:
        page: sentences and tables, without figures.
        series: every reading column.
        outliers: excluded readings.
        facts: as `rtec compare --json` prints them.
    """

    page: "Page"
    series: tuple[SeriesView, ...]
    outliers: tuple[OutlierView, ...]
    facts: Mapping[str, Any]


@dataclass(frozen=True)
class DiagnosisView:
    """A diagnosis.

    Attributes:
        found: the diagnosis, without the readings.
        page: sentences and tables, without figures.
        curves: evidence of each candidate in the residual, by rank; 0 is the shape without a name.
    """

    found: "Diagnosis"
    page: "Page"
    curves: Mapping[int, "tuple[Evidence, ...]"]


@dataclass(frozen=True)
class AddedView:
    """An addition: its result, its page without figures, and the readings with the new model."""

    added: "Added"
    page: "Page"
    compared: CompareView


def summaries(line: Reporter, folder: Path, names: Sequence[str], machine: Path) -> tuple[Summary, ...]:
    """Summaries of measurements; that of an unreadable one has the reason."""
    known, out = rtec.load_machine(machine), []
    for i, name in enumerate(names):
        line.stage("reading the measurements", i, len(names))
        out.append(_summary(folder / name, known))
    return tuple(out)


def _summary(path: Path, machine: Any) -> Summary:
    try:
        m = rtec.load_measurement(path, machine)
    except RtecError as e:
        return Summary(path.name, trouble=str(e))
    sensors = {s: _range(m.channels[s]) for s in machine.sensor_names if s in m.channels}
    span = {
        a.name: _range(m.channels[a.channel])
        for a in machine.axes
        if a.channel in m.channels and float(np.ptp(m.channels[a.channel])) > 0.0
    }
    return Summary(
        path.name,
        m.instrument.name,
        str(getattr(m.instrument, "axis", "") or ""),
        tuple(m.instrument.columns()),
        len(m),
        len(np.unique(m.run)),
        float(m.time_s[-1] - m.time_s[0]) / 3600.0,
        sensors,
        span,
        m.notes,
    )


def _range(values: Floats) -> tuple[float, float]:
    good = values[np.isfinite(values)]
    return (float(good.min()), float(good.max())) if len(good) else (float("nan"), float("nan"))


def load_model(line: Reporter, model: Path, machine: Path) -> "Model":
    """Read a model with its machine."""
    line.stage("reading the model", 0, 0)
    return rtec.load_model(model, machine)


MANY = 20_000
"""From this number of readings on, the residual is shown before its noise, which takes long to estimate."""


@dataclass(frozen=True)
class ResidualKnown:
    """Sent to the page as soon as it can draw the residual; floors are NaN."""

    series: tuple[SeriesView, ...]


def compare(line: Reporter, model: "Model", files: Sequence[Path], named: Path) -> CompareView:
    """Compare a model with measurements.

    Args:
        line: the reporter; it gets a `ResidualKnown` where there are many readings.
        model: the model.
        files: tables of the measurements.
        named: path of the model in the suggested next command.
    """

    def known(traces: "Traces") -> None:
        if len(traces.readings) >= MANY:
            line.ask(ResidualKnown(tuple(_series(traces, s, float("nan")) for s in traces.readings.series)))

    return _compared(rtec.compare(model, files, progress=line.stage, residual=known), [named, *files])


def _compared(c: "Comparison", files: Sequence[Path]) -> CompareView:
    wrong = [
        OutlierView(w.measurement, w.column, w.row + 1, w.run, w.off, w.unit, _channels_at(c, w))
        for w in c.judged.given.wrong
    ]
    items = zip(c.traces.readings.series, c.items, strict=True)
    series = tuple(_series(c.traces, s, item.floor) for s, item in items)
    return CompareView(_page(c, files), series, tuple(wrong), c.to_dict())


def _channels_at(c: "Comparison", w: "WrongReading") -> dict[str, float]:
    """Every channel at an outlier, by title."""
    readings = c.traces.readings
    s = next((s for s in readings.series if readings.measurements[s.source].name == w.measurement), None)
    if s is None:
        return {}
    first = readings.measurements[s.source].time_s[s.row[0]]
    here = replace(s, row=np.array([w.row]), time_s=readings.measurements[s.source].time_s[[w.row]], run=np.array([0]))
    titles, _, _ = _channels(readings, here, axes_of=s)
    out = {title: float(values[0]) for title, values in titles.items()}
    return out | {TIME: float(here.time_s[0] - first) / 3600.0, "run": float(w.run)}


def _page(result: "Result", files: Sequence[Path]) -> "Page":
    """The page of a result without figures; its commands have the files' names in the folder."""
    page: Page = replace(result, files=tuple(Path(f.name) for f in files)).page(figures=False)
    return page


def _series(traces: "Traces", s: "Series", floor: float) -> SeriesView:
    from rtec.diagnosis.search.picture import series_name
    from rtec.metrology.instruments.ball_bar import BallBar

    readings = traces.readings
    channels, sensors, direction = _channels(readings, s)
    instrument = readings.measurements[s.source].instrument
    angle = readings.states[s.source].channels.get("angle_deg")
    bar = isinstance(instrument, BallBar) and angle is not None
    return SeriesView(
        series_name(readings, s),
        "µrad" if s.unit == "urad" else "µm",
        s.row + 1,
        s.run + 1,
        channels,
        sensors,
        direction,
        traces.measured[s.part],
        traces.predicted[s.part],
        floor,
        float(np.sqrt(np.mean(traces.left[s.part] ** 2))),
        s.start,
        np.deg2rad(angle[s.row]) if bar and angle is not None else None,
    )


TIME = "time since the first reading, h"


def _channels(
    readings: "Readings", s: "Series", axes_of: "Series | None" = None
) -> tuple[dict[str, Floats], tuple[str, ...], Floats]:
    """Channels for the horizontal axis of a reading column; temperatures among them; directions of the first axis."""
    from rtec.diagnosis.words import titled

    state, machine = readings.states[s.source], readings.machine
    out: dict[str, Floats] = {}
    direction: Floats = np.zeros(len(s))
    axes = sorted(machine.axes, key=lambda a: -float(np.ptp(state.value(a.channel)[(axes_of or s).row])))
    for axis in axes:
        place = state.value(axis.channel)[s.row]
        if axes_of is not None or float(np.ptp(place)) > 0.0:
            if not out:
                direction = np.sign(np.asarray(state.value(axis.direction_channel), dtype=np.float64)[s.row])
            out[titled(axis.channel)] = place
    hours = (s.time_s - s.time_s[0]) / 3600.0
    out[TIME] = hours
    warm = [n for n in machine.sensor_names if n in state.channels]
    out |= {titled(n, "degC"): state.channels[n][s.row] for n in warm}
    own = {a.channel for a in machine.axes} | {a.direction_channel for a in machine.axes} | set(warm)
    out |= {
        titled(n): np.asarray(v)[s.row] for n, v in state.channels.items() if n not in own and float(np.ptp(v)) > 0.0
    }
    if direction.any():
        out["direction of motion"] = direction
    out["run"] = np.asarray(s.run, dtype=np.float64) + 1.0
    return out, tuple(titled(n, "degC") for n in warm), direction


def diagnose(line: Reporter, model: "Model", files: Sequence[Path], named: Path, machine: Path) -> DiagnosisView:
    """Diagnose a model."""
    found = rtec.diagnose(model, files, progress=line.stage)
    line.stage("drawing the candidates", 0, 0)
    return _diagnosed(found, [named, *files], machine)


def _diagnosed(found: "Diagnosis", files: Sequence[Path], machine: Path) -> DiagnosisView:
    page = _page(replace(found, machine_file=Path(machine.name)), files)
    return DiagnosisView(replace(found, judged=None), page, _curves(found))


SHOWN, SHOWN_CURVES = 8, 2
"""Number of candidates with a card and a curve, and of reading columns for which the curve is drawn."""


def _curves(d: "Diagnosis") -> dict[int, "tuple[Evidence, ...]"]:
    from rtec.diagnosis.search.picture import of_finding
    from rtec.report.evidence import evidence

    pictures = {0: d.picture} | {f.rank: of_finding(d, f) for f in d.findings[:SHOWN]}
    return {
        rank: tuple(evidence(q) for q in (p, *p.others) if q.drivers)
        for rank, p in pictures.items()
        if p is not None and p.drivers
    }


@dataclass(frozen=True)
class EffectRequest:
    """An effect with the arguments of `rtec add`.

    Attributes:
        effect: its name; empty with `expression`.
        component: component error that it feeds.
        settings: other arguments, key=value.
        expression, parameters: the user's own effect.
    """

    effect: str = ""
    component: str = ""
    settings: tuple[str, ...] = ()
    expression: str = ""
    parameters: tuple[str, ...] = ()

    @classmethod
    def of(cls, finding: "Finding") -> "EffectRequest":
        """The arguments that add a candidate of a diagnosis."""
        from rtec.report.diagnosis import as_typed

        name, _, component, *rest = as_typed(finding.effect)
        return cls(name, component, tuple(rest[1::2]))

    @property
    def words(self) -> list[str]:
        """Words after `rtec add MODEL`."""
        if self.expression:
            params = [w for p in self.parameters for w in ("--param", p)]
            return ["--expr", self.expression, *params, "--component", self.component]
        return [self.effect, "--component", self.component, *(w for s in self.settings for w in ("--set", s))]

    @property
    def label(self) -> str:
        """Short name for a progress line."""
        return self.expression or f"{self.effect}({self.component})"


def add(line: Reporter, model: "Model", request: EffectRequest | None, files: Sequence[Path], named: Path) -> AddedView:
    """Add an effect as `rtec add`; with `request` None, refit the model's own numbers."""
    from rtec.diagnosis.extend.add import settings_of

    w = request or EffectRequest()
    added = rtec.add(
        model,
        files,
        w.effect or None,
        component=w.component or None,
        expr=w.expression or None,
        params=w.parameters,
        arguments=settings_of(w.settings, f"effect {w.effect!r}"),
        progress=line.stage,
    )
    return _view_of(line, added, files, named)


def _view_of(line: Reporter, added: "Added", files: Sequence[Path], named: Path) -> AddedView:
    line.stage("comparing", 0, 0)
    compared = rtec.compare(added.model, files, progress=line.stage)
    return AddedView(added, _page(added, [named, *files]), _compared(compared, [named, *files]))


@dataclass(frozen=True)
class StepDone:
    """Sent to the page after each step of an improvement: the addition, and the readings with the new model."""

    view: AddedView


@dataclass(frozen=True)
class RefitQuestion:
    """Asked before the model's own numbers are refitted, or a further temperature is added.

    Attributes:
        what: the further temperature; empty for a refit.
        before, after: error on held-out runs.
        unit: unit of both.
    """

    what: str
    before: float
    after: float
    unit: str


@dataclass(frozen=True)
class StepQuestion:
    """Asked before a step.

    Attributes:
        diagnosis: the diagnosis with its candidates.
        number: number of the step, from 1.
    """

    diagnosis: DiagnosisView
    number: int


def improve(line: Reporter, model: "Model", files: Sequence[Path], named: Path, machine: Path) -> str:
    """Improve step by step, with a question before each; give the reason why it ended, in a sentence."""

    def ask(step: "ProposedStep") -> "Finding | None":
        d = step.diagnosis
        rank = line.ask(StepQuestion(_diagnosed(d, [named, *files], machine), step.number))
        return next((f for f in d.findings if f.rank == rank), None)

    def ask_made(made: "Added") -> bool:
        return bool(
            line.ask(RefitQuestion(", ".join(made.labels), made.before.held_out, made.after.held_out, made.unit))
        )

    def keep(made: "Added") -> None:
        line.ask(StepDone(_view_of(line, made, files, named)))

    done = rtec.improve(model, files, ask=ask, ask_made=ask_made, step=keep, progress=line.stage)
    return str(done.page(figures=False).lead)


def fit(line: Reporter, machine: Path, files: Sequence[Path], out: Path, effects: str) -> str:
    """Fit a first model and write it, as `rtec fit`; give its verdict."""
    from rtec.studio.folder import Folder

    done = rtec.fit(machine, files, effects=effects or None, name=out.stem, progress=line.stage)
    Folder(out.parent).save_model(done.model, out.name)
    return str(done.page(figures=False).lead)


def try_it(line: Reporter, folder: Path) -> None:
    """Write the tutorial's machine, two measurements with hidden effects, and a first model into a folder."""
    from rtec.studio.example import write

    write(line, folder)


@dataclass(frozen=True)
class PreviewView:
    """An expression over the residual: the curves, and the explained share of the residual, in words."""

    evidence: "Evidence"
    words: str


def preview(line: Reporter, model: "Model", request: EffectRequest, files: Sequence[Path]) -> PreviewView:
    """Fit an expression to the residual by plain least squares, with its non-linear parameters as given.

    Raises:
        RtecError: the expression is invalid, or no reading shows it.
    """
    from rtec.diagnosis.extend.preview import preview as previewed
    from rtec.metrology.files.load import load_measurements
    from rtec.report.evidence import evidence
    from rtec.wording import percent

    del line
    read = load_measurements(files, model.machine)
    shown = previewed(model, read, request.expression, request.parameters, request.component)
    fall = f"removes {percent(shown.removed)}" if shown.removed > 0.0 else "removes nothing"
    words = f"With these parameters it {fall} of the mean square of the residual of these readings."
    return PreviewView(evidence(shown.picture), words)


PREVIEWED = 6000
"""Largest number of drawn readings of a foreign file."""


@dataclass(frozen=True)
class ImportView:
    """Preview of the import of a file of another program.

    Attributes:
        proposal: its map, and questions.
        title, place, readings: the plot: title and values of the horizontal axis, (n,), and the readings by name, (n,)
            each; of very many readings an even selection.
        rows: number of rows of the measurement; 0 before the questions are answered.
        notes: notes on the import, in words.
        trouble: why it cannot be imported like this; else empty.
    """

    proposal: "ImportProposal"
    title: str = ""
    place: Floats = field(default_factory=lambda: np.zeros(0))
    readings: Mapping[str, Floats] = field(default_factory=dict)
    rows: int = 0
    notes: tuple[str, ...] = ()
    trouble: str = ""


def look_at_foreign(
    line: Reporter,
    path: Path,
    machine: Path | None,
    answers: Mapping[str, str],
    edited: Mapping[str, Mapping[str, Any]] | None,
) -> ImportView:
    """Propose a map for a file, and import it in memory if all questions are answered.

    Args:
        line: the reporter.
        path: path of the file.
        machine: file of the machine; None: not chosen yet.
        answers: answers to its questions, by key.
        edited: columns of the map that the user changed; None: as proposed.

    Raises:
        RtecError: the file cannot be read.
    """
    from rtec.metrology.importing import import_measurement

    line.stage("reading the file", 0, 0)
    known = rtec.load_machine(machine) if machine is not None else None
    proposal = _proposed(path, known, dict(answers))
    if edited is not None:
        proposal = proposal.with_columns(edited)
    if proposal.open or known is None:
        return ImportView(proposal)
    try:
        m = import_measurement(path, proposal.import_map(), known)
    except RtecError as e:
        return ImportView(proposal, trouble=str(e))
    moved = max(known.axes, key=lambda a: float(np.ptp(m.channels.get(a.channel, np.zeros(1)))))
    place = m.channels.get(moved.channel)
    title, over = ("time, h", m.time_s / 3600.0) if place is None else (f"{moved.name}, mm", place)
    some = slice(None, None, max(1, len(m) // PREVIEWED))
    readings = {name: values[some] for name, values in m.readings.items()}
    return ImportView(proposal, title, over[some], readings, len(m), m.notes)


def _proposed(path: Path, machine: "Machine | None", answers: dict[str, str]) -> "ImportProposal":
    """The proposal; an answer to a question that another answer took away is forgotten."""
    from rtec.metrology.importing import propose

    first = propose(path, machine)
    for key, value in answers.items():
        if key in {q.key for q in first.questions}:
            first = first.answered({key: value})
    return first


def import_foreign(line: Reporter, path: Path, proposal: "ImportProposal", out: Path) -> tuple[str, ...]:
    """Write a file of another program as a measurement, with the map that made it; give the notes on it."""
    line.stage("importing", 0, 0)
    return rtec.import_table(path, proposal, out).notes


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


def marked_words(plot: DrawnPlot) -> str:
    """How many readings are marked, their residual, and where they are, in words; empty where none is."""
    from rtec.studio.figures import MOST
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
    """

    series: SeriesView
    most: float


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
    foreign: ImportView | None = None
    state: "MachineState | None" = None
    daemon: "DaemonMoment | None" = None

    def is_as(self, other: "ReportParts") -> bool:
        """Whether a report of the one is a report of the other, too: the same objects, drawn in the same way."""
        one, two = (
            (p.names, p.listed, p.files, p.rank, p.zooms, p.drawn and p.drawn.look, len(p.residuals))
            for p in (self, other)
        )
        series = [p.drawn.series if p.drawn else None for p in (self, other)]
        kept = all(getattr(self, k) is getattr(other, k) for k in ("model", "diagnosed", "foreign", "state", "daemon"))
        return one == two and series[0] is series[1] and kept


def report(line: Reporter, parts: ReportParts) -> ReportFiles:
    """Draw a report of what pages show, with its figures."""
    from rtec.report.page import Page, render
    from rtec.studio.pdf import pdf_of

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
        yield Page("", "", (), [*parts.added, *history_sections(parts.model, True), *_residual_sections(parts)])


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
        from rtec.studio.figures import cells_of

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
                           zoom={"y": (-shown.most, shown.most)} | dict(zoom))  # fmt: skip
        words = [w for w in (zoom_words(zoom),) if w]
        out.append(Section(heading, words, None, Figure(f"residual-{k}.png", png, heading)))
    return out


def _foreign_sections(view: ImportView, zoom: "Zoom") -> "list[Section]":
    """A file that is being imported: what is known of it, its columns, its questions, and what it becomes."""
    from rtec.report.compare_figures import preview
    from rtec.report.figures import zoom_words
    from rtec.report.page import Figure, Section, Table
    from rtec.wording import counted

    p = view.proposal
    column = {str(c["from"]): (t, c) for t, c in p.content.get("column", {}).items()}
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
    asked = [(q.text, q.default or "not answered") for q in p.questions if q.key != "machine"]
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
