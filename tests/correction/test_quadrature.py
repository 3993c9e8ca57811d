"""x4 decoding against a walk over the samples in plain Python, and against the track that was encoded."""

import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.quadrature import (
    DecoderState,
    counts_at,
    decode,
    decode_edges,
    encode,
    lines_of,
    pack,
    phase_of,
)
from rtec.errors import ConfigError
from rtec.jit import as_written, njit

STEPS = {  # (A, B) before, (A, B) after: written down from the wave form, A leads B = up
    ((0, 0), (1, 0)): 1,
    ((1, 0), (1, 1)): 1,
    ((1, 1), (0, 1)): 1,
    ((0, 1), (0, 0)): 1,
    ((1, 0), (0, 0)): -1,
    ((1, 1), (1, 0)): -1,
    ((0, 1), (1, 1)): -1,
    ((0, 0), (0, 1)): -1,
}


def walk(samples: NDArray[np.uint8], a_bit: int, b_bit: int) -> tuple[list[tuple[int, int]], list[int]]:
    """Oracle: legal edges as (sample, delta) and illegal samples, by a table of pairs of line levels."""
    lines = [((s >> a_bit) & 1, (s >> b_bit) & 1) for s in samples.tolist()]
    edges, illegal = [], []
    for i in range(1, len(lines)):
        pair = (lines[i - 1], lines[i])
        if pair in STEPS:
            edges.append((i, STEPS[pair]))
        elif pair[0] != pair[1]:
            illegal.append(i)
    return edges, illegal


