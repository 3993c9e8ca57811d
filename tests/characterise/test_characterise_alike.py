"""A free choice among effects that these readings hardly separate. Oracle: the error by the generator's own truth."""

import pytest

from rtec.characterise import characterise
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build, model_error
from tests.discovery.translate import measurement_of, said_by


@pytest.mark.parametrize(("seed", "hidden"), [(97057, "axis_expansion"), (97075, "coupling_misalignment")])
def test_one_of_several_that_are_alike_is_kept_and_not_none(seed: int, hidden: str) -> None:
    """A scale and two temperatures that change it; a curve and a tilt that moves the readings as it does."""
    record = build(Case("singles", seed, "laser", "flicker", (hidden,)))
    m = measurement_of(record)
    assert model_error(record, said_by(characterise([m]).model, m)) < 0.2
