"""An effect as a person asks for it: its name, a component, and what else it needs to know."""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtec.diagnosis.extend.add import new_effect
from rtec.effects import Effect, all_effects, effect_class
from rtec.errors import ModelError
from rtec.model import FittedEffect, Model
from rtec.tomlfile import nearest, validated


def asked_effect(name: str, component: str | None, settings: Sequence[str], model: Model) -> FittedEffect:
    """Build an effect from `NAME`, a component and `key=value` texts.

    An axis that is not named is the component's own. Numbers (coefficients, time constants) may be given as a start.

    Raises:
        ModelError: what is missing or wrong, with what is allowed.
    """
    name = name.lower() if name.lower() in all_effects() else name
    where = f"effect {name!r}"
    kind = effect_class(name, "rtec add")
    given = dict(_pair(text, where) for text in settings)
    if component is None:
        raise ModelError(f"{where}: say which component error it feeds: --component EXX (`rtec effects {name}` tells)")
    arguments = {k: v for k, v in given.items() if k in kind.model_fields}
    if "axis" in kind.model_fields and "axis" not in arguments:
        own = component[2:].removeprefix("0")
        if own in model.machine.axis_names:
            arguments["axis"] = own
    _needed(kind, arguments, model, where)
    effect = validated(kind, {"effect": name, "component": component, **arguments}, where, ModelError)
    numbers = {k: _number(k, v, where) for k, v in given.items() if k not in arguments}
    return new_effect(effect, model, values=numbers)


def check_one(name: str | None, expr: str | None, refit: bool) -> None:
    """Check that one thing was asked for: a name, an expression, or a refit.

    Raises:
        ModelError: more than one; a file in the place of the name belongs to `--data A B C`.
    """
    named = name is not None and name.lower() in all_effects() and not Path(name).exists()
    said = [f"effect {name!r}"] * named + ["--expr"] * (expr is not None) + ["--refit"] * refit
    if len(said) > 1:
        raise ModelError(f"add: {' and '.join(said)} together: give either a name, or --expr, or --refit")


def _pair(text: str, where: str) -> tuple[str, Any]:
    key, mark, value = text.partition("=")
    if not mark or not key.strip():
        raise ModelError(f"{where}: --set {text!r} is no key=value; for example --set sensor=T_bed")
    try:
        return key.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()


def _needed(kind: type[Effect], arguments: dict[str, Any], model: Model, where: str) -> None:
    """Name what is missing together with what the machine has to offer."""
    machine = model.machine
    offers = {"sensor": machine.sensor_names, "front": machine.sensor_names, "back": machine.sensor_names}
    offers["axis"] = machine.axis_names
    for key, field in kind.model_fields.items():
        if key in arguments or not field.is_required() or key in ("effect", "component"):
            continue
        offer = f"; one of: {', '.join(offers[key])}" if key in offers else ""
        raise ModelError(f"{where}: --set {key}=… is missing{offer}")
    for key in ("sensor", "front", "back", "axis"):
        if key in arguments and isinstance(arguments[key], str) and arguments[key] not in offers[key]:
            raise ModelError(f"{where}: {key} {arguments[key]!r} is none{nearest(arguments[key], offers[key])}")


def _number(key: str, value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ModelError(f"{where}: {key} is {value!r}, which is no number")
    return float(value)
