"""LinuxCNC's encoder counter, which nobody here wrote, counts what the ledger says, at every sample.

HAL counts from the level that its first row finds; all comparisons are from that row on.
"""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.insertion import Corrected, InsertionSettings, PulseInserter, correct_capture
from rtec.correction.quadrature import encode
from rtec.playback.sigrok import read
from tests.support import linuxcnc
from tests.support.real_data import real_file

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

REASON = linuxcnc.why_not()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))
both_modes = pytest.mark.parametrize("mode", ["count", "cycle"])


def motions() -> dict[str, Ints]:
    """Tracks of raw counts, one entry a sample."""
    still = np.zeros(600, np.int64)
    ramp = np.arange(4000) // 16
    slow_sine = np.rint(150 * np.sin(np.arange(6000) * (2 * np.pi / 3000))).astype(np.int64)
    tracks = {f"standstill at level {level}": still + level for level in range(4)}
    return tracks | {"constant speed": ramp, "backwards": -ramp, "reversal": slow_sine}


def counted(out: Corrected, rows: Ints | slice = slice(None)) -> Ints:
    """LinuxCNC's count of the corrected lines, from the first row on."""
    hal = linuxcnc.count(out.a[rows], out.b[rows])
    np.testing.assert_array_equal(hal.a, out.a[rows])
    np.testing.assert_array_equal(hal.b, out.b[rows])
    counts: Ints = hal.counts - hal.counts[0]
    return counts


@both_modes
@pytest.mark.parametrize("name", motions())
def test_counts_the_ledger(name: str, mode: str) -> None:
    """Inserted up, down below zero, and back to a rest."""
    track = motions()[name]
    a, b = encode(track)
    limits = InsertionSettings(4, 8, "cycle" if mode == "cycle" else "count")
    at = np.array([20, len(track) // 3, 2 * len(track) // 3])
    out, ledger = correct_capture(a, b, None, limits, target_at=at, target_counts=[12, -8, 4])
    hal = counted(out)
    inserted = np.zeros(len(track), np.int64)
    inserted[out.insertion_at] = out.insertion_delta
    np.testing.assert_array_equal(hal, track - track[0] + np.cumsum(inserted))
    assert ledger.inserted_counts == 4
    assert np.count_nonzero(inserted) == 12 + 20 + 12
    assert hal[-1] == ledger.corrected_counts == ledger.raw_counts + ledger.inserted_counts


@both_modes
def test_counts_a_real_capture(mode: str) -> None:
    """The fastest capture, three seconds of it. HAL gets each state of the lines once: it counts, time is no matter."""
    capture = read(real_file("quadrature", "agilent_hdns_2000_move_mouse_fast.sr"))
    a, b = capture.line("MODE/XA"), capture.line("RB/XB")
    rng = np.random.default_rng(11)
    at = np.sort(rng.integers(0, len(a) * 9 // 10, 80))
    limits = InsertionSettings(10, 50, "cycle" if mode == "cycle" else "count")
    targets = np.cumsum(rng.integers(-15, 16, 80))
    out, ledger = correct_capture(a, b, None, limits, target_at=at, target_counts=targets)
    moved = np.flatnonzero((np.diff(out.a) != 0) | (np.diff(out.b) != 0)) + 1
    rows = np.concatenate(([0], moved))
    hal = counted(out, rows)
    assert hal[-1] == ledger.corrected_counts == ledger.raw_counts + ledger.inserted_counts
    assert np.all(np.abs(np.diff(hal)) == 1), "each state that goes out is one count for the controller"
    assert abs(ledger.inserted_counts) > 0
    assert len(rows) > 3000


def test_counts_a_stream_of_blocks() -> None:
    """As a live corrector works: the ledger after every block is HAL's count at that sample."""
    track = np.rint(100 * np.sin(np.arange(4000) / 300)).astype(np.int64)
    a, b = encode(track)
    stream = PulseInserter(InsertionSettings(4, 8))
    blocks, ledger = [], []
    for start, stop in pairwise(range(0, 4001, 40)):
        blocks.append(stream.push(a[start:stop], b[start:stop], None, [start], [start // 100 - 20]))
        ledger.append(stream.corrected_counts)
    joined = [np.concatenate([getattr(block, line) for block in blocks]) for line in ("a", "b")]
    hal = linuxcnc.count(joined[0], joined[1]).counts
    np.testing.assert_array_equal((hal - hal[0])[39::40], ledger)
