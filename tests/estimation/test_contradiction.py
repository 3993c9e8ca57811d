"""Files that contradict each other. Oracle: what was done to the files."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from rtec.characterise import characterise, read_wanted
from rtec.errors import ModelError
from rtec.estimation.contradiction import Contradiction, contradiction
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser

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


STEPS_MM = (13.7, 17.3, 21.1)


def at_other_targets(truth: Sequence[str], seed: int, step_mm: float, **more: Any) -> Measurement:
    """Hardly a target of one step is within 0.1 mm of one of another."""
    return laser(truth, seed, targets={"step_mm": step_mm}, **more)


@pytest.mark.parametrize("odd", [0, 1, 2])
def test_a_turned_file_is_named_though_its_targets_are_others(odd: int) -> None:
    truth = [*BENT, "polynomial_position,component=EXX,axis=X,degrees=[2,3],c2=3,c3=-2"]
    files = [at_other_targets(truth, 31 + i, step) for i, step in enumerate(STEPS_MM)]
    assert of(files) is None
    files[odd] = turned(files[odd])
    found = of(files)
    assert found is not None
    assert found.odd == (odd,)


@pytest.mark.parametrize("odd", [0, 1, 2])
def test_a_file_of_another_machine_is_named_though_its_targets_are_others(odd: int) -> None:
    other = ["scale,component=EXX,axis=X,k=-10", "polynomial_position,component=EXX,axis=X,degrees=[2,3],c2=4,c3=2"]
    files = [at_other_targets(other if i == odd else BENT, 41 + i, step) for i, step in enumerate(STEPS_MM)]
    found = of(files)
    assert found is not None
    assert found.odd == (odd,)
    assert "readings differ by" in found.message


@pytest.mark.parametrize(
    "wave",
    [
        "cyclic_screw,component=EXX,axis=X,s1=3,c1=2,pitch=5",
        "polynomial_position,component=EXX,axis=X,degrees=[2,3,4,5],c2=5,c3=9,c4=-8,c5=6",
    ],
    ids=["screw", "curve"],
)
def test_what_lies_between_targets_is_no_contradiction(wave: str) -> None:
    """One machine, read at three sets of targets: no straight line between targets meets its waves and bends."""
    for seed in range(4):
        assert of([at_other_targets([wave], 50 + 3 * seed + i, s) for i, s in enumerate(STEPS_MM)]) is None


def test_days_of_other_temperatures_and_targets_do_not_contradict_each_other() -> None:
    files = [
        at_other_targets([HEAT, *BENT], 61 + i, s, **({"thermal": HOT} if i else {})) for i, s in enumerate(STEPS_MM)
    ]
    assert of(files) is None


def test_a_model_that_is_wrong_makes_no_contradiction_of_two_days() -> None:
    """The readings differ by less than their noise; a law nine times too large tells the days apart."""
    noise = {"white_um": 0.6}
    days = [
        laser([HEAT, *BENT], 71 + i, noise=noise, thermal={"air_degc": 20.0, "body": {"T_bed": {"on_degc": on}}})
        for i, on in enumerate((0.05, 1.8))
    ]
    law = effects(*BENT, "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=80")
    assert contradiction(Judgement(Model(days[0].machine, law, name="wrong"), clean(days))) is None


@pytest.mark.parametrize("factor", [-1.0, 1.0])
def test_a_fit_warns_of_a_turned_file_of_a_warmer_day(factor: float) -> None:
    """Heat adds a third to the warm day's line, so it is no mirror image of the other: only the law shows the sign."""
    law = ["scale,component=EXX,axis=X,k=60", HEAT, "backlash,component=EXX,axis=X,B=3"]
    files = [laser(law, 21, thermal={"body": {"T_bed": {"on_degc": 3.0}}}), laser(law, 22, thermal=HOT)]
    other = replace(files[1], readings={k: factor * v for k, v in files[1].readings.items()})
    made = characterise([files[0], other])
    texts = [w.text for w in made.warnings if w.code == "contradiction"]
    assert bool(texts) == (factor < 0.0)
    assert all("what is measured is minus what a fit of laser-x-2" in t for t in texts)
