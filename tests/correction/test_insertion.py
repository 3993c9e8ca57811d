"""Laws of pulse insertion, for any motion, any target and any division into blocks.

The oracle for the lines is a walk over levels in plain Python; for the places of the insertions, a corrector that
looks at every sample one by one and at nothing else (`one_by_one`), written for these tests.
"""

from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Literal, TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rtec.correction.insertion import Corrected, InsertionSettings, PulseInserter, correct_capture
from rtec.correction.quadrature import encode
from rtec.errors import ConfigError

Bytes = NDArray[np.uint8]
Mode: TypeAlias = Literal["count", "cycle"]
laws = settings(max_examples=300, deadline=None, derandomize=True)

TURN = [(0, 0), (1, 0), (1, 1), (0, 1)]


def steps(a: Bytes, b: Bytes) -> list[int]:
    """Oracle: at each sample 0, +1, -1, or 2 where both lines changed; A leads B = +1."""
    turns = [TURN.index(levels) for levels in zip(a.tolist(), b.tolist(), strict=True)]
    return [0] + [(0, 1, 2, -1)[(new - old) % 4] for old, new in pairwise(turns)]


def counts(a: Bytes, b: Bytes) -> list[int]:
    """Oracle: the count at each sample; illegal steps count nothing."""
    return list(accumulate(0 if step == 2 else step for step in steps(a, b)))


@dataclass(frozen=True)
class Case:
    """A raw signal, an index line, a timeline and limits."""

    a: Bytes
    b: Bytes
    z: Bytes
    at: list[int]
    targets: list[int]
    settings: InsertionSettings

    def correct(self) -> tuple[Corrected, PulseInserter]:
        return correct_capture(self.a, self.b, self.z, self.settings, target_at=self.at, target_counts=self.targets)

    def target_of(self, sample: int) -> int:
        return next((t for at, t in zip(self.at[::-1], self.targets[::-1], strict=True) if at <= sample), 0)


def one_by_one(case: Case) -> list[tuple[int, int]]:
    """Oracle: look at each sample in turn, with the whole raw signal in view; the insertions as (sample, delta)."""
    raw, n = steps(case.a, case.b), len(case.a)
    separation = case.settings.min_edge_separation_samples
    inserted, goal = 0, 0
    made: list[tuple[int, int]] = []
    edges: list[int] = []
    for t in range(1, n):
        target = case.target_of(t)
        if case.settings.mode == "count":
            goal = target
        elif inserted == goal and abs(target - goal) > 2:
            goal += 4 if target > goal else -4
        delta = (goal > inserted) - (goal < inserted)
        if delta == 0 or (made and t - made[-1][0] < case.settings.min_insertion_interval_samples):
            continue
        near = range(max(0, t - separation + 1), min(n, t + separation))
        alone = not any(raw[i] for i in near) and not any(i in near for i in edges)
        if alone:
            edges.append(t)
        elif raw[t] != -delta:
            continue
        inserted += delta
        made.append((t, delta))
    return made


