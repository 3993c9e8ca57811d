"""Histograms of the loop's times. Oracle: numpy's percentiles of the times themselves."""

import numpy as np
import pytest

from rtec.loop.stats import BINS, Histogram


def test_percentiles_are_those_of_the_times_within_a_microsecond() -> None:
    times_ns = (1e3 * np.random.default_rng(4).lognormal(3.0, 1.0, 20_011)).astype(np.int64)
    histogram = Histogram()
    for time_ns in times_ns.tolist():
        histogram.add(time_ns)
    found = histogram.summary()
    for name, percent in (("p50_us", 50.0), ("p99_us", 99.0), ("p99_9_us", 99.9)):
        true_us = 1e-3 * float(np.percentile(times_ns, percent, method="inverted_cdf"))
        assert true_us <= found[name] <= true_us + 1.0
    assert found["max_us"] == times_ns.max() * 1e-3


def test_what_is_beyond_the_bins_is_kept_as_the_largest() -> None:
    histogram = Histogram()
    assert histogram.summary() == dict.fromkeys(("p50_us", "p99_us", "p99_9_us", "max_us"), 0.0)
    histogram.add(-5)  # a clock read a moment before the deadline
    histogram.add(3 * BINS * 1000)
    assert histogram.counts[0] == histogram.counts[-1] == 1
    assert histogram.summary()["max_us"] == pytest.approx(3.0 * BINS)
