"""A model's numbers from other readings are evidence, too. Oracle: what the readings of a third day were made of.

On the day of the fit nothing was warm. On the next, bed and head warm alike: the readings of that day alone cannot tell
which of them stretches the scale. But one of them does so beside the scale that the model knows, and the other only
beside a scale that is far from it.
"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rtec.characterise import fitted_model
from rtec.diagnosis.extend.add import add, asked_effect, gains, new_effect
from rtec.diagnosis.extend.improve import Improved, ProposedStep, _Growth, improve
from rtec.diagnosis.result import Finding
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects.effect_list import read_wanted
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.report.diagnosis import diagnosis_page
from tests.support import proof
from tests.support.both import both
from tests.support.diagnosis_examples import effects, laser, small_machine
from tests.support.machines import axis

NOISE_UM, DRAUGHT_UM, REFERENCE_DEGC = 0.4, 0.9, 20.0
SCALE, BACKLASH, ALPHA = 12.0, 3.0, 11.0
MACHINE = machine_from(
    {
        "machine": {"name": "mill", "tool_chain": ["head"], "work_chain": ["X", "table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 700.0])},
        "link": {"head": {}, "table": {}},
        "temperature": {"T_bed": {}, "T_head": {}},
    },
    "mill",
)


def day(name: str, seed: int, bed_degc: float, head_degc: float, cause: str, rises: float = 4.0) -> Measurement:
    """Twelve runs of a laser there and back; the bed warms by `rises` from its start, the head by twice as much."""
    rng = np.random.default_rng(seed)
    places = np.linspace(20.0, 680.0, 18)
    run, x, way = (
        np.concatenate([np.repeat(r, 36) for r in range(1, 13)]),
        np.tile(np.concatenate([places, places[::-1]]), 12),
        np.tile(np.repeat([1.0, -1.0], 18), 12),
    )
    time_s = 25.0 * np.arange(len(run)) + 600.0 * run
    warm = 1.0 - np.exp(-time_s / 6000.0)
    true = {"T_bed": bed_degc + rises * warm, "T_head": head_degc + 2.0 * rises * warm}
    rise = true[cause] - REFERENCE_DEGC if cause else np.zeros(len(run))
    reading = 1e-3 * x * (SCALE + ALPHA * rise) + 0.5 * BACKLASH * way + NOISE_UM * rng.normal(size=len(run))
    read = {k: np.round(v + 0.03 * rng.normal(size=len(run)), 1) for k, v in true.items()}
    instrument = make_instrument("laser_linear", {}, "X", "EXX", MACHINE, name)
    return Measurement(
        name=name, machine=MACHINE, instrument=instrument, run=run, time_s=time_s,
        channels={"x": x, "d_x": way, **read}, readings={"reading_um": reading},
    )  # fmt: skip


@cache
def known() -> Model:
    cold = day("cold", 1, REFERENCE_DEGC, REFERENCE_DEGC, "", rises=0.0)
    return fitted_model([cold], wanted=read_wanted("scale,backlash", MACHINE))


def improved(cause: str, **more: object) -> Improved:
    return improve(known(), [day("today", 2, 23.0, 24.0, cause)], draws=50, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("cause", ["T_bed", "T_head"])
def test_the_known_scale_tells_which_of_two_temperatures_it_is(cause: str) -> None:
    done = improved(cause)
    assert done.refit is None
    assert done.steps[0].labels == (f"axis_expansion(EXX, X, {cause})",)
    third = clean([day("third", 3, 18.0, 24.0, cause)], REFERENCE_DEGC)
    assert Judgement(done.model, third).residual < 2.0 * NOISE_UM < 0.2 * Judgement(known(), third).residual


@pytest.mark.parametrize("cause", ["T_bed", "T_head"])
def test_who_is_asked_is_asked_about_that_one_first(cause: str) -> None:
    asked: list[str] = []

    def ask(step: ProposedStep) -> Finding | None:
        asked.append(step.finding.effect.label)
        return None

    improved(cause, ask=ask, ask_made=lambda _: True)
    assert asked == [f"axis_expansion(EXX, X, {cause})"]


def there_and_back(name: str, seed: int, backlash_um: float) -> Measurement:
    """A laser once there and once back, seventeen targets, in a draught; nothing warms."""
    rng, x = np.random.default_rng(seed), np.linspace(20.0, 680.0, 17)
    place, way = np.concatenate([x, x[::-1]]), np.repeat([1.0, -1.0], 17)
    reading = 1e-3 * place * SCALE + 0.5 * backlash_um * way + DRAUGHT_UM * rng.normal(size=34)
    instrument = make_instrument("laser_linear", {}, "X", "EXX", MACHINE, name)
    return Measurement(
        name=name, machine=MACHINE, instrument=instrument, run=np.repeat([1, 2], 17), time_s=np.arange(34.0),
        channels={"x": place, "d_x": way, "T_bed": np.full(34, 20.0), "T_head": np.full(34, 20.0)},
        readings={"reading_um": reading},
    )  # fmt: skip


def test_improve_refits_what_a_diagnosis_says_it_refits() -> None:
    """A reversal that grew between two days of one run there and one back. Oracle: what was put in, and the noise.

    What the first day knew of it had held it back at half of the way.
    """
    known = fitted_model(
        [there_and_back("before", 4, 1.0)], wanted=read_wanted("scale,polynomial_position,backlash", MACHINE)
    )
    worn = there_and_back("now", 5, 5.5)
    found, done = both(known, [worn], draws=50)
    assert found.out_of_date
    assert "above all backlash(EXX, X) B from " in found.sentence
    assert not done.steps
    assert done.refit is not None
    assert next(f for f in done.model.effects if f.effect.effect == "backlash").values["B"] == pytest.approx(
        5.5, abs=0.4
    )
    assert done.refit.before.held_out > 2.0 * done.refit.after.held_out
    third = clean([there_and_back("third", 6, 5.5)], REFERENCE_DEGC)
    assert Judgement(done.model, third).residual < 1.2 * DRAUGHT_UM


def test_refitted_numbers_that_were_declined_are_not_offered_again() -> None:
    """Oracle: counted. The second look would have proposed the same numbers, freely refitted."""
    asked: list[object] = []

    def decline(added: object) -> bool:
        asked.append(added)
        return False

    known = fitted_model([there_and_back("before", 4, 1.0)], wanted=read_wanted("scale,backlash", MACHINE))
    done = improve(
        known,
        [there_and_back("now", 5, 5.5)],
        draws=50,
        ask=lambda step: step.finding,
        ask_made=decline,
    )
    assert len(asked) == 1
    assert done.model.hash == known.hash


@pytest.mark.parametrize(("share", "kept"), [(-np.inf, True), (0.1, True), (0.9, False)])
def test_what_a_second_look_adds_lowers_the_error_clearly(share: float, kept: bool) -> None:
    """An expansion that removes four fifths of the held-out mean square. Oracle: that share, by two calls of `add`."""
    m = day("today", 2, 23.0, 24.0, "T_bed", rises=0.6)
    start = fitted_model([m], wanted=read_wanted("scale,backlash", MACHINE))
    new = asked_effect("axis_expansion", "EXX", {"sensor": "T_bed"}, start)
    growth = _Growth([m], clean([m], REFERENCE_DEGC), start, (1, 0.05, 50), None, None, least_fall=share)
    added, alone = growth._gaining(start, [new]), add(start, [new], [m])
    fall = 1.0 - (alone.after.held_out / alone.before.held_out) ** 2
    assert 0.1 < fall < 0.9
    assert (added is not None) == kept


def test_what_so_few_readings_show_is_said_and_offered_on_trial() -> None:
    """A reversal that the model lacks, one run there and one back. Oracle: what was put in; a jump does the same.

    It had been "neither an effect of the catalogue nor a shape" above a table whose first line removed 93 %.
    """
    known = fitted_model([there_and_back("before", 14, 0.0)], wanted=read_wanted("scale", MACHINE))
    d = diagnose(known, [there_and_back("now", 15, 5.5)], draws=50)
    assert d.verdict == "undecided"
    assert [x.kind for x in d.doubts if x.fatal] == ["too_few"], d.sentence
    assert "backlash(EXX, X) explains 2." in d.sentence
    (command,) = diagnosis_page(replace(d, files=(Path("model.toml"), Path("now.csv"))), figures=False).next
    assert command.startswith("rtec add model.toml backlash --component EXX")


def test_the_number_that_is_most_out_of_date_is_named_beside_delays() -> None:
    """An expansion with a delay stands before it, which has a slope by that delay. Oracle: what was put in."""
    late = "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,k=11,tau=900"
    m = laser([late, "scale,component=EXX,axis=X,k=12", "backlash,component=EXX,axis=X,B=3"], 8)
    known = effects(late, "scale,component=EXX,axis=X,k=12", "backlash,component=EXX,axis=X,B=1")
    moved = Judgement(Model(m.machine, known), clean([m])).most_moved
    assert moved is not None
    assert (moved.effect, moved.name, moved.was) == ("backlash(EXX, X)", "B", 1.0)
    assert moved.now == pytest.approx(3.0, abs=0.2)


def known_by(errors: tuple[float, ...], expansion: float) -> Model:
    """A model of earlier readings: a scale, a backlash and an expansion, with their standard errors."""
    told = effects("scale,component=EXX,axis=X,k=8", "backlash,component=EXX,axis=X,B=2",
                   f"axis_expansion,component=EXX,axis=X,sensor=T_bed,k={expansion}")  # fmt: skip
    fitted = [replace(f, errors=dict.fromkeys(f.values, e)) for f, e in zip(told, errors, strict=True)]
    return Model(small_machine(), tuple(fitted), name="known")


@pytest.mark.parametrize(("swing_um", "believed"), [(4.0, 6.0), (8.0, 4.0)])
def test_an_addition_is_judged_by_the_same_numbers_before_and_after(swing_um: float, believed: float) -> None:
    """A slow swing of the scale keeps what was known of an expansion; free numbers follow it, before and after a bow.

    The error with free numbers before had been held against the error beside what was known after: 0.59 to 0.66 µm,
    though the bow lowers both. Oracle: the bow that was made.
    """
    model = known_by((1.0, 0.08, 0.5), believed)
    bow = "polynomial_position,component=EXX,axis=X,degrees=[2,3],c2=0.5,c3=0"
    truth = ["scale,component=EXX,axis=X,k=8", "backlash,component=EXX,axis=X,B=2", bow]
    truth.append("axis_expansion,component=EXX,axis=X,sensor=T_bed,k=6")
    m = laser(truth, 1, cycles=1, noise={"white_um": 0.2, "drift_um": 0.1, "drift_tau_s": 2400.0})
    swing = np.sin(2.0 * np.pi * (m.time_s - m.time_s[0]) / np.ptp(m.time_s) / 2.5) * m.channels["x"] / 200.0
    m = replace(m, readings={"reading_um": m.readings["reading_um"] + swing_um * swing})
    refit = add(model, [], [m])
    new = new_effect(effects(bow)[0].effect, model)
    added = add(refit.model, [new], [m], own=0, earlier=model)
    assert added.better
    assert gains(added.before, added.after, len(m.channels["x"]))
    assert added.model.effects[-1].values["c2"] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("seed", proof.few([1, 3], 1))
def test_what_was_known_does_not_make_an_addition_fit_worse_than_nothing(seed: int) -> None:
    """A scale that jumps while it is warm changes the expansion that was known; beside the growth with the air, which
    was made, too, the expansion was held where it had been: the fit was worse than without the growth.

    `diagnose` leaves the numbers free, and `add` had refused what it printed. Oracle: the growth that was made.
    """
    model = known_by((0.4, 0.05, 0.05), 6.0)
    by_air = "axis_expansion,component=EXX,axis=X,sensor=T_air,k=3"
    truth = ["scale,component=EXX,axis=X,k=8", "backlash,component=EXX,axis=X,B=2", by_air]
    truth.append("axis_expansion,component=EXX,axis=X,sensor=T_bed,k=6")
    m = laser(truth, seed, cycles=1, noise={"white_um": 0.15})
    warm = m.channels["T_bed"] > np.quantile(m.channels["T_bed"], 0.8)
    m = replace(m, readings={"reading_um": m.readings["reading_um"] + 40e-3 * m.channels["x"] * warm})
    refit = add(model, [], [m])
    added = add(model, [new_effect(effects(by_air)[0].effect, model)], [m])
    assert added.better
    assert added.after.inside < refit.after.inside
    assert added.after.held_out < added.before.held_out


@pytest.mark.parametrize("rich_first", [False, True])
def test_a_rival_with_more_numbers_decides_nothing(rich_first: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bend of two numbers beside which the known ones hold, and an expansion of one beside which they do not.

    The bend takes up what makes them look out of date. Where it is what the diagnosis names, it may. Oracle: the rule.
    """
    m = day("today", 2, 23.0, 24.0, "T_bed")
    growth = _Growth([m], clean([m], REFERENCE_DEGC), known(), (1, 0.05, 50), None, None)
    found = replace(growth.diagnosed(known()), together=())
    first = replace(found.findings[0], partner=None, confused_with=(), group=True)
    bend = asked_effect("polynomial_position", "EXX", {"axis": "X", "degrees": [2, 3]}, known())
    rich = replace(first, effect=bend.effect, theta={}, parameters={}, rank=2)
    found = replace(found, findings=(rich, first) if rich_first else (first, rich))

    def gaining(model: Model, new: list[FittedEffect]) -> SimpleNamespace | None:
        del model
        return SimpleNamespace(own_kept=1) if len(new[0].values) > 1 else None

    monkeypatch.setattr(growth, "_gaining", gaining)
    assert (growth.holding(known(), found) is not None) is rich_first


def unsettled(name: str, seed: int) -> Measurement:
    """A day whose zero goes its own way, and on which the bed warms by 8 K: the machine is that of every other day."""
    rng = np.random.default_rng([seed, 5])
    quiet = day(name, seed, 20.5, 20.5, "T_bed", rises=8.0)
    apart = np.diff(quiet.time_s, prepend=0.0)
    walk = np.cumsum(0.012 * np.sqrt(apart) * rng.normal(size=len(apart)))
    return replace(quiet, readings={"reading_um": quiet.readings["reading_um"] + walk})


def test_a_drift_that_a_refit_follows_makes_no_number_out_of_date() -> None:
    """The true numbers are the same on both days. A refit follows the second day's drift, within their errors."""
    wanted = read_wanted("scale,backlash,axis_expansion:EXX:sensor=T_bed", MACHINE)
    model = fitted_model([unsettled("first", 4)], wanted=wanted)
    found = diagnose(model, [unsettled("second", 14)], draws=50, explain=True)
    assert found.verdict == "nothing_missing"
    assert found.refit_fits
    assert not found.out_of_date
    assert "no number of the model has changed by more than its error" in found.sentence
