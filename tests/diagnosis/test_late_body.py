"""Bodies that warm up after their sensors, or about another end of an axis. Oracle: the law in the readings."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from rtec.characterise import fitted_model
from rtec.characterise.candidates import thermal
from rtec.diagnosis.doubts.edited import as_in_the_fit
from rtec.diagnosis.doubts.edits import Edit
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.heat import late_sensor
from rtec.diagnosis.search import diagnose as search
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects.effect_list import read_wanted
from rtec.estimation.candidates import library
from rtec.estimation.gram.source import Source
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.estimation.readings import read
from rtec.estimation.visible import VisibleComponent
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.history import improved_page
from rtec.sim.campaign.truth import effect_from_text
from tests.support.both import both
from tests.support.diagnosis_examples import TABLE
from tests.support.machines import axis
from tests.support.warming import delayed

RUNS, TARGETS, NOISE_UM = 16, 15, 0.2
HEIGHTS = {"low": 0.0, "high": 220.0}
"""Of two drift probes above the origin of the spindle, mm."""


def mill() -> Machine:
    """X from -600 to 0 mm; a head and a table, and no link that is named after a spindle."""
    chains = {"name": "mill", "tool_chain": ["Z", "head", "tool"], "work_chain": ["X", "table"]}
    links = {name: {"offset_mm": [0.0, 0.0, 50.0]} for name in ("head", "tool", "table")}
    axes = {**TABLE["axis"], "X": axis("X", travel_mm=[-600.0, 0.0])}
    return machine_from({**TABLE, "machine": chains, "axis": axes, "link": links}, "mill")


def line(
    seed: int, tau_s: float = 0.0, um_per_degc: float = 0.0, growth: float = 0.0, fixed_mm: float = 0.0
) -> Measurement:
    """A laser along X while the bed warms for five hours and cools for three; the spindle runs in between.

    Args:
        seed: of the noise.
        tau_s: delay of the mounting and of the screw behind T_bed.
        um_per_degc: growth of the mounting.
        growth: of the screw, µm/(m·K), about `fixed_mm`.
        fixed_mm: its fixed end.
    """
    rng, machine = np.random.default_rng(seed), mill()
    there = np.linspace(-590.0, -10.0, TARGETS) + rng.uniform(-8.0, 8.0, TARGETS)
    x = np.tile(np.concatenate([there, there[::-1]]), RUNS)
    time_s = np.concatenate([1800.0 * r + 6.0 * np.arange(2 * TARGETS) for r in range(RUNS)])
    hours = time_s / 3600.0
    rise = np.where(hours < 5.0, 3.0 * (1.0 - np.exp(-hours / 1.5)), 2.9 * np.exp(-np.maximum(hours - 5.0, 0.0) / 1.2))
    body = delayed(rise, time_s, tau_s) if tau_s else rise
    error = um_per_degc * body + growth * 1e-3 * (x - fixed_mm) * body + 8e-3 * x
    reading = error + NOISE_UM * rng.standard_normal(len(x))
    channels = {
        "x": x, "d_x": np.tile(np.repeat([1.0, -1.0], TARGETS), RUNS), "T_bed": 20.0 + rise,
        "T_air": 20.0 + 0.3 * np.sin(hours), "spindle_rpm": np.where((hours > 0.5) & (hours < 5.0), 3000.0, 0.0),
    }  # fmt: skip
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    run = np.repeat(np.arange(RUNS), 2 * TARGETS)
    return Measurement("laser", made, machine, run, time_s, channels, {"reading_um": reading})


@pytest.mark.parametrize("tau_s", [1500.0, 3000.0])
def test_a_mounting_that_warms_after_its_sensor_is_named_with_its_delay(tau_s: float) -> None:
    """It had been called a spindle that grows in a table, or nothing of the catalogue."""
    m = line(3, tau_s, um_per_degc=3.0)
    d = diagnose(fitted_model([m], wanted=read_wanted("scale:EXX", m.machine)), [m], draws=50)
    first = d.findings[0]
    assert d.verdict in ("missing_effect", "ambiguous")
    assert (first.effect.effect, getattr(first.effect, "sensor", ""), getattr(first.effect, "lag", None)) == (
        "mount_expansion", "T_bed", True,
    )  # fmt: skip
    assert first.parameters["tau"].value == pytest.approx(tau_s, rel=0.1)
    assert first.parameters["k"].value == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("fixed_mm", [-600.0, -300.0, 0.0])
def test_a_late_screw_is_named_with_its_fixed_end(fixed_mm: float) -> None:
    """With its end elsewhere than at zero it had been called a screw that follows another sensor at once."""
    m = line(3, 2000.0, growth=9.0, fixed_mm=fixed_mm)
    d = diagnose(fitted_model([m], wanted=read_wanted("scale:EXX", m.machine)), [m], draws=50)
    first = d.findings[0]
    given = ("sensor", "lag", "fixed_mm")
    assert (first.effect.effect, *(getattr(first.effect, n) for n in given)) == (
        "axis_expansion",
        "T_bed",
        True,
        fixed_mm,
    )
    assert first.parameters["tau"].value == pytest.approx(2000.0, rel=0.1)
    assert first.parameters["k"].value == pytest.approx(9.0, rel=0.05)


def test_a_table_is_no_spindle() -> None:
    """Where no link is named after the spindle, any other body but a table may be it."""
    tried = [c.effect for c in library(read([line(1)]))[0]]
    links = {e.component[3:] for e in tried if e.effect.startswith("spindle")}
    assert links <= {"head", "tool"}


def test_nor_is_it_one_in_a_fit() -> None:
    """`rtec fit` calls what shifts a table the growth of a mounting; only the spindle's link has a spindle's growth."""
    m = probed(4, 6.0, 0.0)
    sources = [Source.of(m)]
    for link, effect in (("table", "mount_expansion"), ("spindle", "spindle_growth")):
        seen = VisibleComponent(f"EY0{link}", None, moves=False)
        assert {c.term.effect.effect for c in thermal(seen, sources, ["T_col_front"])} == {effect}


def test_the_record_that_a_model_was_fitted_to_is_not_accused_of_a_turned_axis() -> None:
    """A fit follows the places that the record has: with X turned round it might fit better, but X was not turned."""
    m = line(5, growth=8.0, fixed_mm=-600.0)
    known = fitted_model([m], wanted=read_wanted("scale:EXX,axis_expansion:EXX:sensor=T_bed", m.machine))
    turned = Edit(0.0, "turned_axis", "", "", "")
    of_another_day = replace(known, measurements={"another": "day"})
    assert as_in_the_fit(Judgement(of_another_day, clean([m])), turned)
    assert not as_in_the_fit(Judgement(known, clean([m])), turned)
    d = diagnose(known, [m], draws=50)
    assert d.findings[0].effect.effect in ("mount_expansion", "axis_expansion")


def test_what_is_significant_is_never_called_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect that explains half of what a shape without a name does is no answer; the shape is one."""
    m = line(7)
    u = m.channels["x"] / 300.0 + 1.0
    m = replace(m, readings={"reading_um": m.readings["reading_um"] - 2.5 * u**2 - 1.5 * u**3})
    monkeypatch.setattr(search, "adequacy", lambda *_: 0.5)
    monkeypatch.setattr(search.Search, "_shape_beside", lambda *_: math.inf)
    monkeypatch.setattr(search.Search, "_with_another", lambda *_: -math.inf)
    d = diagnose(fitted_model([m], wanted=read_wanted("scale:EXX", m.machine)), [m], draws=50)
    assert d.verdict != "nothing_missing"
    assert d.unknown is not None


