"""The place of a number in a frame: a signal of a DBC file, or an object in a CANopen PDO.

Watches CANopen devices: heartbeat, state, boot-up and emergency messages (CiA 301).
"""

import importlib
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from rtec.errors import ConfigError, DriverFault, DriverUnavailable
from rtec.tomlfile import Strict, nearest
from rtec.wording import counted

ObjectType = Literal["i8", "u8", "i16", "u16", "i24", "u24", "i32", "u32", "i64", "u64", "f32", "f64"]
PDO_IDS = {1: 0x180, 2: 0x280, 3: 0x380, 4: 0x480}
"""CiA 301, pre-defined connection set: identifiers of transmit PDOs, to which the node's number is added."""
Decoder = Callable[[bytes], float]


class SignalOptions(Strict):
    """Place of a number: either `message` and `signal` of the DBC file, or `node`, `pdo` and `map`.

    Attributes:
        message, signal: names in the DBC file; its own scale and offset are used.
        node: CANopen number of the device.
        pdo: number of its transmit PDO, 1 to 4.
        cob_id: identifier of the PDO where it is not the pre-defined one.
        map: types of the objects in the PDO, in order (as in the device's object 1A00h to 1A03h).
        item: index of the number among them, from 1.
    """

    message: str | None = None
    signal: str | None = None
    node: Annotated[int, Field(ge=1, le=127)] | None = None
    pdo: Literal[1, 2, 3, 4] = 1
    cob_id: Annotated[int, Field(ge=1, le=0x7FF)] | None = None
    map: Annotated[tuple[ObjectType, ...], Field(max_length=8)] = ()
    item: Annotated[int, Field(ge=1, le=8)] = 1

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.message is None) != (self.signal is None):
            raise ValueError("message and signal go together")
        if (self.message is None) == (self.node is None):
            raise ValueError("give either message and signal (DBC), or node, pdo and map (CANopen)")
        if self.node is not None and not self.map:
            raise ValueError('map is missing: the types of the objects in the PDO, for example ["i16", "i16"]')
        if self.node is not None and self.item > len(self.map):
            raise ValueError(f"item {self.item}: map has only {len(self.map)}")
        if sum(_bytes(t) for t in self.map) > 8:
            raise ValueError("map has more than 8 bytes, which no PDO has")
        return self


@dataclass(frozen=True)
class SignalSource:
    """Reader of a number in a frame.

    Attributes:
        identifier, extended: identifier of the frame.
        number: reads it from the frame's content; raises DriverFault where it is missing.
        bits: width of a whole number; 64 for others.
    """

    identifier: int
    extended: bool
    number: Decoder
    bits: int = 64


