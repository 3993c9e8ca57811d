"""The search for the noise. Oracle: numpy's own sort."""

import numpy as np
import pytest

from rtec.estimation.whitening import rising
from rtec.jit import as_written


@pytest.mark.parametrize("order_of", [rising, as_written(rising)], ids=["compiled", "plain"])
def test_few_values_in_rising_order(order_of: object) -> None:
    """Equal ones stay in their order, infinite and missing ones come last."""
    assert callable(order_of)
    rng = np.random.default_rng(5)
    for _ in range(300):
        cost = rng.choice([0.0, 1.0, 2.5, -3.0, np.inf, np.nan], int(rng.integers(1, 6)))
        order = np.empty(len(cost), np.int64)
        order_of(cost, order)
        np.testing.assert_array_equal(order, np.argsort(cost, kind="stable"))
