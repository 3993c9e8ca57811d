"""The second story: a machine with a hidden fault, and a model that gets the missing effect.

A fault is drawn. A first model is fitted to half a day of probing and corrects the machine; an error remains.
`rtec diagnose` searches the same readings. The effect that it names is added as by `rtec add`, and the same hours run
again with the new model through the same loop. Then come the lines of the terminal and the sections of the report.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import tomli_w

from rtec.arrays import Floats, Ints
from rtec.demo import training
from rtec.demo.day import CYLINDER, FACE, SHOULDER, Plan, Track
from rtec.demo.figures import tip_by_part
from rtec.demo.hidden import Fault, draw, with_play
from rtec.demo.live import corrected
from rtec.diagnosis.extend.add import Added, add, new_effect
from rtec.diagnosis.result import Diagnosis, Finding
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.words import sentence
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.diagnosis import diagnosis_page
from rtec.report.history import added_page
from rtec.report.page import Figure, Section, Table
from rtec.sim.truth import Truth, load_truth
from rtec.wording import ERROR_UNITS

Stage = Callable[[str, int, int], None]
Verdict = Literal["named", "among those alike", "not named", "wrongly named"]

LATER_PLAN = Plan(warm_h=1.5, night_h=0.0)
APART = 1000
"""Offset of the seeds, so that the days of this story differ from those of the first one."""


@dataclass(frozen=True)
class Later:
    """Result of the second story.

    Attributes:
        hidden_seed: seed of the fault.
        fault: the fault.
        seed: seed of the corrected hours; the probing has the next seed.
        readings: number of probe readings.
        noise_um: noise of the probe.
        first: model without the fault.
        diagnosis: diagnosis of the readings.
        added: result of the addition; None where no effect was named.
        healthy: the corrected hours of the machine without the fault, with a model of it: the best possible result.
        before, after: the corrected hours with the first and with the new model; None where there is no new model.
    """

    hidden_seed: int
    fault: Fault
    seed: int
    readings: int
    noise_um: float
    first: Model
    diagnosis: Diagnosis
    added: Added | None
    healthy: Track
    before: Track
    after: Track | None

    @property
    def found(self) -> Verdict:
        """Whether the diagnosis is right, which only a simulation knows.

        "named" only if the diagnosis is certain, and the fault is the first and only effect that it names.
        """
        if self.added is None:
            return "not named"
        right = {(effect, self.fault.component) for effect in self.fault.right}
        named = {(f.effect.effect, f.effect.component) for f in self.diagnosis.group}
        named |= {(m.fitted.effect.effect, m.fitted.effect.component) for m in self.diagnosis.together}
        if self.diagnosis.verdict == "missing_effect" and named <= right:
            return "named"
        alike = {(a.effect, a.component) for a in self.diagnosis.findings[0].confused_with}
        return "among those alike" if (named | alike) & right else "wrongly named"

    def facts(self) -> dict[str, Any]:
        """The result as plain data, for JSON."""
        return {
            "hidden_seed": self.hidden_seed,
            "hidden": {"name": self.fault.name, "words": self.fault.words, "component": self.fault.component},
            "seed": self.seed,
            "readings": self.readings,
            "found": self.found,
            "added": list(self.added.labels) if self.added else [],
            "tip_rms_um": {
                "without_the_fault": tip_rms_um(self.healthy),
                "first_model": tip_rms_um(self.before),
                "new_model": tip_rms_um(self.after) if self.after is not None else None,
            },
            "held_out_rms_um": {
                "before": self.added.before.held_out if self.added else None,
                "after": self.added.after.held_out if self.added else None,
            },
            "probe_noise_um": self.noise_um,
            "diagnosis": self.diagnosis.facts(),
        }


def tell_later(sound: Model, truth_file: Path, hidden_seed: int, name: str | None, seed: int, stage: Stage) -> Later:
    """Run the second story.

    Args:
        sound: model of the machine without the fault.
        truth_file: truth of that machine.
        hidden_seed: seed of the fault.
        name: name of the fault, or None to draw it.
        seed: seed of the first story.
        stage: progress callback, see `Stage`.
    """
    with TemporaryDirectory() as scratch:
        fault, file = draw(hidden_seed, name), Path(scratch) / "truth.toml"
        truth = with_play(load_truth(truth_file), fault)
        file.write_text(tomli_w.dumps(truth.model_dump(mode="json", exclude_none=True)), encoding="utf-8")
        return _tell(sound, (truth_file, file), truth, fault, (hidden_seed, seed + APART), stage)


def _tell(
    sound: Model, files: tuple[Path, Path], truth: Truth, fault: Fault, seeds: tuple[int, int], stage: Stage
) -> Later:
    """The story after the fault is drawn; files: the truth without and with it."""
    hidden_seed, later = seeds

    def live(model: Model, what: str, fault: Fault | None = fault) -> Track:
        def progress(done: int, total: int) -> None:
            stage(what, done, total)

        return corrected(model, files[fault is not None], later, LATER_PLAN, progress=progress, fault=fault)[0]

    stage("probing a machine with a fault", 0, 1)
    day = training.measure(sound.machine, truth, later + 1, visit=training.SHORT, fault=fault)
    measured = training.measurement_of(day, day.tip_um, "probing")
    first = training.fit_day(day, name="first")
    healthy = live(sound, "without the fault", None)
    before = live(first, "with the first model")
    diagnosis = diagnose(first, [measured], seed=hidden_seed, stage=stage)
    best = diagnosis.findings[0] if diagnosis.findings else None
    added = _add(first, best, measured, stage) if best is not None and best.accepted else None
    after = live(added.model, "with the new model") if added else None
    return Later(
        hidden_seed,
        fault,
        later,
        day.readings,
        training.PROBE_NOISE_UM,
        first,
        diagnosis,
        added,
        healthy,
        before,
        after,
    )


def _add(model: Model, named: Finding, measured: Measurement, stage: Stage) -> Added:
    values = {k: n.value for k, n in named.parameters.items()}
    return add(model, [new_effect(named.effect, model, named.theta, values)], [measured], stage=stage)


def tip_errors_um(track: Track) -> tuple[Ints, Floats]:
    """Tip error across and along the workpiece during the cuts, relative to the mean on the first part.

    Returns:
        Part, (n,), and error along X and Z, (n, 2), µm.
    """
    rows = np.isin(track.surface, (CYLINDER, FACE, SHOULDER))
    part, error = track.part[rows], track.tip_um[rows][:, [0, 2]]
    return part, np.asarray(error - error[part == 0].mean(axis=0))


def tip_rms_um(track: Track) -> float:
    """Root mean square error of the tool tip in the plane of X and Z, µm."""
    return float(np.sqrt(np.mean(np.sum(tip_errors_um(track)[1] ** 2, axis=1))))


def by_part_um(track: Track) -> Floats:
    """Root mean square error of each part, µm, (parts,)."""
    part, error = tip_errors_um(track)
    square = np.sum(error**2, axis=1)
    return np.array([float(np.sqrt(square[part == p].mean())) for p in np.unique(part)])


TITLE = "An effect that the model does not know"
VERDICTS = {
    "named": "The diagnosis named it.",
    "among those alike": "It is among the effects that the diagnosis names as confounded; where the machine was "
    "probed their effect is the same, so each of them corrects it.",
    "not named": "The diagnosis named nothing, so nothing was added.",
    "wrongly named": "The diagnosis named another effect: it was wrong.",
}


def later_words(later: Later) -> list[str]:
    """The story in sentences."""
    out = [
        f"A fault was hidden in the machine (hidden seed {later.hidden_seed}). A model fitted to {later.readings} "
        f"readings of a probe does not know it: the error at the tool tip is {tip_rms_um(later.before):.2f} µm; "
        f"without the fault it would be {tip_rms_um(later.healthy):.2f} µm (root mean square).",
        f"Diagnosis: {sentence(later.diagnosis.sentence)}",
    ]
    if later.added is not None and later.after is not None:
        unit = ERROR_UNITS[later.added.unit]
        out += [
            f"Added {', '.join(later.added.labels)}: on held-out runs the residual falls from "
            f"{later.added.before.held_out:.2f} to {later.added.after.held_out:.2f} {unit}; the noise floor is "
            f"{later.added.floor:.2f}.",
            f"At the tool tip, through the same loop, the error falls from {tip_rms_um(later.before):.2f} to "
            f"{tip_rms_um(later.after):.2f} µm.",
        ]
    return [*out, f"What was hidden: {later.fault.words}. {VERDICTS[later.found]}"]


def tip_rows(later: Later) -> list[list[str]]:
    """Rows of the table of tip errors: run, root mean square in the plane, the same of the last part."""
    runs = [("without the fault, and a model of that machine", later.healthy)]
    runs += [("with the fault, first model", later.before)]
    if later.after is not None:
        runs += [("with the fault, effect added", later.after)]
    return [[name, f"{tip_rms_um(track):.2f}", f"{by_part_um(track)[-1]:.2f}"] for name, track in runs]


TIP_HEAD = ("tool tip, µm rms in X and Z", "all parts", "last part")


def later_sections(later: Later) -> list[Section]:
    """Sections of the report: the story, the evidence, and the falling error in the readings and at the tip."""
    runs = [("without the fault", by_part_um(later.healthy)), ("first model", by_part_um(later.before))]
    if later.after is not None:
        runs.append(("effect added", by_part_um(later.after)))
    png = tip_by_part("Error at the tool tip, part by part", runs)
    caption = "While cutting, counted from the mean of the first part."
    out = [
        Section(
            TITLE,
            later_words(later),
            Table(TIP_HEAD, tip_rows(later), caption),
            Figure("hidden-tip.png", png, "Error at the tool tip of each part with the first and the new model"),
        )
    ]
    shown = diagnosis_page(later.diagnosis)
    out += [_renamed(s, "The evidence", "hidden-evidence.png") for s in shown.sections[:1] if s.figure]
    if later.added is not None:
        steps = [s for s in added_page(later.added).sections if s.figure]
        out += [_renamed(s, "Error on held-out readings before and after", "hidden-history.png") for s in steps]
    return out


def _renamed(section: Section, heading: str, file: str) -> Section:
    """The section with another heading and another file name for its figure."""
    figure = section.figure
    kept = Figure(file, figure.png, figure.shows) if figure else None
    return Section(heading, section.text, section.table, kept)
