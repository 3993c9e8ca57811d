"""Counters that wrap, slip and jump. Oracle of each test: the position that the wrapping counter was made from."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtec.errors import DriverFault
from rtec_drivers.count_tracker import CountTracker

MS = 1_000_000
FASTEST = 800_000.0
"""Counts a second: 400 mm/s at 2000 counts a mm."""


def tracker(bits: int, axes: int = 1) -> CountTracker:
    return CountTracker("XYZ"[:axes], bits, [FASTEST] * axes)


def wrapped(values: Sequence[int], bits: int) -> list[int]:
    return [v & ((1 << bits) - 1) for v in values]


@given(st.sampled_from([16, 24, 32]), st.lists(st.tuples(st.integers(-800, 800), st.integers(1, 20)), max_size=60))
def test_any_motion_the_machine_can_do_is_followed(bits: int, moves: list[tuple[int, int]]) -> None:
    """Steps of up to 800 counts a millisecond, from a start close below the wrap."""
    true, now_ms = (1 << (bits - 1)) - 100, 0
    seen = tracker(bits)
    seen.update(wrapped([true], bits), 0, 0)
    for step, cycles in moves:
        for _ in range(cycles):
            true, now_ms = true + step, now_ms + 1
            assert seen.update(wrapped([true], bits), now_ms * MS, now_ms * MS) == (true,)


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_many_turns_in_both_directions(bits: int) -> None:
    """Far round the counter, in steps as long as the bits allow."""
    span_ns = round(0.4 * 2**bits / FASTEST * 1e9)
    seen, now_ns, true = tracker(bits, 2), 0, [0, 0]
    for k in range(60):
        assert seen.update(wrapped(true, bits), now_ns, now_ns) == tuple(true)
        now_ns += span_ns
        step = int(0.3 * 2**bits)
        true = [true[0] + step, true[1] - (step if k < 40 else -step)]
    assert true[0] > 15 * 2**bits


def test_the_first_reading_is_a_signed_number() -> None:
    assert tracker(16).update([65_535], 0, 0) == (-1,)
    assert tracker(32).update([2**31 - 1], 0, 0) == (2**31 - 1,)


def test_a_slip_is_refused_and_passes() -> None:
    """One wrong reading: told, refused, and the next right one is taken."""
    seen = tracker(32)
    seen.update([1000], 0, 0)
    with pytest.raises(DriverFault, match=r"axis X jumped by 5000 counts in 1 ms, more than .* \(800\): refused"):
        seen.update([6000], MS, MS)
    assert seen.update([1010], 2 * MS, 2 * MS) == (1010,)
    assert not seen.lost
    with pytest.raises(DriverFault, match="refused"):
        seen.update([-9000], 3 * MS, 3 * MS)
    assert seen.update([1030], 30 * MS, 30 * MS) == (1030,)


def test_the_limit_is_the_highest_speed_and_two_counts() -> None:
    """800 counts in a millisecond, and the two that an encoder flickers by."""
    for values, fits in (([802], True), ([-802], True), ([803], False), ([-803], False)):
        seen = tracker(32)
        seen.update([0], 0, 0)
        if fits:
            assert seen.update(values, MS, MS) == tuple(values)
        else:
            with pytest.raises(DriverFault, match="refused"):
                seen.update(values, MS, MS)


@pytest.mark.parametrize("later_ms", [2, 5, 60])
def test_a_jump_that_stays_is_never_taken_by_waiting(later_ms: int) -> None:
    """By the time that has passed since, the machine could have gone there; it has not, so the position is lost."""
    seen = tracker(32)
    seen.update([0], 0, 0)
    with pytest.raises(DriverFault, match="refused"):
        seen.update([20_000], MS, MS)
    with pytest.raises(DriverFault, match="the position is not known"):
        seen.update([20_010], later_ms * MS, later_ms * MS)
    with pytest.raises(DriverFault, match="the position is not known"):
        seen.update([0], 61 * MS, 61 * MS)
    seen.restart()
    assert seen.update([20_010], 62 * MS, 62 * MS) == (20_010,)


def test_a_reading_may_be_as_late_as_its_answer() -> None:
    """The box latched somewhere between question and answer: 5 ms allow 4000 counts, 1 ms allows 800."""
    late, prompt = tracker(32), tracker(32)
    for seen in (late, prompt):
        seen.update([0], 0, 0)
    assert late.update([3900], MS, 5 * MS) == (3900,)
    with pytest.raises(DriverFault):
        prompt.update([3900], MS, MS)


@pytest.mark.parametrize(
    ("bits", "gap_s", "lost"), [(16, 0.03, False), (16, 0.05, True), (24, 10, False), (24, 11, True)]
)
def test_a_gap_in_which_the_counter_may_have_gone_round(bits: int, gap_s: float, lost: bool) -> None:
    """Half the counter's range at 800 000 counts/s: 41 ms with 16 bits, 10.5 s with 24."""
    seen, now_ns = tracker(bits), round(gap_s * 1e9)
    seen.update([7], 0, 0)
    if not lost:
        assert seen.update([9], now_ns, now_ns) == (9,)
        return
    with pytest.raises(DriverFault, match=f"a counter of {bits} bits may have gone round unseen"):
        seen.update([9], now_ns, now_ns)
    assert seen.lost
