"""Laser, ball bar and plates in one fit; the quick form of `joint_proof`."""

import numpy as np
import pytest

from tests.characterise.joint_proof import errors_of


@pytest.mark.parametrize("seeds", [range(4)], ids=["four machines"])
def test_numbers_of_a_joint_fit_are_within_their_errors(seeds: range) -> None:
    """Oracle: the truth, by exact transforms; of some 25 numbers none is beyond four standard errors, and their root
    mean square is what chance allows (99.9 % of 25 normal numbers are between 0.6 and 1.5)."""
    z = np.array([v for seed in seeds for _, v in errors_of(seed)])
    assert len(z) >= 20
    assert np.abs(z).max() < 4.0
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5