@st.composite
def motions(draw: st.DrawFn) -> tuple[Bytes, Bytes]:
    """Standstill, motion both ways at any speed, glitches and illegal jumps, from any level."""
    track = [draw(st.integers(0, 3))]
    for kind in draw(st.lists(st.sampled_from(["still", "move", "glitch", "jump"]), min_size=1, max_size=6)):
        if kind == "still":
            track += [track[-1]] * draw(st.integers(1, 60))
        elif kind == "move":
            direction, period = draw(st.sampled_from([-1, 1])), draw(st.integers(1, 20))
            track += [track[-1] + direction * (1 + i // period) for i in range(period * draw(st.integers(1, 8)))]
        elif kind == "glitch":
            track += [track[-1] + draw(st.sampled_from([-1, 1]))] * draw(st.integers(1, 3)) + [track[-1]]
        else:
            track += [track[-1] + 2] * draw(st.integers(1, 10))
    return encode(np.array(track))


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Any motion, index line, timeline and limits."""
    a, b = draw(motions())
    n = len(a)
    z = np.random.default_rng(draw(st.integers(0, 99))).integers(0, 2, n, dtype=np.uint8)
    at = sorted(draw(st.lists(st.integers(0, n + 5), max_size=6)))
    targets = draw(st.lists(st.integers(-15, 15), min_size=len(at), max_size=len(at)))
    modes: tuple[Mode, Mode] = ("count", "cycle")
    limits = InsertionSettings(draw(st.integers(1, 9)), draw(st.integers(1, 25)), draw(st.sampled_from(modes)))
    return Case(a, b, z, at, targets, limits)


@laws
@given(cases())
def test_counts_are_conserved_at_every_sample(case: Case) -> None:
    out, ledger = case.correct()
    inserted = np.zeros(len(case.a), np.int64)
    inserted[out.insertion_at] = out.insertion_delta
    raw, corrected = counts(case.a, case.b), counts(out.a, out.b)
    np.testing.assert_array_equal(np.array(raw) + np.cumsum(inserted), corrected)
    assert (ledger.raw_counts, ledger.inserted_counts, ledger.corrected_counts) == (
        raw[-1],
        inserted.sum(),
        corrected[-1],
    )


@laws
@given(cases())
def test_illegal_transitions_pass_and_none_is_made(case: Case) -> None:
    out, ledger = case.correct()
    raw, corrected = steps(case.a, case.b), steps(out.a, out.b)
    assert [i for i, s in enumerate(corrected) if s == 2] == [i for i, s in enumerate(raw) if s == 2]
    assert ledger.illegal_transitions == raw.count(2)


@laws
@given(cases())
def test_inserted_edges_keep_their_distance_and_raw_edges_their_place(case: Case) -> None:
    out, _ = case.correct()
    raw, corrected = steps(case.a, case.b), steps(out.a, out.b)
    inserted = dict(zip(out.insertion_at.tolist(), out.insertion_delta.tolist(), strict=True))
    edges = np.array([i for i, s in enumerate(corrected) if s])
    for i, delta in inserted.items():
        if raw[i]:
            assert (raw[i], corrected[i]) == (-delta, 0), "an edge is swallowed whole or not at all"
        else:
            others = edges[edges != i]
            assert corrected[i] == delta
            assert np.all(np.abs(others - i) >= case.settings.min_edge_separation_samples)
    assert [s for i, s in enumerate(raw) if i not in inserted] == [
        s for i, s in enumerate(corrected) if i not in inserted
    ]


@laws
@given(cases())
def test_the_rate_limit_holds(case: Case) -> None:
    out, _ = case.correct()
    assert np.all(np.diff(out.insertion_at) >= case.settings.min_insertion_interval_samples)


@laws
@given(cases())
def test_every_insertion_is_where_one_by_one_puts_it(case: Case) -> None:
    """So none is late, none is lost, and none is made that was not asked for."""
    out, _ = case.correct()
    assert list(zip(out.insertion_at.tolist(), out.insertion_delta.tolist(), strict=True)) == one_by_one(case)


@laws
@given(cases())
def test_the_index_passes_unmodified(case: Case) -> None:
    np.testing.assert_array_equal(case.correct()[0].z, case.z)


@laws
@given(cases(), st.lists(st.integers(0, 400), max_size=8))
def test_blocks_change_nothing_and_the_latency_is_fixed(case: Case, cuts: list[int]) -> None:
    """Oracle: the whole record in one call. The ledger balances after every block."""
    whole, at_end = case.correct()
    stream, late = PulseInserter(case.settings), case.settings.latency_samples
    blocks, corrected, index = [], counts(whole.a, whole.b), 0
    bounds = sorted(min(cut, len(case.a)) for cut in [0, *cuts, len(case.a)])
    for start, stop in pairwise(bounds):
        due = [i for i in range(index, len(case.at)) if case.at[i] < stop]
        index += len(due)
        block = stream.push(
            case.a[start:stop],
            case.b[start:stop],
            case.z[start:stop],
            [case.at[i] for i in due],
            [case.targets[i] for i in due],
        )
        blocks.append(block)
        assert block.first_sample == start - late
        assert stream.raw_counts + stream.inserted_counts == stream.corrected_counts
        assert stream.corrected_counts == corrected[max(0, stop - late - 1)]
    for name in ("a", "b", "z"):
        streamed = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_array_equal(streamed[late:], getattr(whole, name)[: max(0, len(case.a) - late)])
        assert np.all(streamed[:late] == getattr(case, name)[0])
    hold = np.repeat(case.a[-1:], late), np.repeat(case.b[-1:], late)
    rest = stream.push(*hold, target_at=case.at[index:], target_counts=case.targets[index:])
    inserted_at = np.concatenate([block.insertion_at for block in [*blocks, rest]])
    np.testing.assert_array_equal(inserted_at, whole.insertion_at)
    assert (stream.inserted_counts, stream.waiting_counts) == (at_end.inserted_counts, at_end.waiting_counts)


@laws
@given(cases())
def test_what_waits_is_what_is_wanting(case: Case) -> None:
    """Oracle: the target at the last sample; a rest of up to two counts is no cycle."""
    _, ledger = case.correct()
    wanting = case.target_of(len(case.a) - 1) - ledger.inserted_counts
    if len(case.a) == 1:
        return
    if case.settings.mode == "count":
        assert ledger.waiting_counts == wanting
    else:
        assert (ledger.inserted_counts + ledger.waiting_counts) % 4 == 0
        assert abs(wanting - ledger.waiting_counts) <= 5 if ledger.waiting_counts else abs(wanting) <= 2


@laws
@given(cases())
def test_at_rest_everything_is_inserted_in_the_end(case: Case) -> None:
    """Standstill at the level where the motion ended, for long enough."""
    pause = 40 * (case.settings.min_insertion_interval_samples + case.settings.min_edge_separation_samples)
    still = [np.concatenate((line, np.repeat(line[-1:], pause))) for line in (case.a, case.b, case.z)]
    rested = Case(still[0], still[1], still[2], case.at, case.targets, case.settings)
    _, ledger = rested.correct()
    assert ledger.waiting_counts == 0
    if case.settings.mode == "count":
        assert ledger.inserted_counts == rested.target_of(len(still[0]))
    else:
        assert ledger.inserted_counts % 4 == 0
        assert abs(ledger.inserted_counts - rested.target_of(len(still[0]))) <= 2


@pytest.mark.parametrize("level", range(4))
def test_standstill_positive_is_a_leading_b(level: int) -> None:
    """Oracle: NIST guidelines 4.2.1, by hand: after a full cycle the lines are back, one line at a time."""
    a, b = encode(np.full(60, level))
    out, ledger = correct_capture(a, b, None, InsertionSettings(3, 10, "cycle"), target_at=[0], target_counts=[4])
    after = [(int(out.a[i]), int(out.b[i])) for i in (0, *out.insertion_at)]
    assert after == [TURN[(level + k) % 4] for k in range(5)]
    assert (ledger.raw_counts, ledger.inserted_counts, ledger.corrected_counts) == (0, 4, 4)


@pytest.mark.parametrize("direction", [1, -1])
def test_too_fast_waits_and_says_so(direction: int) -> None:
    """Oracle: by hand: edges every 5 samples leave no room for 3 before and after; against the motion they go in."""
    a, b = encode(direction * (np.arange(497) // 5))
    limits = InsertionSettings(3, 5)
    _, along = correct_capture(a, b, None, limits, target_at=[10], target_counts=[7 * direction])
    assert (along.inserted_counts, along.waiting_counts) == (0, 7 * direction)
    out, against = correct_capture(a, b, None, limits, target_at=[10], target_counts=[-7 * direction])
    assert (against.inserted_counts, against.waiting_counts) == (-7 * direction, 0)
    assert out.insertion_at.tolist() == [5 * k for k in range(2, 9)]


def test_a_restart_keeps_the_ledger_and_the_lines() -> None:
    """Oracle: one inserter that never stopped, at a standstill of longer than the latency."""
    a, b = encode(np.concatenate((np.arange(100) // 10, np.full(50, 9), 9 - np.arange(100) // 10)))
    limits = InsertionSettings(4, 8)
    whole, end = correct_capture(a, b, None, limits, target_at=[0, 130], target_counts=[5, 2])
    first = correct_capture(a[:125], b[:125], None, limits, target_at=[0], target_counts=[5])[1]
    later = PulseInserter(limits, first.raw_counts, first.inserted_counts)
    still = np.concatenate((a[125:], a[-1:].repeat(4))), np.concatenate((b[125:], b[-1:].repeat(4)))
    block = later.push(*still, target_at=[5], target_counts=[2])
    np.testing.assert_array_equal(block.a[4:], whole.a[125:])
    np.testing.assert_array_equal(block.b[4:], whole.b[125:])
    assert (later.raw_counts, later.inserted_counts, later.corrected_counts) == (
        end.raw_counts,
        end.inserted_counts,
        end.corrected_counts,
    )


def test_what_cannot_be_is_refused() -> None:
    """Each message says what is allowed."""
    one = np.zeros(1, np.uint8)
    with pytest.raises(ConfigError, match="min_edge_separation_samples = 0"):
        InsertionSettings(0, 1)
    with pytest.raises(ConfigError, match="min_insertion_interval_samples = -1"):
        InsertionSettings(1, -1)
    with pytest.raises(ConfigError, match="allowed: 'count', 'cycle'"):
        InsertionSettings(1, 1, "pulse")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="multiple of 4"):
        PulseInserter(InsertionSettings(1, 1, "cycle"), inserted_counts=6)
    stream = PulseInserter(InsertionSettings(1, 1))
    with pytest.raises(ConfigError, match="one length"):
        stream.push(one, np.zeros(2, np.uint8))
    with pytest.raises(ConfigError, match="0 or 1"):
        stream.push(one + np.uint8(2), one)
    with pytest.raises(ConfigError, match="ascend"):
        stream.push(one, one, target_at=[5, 4], target_counts=[1, 2])
    with pytest.raises(ConfigError, match="one each"):
        stream.push(one, one, target_at=[5], target_counts=[1, 2])
