"""The truth of the simulated machine: effects of a model file, and effects written on one line."""

import ast
import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rtec.effects import effect_class
from rtec.effects.arithmetic import degree, parse
from rtec.effects.expression import Expression
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.model import FittedEffect, Model
from rtec.model.model import names_of
from rtec.tomlfile import nearest, validated

MOST_NAMES = 8
FORM = "write NAME,key=value,…, for example scale,component=EXX,axis=X,k=12"


def truth_of(machine: Machine, known: Model | None = None, effects: Sequence[str] = ()) -> Model:
    """The true model: the effects of a model, then those of the texts.

    Raises:
        ModelError: a text is invalid; the message names it.
    """
    base = known or Model(machine, name="truth")
    added = tuple(effect_from_text(text, machine) for text in effects)
    model = Model(machine, (*base.effects, *added), name=base.name, reference_degc=base.reference_degc)
    model.check(base.name)
    return model


def effect_from_text(text: str, machine: Machine) -> FittedEffect:
    """Read `NAME,key=value,…`: arguments, coefficients and non-linear parameters of one effect, in any order.

    The user's own expression has the same form: `expression,component=EYX,expression=A*exp(-((x-c)/w)**2),A=3,…`.

    Raises:
        ModelError: the text is invalid; the message has the fault.
    """
    where = f"effect {text!r}"
    head, *items = split(text)
    kind = effect_class(head.strip(), where)
    given: dict[str, Any] = {}
    for item in items:
        key, mark, value = item.partition("=")
        if not mark:
            raise ModelError(f"{where}: {item!r} is no key=value; {FORM}")
        if key.strip() in given:
            raise ModelError(f"{where}: {key.strip()!r} is given twice")
        given[key.strip()] = toml_value(value)
    if kind is Expression and "linear" not in given:
        given |= _declared(given, where)
    arguments = {k: v for k, v in given.items() if k in kind.model_fields}
    effect = validated(kind, {"effect": head.strip(), **arguments}, where, ModelError)
    effect.check(machine, where)
    linear, free = names_of(effect, machine)
    numbers = {k: v for k, v in given.items() if k not in arguments}
    for key, value in numbers.items():
        if key not in (*linear, *free):
            raise ModelError(f"{where}: unknown key {key!r}{nearest(key, [*kind.model_fields, *linear, *free])}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ModelError(f"{where}: {key} is {value!r}, which is no number")
    missing = [n for n in (*linear, *free) if n not in numbers]
    if missing:
        raise ModelError(f"{where}: {missing[0]!r} is missing; it has the numbers {', '.join((*linear, *free))}")
    pick = {k: float(v) for k, v in numbers.items()}
    return FittedEffect(effect, {k: pick[k] for k in linear}, {k: pick[k] for k in free})


def _declared(given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Keys `linear` and `free` of an expression: as many of its numbers as possible are linear.

    The bounds of a free one are a factor of ten around its value: true values are not searched for.

    Raises:
        ModelError: the text is no expression.
    """
    numbers = [k for k, v in given.items() if type(v) in (int, float) and k not in Expression.model_fields]
    try:
        tree = parse(str(given.get("expression", "")))
    except ValueError as e:
        raise ModelError(f"{where}: expression: {e}") from e
    linear = next((s for s in _subsets(numbers) if _is_linear(tree, s)), set[str]())
    unit = "urad" if str(given.get("component", ""))[1:2] in ("A", "B", "C") else "um"
    free = {k: _free(float(given[k])) for k in numbers if k not in linear}
    return {"linear": dict.fromkeys((k for k in numbers if k in linear), unit), "free": free}


def _subsets(names: Sequence[str]) -> Iterator[set[str]]:
    """All subsets, the largest first; of many names only the whole set and each name alone."""
    sizes = range(len(names), 0, -1) if len(names) <= MOST_NAMES else (len(names), 1)
    return (set(chosen) for size in sizes for chosen in itertools.combinations(names, size))


def _is_linear(tree: ast.expr, names: set[str]) -> bool:
    try:
        return degree(tree, names) == 1
    except ValueError:
        return False


def _free(value: float) -> dict[str, float]:
    low, high = sorted((value / 10.0, value * 10.0)) if value else (-1.0, 1.0)
    return {"start": value, "low": low, "high": high}


def split(text: str) -> list[str]:
    """Split at commas outside of brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in "([{":
            depth += 1
        elif letter in ")]}":
            depth -= 1
        elif letter == "," and depth == 0:
            parts.append("")
            continue
        parts[-1] += letter
    return parts


def toml_value(text: str) -> Any:
    """A TOML value (number, list, true, quoted text); anything else is the text itself."""
    try:
        return tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()
