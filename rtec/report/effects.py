"""Pages and facts about the effects: the table of all, and one in full."""

import inspect
import math
from collections.abc import Iterator
from typing import Any

from rtec.diagnosis.words import spoken
from rtec.effects import Effect, Parameter
from rtec.effects.base import About
from rtec.effects.registry import EFFECTS, FAMILIES, all_effects, effect_class, plug_in_faults
from rtec.effects.time_data import NOT_EFFECTS
from rtec.report.effects_figures import example_machine, example_of
from rtec.report.page import Page, Section, Table

OTHERS = "of other packages"
NO_EFFECTS = "no errors of the machine (listed for comparison; a model cannot hold them)"
ARGUMENTS: dict[str, str] = {
    "component": "the component error that it feeds",
    "axis": "the axis that it runs along",
    "other": "the other axis",
    "sensor": "the temperature",
    "front": "the first of two temperatures",
    "back": "the second, which is taken away from the first",
    "lag": "the temperature through a first-order lag",
    "builds_up": "the lag builds up after each reversal",
    "stretched": "a screw that was stretched at assembly: it grows from `T0` °C on, where it is slack",
    "fixed_mm": "the place that stands still, mm",
    "degrees": "degrees of the Legendre polynomials",
    "degree": "highest power of the position",
    "knots_mm": "places between which it is straight, mm",
    "harmonics": "number of harmonics",
    "grows_with": "the channel that its size is proportional to: a temperature (above the model's reference), "
    "`load_kg` or `spindle_rpm`; without it the size is constant",
    "lambda_mm": "signal period of the scale, mm, from its data sheet",
    "expression": "arithmetic on channels and parameters",
    "terms": "terms of the equation that it has; the others are zero",
    "linear": "its coefficients and their units",
    "free": "its other parameters: start, low, high, unit",
}


NEEDS = {
    "since_reversal": "distance since a reversal",
    "spindle_rpm": "spindle speed",
    "load_kg": "load",
    "force_n": "force",
    "time_s": "time",
    "other axis": "the other axis' position",
}
"""Phrases for words of `driven_by`; `pitch` is from the machine file and does not vary."""


def families() -> dict[str, dict[str, About]]:
    """Descriptions by family: built-in effects, those of other packages, and artefacts that are no effects."""
    out = {family: {name: EFFECTS[name].about for name in names} for family, names in FAMILIES.items()}
    added = {name: kind.about for name, kind in all_effects().items() if name not in EFFECTS}
    if added:
        out[OTHERS] = added
    return {**out, NO_EFFECTS: dict(NOT_EFFECTS)}


def catalogue_page() -> Page:
    """The table of all effects, by family."""
    sections = [
        Section(family, [], Table(("effect", "what"), [(n, a.title) for n, a in abouts.items()], words=(0, 1)))
        for family, abouts in families().items()
    ]
    faults = [f"{name}: {fault}" for name, fault in plug_in_faults().items()]
    if faults:
        sections.append(Section("Plug-ins that cannot be used", faults))
    count = len(all_effects())
    return Page(
        title="Effects",
        lead=f"{count} effects that a model can hold. rtec effects NAME shows the equation of one, and more.",
        numbers=[(str(count), "effects")],
        sections=sections,
    )


def effect_page(name: str) -> Page:
    """One effect in full.

    Raises:
        ModelError: there is none of that name.
    """
    about, kind = _looked_up(name)
    equation = [about.equation, *_more(kind), f"Usual size: {about.typical}.", f"Source: {about.source}."]
    sections = [Section("Equation", equation)]
    if kind is not None:
        sections += list(_in_a_model(kind))
    shows = [_sentence(about.reveal)] if about.reveal else []
    if about.seen_by:
        shows.append(f"Instruments: {', '.join(about.seen_by)}.")
    needs = [NEEDS.get(d, d) for d in kind.driven_by if d != "pitch"] if kind is not None else []
    if needs:
        shows.append(f"Must vary in the readings: {', '.join(needs)}.")
    sections.append(Section("What shows it", shows))
    rows = [(c.effect, c.why, c.separate_by) for c in about.confusions]
    if rows:
        sections.append(Section("Confounded with", [], Table(("effect", "why", "separated by"), rows, words=(0, 1, 2))))
    return Page(title=about.title, lead=f"{name}: {about.title}.", numbers=[], sections=sections)


def _looked_up(name: str) -> tuple[About, type[Effect] | None]:
    if name in NOT_EFFECTS:
        return NOT_EFFECTS[name], None
    kind = effect_class(name, "rtec effects")
    return kind.about, kind


