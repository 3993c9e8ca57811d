"""The session of one browser tab: one typed object, from the opened folder to the steps of the model."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, TypeVarTuple

from rtec.errors import RtecError
from rtec.tasks.folder import Folder, Listing, Summary
from rtec.tasks.jobs import Cancelled, Job, Reporter

if TYPE_CHECKING:
    from rtec.model import Model
    from rtec.report.figures import Zoom
    from rtec.report.machine_state import MachineState
    from rtec.tasks.daemon import LiveLink
    from rtec.tasks.foreign import ImportView
    from rtec.tasks.model import AddedView, CompareView, DiagnosisView, PreviewView, SeriesView
    from rtec.tasks.report import ReportFiles, ReportParts

Ts = TypeVarTuple("Ts")
R = TypeVar("R")
NO_FIELDS: Final[Mapping[str, str]] = {}


def blamed(message: str, fields: Mapping[str, str], beside: str) -> tuple[str, str]:
    """Message and place of an error: the field of the option with which the message begins, else `beside`."""
    option = message.partition(" ")[0].removesuffix(":")
    return (message.removeprefix(f"{option}: "), fields[option]) if option in fields else (message, beside)


@dataclass(frozen=True)
class ModelStep:
    """One state of the model.

    Attributes:
        model: the model.
        label: the change that led to it, in words.
        words: words of the equivalent command after `rtec`, without model and files; empty for the model of the file.
        added: result of the change; None for the model of the file.
        compared, diagnosed: results, once they exist.
        residual: reading columns that can be drawn before the comparison, without their noise.
    """

    model: Model
    label: str
    words: tuple[str, ...] = ()
    added: AddedView | None = None
    compared: CompareView | None = None
    diagnosed: DiagnosisView | None = None
    residual: tuple[SeriesView, ...] = ()


@dataclass(frozen=True)
class ForeignFile:
    """A file of another program on its way to a measurement.

    Attributes:
        name: name of the file.
        answers: answers by key of the question.
        edited: columns of the map that the user changed; None: as proposed.
        looked: preview; None before the first one.
        machine: file of the machine for whose axes and sensors the preview was made; empty: none.
        temperatures: name of the log of temperatures that comes with it; empty: none.
    """

    name: str
    answers: Mapping[str, str] = field(default_factory=dict)
    edited: Mapping[str, Mapping[str, Any]] | None = None
    looked: ImportView | None = None
    machine: str = ""
    temperatures: str = ""


@dataclass(frozen=True)
class PlotChoices:
    """What the user chose for the plots of the page Compare.

    Attributes:
        series: name of the reading column; empty: that with the largest residual.
        over, colour: titles of the channels; empty: the first one; the direction of motion.
        marked: numbers of the marked readings among those of all columns.
    """

    series: str = ""
    over: str = ""
    colour: str = ""
    marked: tuple[int, ...] = ()


Stamp = tuple[int, int]
"""Time of the last change of a file, ns, and its size in bytes."""


@dataclass(frozen=True)
class SetAside:
    """What was added and not saved when other files were chosen.

    Attributes:
        machine, model, chosen, steps, at, saved, read: as in `TabSession`, at that moment.
    """

    machine: str
    model: str
    chosen: tuple[str, ...]
    steps: tuple[ModelStep, ...]
    at: int
    saved: Mapping[int, str]
    read: Mapping[str, Stamp]

    @property
    def words(self) -> str:
        """What was added, in words."""
        return ", ".join(step.label for step in self.steps[1 : self.at + 1])


@dataclass
class TabSession:
    """One tab.

    Attributes:
        folder: the opened folder.
        listing: its files.
        machine, model: names of the chosen files; empty: none yet.
        chosen: names of the chosen measurements.
        summaries: summaries of all measurements; `listed` has the stamps of their files at that time.
        steps: the model of the file, and after each addition; `at` is the current one (undo and redo).
        saved: name of the file of a saved step, by number of the step.
        aside: additions to models that are no longer chosen, the latest last; they are not saved.
        read: stamps of the files from which the steps were made, by name.
        written: content of the files that this tab wrote, by name.
        job: the running job, or None.
        trouble: why the last job failed, in a sentence; `beside` is the place or field of a page to which it belongs.
        improved: why the last improvement ended.
        question: the job's present question, with the future of its answer.
        rank: the shown candidate.
        drafts: texts of fields, by name.
        plots: choices for the plots of the page Compare.
        zooms: zoom of each plot, by its name, which begins with that of its page.
        came_from: number of the step before the last addition, undo or redo; None: there was none.
        moving: whether the page Add and watch is to move the residual from there.
        foreign: the file of another program that is being imported, or None.
        live: connection to a daemon, or None.
        previewed: the expression that is being written on the page Add and watch, and its preview; None: none.
        explored: what the page Explore shows; None before its first visit.
        reported: names of the parts that the report is to hold; None: all that there are.
        report: the last report, and its parts.
        on_progress, on_change, on_names: redraw the progress, the whole page, or the names at its top.
        on_compared: adds a comparison to a page that already shows its residual; gives whether there is such a page.
    """

    folder: Folder
    listing: Listing = field(default_factory=Listing)
    machine: str = ""
    model: str = ""
    chosen: tuple[str, ...] = ()
    summaries: dict[str, Summary] = field(default_factory=dict)
    listed: dict[str, Stamp | None] = field(default_factory=dict)
    steps: tuple[ModelStep, ...] = ()
    at: int = 0
    saved: dict[int, str] = field(default_factory=dict)
    aside: tuple[SetAside, ...] = ()
    read: Mapping[str, Stamp] = field(default_factory=dict)
    written: dict[str, bytes] = field(default_factory=dict)
    job: Job | None = None
    trouble: str = ""
    beside: str = ""
    improved: str = ""
    question: tuple[Any, asyncio.Future[Any]] | None = None
    rank: int = 1
    drafts: dict[str, str] = field(default_factory=dict)
    plots: PlotChoices = PlotChoices()
    zooms: dict[str, Zoom] = field(default_factory=dict)
    came_from: int | None = None
    moving: bool = False
    foreign: ForeignFile | None = None
    live: LiveLink | None = None
    previewed: tuple[str, PreviewView] | None = None
    explored: MachineState | None = None
    reported: frozenset[str] | None = None
    report: tuple[ReportParts, ReportFiles] | None = None
    on_progress: Callable[[], None] = lambda: None
    on_change: Callable[[], None] = lambda: None
    on_names: Callable[[], None] = lambda: None
    on_compared: Callable[[], bool] = lambda: False
    go: Callable[[str], None] = lambda _: None

    @property
    def step(self) -> ModelStep | None:
        """The current step (undo and redo); None before a model was read."""
        return self.steps[self.at] if self.steps else None

    @property
    def files(self) -> list[Path]:
        """Tables of the chosen measurements."""
        return [self.folder.existing(name) for name in self.chosen]

    @property
    def machine_path(self) -> Path:
        """File of the machine."""
        return self.folder.existing(self.machine)

    @property
    def model_path(self) -> Path:
        """File of the chosen model."""
        return self.folder.existing(self.model)

    @property
    def lacks(self) -> str:
        """What is missing for a comparison, in a sentence; empty where nothing is."""
        if not self.machine:
            return "Choose a machine file on the page Measurements."
        if not self.chosen:
            return "Choose at least one measurement on the page Measurements."
        return "" if self.model else "Choose or fit a model on the page Measurements."

    def look(self) -> None:
        """Read the folder's listing; deleted files are no longer chosen, and the only one of its kind is chosen.

        A deleted model stays chosen while additions to it are not saved. Files that were changed are read again,
        unless additions were made from them: then `outdated` has their names.
        """
        try:
            self.listing = self.folder.listing()
        except RtecError as e:
            self.listing = Listing()
            self.fail(str(e))
        self.machine = _kept(self.machine, self.listing.machines)
        model = _kept(self.model, self.listing.models)
        if model != self.model and len(self.steps) <= 1:  # else additions would be lost with the file
            self.model = model
            self.forget()
        self.chosen = tuple(n for n in self.chosen if n in self.listing.measurements)
        listed = {n: self._stamp(n) for n in self.listing.measurements}
        self.summaries = {n: s for n, s in self.summaries.items() if listed.get(n) == self.listed.get(n)}
        self.listed = listed
        self.look_at_chosen()

    def look_at_chosen(self) -> None:
        """Forget what was read from a chosen file that was changed since, unless additions were made from it."""
        if self.outdated and len(self.steps) <= 1 and self.job is None:
            self.forget()

    @property
    def outdated(self) -> tuple[str, ...]:
        """Names of the files that were changed since the steps were made from them."""
        return tuple(n for n, stamp in self.read.items() if self._stamp(n) not in (stamp, None))

    def stamps(self) -> dict[str, Stamp]:
        """Stamps of the machine, the model and the chosen measurements, by name."""
        found = {n: self._stamp(n) for n in (self.machine, self.model, *self.chosen)}
        return {n: stamp for n, stamp in found.items() if stamp is not None}

    def _stamp(self, name: str) -> Stamp | None:
        """Stamp of a file; of a table with that of the TOML beside it; None where it is not there."""
        try:
            path = self.folder.existing(name)
            found = [p.stat() for p in {path, path.with_suffix(".toml")}]
        except (OSError, RtecError):
            return None
        return max(s.st_mtime_ns for s in found), sum(s.st_size for s in found)

    def choose(
        self, *, machine: str | None = None, model: str | None = None, chosen: tuple[str, ...] | None = None
    ) -> None:
        """Use another machine, another model or other measurements; what was added and not saved is put aside.

        Args:
            machine, model, chosen: names of the files; None: as before.
        """
        if self.at > 0 and self.at not in self.saved:
            now = SetAside(self.machine, self.model, self.chosen, self.steps, self.at, self.saved, self.read)
            self.aside = (*self.aside, now)
        self.machine = self.machine if machine is None else machine
        self.model = self.model if model is None else model
        self.chosen = self.chosen if chosen is None else chosen
        self.forget()

    def bring_back(self) -> None:
        """Go back to what was put aside last, with its machine, model and measurements."""
        *others, last = self.aside
        if last.machine != self.machine:
            self.summaries = {}
        self.choose(machine=last.machine, model=last.model, chosen=last.chosen)
        self.aside = (*others, *self.aside[len(others) + 1 :])
        self.steps, self.at, self.saved, self.read = last.steps, last.at, dict(last.saved), last.read

    def forget(self) -> None:
        """Remove all steps, because the model or the measurements changed."""
        self.steps, self.at, self.saved, self.improved = (), 0, {}, ""
        self.read = {}
        self.came_from, self.moving = None, False
        self._show_whole_plots()

    def push(self, step: ModelStep) -> None:
        """Add a step after the current one; undone steps are removed."""
        self.steps = (*self.steps[: self.at + 1], step)
        self.at = len(self.steps) - 1
        self.came_from, self.moving = self.at - 1, False
        self.saved = {k: name for k, name in self.saved.items() if k < self.at}
        self._show_whole_plots()

    def move(self, by: int) -> None:
        """Go to another step: -1 undoes, +1 redoes."""
        self.came_from, self.moving = self.at, True
        self.at += by
        self.improved = ""
        self._show_whole_plots()

    def _show_whole_plots(self) -> None:
        """Forget zoom, marked readings, candidate and preview: they were of another model or of other readings."""
        self.rank, self.previewed = 1, None
        self.unzoom("compare", "diagnose", "add")
        self.plots = replace(self.plots, marked=())

    def zoom(self, name: str, ends: Mapping[str, Sequence[float]]) -> None:
        """Store the zoom of a plot, as the browser reports it; without ends it is whole."""
        zoom = {axis: (float(v[0]), float(v[1])) for axis, v in ends.items()}
        self.zooms = {k: v for k, v in self.zooms.items() if k != name} | ({name: zoom} if zoom else {})

    def mark(self, numbers: Sequence[float]) -> None:
        """Store the marked readings, as the browser reports them: by their numbers among those of all columns."""
        self.plots = replace(self.plots, marked=tuple(int(n) for n in numbers))

    def unzoom(self, *plots: str) -> None:
        """Forget the zoom of the plots whose names begin with one of these."""
        self.zooms = {k: v for k, v in self.zooms.items() if not k.startswith(plots)}

    def keep(self, **known: Any) -> None:
        """Store results with the current step."""
        steps = list(self.steps)
        steps[self.at] = replace(steps[self.at], **known)
        self.steps = tuple(steps)

    def fail(self, why: str, beside: str = "") -> None:
        """Store the reason of a failure, and the place of a page that shows it; by default its head."""
        self.trouble, self.beside = why, beside

    def trouble_at(self, place: str) -> str:
        """The failure that belongs to a place; empty where there is none."""
        return self.trouble if self.beside == place else ""

    async def work(
        self,
        title: str,
        task: Callable[[Reporter, *Ts], R],
        *args: *Ts,
        beside: str = "",
        fields: Mapping[str, str] = NO_FIELDS,
    ) -> R | None:
        """Run a task in another process; None where it failed (`trouble` has the reason) or was cancelled.

        Args:
            title: description in words.
            task: the task.
            args: its arguments.
            beside: place of a page that shows an error.
            fields: fields that show it instead, by the option with which the message begins.
        """
        if self.job is not None:
            self.fail(f"{self.job.title} is not finished; wait for it, or cancel it.", beside)
            self.on_change()
            return None
        self.fail("")
        self.job = Job(title, self.on_progress_now, self._ask)
        self.on_progress()
        try:
            return await self.job.run(task, *args)
        except RtecError as e:
            # As on a command line that is in the folder.
            self.fail(*blamed(str(e).replace(f"{self.folder.root}/", ""), fields, beside))
        except Cancelled:
            self.fail(f"{title}: cancelled; nothing was changed.", beside)
        finally:
            self.job, self.question = None, None
            self.on_progress()
        self.on_change()
        return None

    def on_progress_now(self) -> None:
        """Call `on_progress`, looked up at each call: another page may have replaced it."""
        self.on_progress()

    def answer(self, value: Any) -> None:
        """Answer the job's present question."""
        if self.question is not None and not self.question[1].done():
            question, self.question = self.question, None
            question[1].set_result(value)
            self.on_change()

    def _ask(self, question: Any) -> asyncio.Future[Any]:
        from rtec.tasks.model import ResidualKnown, StepDone

        answer: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        if isinstance(question, StepDone):
            view = question.view
            label = ", ".join(view.added.labels) or "numbers refitted"
            self.push(ModelStep(view.added.model, label, ("improve",), view, view.compared))
            answer.set_result(True)
        elif isinstance(question, ResidualKnown):
            self.keep(residual=question.series)
            answer.set_result(True)
        else:
            self.question = question, answer
        self.on_change()
        return answer


def _kept(name: str, there: tuple[str, ...]) -> str:
    if name in there:
        return name
    return there[0] if len(there) == 1 else ""
