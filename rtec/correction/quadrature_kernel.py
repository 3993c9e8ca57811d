"""Kernels of the x4 decoder: no allocation, eight samples at a time where it pays.

Eight one-byte samples are one 64-bit word whose lowest byte is the earliest sample (little-endian machines).
`totals` is net counts, illegal transitions, legal edges; the kernels add to it.
"""

from typing import Any

import numpy as np

from rtec.jit import njit

GROUP_SAMPLES = 64
"""Samples that `count_words` skips in one go where neither line moves; it takes whole groups only."""

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
    """Change of count between two phases; 2 = illegal."""
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
    """One sample at a time, for the ends that do not fill a word; gives the last phase."""
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
    """Whole words, eight at a time; `before` holds the sample before the first in its highest byte.

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
    """Write every transition, delta 0 for an illegal one; the arrays have the room that the counting found.

    `bits` are those of A and B, `start` the phase before the block and the number of its first sample.
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
