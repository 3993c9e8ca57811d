"""A column that leans about its foot while axes move. Oracle: the rotation about the foot, by the generator."""

import pytest

from rtec.estimation.candidates import library
from rtec.estimation.readings import read
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build, model_error
from tests.discovery.translate import base_model, measurement_of, said_by
from tests.support import proof
from tests.support.both import both


@pytest.mark.parametrize(("seed", "noise"), proof.few([(96010, "heavy"), (96127, "daily")], 1))
def test_readings_in_three_directions_show_that_the_column_turns_about_its_foot(seed: int, noise: str) -> None:
    hidden = build(Case("singles", seed, "tool_tip", noise, ("column_tilt",)))
    m = measurement_of(hidden)
    known = base_model(hidden, m)
    d, done = both(known, [m], draws=50)
    assert d.verdict == "missing_effect"
    assert d.findings[0].label == "column_tilt(EA0column, T_front, T_back)"
    assert model_error(hidden, said_by(done.model, m)) < 0.2 * model_error(hidden, said_by(known, m))


def test_one_direction_shows_no_foot() -> None:
    """A laser reads along one axis: a turn of the column moves it as a turn of an axis does."""
    hidden = build(Case("singles", 96017, "laser", "ou", ("missed_counts",)))
    candidates, _ = library(read([measurement_of(hidden)]))
    assert not [c.effect.component for c in candidates if c.effect.component[2:] == "0column"]
