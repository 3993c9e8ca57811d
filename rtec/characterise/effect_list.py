"""Reads `--effects`: the only effects to fit."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rtec.effects import Effect, effect_class
from rtec.effects.registry import check_effect
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import nearest, validated

ITEM = re.compile(r",(?![^\[]*\])")
ALL = "*"


@dataclass(frozen=True)
class AskedEffects:
    """Effects that the user named.

    Attributes:
        names: effects that may be chosen for any component that influences the readings.
        exact: effects with all their arguments, fitted without a choice.
    """

    names: tuple[str, ...]
    exact: tuple[Effect, ...]


def read_wanted(text: str, machine: Machine) -> AskedEffects:
    """Read `scale,backlash,mount_expansion:EXX:sensor=T_bed`.

    For a name alone, components and sensors are chosen. A name with a component, and arguments as `key=value`, is
    fitted exactly so; `sensor=*` means every sensor of the machine.

    Raises:
        ModelError: an effect, component or argument is unknown; the message has what is allowed.
    """
    names: list[str] = []
    exact: list[Effect] = []
    for item in (part.strip() for part in ITEM.split(text)):
        name, *rest = item.split(":")
        where = f"--effects {item}"
        effect_class(name, where)
        if not rest:
            names.append(name)
            continue
        arguments = _arguments(rest[1:], where)
        sensors = machine.sensor_names if arguments.get("sensor") == ALL else (arguments.get("sensor"),)
        for sensor in sensors:
            more = {**arguments, **({} if sensor is None else {"sensor": sensor})}
            exact.append(_made(name, rest[0], more, machine, where))
    return AskedEffects(tuple(dict.fromkeys(names)), tuple(exact))


def _made(name: str, component: str, arguments: dict[str, Any], machine: Machine, where: str) -> Effect:
    if component not in machine.components:
        hint = nearest(component, machine.components)
        raise ModelError(f"{where}: component {component!r} is none of machine {machine.name!r}{hint}")
    kind = effect_class(name, where)
    table: dict[str, Any] = {"effect": name, "component": component, **arguments}
    if "axis" in kind.model_fields and "axis" not in table and component[2:].removeprefix("0") in machine.axis_names:
        table["axis"] = component[2:].removeprefix("0")
    effect = validated(kind, table, where, ModelError)
    check_effect(effect, machine, where)
    return effect


def _arguments(pairs: Sequence[str], where: str) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign:
            raise ModelError(f"{where}: {pair!r} is no key=value; write for example sensor=T_bed")
        try:
            out[key] = json.loads(value)
        except ValueError:
            out[key] = value
    return out