class Dbc:
    """A DBC file, read for the first signal.

    Args:
        path: the file, or None where the device has none.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._database: Any = None

    def source(self, options: SignalOptions, scaled: bool) -> SignalSource:
        """The reader of a signal.

        Args:
            options: its names, or its place in a PDO.
            scaled: with the file's scale and offset, or the bare number.

        Raises:
            ConfigError: the message or signal does not exist, or there is no DBC file.
            DriverUnavailable: the package that reads DBC files is not installed.
        """
        if options.node is not None:
            return _pdo_source(options)
        if self._database is None:
            self._database = self._read()
        names = {m.name: m for m in self._database.messages}
        message = names.get(options.message)
        if message is None:
            raise ConfigError(f"{self._path}: no message {options.message!r}{nearest(str(options.message), names)}")
        signals = [s.name for s in message.signals]
        if options.signal not in signals:
            where = f"{self._path}: message {message.name}"
            raise ConfigError(f"{where} has no signal {options.signal!r}{nearest(str(options.signal), signals)}")
        signal = message.get_signal_by_name(options.signal)
        decoder = _dbc_decoder(message, signal.name, scaled)
        return SignalSource(
            message.frame_id, message.is_extended_frame, decoder, 64 if signal.is_float else signal.length
        )

    def _read(self) -> Any:
        if self._path is None:
            raise ConfigError("signals are named, but no dbc file is given")
        try:
            cantools = importlib.import_module("cantools")
        except ImportError as e:
            raise DriverUnavailable("DBC files need the package cantools: pip install 'rtec[can]'") from e
        try:
            return cantools.database.load_file(self._path)
        except (OSError, UnicodeDecodeError) as e:
            raise ConfigError(f"{self._path}: cannot be read: {e}") from e
        except cantools.database.Error as e:
            raise ConfigError(f"{self._path}: not a good DBC file: {e}") from e


def _dbc_decoder(message: Any, signal: str, scaled: bool) -> Decoder:
    def number(data: bytes) -> float:
        try:
            content = message.decode(data, decode_choices=False, scaling=scaled)
        except (
            ValueError,
            KeyError,
        ) as e:  # cantools' DecodeError is a ValueError in some releases, an Error in others
            raise DriverFault(f"frame {message.name}: cannot be decoded: {e}") from e
        except Exception as e:
            if type(e).__module__.startswith(("cantools", "bitstruct")):
                raise DriverFault(f"frame {message.name}: cannot be decoded: {e}") from e
            raise
        if signal not in content:
            raise DriverFault(f"frame {message.name}: signal {signal} is not in this one (multiplexed)")
        value: float = content[signal]
        return value

    return number


def _pdo_source(options: SignalOptions) -> SignalSource:
    start = sum(_bytes(t) for t in options.map[: options.item - 1])
    kind = options.map[options.item - 1]
    end, whole = start + _bytes(kind), sum(_bytes(t) for t in options.map)
    identifier = options.cob_id if options.cob_id is not None else PDO_IDS[options.pdo] + (options.node or 0)

    def number(data: bytes) -> float:
        if len(data) < whole:  # CiA 301: a PDO that is shorter than its map is not processed
            raise DriverFault(
                f"{identifier:X}h comes with {counted(len(data), 'byte')}, {whole} are needed for map "
                f"{', '.join(options.map)}; compare map with the device's object 1A0{options.pdo - 1}h"
            )
        part = data[start:end]
        if kind in ("f32", "f64"):
            return float(struct.unpack("<f" if kind == "f32" else "<d", part)[0])
        return int.from_bytes(part, "little", signed=kind[0] == "i")

    return SignalSource(identifier, False, number, 64 if kind in ("f32", "f64") else 8 * _bytes(kind))


def _bytes(kind: str) -> int:
    return int(kind[1:]) // 8


HEARTBEAT, EMERGENCY, NMT = 0x700, 0x080, 0x000
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
STATES = {BOOT_UP: "has just started", STOPPED: "is stopped", PRE_OPERATIONAL: "is pre-operational"}
START = 1


class NodeOptions(Strict):
    """A CANopen device to watch.

    Attributes:
        id: number of the node.
        heartbeat_s: longest time between two heartbeats (a little more than in its object 1017h).
        start: order it to become operational when it is not; keep false where another master does so.
    """

    id: Annotated[int, Field(ge=1, le=127)]
    heartbeat_s: Annotated[float, Field(ge=1e-3, le=120)] = 2.0
    start: bool = False


class NodeWatch:
    """State of the watched devices, from their messages."""

    def __init__(self, nodes: Sequence[NodeOptions]) -> None:
        self._nodes = {n.id: n for n in nodes}
        self._seen_ns: dict[int, int] = {}
        self._state: dict[int, int] = {}
        self._emergency: dict[int, int] = {}
        self._since_ns = -1

    def identifiers(self) -> list[tuple[int, bool]]:
        """Identifiers that must pass the filter."""
        return [(base + n, False) for n in self._nodes for base in (HEARTBEAT, EMERGENCY)]

    def frame(self, identifier: int, data: bytes, now_ns: int) -> bytes | None:
        """Process a frame; give the content of an NMT order to send, or None."""
        base, number = identifier & ~0x7F, identifier & 0x7F
        node = self._nodes.get(number)
        if node is None or not data:
            return None
        if base == EMERGENCY and len(data) >= 2:
            self._emergency[number] = int.from_bytes(data[:2], "little")
        if base != HEARTBEAT:
            return None
        self._seen_ns[number], self._state[number] = now_ns, data[0] & 0x7F
        if self._state[number] == BOOT_UP:  # what it reported before its restart is over
            self._emergency.pop(number, None)
        if self._state[number] != OPERATIONAL and node.start:
            return bytes([START, number])
        return None

    def faults(self, now_ns: int) -> list[str]:
        """Present faults of the devices, one line each."""
        if self._since_ns < 0:
            self._since_ns = now_ns
        out = []
        for number, node in self._nodes.items():
            age_s = (now_ns - self._seen_ns.get(number, self._since_ns)) * 1e-9
            state, emergency = self._state.get(number, OPERATIONAL), self._emergency.get(number, 0)
            if age_s > node.heartbeat_s:
                out.append(f"node {number}: no heartbeat for {age_s:.1f} s")
            elif state != OPERATIONAL:
                out.append(f"node {number} {STATES.get(state, f'is in state {state}')}: it sends no process data")
            if emergency:
                out.append(f"node {number}: emergency message, error code {emergency:04X}h")
        return out
