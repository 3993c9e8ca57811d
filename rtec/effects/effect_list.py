"""Effects as text of the command line, as in `--effects scale,mount_expansion:EXX:sensor=T_bed`: read and written."""

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtec.effects.base import Effect
from rtec.effects.registry import check_effect, effect_class
from rtec.errors import ModelError
from rtec.machine import Machine
from rtec.tomlfile import nearest, validated

ALL = "*"
PLAIN = re.compile(r"[\w.+/-]+")
"""A word that needs no quotes, neither in a list of effects nor in a shell."""
BEYOND = 1e-3
"""A number may be beyond its bounds by this share of their distance: a text has it rounded."""


@dataclass(frozen=True)
class AskedEffects:
    """Effects that the user named.

    Attributes:
        names: effects that may be chosen for any component that influences the readings.
        exact: effects with all their arguments, fitted without a choice.
        numbers: the given coefficients and non-linear parameters of each of `exact`; empty where none was asked for.
    """

    names: tuple[str, ...]
    exact: tuple[Effect, ...]
    numbers: tuple[Mapping[str, float], ...] = ()


def read_wanted(text: str, machine: Machine, option: str = "--effects", *, with_numbers: bool = False) -> AskedEffects:
    """Read `scale,backlash,mount_expansion:EXX:sensor=T_bed`.

    For a name alone, components and sensors are chosen. A name with a component, and arguments as `key=value`, is
    fitted exactly so; `sensor=*` means every sensor of the machine. A value is JSON, or else a word.

    Args:
        text: the list.
        machine: of the effects.
        option: what the user typed, for messages.
        with_numbers: whether an effect may have numbers, too: `cyclic_pole:EXX:period=39.8`.

    Raises:
        ModelError: an effect, component or argument is unknown; the message has what is allowed.
    """
    names: list[str] = []
    exact: list[tuple[Effect, Mapping[str, float]]] = []
    for item in (part.strip() for part in _split(text, ",")):
        name, *rest = _split(item, ":")
        where = f"{option} {item}"
        effect_class(name, where)
        if not rest:
            names.append(name)
            continue
        arguments = _arguments(rest[1:], where)
        sensors = machine.sensor_names if arguments.get("sensor") == ALL else (arguments.get("sensor"),)
        for sensor in sensors:
            more = {**arguments, **({} if sensor is None else {"sensor": sensor})}
            exact.append(_made(name, rest[0], more, machine, where, with_numbers))
    return AskedEffects(tuple(dict.fromkeys(names)), tuple(e for e, _ in exact), tuple(n for _, n in exact))


def as_text(effect: Effect, numbers: Mapping[str, float] | None = None) -> str:
    """An effect as `read_wanted` reads it: `mount_expansion:EXX:sensor=T_bed`.

    Args:
        effect: any.
        numbers: coefficients and non-linear parameters, rounded to six digits.
    """
    pairs = [f"{k}={_as_json(v)}" for k, v in _given(effect).items()]
    pairs += [f"{k}={v:.6g}" for k, v in (numbers or {}).items()]
    return ":".join([effect.effect, effect.component, *pairs])


def as_options(effect: Effect) -> list[str]:
    """An effect as arguments of `rtec add`."""
    pairs = [f"{k}={_as_toml(v)}" for k, v in _given(effect).items() if v is not None]
    return [effect.effect, "--component", effect.component, *(word for pair in pairs for word in ("--set", pair))]


def _given(effect: Effect) -> dict[str, Any]:
    """Arguments of an effect that are not their default; its axis where it is not that of its component."""
    given = effect.model_dump(mode="json", exclude={"effect", "component"}, exclude_defaults=True)
    if given.get("axis") == _own_axis(effect.component):
        del given["axis"]
    return given


def _own_axis(component: str) -> str:
    return component[2:].removeprefix("0")


def _as_json(value: Any) -> str:
    if isinstance(value, str) and PLAIN.fullmatch(value) and _from_json(value) == value:
        return value
    return json.dumps(value, ensure_ascii=False, separators=(",", ":"))


def _from_json(text: str) -> Any:
    """The value of a JSON text; any other text as it is."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _as_toml(value: Any) -> str:
    """A value as `settings_of` reads it: TOML, or a word."""
    plain = isinstance(value, str) and PLAIN.fullmatch(value) and not _is_toml(value)
    return str(value) if plain else _toml(value)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_quoted(k)} = {_toml(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return _quoted(value) if isinstance(value, str) else json.dumps(value)


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _is_toml(text: str) -> bool:
    try:
        tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return False
    return True


def _split(text: str, mark: str) -> list[str]:
    """Parts of a text between marks that are outside brackets and double quotes."""
    out, depth, quoted, escaped = [""], 0, False, False
    for letter in text:
        if quoted:
            quoted, escaped = letter != '"' or escaped, letter == "\\" and not escaped
        elif letter == mark and depth == 0:
            out.append("")
            continue
        else:
            quoted = letter == '"'
            depth = max(depth + (letter in "[{(") - (letter in "]})"), 0)
        out[-1] += letter
    return out


def _made(
    name: str, component: str, given: dict[str, Any], machine: Machine, where: str, with_numbers: bool
) -> tuple[Effect, Mapping[str, float]]:
    if component not in machine.components:
        hint = nearest(component, machine.components)
        raise ModelError(f"{where}: component {component!r} is none of machine {machine.name!r}{hint}")
    kind = effect_class(name, where)
    numbers = {k: v for k, v in given.items() if with_numbers and k not in kind.model_fields}
    table: dict[str, Any] = {"effect": name, "component": component}
    table |= {k: v for k, v in given.items() if k not in numbers}
    own = _own_axis(component)
    if "axis" in kind.model_fields and "axis" not in table and own in machine.axis_names:
        table["axis"] = own
    effect = validated(kind, table, where, ModelError)
    check_effect(effect, machine, where)
    return effect, _checked(numbers, effect, machine, where)


def _checked(numbers: Mapping[str, Any], effect: Effect, machine: Machine, where: str) -> dict[str, float]:
    """Numbers of an effect; raises an error where one is unknown, no number, or out of bounds."""
    known = {p.name: p for p in (*effect.coefficients(machine), *effect.nonlinear(machine))}
    for name, value in numbers.items():
        if name not in known:
            allowed = [k for k in type(effect).model_fields if k not in ("effect", "component")]
            hint = nearest(name, (*allowed, *known))
            raise ModelError(f"{where}: {name!r} is neither an argument nor a number of this effect{hint}")
        low, high = known[name].low, known[name].high
        slack = BEYOND * (high - low) if math.isfinite(high - low) else 0.0
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ModelError(f"{where}: {name} is {value!r}, which is no number")
        if not low - slack <= value <= high + slack:
            raise ModelError(f"{where}: {name} = {value:g} is outside {low:g} to {high:g}")
    return {name: float(value) for name, value in numbers.items()}


def _arguments(pairs: Sequence[str], where: str) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for pair in pairs:
        key, sign, value = pair.partition("=")
        if not sign:
            raise ModelError(f"{where}: {pair!r} is no key=value; write for example sensor=T_bed")
        out[key] = _from_json(value)
    return out
