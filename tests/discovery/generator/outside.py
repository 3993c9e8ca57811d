"""Hidden errors that no effect of the catalogue is: the variables that they truly depend on are told beside each.

A velocity holds direction and feed, so it counts as a true variable where one of these is. `Truth.variables` uses
`{low}` for the channel of the line's axis.
"""

import numpy as np
from numpy.typing import NDArray

from tests.discovery.generator.truth import Truth
from tests.discovery.generator.world import World

Floats = NDArray[np.float64]
Rng = np.random.Generator


def odd_period(w: World, rng: Rng) -> Floats:
    """Waves over a period that is no pitch, in a part of the travel."""
    angle = 2.0 * np.pi * w.q / rng.uniform(45.0, 85.0) + rng.uniform(0.0, 6.28)
    window = 1.0 / (1.0 + np.exp(-4.0 * (w.u + rng.uniform(0.2, 0.6))))
    return np.sin(angle) * window


def chirp(w: World, rng: Rng) -> Floats:
    """Waves that get shorter along the travel."""
    turns = rng.uniform(1.5, 2.5)
    part = 0.5 * (w.u + 1.0)
    return np.sin(2.0 * np.pi * turns * (part + part**2))


def two_waves(w: World, rng: Rng) -> Floats:
    """Waves over the line that turn over along another axis."""
    other = w.scaled(w.other(0))
    return np.sin(2.6 * w.u + 0.3) * np.cos(3.0 * other + rng.uniform(-0.3, 0.3))


def folded(w: World, rng: Rng) -> Floats:
    """A ridge that runs slantwise through the plane of two axes."""
    other = w.scaled(w.other(0))
    return np.exp(-0.5 * ((w.u - other * rng.uniform(0.6, 1.0)) / rng.uniform(0.35, 0.5)) ** 2)


def sleeping_feed(w: World, rng: Rng) -> Floats:
    """An error of both directions that comes only in the middle of the speeds, and more at one end of the travel."""
    hump = np.exp(-0.5 * ((np.log(w.feed_m_min) - np.log(1.5)) / 0.7) ** 2)
    return np.asarray(hump * (1.0 + 0.8 * np.sin(2.5 * w.u + rng.uniform(0.0, 6.28))), dtype=np.float64)


def warm_wave(w: World, rng: Rng) -> Floats:
    """A wave along the line that comes as the screw warms, and stops growing."""
    return np.tanh(w.rise("T_screw") / rng.uniform(1.5, 3.0)) * np.sin(2.0 * np.pi * w.q / rng.uniform(90.0, 140.0))


def threshold(w: World, rng: Rng) -> Floats:
    """An offset that appears when a fast feed meets a warm spindle."""
    fast = 1.0 / (1.0 + np.exp(-3.0 * (w.feed_m_min - 2.0)))
    warm = w.rise("T_spindle")
    return fast / (1.0 + np.exp(-(warm - np.median(warm)) / rng.uniform(0.6, 1.0)))


def loaded_wave(w: World, rng: Rng) -> Floats:
    """Waves along the line under load only."""
    return np.asarray(
        (w.load > 0.5) * np.sqrt(w.load) * np.sin(2.0 * np.pi * w.q / rng.uniform(70.0, 110.0)), dtype=np.float64
    )


def roll_ripple(w: World, rng: Rng) -> Floats:
    """Waves over another axis that stands elsewhere in every run: seen as steps from run to run."""
    other = w.scaled(w.other(0))
    return np.sin(rng.uniform(3.5, 4.5) * other) * (1.0 + 0.5 * np.cos(3.0 * w.u))


def resonance(w: World, rng: Rng) -> Floats:
    """A shift of the spindle in a band of speeds."""
    return np.asarray(np.exp(-0.5 * ((w.krpm - rng.choice([4.0, 6.0])) / 1.2) ** 2), dtype=np.float64)


LINE, FEED = "{low}", ("feed_mm_min", "v_{low}", "d_{low}")

OUTSIDE: tuple[Truth, ...] = (
    Truth("odd_period", "laser", "E{a}{a}", odd_period, variables=(LINE,)),
    Truth("chirp", "straightness", "E{c}{a}", chirp, variables=(LINE,)),
    Truth("two_waves", "laser", "E{a}{a}", two_waves, variables=(LINE, "{other}")),
    Truth("folded", "straightness", "E{c}{a}", folded, variables=(LINE, "{other}")),
    Truth("sleeping_feed", "laser", "E{a}{a}", sleeping_feed, variables=(LINE, *FEED)),
    Truth("warm_wave", "laser", "E{a}{a}", warm_wave, variables=(LINE, "T_screw")),
    Truth("threshold", "laser", "E{a}{a}", threshold, variables=("T_spindle", *FEED)),
    Truth("loaded_wave", "laser", "E{a}{a}", loaded_wave, variables=(LINE, "load_kg")),
    Truth("roll_ripple", "straightness", "E{c}{a}", roll_ripple, variables=(LINE, "{other}")),
    Truth("resonance", "drift", "EZ0spindle", resonance, variables=("spindle_rpm",)),
)
