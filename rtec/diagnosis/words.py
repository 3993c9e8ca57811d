"""The verdict of a diagnosis in one sentence, and units and channels in words for people.

Files and JSON keep the codes.
"""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

from rtec.diagnosis.result import REFIT, Alike, Diagnosis, Finding, Member
from rtec.effects import Effect
from rtec.effects.time_data import MissedCounts
from rtec.estimation.joint import ChangedNumber
from rtec.estimation.warmth import Warmer
from rtec.model import FittedEffect
from rtec.wording import (
    ERROR_UNITS,
    NONE,
    counted,
    duration,
    listed,
    number,
    percent,
    significant,
    sizes,
    two_numbers,
    with_error,
)

ABOVE = 1.5
"""Residual, in noise floors, above which the sentence gives the part that is slow drift."""
WORDS = {
    "um": "µm", "urad": "µrad", "degc": "K", "degC": "°C", "deg": "°", "krpm": "(1000/min)", "kn": "kN",
    "100kg": "(100 kg)", "1": "", "krpm2": "(1000/min)²", "krpm_to_p": "(1000/min)^p", "s2": "s²", "m2": "m²",
    "mm/s2": "mm/s²", "noise": "× noise",
}  # fmt: skip
NAMED = {
    "spindle_rpm": "spindle speed, rpm",
    "load_kg": "load, kg",
    "force_n": "force, N",
    "feed_mm_min": "feed, mm/min",
    "time_s": "time, s",
    "angle_deg": "angle on the circle, degrees",
    "run": "run",
}
OF_AXIS = {
    "d": "last direction of {}",
    "v": "velocity of {}, mm/s",
    "a": "acceleration of {}, mm/s²",
    "s": "distance since {} turned round, mm",
}


def spoken(unit: str) -> str:
    """A unit for people: `um_per_m_degc` is µm/(m·K), `degC` °C, and `1` nothing."""
    if unit.endswith("krpm_to_p"):
        return f"{WORDS[unit.split('_', maxsplit=1)[0]]}/(1000/min)^p"
    above, _, below = f"_{unit}".partition("_per_")
    above = above.removeprefix("_")
    top = "·".join(WORDS.get(w, w) for w in above.split("_") if w)
    parts = [WORDS.get(w, w) for w in below.split("_")] if below else []
    if not parts:
        return top
    return f"{top or '1'}/{parts[0]}" if len(parts) == 1 else f"{top or '1'}/({'·'.join(parts)})"


def fitted_numbers(f: Finding) -> str:
    """The first fitted numbers of a candidate with their standard errors and units; no value where undetermined."""
    parts = []
    for name, n in f.parameters.items():
        if n.se is None:  # not determined by these data
            parts.append(f"{name} {NONE}")
            continue
        value, se = with_error(n.value, n.se)
        parts.append(f"{name} {value}{'' if se == NONE else f' ± {se}'} {spoken(n.unit)}".strip())
    return "; ".join(parts[:MOST_NUMBERS]) + (" …" if len(parts) > MOST_NUMBERS else "")


def titled(channel: str, unit: str = "") -> str:
    """A channel as the title of a figure's axis: `x` is "X, mm", `s_y` "distance since Y turned round, mm".

    Args:
        channel: name of the channel.
        unit: its code, where it is known: a sensor may have any name.
    """
    if unit == "degC" or channel.startswith("T_"):
        return f"{channel}, °C"
    if channel in NAMED:
        return NAMED[channel]
    head, mark, rest = channel.partition("_")
    if mark and head in OF_AXIS:
        return OF_AXIS[head].format(rest.upper())
    return f"{channel.upper()}, mm"


def named(channel: str) -> str:
    """A channel within a sentence: the title without its unit."""
    return titled(channel).rpartition(", ")[0] or titled(channel)


