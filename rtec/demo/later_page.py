"""The second story in words: the lines of the terminal and the sections of the report."""

from rtec.demo.second_story import Later, by_part_um, tip_rms_um
from rtec.diagnosis.words import UNITS
from rtec.report import diagnosis_figures
from rtec.report.additions import added_page
from rtec.report.diagnosis import diagnosis_page
from rtec.report.page import Figure, Section, Table

TITLE = "An effect that the model does not know"
VERDICTS = {
    "named": "The diagnosis named it.",
    "among those alike": "It is among the effects that the diagnosis says these readings cannot tell apart; where the "
    "machine was probed they act alike, so any of them corrects it.",
    "not named": "The diagnosis named nothing, so nothing was added.",
    "wrongly named": "The diagnosis named another effect: it was wrong.",
}


def later_words(later: Later) -> list[str]:
    """The story in sentences."""
    out = [
        f"A fault was hidden in the machine (hidden seed {later.hidden_seed}). A model fitted to {later.readings} "
        f"readings of a probe, which knows nothing of it, leaves {tip_rms_um(later.before):.2f} µm at the tool tip; "
        f"without the fault it would be {tip_rms_um(later.healthy):.2f} µm.",
        f"Diagnosis: {later.diagnosis.sentence}.",
    ]
    if later.added is not None and later.after is not None:
        unit = UNITS[later.added.unit]
        out += [
            f"Added {', '.join(later.added.labels)}: on readings left out of the fit the error goes from "
            f"{later.added.before.held_out:.2f} to {later.added.after.held_out:.2f} {unit}, noise is "
            f"{later.added.floor:.2f}.",
            f"At the tool tip of the machine, through the same loop: from {tip_rms_um(later.before):.2f} to "
            f"{tip_rms_um(later.after):.2f} µm.",
        ]
    return [*out, f"What was hidden: {later.fault.words}. {VERDICTS[later.found]}"]


def tip_rows(later: Later) -> list[list[str]]:
    """Table of tip errors: which run, root mean square in the plane, of the last part."""
    runs = [("without the fault, and a model of that machine", later.healthy)]
    runs += [("with the fault, first model", later.before)]
    if later.after is not None:
        runs += [("with the fault, effect added", later.after)]
    return [[name, f"{tip_rms_um(track):.2f}", f"{by_part_um(track)[-1]:.2f}"] for name, track in runs]


TIP_HEAD = ("tool tip, µm rms in X and Z", "all parts", "last part")


def later_sections(later: Later) -> list[Section]:
    """Sections of the report: the story, the evidence, the error falling in the readings and at the tip."""
    runs = [("without the fault", by_part_um(later.healthy)), ("first model", by_part_um(later.before))]
    if later.after is not None:
        runs.append(("effect added", by_part_um(later.after)))
    png = diagnosis_figures.tip_by_part("Error at the tool tip, part by part", runs)
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
    out += [_renamed(s, "What the diagnosis saw", "hidden-evidence.png") for s in shown.sections[:1] if s.figure]
    if later.added is not None:
        steps = [s for s in added_page(later.added).sections if s.figure]
        out += [_renamed(s, "What it bought on readings left out", "hidden-history.png") for s in steps]
    return out


def _renamed(section: Section, heading: str, file: str) -> Section:
    """The section under another heading, its figure under another file name."""
    figure = section.figure
    kept = Figure(file, figure.png, figure.shows) if figure else None
    return Section(heading, section.text, section.table, kept)
