"""Play of a worn length of the axis. Oracle: the zone that was put in, in shapes that the effect does not have."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, small_machine

Floats = NDArray[np.float64]
RUNS, TARGETS, NOISE_UM = 5, 39, 0.4


def line(play: Callable[[Floats], Floats], seed: int) -> Measurement:
    """A laser along X, five times there and back over 39 targets; the play differs from place to place."""
    machine, rng = small_machine(), np.random.default_rng(seed)
    at = np.linspace(5.0, 195.0, TARGETS)
    at[1:-1] += rng.uniform(-1.0, 1.0, TARGETS - 2)
    x = np.tile(np.concatenate([at, at[::-1]]), RUNS)
    ways = np.tile(np.repeat([1.0, -1.0], TARGETS), RUNS)
    warm = {name: 20.0 + 0.02 * rng.standard_normal(len(x)) for name in ("T_bed", "T_air")}
    values = 0.02 * x + (0.75 + 0.5 * play(x)) * ways + NOISE_UM * rng.standard_normal(len(x))
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    run, time_s = np.repeat(np.arange(1, RUNS + 1), 2 * TARGETS), np.linspace(0.0, 5.0 * len(x), len(x))
    channels = {"x": x, "d_x": ways, **warm}
    return Measurement("worn", made, machine, run, time_s, channels, {"reading_um": values})


def box(x: Floats) -> Floats:
    return np.where((x > 60.0) & (x < 100.0), 4.0, 0.0)


def bell(x: Floats) -> Floats:
    return np.asarray(4.0 * np.exp(-0.5 * ((x - 80.0) / 15.0) ** 2))


def ramps(x: Floats) -> Floats:
    return np.asarray(np.interp(x, [50.0, 70.0, 90.0, 110.0], [0.0, 4.0, 4.0, 0.0]))


@pytest.mark.parametrize("seed", proof.few(range(2), 1))
@pytest.mark.parametrize(("play", "wide"), [(box, 20.0), (bell, 17.7), (ramps, 20.0)])
def test_a_worn_length_is_named_with_its_place(play: Callable[[Floats], Floats], wide: float, seed: int) -> None:
    m = line(play, seed)
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")
    d = diagnose(Model(small_machine(), known, name="known"), [m], draws=50)
    assert d.verdict == "missing_effect", d.sentence
    first = d.findings[0]
    assert first.effect.effect == "backlash_zone", d.sentence
    assert first.parameters["q0"].value == pytest.approx(80.0, abs=3.0)
    # Half of the length at half of the play, mm.
    half = first.parameters["w"].value * np.log(2.0) ** 0.25
    assert half == pytest.approx(wide, abs=3.0)
    # Oracle of the size: the difference of both directions, inside and outside.
    x, ways, values = m.channels["x"], m.channels["d_x"], m.readings["reading_um"]

    def apart(inside: NDArray[np.bool_]) -> float:
        return float(values[inside & (ways > 0)].mean() - values[inside & (ways < 0)].mean())

    most = apart(np.abs(x - 80.0) < 8.0) - apart(np.abs(x - 80.0) > 45.0)
    assert first.parameters["B"].value == pytest.approx(most, rel=0.15)


@pytest.mark.parametrize("play", [lambda x: 0.0 * x, lambda x: 3.0 * x / 200.0], ids=["none", "winds up"])
def test_play_that_changes_along_the_whole_axis_has_no_zone(play: Callable[[Floats], Floats]) -> None:
    """Oracle: what was put in."""
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")
    d = diagnose(Model(small_machine(), known, name="known"), [line(play, 7)], draws=50)
    assert not d.findings or d.findings[0].effect.effect != "backlash_zone" or d.verdict == "nothing_missing", (
        d.sentence
    )


def test_play_without_a_name_is_found_beside_a_fitted_curve() -> None:
    """Play that grows and falls back every 70 mm, beside a model that has a curve of it. Oracle: what was put in."""
    numbers = ",".join(f"b{i}=0" for i in range(5))
    curve = f"backlash_position,component=EXX,axis=X,degree=4,{numbers}"
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0", curve)
    m = line(lambda x: 4.0 * np.mod(x, 70.0) / 70.0, 3)
    d = diagnose(Model(small_machine(), known, name="known"), [m], only=["axis_expansion"], draws=50)
    assert d.verdict == "unknown_effect", d.sentence
    assert d.unknown is not None
    assert d.unknown.channels == ("x", "d_x")
