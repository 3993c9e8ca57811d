"""A refit of a least-squares optimum is that optimum; the quick form of `refit_proof`: one of each form, two loud."""

import pytest

from tests.estimation.refit_proof import FORMS, moved
from tests.support import proof


@pytest.mark.parametrize("seed", proof.few([*range(1000, 1000 + len(FORMS)), 61, 125, *range(1008, 1016)], 10))
def test_a_refit_of_an_optimum_changes_no_prediction_by_more_than_its_error(seed: int) -> None:
    """Oracle: numpy's least squares, and its spread over the record with one tenth left out after another."""
    assert moved(seed) < 1.0
