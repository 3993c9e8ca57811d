"""`model.predict` with what people have. Oracle: the same instants as a `State`, and the effects' own equations."""

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

from rtec.errors import ModelError
from rtec.model import Model
from tests.support.diagnosis_examples import effects, small_machine

SCALE = "scale,component=EXX,axis=X,k=40"
PLAY = "backlash,component=EXX,axis=X,B=3"
GROWTH = "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,k=11,tau=1800"
TILT = "angular_motion,component=EBX,axis=X,c2=20,c3=0"


def model(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts))


def test_numbers() -> None:
    """Oracle: 40 µm/m at 100 mm; in one row, as nothing but numbers was given."""
    tip = model(SCALE).predict(X=100.0)
    assert tip.shape == (3,)
    np.testing.assert_allclose(tip, [4.0, 0.0, 0.0], atol=1e-12)


def test_arrays_and_numbers_together() -> None:
    """Oracle: row by row alone."""
    m = model(SCALE, TILT)
    x, z = np.array([0.0, 50.0, 100.0]), -30.0
    tip = m.predict(X=x, Z=z)
    assert tip.shape == (3, 3)
    np.testing.assert_array_equal(tip, [m.predict(X=float(v), Z=z) for v in x])


@pytest.mark.parametrize("make", [dict, pd.DataFrame, pl.DataFrame, pa.table])
def test_tables_of_any_kind(make: type) -> None:
    """Oracle: keyword arguments; columns that are no channel, such as the readings, are not read of a frame."""
    m = model(SCALE, PLAY, GROWTH)
    columns = {"x_mm": [0.0, 100.0, 50.0], "T_bed_degc": [20.0, 21.0, 22.0], "dir_x": [1.0, 1.0, -1.0]}
    more = {} if make is dict else {"run": [1, 1, 1], "reading_um": [0.1, 0.2, 0.3]}
    tip = m.predict(make({**columns, **more}))
    np.testing.assert_array_equal(tip, m.predict(X=[0, 100, 50], T_bed=[20, 21, 22], dir_X=[1, 1, -1]))


def test_without_a_time_it_has_settled() -> None:
    """Oracle: 11 µm/m/K at 100 mm and 2 K, long after the change; with a time the lag counts."""
    m = model(GROWTH)
    np.testing.assert_allclose(m.predict(X=[100, 100], T_bed=[20, 22])[:, 0], [0.0, 2.2], atol=1e-12)
    soon = m.predict(X=[100, 100], T_bed=[20, 22], time_s=[0, 60])[1, 0]
    late = m.predict(X=[100, 100, 100], T_bed=[20, 22, 22], time_s=[0, 60, 1e6])[2, 0]
    assert 0.0 < soon < 0.2
    assert late == pytest.approx(2.2, abs=1e-6)


def test_directions_follow_from_the_order() -> None:
    """Oracle: the directions written out."""
    m = model(PLAY)
    there_and_back = m.predict(X=[0, 50, 100, 50, 0])
    np.testing.assert_array_equal(there_and_back, m.predict(X=[0, 50, 100, 50, 0], dir_X=[0, 1, 1, -1, -1]))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"X": 1.0, "T_bd": 20.0}, "'T_bd' is no channel of this machine; did you mean 'T_bed'"),
        ({"X": 1.0, "dir_X": 1}, "temperature T_bed is missing: T_bed=…, °C"),
        ({"T_bed": 20.0, "dir_X": 1}, "the position of X is missing: X=…, mm"),
        ({"X": 1.0, "T_bed": 20.0}, "one position has no direction of motion, which the model needs: dir_X=1 or -1"),
        ({"X": [1.0, 2.0], "T_bed": [20.0] * 3, "dir_X": 1}, "lengths differ: x 2, T_bed 3"),
        ({"X": "far", "T_bed": 20.0, "dir_X": 1}, "X: could not convert"),
        ({"X": float("nan"), "T_bed": 20.0, "dir_X": 1}, "X has a value that is no finite number"),
        ({"X": [[1.0]], "T_bed": 20.0, "dir_X": 1}, "X has 2 dimensions"),
        ({"X": 1.0, "T_bed": 20.0, "dir_X": 2}, "dir_X must be 1, -1, or 0 where it is unknown"),
        ({"X": 1.0, "T_bed": -300.0, "dir_X": 1}, "T_bed is below absolute zero; temperatures are in °C"),
        ({"X": 1.0, "x_mm": 2.0, "T_bed": 20.0, "dir_X": 1}, "X and x_mm are the same channel; give one of them"),
    ],
)
def test_what_is_wrong_is_named(given: dict[str, object], said: str) -> None:
    """Oracle: the word that was wrong, and a way on."""
    with pytest.raises(ModelError, match=said.replace("(", r"\(")):
        model(SCALE, PLAY, GROWTH).predict(**given)  # type: ignore[arg-type]


def test_words_beside_a_dict_replace_its_values() -> None:
    """Oracle: the value alone, by whichever of its names."""
    at = {"X": 50.0, "T_bed": 20.0, "dir_X": 1}
    m = model(SCALE, PLAY, GROWTH)
    np.testing.assert_array_equal(m.predict(at, x_mm=100.0), m.predict({**at, "X": 100.0}))


def test_an_axis_that_turns_no_lever_is_not_asked_for() -> None:
    """Oracle: the chain: the arm of EBX depends on Z, that of EXX on nothing."""
    assert model(SCALE).predict(X=100.0)[0] == pytest.approx(4.0)
    arms = small_machine().chain.terms[:, small_machine().components.index("EBX"), 1:]
    missing = [a.name for a, c in zip(small_machine().axes, arms.T, strict=True) if c.any() and a.name != "X"]
    if missing:
        with pytest.raises(ModelError, match=f"the position of {missing[0]} is missing"):
            model(TILT).predict(X=100.0)
