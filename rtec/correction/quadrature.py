"""Quadrature: x4 decoding of two lines A and B, and the reverse.

    phase = 2 B + (A xor B)      A B = 00, 10, 11, 01  ->  phase 0, 1, 2, 3
    count(n) = count(n-1) + 1, 0, -1    where phase(n) - phase(n-1) = 1, 0, 3 (mod 4)

Every edge of A or B is one count; A leads B = positive [NIST guidelines, section 4.2.1]. A step of 2 means that
both lines changed between two samples: the direction is lost. It is counted as illegal and moves the count by nothing.

Samples are bytes; A and B are two of their bits.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtec.correction.quadrature_kernel import (
    GROUP_SAMPLES,
    count_bytes,
    count_words,
    fill_transitions,
    phase_of_sample,
)
from rtec.errors import ConfigError

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Deltas = NDArray[np.int8]


@dataclass(frozen=True, slots=True)
class DecoderState:
    """Where one block ended, for the next to go on from.

    Attributes:
        phase: of the last sample, 0 to 3.
        samples: how many samples the stream has had so far.
    """

    phase: int
    samples: int


@dataclass(frozen=True, slots=True)
class Decoded:
    """What one block did.

    Attributes:
        counts: net x4 counts of the block, positive where A leads B.
        illegal: transitions in which both lines changed at once.
        edges: legal edges, of either sign.
        state: hand this to the next call; None only if no sample has been seen yet.
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
    """Give the state before the block; the first sample of a stream is its own predecessor."""
    return state if state is not None else DecoderState(phase_of_sample(int(samples[0]), a_bit, b_bit), 0)


def decode(samples: Bytes, a_bit: int, b_bit: int, state: DecoderState | None = None) -> Decoded:
    """Count one block of a stream of samples; blocks of any length give the same sum as the whole.

    Args:
        samples: one byte a sample, (n,).
        a_bit: position of line A in the byte, 0 to 7.
        b_bit: position of line B.
        state: `Decoded.state` of the block before; None at the start of the stream.

    Raises:
        ConfigError: samples are not bytes, or the two bits are not two.
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
    samples: Bytes, a_bit: int, b_bit: int, state: DecoderState | None = None
) -> tuple[Ints, Deltas, DecoderState | None]:
    """Find every transition in order; arguments and errors as for `decode`.

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
    """Find the legal edges and the illegal transitions of one block; arguments and errors as for `decode`."""
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
        counts: one entry a sample, (n,); a legal signal needs steps of at most one count.

    Returns:
        A and B, 0 or 1, (n,) each.
    """
    return lines_of(np.asarray(counts, np.int64))


def pack(a: Bytes, b: Bytes) -> Bytes:
    """One byte a sample with A in bit 0 and B in bit 1, as `decode` takes it."""
    return (a | (b << 1)).astype(np.uint8)


def _byte_of(phase: int, a_bit: int, b_bit: int) -> int:
    """Give a sample with this phase."""
    return (((phase + 1) >> 1 & 1) << a_bit) | ((phase >> 1) << b_bit)
