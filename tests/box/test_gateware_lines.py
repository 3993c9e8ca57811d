"""What a chip does with its lines: filter, index latch, relay. Oracle: the lines, made by hand, and arithmetic."""

from collections.abc import Iterator

import numpy as np
import pytest

from rtec.correction.quadrature import encode
from tests.support.gateware import Chip, missing

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture
def chip() -> Iterator[Chip]:
    made = Chip(2)
    yield made
    made.close()


def test_the_relay_waits_until_the_outputs_follow(chip: Chip) -> None:
    """2^16 clocks after every start; until then the controller has the encoder itself."""
    for _ in range(2):
        assert not chip.relay
        chip.run(2**16 - 200, [0, 0])
        assert not chip.relay
        chip.run(400, [0, 0])
        assert chip.relay
        chip.reset()


@pytest.mark.parametrize(("length", "clocks", "passes"), [(0, 1, True), (3, 3, False), (3, 4, True), (9, 9, False)])
def test_what_is_shorter_than_the_filter_leaves_no_trace(chip: Chip, length: int, clocks: int, passes: bool) -> None:
    chip.settings(filter_length=length)
    a = np.zeros(200, np.uint8)
    a[50 : 50 + clocks] = 1
    still = np.zeros_like(a)
    a_out, b_out, _ = chip.lines(0, a, still, still)
    assert bool(a_out.any()) is passes
    assert not b_out.any()
    assert (chip.ledger(0).raw, chip.ledger(0).illegal) == (0, 0)


@pytest.mark.parametrize("direction", [1, -1])
def test_the_index_passes_and_its_count_is_kept(chip: Chip, direction: int) -> None:
    """The pulse is between counts 7 and 8 of a steady motion; it comes out between the same two edges."""
    place = direction * (np.arange(400) // 20)
    a, b = encode(place)
    z = (np.abs(place) == 7).astype(np.uint8)
    out = chip.lines(1, a, b, z)
    late = int(np.flatnonzero(out[0] | out[1])[0] - np.flatnonzero(a | b)[0])
    assert late > 0
    for given, came in zip((a, b, z), out, strict=True):
        np.testing.assert_array_equal(came[late:], given[:-late])
    assert chip.ledger(1).at_index == 7 * direction


def test_a_balance_at_full_speed(chip: Chip) -> None:
    """An edge every clock, both axes, there and back: none is lost."""
    chip.run(1, [100_000, -70_000])
    chip.run(100, [100_000, -70_000])
    assert [chip.ledger(i).raw for i in range(2)] == [100_000, -70_000]
    assert [chip.ledger(i).corrected for i in range(2)] == [100_000, -70_000]
    chip.run(1, [-5, 3])
    chip.run(100, [-5, 3])
    assert [(chip.ledger(i).raw, chip.ledger(i).illegal) for i in range(2)] == [(-5, 0), (3, 0)]
