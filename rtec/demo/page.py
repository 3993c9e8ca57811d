"""The demo's report in words, tables and figures; written whole or not at all."""

from pathlib import Path

import numpy as np

from rtec.arrays import Floats
from rtec.demo import figures
from rtec.demo.day import CYLINDER, FACE, OTHER, line
from rtec.demo.live import RATE_HZ
from rtec.demo.residual_sources import WHY
from rtec.demo.second_story import later_sections
from rtec.demo.story import FINER, Story
from rtec.report.page import Figure, Page, Section, Table, write_page
from rtec.version import __version__

TITLE = "A turning centre over a day, uncorrected and corrected"


def write_report(story: Story, folder: Path) -> Path:
    """Write `report.html`, `result.json` and the figures; give the page's path.

    All files are written into a hidden folder first, then moved to their places, the page last.

    Raises:
        RtecError: the folder cannot be written.
    """
    return write_page(page_of(story), story.facts(), folder)


def page_of(story: Story) -> Page:
    """The page of the report."""
    by_error = {row["error"]: row for row in story.figures()}
    return Page(
        title=TITLE,
        lead=(
            f"The same simulated day twice: {story.plan.warm_h:g} hours of work from cold, then "
            f"{story.plan.night_h:g} hours to cool. Largest error of "
            f"a diameter {by_error['diameter']['off_largest_um']:.0f} µm without correction, "
            f"{by_error['diameter']['on_largest_um']:.1f} µm with it."
        ),
        numbers=[
            (
                f"{by_error[kind]['factor_largest']:.1f}\u00a0×",
                f"smaller error of {kind}{nist_words(by_error[kind]['nist_factor'])}",
            )
            for kind in ("diameter", "length", "straightness")
        ],
        sections=[
            _diameter(story), _sizes(story), _over_time(story), _straight(story), _profiles(story),
            _temperatures(story), _not_corrected(story), _how(story),
            *(later_sections(story.later) if story.later else []),
        ],
        foot=[
            f"rtec {__version__}, {command(story)}. A simulation: machine, heat and errors are made up "
            "in the size of a real turning centre of middle accuracy; nothing here was measured on a machine.",
            "[G 4]: the guidelines of NIST on real-time error correction of machine tools, which report 10-20 × on "
            "diameter and length from cold to operating temperature and 4-5 × on straightness over 70 mm.",
        ],
    )  # fmt: skip


def command(story: Story) -> str:
    """The command that runs the same story again."""
    if story.later is None:
        return f"rtec demo --seed {story.seed} --no-hidden"
    return f"rtec demo --seed {story.seed} --hidden-seed {story.later.hidden_seed} --hidden {story.later.fault.name}"


def nist_words(factor: list[float] | None) -> str:
    """Improvement factors of NIST for a sentence; empty where there are none."""
    return f" (NIST reports {factor[0]:.0f}-{factor[1]:.0f} × [G 4])" if factor else ""


def error_rows(story: Story) -> list[list[str]]:
    """Rows of the main table: error, largest uncorrected, corrected, factor, the same for typical, NIST."""
    return [
        [
            row["error"],
            f"{row['off_largest_um']:.1f}", f"{row['on_largest_um']:.1f}", f"{row['factor_largest']:.1f}\u00a0×",
            f"{row['off_rms_um']:.1f}", f"{row['on_rms_um']:.1f}", f"{row['factor_rms']:.1f}\u00a0×",
            "{:.0f}-{:.0f}\u00a0×".format(*row["nist_factor"]) if row["nist_factor"] else "-",
        ]
        for row in story.figures()
    ]  # fmt: skip


ERROR_HEAD = (
    "µm", "largest, uncorrected", "corrected", "factor", "typical, uncorrected", "corrected", "factor", "NIST",
)  # fmt: skip


def limits_in_words(story: Story) -> list[str]:
    """Sentences on errors that no correction can remove here, with the reasons."""
    facts = story.facts()
    across, finer = facts["across"], facts["straightness_with_finer_encoder"]
    return [
        f"Across the workpiece (Y) the error is up to {across['largest_um']:.0f} µm and is not corrected: no axis "
        f"moves that way. On a diameter it counts for {across['on_diameter_um']:.3f} µm only.",
        f"Straightness is held back by the encoder: position, direction and correction are known in "
        f"steps of {1e3 / story.model.machine.axes[0].counts_per_mm:g} µm only. With {FINER} counts for one and "
        f"nothing else changed, the first two parts go from {finer['off_um']:.1f} to {finer['on_um']:.1f} µm, "
        f"{finer['factor']:.1f} × instead.",
    ]


def _sizes(story: Story) -> Section:
    parts = len(story.sizes[0].hours)
    return Section(
        "What the parts measure",
        [
            f"{parts} parts were cut: a face of 70 mm, a cylinder of 200 mm, a shoulder of 70 mm in one pass. The "
            "operator set the tool offsets on the first, cold part, in both runs alike, so errors of diameter and "
            "length count from there. Straightness counts as it is: range about the best-fit line, over the worst "
            "70 mm of the cylinder and over the face.",
        ],
        Table(
            ERROR_HEAD,
            error_rows(story),
            "All parts of day and night; typical: root mean square; factor: uncorrected by corrected.",
        ),
    )