A_STEP, A_STEP_BETWEEN = "a step at", "a step between"
"""So begins the place of a single step; of one that is over between two targets."""
LITTLE = 2.0
"""The readings show little where half of the tested effects are detected only above this many times the residual."""
TOGETHER = "to be added together with rank 1"
NONE_SETTLES = "none of the usual tests on this machine settles it alone"
AMONG = "named together with rank 1"
BESIDE = "explains another part than rank 1; may be missing too"
NO_BETTER_BESIDE = "beside rank 1 it does not lower the error on held-out runs"
OF_NO_MACHINE = "describes the same, but would have a size that no machine has"
MOST_NUMBERS = 4


def with_sentence(d: Diagnosis, smallest: float, odd: Sequence[str] = (), foreign: Sequence[str] = ()) -> Diagnosis:
    """The diagnosis with its verdict in one sentence.

    Args:
        d: without a sentence.
        smallest: size from which on half of the searched effects would have been detected.
        odd: readings of the wrong sign or unit, in words.
        foreign: sentences that follow: on files that may be of another machine, on the air of a beam.
    """
    if odd and d.verdict == "undecided":
        return replace(d, sentence=" ".join([*odd, *_until_then(d)]))
    verdict = _sentence(d, smallest) + _beside_instrument(d)
    verdict = " ".join([sentence(verdict), *of_files(foreign)]) if foreign else verdict
    return replace(d, sentence=f"{odd[0]} Correct that first; until then: {verdict}" if odd else verdict)


def of_changes(changed: Sequence[ChangedNumber], sure: bool = True) -> str:
    """Numbers of a model that have changed, before and now, in words; or only seem so beside what is missing."""
    parts = list(map(_moved, changed))
    more = f" and {len(parts) - MOST_CHANGED} more" if len(parts) > MOST_CHANGED else ""
    have = "have" if sure else "seem to have"
    return f"Numbers of the model {have} changed since it was fitted: {', '.join(parts[:MOST_CHANGED])}{more}"


def _moved(c: ChangedNumber) -> str:
    pair = f"{' to '.join(two_numbers(c.was, c.now))} {spoken(c.unit)}"
    if c.unit == "s":
        pair = f"{duration(c.was)} to {duration(c.now)}"
    moved, off = f"{c.effect} {c.name} from {pair}", c.misread
    if off is None or off.shown:
        return moved
    return f"{moved} (or {off.sensor} reads {abs(off.by_k):.2f} K {'more' if off.by_k > 0.0 else 'less'} than then)"


def of_warmth(changed: Sequence[ChangedNumber]) -> str:
    """That parts are warmer than in the fit, so that numbers only look changed; empty where none are."""
    found = [(c.effect, c.warmer) for c in changed if c.warmer is not None]
    alike, decided = ([_warmer(e, w) for e, w in found if bool(w.effect) == sure] for sure in (False, True))
    open_ = [f"{'; '.join(alike)}. A measurement at one more temperature decides."] if alike else []
    return "".join(f" {text}" for text in (*(f"{t}." for t in decided), *open_))


def of_sensors(changed: Sequence[ChangedNumber]) -> str:
    """That sensors may read too high or too low, so that numbers only look changed; empty where none do."""
    return "".join(
        f" {c.misread.sensor} stands apart from the other temperatures by more than in the fit: if it reads "
        f"{significant(abs(c.misread.by_k), 2)} K too {'high' if c.misread.by_k > 0.0 else 'low'}, {c.effect} has not "
        "changed. Hold it beside another thermometer."
        for c in changed
        if c.misread is not None and c.misread.shown
    )


def _warmer(scale: str, w: Warmer) -> str:
    is_so = f"{w.sensor} is {significant(abs(w.by_k), 2)} K {'warmer' if w.by_k > 0.0 else 'colder'} than in the fit"
    growth = f"{significant(w.growth, 2)} µm/(m·K)"
    if w.leaves is None:
        return f"{is_so}: an expansion of {growth} would look like the change of {scale}"
    rivals = f" (or {' or '.join(w.rivals)})" if w.rivals else ""
    if not w.sure:
        return (
            f"{is_so}: {w.effect} of {growth}{rivals} in place of the change of {scale} leaves as little, "
            f"{number(w.leaves)}, and is likelier; a measurement at one more temperature decides"
        )
    return (
        f"{is_so}: {w.effect} of {growth}{rivals} in place of the change of {scale} leaves only {number(w.leaves)}; "
        "`rtec improve` adds it if it predicts held-out runs better, too"
    )


