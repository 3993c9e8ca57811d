"""Report of a diagnosis; its figures are the evidence of a finding, and the candidates beside each other."""

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from rtec.diagnosis.doubts.not_read import not_logged_beside, unread_beside
from rtec.diagnosis.result import Diagnosis, Finding, NotTestable, OnCircle, Picture
from rtec.diagnosis.search.not_found import ALPHA
from rtec.diagnosis.words import (
    MOST_NUMBERS,
    fitted_numbers,
    hardly,
    indistinguishable,
    labels,
    rivals_of,
    same_part,
    sentence,
)
from rtec.effects import Effect
from rtec.effects.effect_list import as_options, as_text
from rtec.model import FittedEffect
from rtec.report.evidence import Amplitudes, Evidence, evidence
from rtec.report.figures import GREY, MOST_DOTS, OFF, ON, WHOLE, Zoom, as_png, canvas, room_above, stacked, zoomed
from rtec.report.page import Figure, Page, Section, Table, name_of_file, shell_command
from rtec.version import __version__
from rtec.wording import ERROR_UNITS, NONE, counted, decimals, number, percent, probability, sizes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as MplFigure

MOST_MARKERS = 120
LEVEL_COLOURS = ("#3B1C8C", "#2A6FB0", "#1FA187", "#A8A800", "#D55E00")
"""From the lowest to the highest level of a second variable: hue and lightness change together."""
ROW_IN = 5.2
LOOKS = {0: ("o", "-"), 1: ("^", "-"), -1: ("v", "--")}
WAYS = {0: "", 1: ", moving +", -1: ", moving −"}
"""Marker, line and name of both directions together, and of each."""
LEAST_NOISE = 1e-4
"""Least noise that `rtec plan` takes, µm or µrad."""
NO_BETTER = 0.005
"""Smallest relative fall of the mean square that is shown."""
LONG = 24
"""Largest number of letters of a name on one line; longer names are on two lines."""


@as_png
def evidence_figure(rows: Sequence[Evidence], zooms: Sequence[Zoom] = ()) -> "MplFigure":
    """The residual and the part that the finding explains, one row a reading column.

    Args:
        rows: the evidence of each.
        zooms: the visible part of each; those without one are whole.
    """
    figure = canvas(ROW_IN * len(rows))
    parts = figure.subfigures(len(rows), 1, squeeze=False)[:, 0]
    for part, row, zoom in zip(parts, rows, [*zooms, *[WHOLE] * len(rows)][: len(rows)], strict=True):
        part.suptitle(row.title, x=0.01, ha="left", fontsize=17, fontweight="bold")
        if row.amplitudes:
            shapes, sizes = part.subplots(1, 2, width_ratios=(3, 2))
            _draw_curves(shapes, row, zoom)
            _draw_amplitudes(sizes, row.unit, row.amplitudes)
        elif row.causes:
            top, *others = part.subplots(1 + len(row.causes), 1, sharex=True, height_ratios=(3, *[1] * len(row.causes)))
            _draw_curves(top, row, zoom)
            top.set_xlabel("")
            _draw_causes(others, row)
        else:
            _draw_curves(part.subplots(), row, zoom)
    return figure


