"""Reading TOML into strict pydantic models, with messages that name the key, its place, and what is allowed."""

import codecs
import difflib
import hashlib
import json
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.fields import FieldInfo

from rtec.errors import ConfigError, RtecError
from rtec.text import clean

M = TypeVar("M", bound=BaseModel)
MAX_BYTES = 64 * 1024 * 1024
DEEPEST = 32
"""Largest depth of tables within tables; no file of rtec has more than seven."""
DECIMAL_COMMA = re.compile(r"=\s*([+-]?\d+),(\d+)\s*(?:#|$)")
ENDLESS_KEY = re.compile(r"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){%d}" % (DEEPEST + 1))  # noqa: UP031 (braces)
MOST_NEAR, LIKE, NEARLY = 6, 0.6, 0.05
"""Largest number of words proposed for a mistyped one; how similar they are at least, whatever the case; and how much
less than the best."""
OUT_OF_RANGE = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


class Strict(BaseModel):
    """Base of all data read from files: unknown keys are errors, values do not change afterwards."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, arbitrary_types_allowed=True)


KINDS = (
    ("a model file", "model", "format"),
    ("a run file", "run", "machine"),
    ("a machine file", "machine", "tool_chain"),
    ("a measurement", "measurement", "instrument"),
)
"""Kinds of files, each with a table and a key of it that no other kind has."""
TABLES = (".csv", ".parquet")


def read_kind(path: Path, kind: str, error: type[RtecError] = ConfigError) -> dict[str, Any]:
    """The tables of a TOML file of a kind.

    Args:
        path: the file.
        kind: one of `KINDS`.
        error: what is raised.

    Raises:
        error: as `read_toml`; or the file is of another kind, which the message names.
    """
    data = read_toml(path, error)
    for name, table, key in KINDS:
        if isinstance(head := data.get(table), dict) and key in head:
            if name != kind:
                raise error(f"{path}: is {name}; {kind} is expected here")
            break
    return data


def read_toml(path: Path, error: type[RtecError] = ConfigError) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        error: the file is missing, too large, not UTF-8 or not TOML; the message names file and line.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise error(f"{path}: larger than {MAX_BYTES // 2**20} MiB, which no configuration is")
        if path.suffix.lower() in TABLES and path.is_file():
            raise error(f"{path}: is a table of readings; a TOML file is expected here")
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows write a byte order mark
        if ENDLESS_KEY.search(text):
            raise RecursionError  # tomllib needs quadratic time to read such a key
        data = tomllib.loads(text)
        beyond = [_section(loc[:-1]) + loc[-1] for loc in _beyond_64_bits(data, ())]
    except FileNotFoundError as e:
        raise error(f"{path}: no such file") from e
    except IsADirectoryError as e:
        raise error(f"{path}: is a folder, not a file") from e
    except PermissionError as e:
        raise error(f"{path}: may not be read by this user") from e
    except UnicodeDecodeError as e:
        is_utf_16 = bytes(e.object[:2]) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        what = "is UTF-16 text; save it as UTF-8" if is_utf_16 else f"not UTF-8 text (byte {e.start})"
        raise error(f"{path}: {what}") from e
    except RecursionError as e:
        raise error(f"{path}: nested too deeply") from e
    except OSError as e:
        raise error(f"{path}: cannot be read: {e.strerror}") from e
    except ValueError as e:  # TOMLDecodeError is one; a number of thousands of digits raises another
        raise error(f"{path}: not valid TOML: {e}{_comma(text, str(e))}") from e
    if beyond:
        raise error("\n".join(f"{path}: {place}: TOML's integers have 64 bits; this one has more" for place in beyond))
    if fault := next(_unprintable(data), ""):
        raise error(f"{path}: {fault}")
    return data


def _beyond_64_bits(value: object, loc: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    """Places of integers beyond 64 bits, which TOML 1.0 requires a reader to refuse. Recurses down to `DEEPEST`."""
    if len(loc) > DEEPEST:
        raise RecursionError
    if isinstance(value, int):
        if not -(2**63) <= value < 2**63:
            yield _joined(loc)
    elif isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _beyond_64_bits(item, (*loc, key))


def _unprintable(value: Any, key: str = "") -> Iterator[str]:
    """Unprintable text in keys and values: it would affect terminals, journals and other files."""
    if isinstance(value, Mapping):
        for name, inner in value.items():
            if name != clean(name):
                yield f"key {clean(name)[:80]!r}: has characters that are not printable; take them out"
            yield from _unprintable(inner, name)
    elif isinstance(value, list):
        for inner in value:
            yield from _unprintable(inner, key)
    elif isinstance(value, str):
        lines = [value] if key == "name" else value.replace("\t", " ").replace("\r\n", "\n").split("\n")
        if any(line != clean(line) for line in lines):
            yield f"{key} = {clean(value)[:80]!r}: has characters that are not printable; take them out"


def validated(kind: type[M], data: object, source: str, error: type[RtecError] = ConfigError) -> M:
    """Check `data` against a model class.

    Raises:
        error: all faults at once, one a line, each naming source, section, key and what is allowed.
    """
    try:
        # As JSON and strict: a list may be a tuple and a text a path, but "1000" and true are no numbers.
        return kind.model_validate_json(json.dumps(data, default=str), strict=True)
    except ValidationError as e:
        raise error("\n".join(_faults(kind, e, source))) from e


def fault_of_key(kind: type[BaseModel], key: str, value: object, source: str) -> str:
    """What is wrong with the value of one key, whatever the others are; "" where nothing is."""
    try:
        kind.model_validate_json(json.dumps({key: value}, default=str), strict=True)
    except ValidationError as e:
        return next(iter(_faults(kind, e, source, key)), "")
    return ""


def _faults(kind: type[BaseModel], error: ValidationError, source: str, key: str = "") -> list[str]:
    """The faults of one key, or of all; what a list lacks is one."""
    items = [item for item in error.errors() if not key or item["loc"][:1] == (key,)]
    return list(dict.fromkeys(_fault(kind, item, source, items) for item in items))


def digest(value: object) -> str:
    """SHA-256 of a value's canonical JSON: the same content gives the same digest, whatever its formatting."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _comma(text: str, fault: str) -> str:
    """What to write, where the faulty line gives a number with a decimal comma; else nothing."""
    at = re.search(r"at line (\d+)", fault)
    number = at and DECIMAL_COMMA.search(text.splitlines()[int(at[1]) - 1])
    return f"; a decimal mark is a point: {number[1]}.{number[2]}" if number else ""


