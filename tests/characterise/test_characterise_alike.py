"""A free choice among effects that these readings hardly separate. Oracle: the error by the generator's own truth."""

from rtec.characterise import Characterisation, characterise
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build, model_error
from tests.discovery.translate import measurement_of, said_by


def chosen(seed: int, noise: str, hidden: str) -> tuple[Characterisation, float]:
    """A free choice on a laser with a hidden effect, and the error of its model, µm."""
    record = build(Case("singles", seed, "laser", noise, (hidden,)))
    m = measurement_of(record)
    found = characterise([m])
    return found, model_error(record, said_by(found.model, m))


def test_one_of_several_that_are_alike_is_kept_and_not_none() -> None:
    """A scale, and two temperatures that change it."""
    assert chosen(97057, "flicker", "axis_expansion")[1] < 0.2


def test_a_curve_along_the_axis_is_kept_beside_a_tilt_that_makes_the_same() -> None:
    found, error = chosen(97075, "flicker", "coupling_misalignment")
    assert {"scale", "polynomial_position"} <= {f.effect.effect for f in found.model.effects}
    assert error < 1.0


def test_a_free_choice_tries_what_changes_with_the_load() -> None:
    found, error = chosen(97009, "steps", "backlash_load")
    assert "backlash_load" in {f.effect.effect for f in found.model.effects}
    assert error < 0.3
