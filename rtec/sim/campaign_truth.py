"""What is true of the machine that is measured: effects of a model file, and effects written on one line."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtec.effects import effect_class
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.model import FittedEffect, Model, load_model
from rtec.model.model import names_of
from rtec.tomlfile import nearest, validated

FORM = "write NAME,key=value,…, for example scale,component=EXX,axis=X,k=12"


def truth_of(machine: Machine, file: Path | None = None, effects: Sequence[str] = (), name: str = "truth") -> Model:
    """Give the true model: the effects of a file, then those of the texts.

    Raises:
        ModelError: the file is not for this machine, or a text says something that cannot be; the message names it.
    """
    base = load_model(file, machine) if file is not None else Model(machine, name=name)
    added = tuple(effect_from_text(text, machine) for text in effects)
    model = Model(machine, (*base.effects, *added), name=base.name, reference_degc=base.reference_degc)
    model.check(str(file) if file is not None else name)
    return model


def effect_from_text(text: str, machine: Machine) -> FittedEffect:
    """Read `NAME,key=value,…`: arguments, coefficients and non-linear parameters of one effect, in any order.

    Raises:
        ModelError: what is wrong in it.
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
            raise ModelError(f"{where}: {key.strip()!r} stands twice")
        given[key.strip()] = toml_value(value)
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


def split(text: str) -> list[str]:
    """Cut at commas that stand in no brackets and no quotes."""
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
    """A number, list, true or quoted text as TOML reads it; anything else is text as it stands."""
    try:
        return tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return text.strip()
