"""Histograms of the loop's times. Oracle: numpy's percentiles of the times themselves."""

import numpy as np
import pytest

from rtec.loop.stats import SLOW_BINS, Histogram


@pytest.mark.parametrize(("scale_us", "within_us"), [(20.0, 1.0), (100_000.0, 1000.0)])
def test_percentiles_are_those_of_the_times_within_a_bin(scale_us: float, within_us: float) -> None:
    """Of cycles of a few µs, and of those that wait for a slow device."""
    times_ns = (1e3 * scale_us * np.random.default_rng(4).lognormal(0.0, 0.5, 20_011)).astype(np.int64)
    histogram = Histogram()
    for time_ns in times_ns.tolist():
        histogram.add(time_ns)
    found = histogram.summary()
    for name, percent in (("p50_us", 50.0), ("p99_us", 99.0), ("p99_9_us", 99.9)):
        true_us = 1e-3 * float(np.percentile(times_ns, percent, method="inverted_cdf"))
        assert true_us <= found[name] <= true_us + within_us
    assert found["max_us"] == times_ns.max() * 1e-3


def test_what_is_beyond_the_bins_is_kept_as_the_largest() -> None:
    histogram = Histogram()
    assert histogram.summary() == dict.fromkeys(("p50_us", "p99_us", "p99_9_us", "max_us"), 0.0)
    histogram.add(-5)  # a clock read a moment before the deadline
    longest_us = 1000.0 * (SLOW_BINS + 5)
    histogram.add(round(longest_us * 1000.0))
    assert histogram.counts[0] == histogram.slow[-1] == 1
    found = histogram.summary()
    assert (found["p50_us"], found["p99_us"], found["max_us"]) == (1.0, longest_us, longest_us)
