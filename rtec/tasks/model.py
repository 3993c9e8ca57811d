"""Tasks of a worker process on a model: load, compare, diagnose, add, improve, fit. Results are small and plain.

The first argument of each task is its reporter. The numbers are those of the command line: the same functions with the
same arguments.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rtec
from rtec.arrays import Floats, Ints
from rtec.errors import RtecError
from rtec.tasks.folder import Summary
from rtec.tasks.jobs import Reporter

if TYPE_CHECKING:
    from rtec.diagnosis.compare.result import Comparison, Traces
    from rtec.diagnosis.extend.add import Added
    from rtec.diagnosis.extend.improve import ProposedStep
    from rtec.diagnosis.result import Diagnosis, Finding
    from rtec.estimation.outliers import WrongReading
    from rtec.estimation.readings import Readings, Series
    from rtec.model import Model
    from rtec.report.evidence import Evidence
    from rtec.report.page import Page
    from rtec.result import Result


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
        tiles: large numbers of each reading column, with their meanings.
    """

    page: "Page"
    series: tuple[SeriesView, ...]
    outliers: tuple[OutlierView, ...]
    facts: Mapping[str, Any]
    tiles: tuple[tuple[tuple[str, str], ...], ...]


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
    from rtec.report.compare import numbers_of

    wrong = [
        OutlierView(w.measurement, w.column, w.row + 1, w.run, w.off, w.unit, _channels_at(c, w))
        for w in c.judged.given.wrong
    ]
    items = zip(c.traces.readings.series, c.items, strict=True)
    series = tuple(_series(c.traces, s, item.floor) for s, item in items)
    numbers = tuple(tuple(numbers_of(item)) for item in c.items)
    return CompareView(_page(c, files), series, tuple(wrong), c.to_dict(), numbers)


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
    from rtec.wording import ERROR_UNITS

    readings = traces.readings
    channels, sensors, direction = _channels(readings, s)
    instrument = readings.measurements[s.source].instrument
    angle = readings.states[s.source].channels.get("angle_deg")
    bar = isinstance(instrument, BallBar) and angle is not None
    return SeriesView(
        series_name(readings, s),
        ERROR_UNITS[s.unit],
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
DIRECTION = "direction of motion"


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
        out[DIRECTION] = direction
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

    unnamed = {} if d.shows_rank_1 else {0: d.picture}
    pictures = unnamed | {f.rank: of_finding(d, f) for f in d.findings[:SHOWN]}
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
        from rtec.effects.effect_list import as_options

        name, _, component, *rest = as_options(finding.effect)
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
    """Asked before the model's own numbers are refitted, or what names no cause is added.

    Attributes:
        question: in words.
        adds: whether it adds an effect; else it refits.
        fell: how the residual on held-out runs fell, in words.
    """

    question: str
    adds: bool
    fell: str


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
    from rtec.report.history import fell
    from rtec.wording import ERROR_UNITS

    def ask(step: "ProposedStep") -> "Finding | None":
        d = step.diagnosis
        rank = line.ask(StepQuestion(_diagnosed(d, [named, *files], machine), step.number))
        return next((f for f in d.findings if f.rank == rank), None)

    def ask_made(made: "Added") -> bool:
        went = fell(made.before, made.after, ERROR_UNITS[made.unit])
        return bool(line.ask(RefitQuestion(made.question, bool(made.labels), went)))

    def keep(made: "Added") -> None:
        line.ask(StepDone(_view_of(line, made, files, named)))

    done = rtec.improve(model, files, ask=ask, ask_made=ask_made, step=keep, progress=line.stage)
    return str(done.page(figures=False).lead)


def fit(line: Reporter, machine: Path, files: Sequence[Path], out: Path, effects: str) -> str:
    """Fit a first model and write it, as `rtec fit`; give its verdict."""
    from rtec.tasks.folder import Folder

    done = rtec.fit(machine, files, effects=effects or None, name=out.stem, progress=line.stage)
    Folder(out.parent).save_model(done.model, out.name)
    return str(done.page(figures=False).lead)


def try_it(line: Reporter, folder: Path) -> None:
    """Write the tutorial's machine, two measurements with hidden effects, and a first model into a folder."""
    from rtec.tasks.example import write

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
    words = f"With these parameters it {fall} of the mean square of the residual of all readings."
    if shown.columns > 1:
        words += f" The curve is drawn on {shown.picture.place}, where it explains most."
    return PreviewView(evidence(shown.picture), words)