def random_samples(seed: int, n: int, repeat: int) -> NDArray[np.uint8]:
    """Bytes with all eight lines at random: many illegal transitions; each level held `repeat` samples on average."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.integers(0, 256, n, dtype=np.uint8), rng.integers(1, 2 * repeat, n))[:n]


BITS = [(0, 1), (1, 0), (7, 0), (0, 7), (3, 5), (6, 7)]


@pytest.mark.parametrize(("a_bit", "b_bit"), BITS)
@pytest.mark.parametrize("repeat", [1, 4, 200])
def test_agrees_with_a_walk(a_bit: int, b_bit: int, repeat: int) -> None:
    samples = random_samples(10 * a_bit + b_bit, 5000, repeat)
    edges, illegal = walk(samples, a_bit, b_bit)
    got = decode_edges(samples, a_bit, b_bit)
    assert list(zip(got.index.tolist(), got.delta.tolist(), strict=True)) == edges
    assert got.illegal_index.tolist() == illegal
    total = decode(samples, a_bit, b_bit)
    assert (total.counts, total.edges, total.illegal) == (sum(d for _, d in edges), len(edges), len(illegal))
    assert total.state == got.state


@pytest.mark.parametrize("start", range(10))
@pytest.mark.parametrize("length", [0, 1, 2, 7, 8, 9, 63, 64, 65, 71, 72, 73, 200, 1000])
def test_every_alignment_and_length(start: int, length: int) -> None:
    """Heads and tails that fill no word; oracle: the walk."""
    samples = random_samples(start, 1200, 2)[start : start + length]
    edges, illegal = walk(samples, 2, 4)
    got = decode(samples, 2, 4)
    assert (got.counts, got.illegal) == (sum(d for _, d in edges), len(illegal))


@pytest.mark.parametrize("seed", range(20))
def test_blocks_give_the_same_as_the_whole(seed: int) -> None:
    """Oracle: the same function on the whole stream, itself checked against the walk."""
    samples = random_samples(seed, 3000, 3)
    cuts = np.sort(np.random.default_rng(seed).integers(0, 3001, 12))
    whole, whole_edges = decode(samples, 1, 2), decode_edges(samples, 1, 2)
    state: DecoderState | None = None
    counts, illegal, index, delta, bad = 0, 0, [], [], []
    for block in np.split(samples, cuts):
        part, edges = decode(block, 1, 2, state), decode_edges(block, 1, 2, state)
        assert part.state == edges.state
        state = part.state
        counts, illegal = counts + part.counts, illegal + part.illegal
        index += edges.index.tolist()
        delta += edges.delta.tolist()
        bad += edges.illegal_index.tolist()
    assert (counts, illegal, state) == (whole.counts, whole.illegal, whole.state)
    assert index == whole_edges.index.tolist()
    assert delta == whole_edges.delta.tolist()
    assert bad == whole_edges.illegal_index.tolist()


def test_a_leading_b_is_positive() -> None:
    """Oracle: NIST guidelines 4.2.1, the wave form by hand."""
    a = np.array([0, 1, 1, 0, 0], np.uint8)
    b = np.array([0, 0, 1, 1, 0], np.uint8)
    assert decode(pack(a, b), 0, 1).counts == 4
    assert decode(pack(b, a), 0, 1).counts == -4


def test_both_lines_at_once_is_illegal_and_moves_nothing() -> None:
    """Oracle: by hand, all four illegal transitions; one straddles the border of two words of eight samples."""
    a = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 1, 1, 0], np.uint8)
    b = np.array([0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 1], np.uint8)
    samples = np.concatenate((pack(a, b), np.full(100, 2, np.uint8)))
    got = decode_edges(samples, 0, 1)
    assert got.illegal_index.tolist() == [8, 9, 11, 13]
    assert got.index.tolist() == [10]
    assert got.delta.tolist() == [-1]
    assert decode(samples, 0, 1).illegal == 4


@pytest.mark.parametrize("seed", range(5))
def test_encoded_tracks_decode_to_themselves(seed: int) -> None:
    """Oracle: the track that was encoded."""
    track = np.cumsum(np.random.default_rng(seed).integers(-1, 2, 10_000))
    a, b = encode(track)
    edges = decode_edges(pack(a, b), 0, 1)
    np.testing.assert_array_equal(counts_at(edges, np.arange(len(track))), track - track[0])
    assert len(edges.illegal_index) == 0


def test_counts_at_before_between_and_after() -> None:
    """Oracle: by hand; an edge counts from its own sample on."""
    edges = decode_edges(pack(*encode(np.array([0, 0, 1, 1, 2, 1, 1]))), 0, 1)
    assert counts_at(edges, [[0, 1], [2, 3]]).tolist() == [[0, 0], [1, 1]]
    assert counts_at(edges, [6, 5, 4, 100, -3]).tolist() == [1, 1, 2, 1, 0]


def test_lines_and_phase_undo_each_other() -> None:
    """Oracle: the four rows of the gray code."""
    a, b = lines_of(np.array([0, 1, 2, 3, 4, -1]))
    assert a.tolist() == [0, 1, 1, 0, 0, 0]
    assert b.tolist() == [0, 0, 1, 1, 0, 1]
    assert phase_of(a, b).tolist() == [0, 1, 2, 3, 0, 3]


@pytest.mark.parametrize(
    ("samples", "a_bit", "b_bit"),
    [
        (np.zeros(4, np.int64), 0, 1),
        (np.zeros((2, 2), np.uint8), 0, 1),
        (np.zeros(4, np.uint8), 3, 3),
        (np.zeros(4, np.uint8), 0, 8),
        (np.zeros(4, np.uint8), -1, 0),
    ],
)
def test_what_cannot_be_decoded_is_refused(samples: NDArray[np.uint8], a_bit: int, b_bit: int) -> None:
    with pytest.raises(ConfigError, match=r"needed|allowed"):
        decode(samples, a_bit, b_bit)


def test_njit_takes_options_and_keeps_the_source() -> None:
    """Oracle: the function itself."""

    @njit(cache=False)
    def twice(x: int) -> int:
        return 2 * x

    assert twice(21) == 42
    assert as_written(twice)(21) == 42


WITHOUT_NUMBA = """
import sys
sys.modules["numba"] = None
import numpy as np
from rtec.jit import HAVE_NUMBA
from rtec.correction.quadrature import decode, decode_edges, encode, pack
from rtec.correction.insertion import InsertionSettings, correct_capture
assert not HAVE_NUMBA
samples = np.random.default_rng(7).integers(0, 256, 2000, dtype=np.uint8)
total, edges = decode(samples, 1, 6), decode_edges(samples, 1, 6)
print(total.counts, total.illegal, total.edges, int((edges.index * edges.delta).sum()), int(edges.illegal_index.sum()))
a, b = encode(np.arange(3000) // 17)
out, ledger = correct_capture(a, b, None, InsertionSettings(5, 20), target_at=[0, 1500], target_counts=[30, -30])
print(ledger.inserted_counts, ledger.corrected_counts, int((out.insertion_at * out.insertion_delta).sum()))
"""


def test_same_numbers_without_numba() -> None:
    """Oracle: the compiled kernels in another process; warnings are errors there too."""
    plain = [sys.executable, "-W", "error", "-c", WITHOUT_NUMBA]
    compiled = WITHOUT_NUMBA.replace('sys.modules["numba"] = None', "").replace("assert not", "assert")
    first = subprocess.run(plain, capture_output=True, text=True, timeout=120, check=False)
    second = subprocess.run([sys.executable, "-c", compiled], capture_output=True, text=True, timeout=120, check=False)
    assert first.stderr == ""
    assert first.stdout == second.stdout
    assert len(first.stdout.split()) == 8
