"""Lists the identifiers on a CAN bus and the bytes that change. Sends nothing."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Self

from rtec.loop.clock import Clock
from rtec.wording import counted
from rtec_drivers.can.bus import CanLink, CanOptions
from rtec_drivers.can.signals import PDO_IDS
from rtec_drivers.temperatures import in_room

LISTEN_S: Final = 5.0
STEP_NS: Final = 100_000_000
DRAIN_NS: Final = 50_000_000
PLACE: Final = "frame {:03X}h, bytes {}-{}"


@dataclass
class HeardFrames:
    """All frames with one identifier.

    Attributes:
        data: content of the newest.
        count: number of frames.
        changed: indices of the bytes that changed.
    """

    data: bytes
    count: int = 0
    changed: frozenset[int] = frozenset()

    def take(self, data: bytes) -> None:
        """Add a frame."""
        self.changed |= {k for k, (a, b) in enumerate(zip(self.data, data, strict=False)) if a != b}
        self.data, self.count = data, self.count + 1


class CanScanner:
    """Listens on a CAN bus.

    Args:
        options: the interface.
        clock: clock of the durations.
        kind: kind of number to look for.
        listen_s: duration; None: some seconds.

    Attributes:
        duration: duration of the search, in words.
        heard: frames by identifier, and whether that has 29 bits.
    """

    def __init__(
        self, options: CanOptions, clock: Clock, kind: Literal["temperature", "axis"], listen_s: float | None = None
    ) -> None:
        self._listen_s = LISTEN_S if listen_s is None else listen_s
        self.duration = f"{self._listen_s:g} s"
        self.heard: dict[tuple[int, bool], HeardFrames] = {}
        self._options, self._clock, self._kind = options, clock, kind
        self._link: CanLink | None = None

    def __enter__(self) -> Self:
        """Open the interface.

        Raises:
            DriverUnavailable: it cannot be opened.
        """
        self._link = CanLink(self._options, ())
        return self

    def __exit__(self, *error: object) -> None:
        """Close the interface."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def search(self) -> Iterator[tuple[float, str]]:
        """Listen; name the identifiers at the end."""
        start_ns, long_ns = self._clock.now_ns(), round(self._listen_s * 1e9)
        while (passed_ns := self._clock.now_ns() - start_ns) < long_ns:
            yield passed_ns / long_ns, ""
            self._listen(min(STEP_NS, long_ns - passed_ns))
        yield 1.0, "" if self.heard else f"nothing came in {self._listen_s:g} s: bit rate, wiring, termination?"
        for (identifier, extended), frames in sorted(self.heard.items()):
            yield 1.0, self._about(identifier, extended, frames)

    def read(self) -> dict[str, float]:
        """Newest number at every place."""
        self._listen(DRAIN_NS)
        return {place: number for place, (_, _, number) in self._places().items()}

    def proposed(self, names: Sequence[str]) -> dict[str, str]:
        """In the order of the identifiers: plausible room temperatures; positions only if there are as many as axes."""
        there = self._places()
        if self._kind == "axis":
            return dict(zip(names, there, strict=True)) if len(there) == len(names) else {}
        could_be = [place for place, (_, kind, number) in there.items() if in_room(number, kind == "f32")]
        return dict(zip(names, could_be, strict=False)) if len(could_be) >= len(names) else {}

    def table(self, places: Mapping[str, str], unit: float) -> dict[str, Any]:
        """`temperature`, or `axis` with `sync`: positions that come unasked need no SYNC."""
        there = self._places()
        out = {name: self._signal(there[place][0], place) for name, place in places.items()}
        if self._kind == "axis":
            return {"sync": False, "axis": out}
        return {"temperature": {name: signal | {"scale": unit} for name, signal in out.items()}}

    def _listen(self, long_ns: int) -> None:
        """Receive frames for that time; on a quiet bus `receive` itself waits."""
        end_ns = self._clock.now_ns() + long_ns
        while self._link is not None and self._clock.now_ns() < end_ns:
            message = self._link.receive()
            if message is not None and not message.is_error_frame and not message.is_remote_frame:
                key, data = (message.arbitration_id, bool(message.is_extended_id)), bytes(message.data)
                self.heard.setdefault(key, HeardFrames(data)).take(data)

    def _places(self) -> dict[str, tuple[int, str, float]]:
        """Identifier, type and number by place: only frames with 11 bits, which need no DBC file."""
        out: dict[str, tuple[int, str, float]] = {}
        for (identifier, extended), frames in sorted(self.heard.items()):
            at = 0
            for kind in () if extended else self._map(frames.data):
                end = at + int(kind[1:]) // 8
                if kind != "u8":
                    place = PLACE.format(identifier, at, end - 1)
                    out[place] = (identifier, kind, _number(kind, frames.data[at:end]))
                at = end
        return out

    def _map(self, data: bytes) -> list[str]:
        """Types of a frame's numbers: positions of 32 bits; floats that may be room temperatures, else 16 bits."""
        if self._kind == "axis":
            return ["u32"] * (len(data) // 4)
        out, at = [], 0
        while at < len(data):
            remaining = len(data) - at
            if remaining >= 4 and in_room(_number("f32", data[at : at + 4]), degc=True):
                out.append("f32")
            else:
                out.append("i16" if remaining >= 2 else "u8")
            at += int(out[-1][1:]) // 8
        return out

    def _signal(self, identifier: int, place: str) -> dict[str, Any]:
        kinds = self._map(self.heard[identifier, False].data)
        starts = [sum(int(kind[1:]) // 8 for kind in kinds[:k]) for k in range(len(kinds))]
        item = next(k for k, at in enumerate(starts) if f" {at}-" in place)
        pdo, node = _pdo(identifier)
        named = {"node": node, "pdo": pdo} if pdo else {"node": max(node, 1), "cob_id": identifier}
        return {**named, "map": kinds, "item": item + 1}

    def _about(self, identifier: int, extended: bool, frames: HeardFrames) -> str:
        pdo, node = (0, 0) if extended else _pdo(identifier)
        name = f"{identifier:08X}h (29 bits: its signals need a DBC file)" if extended else f"{identifier:03X}h"
        name += f" (in CANopen: process data {pdo} of node {node})" if pdo else ""
        rate = frames.count / self._listen_s
        often = f"{rate:.0f} a second" if rate >= 1 else f"{counted(frames.count, 'time')} in {self._listen_s:g} s"
        changing = ", ".join(map(str, sorted(frames.changed)))
        what = f"bytes that change: {changing}" if changing else "always the same"
        return f"frame {name}: {counted(len(frames.data), 'byte')}, {often}, {what}"


def _pdo(identifier: int) -> tuple[int, int]:
    """Number and node of a process data object; number 0 where it is none of the pre-defined ones."""
    node = identifier & 0x7F
    return next((pdo for pdo, base in PDO_IDS.items() if identifier & ~0x7F == base and node), 0), node


def _number(kind: str, data: bytes) -> float:
    if kind == "f32":
        return float(struct.unpack("<f", data)[0])
    return float(int.from_bytes(data, "little", signed=kind[0] == "i"))