def with_changes_beside(d: Diagnosis, changed: Sequence[ChangedNumber]) -> Diagnosis:
    """The diagnosis with numbers of the model that have changed, as only what is named beside them shows."""
    parts = ", ".join(map(_moved, changed[:MOST_CHANGED]))
    return replace(
        d, sentence=f"{sentence(d.sentence)} Beside what is named, numbers of the model have changed: {parts}."
    )


def with_changes(d: Diagnosis, changed: Sequence[ChangedNumber], rms: float, held_out: float) -> Diagnosis:
    """The diagnosis with numbers of the model that have changed, and the residual with them, in its sentence.

    Args:
        d: the diagnosis.
        changed: the numbers.
        rms, held_out: residual with them, and on held-out runs.
    """
    if not changed:
        return d
    before, after = two_numbers(d.rms_residual, rms)
    unit = ERROR_UNITS[d.unit]
    warmed = any(c.warmer is not None and c.warmer.effect for c in changed)
    only = d.verdict == "nothing_missing" and not warmed and d.out_of_date and REFIT * rms < d.refit
    d = replace(d, changed=tuple(changed), changed_rms=rms, changed_held_out=held_out)
    sure = d.mostly_changed or d.verdict in ("nothing_missing", "undecided")
    text = (
        f"{of_changes(changed, sure)}; with these alone the residual falls from {before} to {after} {unit}"
        f"{f' {REFITS}' if only else ''}." + of_warmth(changed) + of_sensors(changed)
    )
    text += "" if sure else " What is missing may look the same: add it first."
    asked = of_files([b.message for b in d.doubts if b.kind == "other_machine"])
    if d.verdict == "nothing_missing" and warmed:
        return replace(d, verdict="undecided", sentence=" ".join([text, *asked]))
    if only:
        slow = drifts(d) if d.judged is not None and d.judged.drift < rms else ""
        answer = f"No effect is missing; the noise floor is {number(d.noise_floor)} {unit}{slow}."
        return replace(d, sentence=" ".join([text, answer, *asked]))
    order = (text, sentence(d.sentence)) if d.mostly_changed else (sentence(d.sentence), text)
    return replace(d, sentence=" ".join(order))


def within_errors(d: Diagnosis) -> Diagnosis:
    """The diagnosis where a refit would lower the residual, but by no number that has changed beyond its error."""
    if d.verdict != "nothing_missing" or not d.out_of_date:
        return d
    text = d.sentence.replace(
        _out_of_date(d),
        f"and no number of the model has changed by more than its error: {_levels(d)}; refitted to these readings the "
        f"residual is {number(d.refit)} {ERROR_UNITS[d.unit]}, which may follow the drift of this record alone",
    )
    return replace(d, sentence=text, within_errors=True)


def _out_of_date(d: Diagnosis) -> str:
    """That no effect but a refit would lower the residual: the part of a sentence."""
    moved = d.judged.most_moved if d.judged is not None else None
    above_all = f", above all {_moved(moved)}" if moved is not None else ""
    return (
        f"but the model's numbers are out of date{above_all}: {_levels(d)}; refitted to these readings the residual is "
        f"{number(d.refit)} {ERROR_UNITS[d.unit]} {REFITS}"
    )


def _levels(d: Diagnosis) -> str:
    residual, floor = sizes(d.rms_residual, d.noise_floor)
    unit = ERROR_UNITS[d.unit]
    return f"the residual is {residual} {unit}, the noise floor {floor} {unit}"


REFITS = "(`rtec improve` refits them)"
"""Advice of a diagnosis; `rtec improve` itself does not give it."""
MOST_CHANGED = 4
FOREIGN = re.compile(r"(The model leaves )(.+? of .+?)(, and left .+)", re.DOTALL)


