"""Files that contradict each other. Oracle: what was done to the files."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from rtec.characterise import characterise, read_wanted
from rtec.errors import ModelError
from rtec.estimation.contradiction import Contradiction, contradiction
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import laser

BENT = ["scale,component=EXX,axis=X,k=30"]
HEAT = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
HOT = {"air_degc": 22.0, "body": {"T_bed": {"on_degc": 16.0}}}


def turned(m: Measurement) -> Measurement:
    return replace(m, readings={k: -v for k, v in m.readings.items()})


def of(files: Sequence[Measurement]) -> Contradiction | None:
    return contradiction(Judgement(Model(files[0].machine), clean(files)))


def test_two_of_five_files_are_odd() -> None:
    """Each of both contradicts three others, each of these two; without a majority nobody knows."""
    files = [laser(BENT, seed) for seed in range(11, 16)]
    found = of([*files[:3], *map(turned, files[3:])])
    assert found is not None
    assert found.odd == (3, 4)
    assert found.message.startswith("laser-x-14, laser-x-15 contradict laser-x-11, laser-x-12, laser-x-13: ")
    even = of([*files[:2], *map(turned, files[3:])])
    assert even is not None
    assert even.odd == ()


def test_days_of_other_temperatures_do_not_contradict_each_other() -> None:
    assert of([laser([HEAT, *BENT], 21), laser([HEAT, *BENT], 22, thermal=HOT)]) is None


def test_a_fit_leaves_the_turned_file_out_and_says_so() -> None:
    """The fit is that of the others: no number of it comes from the file that was turned."""
    files = [laser(BENT, seed) for seed in (11, 12, 13)]
    wanted = read_wanted("scale", files[0].machine)
    without = characterise(files[:2], wanted=wanted)
    made = characterise([*files[:2], turned(files[2])], wanted=wanted)
    first = made.warnings[0]
    assert first.code == "contradiction"
    assert first.text.startswith("laser-x-13 contradicts laser-x-11, laser-x-12: ")
    assert "left out" in first.text
    assert made.coefficients == without.coefficients
    assert made.held_out_rms == without.held_out_rms
    assert set(made.model.measurements) == {"laser-x-11", "laser-x-12"}


def test_where_nobody_knows_which_is_right_all_are_fitted_and_it_is_said() -> None:
    files = [laser(BENT, 11), turned(laser(BENT, 12))]
    made = characterise(files, wanted=read_wanted("scale", files[0].machine))
    assert made.warnings[0].code == "contradiction"
    assert "laser-x-11, laser-x-12 contradict each other" in made.warnings[0].text
    assert set(made.model.measurements) == {"laser-x-11", "laser-x-12"}


def test_a_fit_that_finds_nothing_in_files_that_contradict_says_that_they_do() -> None:
    files = [laser(BENT, 11), turned(laser(BENT, 11))]
    twin = replace(files[1], name="twin")
    with pytest.raises(ModelError, match=r"(?s)no effect lowers.*twin contradict each other.*their signs"):
        characterise([files[0], twin])
