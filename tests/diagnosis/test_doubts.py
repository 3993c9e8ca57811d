"""The record in doubt. Oracle: what was done to the file."""

import re
from dataclasses import replace

import numpy as np
import pytest

from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.doubts.doubt import Doubt
from rtec.diagnosis.extend.add import add, refused
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.machine import Machine
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from rtec.report.compare import compare_page
from rtec.sim.campaign.truth import effect_from_text
from tests.discovery.generator.cases import Case
from tests.discovery.generator.dataset import build as generated
from tests.discovery.translate import base_model, measurement_of
from tests.support import proof
from tests.support.characterise_examples import Probe, ProbeSetup, measurement, runs
from tests.support.diagnosis_examples import effects, laser, small_machine

BENT = ["scale,component=EXX,axis=X,k=30"]


def effects_of(machine: Machine, *texts: str) -> list[FittedEffect]:
    return [effect_from_text(t, machine) for t in texts]


def model(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts), name="base")


def kinds(doubts: tuple[Doubt, ...]) -> list[str]:
    return [d.kind for d in doubts]


def test_a_good_record_is_not_doubted() -> None:
    assert not compare(model(*BENT), [laser(BENT, 4), laser(BENT, 5)]).doubts


def test_files_that_contradict_each_other_blame_no_effect() -> None:
    """One of three files with its sign turned: it is named, and no effect is."""
    good = [laser(BENT, seed) for seed in (11, 12)]
    bad = laser(BENT, 13)
    turned = replace(bad, readings={k: -v for k, v in bad.readings.items()})
    d = diagnose(model(), [*good, turned], draws=50)
    assert kinds(d.doubts) == ["contradiction"]
    assert "laser-x-13 contradicts laser-x-11, laser-x-12" in d.sentence
    assert not d.findings[0].accepted


@pytest.mark.parametrize("cold", [True, False])
def test_the_turned_file_is_named_though_one_of_the_others_is_cooler(cold: bool) -> None:
    """Oracle: what was done. Only the warm files are each other's mirror image; without the cool one, nobody knows."""
    known = {"cool": ([*BENT], 41, 1.0), "turned": (["scale,component=EXX,axis=X,k=90"], 42, -1.0)}
    known |= {"warm": (["scale,component=EXX,axis=X,k=90"], 43, 1.0)}
    made = [
        replace(m, name=name, readings={k: sign * v for k, v in m.readings.items()})
        for name, (truth, seed, sign) in known.items()
        if cold or name != "cool"
        for m in [laser(truth, seed)]
    ]
    said = [d.message for d in compare(model(), made).doubts if d.kind == "contradiction"]
    first = "turned contradicts warm:" if cold else "turned, warm contradict each other:"
    assert said
    assert said[0].startswith(first)


def test_a_cold_day_and_a_hot_one_do_not_contradict_each_other() -> None:
    """Oracle: the truth. Below the reference X is short, above it long: one day's line falls, the other's rises."""
    heat = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
    cold = laser([heat, *BENT], 21, thermal={"air_degc": 18.5, "body": {"T_bed": {"on_degc": 0.5}}})
    hot = laser([heat, *BENT], 22, thermal={"air_degc": 22.0, "body": {"T_bed": {"on_degc": 16.0}}})
    d = diagnose(model(*BENT), [cold, hot], draws=50)
    assert "contradiction" not in kinds(d.doubts)
    assert d.findings[0].effect.effect == "axis_expansion"
    assert d.findings[0].accepted


def test_beams_at_other_offsets_do_not_contradict_each_other() -> None:
    """Oracle: the arm: 38 µrad of tilt make 3.8 µm more on a beam that is 100 mm farther away."""
    tilts = [*BENT, "angular_reversal,component=EBX,axis=X,theta=38"]
    beside = laser(tilts, 12, setup={"beam_offset_mm": [0.0, 0.0, 100.0]})
    assert not compare(model(*BENT), [laser(tilts, 11), beside]).doubts


