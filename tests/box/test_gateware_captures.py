"""Real encoder signals through the gateware's inserter, and its output counted by a program that nobody here wrote.

Oracles: the insertion in software, bit for bit; numpy's own unwrapping of the lines' phase; LinuxCNC's `encoder`.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.correction.insertion import InsertionSettings, correct_capture
from rtec.correction.quadrature import encode
from rtec.playback.sigrok import read
from tests.support import linuxcnc
from tests.support.gateware import insert, missing
from tests.support.real_data import real_file

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())
Bytes = NDArray[np.uint8]
SEPARATION, INTERVAL = 8, 50
SIGNALS = [
    (f"agilent_hdns_2000_move_mouse_{how}.sr", *pair)
    for how in ("fast", "left_right", "up_down")
    for pair in (("MODE/XA", "RB/XB"), ("LB/YA", "MB/YB"))
] + [("rotary-ramp.sr", "0", "1"), ("rotary-sin.sr", "0", "1")]


def counted(a: Bytes, b: Bytes) -> int:
    """Counts of two lines from the first sample on, by unwrapping; a change of both lines counts nothing."""
    angle = np.array([[0, 3], [1, 2]], np.int64)[a, b]
    step = np.diff(np.unwrap(angle, period=4))
    return int(step[np.abs(step) != 2].sum())


@pytest.mark.parametrize(
    ("name", "a", "b", "mode"),
    [(*signal, ("count", "cycle")[i % 2]) for i, signal in enumerate(SIGNALS)],
    ids=[f"{n[-12:-3]} {a}" for n, a, _ in SIGNALS],
)
def test_real_signals(name: str, a: str, b: str, mode: str) -> None:
    """A wandering target, a sample a clock: the lines of the software, and a ledger that an observer confirms."""
    capture = read(real_file("quadrature", name))
    lines = capture.line(a), capture.line(b)
    rng = np.random.default_rng(len(name))
    n = len(lines[0])
    at = np.sort(rng.integers(1, n * 9 // 10, 60))
    targets = np.cumsum(rng.integers(-12, 13, 60))
    limits = InsertionSettings(SEPARATION, INTERVAL, "cycle" if mode == "cycle" else "count")
    software, ledger = correct_capture(*lines, None, limits, target_at=at, target_counts=targets)
    wanted = np.zeros(n, np.int32)
    for start, target in zip(at, targets, strict=True):
        wanted[start:] = target
    still = np.zeros(n, np.uint8)
    cycles = mode == "cycle"
    a_out, b_out, _, raw, inserted = insert((*lines, still), wanted, SEPARATION, whole_cycles=cycles, interval=INTERVAL)
    np.testing.assert_array_equal(a_out, software.a)
    np.testing.assert_array_equal(b_out, software.b)
    assert (raw, inserted) == (ledger.raw_counts, ledger.inserted_counts)
    assert raw == counted(*lines)
    assert raw + inserted == counted(a_out, b_out)


@pytest.mark.skipif(linuxcnc.why_not() is not None, reason=str(linuxcnc.why_not()))
@pytest.mark.parametrize("mode", ["count", "cycle"])
def test_linuxcnc_counts_what_goes_out(mode: str) -> None:
    """Forth and back with insertions on the way and at rest: LinuxCNC has raw + inserted at the end."""
    places = np.rint(60 * np.sin(np.arange(6000) * (2 * np.pi / 4000))).astype(np.int64)
    a, b = encode(places)
    wanted = np.where(np.arange(6000) < 3000, 21, -13).astype(np.int32)
    wanted[:100] = 0
    still = np.zeros_like(a)
    a_out, b_out, _, raw, inserted = insert(
        (a, b, still), wanted, SEPARATION, whole_cycles=mode == "cycle", interval=20
    )
    hal = linuxcnc.count(a_out, b_out)
    np.testing.assert_array_equal(hal.a, a_out)
    assert int(hal.counts[-1] - hal.counts[0]) == raw + inserted
    assert abs(inserted + 13) <= (2 if mode == "cycle" else 0)