def of_files(texts: Sequence[str]) -> list[str]:
    """The same texts on files that may be of another machine; those that differ in the file only are one, of all files.

    Args:
        texts: each on one file.
    """
    groups: dict[str, list[str]] = {}
    for text in texts:
        match = FOREIGN.fullmatch(text)
        groups.setdefault(match[3] if match else text, []).append(match[2] if match else "")
    out = []
    for rest, files in groups.items():
        many = rest
        for one, other in ("the file is of", "the files are of"), ("whether it is of", "whether they are of"):
            many = many.replace(one, other) if len(files) > 1 else many
        out.append(f"The model leaves {listed(files)}{many}" if files[0] else rest)
    return out


def _until_then(d: Diagnosis) -> list[str]:
    """Sentences on what is named beside a doubt that decides nothing."""
    if not accepted(d.findings):
        return []
    f = d.findings[0]
    part = _of_the_residual(f.size_um, d, ERROR_UNITS[d.unit])
    return [f"Until then: {f.label} explains {part}, which may be a part of that growth."]


def _sentence(d: Diagnosis, smallest: float) -> str:
    unit = ERROR_UNITS[d.unit]
    if d.together:
        return _together(d)
    if d.verdict == "missing_effect":
        return _missing(d, unit)
    if d.verdict == "ambiguous":
        return _one_of(d)
    if d.runs is not None:
        return (
            f"the runs differ by {number(d.runs.size)} {unit}, more than their readings scatter; "
            f"{d.findings[0].label} may explain it (adding it removes {percent(d.findings[0].heldout_drop)} of the "
            f"held-out mean square error), but {d.runs.count} runs are too few to name it. "
            f"This test decides: {d.runs.test}"
        )
    if d.verdict == "unknown_effect" and d.unknown is not None:
        where = " and ".join(map(named, d.unknown.channels))
        period = d.unknown.period
        periods = " or ".join(significant(p, 4) for p in (period.value, *d.unknown.aliases_mm)) if period else ""
        how = f"with a period of {periods} {spoken(period.unit)} " if period else "smoothly "
        at = f", {d.unknown.where}" if d.unknown.where else ""
        if d.unknown.shape == "steps":
            how, at = ("", f", with {d.unknown.where}") if at else ("in steps ", "")
        elif d.unknown.where.startswith((A_STEP, A_STEP_BETWEEN)):
            how, at = "", f", with {d.unknown.where}"
        if d.unknown.step_mm is not None:
            at += f"; targets every {d.unknown.step_mm:.4g} mm show these periods alike, unequal steps do not"
        near = "; it rises with time in this record, so a drift would look alike" if d.unknown.with_time else ""
        if d.findings and d.adequacy is not None:
            share = percent(max(d.adequacy, 0.0))
            near += f"; the closest effect, {d.findings[0].label}, explains {share} of what can be explained"
        text = f"an effect is missing that is not in the catalogue: the residual depends {how}on {where}{at}{near}"
        return text + _within(d) + _by_feed(d) + _by_heat(d)
    slow = drifts(d)
    if d.out_of_date:
        return f"no effect is missing, {_out_of_date(d)}{slow}"
    limit = ""
    if math.isfinite(smallest):
        size = f"from {significant(smallest, 2)} {unit} on"
        little = smallest > LITTLE * d.rms_residual
        limit = (
            f" (they show little: half of the effects tested only {size})"
            if little
            else f" (half of those tested {size})"
        )
    return f"no effect is missing that these readings could show{limit}: {_levels(d)}{slow}"