def test_twice_a_turn_beside_the_wave_once_a_turn_is_the_coupling() -> None:
    """Oracle: the same readings, in which nobody asks any more once the model has the wave of the whole pitch."""
    trial = build("wrong_file", "wrong_pitch", 304)
    known = model_of(trial)
    (screw,) = effects_of(known.machine, "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=0.5,c1=0,pitch=20")
    d = diagnose(replace(known, effects=(*known.effects, screw)), measurements_of(trial), draws=50)
    assert d.findings[0].effect.effect == "coupling_misalignment"
    assert d.findings[0].accepted
    assert not d.doubts


def test_a_position_is_not_stretched_beyond_the_travel() -> None:
    """A bent guide times its arm, which a twofold scale would follow as well as any: X would leave its 600 mm."""
    trial = build("lean", "abbe", 304)
    assert not compare(model_of(trial), measurements_of(trial)).doubts


@pytest.mark.parametrize("factor", [60.0, 1 / 25.4])
def test_a_wrong_unit_of_a_channel_is_no_new_effect(factor: float) -> None:
    """A position in other units; the model, which was made with the right ones, says which."""
    m = laser(BENT, 14, protocol="cold")
    odd = replace(m, channels={**m.channels, "x": m.channels["x"] * factor})
    (doubt,) = compare(model(*BENT), [odd]).doubts
    assert doubt.kind == "wrong_channel"
    assert doubt.message.startswith(f"with x times {'1/60' if factor == 60.0 else '25.4'} ")