def _more(kind: type[Effect] | None) -> list[str]:
    """Paragraphs of the class's docstring after the first one."""
    paragraphs = (inspect.getdoc(kind) or "").split("\n\n")[1:] if kind is not None else []
    return [" ".join(p.split()).replace("`", "") for p in paragraphs]


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _in_a_model(kind: type[Effect]) -> Iterator[Section]:
    """Sections on parameters and arguments."""
    linear, free = _parameters(kind)
    rows = [(p.name, spoken(p.unit), f"{p.typical:g}", "", "fitted, linear") for p in linear]
    rows += [(p.name, spoken(p.unit), f"{p.start:g}", _bounds(p), f"searched for{form}") for p, form in free]
    if rows:
        yield Section("Parameters", [], Table(("name", "unit", "usual", "between", "how"), rows, words=(0, 1, 3, 4)))
    given = [(key, ARGUMENTS.get(key, ""), default) for key, default in _arguments(kind)]
    yield Section("Arguments in a model file", [], Table(("name", "what", "default"), given, words=(0, 1, 2)))


def _parameters(kind: type[Effect]) -> tuple[tuple[Parameter, ...], list[tuple[Parameter, str]]]:
    """The linear parameters; the others, each with the form of the effect that has it, as ", with lag = true"."""
    machine = example_machine()
    effect = example_of(kind, machine)
    if effect is None:
        return (), []
    free = [(p, "") for p in effect.nonlinear(machine)]
    for key in [k for k, field in kind.model_fields.items() if field.annotation is bool and not getattr(effect, k)]:
        own = {p.name for p, _ in free}
        form = effect.model_copy(update={key: True}).nonlinear(machine)
        free += [(p, f", with {key} = true") for p in form if p.name not in own]
    return effect.coefficients(machine), free


def _bounds(p: Parameter) -> str:
    return f"{p.low:g} … {p.high:g}" if math.isfinite(p.low) and math.isfinite(p.high) else ""


def _arguments(kind: type[Effect]) -> Iterator[tuple[str, str]]:
    """Arguments and their defaults as in a model file; "" for a required one."""
    for key, field in kind.model_fields.items():
        if key == "effect":
            continue
        default = field.get_default(call_default_factory=True) if not field.is_required() else None
        if isinstance(default, bool):
            yield key, str(default).lower()
        elif isinstance(default, tuple):
            yield key, str(list(default))
        else:
            yield key, "" if default in (None, {}) else str(default)


def effect_facts(name: str, family: str, about: About) -> dict[str, Any]:
    """Facts about one entry for programs."""
    kind = all_effects().get(name)
    linear, free = _parameters(kind) if kind is not None else ((), [])
    return {
        "family": family,
        "in_a_model": kind is not None,
        "title": about.title,
        "equation": about.equation,
        "typical": about.typical,
        "source": about.source,
        "arguments": [key for key, _ in _arguments(kind)] if kind is not None else [],
        "parameters": [{"name": p.name, "unit": p.unit, "typical": p.typical} for p in linear],
        "nonlinear": [
            {"name": p.name, "unit": p.unit, "start": p.start, "low": p.low, "high": p.high, "grid": list(p.grid)}
            for p, _ in free
        ],
        "needs": list(kind.driven_by) if kind is not None else [],
        "shown_by": about.reveal,
        "instruments": list(about.seen_by),
        "confusions": [vars(c) for c in about.confusions],
    }


def all_facts(name: str | None = None) -> dict[str, dict[str, Any]]:
    """Facts by name: of one entry, or of all.

    Raises:
        ModelError: there is none of that name.
    """
    if name is not None:
        _looked_up(name)
    return {
        key: effect_facts(key, family, about)
        for family, abouts in families().items()
        for key, about in abouts.items()
        if name in (None, key)
    }


def catalogue_markdown() -> str:
    """The built-in catalogue as tables of Markdown, for docs/effects.md: a family a heading, an entry a row."""
    parts = []
    for family, abouts in families().items():
        if family == OTHERS:
            continue
        lines = [f"## {family[0].upper()}{family[1:]}", ""]
        lines += [
            "| effect | what, equation | usual size | shown by | confounded with: separated by |",
            "|---|---|---|---|---|",
        ]
        lines += [_markdown_row(name, about) for name, about in abouts.items()]
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _markdown_row(name: str, about: About) -> str:
    alike = "<br>".join(f"`{c.effect}`: {c.separate_by}" for c in about.confusions)
    cells = (f"`{name}`", f"{about.title}<br>`{about.equation}`", about.typical, about.reveal, alike)
    return "| " + " | ".join(c.replace("|", r"\|") for c in cells) + " |"
