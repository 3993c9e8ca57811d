"""A curve along another axis takes three places of it. Oracle: P2 is the same at two places that mirror each other."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.effects.base import Surroundings, places_of
from rtec.effects.load import CrossTalk
from rtec.machine import Machine
from tests.support.machines import vertical_mill

Floats = NDArray[np.float64]


def around(machine: Machine, z_mm: Floats) -> Surroundings:
    x_mm = np.tile(np.linspace(0.0, 400.0, 9), len(z_mm))
    places = {"x": x_mm, "z": np.repeat(z_mm, 9)}
    spans = {n: (float(v.min()), float(v.max())) for n, v in places.items()}
    return Surroundings(machine, "EBX", machine.axis("X"), (), spans, 3600.0, 1.0, places)


@pytest.mark.parametrize(("z_mm", "there"), [([-350.0, -50.0], False), ([-350.0, -200.0, -50.0], True)])
def test_cross_talk_takes_three_places_of_the_other_axis(z_mm: list[float], there: bool) -> None:
    """With two heights it was named for a bend along X, and was 7 µm wrong between them."""
    found = [e for e in CrossTalk.suggest(around(vertical_mill(), np.array(z_mm))) if getattr(e, "other", "") == "Z"]
    assert bool(found) == there
    assert bool(CrossTalk.missing(around(vertical_mill(), np.array(z_mm)))) != there


def test_places_are_apart_by_more_than_the_noise_of_a_display() -> None:
    at = np.concatenate([np.zeros(5), np.full(5, 100.0), 100.0 + np.linspace(0.0, 0.02, 5)])
    assert places_of(at) == 2
    assert places_of(np.linspace(0.0, 360.0, 73)) == 73
    assert places_of(np.zeros(4)) == 1
