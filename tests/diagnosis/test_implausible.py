"""What no machine can have recorded, and what a machine can. Oracle: what was done to the file.

The model was fitted to an earlier day, and met it.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.search.diagnose import diagnose
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.both import both
from tests.support.diagnosis_examples import NOISE_UM, effects, laser, small_machine

Floats = NDArray[np.float64]

SCALE, PLAY = "scale,component=EXX,axis=X,k=60", "backlash,component=EXX,axis=X,B=3"
HEAT = "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=11"
LATE = f"{HEAT},lag=true,tau=1500"
HOT: dict[str, Any] = {"air_degc": 20.0, "body": {"T_bed": {"on_degc": 12.0}}}
NEW = {
    "swapped_axes", "wrong_direction", "wrong_rate", "far_temperatures", "outside_travel", "scatter", "not_read",
}  # fmt: skip


def day(seed: int, heat: str = HEAT, play: str = PLAY, thermal: Mapping[str, Any] = HOT, **more: Any) -> Measurement:
    return laser([SCALE, play, heat], seed, thermal=thermal, log_every_s=60.0, **more)


@cache
def fitted(heat: str = HEAT) -> Model:
    return add(Model(small_machine(), effects(SCALE, PLAY, heat), name="known"), [], [day(1, heat)]).model


def changed(m: Measurement, **channels: Floats) -> Measurement:
    return replace(m, channels={**m.channels, **channels})


def asked(model: Model, m: Measurement) -> list[tuple[str, bool]]:
    return [(d.kind, d.fatal) for d in compare(model, [m]).doubts if d.kind in NEW]


def stops(model: Model, m: Measurement) -> str:
    """The answer, after nothing was named and nothing written."""
    d, done = both(model, [m], changes=True, draws=50)
    assert d.verdict == "undecided"
    assert not any(f.accepted for f in d.findings)
    assert done.reason == "undecided"
    assert done.model.hash == model.hash
    return d.sentence


@pytest.mark.parametrize("seed", proof.few([11, 12], 1))
def test_a_file_of_the_machine_as_it_was_is_not_asked_about(seed: int) -> None:
    for heat in (HEAT, LATE):
        assert not asked(fitted(heat), day(seed, heat))


# Directions


def test_a_direction_of_the_other_sign_contradicts_the_positions() -> None:
    m = day(21)
    said = stops(fitted(), changed(m, d_x=-m.channels["d_x"]))
    assert said.startswith("dir_x of laser-x-21 contradicts the order of the positions in ")
    assert "with the other sign the model leaves 0." in said


def test_the_odd_one_of_two_files_is_named() -> None:
    m, good, along_z = day(26), day(27), laser(["scale,component=EZZ,axis=Z,k=10"], 28, along="Z")
    doubts = compare(fitted(), [good, along_z, changed(m, d_x=-m.channels["d_x"])]).doubts
    assert [d.kind for d in doubts if d.fatal] == ["wrong_direction"]
    assert doubts[0].message.startswith("dir_x of laser-x-26 contradicts")


def test_a_reversal_error_that_turned_its_sign_is_one_of_the_machine() -> None:
    d = diagnose(fitted(), [day(22, play=PLAY.replace("3", "-3"))], draws=50, explain=True)
    assert not [x for x in d.doubts if x.kind in NEW]
    assert "backlash(EXX, X) B from 2.98 to -3.01 µm" in d.sentence


def test_targets_that_were_approached_from_beyond_keep_their_directions() -> None:
    """Each target is passed by and come back to, both ways: the readings show the directions as they are recorded."""
    m = day(23)
    turned = -m.channels["d_x"]
    known = PLAY.partition("B=")[0] + "B=-3"
    beyond = changed(day(23, play=known), d_x=turned)
    assert not asked(fitted(), beyond)
    assert asked(fitted(), changed(m, d_x=turned)) == [("wrong_direction", True)]


@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_targets_approached_from_one_side_do_not_contradict(way: float) -> None:
    bare = Model(small_machine(), effects(SCALE, HEAT), name="bare")
    m = day(24, play=PLAY.replace("3", "0"))
    assert not asked(bare, changed(m, d_x=np.full(len(m), way)))


def test_a_pilgrim_step_does_not_contradict() -> None:
    """Every target twice from each side, the first time from beyond."""
    bare = Model(small_machine(), effects(SCALE, HEAT), name="bare")
    m = day(25, play=PLAY.replace("3", "0"))
    order = np.argsort(m.channels["x"], kind="stable")
    x = m.channels["x"][order]
    alternate = np.where(np.arange(len(m)) % 2 == 0, -1.0, 1.0)
    step = changed(m, x=np.repeat(x[::4], 4)[: len(m)], d_x=alternate)
    assert not [k for k, _ in asked(bare, step) if k == "wrong_direction"]


# Temperatures


def test_all_temperatures_in_fahrenheit() -> None:
    m = day(31)
    warm = {n: 1.8 * m.channels[n] + 32.0 for n in ("T_bed", "T_air")}
    said = stops(fitted(), changed(m, **warm))
    assert said.startswith("with all temperatures read as °F the model leaves 0.")


@pytest.mark.parametrize("by_k", [-12.0, 15.0])
def test_another_season_is_no_other_unit(by_k: float) -> None:
    there = {**HOT, "air_degc": 20.0 + by_k}
    assert not asked(fitted(), day(32, thermal=there))


def test_no_machine_is_55_kelvin_colder_everywhere() -> None:
    m = day(33)
    cold = {n: m.channels[n] - 55.0 for n in ("T_bed", "T_air")}
    known = replace(fitted(), valid_range={**fitted().valid_range, "T_air": (19.0, 21.0)})
    (doubt,) = [d for d in compare(known, [changed(m, **cold)]).doubts if d.kind == "far_temperatures"]
    assert doubt.fatal
    assert doubt.next_step == "Check their unit."


# The clock


@pytest.mark.parametrize(("rate", "said"), [(1 / 60.0, "time_s times 60"), (1000.0, "time_s times 1/1000")])
def test_a_time_in_another_unit(rate: float, said: str) -> None:
    m = day(41, LATE)
    assert f"with {said} the model leaves 0." in stops(fitted(LATE), replace(m, time_s=rate * m.time_s))


def test_no_machine_moves_at_so_many_metres_a_second() -> None:
    m = day(42)
    said = stops(fitted(), replace(m, time_s=m.time_s / 36000.0))
    assert said.startswith("time_s of laser-x-42: X would have moved at ")
    assert "is it in minutes or hours?" in said


@pytest.mark.parametrize("tau_s", [2, 25, 300, 6000, 90000])
def test_a_delay_that_changed_is_no_clock(tau_s: float) -> None:
    assert not asked(fitted(LATE), day(43, LATE.replace("1500", str(tau_s))))


# Positions


@pytest.mark.parametrize("by_mm", [-40.0, 50.0])
def test_positions_outside_the_travel(by_mm: float) -> None:
    m = day(51)
    d = compare(fitted(), [changed(m, x=m.channels["x"] + by_mm)])
    (first, *_) = d.doubts
    assert (first.kind, first.fatal) == ("outside_travel", True)
    assert first.message.startswith("X of laser-x-51 was at ")
    assert first.message.endswith(" mm, outside its travel of 0 to 200 mm.")
    assert [x.kind for x in d.doubts if x.fatal] == ["outside_travel"]


def test_a_model_that_was_fitted_outside_the_travel_goes_on() -> None:
    far, other = (laser([SCALE, PLAY], seed) for seed in (52, 53))
    far = changed(far, x=far.channels["x"] + 50.0)
    model = add(Model(small_machine(), effects(SCALE, PLAY), name="known"), [], [far]).model
    d = diagnose(model, [changed(other, x=other.channels["x"] + 50.0)], draws=50)
    assert [(x.kind, x.fatal) for x in d.doubts] == [("outside_travel", False)]
    assert d.verdict == "nothing_missing"


def plate(seed: int, k_x: float = 60.0, k_z: float = -45.0) -> Measurement:
    """The tool tip in X and Z over a grid, run by run to and fro; oracle: two scales and a bow, worked out here."""
    rng, places = np.random.default_rng(seed), np.linspace(20.0, 180.0, 9)
    x, z = (g.ravel() for g in np.meshgrid(places, places))
    x, z = (np.concatenate([v, v[::-1], v, v[::-1]]) for v in (x, z))
    error = {"x": 1e-3 * k_x * x + 5.0 * ((x - 100.0) / 100.0) ** 2, "z": 1e-3 * k_z * z}
    n = len(x)
    return Measurement(
        name=f"plate-{seed}",
        instrument=make_instrument("tool_tip", {"directions": ["X", "Z"]}, None, None, small_machine(), "test"),
        machine=small_machine(),
        run=np.repeat(np.arange(4) + 1, n // 4),
        time_s=np.arange(0.0, 6.0 * n, 6.0),
        channels={"x": x, "z": z},
        readings={f"reading_{a}_um": e + rng.normal(0.0, NOISE_UM, n) for a, e in error.items()},
    )


@cache
def of_a_plate() -> Model:
    texts = (
        SCALE, "polynomial_position,component=EXX,axis=X,degrees=[2],c2=5", "scale,component=EZZ,axis=Z,k=-45",
    )  # fmt: skip
    return add(Model(small_machine(), effects(*texts), name="known"), [], [plate(1)]).model


def test_two_positions_exchanged() -> None:
    m = plate(61)
    said = stops(of_a_plate(), changed(m, x=m.channels["z"], z=m.channels["x"]))
    assert said.startswith("with x and z exchanged the model leaves 0.3")


def test_numbers_of_two_axes_that_changed_are_no_exchange() -> None:
    assert not asked(of_a_plate(), plate(62, k_x=-45.0, k_z=60.0))
    assert not asked(of_a_plate(), plate(63))


# Columns that nothing reads


def unread(m: Measurement, um: Floats, **columns: Floats) -> Measurement:
    return replace(m, readings={k: v + um for k, v in m.readings.items()}, unread=columns)


def saw(m: Measurement, period_s: float = 1700.0) -> Floats:
    return np.asarray(55.0 + 6.0 * (m.time_s / period_s % 1.0))


@pytest.mark.parametrize("seed", proof.few([71, 72], 1))
def test_readings_that_follow_a_column_that_nothing_reads(seed: int) -> None:
    m = day(seed)
    bar = saw(m)
    said = stops(fitted(), unread(m, 1.0 * (bar - 55.0), pressure_bar=np.round(bar, 1)))
    assert said.startswith("The residual follows pressure_bar (55 to 61), which rtec does not read: ")


@pytest.mark.parametrize("seed", proof.few([73, 74], 1))
def test_a_slope_that_follows_a_column_that_nothing_reads(seed: int) -> None:
    """A wavelength that follows the humidity: the error is the distance times a number of each run."""
    m, rng = day(seed), np.random.default_rng(seed)
    runs, at = np.unique(m.run, return_inverse=True)
    percent = rng.uniform(30.0, 70.0, len(runs))[at] + rng.normal(0.0, 0.3, len(m))
    x = m.channels["x"]
    said = stops(fitted(), unread(m, 2e-3 * (percent - 50.0) * x, humidity=np.round(percent, 1)))
    assert "The residual follows humidity (" in said
    assert "which rtec does not read, times the position along X: that product lowers it from " in said


@pytest.mark.parametrize("seed", proof.few(range(20), 2))
def test_a_slope_of_its_own_is_followed_by_nothing(seed: int) -> None:
    """An expansion of the screw, late or not, beside an air that is as slow: no slope of the humidity."""
    m, rng = day(81), np.random.default_rng(seed)
    hours = m.time_s / 3600.0
    given = {"percent": 40.0 + 3.0 * np.sin(hours / 5.0 + seed) + walk(m, rng, 0.02), "walk": walk(m, rng, 0.1)}
    for slope in (2.0 * np.sin(hours / 4.0 + 2.0), 4.0 * (1.0 - np.exp(-hours / 2.0)), walk(m, rng, 0.15)):
        assert not asked(fitted(), unread(m, 1e-2 * slope * m.channels["x"], **given))


def walk(m: Measurement, rng: np.random.Generator, step: float) -> Floats:
    return np.asarray(np.cumsum(rng.normal(0.0, step, len(m))))


@pytest.mark.parametrize("seed", proof.few(range(20), 2))
def test_a_column_of_its_own_is_followed_by_nothing(seed: int) -> None:
    """A walk beside a walk, the air's drift beside a drift, a saw beside noise."""
    m, rng = day(80), np.random.default_rng(seed)
    hours = m.time_s / 3600.0
    given = {"walk": walk(m, rng, 0.1), "percent": 40.0 + 3.0 * np.sin(hours / 5.0 + seed) + walk(m, rng, 0.02)}
    for um in (0.0 * hours, walk(m, rng, 0.15), 4.0 * (1.0 - np.exp(-hours / 2.0)), 2.0 * np.sin(hours / 4.0 + 2.0)):
        assert not asked(fitted(), unread(m, um, pressure_bar=saw(m), **given))