def _diameter(story: Story) -> Section:
    """The picture of the README: the diameter, which a customer measures."""
    off, on = story.sizes
    png = figures.over_time(off.hours, [("Diameter error", off.diameter_um, on.diameter_um)], story.plan.warm_h)
    return Section(
        "The diameter over the day",
        ["Each mark is a part, the band all places along its cylinder. Nothing is set again during the day."],
        figure=Figure("diameter.png", png, "Diameter error over 24 hours, uncorrected and corrected"),
    )


def _over_time(story: Story) -> Section:
    off, on = story.sizes
    panels = [
        ("Length error, face to shoulder", off.length_um, on.length_um),
        ("Radial tip error at the cylinder", off.tip_um[:, 0], on.tip_um[:, 0]),
        ("Axial tip error at the face", off.tip_um[:, 1], on.tip_um[:, 1]),
    ]
    return Section(
        "Errors over the day",
        ["Each mark is a part. The correction is on from the first one; nothing is set again during the day."],
        figure=Figure(
            "errors-over-time.png",
            figures.over_time(off.hours, panels, story.plan.warm_h),
            "Length and tip errors over 24 hours, uncorrected and corrected",
        ),
    )


def _straight(story: Story) -> Section:
    off, on = story.sizes
    panels = [
        ("Straightness of the cylinder's line, worst 70 mm", off.straight_um, on.straight_um),
        ("Straightness of the face, 70 mm", off.face_straight_um, on.face_straight_um),
    ]
    png = figures.straightness_bars(off.hours, panels)
    shows = "Straightness of every part, uncorrected and corrected"
    return Section("Straightness, part by part", figure=Figure("straightness.png", png, shows))


def _profiles(story: Story) -> Section:
    part = int(np.argmin(np.abs(story.sizes[0].hours - story.plan.warm_h)))
    panels = []
    for surface, title, below in (
        (CYLINDER, "The cylinder's line on the hot part", "along the cylinder, mm"),
        (FACE, "The face of the hot part", "radius beyond the cylinder's, mm"),
    ):
        place, off = line(story.off, part, surface)
        panels.append(
            (title, below, place - place[0], _level(place, off), _level(place, line(story.on, part, surface)[1]))
        )
    return Section(
        "What straightness looks like",
        [
            f"The part cut at {story.sizes[0].hours[part]:.1f} hours, as a stylus would draw it, without the best-fit "
            "line."
        ],
        figure=Figure("profiles.png", figures.profiles(panels), "Profiles of a hot part, uncorrected and corrected"),
    )


def _temperatures(story: Story) -> Section:
    between = np.flatnonzero(story.off.surface == OTHER)[::30]
    names = story.model.machine.sensor_names
    degc = {name.removeprefix("T_").replace("_", " "): story.off.degc[between, i] for i, name in enumerate(names)}
    return Section(
        "Why: the machine warms up",
        ["The spindle heats the headstock, the drives heat screws and nuts, and the shop has its own day."],
        figure=Figure(
            "temperatures.png",
            figures.temperatures(story.off.hours[between], degc, story.plan.warm_h),
            "Temperatures of all sensors over 24 hours",
        ),
    )


def _not_corrected(story: Story) -> Section:
    rows = story.sources.sizes()
    return Section(
        "What stays uncorrected, and why",
        [
            *limits_in_words(story),
            "Only a simulation knows where the rest comes from. The parts below sum to the tip error of the corrected "
            "day at every recorded instant.",
        ],
        Table(
            ("part", "rms, µm", "largest, µm", "why"),
            [
                [name, f"{rms:.2f}", f"{most:.2f}", WHY.get(name, "they do not all peak at once")]
                for name, rms, most in rows
            ],
            "At the tool tip: radial on the cylinder, axial on face and shoulder, counted from the first part.",
            words=(0, 3),
        ),
        Figure("left-uncorrected.png", figures.shares("Residual at the tool tip", rows), "Sizes of the residual"),
    )


def _how(story: Story) -> Section:
    model = story.model
    return Section(
        "How it was done",
        [
            f"The model knows nothing of the day above. It was fitted to another day (seed {story.measuring_seed}) on "
            f"which a probe read {story.readings} tip errors with a noise of 0.3 µm: {len(model.effects)} effects, "
            f"{len(model.parameter_values())} numbers. The residual is {story.held_out_um:.2f} µm "
            f"(root mean square) on held-out hours and {story.inside_um:.2f} µm on fitted ones.",
            f"The corrected day ran through the same loop and step as `rtec run`, at {RATE_HZ} cycles a second while "
            "cutting: counts and temperatures in, guard, ledger, inserted counts out; the simulated controller closes "
            f"its position loop on raw plus inserted counts. The guard held the correction in "
            f"{100 * story.held_share:.1f} % of the cycles.",
        ],
    )


def _level(place: Floats, error: Floats) -> Floats:
    slope, start = np.polyfit(place, error, 1)
    return np.asarray(error - slope * place - start)
