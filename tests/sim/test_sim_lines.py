"""Encoder lines against a decoder of the test's own."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.errors import ConfigError
from rtec.sim.lines import lines_of
from tests.support.sim_example import MS, S, plain


def decode(samples: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Count edge by edge: at an edge of A, forward if A now differs from B; at an edge of B, if it equals A."""
    count, out = 0, [0]
    for old, new in pairwise(samples):
        a0, b0, a1, b1 = old & 1, old >> 1 & 1, new & 1, new >> 1 & 1
        assert not (a0 != a1 and b0 != b1), "both lines at once"
        if a0 != a1:
            count += 1 if a1 != b1 else -1
        elif b0 != b1:
            count += 1 if b1 == a1 else -1
        out.append(count)
    return np.array(out)


def test_lines_count_what_the_position_says() -> None:
    """Oracle: the tiny decoder above; a sweep forwards, back over zero, standing still, at two speeds."""
    position = np.concatenate(
        [np.linspace(0.5, 90.5, 400), np.linspace(90.5, -61.5, 153), np.full(50, -61.5), np.linspace(-61.5, 3.2, 9000)]
    )
    lines = lines_of(position, 40)
    np.testing.assert_array_equal(decode(lines), np.floor(position).astype(int))


def test_a_leads_b_when_positive() -> None:
    """Oracle: [G 4]: the first edge from a state with both low is A's when moving positive, B's when negative."""
    assert list(lines_of(np.array([0.5, 1.5, 2.5, 3.5, 4.5]), 1000) & 3) == [0, 1, 3, 2, 0]
    assert list(lines_of(np.array([0.5, -0.5]), 1000) & 3) == [0, 2]


def test_index_once_a_turn() -> None:
    """Oracle: floor(counts / 40): one mark one count wide each time it passes a multiple of 40."""
    position = np.arange(-100, 100, 0.25) + 0.1
    marked = lines_of(position, 40) >> 2 & 1
    assert sorted(set(np.floor(position[marked > 0]).astype(int))) == [-80, -40, 0, 40, 80]
    once = lines_of(position) >> 2 & 1
    assert sorted(set(np.floor(position[once > 0]).astype(int))) == [0]


def test_too_slow_sampling_is_refused() -> None:
    """Oracle: 3 counts in a sample cannot be told from 1 back; the message says how much faster."""
    with pytest.raises(ConfigError, match="at least 3 times as fast"):
        lines_of(np.array([0.0, 3.0]))


def test_lines_of_a_moving_machine_agree_with_its_counts() -> None:
    """Oracle: the decoder's net count = change of raw counts, per axis, at rapid speed and over a reversal."""
    sim = plain(screw={"encoder_um": 1.0})
    sim.load_program("G0 X40 Z10\nG0 X5 Z30")
    sim.advance_to(3 * MS)
    before = sim.raw_counts
    lines = sim.encoder_lines(700 * MS, 2_000_000.0)
    assert lines.shape == (1_394_000, 2)
    middle = sim.raw_counts
    for a in (0, 1):
        edges = np.flatnonzero(np.diff(lines[:, a] & 3) != 0)
        thin = lines[np.concatenate([[0], edges + 1]), a]  # only samples at which something changed
        assert abs(decode(thin)[-1] - (middle[a] - before[a])) <= 1  # the first sample may already hold one edge
    assert np.any(middle - before != 0)
    sim.advance_to(2 * S)
    np.testing.assert_array_equal(sim.raw_counts, [5000, 30000])
