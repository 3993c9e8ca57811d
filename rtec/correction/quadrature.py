"""Quadrature: x4 decoding of two lines A and B, and the reverse.

    phase = 2 B + (A xor B)      A B = 00, 10, 11, 01  ->  phase 0, 1, 2, 3
    count(n) = count(n-1) + 1, 0, -1    where phase(n) - phase(n-1) = 1, 0, 3 (mod 4)

Every edge of A or B is one count; A leads B = positive [NIST guidelines, section 4.2.1]. In a step of 2 both lines
changed between two samples, so the direction is lost: it counts as illegal and does not change the count.

Samples are bytes; A and B are two of their bits. The kernels allocate nothing. Where that is faster they decode eight
samples at a time: one 64-bit word, whose lowest byte is the earliest sample (little-endian machines). `totals` is net
counts, illegal transitions, legal edges; the kernels add to it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtec.arrays import Ints
from rtec.errors import ConfigError
from rtec.jit import njit

GROUP_SAMPLES = 64
"""Samples that `count_words` skips at once where neither line moves; it takes whole groups only."""

_ONES = np.uint64(0x0101010101010101)
_EVEN_BYTES = np.uint64(0x00FF00FF00FF00FF)
_U8, _U16, _U32, _U56 = np.uint64(8), np.uint64(16), np.uint64(32), np.uint64(56)
_LOW16 = np.uint64(0xFFFF)
_ZERO = np.uint64(0)
_GROUP = GROUP_SAMPLES // 8


@njit
def _sum_of_bytes(word: Any) -> Any:
    """Sum of the eight bytes of a word; each may be up to 255."""
    word = (word & _EVEN_BYTES) + ((word >> _U8) & _EVEN_BYTES)
    word = word + (word >> _U16)
    return (word + (word >> _U32)) & _LOW16


@njit
def _step(old: int, new: int) -> int:
    """Change of count between two phases; 2: illegal."""
    step = (new - old) & 3
    return -1 if step == 3 else step


@njit
def phase_of_sample(sample: int, a_bit: int, b_bit: int) -> int:
    """Phase, 0 to 3, of one sample."""
    a = (sample >> a_bit) & 1
    b = (sample >> b_bit) & 1
    return 2 * b + (a ^ b)


@njit
def count_bytes(samples: Any, a_bit: int, b_bit: int, phase: int, totals: Any) -> int:
    """Count one sample at a time, for the ends that do not fill a word; give the last phase."""
    for i in range(len(samples)):
        new = phase_of_sample(int(samples[i]), a_bit, b_bit)
        step = _step(phase, new)
        if step == 2:
            totals[1] += 1
        elif step != 0:
            totals[0] += step
            totals[2] += 1
        phase = new
    return phase


@njit
def count_words(words: Any, a_bit: Any, b_bit: Any, before: Any, totals: Any) -> None:
    """Count whole words, eight at a time; `before` holds the sample before the first in its highest byte.

    One bit a sample: a line changed where it differs from the sample before it. With A(n) xor B(n-1) = 1 a legal
    edge counts up, otherwise down.
    """
    mask = (_ONES << a_bit) | (_ONES << b_bit)
    up_total, legal_total, illegal_total = np.int64(0), np.int64(0), np.int64(0)
    for group in range(0, len(words) - _GROUP + 1, _GROUP):
        level = before >> _U56
        level = level | (level << _U8)
        level = level | (level << _U16)
        level = level | (level << _U32)
        moved = _ZERO
        for k in range(_GROUP):
            moved |= words[group + k] ^ level
        if moved & mask != _ZERO:
            up, legal, illegal = _ZERO, _ZERO, _ZERO
            for k in range(_GROUP):
                word = words[group + k]
                last = (word << _U8) | (before >> _U56)
                a_moved = ((word ^ last) >> a_bit) & _ONES
                b_moved = ((word ^ last) >> b_bit) & _ONES
                edge = a_moved ^ b_moved
                up += edge & ((word >> a_bit) ^ (last >> b_bit))
                legal += edge
                illegal += a_moved & b_moved
                before = word
            up_total += np.int64(_sum_of_bytes(up))
            legal_total += np.int64(_sum_of_bytes(legal))
            illegal_total += np.int64(_sum_of_bytes(illegal))
        before = words[group + _GROUP - 1]
    totals[0] += 2 * up_total - legal_total
    totals[1] += illegal_total
    totals[2] += legal_total


@njit
def fill_transitions(samples: Any, bits: tuple[int, int], start: tuple[int, int], index: Any, delta: Any) -> None:
    """Write every transition, delta 0 for an illegal one; the arrays have the lengths that the counting gave.

    `bits` are those of A and B, `start` is the phase before the block and the number of its first sample.
    """
    mask = (1 << bits[0]) | (1 << bits[1])
    phase, offset = start
    n = 0
    last = -1
    for i in range(len(samples)):
        lines = int(samples[i]) & mask
        if lines == last:
            continue
        last = lines
        new = phase_of_sample(lines, bits[0], bits[1])
        step = _step(phase, new)
        if step != 0:
            index[n] = offset + i
            delta[n] = 0 if step == 2 else step
            n += 1
        phase = new


Bytes = NDArray[np.uint8]
Deltas = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class DecoderState:
    """State at the end of a block, from which the next block goes on.

    Attributes:
        phase: of the last sample, 0 to 3.
        samples: number of samples of the stream so far.
    """

    phase: int
    samples: int


@dataclass(frozen=True, slots=True)
class Decoded:
    """Counts of one block.

    Attributes:
        counts: net x4 counts of the block, positive where A leads B.
        illegal: transitions in which both lines changed at once.
        edges: legal edges, of either sign.
        state: argument of the next call; None only before the first sample.
    """

    counts: int
    illegal: int
    edges: int
    state: DecoderState | None


@dataclass(frozen=True, slots=True)
class Edges:
    """Every transition of one block; sample indices count from the start of the stream.

    Attributes:
        index: first sample after each legal edge, ascending, (n,).
        delta: +1 or -1 for each, (n,).
        illegal_index: first sample after each illegal transition, ascending, (m,).
        state: as in `Decoded`.
    """

    index: Ints
    delta: Deltas
    illegal_index: Ints
    state: DecoderState | None


def _checked(samples: Bytes, a_bit: int, b_bit: int) -> Bytes:
    if samples.dtype != np.uint8 or samples.ndim != 1:
        raise ConfigError(f"samples: {samples.dtype} of {samples.ndim} dimensions; needed: uint8, one dimension")
    if not (0 <= a_bit < 8 and 0 <= b_bit < 8 and a_bit != b_bit):
        raise ConfigError(f"bits of A and B: {a_bit} and {b_bit}; allowed: two different ones of 0 to 7")
    return np.ascontiguousarray(samples)


def _start(samples: Bytes, a_bit: int, b_bit: int, state: DecoderState | None) -> DecoderState:
    """The state before the block; the first sample of a stream is its own predecessor."""
    return state if state is not None else DecoderState(phase_of_sample(int(samples[0]), a_bit, b_bit), 0)


def decode(samples: Bytes, a_bit: int, b_bit: int, state: DecoderState | None = None) -> Decoded:
    """Count one block of a stream of samples; blocks of any length give the same sum as the whole.

    Args:
        samples: one byte a sample, (n,).
        a_bit: position of line A in the byte, 0 to 7.
        b_bit: position of line B.
        state: `Decoded.state` of the block before; None at the start of the stream.

    Raises:
        ConfigError: samples are not bytes, or the two bits are the same or not in a byte.
    """
    samples = _checked(samples, a_bit, b_bit)
    if len(samples) == 0:
        return Decoded(0, 0, 0, state)
    before = _start(samples, a_bit, b_bit, state)
    totals = np.zeros(3, np.int64)
    head = min(-samples.ctypes.data % 8, len(samples))
    tail = head + (len(samples) - head) // GROUP_SAMPLES * GROUP_SAMPLES
    phase = count_bytes(samples[:head], a_bit, b_bit, before.phase, totals)
    if tail > head:
        last = np.uint64(_byte_of(phase, a_bit, b_bit) << 56)
        count_words(samples[head:tail].view(np.uint64), np.uint64(a_bit), np.uint64(b_bit), last, totals)
        phase = phase_of_sample(int(samples[tail - 1]), a_bit, b_bit)
    phase = count_bytes(samples[tail:], a_bit, b_bit, phase, totals)
    counts, illegal, edges = (int(total) for total in totals)
    return Decoded(counts, illegal, edges, DecoderState(int(phase), before.samples + len(samples)))


def transitions(
    samples: Bytes, a_bit: int, b_bit: int, state: DecoderState | None
) -> tuple[Ints, Deltas, DecoderState | None]:
    """Every transition in order; arguments and errors as for `decode`.

    Returns:
        First sample after each, counted from the start of the stream, (n,); +1, -1, or 0 for an illegal one, (n,);
        the state for the next block.
    """
    found = decode(samples, a_bit, b_bit, state)
    index = np.empty(found.edges + found.illegal, np.int64)
    delta = np.empty(len(index), np.int8)
    if len(samples):
        before = _start(samples, a_bit, b_bit, state)
        start = (before.phase, before.samples)
        fill_transitions(_checked(samples, a_bit, b_bit), (a_bit, b_bit), start, index, delta)
    return index, delta, found.state


def decode_edges(samples: Bytes, a_bit: int, b_bit: int, state: DecoderState | None = None) -> Edges:
    """The legal edges and the illegal transitions of one block; arguments and errors as for `decode`."""
    index, delta, after = transitions(samples, a_bit, b_bit, state)
    legal = delta != 0
    return Edges(index[legal], delta[legal], index[~legal], after)


def counts_at(edges: Edges, indices: ArrayLike) -> Ints:
    """Count at given samples (0 before the first edge of the block; an edge counts from its own sample on).

    Args:
        edges: of one block, from `decode_edges`.
        indices: samples, counted from the start of the stream, any order and shape.

    Returns:
        Net counts, the same shape as `indices`.
    """
    track = np.concatenate(([0], np.cumsum(edges.delta, dtype=np.int64)))
    counts: Ints = track[np.searchsorted(edges.index, np.asarray(indices, np.int64), side="right")]
    return counts


def phase_of(a: Bytes, b: Bytes) -> Bytes:
    """Phase, 0 to 3, of two lines of 0 and 1; any shape."""
    return ((b << 1) | (a ^ b)).astype(np.uint8)


def lines_of(phase: Bytes | Ints) -> tuple[Bytes, Bytes]:
    """Lines A and B, 0 or 1, of a phase or of any count (taken modulo four); the reverse of `phase_of`."""
    turn: Bytes = np.bitwise_and(phase, 3).astype(np.uint8)
    b: Bytes = np.right_shift(turn, 1)
    a: Bytes = np.bitwise_and(turn ^ b, 1)
    return a, b


def encode(counts: Ints) -> tuple[Bytes, Bytes]:
    """Lines A and B of an encoder that follows a track of counts; count 0 has both lines low.

    Args:
        counts: one element a sample, (n,); a legal signal needs steps of at most one count.

    Returns:
        A and B, 0 or 1, (n,) each.
    """
    return lines_of(np.asarray(counts, np.int64))


def pack(a: Bytes, b: Bytes) -> Bytes:
    """One byte a sample with A in bit 0 and B in bit 1, as `decode` reads it."""
    return (a | (b << 1)).astype(np.uint8)


def _byte_of(phase: int, a_bit: int, b_bit: int) -> int:
    """A sample with this phase."""
    return (((phase + 1) >> 1 & 1) << a_bit) | ((phase >> 1) << b_bit)
