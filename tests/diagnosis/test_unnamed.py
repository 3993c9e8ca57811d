"""What has no name in the catalogue. Oracle: what the benchmark's own physics hid."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import build
from rtec.diagnosis.result import Diagnosis
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.shapes import Ground, LocalPlace, Shape
from rtec.diagnosis.search.unnamed import Shaped, by_own_sensors
from rtec.estimation.gls import Fit
from rtec.estimation.readings import read
from rtec.machine import load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.diagnosis_examples import effects, laser, recorded_by_laser, small_machine

Floats = NDArray[np.float64]
MACHINES = Path(__file__).parents[2] / "configs" / "machines"


@pytest.mark.parametrize(("what", "seed"), proof.few([("bump", 2), ("step", 1), ("sawtooth", 1), ("step", 2)], 3))
def test_a_place_along_an_axis_is_no_catalogue_effect_of_many_numbers(what: str, seed: int) -> None:
    trial = build("beyond", what, seed)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)
    assert not d.together


def test_a_wave_without_a_name_is_said_with_all_periods_that_equal_steps_show_alike() -> None:
    """Oracles: a cosine at the targets, which is the same for each period; the hidden one is 0.86 to 0.96 steps."""
    trial = build("aliases", "alias", 31000)
    d = diagnose(model_of(trial), measurements_of(trial), draws=50)
    assert d.unknown is not None
    assert d.unknown.period is not None
    assert d.unknown.step_mm == pytest.approx(25.0)
    targets = 25.0 * np.arange(24)
    waves = [np.cos(2.0 * np.pi * targets / p) for p in (d.unknown.period.value, *d.unknown.aliases_mm)]
    assert len(waves) == 3
    assert np.allclose(waves[1:], waves[0])
    assert any(0.86 * 25.0 < p < 0.96 * 25.0 for p in d.unknown.aliases_mm)
    assert "targets every 25 mm show these periods alike" in d.sentence


def test_a_curve_of_the_whole_travel_is_still_named() -> None:
    """Ten knots put in by hand: no hump and no step says them with fewer numbers."""
    truth = [
        "piecewise_position,component=EXX,axis=X,knots_mm=[0,40,80,120,160,200],at0=0,at1=4,at2=-3,at3=4,at4=-4,at5=3"
    ]
    d = diagnose(Model(small_machine(), name="empty"), [laser(truth, 3)], draws=50)
    assert d.unknown is None
    assert d.findings[0].accepted


def test_hump_and_step_are_what_they_say() -> None:
    """Oracle: the values of exp(-1) one width from the centre, and of tanh."""
    hump, step = LocalPlace("hump", 10.0, 2.0), LocalPlace("step", 10.0, 2.0)
    at = np.array([8.0, 10.0, 12.0])
    assert hump.curve(at) == pytest.approx([np.exp(-1.0), 1.0, np.exp(-1.0)])
    assert step.curve(at) == pytest.approx([-np.tanh(1.0), 0.0, np.tanh(1.0)])


@pytest.mark.parametrize(
    "shapes",
    [
        [Shape("EXX", ("x",), (0,), p) for p in (11.0, 23.0)],
        [Shape("EXX", ("x",), (0,), place=LocalPlace("hump", c, 4.0)) for c in (50.0, 90.0, 120.0)],
        [Shape("EXX", ("x",), (0,), place=LocalPlace("step", 60.0, w)) for w in (2.0, 9.0)],
        [Shape("EXX", ("x", "time_s"), (0, 1), 30.0), Shape("EXX", ("x", "x"), (0, 2), 30.0)],
        [Shape("EXX", ("x",), (5,)), Shape("EXX", ("x",), (0,), 12.0)],
    ],
)
def test_columns_of_several_shapes_are_those_of_each(shapes: list[Shape]) -> None:
    """Oracle: the columns of each shape by itself."""
    ground = Ground(read([laser([], 3)]))
    group = next(iter(ground.groups))
    named = [Shape(group, s.over, s.fine, s.period, s.place) for s in shapes]
    whole, widths = ground.block(named)
    assert np.array_equal(whole, np.concatenate([ground.columns(s) for s in named], axis=1))
    assert widths.tolist() == [ground.columns(s).shape[1] for s in named]


@pytest.mark.parametrize("seed", proof.few([0, 1, 2], 2))
def test_no_heat_is_named_for_a_shape_of_place_and_load(seed: int) -> None:
    """Oracle: the formula that was put in, |x| times the load squared, which grew while the machine warmed."""
    rng = np.random.default_rng(seed)
    cold = laser([], seed)
    runs = np.unique(cold.run)
    load_kg = (40.0 + 30.0 * np.arange(len(runs)) + rng.uniform(-60.0, 60.0, len(runs)))[cold.run - runs[0]].clip(0.0)
    error = 6.0 * (np.abs(cold.channels["x"]) / 200.0) * (load_kg / 500.0) ** 2
    m = replace(
        cold,
        channels={**cold.channels, "load_kg": load_kg},
        readings={"reading_um": cold.readings["reading_um"] + error},
    )
    d = diagnose(Model(small_machine(), name="empty"), [m], draws=50)
    heat = {c for c in m.channels if c.startswith("T_")}
    named = [m.fitted.effect for m in d.together] or [f.effect for f in d.findings[:1] if f.accepted]
    assert not any(heat & set(e.channels(m.machine)) for e in named), d.sentence


def at_few_targets(curve: Callable[[Floats], Floats], seed: int, count: int = 12) -> Diagnosis:
    """Targets at unequal steps, nine times there and back; the model knows the scale error and the backlash."""
    machine, rng = small_machine(), np.random.default_rng(seed)
    at = np.linspace(5.0, 195.0, count) + rng.uniform(-4.0, 4.0, count) * 12 / count
    x = np.tile(np.concatenate([at, at[::-1]]), 9)
    n, day = len(x), np.linspace(0.0, 1.0, len(x))
    channels = {
        "x": x,
        "d_x": np.tile(np.repeat([1.0, -1.0], count), 9),
        "T_bed": 20.0 + 2.0 * day,
        "T_air": 21.0 - day,
    }
    readings = {"reading_um": curve(x) + 0.01 * x + 0.2 * rng.standard_normal(n)}
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    m = Measurement(
        "few", made, machine, np.repeat(np.arange(1, 10), 2 * count), np.linspace(0.0, 9.0 * n, n), channels, readings
    )
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")
    return diagnose(Model(machine, known, name="known"), [m], draws=50, explain=True)


def test_a_plate_that_waves_along_both_axes_depends_on_both() -> None:
    """Nearly two periods along X, one and a half along Z. A surface of four by four had seen next to nothing of it."""
    rng, machine = np.random.default_rng(3), small_machine()
    x, z = (np.tile(v.ravel(), 6) for v in np.meshgrid(np.linspace(0.0, 200.0, 12), np.linspace(0.0, 300.0, 12)))
    turn = 2.0 * np.pi * np.stack([x / 104.0 + 0.1, z / 185.0 + 0.5])
    n = len(x)
    readings = {f"reading_{c}_um": rng.normal(0.0, 0.4, n) for c in "xyz"}
    readings["reading_y_um"] += 2.5 * np.sin(turn[0]) * np.sin(turn[1])
    channels = {"x": x, "z": z, "T_bed": np.full(n, 20.0), "T_air": np.linspace(20.0, 20.5, n)}
    made = make_instrument("tool_tip", {}, None, None, machine, "test")
    m = Measurement(
        "plate",
        made,
        machine,
        np.repeat(np.arange(1, 7), 144),
        6.0 * np.arange(n, dtype=np.float64),
        channels,
        readings,
    )
    d = diagnose(Model(machine), [m], draws=50)
    assert d.unknown is not None
    assert set(d.unknown.channels) == {"x", "z"}
    assert d.unknown.r2 > 0.5  # most of it


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
@pytest.mark.parametrize("form", ["hump", "step"])
def test_a_hump_or_a_step_at_few_targets_is_no_curve_of_many_numbers(form: str, seed: int) -> None:
    centre = 60.0 + 25.0 * seed
    place = LocalPlace("hump" if form == "hump" else "step", centre, 22.0 if form == "hump" else 8.0)
    d = at_few_targets(lambda x: 3.0 * place.curve(x), seed)
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)
    assert form in d.unknown.where


@pytest.mark.parametrize("seed", proof.few(range(3), 1))
@pytest.mark.parametrize("which", [[30], [30, 31], [12, 45]])
def test_what_two_of_many_targets_show_is_no_shape(which: list[int], seed: int) -> None:
    """Sixty targets, 3.2 mm apart, of which one or two are 2 µm off in every run."""
    d = at_few_targets(lambda x: np.where(np.isin(x, np.unique(x)[which]), 2.0, 0.0), seed, 60)
    assert d.unknown is None, d.sentence
    assert not any(f.accepted for f in d.findings), d.sentence
    assert d.verdict == "undecided"
    assert re.search("stands? out from all others", d.sentence)


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_what_one_reading_at_each_of_two_targets_shows_is_nothing(seed: int) -> None:
    """Oracle: two of 1080 readings are 9 µm off."""
    d = at_few_targets(lambda x: np.where(np.isin(np.arange(len(x)), [30, 271]), 9.0, 0.0), seed, 60)
    assert d.unknown is None, d.sentence
    assert d.verdict == "nothing_missing"


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_a_hump_of_a_few_targets_is_one(seed: int) -> None:
    d = at_few_targets(lambda x: 2.0 * np.exp(-(((x - 80.0 - 20.0 * seed) / 5.0) ** 2)), seed, 60)
    assert d.unknown is not None
    assert "a hump at X" in d.unknown.where


@pytest.mark.parametrize("seed", proof.few(range(4), 2))
def test_a_curve_of_many_numbers_at_few_targets_is_still_named(seed: int) -> None:
    heights = 3.0 * np.random.default_rng(seed).choice([-1.0, 1.0], 11) * np.tile([1.0, 0.4], 6)[:11]
    d = at_few_targets(lambda x: np.interp(x, np.linspace(0.0, 200.0, 11), heights), seed)
    assert d.unknown is None
    assert d.findings[0].accepted


@pytest.mark.parametrize("degree", [2, 3])
def test_a_bow_at_few_targets_is_still_named(degree: int) -> None:
    d = at_few_targets(lambda x: 3.0 * (x / 100.0 - 1.0) ** degree, 1)
    assert d.unknown is None
    assert d.findings[0].accepted


@pytest.mark.parametrize("seed", proof.few(range(4), 2))
def test_a_wave_of_hardly_more_than_a_turn_is_a_bow_and_no_step(seed: int) -> None:
    """It rises over four tenths of the travel."""
    d = at_few_targets(lambda x: 0.25 * np.sin(1.2 * np.pi * (x / 100.0 - 1.0) + 0.8 * seed), seed)
    assert any(f.accepted for f in d.findings)


def follows(time_s: Floats, drive: Floats, tau_s: float) -> Floats:
    """First-order lag behind a drive, at even times."""
    out, step = np.empty_like(drive), float(time_s[1] - time_s[0])
    out[0] = drive[0]
    for k in range(1, len(drive)):
        out[k] = out[k - 1] + (drive[k] - out[k - 1]) * step / (tau_s + step)
    return out


def heated_and_cooled(seed: int, along: bool = False) -> Measurement:
    """Eleven runs; in the pauses a part is heated or not. The error turns where it is half warm, as a joint that lifts.

    The other temperature follows the first as a neighbour does; both sensors lag. `along` makes it bend along X, too.
    """
    machine, rng = small_machine(), np.random.default_rng(seed)
    runs = 11
    at = np.linspace(5.0, 195.0, 12) + rng.uniform(-4.0, 4.0, 12)
    x = np.tile(np.concatenate([at, at[::-1]]), runs)
    n, run = len(x), np.repeat(np.arange(runs), 24)
    pause_s = rng.uniform(900.0, 2400.0, runs)
    time_s = 9.0 * np.arange(n) + np.concatenate([[0.0], pause_s.cumsum()[:-1]])[run]
    t = np.arange(-600.0, time_s[-1] + 60.0, 20.0)
    begin = np.interp(t, time_s, run)
    resting = np.abs(begin - np.round(begin)) > 1e-9
    hot = resting & np.isin(np.floor(begin), rng.choice(np.arange(2, runs - 2), 4, replace=False))
    warm = follows(t, np.where(hot, 9.0, 0.0), 1800.0)
    near = follows(t, np.asarray(0.6 * warm + 0.8 * np.sin(t / 4000.0 + seed), dtype=np.float64), 5000.0)
    body = {"T_bed": warm, "T_air": near}
    channels = {"x": x, "d_x": np.tile(np.repeat([1.0, -1.0], 12), runs)}
    for s, value in body.items():
        sensed = np.interp(time_s, t, follows(t, value, 120.0)) + 0.015 * rng.standard_normal(n)
        channels[s] = np.round(16.0 * (20.0 + sensed)) / 16.0
    true = np.interp(time_s, t, warm)
    error = 2.5 * np.abs(true - np.quantile(true, 0.6)) * (2.0 * (x / 100.0 - 1.0) ** 2 if along else 1.0)
    readings = {"reading_um": error + 0.3 * rng.standard_normal(n)}
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    return Measurement("warm", made, machine, run + 1, time_s, channels, readings)


def depends_on(m: Measurement) -> tuple[str, ...]:
    known = effects("scale,component=EXX,axis=X,k=0", "backlash,component=EXX,axis=X,B=0")
    d = diagnose(Model(small_machine(), known, name="known"), [m], draws=50)
    return d.unknown.channels if d.unknown is not None else ()


@pytest.mark.parametrize("seed", proof.few([0, 1, 8, 11, 17, 21, 22], 2))
def test_only_the_temperature_that_matters_is_named(seed: int) -> None:
    assert depends_on(heated_and_cooled(seed)) == ("T_bed",)


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_a_position_and_a_temperature_are_named_where_both_matter(seed: int) -> None:
    assert set(depends_on(heated_and_cooled(seed, along=True))) == {"x", "T_bed"}


def swelling_play(seed: int) -> Measurement:
    """A laser of a machine that is too long by 9 µm/m and whose play grows and falls back four times."""
    m = laser(["scale,component=EXX,axis=X,k=9", "backlash,component=EXX,axis=X,B=2"], seed)
    x, d = m.channels["x"], m.channels["d_x"]
    worn = 2.5 * d * (np.mod(x, 52.0) / 26.0 - 1.0)
    return replace(m, readings={"reading_um": m.readings["reading_um"] + worn})


@pytest.mark.parametrize("seed", proof.few(range(3), 2))
def test_a_simple_effect_is_named_beside_a_curve_of_both_directions(seed: int) -> None:
    """Oracle: the formulas that were put in; a surface over position and direction contains both."""
    model = Model(small_machine(), effects("backlash,component=EXX,axis=X,B=2"), name="known")
    d = diagnose(model, [swelling_play(seed)], draws=50)
    assert d.findings[0].effect.effect == "scale"
    assert d.findings[0].parameters["k"].value == pytest.approx(9.0, abs=1.0)
    assert d.unknown is not None
    assert set(d.unknown.channels) == {"x", "d_x"}


def test_simple_effects_are_named_beside_a_curve_along_the_axis() -> None:
    """Oracle: the formulas that were put in: a wave of the guide that no effect has, a tilt by the heat of the bed."""
    laid = laser([], 4)
    x, warm, rng = laid.channels["x"], laid.channels["T_bed"], np.random.default_rng(4)
    wave = 6.0 * np.sin(2.4 * np.pi * x / 200.0 + 0.4) * np.exp(-x / 150.0)
    angle = wave + 1.2 * (warm - warm.mean()) + 0.3 * rng.standard_normal(len(x))
    turned = make_instrument("laser_angular", {"about": "B"}, "X", None, laid.machine, "test")
    m = replace(laid, instrument=turned, readings={"reading_urad": angle})
    d = diagnose(Model(small_machine(), (), name="none"), [m], draws=50)
    assert d.findings[0].accepted
    assert "T_bed" in d.findings[0].channels
    assert d.unknown is not None
    assert d.unknown.channels == ("x",)


def shape_over(*over: str, evidence: float, drop: float) -> Shaped:
    """A refitted shape of which only the evidence matters."""
    return Shaped(Shape("EXX", over, (2,) * len(over)), np.zeros((0, 1)), cast(Fit, None), evidence, drop, 1.0)


@pytest.mark.parametrize(
    ("evidence", "drop", "first"),
    [(104.9, 0.971, "T_x_nut"), (104.9, 0.9, "T_z_nut"), (80.0, 0.971, "T_z_nut")],
    ids=["nearly as likely", "predicts worse", "far less likely"],
)
def test_a_shape_follows_the_nut_of_its_own_axis(evidence: float, drop: float, first: str) -> None:
    """Oracle: which of two nuts that warm alike belongs to the axis, by its name; the readings overrule it."""
    machine = load_machine(MACHINES / "turning-centre.toml")
    top, own = shape_over("x", "T_z_nut", evidence=108.0, drop=0.955), ("x", "T_x_nut")
    others = [top, shape_over(*own, evidence=evidence, drop=drop), shape_over("x", evidence=107.0, drop=0.96)]
    assert by_own_sensors(top, others, machine).shape.variables == ("x", first)


def wave_that_grows_warm(seed: int) -> Measurement:
    """A wave of 100 mm along X, 1.1 µm per kelvin above 20 °C, while the bed warms from 20.6 to 32 °C and cools."""
    rng = np.random.default_rng(seed)
    there = np.linspace(5.0, 195.0, 13)
    x = np.tile(np.concatenate([there, there[::-1]]), 14)
    run = np.repeat(np.arange(14) + 1, 26)
    time_s = 8.0 * np.arange(len(x)) + 800.0 * run
    rise = np.where(time_s < 8000.0, 1.0 - np.exp(-time_s / 2500.0), 0.96 * np.exp(-(time_s - 8000.0) / 5000.0))
    bed = 20.6 + 11.4 * rise
    reading = 0.55 * np.sin(2.0 * np.pi * x / 100.0 + 0.7) * (bed - 20.0) + rng.normal(0.0, 0.3, len(x))
    channels = {"x": x, "T_bed": np.round(bed + rng.normal(0.0, 0.03, len(x)), 1)}
    return recorded_by_laser(seed, run, time_s, channels, np.round(reading, 1))


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
def test_a_shape_that_grows_with_a_temperature_is_no_curve_over_the_position(seed: int) -> None:
    """Least squares: any curve over X alone leaves a third of the root mean square, the product a tenth."""
    found = diagnose(Model(small_machine(), (), name="bare"), [wave_that_grows_warm(seed)])
    assert found.unknown is not None, found.sentence
    assert set(found.unknown.channels) == {"x", "T_bed"}
