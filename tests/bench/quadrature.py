"""Speed of the x4 decoder beside a table look-up in numpy, on the same samples in the same run."""

from timeit import default_timer

import numpy as np
from numpy.typing import NDArray

from rtec.correction.quadrature import decode, encode, pack
from tests.bench.table import Row

SAMPLES = 50_000_000
CHUNK = 1_000_000
ROUNDS = 5
_TABLE = np.array([0, -1, 1, 2, 1, 0, 2, -1, -1, 2, 0, 1, 2, 1, -1, 0], np.int8)
"""Step, by 4 x (lines after) + (lines before), lines = A + 2 B; 2 = illegal."""


def by_table(samples: NDArray[np.uint8]) -> tuple[int, int]:
    """Net counts and illegal transitions by a table of 16 steps, a chunk at a time to stay in the cache."""
    counts, illegal = 0, 0
    for start in range(0, len(samples), CHUNK):
        lines = samples[max(0, start - 1) : start + CHUNK] & 3
        step = _TABLE[(lines[1:] << 2) | lines[:-1]]
        bad = int(np.count_nonzero(step == 2))
        counts += int(step.sum(dtype=np.int64)) - 2 * bad
        illegal += bad
    return counts, illegal


def rows() -> list[Row]:
    """Measure a busy stream (an edge every 4 samples) and a sparse one (every 1000); about five seconds.

    Raises:
        AssertionError: the two decoders disagree; the figures would mean nothing.
    """
    return [_row(name, pack(*encode(np.arange(SAMPLES) // every))) for name, every in STREAMS.items()]


STREAMS = {"busy": 4, "sparse": 1000}


def _row(name: str, samples: NDArray[np.uint8]) -> Row:
    fast, slow = decode(samples, 0, 1), by_table(samples)
    assert (fast.counts, fast.illegal) == slow
    ours_s = min(_seconds_ours(samples) for _ in range(ROUNDS))
    table_s = min(_seconds_table(samples) for _ in range(2))
    rate, table = len(samples) / ours_s / 1e6, len(samples) / table_s / 1e6
    what = f"x4 decode, {name}: an edge every {STREAMS[name]} samples"
    against = f"numpy table look-up: {table:.0f} M/s"
    return Row(what, f"{rate:.0f} M samples/s", table_s / ours_s, against, "≥ 300 M/s", rate >= 300)


def _seconds_ours(samples: NDArray[np.uint8]) -> float:
    start = default_timer()
    decode(samples, 0, 1)
    return default_timer() - start


def _seconds_table(samples: NDArray[np.uint8]) -> float:
    start = default_timer()
    by_table(samples)
    return default_timer() - start
