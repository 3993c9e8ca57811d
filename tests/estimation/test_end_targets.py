"""End targets that stand out. Oracle: what was done to the file, and the fit of the file without these targets."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.end_targets import end_targets
from rtec.estimation.readings import read
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support.diagnosis_examples import effects, laser, small_machine

Floats = NDArray[np.float64]
TRUTH = ["scale,component=EXX,axis=X,k=30", "backlash,component=EXX,axis=X,B=3"]
HEAT = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9"
BOTH = {0: -30.0, 1: 22.0, -1: 25.0}


def with_(m: Measurement, added: Floats) -> Measurement:
    return replace(m, readings={k: v + added for k, v in m.readings.items()})


def at_targets(m: Measurement, off: dict[int, float], share: float = 1.0, way: float = 0.0) -> Floats:
    """Something added at targets, counted from either end, in a share of the runs; going one way, or both."""
    places = np.unique(np.round(m.channels["x"], 3))
    runs = np.unique(m.run)
    spared = np.isin(m.run, runs[:: round(1.0 / (1.0 - share))]) if share < 1.0 else np.zeros(len(m), dtype=bool)
    out = np.zeros(len(m))
    for i, by in off.items():
        out += by * (np.isclose(m.channels["x"], places[i], atol=1e-3) & ~spared)
    return out * (1.0 if not way else m.channels["d_x"] == way)


@pytest.mark.parametrize("off", [{0: 18.0}, {-1: -30.0, -2: 15.0}, BOTH], ids=str)
@pytest.mark.parametrize("share", [1.0, 0.8])
@pytest.mark.parametrize("setup", [{}, {"zero": "run"}], ids=["one zero", "zeros of runs"])
def test_they_are_named_with_place_and_size(off: dict[int, float], share: float, setup: dict[str, str]) -> None:
    good = laser([*TRUTH, HEAT], 3, setup=setup)
    places = np.unique(np.round(good.channels["x"], 3))
    (found,) = end_targets(read([with_(good, at_targets(good, off, share))], smooth=False))
    expected = sorted((float(places[i]), by) for i, by in off.items())
    assert found.places_mm == pytest.approx([p for p, _ in expected], abs=0.1)
    assert found.off == pytest.approx([by for _, by in expected], abs=1.5)
    for place, _ in expected:
        assert f"{place:.4g} mm" in found.message


def test_a_fit_takes_no_law_from_them() -> None:
    """To the last digits, the numbers are those of the file without these readings."""
    good = laser([*TRUTH, HEAT], 4)
    added = at_targets(good, BOTH)
    lost = with_(good, np.where(added != 0.0, np.nan, 0.0))
    made, without = (characterise([m]) for m in (with_(good, added), lost))
    assert made.warnings[0].code == "end_targets"
    assert {f.effect.effect for f in made.model.effects} == {"scale", "backlash", "axis_expansion"}
    for one, other in zip(made.coefficients, without.coefficients, strict=True):
        assert one.value == pytest.approx(other.value, rel=1e-6, abs=1e-9)


def test_the_diagnosis_names_the_places_and_no_effect() -> None:
    good = laser(TRUTH, 5)
    bad = with_(good, at_targets(good, BOTH))
    d = diagnose(Model(small_machine(), effects(*TRUTH), name="true"), [bad], draws=50)
    assert d.verdict == "undecided"
    assert [doubt.kind for doubt in d.doubts] == ["end_targets"]
    assert "at the end of X the readings at" in d.sentence
    assert not any(f.accepted for f in d.findings)


def test_a_comparison_names_them_and_shows_them() -> None:
    """What stands out may be an error of the machine: its readings count in the residual."""
    good = laser(TRUTH, 5)
    c = compare(Model(small_machine(), effects(*TRUTH), name="true"), [with_(good, at_targets(good, BOTH))])
    assert [doubt.kind for doubt in c.doubts] == ["end_targets"]
    assert c.items[0].n == len(good)


def test_an_end_that_is_not_read_going_back_is_named_too() -> None:
    good = laser([*TRUTH, HEAT], 8)
    last = at_targets(good, {-1: 30.0})
    once = with_(good, np.where((last != 0.0) & (good.channels["d_x"] < 0.0), np.nan, last))
    (found,) = end_targets(read([once], smooth=False))
    assert found.off == pytest.approx([30.0], abs=1.5)


def test_what_is_missing_besides_is_still_found() -> None:
    good = laser([*TRUTH, HEAT], 6)
    bad = with_(good, at_targets(good, BOTH))
    made = improve(Model(small_machine(), effects(*TRUTH), name="cold"), [bad], draws=50)
    assert [f.effect.effect for f in made.model.effects] == ["scale", "backlash", "axis_expansion"]
    assert made.model.effects[2].values["k"] == pytest.approx(9.0, abs=0.3)


@pytest.mark.parametrize("targets", [9, 15, 40])
def test_a_smooth_law_is_none(targets: int) -> None:
    """Oracle: each law reaches over a third of the travel or more."""
    laws: dict[str, Callable[[Floats], Floats]] = {
        "curve": lambda u: 20.0 * (u**2 + 0.8 * u**3),
        "wave": lambda u: 6.0 * np.sin(4.0 * u + 1.0),
        "bent": lambda u: np.where(u > 0.2, 40.0 * (u - 0.2), 0.0),
        "step": lambda u: np.where(u > 0.3, 15.0, 0.0),
        "screw": lambda u: 3.0 * np.sin(40.0 * np.pi * u),
    }
    for seed, (name, law) in enumerate(laws.items()):
        good = laser([*TRUTH, HEAT], 10 + seed, targets={"step_mm": 192.0 / (targets - 1)})
        u = good.channels["x"] / 100.0 - 1.0
        assert not end_targets(read([with_(good, law(u))], smooth=False)), name


def test_what_a_reversal_leaves_at_the_ends_is_none() -> None:
    """It shows going one way only."""
    good = laser(TRUTH, 7)
    turned = at_targets(good, {0: 8.0}, way=1.0) + at_targets(good, {-1: -8.0}, way=-1.0)
    assert not end_targets(read([with_(good, turned)], smooth=False))


def test_a_good_record_has_none() -> None:
    for seed in range(12):
        noise = {"white_um": 0.1 + 0.1 * seed, "run_offset_um": 1.5 * (seed % 2)}
        m = laser([*TRUTH, HEAT], 100 + seed, noise=noise, targets={"step_mm": 6.0 + 3.0 * seed})
        assert not end_targets(read([m], smooth=False))
