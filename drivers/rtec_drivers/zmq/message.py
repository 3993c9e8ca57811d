"""Messages of the ZeroMQ link, schema 1 (`docs/zmq-link.md`): JSON texts, checked key by key."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

SCHEMA = 1
TOPIC = b"rtec.state"
LARGEST = 2**63 - 1
KEYS = {
    "schema",
    "boot",
    "seq",
    "time_ns",
    "counts",
    "counts_time_ns",
    "degc",
    "spindle_rpm",
    "output",
}


class MessageError(ValueError):
    """A message that does not follow the schema."""


@dataclass(frozen=True)
class StateMessage:
    """A state that the other process publishes.

    Attributes:
        boot: text that differs after every start of it.
        seq: grows with every message.
        time_ns: instant of sending, by its clock.
        counts, counts_time_ns: raw counts by axis, and their instant of latching, by its clock.
        degc: temperature and instant of acquisition by sensor.
        spindle_rpm: spindle speed.
        output: applied output by axis, in the actuator's units.
    """

    boot: str
    seq: int
    time_ns: int
    counts: Mapping[str, int] = field(default_factory=dict)
    counts_time_ns: int = 0
    degc: Mapping[str, tuple[float, int]] = field(default_factory=dict)
    spindle_rpm: float | None = None
    output: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class CommandAnswer:
    """The other process' answer to a command.

    Attributes:
        boot, seq: its start, and the number of the command.
        refused: why it refused the command; "" where it accepted it.
    """

    boot: str
    seq: int
    refused: str


def read_state(text: bytes) -> StateMessage:
    """Read a state.

    Raises:
        MessageError: it is malformed; the message says how.
    """
    data = _object(text)
    unknown = sorted(set(data) - KEYS)
    if unknown:
        raise MessageError(f"unknown key {unknown[0]!r}")
    counts = _integers(data, "counts")
    return StateMessage(
        boot=_text(data, "boot"),
        seq=_integer(data, "seq"),
        time_ns=_integer(data, "time_ns"),
        counts=counts,
        counts_time_ns=_integer(data, "counts_time_ns") if counts else 0,
        degc={name: _reading(name, pair) for name, pair in _table(data, "degc").items()},
        spindle_rpm=_number("spindle_rpm", data["spindle_rpm"]) if "spindle_rpm" in data else None,
        output=_integers(data, "output"),
    )


def read_answer(text: bytes) -> CommandAnswer:
    """Read the answer to a command.

    Raises:
        MessageError: it is malformed; the message says how.
    """
    data = _object(text)
    refused = data.get("refused", "")
    if not isinstance(refused, str):
        raise MessageError("'refused' is no text")
    return CommandAnswer(_text(data, "boot"), _integer(data, "seq"), refused)


def command(boot: str, seq: int, output: Mapping[str, int]) -> bytes:
    """The text of a command: absolute output of every axis."""
    return json.dumps({"schema": SCHEMA, "boot": boot, "seq": seq, "output": dict(output)}).encode()


def _object(text: bytes) -> dict[str, Any]:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as e:
        raise MessageError("is no JSON text") from e
    if not isinstance(data, dict):
        raise MessageError("is no JSON object")
    if data.get("schema") != SCHEMA:
        raise MessageError(f"schema {data.get('schema')!r}; this program reads {SCHEMA}")
    return data


def _text(data: Mapping[str, Any], key: str) -> str:
    value = data.get(key)
    if not isinstance(value, str) or not 0 < len(value) <= 64:
        raise MessageError(f"{key!r} must be a text of 1 to 64 characters")
    return value


def _integer(data: Mapping[str, Any], key: str, of: str = "") -> int:
    value = data.get(key)
    if type(value) is not int or abs(value) > LARGEST:
        found = f", found {value!r:.40}" if isinstance(value, int | float | str) else ""
        raise MessageError(f"{of + key!r} must be an integer of 64 bits{found}")
    return value


def _table(data: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = data.get(key, {})
    if not isinstance(value, dict):
        raise MessageError(f"{key!r} must be an object")
    return value


def _integers(data: Mapping[str, Any], key: str) -> dict[str, int]:
    table = _table(data, key)
    return {name: _integer(table, name, f"{key}.") for name in table}


def _number(key: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise MessageError(f"{key!r} must be a number")
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise MessageError(f"{key!r} must be a number")
    return number


def _reading(name: str, pair: object) -> tuple[float, int]:
    if not isinstance(pair, list) or len(pair) != 2:
        raise MessageError(f"degc {name!r} must be [temperature, instant in ns]")
    return _number(name, pair[0]), _integer({name: pair[1]}, name)
