"""One question has one number: every command judges the same model on the same files alike. Oracle: each other."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from rtec.characterise import Characterisation, characterise, read_wanted
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.campaign import simulate
from rtec.sim.campaign.settings import Settings
from rtec.sim.campaign.truth import effect_from_text
from tests.support.frame_thermal import COMPONENT, recorded

CONFIGS = Path(__file__).parents[2] / "configs"


def shipped(name: str, instrument: str, axis: str, *truth: str) -> list[Measurement]:
    """A shipped machine with errors, one reading made wrong."""
    machine = load_machine(CONFIGS / "machines" / f"{name}.toml")
    model = Model(machine, tuple(effect_from_text(t, machine) for t in truth), name="truth")
    made = make_instrument(instrument, {}, axis, None, machine, "test")
    settings = Settings.model_validate({"cycles": 2, "noise": {"white_um": 0.3, "drift_um": 0.5}})
    m = simulate(model, made, settings, 3, "laser")
    m.readings["reading_um"][17] += 60.0
    return [m]


EXAMPLES: dict[str, tuple[Callable[[], list[Measurement]], str]] = {
    "turning centre": (
        lambda: shipped("turning-centre", "laser_linear", "X", "scale,component=EXX,axis=X,k=12"),
        "scale,backlash",
    ),
    "vertical mill": (
        lambda: shipped("vertical-mill", "laser_linear", "Y", "backlash,component=EYY,axis=Y,B=4"),
        "backlash",
    ),
    "gantry": (lambda: [recorded("gross_outliers")], f"mount_expansion:{COMPONENT}:sensor=T_frame"),
}


def judged(facts: dict[str, Any]) -> tuple[object, ...]:
    keys = ("unit", "rms_residual", "noise_floor", "noise_floor_from", "rms_held_out", "readings", "wrong_readings")
    return tuple(facts[k] for k in keys)


def fit_of(measured: Sequence[Measurement], effects: str) -> Characterisation:
    return characterise(measured, wanted=read_wanted(effects, measured[0].machine))


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_command_gives_the_same_numbers(name: str) -> None:
    make, effects = EXAMPLES[name]
    measured = make()
    result = fit_of(measured, effects)
    model, fit = result.model, result.facts()
    one = judged(fit["judged"])
    assert fit["rms_inside"] == fit["judged"]["rms_residual"]
    assert fit["rms_held_out"] == fit["judged"]["rms_held_out"]
    compared = compare(model, measured)
    assert judged(compared.facts()["together"]) == one
    d = diagnose(model, measured, draws=20)
    assert judged(d.facts()["judged"]) == one
    assert (d.rms_residual, d.noise_floor) == (fit["rms_inside"], compared.judged.noise_floor)
    again = add(model, [], measured)
    assert again.before.as_given == fit["rms_inside"]
    after = judged(compare(again.model, measured).facts()["together"])
    assert (again.after.inside, again.floor, again.after.held_out) == (after[1], after[2], after[4])
    better = improve(model, measured, draws=20)
    last = [*([better.refit] if better.refit else []), *better.steps]
    if last:
        end = judged(compare(better.model, measured).facts()["together"])
        assert (last[-1].after.inside, last[-1].floor, last[-1].after.held_out) == (end[1], end[2], end[4])


def test_the_wrong_reading_is_named_by_all() -> None:
    make, effects = EXAMPLES["turning centre"]
    measured = make()
    result = fit_of(measured, effects)
    assert [o.row for o in result.outliers] == [17]
    for notes in (compare(result.model, measured).notes, diagnose(result.model, measured, draws=20).notes):
        assert any("row 18 of run 1" in n for n in notes)