def test_a_temperature_that_hardly_varied_is_given_as_the_reason() -> None:
    """The air varied by 0.6 °C. The addition would lower the error, so that "less than 2 %" would be untrue."""
    m = line(9, growth=8.0)
    air = 0.024 * m.channels["x"] * (m.channels["T_air"] - 20.0)
    m = replace(m, readings={"reading_um": m.readings["reading_um"] + air})
    known = fitted_model([m], wanted=read_wanted("scale:EXX,axis_expansion:EXX:sensor=T_bed", m.machine))
    done = improve(known, [m], draws=50)
    assert done.diagnoses[-1].findings[0].label == "axis_expansion(EXX, X, T_air)"
    assert done.reason == "narrow_range"
    assert "varied by less than 1 °C" in improved_page(done, figures=False).lead


def probed(seed: int, urad_per_degc: float, tau_s: float) -> Measurement:
    """Drift probes at two heights of an arbor; a column whose front is warmed twice, for an hour, leans behind it."""
    rng = np.random.default_rng(seed)
    chains = {"name": "mill", "tool_chain": ["column", "Z", "spindle"], "work_chain": ["X", "table"]}
    links = {"column": {}, "spindle": {"offset_mm": [0.0, 0.0, 150.0]}, "table": {}}
    sensors: dict[str, dict[str, object]] = {"T_col_front": {}, "T_col_back": {}, "T_spindle": {}, "T_air": {}}
    machine = machine_from({**TABLE, "machine": chains, "link": links, "temperature": sensors}, "mill")
    time_s = 150.0 * np.arange(210.0)
    run = 1 + (time_s // 3600.0).astype(np.int64)
    sun = np.where((time_s // 3600.0) % 4.0 < 2.0, 1.0, 0.0)
    front, back = 6.0 * delayed(sun, time_s, 1500.0), 1.5 * delayed(sun, time_s, 6000.0)
    air = 0.8 * np.sin(2.0 * np.pi * time_s / 86400.0)
    true = {"T_col_front": front + air, "T_col_back": back + air, "T_spindle": 0.5 * air, "T_air": air}
    tilt = urad_per_degc * (delayed(front - back, time_s, tau_s) if tau_s else front - back)
    probes = {f"probe.{n}": {"direction": "Y", "offset_mm": [0.0, 0.0, z], "sign": 1} for n, z in HEIGHTS.items()}
    setup = {"probe": {k.removeprefix("probe."): v for k, v in probes.items()}}
    read_degc = {k: np.round(20.0 + v + 0.03 * rng.normal(size=len(v)), 1) for k, v in true.items()}
    # A turn about X moves a point that is z above the spindle's origin by -z times the angle along Y.
    readings = {f"reading_{n}_um": -1e-3 * z * tilt + 0.4 * rng.normal(size=len(tilt)) for n, z in HEIGHTS.items()}
    still = np.zeros(len(time_s))
    return Measurement(
        name="probes", machine=machine, instrument=make_instrument("spindle_drift", setup, None, None, machine, "test"),
        run=run, time_s=time_s, channels={"x": still, "z": still, "spindle_rpm": still, **read_degc}, readings=readings,
    )  # fmt: skip


def test_a_column_that_leans_after_its_sides_are_warm_is_named() -> None:
    """The drift of the zero swallowed the slow lean; it had been called a drift of the room, or a shift."""
    m = probed(4, 6.0, 3000.0)
    known = Model(m.machine, (), name="empty")
    d, done = both(known, [m], draws=50)
    assert d.findings[0].label == "column_tilt(EA0spindle, T_col_front, T_col_back)"
    assert d.verdict in ("missing_effect", "ambiguous")
    assert d.findings[0].theta["tau"] == pytest.approx(3000.0, rel=0.2)
    assert Judgement(done.model, clean([probed(5, 6.0, 3000.0)])).residual < 1.2 * 0.4


@pytest.mark.parametrize("late_s", [45.0, 75.0])
def test_a_sensor_that_is_read_late_is_no_missing_effect(late_s: float) -> None:
    """A screw as in the model, its sensor behind it by a first-order lag and read in steps of 0.1 K.

    Oracle: the lag. As it was, "axis_expansion(EXX, X, T_x_nut) is missing", which the model has.
    """
    rng, runs, k = np.random.default_rng(7), 24, 11.5
    there = np.linspace(-590.0, -10.0, TARGETS)
    x = np.tile(np.concatenate([there, there[::-1]]), runs)
    run = np.repeat(np.arange(runs), 2 * TARGETS)
    time_s = 8.0 * np.arange(len(x)) + 300.0 * run
    at_s = np.arange(0.0, time_s[-1] + 1.0)
    screw = 20.0 + 4.0 * np.sin(at_s / 2200.0) ** 2
    shown = np.interp(time_s, at_s, delayed(screw, at_s, late_s))
    grown = k * 1e-3 * x * (np.interp(time_s, at_s, screw) - 20.0)
    machine = mill()
    m = Measurement(
        name="late", machine=machine, run=run, time_s=time_s, channels={"x": x, "T_bed": np.round(shown, 1)},
        instrument=make_instrument("laser_linear", {}, "X", None, machine, "test"),
        readings={"reading_um": grown + 0.6 * rng.standard_normal(len(x))},
    )  # fmt: skip
    growth = effect_from_text(f"axis_expansion,component=EXX,axis=X,sensor=T_bed,k={k}", machine)
    found = diagnose(Model(machine, (growth,), name="known"), [m], draws=50)
    assert found.verdict in ("nothing_missing", "undecided")
    (said,) = [d for d in found.doubts if d.kind == "late_sensor"]
    told = re.search(r"as if the sensor were (\d+) s later than the part", said.message)
    assert told
    assert float(told[1]) == pytest.approx(late_s, rel=0.3)


@pytest.mark.parametrize(("number", "said"), [(11.5, True), (0.0, False)])
def test_a_late_sensor_needs_an_effect_that_acts(number: float, said: bool) -> None:
    """Oracle: the quotient of the numbers, 10 s; an effect of zero follows nothing."""
    machine = mill()
    at_once = effect_from_text(f"axis_expansion,component=EXX,axis=X,sensor=T_bed,k={number}", machine)
    found = late_sensor(at_once.effect.model_copy(update={"lag": True}), 100.0, -1.15, [at_once])
    assert (found is not None) is said
    assert found is None or "as if the sensor were 10 s later than the part" in found.message
    by_speed = effect_from_text("spindle_growth,component=EZ0head,k=1,tau=100,p=1", machine)
    assert late_sensor(by_speed.effect, 300.0, -0.1, [by_speed]) is None
