"""Options of a driver as people read them: name, type, what holds where it is not given, meaning.

They are read off the pydantic model that checks them. The meaning is the field's description where it has one, else
what the class' docstring says under "Attributes:".
"""

import inspect
import json
import re
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

WORDS: dict[Any, str] = {
    bool: "true or false",
    int: "whole number",
    float: "number",
    str: "text",
    Path: "file",
}
LOW, HIGH = {"ge": "from {}", "gt": "above {}"}, {"le": "to {}", "lt": "below {}"}


@dataclass(frozen=True)
class Option:
    """One key that a device's table may have.

    Attributes:
        name: the key; of a table within it with dots, `NAME` standing for a name of the user's choice.
        kind: what may be given.
        default: what holds where it is not given, as TOML; "" where nothing does.
        required: must it be given?
        meaning: one sentence or two; "" where the driver's author wrote none.
    """

    name: str
    kind: str
    default: str
    required: bool
    meaning: str


def options_of(model: type[BaseModel], prefix: str = "") -> list[Option]:
    """All options of a model, those of tables within it behind their table."""
    said = _attributes(model)
    out = []
    for key, field in model.model_fields.items():
        name = prefix + (field.alias or key)
        kind, inner, below = _kind(field.annotation, field.metadata)
        meaning = field.description or said.get(key) or said.get(field.alias or key, "")
        out.append(Option(name, kind, _default(field), field.is_required(), _flat(meaning)))
        if inner is not None:
            out += options_of(inner, f"{name}.{below}")
    return out


def summary_of(kind: type) -> str:
    """First paragraph of a class' docstring, on one line."""
    return _flat((inspect.getdoc(kind) or "").split("\n\n", maxsplit=1)[0])


def _kind(annotation: Any, metadata: typing.Sequence[Any] = ()) -> tuple[str, type[BaseModel] | None, str]:
    """Words for a type; the model of a table within; and what stands between its name and its keys."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is typing.Annotated:
        parts = [part.metadata if isinstance(part, FieldInfo) else [part] for part in arguments[1:]]
        return _kind(arguments[0], [item for part in parts for item in part])
    if origin in (typing.Union, types.UnionType):
        kinds = [_kind(a, metadata) for a in arguments if a is not type(None)]
        inner = next((k for k in kinds if k[1] is not None), (None, None, ""))
        return " or ".join(k[0] for k in kinds), inner[1], inner[2]
    if origin is Literal:
        return "one of " + ", ".join(_toml(a) for a in arguments), None, ""
    if origin is dict:
        words, inner_model, below = _kind(arguments[1])
        return ("tables by name" if inner_model else f"table: name = {words}"), inner_model, f"NAME.{below}"
    if origin in (tuple, list):
        return _sequence(arguments), None, ""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "table", annotation, ""
    return WORDS.get(annotation, "value") + _bounds(metadata), None, ""


def _sequence(arguments: tuple[Any, ...]) -> str:
    kinds = list(dict.fromkeys(_kind(a)[0] for a in arguments if a is not Ellipsis))
    if Ellipsis in arguments or len(arguments) < 2:
        return f"list: {kinds[0] if kinds else 'value'}, …"
    return f"list of {len(arguments)}: {', '.join(kinds)}"


def _bounds(metadata: typing.Sequence[Any]) -> str:
    """Such as " from 1 to 247"."""
    return "".join(
        f" {words.format(_short(getattr(item, key)))}"
        for side in (LOW, HIGH)
        for key, words in side.items()
        for item in metadata
        if getattr(item, key, None) is not None
    )


def _short(number: float) -> str:
    return str(int(number)) if float(number).is_integer() else f"{number:g}"


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return ""
    value = field.get_default(call_default_factory=True, validated_data={})
    return "" if value is None else _toml(value)


def _toml(value: Any) -> str:
    if isinstance(value, BaseModel):
        return ""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return json.dumps(value, ensure_ascii=False, default=str)


def _attributes(model: type) -> dict[str, str]:
    """What the docstrings of a class and of its bases say of their attributes; the class' own words first."""
    out: dict[str, str] = {}
    for base in model.__mro__:
        text = inspect.cleandoc(base.__doc__ or "")
        part = re.search(r"^Attributes:\n((?:[ \t]+.*\n?|\n)*)", text, re.MULTILINE)
        for names, words in _entries(inspect.cleandoc(part[1]) if part else ""):
            for name in names:
                out.setdefault(name, words)
    return out


def _entries(text: str) -> list[tuple[list[str], str]]:
    """Split `name, name: words` with indented lines below into names and words."""
    out = []
    for entry in re.split(r"\n(?=\S)", text):
        names, colon, words = entry.partition(":")
        if colon and all(name.strip().isidentifier() for name in names.split(",")):
            out.append(([name.strip() for name in names.split(",")], words))
    return out


def _flat(text: str) -> str:
    return re.sub(r"\s+", " ", text).strip()