def _draw_curves(ax: "Axes", row: Evidence, zoom: Zoom) -> None:
    if not row.second:
        thin = slice(None, None, max(1, len(row.dots[0]) // MOST_DOTS))
        ax.plot(row.dots[0][thin], row.dots[1][thin], linestyle="", marker=".", markersize=5, color=GREY, alpha=0.25,
                label="residual of each reading")  # fmt: skip
    for curve, colour in zip(row.curves, _colours(row), strict=True):
        marker, line = LOOKS[curve.direction]
        # White behind the line separates it from the dots.
        ax.plot(curve.place, curve.part, color="white", linewidth=6.0)
        ax.plot(curve.place, curve.part, color=colour, linestyle=line, linewidth=3.0)
        if len(curve.place) <= MOST_MARKERS:
            ax.plot(curve.place, curve.residual, linestyle="-" if row.second else "", linewidth=1.0, color=colour,
                    marker=marker, markersize=9, markeredgecolor="white")  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_xlabel(row.below)
    ax.set_ylabel(f"residual, {row.unit}")
    for way in dict.fromkeys(c.direction for c in row.curves):
        marker, line = LOOKS[way]
        colour = GREY if row.second else OFF if way < 0 else ON
        if len(row.curves[0].place) <= MOST_MARKERS:
            ax.plot([], [], linestyle="", marker=marker, markersize=9, color=colour, label=f"mean residual{WAYS[way]}")
        ax.plot([], [], linestyle=line, color=colour, linewidth=3.0, label=f"explained{WAYS[way]}")
    room_above(ax, 0.3 if len(row.curves) > 1 and not row.second else 0.2)
    ax.legend(fontsize=13, loc="upper left", ncols=3, frameon=True, facecolor="white", edgecolor="none",
              framealpha=0.9, columnspacing=1.0, handletextpad=0.4)  # fmt: skip
    if row.second:
        _name_levels(ax, row)
    zoomed(ax, zoom)


def _draw_causes(axes: "Sequence[Axes]", row: Evidence) -> None:
    """Draw the channels that drive the finding, over the same time."""
    order = np.argsort(row.dots[0], kind="stable")
    for ax, (name, value) in zip(axes, row.causes, strict=True):
        ax.plot(row.dots[0][order], value[order], color=GREY, drawstyle="steps-post")
        ax.set_ylabel(name.replace(", ", ",\n"))
    axes[-1].set_xlabel(row.below)


def _name_levels(ax: "Axes", row: Evidence) -> None:
    """Write the value of the second variable at the end of its curve; moved up where two would overlap."""
    last = {c.level: (c, colour) for c, colour in zip(row.curves, _colours(row), strict=True) if c.level is not None}
    ends = sorted(last.items(), key=lambda item: float(item[1][0].part[-1]))
    values = [v for v, _ in ends]
    digits = decimals_of_step(min(np.diff(np.sort(values)), default=1.0))
    low, high = ax.get_ylim()
    heights = spread_out([float(c.part[-1]) for _, (c, _) in ends], 0.075 * (high - low))
    for (value, (_, colour)), height in zip(ends, heights, strict=True):
        ax.annotate(f"{value:.{digits}f}", (1.0, height), (6, 0), xycoords=ax.get_yaxis_transform(),
                    textcoords="offset points", ha="left", va="center", color=colour, fontweight="bold", fontsize=14,
                    annotation_clip=False)  # fmt: skip
    ax.set_title(row.second, loc="right", fontsize=14, fontweight="normal")


def spread_out(heights: Sequence[float], least: float) -> list[float]:
    """Rising heights with a distance of at least `least`, as near to the given ones as possible (least squares)."""
    step = least * np.arange(len(heights))
    level = np.asarray(heights, dtype=np.float64) - step
    # The nearest rising sequence: neighbours that would cross get their mean.
    blocks: list[list[float]] = []
    for value in level:
        blocks.append([float(value)])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    flat = [float(np.mean(b)) for b in blocks for _ in b]
    return [float(v) for v in np.asarray(flat) + step]


def decimals_of_step(step: float) -> int:
    """Number of decimals that shows a difference of one step."""
    return max(0, -math.floor(math.log10(max(step, 1e-6))))


def _colours(row: Evidence) -> list[str]:
    """Colours of the curves: by level where there is a second variable, else by direction."""
    if not row.second:
        return [OFF if c.direction < 0 else ON for c in row.curves]
    levels = sorted({c.level for c in row.curves if c.level is not None})
    spread = np.linspace(0, len(LEVEL_COLOURS) - 1, len(levels)).round().astype(int)
    return [LEVEL_COLOURS[spread[levels.index(c.level)]] for c in row.curves if c.level is not None]


def _draw_amplitudes(ax: "Axes", unit: str, a: Amplitudes) -> None:
    """Draw the size of the shape over the variable that sets it: dots from the residual, the line from the finding."""
    ax.plot(a.value, a.explained, color=OFF, linewidth=3.0, label="explained")
    ax.errorbar(a.value, a.measured, 2.0 * a.error, linestyle="", marker="o", markersize=9, color=ON,
                markeredgecolor="white", capsize=4, elinewidth=1.6, label="residual, ± 2 std. errors")  # fmt: skip
    ax.axhline(0.0, color="black", linewidth=1)
    ax.set_title("Height of this shape")
    ax.set_xlabel(a.below)
    ax.set_ylabel(f"lowest to highest, {unit}")
    room_above(ax, 0.25)
    ax.legend(fontsize=13, loc="upper left", frameon=True, facecolor="white", edgecolor="none", framealpha=0.9)


@as_png
def rivals(rows: Sequence[tuple[str, float, bool, str]], title: str) -> "MplFigure":
    """Bars of the share of the residual that each candidate explains on held-out runs, best on top.

    Args:
        rows: label, relative fall of the mean square, whether it belongs to the winner's group, and a short reason why
            it is preferred or not.
        title: above the bars.
    """
    figure, (ax,) = stacked(0.74 * len(rows) + 2.0)
    groups = (("named, or confounded with what is named", ON, ""), ("not preferred", "#BBBBBB", "//"))
    for place, (name, drop, chosen, why) in enumerate(reversed(rows)):
        label, colour, hatch = groups[0 if chosen else 1]
        ax.barh(place, 100.0 * max(drop, 0.0), 0.7, color=colour, hatch=hatch, edgecolor="white", label=label)
        said = f"{100.0 * drop:.0f} %" if drop >= NO_BETTER else "no better"
        ax.text(100.0 * max(drop, 0.0), place, f" {said}", va="center", fontsize=14)
        ax.text(0.97, place, fill(why, 22), va="center", fontsize=12, color=ON if chosen else GREY,
                linespacing=1.2, transform=ax.get_yaxis_transform())  # fmt: skip
        ax.text(-0.02, place, _on_two(name), va="center", ha="right", fontsize=13, linespacing=1.2,
                transform=ax.get_yaxis_transform())  # fmt: skip
    ax.set_yticks([])
    ax.set_xlim(0, 119)
    ax.set_xticks(range(0, 101, 20))
    figure.suptitle(title, x=0.01, ha="left", fontsize=17, fontweight="bold")
    ax.set_xlabel("fall of the mean square residual on held-out runs, %")
    ax.grid(visible=False, axis="y")
    # One entry each, in the order of the list, above the bars, where there is always room.
    handles, names = ax.get_legend_handles_labels()
    once = dict(zip(names, handles, strict=True))
    kept = [n for n, _, _ in groups if n in once]
    ax.legend([once[n] for n in kept], kept, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False,
              fontsize=13, borderaxespad=0.2)  # fmt: skip
    return figure


def _on_two(name: str) -> str:
    """A long label, broken into two lines at the bracket."""
    return name.replace("(", "\n(", 1) if len(name) > LONG else name


SHOWN, WHERE, BRIEF = 8, 5, 3
BETTER = 0.005
"""Smallest relative fall of the mean square that is shown."""


def _beside(d: Diagnosis) -> str:
    """What the files hold and the diagnosis does not use."""
    if d.judged is None:
        return ""
    read = d.judged.readings.measurements
    return unread_beside(read, d.doubts) + not_logged_beside(read)


def diagnosis_page(d: Diagnosis, figures: bool = True) -> Page:
    """The page.

    Args:
        d: the diagnosis.
        figures: whether to draw.
    """
    unit = ERROR_UNITS[d.unit]
    residual, floor = sizes(d.rms_residual, d.noise_floor)
    return Page(
        title="Which effect is missing",
        lead=sentence(d.sentence) + _beside(d),
        numbers=[
            (f"{residual}\u00a0{unit}", "residual of the model"),
            (f"{floor}\u00a0{unit}", "noise floor"),
            *_weight(d),
        ],
        sections=[
            *_to_type(d),
            *_evidence(d, figures),
            *_confused(d),
            *_undetected(d),
            *_untestable(d),
            Section("How the readings were treated", [*map(sentence, d.notes), *(f"{n}." for n in d.noise)]),
        ],
        foot=[
            "Held-out runs: each part of the runs is predicted by the fit to all others.",
            f"rtec {__version__}, rtec diagnose, seed {d.seed} of the random draws.",
        ],
        brief=Section("", [], _brief(d)),
        next=_next(d),
    )


def _weight(d: Diagnosis) -> list[tuple[str, str]]:
    """How sure the answer is: a number and its words."""
    if d.together:
        by = "all together" if len(d.together) > 1 else d.together[0].label
        return [(percent(d.together[-1].heldout_drop), f"of the held-out mean square error, removed by {by}")]
    if not d.group:
        return []
    alike = indistinguishable(d)
    if len(alike) > 1:
        return [(f"1 of {len(alike)}", "effects that these data cannot distinguish")]
    return [(probability(d.findings[0].confidence), "probability of the first candidate")]


def _together(d: Diagnosis) -> Table:
    """Table of the effects that are missing together."""
    names = labels([m.fitted for m in d.together])
    rows = [
        [name, percent(max(m.heldout_drop, 0.0)), " or ".join(rivals_of(m, d)[:2]) or "no other"]
        for m, name in zip(d.together, names, strict=True)
    ]
    caption = "Falls by: share of the held-out mean square error, with the effects above it. One by one: --full."
    return Table(("missing together", "falls by", "or in its place"), rows, caption, words=(0, 2))


def _brief(d: Diagnosis) -> Table | None:
    """Table of the first candidates; None where there are none, or the record is in doubt."""
    if not d.findings or any(b.blames_no_effect for b in d.doubts):
        return None
    if len(d.together) > 1:
        return _together(d)
    shown = d.findings[:BRIEF]
    rows = [
        [
            label,
            number(f.size_um, decimals(d.noise_floor)),
            percent(max(f.heldout_drop, 0.0)),
            probability(f.confidence),
        ]
        for f, label in zip(shown, labels(shown), strict=True)
    ]
    head: tuple[str, ...] = ("candidate", f"explains, {ERROR_UNITS[d.unit]}", "held-out error falls by", "probability")
    # Too few runs decide: drift explains them as well. What has no name is in no probability.
    if d.runs is not None or d.verdict == "unknown_effect":
        head, rows = head[:-1], [r[:-1] for r in rows]
    more = f" {counted(len(d.findings) - BRIEF, 'more candidate')} with --full." if len(d.findings) > BRIEF else ""
    caption = " ".join(filter(None, ["Falls by: share of the mean square.", _less_likely_first(d)]))
    return Table(head, rows, caption + more)


def _less_likely_first(d: Diagnosis) -> str:
    """Why the first candidate is named though another is likelier; empty where none is, or none is named."""
    first, *others = d.findings
    if not first.accepted or all(f.confidence <= first.confidence for f in others):
        return ""
    if d.together:
        return "Probability: that it is all that is missing; the first is named beside what has no name."
    return (
        "The first is less probable. It comes first because it has fewer numbers, is what the instrument reads, or "
        "predicts held-out runs better."
    )


def _next(d: Diagnosis) -> list[str]:
    """Commands that add the effect, separate the rivals, or refit the model."""
    if not d.files:
        return []
    model, *data = d.files
    last = ("-o", f"{model.with_suffix('')}-more.toml", *d.machine_option)
    if d.verdict == "unknown_effect":
        typed = by_expression(d, d.files, d.machine_option)
        if typed or not d.refits_changed:
            return typed  # which refits the model's numbers as well
    if d.refits_changed:
        return [shell_command("rtec", "improve", *d.files, *last)]
    sure = d.verdict == "missing_effect" or any(doubt.kind == "too_few" for doubt in d.doubts)
    if d.verdict == "ambiguous" and len(d.together) < 2:
        rivals = _rivals(d) if d.machine_file is not None else []
        if rivals:
            noise = [] if d.unit == "noise" else ["--noise", f"{float(f'{max(d.noise_floor, LEAST_NOISE):.2g}'):g}"]
            chosen = ",".join(rivals[:BRIEF])
            return [shell_command("rtec", "plan", d.machine_file, *data, "--rivals", chosen, *noise)]
        first = d.findings[0]
        names = {(a.effect, a.component) for a in first.confused_with if not a.apart}
        if names - {(first.effect.effect, first.effect.component)}:
            return []  # of a rival that is not in the catalogue: the sentence says what to do
        sure = not d.together  # together: forms of one effect, which is missing in any case
    # `rtec add` searches a period or a delay again; `rtec improve` begins with the one that was found.
    if sure and d.findings[0].partner is None and len(d.together) < 2 and not d.findings[0].theta:
        return [shell_command("rtec", "add", model, *as_options(d.findings[0].effect), "--data", *data, *last)]
    if d.verdict == "undecided" or (d.verdict == "nothing_missing" and not d.out_of_date and not d.within_errors):
        return []
    return [shell_command("rtec", "improve", *d.files, *last)]


def _rivals(d: Diagnosis) -> list[str]:
    """Rank 1 and what it is confounded with, as `rtec plan --rivals` reads them: each cause with its numbers.

    None where all have one name: that effect is missing in any case.

    A rival that is no candidate of the catalogue is not among them: no text describes it.
    """
    out: dict[tuple[str, ...], str] = {}
    for f in same_part(d):
        out.setdefault(_cause(f.effect), as_text(f.effect, _numbers(f)))
    for a in d.findings[0].confused_with:
        if not a.apart and a.fitted is not None:
            out.setdefault(_cause(a.fitted.effect), as_text(a.fitted.effect, _sizes(a.fitted)))
    return list(out.values()) if len({cause[:2] for cause in out}) > 1 else []


def _cause(effect: Effect) -> tuple[str, ...]:
    """What separates two causes: the name, the component and the sensors; two forms of an effect are one cause."""
    return effect.effect, effect.component, *(str(getattr(effect, k, None)) for k in ("sensor", "front", "back"))


def _sizes(f: FittedEffect) -> dict[str, float]:
    """Coefficients other than zero, to three digits, and non-linear parameters of an effect."""
    return {k: float(f"{v:.3g}") for k, v in f.values.items() if v} | dict(f.theta)


def _numbers(f: Finding) -> dict[str, float]:
    """Coefficients, to three digits, and non-linear parameters of a candidate."""
    return {k: float(f"{n.value:.3g}") for k, n in f.parameters.items()} | dict(f.theta)


def _evidence(d: Diagnosis, figures: bool) -> list[Section]:
    out = []
    if d.picture is not None and d.picture.drivers and figures:
        p = d.picture

        png = evidence_figure([evidence(q) for q in (p, *p.others) if q.drivers])
        shows = "The residual against its driver, with the fitted effect."
        out.append(Section("Residual and fitted effect", [], None, Figure("evidence.png", png, shows)))
        out += [on_its_circle(q, q.circle) for q in (p, *p.others) if q.circle is not None]
    if not d.findings:
        return [*out, Section("Candidates", ["Noise alone would give as good a fit as the best of them."])]
    figure, rows = None, bars(d) if figures else []
    if any(drop >= NO_BETTER for _, drop, _, _ in rows):  # else there is no bar to look at
        title = ADDED_UP if len(d.together) > 1 else EACH_ALONE
        figure = Figure("rivals.png", rivals(rows, title), "Fall of the held-out error with each candidate.")
    return [*out, Section("Candidates, best first", _candidate_words(d), _candidates(d), figure)]


EACH_ALONE = "How much of the residual each candidate explains, and how likely it is"
ADDED_UP = "How much of the residual is explained, effect by effect"


def bars(d: Diagnosis) -> list[tuple[str, float, bool, str]]:
    """Rows of `rivals`: the candidates, or the effects that are named together; none where the record is in doubt."""
    if any(b.blames_no_effect for b in d.doubts):
        return []
    if len(d.together) > 1:
        names = labels([m.fitted for m in d.together])
        words = ["alone", *("with those above it" for _ in names[1:])]
        return [(n, m.heldout_drop, True, w) for m, n, w in zip(d.together, names, words, strict=True)]
    shown = d.findings[:SHOWN]
    return [(n, f.heldout_drop, f.group, _short(d, f)) for f, n in zip(shown, labels(shown), strict=True)]


def on_its_circle(p: Picture, circle: OnCircle) -> Section:
    """The residual of a ball bar on its circle."""
    from rtec.report.ball_bar_figures import CircleTrace
    from rtec.report.compare_figures import polar_pair

    trace = CircleTrace("", circle.sense, circle.angle_rad, p.residual, p.part)
    names = ("residual before", "fitted effect", "residual after")
    png = polar_pair(p.title, circle.letters, trace, names)
    shows = "Residual and fitted effect drawn outwards from the circle; beside it what is then the residual."
    file = name_of_file(p.place)
    return Section(f"On the circle: {p.title}", [], None, Figure(f"polar-{file}.png", png, shows))


def by_expression(d: Diagnosis, files: Sequence[Path], machine_option: Sequence[str]) -> list[str]:
    """The command that adds what has no name as an expression; empty where there is none.

    Args:
        d: the diagnosis.
        files: the model, then the measurements.
        machine_option: `--machine` and its file, where the command needs them.
    """
    u = d.unknown
    if u is None or not u.expression:
        return []
    model, *data = files
    given = ["rtec", "add", model, "--expr", u.expression, *(word for p in u.parameters for word in ("--param", p))]
    given += ["--component", u.feeds, "--data", *data, "-o", f"{model.with_suffix('')}-more.toml", *machine_option]
    return [shell_command(*given)]


def _to_type(d: Diagnosis) -> list[Section]:
    """The command that adds an effect without a name as an expression."""
    command = by_expression(d, d.files or (Path("MODEL"), Path("MEASUREMENT")), d.machine_option)
    if not command:
        return []
    words = [
        "The nearest simple expression; `rtec add` refuses it if the error on held-out runs does not fall:",
        *command,
        "It describes the shape of the error, not its cause.",
    ]
    return [Section("To add it without a name", words)]


def _candidate_words(d: Diagnosis) -> list[str]:
    first, out = d.findings[0], []
    chance = f"Of random draws under noise alone, {percent(first.p)} give as good a fit of any effect of the catalogue."
    if first.accepted:
        out.append(chance)
        if d.adequacy is not None and d.adequacy < 1.0:
            out.append(f"It explains {percent(d.adequacy)} of what the best smooth or periodic shape would explain.")
    else:
        out.append(f"None of them passed: rank 1 {_doubt(d, first)}.")
    if any(n.se is None for f in d.findings for n in list(f.parameters.values())[:MOST_NUMBERS]):
        out.append(f"A number shown as {NONE} is not determined by these data.")
    return out


def _candidates(d: Diagnosis) -> Table:
    unit = ERROR_UNITS[d.unit]
    rows = [
        [
            f"{f.rank}",
            label,
            fitted_numbers(f),
            number(f.size_um, decimals(d.noise_floor)),
            percent(f.heldout_drop) if f.heldout_drop >= BETTER else "does not fall",
            probability(f.confidence),
            "accepted" if f.accepted else f.why_not or f"not accepted: {_doubt(d, f)}",
        ]
        for f, label in zip(d.findings, labels(d.findings), strict=True)
    ]
    head = ("", "effect", "numbers", f"explains, {unit}", "held-out error falls by", "probability", "")
    caption = (
        "Held-out error: mean square on held-out runs. Probability: among these candidates, each by itself, and "
        "'nothing is missing'; an effect that none of them describes is not in it."
    )
    return Table(head, rows, caption, words=(1, 2, 6))


def _doubt(d: Diagnosis, f: Finding) -> str:
    """Reason why a candidate was not accepted."""
    if f.heldout_drop <= 0.0:
        return "does not lower the error on held-out runs or targets"
    if d.unknown is not None and d.adequacy is not None:
        return f"explains only {percent(max(d.adequacy, 0.0))} of what a shape without a name does"
    if any(b.blames_no_effect for b in d.doubts):
        return "no effect is named beside a record in doubt"
    if f.p >= ALPHA:
        return f"is as good in {percent(f.p)} of random draws under noise alone"
    return "the evidence for it is below 20 to 1 beyond that of any effect at all"


def _short(d: Diagnosis, f: Finding) -> str:
    """Short reason why a candidate is preferred or not, for its bar."""
    if f.rank == 1 and f.accepted:
        return f"probability {probability(f.confidence)}"
    return (f.why_not or _doubt(d, f)).removesuffix(" than rank 1").removesuffix(" from these data")


def _confused(d: Diagnosis) -> list[Section]:
    if not d.group or not d.findings[0].confused_with:
        return []
    alikes, head = d.findings[0].confused_with, ("effect", "why", "test")
    rivals = [[a.label, a.why, a.separating_test] for a in alikes if not a.apart]
    beside = [[a.label, a.why, a.separating_test] for a in alikes if a.apart]
    words = ["These effects cannot be distinguished from rank 1 by these data; the test on the right separates them."]
    out = [Section("Confounded with rank 1", words, Table(head, rivals, words=(0, 1, 2)))] if rivals else []
    if beside:
        table = Table(("effect", "why", "what to do"), beside, words=(0, 1, 2))
        out.append(Section("What may be missing besides", [], table))
    return out


def _undetected(d: Diagnosis) -> list[Section]:
    if not d.absent:
        return []
    smallest: dict[str, tuple[float, float, set[str]]] = {}
    for a in d.absent:
        low, high, where = smallest.get(a.effect, (math.inf, 0.0, set()))
        smallest[a.effect] = (min(low, a.smallest), max(high, a.smallest), {*where, a.component})
    rows = [
        [name, number(low), number(high), ", ".join(sorted(where)[:WHERE]) + (" …" if len(where) > WHERE else "")]
        for name, (low, high, where) in sorted(smallest.items())
    ]
    unit = ERROR_UNITS[d.unit]
    head = ("effect", f"found from, {unit}", f"to, {unit}", "tested in")
    words = ["Tested and not found, with the size in the readings (root mean square) from which it would be found."]
    return [Section("Tested and absent", words, Table(head, rows, words=(0, 3)))]


def _untestable(d: Diagnosis) -> list[Section]:
    if not d.not_testable:
        return []
    seen: dict[tuple[str, str], list[str]] = {}
    faint: dict[str, list[NotTestable]] = {}
    for n in d.not_testable:
        if n.usual is None or n.smallest is None:
            seen.setdefault((n.why, n.test), []).append(n.effect)
        else:
            faint.setdefault(n.effect, []).append(n)
    rows = [[", ".join(dict.fromkeys(names)), why, test] for (why, test), names in seen.items()]
    rows += [_hardly(name, of, d.unit) for name, of in faint.items()]
    words = ["These readings could not show them, or only at far more than their usual size."]
    head = ("effect", "why not", "what would show it")
    return [Section("Not testable with these readings", words, Table(head, rows, words=(0, 1, 2)))]


def _hardly(name: str, of: Sequence[NotTestable], unit: str) -> list[str]:
    """One row for an effect, for all its components together."""
    where = sorted({n.component for n in of})
    named = f"{name}({', '.join(where[:WHERE])}{' …' if len(where) > WHERE else ''})"
    usual, smallest = [n.usual or 0.0 for n in of], [n.smallest or 0.0 for n in of]
    return [named, hardly(usual, smallest, unit), of[0].test]
