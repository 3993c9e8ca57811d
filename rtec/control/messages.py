"""Messages between a daemon and its clients, schema 1 (`docs/control.md`): JSON texts, checked key by key."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from rtec.loop.orders import LONGEST_TEXT, Order, OrderRefused, order_named

SCHEMA: Final = 1
LARGEST_REQUEST: Final = 4096
"""Bytes; a longer request is not read."""
_KEYS: Final = {
    "status": {"schema", "ask", "id"},
    "watch": {"schema", "ask", "id"},
    "as": {"schema", "ask", "id", "name", "role"},
    "session": {"schema", "ask", "id"},
    "order": {"schema", "ask", "id", "session", "seq", "order", "text"},
}
_SESSION: Final = re.compile("[0-9a-f]{32}")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_LARGEST: Final = 2**53
Role = Literal["read", "operate"]


class RequestError(ValueError):
    """A request that does not follow the schema."""


@dataclass(frozen=True)
class Request:
    """A client's request.

    Attributes:
        ask: kind of request.
        id: number that the answer repeats; None: none was given.
        session, seq, order, text: of an order.
        name, role: the client's, from now on.
    """

    ask: Literal["status", "watch", "as", "session", "order"]
    id: int | None = None
    session: str = ""
    seq: int = 0
    order: Order = Order.MARK
    text: str = ""
    name: str = ""
    role: Role = "read"


def read_request(message: bytes) -> Request:
    """Read a request.

    Raises:
        RequestError: it is malformed; the message says how.
    """
    data = _object(message)
    ask = data.get("ask")
    if not isinstance(ask, str) or ask not in _KEYS:
        raise RequestError(f"'ask' must be one of {', '.join(_KEYS)}")
    unknown = sorted(set(data) - _KEYS[ask])
    if unknown:
        raise RequestError(f"unknown key {unknown[0][:40]!r}")
    number = _integer(data, "id") if "id" in data else None
    if ask == "as":
        return Request("as", number, name=name_of(data.get("name")), role=_role(data))
    if ask != "order":
        return Request(ask, number)  # type: ignore[arg-type]
    return Request("order", number, _session(data), _integer(data, "seq"), _order(data), _text(data))


def request(ask: str, number: int, **more: object) -> bytes:
    """The text of a request."""
    return json.dumps({"schema": SCHEMA, "ask": ask, "id": number, **more}).encode()


def answer(request_id: int | None, content: Mapping[str, Any]) -> bytes:
    """The text of an answer."""
    head = {"schema": SCHEMA} if request_id is None else {"schema": SCHEMA, "id": request_id}
    return json.dumps({**head, **content}, allow_nan=False).encode()


def read_answer(message: bytes) -> dict[str, Any]:
    """Read an answer.

    Raises:
        RequestError: it has another schema, or is no answer.
    """
    return _object(message, longest=None)


def may_be_text(value: str) -> bool:
    """May it be an order's text? Control characters act on terminals; half a surrogate makes a file malformed."""
    return len(value) <= LONGEST_TEXT and value.isprintable()


def name_of(value: object) -> str:
    """Check the name of a client, and return it.

    Raises:
        RequestError: it is not allowed.
    """
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise RequestError("'name' must have letters, digits, '.', '-' and '_', at most 40")
    return value


def numbers(value: Any) -> Any:
    """The same value with None for every number that is not finite, which JSON cannot hold."""
    if isinstance(value, Mapping):
        return {str(k): numbers(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [numbers(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _object(message: bytes, longest: int | None = LARGEST_REQUEST) -> dict[str, Any]:
    if longest is not None and len(message) > longest:
        raise RequestError(f"longer than {longest} bytes")
    try:
        data = json.loads(message.decode())
    except (ValueError, RecursionError) as e:
        raise RequestError("is no JSON text") from e
    if not isinstance(data, dict):
        raise RequestError("is no JSON object")
    schema = data.get("schema")
    if type(schema) is not int or schema != SCHEMA:
        raise RequestError(f"'schema' must be {SCHEMA}")
    return data


def _integer(data: Mapping[str, Any], key: str) -> int:
    value = data.get(key)
    if type(value) is not int or not 0 <= value <= _LARGEST:
        raise RequestError(f"{key!r} must be an integer from 0 to 2^53")
    return value


def _role(data: Mapping[str, Any]) -> Role:
    role = data.get("role")
    if role not in ("read", "operate"):
        raise RequestError("'role' must be 'read' or 'operate'")
    return "read" if role == "read" else "operate"


def _session(data: Mapping[str, Any]) -> str:
    value = data.get("session")
    if not isinstance(value, str) or not _SESSION.fullmatch(value):
        raise RequestError("'session' must be what the answer to `session` said")
    return value


def _order(data: Mapping[str, Any]) -> Order:
    value = data.get("order")
    if not isinstance(value, str):
        raise RequestError("'order' must be the name of an order")
    try:
        return order_named(value)
    except OrderRefused as e:
        raise RequestError(str(e)) from e


def _text(data: Mapping[str, Any]) -> str:
    value = data.get("text", "")
    if not isinstance(value, str) or not may_be_text(value):
        raise RequestError(f"'text' must be a text of at most {LONGEST_TEXT} printable characters")
    return value
