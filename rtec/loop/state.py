"""The loop's kept state: an image of three slots. One of them is whole at every instant, even within a write.

Slots 0 and 1 are written in turns, slot 2 at a new beginning (a reload). Each slot is a row of 64-bit words: header,
ledger, counts, zero, the step's memory, and a CRC-32 of all that. Behind it is a text with a CRC of its own: why the
loop waits for an order to resume. The CRC of a slot that was not written to its
end does not match; the other slot then still holds the cycle before. The loop writes a slot every cycle *before* the
command goes out: after a kill, the ledger is the actuator's last command, or the one that was about to go out.
"""

import hashlib
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rtec.arrays import Ints
from rtec.errors import ModelError
from rtec.loop.records import Samples, StepState
from rtec.loop.zero import UNKNOWN, Zero

if TYPE_CHECKING:
    from rtec.loop.step import Step

SLOT_BYTES: Final = 32_768
SLOTS: Final = 3
IMAGE_BYTES: Final = SLOTS * SLOT_BYTES
SNAPSHOT: Final = 2
_MAGIC: Final = int.from_bytes(b"rtecsta2", "little")
_WORD: Final = 8
_HEAD: Final = 20
(_AT_MAGIC, _AT_SEQUENCE, _AT_ROW, _AT_TIME, _AT_MODE, _AT_START_MODE, _AT_CLEAN, _AT_WAITS) = range(8)
(_AT_AXES, _AT_INTS, _AT_FLOATS) = range(8, 11)
_AT_STRUCTURE: Final = slice(11, 15)
_AT_UNITS: Final = slice(15, 18)
_AT_SUPPLY, _AT_HOMED = 18, 19
_WHY_WORDS: Final = 64
WHY_BYTES: Final = (_WHY_WORDS + 1) * _WORD
"""Bytes behind a slot: the text, and its CRC."""


@dataclass(frozen=True)
class Saved:
    """One slot that was read whole.

    Attributes:
        sequence: number of slots written before it.
        row: number of the cycle's row in the ring.
        time_ns: the cycle's instant, monotonic clock.
        mode: the ordered mode.
        start_mode: the run file's mode at the start.
        clean: did the run end in order?
        waits: did it wait for an order to resume?
        output: ledger, in the sink's units, by axis.
        counts: counts from the machine's zero, by axis.
        zero: counts that were added to those of the device, by axis.
        supply: number of the device's start; -1 where it is not known.
        homed: had positions been ordered since that start?
        structure: of the step whose memory this is (`structure_of`).
        units: units of output and counts (`units_of`).
        state: the step's memory.
        words: the slot itself.
        why: what it waited for the order about; "" where that is not known, or it did not wait.
    """

    sequence: int
    row: int
    time_ns: int
    mode: int
    start_mode: int
    clean: bool
    waits: bool
    output: Ints
    counts: Ints
    zero: Ints
    supply: int
    homed: bool
    structure: bytes
    units: bytes
    state: StepState
    words: bytes
    why: str = ""


def structure_of(step: "Step") -> bytes:
    """Hash of 32 bytes; equal where memory of two steps has the same meaning: model, places, names, units."""
    digest = hashlib.sha256(step.source.memory.encode())
    digest.update(units_of(step))
    return digest.digest()


def units_of(step: "Step") -> bytes:
    """Hash of 24 bytes; equal where ledger and counts of two steps have the same meaning."""
    digest = hashlib.sha256(repr(step.layout.axes).encode())
    for name in ("counts_per_mm", "per_um", "quantum"):
        digest.update(step.constants(name).tobytes())
    return digest.digest()[:24]


class StateWriter:
    """Keeps the state of one step in an image; a call writes some hundred bytes and waits for nothing.

    Attributes:
        sequence: number of slots written to this image so far, by all writers.
        start_mode: the mode of the run file.
        order: the ordered mode.
        waits: does the loop wait for an order to resume?

    Args:
        image: `IMAGE_BYTES` bytes, shared or not.
        step: the step whose memory is kept.
        start_mode: the mode of the run file.
        sequence: that of an earlier writer of this image.
        zero: zero of the axes; None: the counts of the device are the machine's.

    Raises:
        ModelError: the step's memory does not fit.
    """

    def __init__(
        self, image: NDArray[np.uint8], step: "Step", start_mode: int, sequence: int = 0, zero: Zero | None = None
    ) -> None:
        self.sequence, self.start_mode, self.order, self.waits = sequence, start_mode, start_mode, False
        self.zero, axes, state = zero, len(step.layout.axes), step.state
        words = _HEAD + 3 * axes + state.ints.size + state.floats.size
        most = SLOT_BYTES // _WORD - 2 - _WHY_WORDS
        if words > most:
            raise ModelError(f"the step needs {words} words of memory; at most {most} can be kept")
        self._state, self._why = state, b"?"
        self._slots = [_Slot(image, k, axes, state.ints.size, state.floats.size) for k in range(SLOTS)]
        self._head = head = np.zeros(_HEAD, np.int64)
        head[_AT_MAGIC], head[_AT_START_MODE] = _MAGIC, start_mode
        head[_AT_SUPPLY] = UNKNOWN
        head[_AT_AXES], head[_AT_INTS], head[_AT_FLOATS] = axes, state.ints.size, state.floats.size
        head[_AT_STRUCTURE] = np.frombuffer(structure_of(step), np.int64)
        head[_AT_UNITS] = np.frombuffer(units_of(step), np.int64)

    def keep(self, samples: Samples, output: Ints, row: int) -> None:
        """Keep the state after this cycle."""
        self.sequence += 1
        self._write(self._slots[self.sequence & 1], samples, output, row, 0)

    def tell_why(self, text: str) -> None:
        """Keep why the loop waits for an order to resume, in all slots; does nothing where that is kept already."""
        content = text.encode()[: _WHY_WORDS * _WORD].ljust(_WHY_WORDS * _WORD, b"\0")
        if content != self._why:
            self._why = content
            for slot in self._slots:
                slot.why[:] = np.frombuffer(content + zlib.crc32(content).to_bytes(_WORD, "little"), np.int64)

    def snapshot(self, samples: Samples, output: Ints, row: int) -> None:
        """Keep it in the third slot: the state from which a new set-up begins after this row."""
        self._write(self._slots[SNAPSHOT], samples, output, row, 0)

    def finish(self, samples: Samples, output: Ints, row: int) -> None:
        """Keep it as the last state: the run ended in order."""
        self.sequence += 1
        self._write(self._slots[self.sequence & 1], samples, output, row, 1)

    def _write(self, slot: "_Slot", samples: Samples, output: Ints, row: int, clean: int) -> None:
        head = self._head
        head[_AT_SEQUENCE], head[_AT_ROW] = self.sequence, row
        head[_AT_TIME], head[_AT_MODE] = samples.time_ns[0], self.order
        head[_AT_CLEAN], head[_AT_WAITS] = clean, self.waits
        if self.zero is not None:
            head[_AT_SUPPLY], head[_AT_HOMED] = self.zero.supply, self.zero.by_order and self.zero.known
            slot.zero[:] = self.zero.offset
        slot.head[:] = head
        slot.output[:] = output
        slot.counts[:] = samples.counts[0]
        slot.ints[:] = self._state.ints
        slot.floats[:] = self._state.floats
        slot.crc[0] = zlib.crc32(slot.body)


