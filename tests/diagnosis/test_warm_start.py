"""Records of which the first hours are cut off, so that they begin while the spindle is warm.

Oracle: the same day from the cold start on. Bodies and their delays are integrated here in steps of a second; what a
body remembers from before the cut fades as exp(-t/τ).
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.search.diagnose import diagnose
from rtec.effects.effect_list import read_wanted
from rtec.estimation.given import given_to
from rtec.estimation.judge import Judgement
from rtec.estimation.outliers import clean
from rtec.estimation.readings import read
from rtec.machine import Machine, machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.both import both
from tests.support.diagnosis_examples import TABLE

pytestmark = pytest.mark.xdist_group("warm-start")

Floats = NDArray[np.float64]
NOISE_UM, EVERY_S, HOURS = 0.15, 300, 13.0
TAU_Z_S, TAU_X_S = 1800.0, 3600.0
K_Z, K_X = -1.2, 0.7
WANTED = "spindle_growth:EX0spindle:sensor=T_spindle:lag=true,spindle_growth:EZ0spindle:sensor=T_spindle:lag=true"
PROBES = {"x": {"direction": "X", "offset_mm": [0.0, 0.0, 0.0]}, "z": {"direction": "Z", "offset_mm": [0.0, 0.0, 0.0]}}


def lathe() -> Machine:
    sensors: dict[str, Any] = {"T_spindle": {}, "T_bed": {}, "T_air": {}}
    chain = {"name": "small", "tool_chain": ["Z", "X", "tool"], "work_chain": ["spindle", "workpiece"]}
    links = {**TABLE["link"], "spindle": {"offset_mm": [0.0, 0.0, 0.0]}}
    return machine_from({**TABLE, "machine": chain, "temperature": sensors, "link": links}, "small")


def behind(values: Floats, tau_s: float) -> Floats:
    """A body that lags, step by step of a second; at rest at first."""
    out, share = np.empty_like(values), 1.0 / tau_s
    out[0] = values[0]
    for i in range(1, len(values)):
        out[i] = out[i - 1] + share * (values[i] - out[i - 1])
    return out


def day(seed: int, from_h: float = 0.0, column_um_per_degc: float = 0.0) -> Measurement:
    """A spindle that runs for four hours, rests for three, runs for two and rests.

    Args:
        seed: of the noise.
        from_h: what was before is cut off.
        column_um_per_degc: growth along Z by T_bed, which the model does not have.
    """
    rng = np.random.default_rng(seed)
    hours = np.arange(0.0, HOURS, 1.0 / 3600.0)
    rpm = np.where((hours > 0.5) & (hours < 4.5), 4000.0, np.where((hours > 7.5) & (hours < 9.5), 6000.0, 0.0))
    air = 20.0 + 0.5 * np.sin(2.0 * np.pi * hours / 24.0)
    spindle = air + behind(rpm / 400.0, 1500.0)
    bed = 20.0 + 3.0 * np.sin(2.0 * np.pi * (hours - 1.0) / 6.0) * (hours > 1.0)
    z = K_Z * behind(spindle - 20.0, TAU_Z_S) + column_um_per_degc * (bed - 20.0)
    x = K_X * behind(spindle - 20.0, TAU_X_S)
    rows = np.arange(int(from_h * 3600), len(hours), EVERY_S)
    channels = {
        "x": np.full(len(rows), 100.0), "z": np.full(len(rows), 100.0), "spindle_rpm": rpm[rows],
        "T_spindle": spindle[rows] + 0.02 * rng.standard_normal(len(rows)), "T_bed": bed[rows], "T_air": air[rows],
    }  # fmt: skip
    readings = {
        f"reading_{n}_um": v[rows] + NOISE_UM * rng.standard_normal(len(rows)) for n, v in {"x": x, "z": z}.items()
    }
    made = make_instrument("spindle_drift", {"probe": PROBES}, None, None, lathe(), "test")
    time_s = EVERY_S * np.arange(float(len(rows)))
    return Measurement(f"day-{seed}", made, lathe(), np.zeros(len(rows), np.int64), time_s, channels, readings)


@cache
def known() -> Model:
    """The model, from two whole days."""
    return characterise([day(1), day(2)], wanted=read_wanted(WANTED, lathe())).model


def warm(model: Model, *records: Measurement) -> str:
    return given_to(model, records).starts


@pytest.mark.parametrize("from_h", [4.6, 5.5, 10.0])
def test_a_true_model_is_right_where_the_first_hours_are_cut_off(from_h: float) -> None:
    """As it was, two or three effects were "missing", and the model got worse on whole days by a factor of ten."""
    late = day(3, from_h)
    plain = Judgement(known(), clean([late]))
    assert plain.residual > 2.0 * NOISE_UM
    found = compare(known(), [late])
    assert found.judged.residual == pytest.approx(NOISE_UM, rel=0.2)
    assert [d.kind for d in found.doubts if d.kind == "warm_start"] == ["warm_start"]
    answer, better = both(known(), [late], ask=None, draws=50)
    assert answer.verdict == "nothing_missing"
    assert "day-3 begins while the machine is warm (T_spindle" in answer.sentence
    assert better.model.effects == known().effects


def test_a_record_from_the_cold_start_on_has_none() -> None:
    assert warm(known(), day(4), day(5)) == ""
    assert compare(known(), [day(4)]).judged.residual == pytest.approx(NOISE_UM, rel=0.2)


def test_each_record_has_its_own_start() -> None:
    assert warm(known(), day(4), day(6, 5.0), day(7, 10.0)).startswith("day-6 and day-7 begin while")


def test_a_start_fades_with_the_delay_of_its_effect() -> None:
    """Of a record that begins at the cut, the states of the whole day at the cut are the true starts."""
    cut_s, late = int(5.0 * 3600), day(8, 5.0)
    whole = predicted(day(8), known())
    cut = predicted(late, known())
    off = whole[:, cut_s // EVERY_S :] - cut
    fades = np.stack([np.exp(-late.time_s / t) for t in taus()])
    np.testing.assert_allclose(off, off[:, :1] * fades, atol=0.06)


def taus() -> list[float]:
    return [f.theta["tau"] for f in known().effects]


def predicted(m: Measurement, model: Model) -> Floats:
    """What each effect of the model predicts, (effects, n)."""
    readings = read([m], smooth=False)
    each = [readings.columns(f.effect, f.theta)[:, 0] * f.values["k"] for f in model.effects]
    return np.stack([e.reshape(2, -1)[i] for i, e in enumerate(each)])


def test_an_effect_is_named_although_the_record_begins_warm() -> None:
    answer = diagnose(known(), [day(9, 4.6, column_um_per_degc=0.8)], draws=50)
    assert answer.verdict in ("missing_effect", "ambiguous")
    assert "T_bed" in {getattr(f.effect, "sensor", "") for f in answer.findings[:1]}


def test_a_missing_effect_of_a_whole_day_is_no_warm_start() -> None:
    assert warm(known(), day(10, column_um_per_degc=0.8)) == ""


def test_fit_estimates_the_starts_of_records_that_begin_warm() -> None:
    """It had chosen five effects, two of them by T_bed, and was 1.2 µm wrong on a whole day."""
    found = characterise([day(11, 5.0), day(12, 5.0)])
    (said,) = [w.text for w in found.warnings if w.code == "warm_start"]
    assert said.startswith("day-11 and day-12 begin while the machine is warm (T_spindle)")
    assert "T_bed" not in {getattr(f.effect, "sensor", "") for f in found.model.effects}
    assert found.judged.held_out < 0.35
    assert compare(found.model, [day(13)]).judged.residual < 0.35


def test_named_effects_get_their_true_numbers_from_records_that_begin_warm() -> None:
    found = characterise([day(11, 5.0), day(12, 9.6)], wanted=read_wanted(WANTED, lathe()))
    assert [w.code for w in found.warnings].count("warm_start") == 1
    for fitted, k, tau_s in zip(found.model.effects, (K_X, K_Z), (TAU_X_S, TAU_Z_S), strict=True):
        assert abs(fitted.values["k"]) == pytest.approx(abs(k), rel=0.05)
        assert fitted.theta["tau"] == pytest.approx(tau_s, rel=0.1)


def test_fit_says_nothing_of_whole_days() -> None:
    assert not [w for w in characterise([day(13), day(14)]).warnings if w.code == "warm_start"]


def test_what_fades_is_determined_by_the_fold_where_it_begins() -> None:
    """A zero is determined by all folds; what fades within one is not determined by the others."""
    late = day(15, 5.0)
    opened = late.instrument.setup.model_copy(update={"start": "unknown"})
    readings = read([replace(late, instrument=replace(late.instrument, setup=opened))], smooth=False)
    alone = dict(zip(readings.setup_names, readings.alone.T.tolist(), strict=True))
    first = [fold == readings.fold[0] for fold in np.unique(readings.fold)]
    for name, there in alone.items():
        assert there == (first if name.startswith("start") else [False] * len(first)), name


@pytest.mark.parametrize(("tau_z_s", "tau_x_s"), [(TAU_Z_S, TAU_X_S), (750.0, 1800.0), (300.0, 300.0)])
@pytest.mark.parametrize("seed", proof.few(range(20, 24), 1))
def test_what_lags_where_a_spindle_starts_and_stops_is_no_wrong_reading(
    monkeypatch: pytest.MonkeyPatch, tau_z_s: float, tau_x_s: float, seed: int
) -> None:
    """Up to six of 314 readings were left out there, as far from a fit by the sensor; a wrong one is found beside."""
    monkeypatch.setattr("tests.diagnosis.test_warm_start.TAU_Z_S", tau_z_s)
    monkeypatch.setattr("tests.diagnosis.test_warm_start.TAU_X_S", tau_x_s)
    m = day(seed)
    assert not clean([m]).wrong
    values = m.readings["reading_z_um"].copy()
    values[60] += 12.0
    spoilt = replace(m, readings={**m.readings, "reading_z_um": values})
    assert [(w.column, w.row) for w in clean([spoilt]).wrong] == [("reading_z_um", 60)]


def test_compare_draws_the_unknown_start_as_a_part_of_the_prediction() -> None:
    """Without it a record of 4 µm seemed to have 0.6 µm measured. Oracle: the readings, less their mean alone."""
    late = day(3, 5.5)
    found = compare(known(), [late])
    z = late.readings["reading_z_um"]
    (item,) = [i for i in found.items if i.column == "reading_z_um"]
    assert item.measured.rms == pytest.approx(float(np.std(z)), rel=0.01)
    assert item.left.rms == pytest.approx(NOISE_UM, rel=0.2)
    assert "unknown start" in [p.label for p in item.parts]
    np.testing.assert_allclose(found.traces.left, found.judged.left, atol=1e-9)