def _missing(d: Diagnosis, unit: str) -> str:
    """One effect, or two that show only together, and what adding them removes."""
    f = d.findings[0]
    if f.partner is not None:
        both = zip([f, f.partner], labels([f, f.partner]), strict=True)
        one, other = (in_full(name, t.effect, t.theta) for t, name in both)
        return (
            f"{one} and {other} are missing together, neither lowers the error on held-out runs alone: adding "
            f"both removes {percent(f.heldout_drop)} of the held-out mean square error{other_parts(f)}"
        )
    removes = f"removes {percent(f.heldout_drop)} of the held-out mean square error"
    if f.heldout_drop <= 0.0:  # held-out runs are predicted better about the mean of each
        removes = "does not lower the error on held-out runs, most of which is between runs"
    return (
        f"{in_full(f.label, f.effect, f.theta)} is missing: it explains {_of_the_residual(f.size_um, d, unit)}, "
        f"and adding it {removes}{_same_jump(f)}{_form_and_more(d)}{other_parts(f)}"
    )


def in_full(label: str, effect: Effect, theta: Mapping[str, float]) -> str:
    """The name of an effect, with what a name does not tell: the period of a wave, the kink of a stretched screw."""
    if getattr(effect, "stretched", False):
        return f"{label} of a stretched screw that is slack from {theta['T0']:.1f} °C on"
    key = next((n for n in ("period", "pitch") if n in theta), None)
    if key is None or f", {key} " in label:
        return label
    return f"{label} with a period of {significant(theta[key], 4)} mm"


def drifts(d: Diagnosis) -> str:
    """Where the residual is far above the noise: how much of it is slow drift, as the end of a sentence."""
    if d.judged is None or d.rms_residual <= ABOVE * d.noise_floor or d.judged.drift <= d.noise_floor:
        return ""
    return f"; {number(d.judged.drift)} {ERROR_UNITS[d.unit]} is slow drift that no recorded channel explains"


def other_parts(f: Finding) -> str:
    """That the readings do not show which part an effect is of; empty where no other is the same, or it is a rival."""
    named = {a.component for a in f.confused_with}
    others = [c for c in f.same_components if c not in named]
    if not others:
        return ""
    more, are = (f" and {len(others) - 1} more", "are") if len(others) > 1 else ("", "is")
    same = f"{others[0]}{more} {are} the same as {f.effect.component} in these readings"
    return f"; {same}: they do not show which part moved"


def _same_jump(f: Finding) -> str:
    """What else makes a jump that lasts to the end of the record; empty for any other effect."""
    jump = isinstance(f.effect, MissedCounts)
    return "; a display that was zeroed again, or a set-up that was touched, makes the same jump" if jump else ""


FEW = 2
"""Number of effects up to which the sentence gives the share of each."""


def _together(d: Diagnosis) -> str:
    """Effects that are missing together, what each removes, and the residual without a name."""
    falls = [after - before for before, after in pairwise([0.0, *(m.heldout_drop for m in d.together)])]
    # One that is larger without the next has no share of its own; of many the table has the shares.
    apart = min(falls) >= 0.0 and len(falls) <= FEW
    parts = []
    labelled = zip(d.together, labels([m.fitted for m in d.together]), strict=True)
    names = [in_full(name, m.fitted.effect, m.fitted.theta) for m, name in labelled]
    members = list(zip(d.together, names, falls, strict=True))
    for m, name, fall in sorted(members, key=lambda t: -t[2]) if min(falls) >= 0.0 else members:
        removes = [f"{percent(fall)} of the held-out mean square error"] if apart else []
        others = rivals_of(m, d)
        either = [f"or {' or '.join(others[:2])} in its place"] if others else []
        parts.append(" ".join([name, *([f"({', '.join(removes + either)})"] if removes + either else [])]))
    if not apart and len(parts) > 1:
        parts[-1] += (
            f", which together remove {percent(d.together[-1].heldout_drop)} of the held-out mean square error,"
        )
    are = "is" if len(parts) == 1 else "are"
    named_so = listed(parts)
    if d.unknown is None:
        return f"{named_so} {are} missing{other_parts(d.findings[0])}"
    where = " and ".join(map(named, d.unknown.channels))
    same = other_parts(d.findings[0])
    text = f"{named_so} {are} missing{same}; what stays has no name in the catalogue and depends on {where}"
    return text + _within(d) + _by_feed(d) + _by_heat(d)


def rivals_of(m: Member, d: Diagnosis) -> list[str]:
    """What may be missing in the place of one of several effects, and is not named beside it anyway."""
    there = {other.label for other in d.together}
    return [r for r in m.rivals if r not in there]