def test_copies_of_a_position_and_of_the_reading_are_no_cause() -> None:
    m = day(90)
    (column,) = m.readings.values()
    um = 1e-3 * 40.0 * m.channels["x"]
    for copy in (1.001 * m.channels["x"], np.round(column + um, 2), m.channels["T_bed"] + 1.0):
        d = diagnose(fitted(), [unread(m, um, other=copy)], draws=50, explain=True)
        assert not [x for x in d.doubts if x.kind == "not_read"]
        assert "scale(EXX, X) k from 61.17 to " in d.sentence


# Scatter


def test_nothing_is_missing_is_not_said_under_far_more_noise() -> None:
    """Each reading creeps after its arrival, and was taken after a wait of its own."""
    m, rng = day(101), np.random.default_rng(101)
    crept = 9.0 * m.channels["d_x"] * np.exp(-rng.uniform(2.0, 45.0, len(m)) / 8.0)
    said = stops(fitted(), unread(m, crept))
    assert said.startswith("Neighbouring readings scatter by ")
    assert "µm at the model's fit" in said


def test_steps_of_a_coarser_display_and_somewhat_more_noise_are_no_scatter() -> None:
    m = day(102, noise={"white_um": 3.0 * NOISE_UM})
    assert diagnose(fitted(), [m], draws=50).verdict == "nothing_missing"
    coarse = {k: 5.0 * np.round(v / 5.0) for k, v in day(103).readings.items()}
    assert "scatter" not in [k for k, _ in asked(fitted(), replace(m, readings=coarse))]
    assert "scatter" not in [d.kind for d in diagnose(fitted(), [replace(day(103), readings=coarse)], draws=50).doubts]


def test_a_fit_warns_of_positions_outside_the_travel() -> None:
    """`fit` had said nothing, and the model that it made then passed these files."""
    m = day(54)
    codes = [w.code for w in characterise([m]).warnings]
    assert "outside_travel" not in codes
    (said,) = [w for w in characterise([changed(m, x=m.channels["x"] + 50.0)]).warnings if w.code == "outside_travel"]
    assert said.text.endswith("outside its travel of 0 to 200 mm")
