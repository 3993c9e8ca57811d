"""Numbers between the values that a search tries, few readings, and what is missing beside the first.

Oracles: the numbers that were put in; a brute scan by numpy's own least squares; chance, where nothing is hidden.
"""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.diagnosis.extend.add import rivals_of
from rtec.diagnosis.extend.improve import improve
from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.polish import live_columns, polished
from rtec.diagnosis.search.prepared import prepare
from rtec.diagnosis.search.screen import Projected
from rtec.errors import MeasurementError
from rtec.estimation.gls import resolved
from rtec.estimation.noise import find_noise
from rtec.estimation.outliers import clean
from rtec.estimation.readings import read
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.report.diagnosis import diagnosis_page
from rtec.report.evidence import evidence
from tests.support.diagnosis_examples import effects, laser, small_machine, write_laser, write_machine

FADING = "lost_motion,component=EXX,axis=X,A=5,s0=7.3"
SCREW = "cyclic_screw,component=EXX,axis=X,harmonics=1,s1=1.6,c1=-0.9,pitch=5.021"
WEAR = "backlash_position,component=EXX,axis=X,b0=1.4,b1=1.1,b2=0.5"
SIMPLE = [
    "scale,component=EXX,axis=X,k=9",
    "backlash,component=EXX,axis=X,B=2.4",
    "axis_expansion,component=EXX,axis=X,sensor=T_bed,k=10",
]
DRIFTING = {"white_um": 0.3, "drift_um": 0.8, "drift_tau_s": 4000.0, "run_offset_um": 0.4}
FAR = 4.0
"""Standard errors."""


def model(*texts: str) -> Model:
    return Model(small_machine(), effects(*texts), name="base")


def first(m: Measurement, n: int, start: int = 0) -> Measurement:
    """Some of the rows of a measurement."""
    part = slice(start, start + n)
    arrays = {f.name: getattr(m, f.name)[part] for f in fields(m) if f.name in ("run", "time_s")}
    channels = {k: v[part] for k, v in m.channels.items()}
    return replace(m, **arrays, channels=channels, readings={k: v[part] for k, v in m.readings.items()})


@pytest.mark.parametrize(("hidden", "name", "value"), [(FADING, "s0", 7.3), (SCREW, "pitch", 5.021)])
def test_a_number_between_those_tried_is_found_within_its_error(hidden: str, name: str, value: float) -> None:
    """Neither is one of the values that are tried; an error about one of these would be a promise that is not kept."""
    d = diagnose(model(), [laser([hidden], 21)])
    found = d.findings[0]
    assert found.effect.effect == hidden.split(",", maxsplit=1)[0]
    tried = found.effect.nonlinear(small_machine())[0].grid
    assert value not in tried
    number = found.parameters[name]
    assert number.se is not None
    assert abs(number.value - value) < FAR * number.se
    assert min(abs(value - t) for t in tried) > FAR * number.se


def test_no_value_near_by_explains_more() -> None:
    """A scan of the whole neighbourhood by `numpy.linalg.lstsq` finds nothing better."""
    m = laser([FADING], 22)
    prepared = prepare(model(), clean([m]))
    projected = Projected.of(prepared.whitener, prepared.base, prepared.readings.values)
    (effect,) = (f.effect for f in effects(FADING))

    def left(s0: float) -> float:
        white = projected.take_out(prepared.whitener(prepared.readings.columns(effect, {"s0": s0})))
        return float(np.linalg.lstsq(white, projected.left, rcond=None)[1][0])

    tried = [{"s0": v} for v in (2.0, 5.0, 12.0)]
    found = polished(effect, tried, 1, prepared.readings, lambda: projected)
    assert left(found["s0"]) <= min(map(left, np.linspace(2.0, 12.0, 161))) * (1.0 + 1e-4)
    assert left(found["s0"]) < left(5.0)


