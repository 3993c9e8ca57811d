"""Where a model is worst; oracle: where errors were put into simulated readings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.compare.bins import cut_into, round_edges, words_of
from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.compare.locate import scan
from rtec.diagnosis.compare.result import Region
from rtec.metrology.measurement import Measurement
from tests.diagnosis.test_compare import SCALE, drift, model
from tests.support import proof
from tests.support.diagnosis_examples import laser, small_machine

Floats = NDArray[np.floating[Any]]
DRIFT = {"white_um": 0.3, "drift_um": 0.3, "drift_tau_s": 1800.0}


def worst(m: Measurement, error: Callable[[Measurement], Floats] | None = None) -> tuple[Region, ...]:
    """Worst regions after an error was put into the readings."""
    if error is not None:
        added = np.asarray(error(m), dtype=np.float64)
        m = replace(m, readings={k: v + added for k, v in m.readings.items()})
    return compare(model(SCALE), [m]).items[0].worst


@pytest.mark.parametrize("seed", proof.few([21, 22, 23], 1))
def test_play_at_one_end_of_the_axis(seed: int) -> None:
    """Oracle: ±2 µm beyond 150 mm, both ways: rms there √(2² + noise²), and nothing of the direction."""
    (region,) = worst(laser([SCALE], seed, noise=DRIFT), lambda m: 2.0 * (m.channels["x"] > 150.0) * m.channels["d_x"])
    (bound,) = region.bounds
    assert bound.channel == "x"
    assert bound.low == pytest.approx(150.0, abs=10.0)
    assert bound.high >= 190.0
    assert region.words == f"X {bound.low:g}-{bound.high:g} mm"
    assert region.rms == pytest.approx(2.04, rel=0.1)
    assert region.elsewhere < 0.6


@pytest.mark.parametrize("seed", proof.few([21, 22, 23], 1))
def test_error_at_one_end_moving_one_way_is_a_pair(seed: int) -> None:
    """Oracle: 2.5 µm beyond 150 mm when moving down only; the mean has its sign."""
    region = worst(
        laser([SCALE], seed, noise=DRIFT), lambda m: 2.5 * ((m.channels["x"] > 150.0) & (m.channels["d_x"] < 0))
    )[0]
    assert {b.channel for b in region.bounds} == {"x", "d_x"}
    assert "X " in region.words
    assert region.words.endswith("moving −")
    assert region.mean > 1.5
    assert region.rms > 3.0 * region.elsewhere


@pytest.mark.parametrize("seed", proof.few([21, 22], 1))
def test_growth_at_high_temperature(seed: int) -> None:
    """Oracle: 4 µm/K in the last 2 K of a drift test with three warm-ups of falling height."""
    m = drift(seed, **DRIFT)
    top = float(m.channels["T_bed"].max())
    region = worst(m, lambda m: 4.0 * np.clip(m.channels["T_bed"] - top + 2.0, 0.0, None))[0]
    named = f"{region.words} {' '.join(region.same)}"
    assert "T_bed" in named
    assert region.mean > 2.0
    bound = next(b for b in region.bounds if b.channel == "T_bed")
    assert bound.high >= top
    assert bound.low > top - 3.0


FORMS = {
    "drift": {"white_um": 0.3, "drift_um": 0.5, "drift_tau_s": 900.0},
    "long": {"white_um": 0.2, "drift_um": 1.0, "drift_tau_s": 7200.0},
    "offset": {"white_um": 0.3, "run_offset_um": 0.5},
}


@pytest.mark.parametrize("form", proof.few(list(FORMS), 1))
def test_clean_readings_claim_nothing(form: str) -> None:
    """Oracle: readings with nothing but noise; of each form one seed in twenty may give a claim at the most."""
    seeds = range(300, 300 + proof.of(40, 20))
    claims = [seed for seed in seeds if worst(laser([SCALE], seed, noise=FORMS[form]))]
    assert len(claims) <= len(seeds) / 20, claims


def test_same_seed_same_answer() -> None:
    """Oracle: the same call again."""
    m = laser([SCALE, "backlash,component=EXX,axis=X,B=3"], 30, noise=DRIFT)
    assert compare(model(SCALE), [m], seed=4).facts() == compare(model(SCALE), [m], seed=4).facts()


@pytest.mark.parametrize(
    ("low", "high", "most", "step"), [(8.0, 392.0, 20, 20.0), (18.3, 25.2, 8, 1.0), (-1990.0, 1990.0, 20, 200.0)]
)
def test_edges_are_round_and_hold_everything(low: float, high: float, most: int, step: float) -> None:
    """Oracle: multiples of a step that people say."""
    edges = round_edges(low, high, most)
    assert edges[0] <= low
    assert edges[-1] >= high
    assert len(edges) - 1 <= most
    np.testing.assert_allclose(np.diff(edges), step)
    np.testing.assert_allclose(edges / step, np.round(edges / step))


def test_words_are_plain() -> None:
    """Oracle: as one would say it."""
    machine, values = small_machine(), np.linspace(0.0, 36000.0, 500)
    time, speed = cut_into("time_s", values, 20), cut_into("spindle_rpm", np.repeat([0.0, 1000.0, 3000.0], 9), 20)
    runs = cut_into("run", np.repeat(np.arange(1.0, 41.0), 5), 20)
    assert time is not None
    assert speed is not None
    assert runs is not None
    assert words_of([time.bound(2, 5)], machine, 1, 36000.0) == "1-3 h after the first reading"
    assert words_of([speed.bound(1, 2)], machine, 1, 1.0) == "spindle 1000-3000 rpm"
    assert words_of([speed.bound(2, 2)], machine, 1, 1.0) == "spindle 3000 rpm"
    assert words_of([runs.bound(0, 0)], machine, 1, 1.0).startswith("run")
    assert int(runs.high[-1]) == 40
    down = cut_into("d_x", np.repeat([-1.0, 1.0], 9), 20)
    assert down is not None
    assert words_of([down.bound(0, 0)], machine, 2, 1.0) == "X moving −"


def test_quiet_stretch_is_not_the_worst() -> None:
    """Oracle: by hand: the middle third is quieter, so that the best region holds none of it."""
    place = np.linspace(0.0, 300.0, 900)
    quiet = (place > 100.0) & (place < 200.0)
    rng = np.random.default_rng(5)
    squares = rng.standard_normal((900, 41)) ** 2
    squares[:, 0] *= np.where(quiet, 0.1, 4.0)
    cut = cut_into("x", place, 20)
    assert cut is not None
    best = scan([cut], [], squares, np.ones(900, dtype=bool)).single
    assert best is not None
    assert not (best.inside & quiet).sum() > 0.1 * best.inside.sum()
