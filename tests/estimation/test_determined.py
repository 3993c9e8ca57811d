"""Terms of which the readings determine only the sum.

Oracle: what was put into the readings, and least squares on columns that differ by a known little.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.extend.add import add, asked_effect, not_determined, predicted, refused
from rtec.diagnosis.extend.improve import improve
from rtec.effects.effect_list import AskedEffects
from rtec.errors import ModelError
from rtec.estimation.determined import undetermined
from rtec.estimation.readings import read
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import effects, small_machine

Floats = NDArray[np.float64]


@pytest.mark.parametrize(("apart", "found"), [(1e-4, [0, 1]), (0.3, [])])
def test_only_terms_that_may_make_more_than_was_read_are_named(apart: float, found: list[int]) -> None:
    """Two columns that are one but for a little, and a third; errors are those of least squares."""
    rng = np.random.default_rng(1)
    one, other, third = rng.standard_normal((3, 200))
    columns = np.stack([one, one + apart * other, third], axis=1)
    values = np.array([3.0, -2.9, 1.0])
    readings = columns @ values + 0.1 * rng.standard_normal(200)
    gram = columns.T @ columns
    fitted = np.linalg.solve(gram, columns.T @ readings)
    left = np.array([float(np.sum((readings - columns @ fitted) ** 2))])
    known = 0.01 * np.linalg.inv(gram)
    assert undetermined(gram[None], fitted, known, np.arange(3), left) == found


def laser(place: Floats, runs: int, time_s: Floats, channels: dict[str, Floats], error_um: Floats) -> Measurement:
    machine = small_machine()
    n, made = len(place), make_instrument("laser_linear", {}, "X", None, machine, "test")
    readings = {"reading_um": error_um + 0.3 * np.random.default_rng(0).standard_normal(n)}
    channels = {s: np.full(n, 20.0) for s in machine.sensor_names} | {"x": place} | channels
    run = np.repeat(np.arange(1, runs + 1), n // runs)
    return Measurement("laser", made, machine, run, time_s, channels, readings)


def test_a_shape_beside_the_scale_that_it_contains_is_refused() -> None:
    """Regions that reach over all targets make any scale; what both make together is all that is known."""
    rng = np.random.default_rng(2)
    at = np.linspace(10.0, 190.0, 18)
    place = np.tile(np.concatenate([at, at[::-1]]), 5)
    error = np.interp(place, at, 3.0 * rng.standard_normal(18))
    m = laser(place, 5, np.linspace(0.0, 900.0, len(place)), {}, error)
    model = Model(
        small_machine(),
        effects("scale,component=EXX,axis=X,k=0", "polynomial_position,component=EXX,axis=X,degrees=[2],c2=0"),
    )
    start = add(model, [], [m]).model
    knots = {"axis": "X", "knots_mm": [float(k) for k in np.linspace(10.0, 190.0, 11)]}
    made = add(start, [asked_effect("piecewise_position", "EXX", knots, start)], [m])
    assert made.after.held_out < 0.9 * made.before.held_out, "else this shows nothing"
    assert not made.better
    assert "piecewise_position(EXX, X)" in made.undetermined
    assert "determine only what" in refused(made)


@pytest.mark.parametrize(("wave_s", "phase", "rise"), [(9000.0, 3.0, 0.2), (10500.0, 0.0, 0.3)])
def test_two_delays_of_one_temperature_that_cancel_are_not_fitted_together(
    wave_s: float, phase: float, rise: float
) -> None:
    """A screw that its nut heats, and the air's temperature only: two delays of it made -1840 and 1836 µm/(m·K)."""
    runs, at = 14, np.linspace(10.0, 190.0, 8)
    place = np.tile(np.concatenate([at, at[::-1]]), runs)
    time_s = np.repeat(np.linspace(0.0, 7.0, runs) * 3600.0, 16) + np.tile(np.arange(16) * 6.0, runs)
    air = 21.0 + 1.3 * np.sin(time_s / wave_s + phase) + 0.15 * np.sin(time_s / 700.0)
    heat = np.where(time_s > 3000.0, 1.0 - np.exp(-(time_s - 3000.0) / 4000.0), 0.0)
    heat = np.where(time_s > 15000.0, heat * np.exp(-(time_s - 15000.0) / 4000.0), heat)
    direction = np.tile(np.repeat([1.0, -1.0], 8), runs)
    channels = {"T_air": np.round(air, 1), "d_x": direction}
    found = characterise([laser(place, runs, time_s, channels, rise * place * heat - 2.0 * direction)])
    assert [f.label for f in found.model.effects] == ["backlash(EXX, X)"]
    assert found.model.effects[0].values["B"] == pytest.approx(-4.0, abs=0.2)


def test_a_wave_of_which_the_targets_show_one_phase_is_not_added() -> None:
    """Steps of two and a half pitches show the cosine alone; the sine was -21 ± 6185 µm. Oracle: the steps."""
    machine, wave = small_machine(), effects("cyclic_screw,component=EXX,axis=X,pitch=5,s1=2,c1=1.5")
    start = Model(machine, effects("scale,component=EXX,axis=X,k=0"))
    for uneven_mm, determined in ((0.0, False), (4.0, True)):
        at = 10.0 + 12.5 * np.arange(14) + uneven_mm * np.random.default_rng(2).uniform(-1.0, 1.0, 14)
        place = np.tile(np.concatenate([at, at[::-1]]), 6) + 0.002 * np.random.default_rng(3).standard_normal(168)
        still = laser(place, 6, 30.0 * np.arange(168.0), {}, np.zeros(168))
        error = predicted(wave, read([still]))
        made = improve(start, [laser(place, 6, still.time_s, {}, error)])
        assert [s.labels for s in made.steps] == [("cyclic_screw(EXX, X)",)] * determined
        fitted = characterise([m := laser(place, 6, still.time_s, {}, error)]).model.effects
        assert ("cyclic_screw" in [f.effect.effect for f in fitted]) is determined
        if not determined:
            assert "measure at unequal steps" in not_determined(made.cancelling)
            with pytest.raises(ModelError, match=r"do not determine cyclic_screw\(EXX, X\).* measure at unequal steps"):
                characterise([m], wanted=AskedEffects(("cyclic_screw",), ()))