def _beside_instrument(d: Diagnosis) -> str:
    """The sentences on an instrument that may be warming up, after what is named beside it."""
    named_beside = [b.words.rstrip(".") for b in d.doubts if b.kind == "instrument_warm_up" and not b.fatal]
    return "".join(f". {text}" for text in named_beside) if accepted(d.findings) else ""


def _within(d: Diagnosis) -> str:
    """The sentence on the range of the temperatures, loads and speeds of a proposed expression; empty for none."""
    ranges = d.unknown.within if d.unknown is not None else ()
    parts = [
        f"{named(n)} {significant(low)} to {significant(high)} {unit_of_channel(n) if n in NAMED else '°C'}"
        for n, low, high in ranges
    ]
    return (
        f". The proposed expression holds only in the range of these readings: {' and '.join(parts)}" if parts else ""
    )


def _by_feed(d: Diagnosis) -> str:
    """The sentence on an effect of the feed alone: without velocities no effect of these was tested."""
    if d.unknown is None or "feed_mm_min" not in d.unknown.channels:
        return ""
    return (
        ". Effects of the velocity were not tested: these readings have a feed, and no velocity that changes. If the "
        "axis was read in motion, write moves_at_feed = true under [table] of the measurement's TOML"
    )


def _by_heat(d: Diagnosis) -> str:
    """The sentences on heat that nothing recorded, after what has no name."""
    return "".join(f". {b.words.rstrip('.')}" for b in d.doubts if b.kind == "no_temperature" and not b.fatal)


def _of_the_residual(size: float, d: Diagnosis, unit: str) -> str:
    """The share of the residual that an effect explains; of the refitted residual where the numbers are out of date."""
    part, whole = sizes(size, d.rms_residual)
    if d.out_of_date and size <= d.refit:
        part, refitted = sizes(size, d.refit)
        return f"{part} {unit} of the {refitted} {unit} residual with refitted numbers ({whole} {unit} as they are)"
    if float(part) <= float(whole):
        return f"{part} {unit} of the {whole} {unit} residual"
    if d.judged is not None and not d.judged.model.effects:
        return f"all of the {whole} {unit} residual"
    return f"{part} {unit}; the residual is {whole} {unit} because the model's numbers compensate a part of it"


def indistinguishable(d: Diagnosis) -> list[str]:
    """Names of the effects of which one is missing, as far as the readings tell; one name where it is certain.

    Forms of one effect have one name. What explains another part of the readings is no rival. Of several effects that
    are missing together the first for which something else may stand is given with it.
    """
    if d.together:
        pairs = zip(d.together, labels([m.fitted for m in d.together]), strict=True)
        either = ([name, *rivals_of(m, d)] for m, name in pairs)
        return next((names for names in either if len(names) > 1), [d.together[0].label])
    first = d.findings[0]
    rivals = [a for a in first.confused_with if not a.apart]
    others = [first.label if a.label.startswith(f"{first.label}, ") else _label(a) for a in rivals]
    return list(dict.fromkeys([*(f.label for f in same_part(d)), *others]))


def _apart(d: Diagnosis) -> set[tuple[str, str]]:
    """Effects that explain another part of the readings than the first."""
    return {(a.effect, a.component) for a in d.findings[0].confused_with if a.apart}


def same_part(d: Diagnosis) -> list[Finding]:
    """The first, and what explains the same part of the readings as well."""
    apart = _apart(d)
    return [d.findings[0], *(f for f in d.group if f.rank > 1 and (f.effect.effect, f.effect.component) not in apart)]


def _may_be_missing_too(d: Diagnosis) -> str:
    """What may be missing besides, as the end of a sentence; empty for nothing."""
    besides = _beside(d, _apart(d))
    return f"; {besides}, which explains another part of the readings, may be missing too" if besides else ""