def nearest(word: str, allowed: typing.Iterable[str]) -> str:
    """' (did you mean …?)' for the closest allowed words, or the list of all when none is close.

    Gives several if they are nearly as close as the closest: T_nut may be T_x_nut or T_z_nut.
    """
    names = sorted(allowed)
    likeness = {name: difflib.SequenceMatcher(None, name.lower(), word.lower()).ratio() for name in names}
    close = sorted((n for n in names if likeness[n] >= LIKE), key=lambda n: -likeness[n])[:MOST_NEAR]
    near = [repr(name) for name in sorted(close) if likeness[name] > likeness[close[0]] - NEARLY]
    if near:
        return f"; did you mean {', '.join(near[:-1])}{' or ' if near[:-1] else ''}{near[-1]}?"
    return f"; allowed: {', '.join(names)}" if names else ""


def _fault(kind: type[BaseModel], item: Mapping[str, Any], source: str, items: Sequence[Mapping[str, Any]]) -> str:
    loc = _joined(_without_tags(kind, item["loc"]))
    if item["type"] == "extra_forbidden":
        key = str(loc[-1])
        return f"{source}: {_section(loc[:-1])}unknown key {key!r}{nearest(key, _keys_at(kind, item['loc'][:-1]))}"
    if item["type"].startswith("union_tag"):
        tag, allowed = item["ctx"].get("tag"), item["ctx"].get("expected_tags", "")
        key = item["ctx"]["discriminator"].strip("'")
        said = f"{key}: must be one of {allowed}, found {tag!r}" if tag else f"key {key!r} is missing"
        return f"{source}: {_section(loc)}{said}"
    if item["type"] == "missing" and isinstance(item["loc"][-1], int):
        *list_loc, _ = item["loc"]
        there, needed = len(item["input"]), max(i["loc"][-1] for i in items if [*i["loc"][:-1]] == list_loc) + 1
        name = str(loc[-1]).rpartition("[")[0]
        return f"{source}: {_section(loc[:-1])}{name}: has {there} value{'s' * (there != 1)}, and {needed} are needed"
    if item["type"] == "missing":
        return f"{source}: {_section(loc[:-1])}key {str(loc[-1])!r} is missing"
    if item["type"] == "model_type":
        return f"{source}: {_section(loc)}must be a table, found {item.get('input')!r}"
    value = item.get("input")
    if item["type"] in OUT_OF_RANGE:
        item = {**item, "msg": _range_at(kind, item["loc"]) or item["msg"]}
    shown = f", found {value!r}" if isinstance(value, str | int | float | bool) else ""
    message = str(item["msg"]).removeprefix("Value error, ")
    where = f"{_section(loc[:-1])}{loc[-1]}: " if loc else ""
    return f"{source}: {where}{message}{shown}"


