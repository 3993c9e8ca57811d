"""The box's end of the link for tests: the payloads that it sends and reads, and encoders that the test moves."""

import struct

from rtec_drivers.box.protocol import MAX_AXES, BoxState, Info

_INFO, _STATE = "<HIBBHI", "<HBHI"


def command_of(payload: bytes) -> tuple[int, tuple[int, ...]] | None:
    """Boot number and targets of a COMMAND; None where the length is wrong."""
    axes, rest = divmod(len(payload) - 2, 4)
    if rest or not 0 < axes <= MAX_AXES:
        return None
    boot, *targets = struct.unpack(f"<H{axes}i", payload)
    return boot, tuple(targets)


def info_payload(info: Info) -> bytes:
    """Payload of INFO."""
    return struct.pack(
        _INFO, info.boot, info.box_serial, info.axes, info.counter_bits, info.hold_after_ms, info.counts_per_s
    )


def state_payload(state: BoxState) -> bytes:
    """Payload of STATE: after the header counts and ledger, axis by axis."""
    pairs = [n for pair in zip(state.counts, state.ledger, strict=True) for n in pair]
    head = struct.pack(_STATE, state.boot, state.status, state.last_command, state.time_us)
    return head + struct.pack("<" + "Ii" * len(state.counts), *pairs)


class StillPlant:
    """Encoders that the test moves.

    Attributes:
        position: raw counts.
        inserted: surplus of the controller's counts.
    """

    def __init__(self, axes: int) -> None:
        self.position = [0] * axes
        self.inserted = [0] * axes

    def counts(self, now_ns: int) -> list[int]:
        """The present position."""
        del now_ns
        return list(self.position)

    def insert(self, ledger: list[int]) -> None:
        """Record it."""
        self.inserted = list(ledger)