def _one_of(d: Diagnosis) -> str:
    """Rivals with the same effect on the readings, and effects that may be missing besides."""
    first = d.findings[0]
    rivals = [a for a in first.confused_with if not a.apart]
    test = next((a.separating_test for a in rivals if a.separating_test), "")
    way = f". To separate them: {test}" if test else ""
    way = f". {sentence(test)}" if test.startswith(NONE_SETTLES) else way
    return (
        f"one of {', '.join(indistinguishable(d)[:4])} is missing, or more than one; these data cannot distinguish "
        f"them (confounded){_may_be_missing_too(d)}{other_parts(first)}{way}"
    )


def _form_and_more(d: Diagnosis) -> str:
    """That the form of an effect is open, and what may be missing besides, as the end of its sentence."""
    first, besides = d.findings[0], _may_be_missing_too(d)
    variant = any(a.label.startswith(f"{first.label}, ") for a in first.confused_with)
    forms = "; its form cannot be determined from these data" if variant or len(same_part(d)) > 1 else ""
    then = ": add the first, then diagnose again" if besides else ""
    return "" if first.partner is not None else f"{forms}{besides}{then}"


def _beside(d: Diagnosis, apart: Collection[tuple[str, str]]) -> str:
    """Effects that may be missing besides: the likeliest, and the number of similar ones."""
    others = [f for f in d.findings if (f.effect.effect, f.effect.component) in apart]
    named = dict(zip(map(id, d.findings), labels(d.findings), strict=True))
    names = list(dict.fromkeys(named[id(f)] if f.label == d.findings[0].label else f.label for f in others))
    return f"{names[0]}{_like(len(names) - 1)}" if names else ""


def _like(count: int) -> str:
    """The number of others like the named one, in brackets; empty for none."""
    return f" (or {'another' if count == 1 else f'one of {count}'} like it)" if count > 0 else ""


def _label(alike: Alike) -> str:
    return alike.label or f"{alike.effect}({alike.component})"


def beside(significant_too: Sequence[str]) -> tuple[str, ...]:
    """Note on effects that are also significant besides the first.

    Args:
        significant_too: labels of such effects, best first.
    """
    if not significant_too:
        return ()
    more = _like(len(significant_too) - 1)
    return (f"more is missing: {significant_too[0]}{more} is also significant; add the first, then diagnose again",)


def hardly(usual: Sequence[float], smallest: Sequence[float], unit: str) -> str:
    """Why an effect would show only if it were far larger than usual.

    Args:
        usual: root mean squares in the readings at its usual size, for each component that it may feed.
        smallest: smallest root mean squares that would be detected.
        unit: of both, as in a diagnosis.
    """
    low, high, name = significant(min(usual), 1), significant(max(usual), 1), ERROR_UNITS[unit]
    makes = low if low == high else f"{low} to {high}"
    return (
        f"at its usual size it adds {makes} {name} to these readings; it would be seen from "
        f"{significant(min(smallest), 2)} {name} on"
    )


def why_not(mine: float, best: float, gain: float, same: bool, whole: float | None = None) -> str:
    """Why a candidate is not preferred.

    Args:
        mine, best: log evidence of the candidate and of rank 1, each by itself.
        gain: on held-out runs.
        same: whether these readings cannot distinguish the two.
        whole: log evidence of rank 1 with the effects that are named together with it; None where it is named alone.
    """
    if gain > 0.0 and mine - best > math.log(20.0):
        more = "" if whole is None or whole < mine else "; rank 1 and what is named with it are likelier together"
        return f"likelier than rank 1 by itself{more}"
    if same and best - mine > math.log(20.0):
        return "less likely than rank 1, but it predicts held-out runs as well or better"
    if same:
        return "as likely as rank 1 from these data"
    if gain <= 0.0:
        return "does not lower the error on held-out runs or targets"
    behind = best - mine
    # A factor of 1.4 is too small to act upon.
    return "as likely as rank 1" if behind < math.log(1.5) else f"{times_less(behind)} than rank 1"