def _joined(loc: tuple[Any, ...]) -> tuple[Any, ...]:
    """Move the indices at the end of a place behind their key: `travel_mm`, 0 becomes `travel_mm[0]`."""
    key = len(loc)
    while key > 1 and isinstance(loc[key - 1], int):
        key -= 1
    return (*loc[: key - 1], str(loc[key - 1]) + "".join(f"[{i}]" for i in loc[key:])) if loc else ()


def _without_tags(kind: Any, loc: tuple[Any, ...]) -> tuple[Any, ...]:
    """A place without the tags that a tagged union puts into it; they are no keys."""
    return tuple(part for i, part in enumerate(loc) if not _tagged(_models_at(kind, loc[:i]), part))


def _tagged(models: Sequence[Any], part: Any) -> list[Any]:
    """The members of a union that have this tag; empty where it is a key."""
    if len(models) < 2 or any(part in model.model_fields for model in models):
        return []
    return [m for m in models if any(part in get_args(f.annotation) for f in m.model_fields.values())]


def _section(loc: tuple[Any, ...]) -> str:
    if not loc:
        return ""
    text = ""
    for part in loc:
        text += f"[{part}]" if isinstance(part, int) else f".{part}"
    return f"[{text.lstrip('.')}] "


def _keys_at(kind: Any, loc: tuple[Any, ...]) -> set[str]:
    """Keys allowed at a place of a model class."""
    return {field.alias or name for model in _models_at(kind, loc) for name, field in model.model_fields.items()}


def _models_at(kind: Any, loc: tuple[Any, ...]) -> list[Any]:
    """Model classes at a place of a model class."""
    return [k for k, _ in _kinds_at(kind, loc) if isinstance(k, type) and issubclass(k, BaseModel)]


def _range_at(kind: Any, loc: tuple[Any, ...]) -> str:
    """'must be from … to …' for the number at a place of a model class; "" if its type does not have two bounds."""
    words = {"ge": "from", "gt": "above", "le": "to", "lt": "below"}
    for _, limits in _kinds_at(kind, loc):
        flat = [item for limit in limits for item in (limit.metadata if isinstance(limit, FieldInfo) else (limit,))]
        limits_text = [f"{words[w]} {getattr(x, w):g}" for w in words for x in flat if getattr(x, w, None) is not None]
        if len(limits_text) == 2:
            return f"must be {' '.join(limits_text)}"
    return ""


def _kinds_at(kind: Any, loc: tuple[Any, ...], limits: tuple[Any, ...] = ()) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Types at a place of a model class, each with its bounds; follows dicts, lists, optionals and unions."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (typing.Union, types.UnionType):
        models = [k for k in arguments if isinstance(k, type) and issubclass(k, BaseModel)]
        tagged = _tagged(models, loc[0]) if loc else []
        for k in tagged or arguments:
            yield from _kinds_at(k, loc[1:] if tagged else loc, limits)
    elif origin is typing.Annotated:
        yield from _kinds_at(arguments[0], loc, (*limits, *arguments[1:]))
    elif loc and isinstance(kind, type) and issubclass(kind, BaseModel):
        field = {f.alias or name: f for name, f in kind.model_fields.items()}.get(str(loc[0]))
        if field:
            yield from _kinds_at(field.annotation, loc[1:], tuple(field.metadata))
    elif loc and origin is tuple and isinstance(loc[0], int) and arguments[-1] is not Ellipsis:
        yield from _kinds_at(arguments[min(loc[0], len(arguments) - 1)], loc[1:])
    elif loc and origin in (dict, list, tuple):
        yield from _kinds_at(arguments[1 if origin is dict else 0], loc[1:])
    else:
        yield kind, limits