class _Slot:
    """Views of one slot of an image; making them changes nothing in the image."""

    def __init__(self, image: NDArray[np.uint8], k: int, axes: int, ints: int, floats: int) -> None:
        sizes = (_HEAD, axes, axes, axes, ints, floats)
        used = sum(sizes)
        words = image[k * SLOT_BYTES : k * SLOT_BYTES + (used + 2 + _WHY_WORDS) * _WORD].view(np.int64)
        self.head, self.output, self.counts, self.zero, self.ints, rest = np.split(words[:used], np.cumsum(sizes)[:-1])
        self.floats = rest.view(np.float64)
        self.crc, self.why = words[used : used + 1], words[used + 1 :]
        self.body = memoryview(words[:used]).cast("B")  # type: ignore[arg-type]


def read_slot(image: bytes, k: int) -> Saved | None:
    """Give a slot; None where it is not whole."""
    words = np.frombuffer(image[k * SLOT_BYTES : (k + 1) * SLOT_BYTES].ljust(SLOT_BYTES, b"\0"), np.int64)
    axes, ints, floats = (int(words[at]) for at in (_AT_AXES, _AT_INTS, _AT_FLOATS))
    if words[_AT_MAGIC] != _MAGIC or min(axes, ints, floats) < 0 or max(axes, ints, floats) >= words.size:
        return None
    ends = np.cumsum([_HEAD, axes, axes, axes, ints, floats])
    used = int(ends[-1])
    if used >= words.size or zlib.crc32(words[:used].tobytes()) != words[used]:
        return None
    head, output, counts, zero, its, rest = (part.copy() for part in np.split(words[:used], ends[:-1]))
    return Saved(
        sequence=int(head[_AT_SEQUENCE]),
        row=int(head[_AT_ROW]),
        time_ns=int(head[_AT_TIME]),
        mode=int(head[_AT_MODE]),
        start_mode=int(head[_AT_START_MODE]),
        clean=bool(head[_AT_CLEAN]),
        waits=bool(head[_AT_WAITS]),
        output=output,
        counts=counts,
        zero=zero,
        supply=int(head[_AT_SUPPLY]),
        homed=bool(head[_AT_HOMED]),
        structure=head[_AT_STRUCTURE].tobytes(),
        units=head[_AT_UNITS].tobytes(),
        state=StepState(rest.view(np.float64), its),
        words=words[: used + 2 + _WHY_WORDS].tobytes(),
        why=_why(words[used + 1 : used + 2 + _WHY_WORDS].tobytes()) if head[_AT_WAITS] else "",
    )


def _why(content: bytes) -> str:
    """The text behind a slot; "" where it is not whole."""
    text, crc = content[:-_WORD], content[-_WORD:]
    whole = len(content) == (_WHY_WORDS + 1) * _WORD and zlib.crc32(text) == int.from_bytes(crc, "little")
    return text.rstrip(b"\0").decode(errors="ignore") if whole else ""


def newest(image: bytes) -> Saved | None:
    """The later of the first two slots that are whole; None where neither is."""
    whole = [saved for k in range(2) if (saved := read_slot(image, k)) is not None]
    return max(whole, key=lambda saved: saved.sequence, default=None)


def is_damaged(image: bytes) -> bool:
    """Was a state kept here of which no slot is whole? An image that nobody wrote to is all zeros."""
    return newest(image) is None and any(image[: SNAPSHOT * SLOT_BYTES])


def state_text(state: StepState) -> dict[str, Any]:
    """A step's memory as plain data, to the last bit; for the header of a log."""
    return {"floats": [x.hex() for x in state.floats.tolist()], "ints": state.ints.tolist()}


def state_from_text(text: Any, like: StepState) -> StepState | None:
    """Read the result of `state_text`; None where the text is malformed, or its size differs from that of `like`."""
    try:
        floats = np.array([float.fromhex(x) for x in text["floats"]])
        ints = np.array([int(x) for x in text["ints"]], np.int64)
    except (TypeError, ValueError, KeyError, OverflowError):
        return None
    if floats.shape != like.floats.shape or ints.shape != like.ints.shape:
        return None
    return StepState(floats, ints)