def times_less(behind: float) -> str:
    """How much less likely a candidate is, in words, by the log of its odds."""
    if behind >= math.log(1e6):
        return "over a million times less likely"
    times = math.exp(behind)
    return f"{times:,.0f} times less likely" if times >= 10.0 else f"{significant(times, 2)} times less likely"


def sentence(text: str) -> str:
    """A text as a sentence: a capital first, unless it begins with a name from a file, and a full stop."""
    first, second, *_ = [*text.split(maxsplit=2), "", ""]
    name = first.endswith(":") or any(mark in first for mark in "_(") or (second.endswith(":") and "_" in second)
    name |= any(map(str.isdigit, first))
    return (text if name else text[:1].upper() + text[1:]) + ("" if text.endswith((".", "?", "!")) else ".")


def unit_of_channel(name: str) -> str:
    """Unit of a channel."""
    if name in ("spindle_rpm", "load_kg", "force_n", "time_s", "feed_mm_min"):
        return {"spindle_rpm": "rpm", "load_kg": "kg", "force_n": "N", "time_s": "s", "feed_mm_min": "mm/min"}[name]
    head = name.split("_", maxsplit=1)[0]
    return {"v": "mm/s", "a": "mm/s2", "d": "1", "T": "degC"}.get(head, "mm")


def notes(names: Sequence[str], warm: bool) -> tuple[str, ...]:
    """Treatment of the data, in words.

    Args:
        names: of the measurements.
        warm: whether temperatures were recorded.
    """
    out = ["slow temperatures are smoothed for the search; a model gets them as they are read"] if warm else []
    if len(names) > 1:
        out.append(f"one result for {len(names)} measurements: {', '.join(names)}")
    return tuple(out)


def less(names: Sequence[str]) -> str:
    """What was subtracted from a residual that is drawn, as an addition to a title; empty where nothing was."""
    return f" less {listed(names)}" if names else ""


def labels(effects: Sequence[Finding | FittedEffect]) -> list[str]:
    """Short names that all differ: equal names get the arguments in which they differ."""
    return [_distinct(f, [g for g in effects if g.label == f.label]) for f in effects]


def _distinct(f: Finding | FittedEffect, same: Sequence[Finding | FittedEffect]) -> str:
    """The name, with the arguments that others of its name differ in, or else the non-linear parameters."""
    if len(same) < 2:
        return f.label
    given = [g.effect.model_dump(mode="json", exclude_none=True) for g in same]
    mine = f.effect.model_dump(mode="json", exclude_none=True)
    keys = [k for k in dict.fromkeys(k for g in given for k in g) if any(g.get(k) != mine.get(k) for g in given)]
    parts = [_argument(k, mine.get(k)) for k in keys]
    if not parts:
        ends = [n for n in f.theta if any(g.theta.get(n) != f.theta[n] for g in same)]
        parts = [
            f"{n} {significant(f.theta[n])}"
            if n != "tau"
            else f"{duration(f.theta[n])} late"
            if f.theta[n]
            else "at once"
            for n in ends
        ]
    return f"{f.label}, {', '.join(parts)}" if parts else f"{f.label} #{1 + same.index(f)}"


AT = {"fixed_mm": "fixed at"}
"""Words of an argument before its value, where its name alone is no English."""
WITHOUT = {"builds_up": "at once", "stretched": "not stretched"}
"""Words of an argument that is false, where "no" and its name are no English."""


def _argument(key: str, value: object) -> str:
    word = key.replace("_", " ")
    if isinstance(value, bool) or value is None:
        return word if value else WITHOUT.get(key, f"no {word}")
    if isinstance(value, list):
        if key == "degrees":
            return f"{'degree' if len(value) == 1 else 'degrees'} {listed(value)}"
        return counted(len(value), word.removesuffix(" mm").removesuffix("s"))
    if not isinstance(value, float):
        return f"{word} {value}"
    return f"{AT.get(key, word.removesuffix(' mm'))} {value:g}{' mm' if key.endswith('_mm') else ''}"


def accepted(findings: Sequence[Finding]) -> bool:
    """Whether rank 1 passed every check."""
    return bool(findings) and findings[0].accepted