@pytest.mark.parametrize("factor", [2.0, 5.0, 0.2, 60.0])
def test_a_wrong_factor_is_asked_about_where_numbers_are_out_of_date_as_well(factor: float) -> None:
    """Oracle: what the column was multiplied with; a model whose numbers are 5 and 9 % off leaves more than the noise.

    Near 20 °C a refit would make up for the factor, and the numbers would be blamed alone.
    """
    now = laser(["scale,component=EXX,axis=X,k=42", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=12"], 72)
    known = model("scale,component=EXX,axis=X,k=40", "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11")
    odd = replace(now, channels={**now.channels, "T_bed": factor * now.channels["T_bed"]})
    (doubt,) = compare(known, [odd]).doubts
    assert doubt.kind == "wrong_channel"
    assert doubt.message.startswith(f"with T_bed times {f'1/{factor:g}' if factor > 1.0 else '5'} ")
    assert not compare(known, [now]).doubts


@pytest.mark.parametrize("factor", [10.0, 2.0])
def test_a_temperature_beside_those_of_other_sensors_has_no_wrong_unit(factor: float) -> None:
    """Oracle: the other sensor shows 20 °C as well; times ten the bed would be beyond what its sensor can show."""
    growth = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
    m = laser([growth], 72)
    warmer = (factor - 1.0) * m.channels["T_bed"]
    stretched = m.readings["reading_um"] + 11e-3 * m.channels["x"] * warmer
    assert "wrong_channel" not in kinds(compare(model(growth), [replace(m, readings={"reading_um": stretched})]).doubts)


def test_a_corrected_machine_is_not_called_a_wrong_model() -> None:
    """The loop was on: the readings hold noise, where the model says 20 µm."""
    (doubt,) = compare(model("scale,component=EXX,axis=X,k=300"), [laser([], 15)]).doubts
    assert doubt.kind == "corrected"
    assert "correction" in doubt.next_step


def one_pass() -> Measurement:
    x = np.linspace(0.0, 180.0, 60)
    rng = np.random.default_rng(1)
    return replace(
        measurement(runs([60]), instrument=Probe(ProbeSetup(zero="setup"), component="EXX")),
        channels={"x": x, "d_x": np.ones(60)},
        readings={"reading_um": 0.155 * x + 0.3 * rng.standard_normal(60)},
    )


def test_one_pass_is_said_to_be_one() -> None:
    m = one_pass()
    d = diagnose(Model(m.machine), [m], draws=50)
    assert "one_pass" in kinds(d.doubts)
    assert any("there and back" in n for n in d.notes)


def test_compare_names_the_shape() -> None:
    """Oracle: 155 µm/m were put in."""
    m = one_pass()
    item = compare(Model(m.machine), [m]).items[0]
    assert item.shape is not None
    assert item.shape.words == "rises straight along X, 155 µm/m"
    assert item.shape.share > 0.99
    assert compare(model(*BENT), [laser(BENT, 16)]).items[0].shape is None


@pytest.mark.parametrize(
    ("what", "kind", "said"),
    [
        ("wrong_factor", "wrong_channel", "with v_x times "),
        ("swapped_sensors", "swapped_sensors", " exchanged the model leaves "),
        ("moved_origin", "moved_origin", "with x moved by "),
    ],
)
@pytest.mark.parametrize("seed", proof.few([2, 3], 1))
def test_a_wrong_file_is_asked_about_and_no_effect_is_named(what: str, kind: str, said: str, seed: int) -> None:
    """Oracle: what the benchmark did to the file."""
    trial = build("wrong_file", what, seed)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert kinds(d.doubts) == [kind]
    assert d.verdict == "undecided"
    assert said in d.sentence
    assert not d.findings[0].accepted


@pytest.mark.parametrize("seed", proof.few([1, 304, 90002], 2))
def test_a_wave_that_no_pitch_gives_asks_about_the_pitch(seed: int) -> None:
    """A screw of 10 mm in a machine file that says 12 mm; and 20 mm, where a coupling makes the same wave.

    In the last the wave has harmonics.
    """
    trial = build("wrong_file", "wrong_pitch", seed)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "ambiguous"
    assert kinds(d.doubts) == ["wrong_pitch"]
    assert re.search("fit (better|as well) with 10.0", d.doubts[0].message)
    assert any(a.effect == "cyclic_screw" and "pitch_mm" in a.separating_test for a in d.findings[0].confused_with)


def test_a_file_of_another_machine_is_named() -> None:
    """Oracle: the first of three files follows another curve."""
    trial = build("contradicting", "other_machine", 1)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "undecided"
    assert "record-1 contradicts record-2, record-3: at the same places its readings differ by" in d.sentence


@pytest.mark.parametrize("what", ["wrong_factor", "swapped_sensors", "moved_origin"])
def test_no_number_of_the_model_follows_a_record_in_doubt(what: str) -> None:
    """Oracle: the truth of the benchmark, which the model has; a refit would take up what was done to the file."""
    trial = build("wrong_file", what, 2)
    known, given = model_of(trial), measurements_of(trial)
    done = improve(known, given, draws=50)
    assert done.reason == "undecided"
    assert done.model.hash == known.hash
    made = add(known, [], given)
    assert not made.better
    assert refused(made).startswith("the record is in doubt: with ")


def test_no_effect_is_named_beside_readings_of_the_wrong_sign() -> None:
    """Oracle: what was done to the second file; play is hidden in both."""
    known, play = "scale,component=EXX,axis=X,k=90", "backlash,component=EXX,axis=X,B=3"
    good, bad = laser([known, play], 61), laser([known, play], 62)
    turned = replace(bad, readings={k: -v for k, v in bad.readings.items()})
    d = diagnose(model(known), [good, turned], draws=50)
    assert d.verdict == "undecided"
    asked = "is the sign of the readings right? Correct the file first."
    assert asked in d.sentence
    assert not d.findings[0].accepted
    assert asked in compare_page(compare(model(known), [turned]), figures=False).lead


@pytest.mark.parametrize(
    ("changed", "seed"), [("backlash,component=EXX,axis=X,B={}", 71), ("scale,component=EXX,axis=X,k={}", 75)]
)
def test_what_changed_between_two_days_is_no_heat(changed: str, seed: int) -> None:
    """The air was two kelvin warmer on the day after a repair. Oracle: what was put in, which no temperature drives."""
    known = [*BENT, changed.format(2 if "backlash" in changed else 0)]
    grown = [*BENT, changed.format(5 if "backlash" in changed else 45)]
    days = []
    for n, (true, degc) in enumerate(((known, 20.0), (grown, 22.0))):
        m = laser(true, seed + n, protocol="cold")
        wander = 0.1 * np.random.default_rng(seed + n).standard_normal(len(m))
        days.append(
            replace(m, channels={**m.channels, "T_bed": np.full(len(m), 20.0) + wander, "T_air": degc + wander})
        )
    d = diagnose(model(*known), days, draws=50)
    assert d.verdict == "undecided"
    assert not d.findings[0].accepted
    assert "explains only what differs between" in d.sentence or "contradict" in d.sentence


def test_a_cold_day_and_a_warm_one_show_an_expansion() -> None:
    """Oracle: the expansion that was put in; twelve kelvin lie between the days, each of one temperature."""
    days = []
    for n, degc in enumerate((18.0, 30.0)):
        m = laser(BENT, 81 + n, protocol="cold")
        grown = 9e-3 * m.channels["x"] * (degc - 20.0)
        bed = np.full(len(m), degc) + 0.02 * np.random.default_rng(n).standard_normal(len(m))
        read = {k: v + grown for k, v in m.readings.items()}
        days.append(replace(m, readings=read, channels={**m.channels, "T_bed": bed, "T_air": np.full(len(m), 20.0)}))
    d = diagnose(model(*BENT), days, draws=50)
    assert (d.findings[0].effect.effect, getattr(d.findings[0].effect, "sensor", "")) == ("axis_expansion", "T_bed")
    assert d.findings[0].accepted
    (doubt,) = [x for x in d.doubts if x.kind == "between_files"]
    assert not doubt.fatal


def test_a_sensor_of_the_model_that_stood_still_is_no_new_effect() -> None:
    """Oracle: what was done to the channel of the bed; the axis grows with it."""
    grows = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=6"
    m = laser([*BENT, grows], 91)
    warm = m.channels["T_bed"]
    dead = replace(m, channels={**m.channels, "T_bed": np.full(len(m), 20.0), "T_air": 20.0 + 0.4 * (warm - 20.0)})
    d = diagnose(model(*BENT, grows), [dead], draws=50)
    assert "dead_sensor" in kinds(d.doubts)
    assert "T_bed, which axis_expansion(EXX, X, T_bed) of the model reads, stood at 20 °C" in d.sentence
    assert not d.findings[0].accepted
    assert diagnose(model(*BENT, grows), [m], draws=50).verdict == "nothing_missing"


def test_what_grows_where_an_axis_is_mounted_is_no_moved_origin() -> None:
    """Oracle: the mount that was put in. An origin elsewhere shifts the readings in just the same way."""
    known = [*BENT, "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=9"]
    m = laser([*known, "mount_expansion,component=EXX,sensor=T_bed,k=0.5"], 95)
    d = diagnose(model(*known), [m], draws=50)
    assert not any(x.fatal for x in d.doubts)
    assert "mount_expansion" in {f.effect.effect for f in d.group}


def test_a_position_is_not_read_in_fifths() -> None:
    """Numbers of the model that are out of date beside a missing expansion look so."""
    trial = build("improve", "bursts_warm_screw", 71003)
    found = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert not found.doubts
    assert found.findings[0].effect.effect == "axis_expansion"


@pytest.mark.parametrize("seed", proof.few([72000, 72001, 71003], 2))
def test_a_moved_origin_is_seen_under_a_drift(seed: int) -> None:
    """Oracle: the place that was put in; one number leaves as little as all numbers of the model refitted."""
    trial = build("wrong_file", "moved_origin", seed)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert kinds(d.doubts) == ["moved_origin"]
    assert d.verdict == "undecided"


@pytest.mark.parametrize(
    ("seed", "kind", "noise", "effect"),
    proof.few(
        [
            (87020, "angular", "heavy", "guide_curvature"),
            (87059, "angular", "white", "guide_curvature"),
            (88023, "laser", "heavy", "scale"),
            (96107, "angular", "heavy", "guide_curvature"),
        ],
        2,
    ),
)
def test_an_effect_that_explains_far_more_than_a_moved_origin_is_named(
    seed: int, kind: str, noise: str, effect: str
) -> None:
    """A straight line is missing; the model has a parabola, which moved by a little is nearly as steep.

    Oracle: the hidden effect.
    """
    hidden = generated(Case("singles", seed, kind, noise, (effect,)))
    m = measurement_of(hidden)
    d = diagnose(base_model(hidden, m), [m], draws=50)
    assert kinds(d.doubts) == []
    assert d.findings[0].accepted
    assert d.findings[0].effect.effect == effect