def test_an_instant_is_looked_for_between_all_readings_near_by() -> None:
    """Oracle: the pause in which the loss was put. Nothing changes until an instant passes the next reading."""
    m = laser([], 23)
    readings = read([m], 20.0)
    (step,) = (f.effect for f in effects("missed_counts,component=EXX,axis=X,q=2,t0=3600"))
    times = np.unique(readings.time_s)
    pauses = 0.5 * (times[1:] + times[:-1])
    true = float(pauses[len(pauses) // 2])
    lost = replace(readings, values=readings.values + 40.0 * (readings.time_s > true))
    whitener = find_noise(lost, np.ones((len(lost), 1)), steps=5)
    projected = Projected.of(whitener, np.ones((len(lost), 1)), lost.values)
    tried = [{"t0": float(t)} for t in pauses[len(pauses) // 2 % 7 + 3 :: 7]]
    best = min(range(len(tried)), key=lambda i: abs(tried[i]["t0"] - true))
    assert tried[best]["t0"] != true
    assert polished(step, tried, best, lost, lambda: projected) == {"t0": true}


def test_the_best_stays_near_its_neighbours() -> None:
    """What fits best is far from all that was tried: nobody searched there, so only some steps towards it are made."""
    prepared = prepare(model(), clean([laser([FADING], 22)]))
    projected = Projected.of(prepared.whitener, prepared.base, prepared.readings.values)
    (effect,) = (f.effect for f in effects(FADING))
    tried = [{"s0": v} for v in (40.0, 60.0, 90.0)]
    inside = polished(effect, tried, 1, prepared.readings, lambda: projected)
    assert 40.0 / 1.6**3 <= inside["s0"] < 60.0
    at_end = polished(effect, tried, 0, prepared.readings, lambda: projected)
    assert 40.0 / 1.5 / 1.6**3 <= at_end["s0"] < 40.0


def test_columns_that_hardly_move_a_reading_are_nothing() -> None:
    """`s/s0 exp(1 - s/s0)` far behind a reversal is rounding: no direction may be made of it."""
    readings = read([laser([], 24)], 20.0)
    (effect,) = (f.effect for f in effects("reversal_spike,component=EXX,axis=X,A=5,s0=5"))
    assert not live_columns(effect, {"s0": 0.005}, readings).any()
    assert live_columns(effect, {"s0": 5.0}, readings).any()


def test_a_handful_of_readings_is_refused() -> None:
    """Six readings fit anything."""
    m = laser([], 25)
    with pytest.raises(MeasurementError, match="too few readings: 6"):
        diagnose(model(), [first(m, 6)])


def test_few_clean_readings_name_nothing() -> None:
    """Nothing is hidden, there is drift: of 32 short records at most 2 may get a name or a shape, as 5 % of chance has
    it. Likelihoods alone gave 4.
    """
    said = []
    for seed in range(30, 34):
        m = laser(SIMPLE, seed, noise=DRIFTING)
        starts = (0, 60, 130, 200)
        said += [diagnose(model(*SIMPLE), [first(m, n, start)]).verdict for start in starts for n in (10, 12)]
    assert len(said) == 32
    assert sum(v != "nothing_missing" for v in said) <= 2, said


def test_what_explains_another_part_is_no_rival() -> None:
    """Both are hidden, and each makes its own part of the readings: neither the sentence nor the history may say that
    one could stand for the other.
    """
    m = laser([SCREW, WEAR], 26)
    d = diagnose(model(), [m], explain=True)
    other = {"cyclic_screw": "backlash_position", "backlash_position": "cyclic_screw"}[d.findings[0].effect.effect]
    assert {m.fitted.effect.effect for m in d.together} == {"cyclic_screw", "backlash_position"}
    assert not any(other in r for m in d.together for r in m.rivals)
    assert other in d.sentence
    assert other not in {r.label.split("(")[0] for r in rivals_of(d, d.findings[0])}
    done = improve(model(), [m])
    assert {f.effect.effect for f in done.model.effects} == {"cyclic_screw", "backlash_position"}
    for entry in done.model.history:
        (added,) = (str(e).split("(")[0] for e in entry["effects"])
        passed = [str(r["effect"]) for r in entry.get("passed_over", ())]
        assert not [p for p in passed if p.startswith({"cyclic_screw", "backlash_position"}.difference({added}).pop())]
        assert len(passed) == len({*passed, *entry["effects"]}) - 1


def test_what_could_not_be_checked_has_one_row_an_effect() -> None:
    """Oracle: counted. A size from which on it would be seen is not "whatever its size"."""
    m = laser([SCREW], 27)
    cold = {n: 20.0 + 0.1 * (v - v.mean()) if n.startswith("T_") else v for n, v in m.channels.items()}
    d = diagnose(model(), [replace(m, channels=cold)])
    faint = [n for n in d.not_testable if n.smallest is not None]
    assert len({n.effect for n in faint}) < len(faint)
    (section,) = [
        s for s in diagnosis_page(d, figures=False).sections if s.heading == "Not testable with these readings"
    ]
    assert section.table is not None
    told = [row[0].split("(")[0] for row in section.table.rows if "at its usual size" in row[1]]
    assert sorted(told) == sorted({n.effect for n in faint})
    assert "whatever their size" not in " ".join(section.text)


def test_a_number_that_the_model_could_take_over_has_no_error() -> None:
    """The model has the same play already: what is constant in the wear and what is in the model are one to the
    readings, and a half of it with a small error would be a claim about nothing."""
    m = laser([WEAR], 26)
    d = diagnose(model("backlash,component=EXX,axis=X,B=2.8"), [m])
    found = d.findings[0]
    assert found.effect.effect == "backlash_position"
    assert found.parameters["b0"].se is None
    slope = found.parameters["b1"]
    assert slope.se is not None
    assert abs(slope.value - 1.1) < FAR * slope.se
    (table,) = [s.table for s in diagnosis_page(d, figures=False).sections if s.heading.startswith("Candidates")]
    assert table is not None
    assert "b0 –" in table.rows[0][2]


def test_how_far_a_number_is_decided() -> None:
    """Oracle: by hand: two equal columns share one number, a third is its own, a column of zeros shows nothing."""
    rng = np.random.default_rng(3)
    a, b = rng.standard_normal((2, 50))
    np.testing.assert_allclose(resolved(np.stack([a, a, b, 0.0 * b], axis=1)), [0.5, 0.5, 1.0, 0.0], atol=1e-9)


def test_a_short_wave_is_drawn_within_one_period() -> None:
    """Oracle: the amplitude that was put in; means over stretches longer than a wave would flatten its line."""
    d = diagnose(model(), [laser([SCREW], 29)])
    assert d.picture is not None
    period = d.picture.period_mm
    assert period is not None
    assert period == pytest.approx(5.021, rel=1e-3)
    shown = evidence(d.picture)
    (wave,) = shown.curves
    assert 0.0 <= wave.place[0] < wave.place[-1] < period
    assert "one period of 5.02" in shown.below
    assert float(np.ptp(wave.part)) == pytest.approx(2.0 * np.hypot(1.6, 0.9), rel=0.1)


def test_an_empty_list_of_effects_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Else nothing would be looked for, and whatever is there would have no name."""
    write_machine(tmp_path)
    table = write_laser(tmp_path, [SCREW], 28)
    path = tmp_path / "model.toml"
    words = ["fit", str(tmp_path / "machine.toml"), str(table), "--effects", "scale", "-o", str(path)]
    assert status(words) == 0
    capsys.readouterr()
    assert status(["diagnose", str(path), str(table), "--only", " , "]) == 2
    assert re.search("name at least one effect", capsys.readouterr().err)
