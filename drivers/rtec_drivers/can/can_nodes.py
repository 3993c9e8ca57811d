"""Watches CANopen devices: heartbeat, state, boot-up and emergency messages (CiA 301)."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from rtec.tomlfile import Strict

HEARTBEAT, EMERGENCY, NMT = 0x700, 0x080, 0x000
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
STATES = {BOOT_UP: "has just started", STOPPED: "is stopped", PRE_OPERATIONAL: "is pre-operational"}
START = 1


class NodeOptions(Strict):
    """A CANopen device that is watched.

    Attributes:
        id: its number.
        heartbeat_s: longest time between two heartbeats (a little more than its object 1017h says).
        start: order it to become operational when it is not; leave false where another master does so.
    """

    id: Annotated[int, Field(ge=1, le=127)]
    heartbeat_s: Annotated[float, Field(gt=0, le=120)] = 2.0
    start: bool = False


class NodeWatch:
    """What the devices say of themselves."""

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
        """Take in a frame; give the content of an NMT order that should be sent, or None."""
        base, number = identifier & ~0x7F, identifier & 0x7F
        node = self._nodes.get(number)
        if node is None or not data:
            return None
        if base == EMERGENCY and len(data) >= 2:
            self._emergency[number] = int.from_bytes(data[:2], "little")
        if base != HEARTBEAT:
            return None
        self._seen_ns[number], self._state[number] = now_ns, data[0] & 0x7F
        if self._state[number] != OPERATIONAL and node.start:
            return bytes([START, number])
        return None

    def faults(self, now_ns: int) -> list[str]:
        """What is wrong with them, one line each."""
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
