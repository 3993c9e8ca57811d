"""Few targets along an axis: what meets them all need not be right between them. Oracle: the curve that was put in."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.estimation.columns import base_of
from rtec.estimation.readings import read
from rtec.metrology.measurement import Measurement
from tests.support import proof
from tests.support.characterise_examples import Probe, ProbeSetup, measurement, runs

Floats = NDArray[np.float64]


def worn(place: Floats, centre: float, height: float) -> Floats:
    """A scale error, and a worn spot of 45 mm."""
    return np.asarray(0.012 * place + height * np.exp(-0.5 * ((place - centre) / 19.0) ** 2))


def iso_230(seed: int) -> tuple[Measurement, float, float]:
    """Ten targets over half a metre, five times there and back; centre and height of the worn spot."""
    rng = np.random.default_rng([seed, 230])
    targets = np.linspace(8.0, 192.0, 10) + rng.uniform(-3.0, 3.0, 10)
    centre, height = float(rng.uniform(60.0, 140.0)), float(rng.uniform(4.0, 12.0))
    place = np.tile(np.concatenate([targets, targets[::-1]]), 5)
    way = np.tile(np.repeat([1.0, -1.0], 10), 5)
    read_um = worn(place, centre, height) + 1.5 * way + 0.5 * rng.standard_normal(100)
    given = measurement(runs([20] * 5), instrument=Probe(ProbeSetup(zero="setup"), component="EXX"))
    channels, time_s = {"x": place, "d_x": way}, 20.0 * np.arange(100.0)
    made = replace(given, channels=channels, readings={"reading_um": read_um}, time_s=time_s)
    return made, centre, height


@pytest.mark.parametrize("seed", proof.few(range(8), 2))
def test_a_fit_of_ten_targets_is_no_worse_between_them_than_no_model(seed: int) -> None:
    """Pieces, a polynomial and a scale together would have as many numbers as there are targets."""
    given, centre, height = iso_230(seed)
    model = characterise([given]).model
    between = np.linspace(10.0, 190.0, 181)
    truth = worn(between, centre, height)
    empty = {k: np.zeros(181) for k in given.readings}
    channels = {"x": between, "d_x": np.ones(181)}
    other = replace(given, run=runs([181]), time_s=np.arange(181.0), channels=channels, readings=empty)
    predicted = base_of(model, read([other])).predicted
    missed, whole = ((v - v.mean()) for v in (truth - predicted, truth))
    assert np.sqrt(np.mean(missed**2)) < (1.0 + 1e-9) * np.sqrt(np.mean(whole**2))
