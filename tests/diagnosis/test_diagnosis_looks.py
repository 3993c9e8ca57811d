"""Looks of the diagnosis: pairs that only help together, drift between runs, few readings for many, least noise."""

import numpy as np
import pytest
from numpy.typing import NDArray

from rtec.diagnosis.search.diagnose import diagnose
from rtec.diagnosis.search.run_drift import run_drifts
from rtec.diagnosis.search.screen import Bank, Projected, screen_all
from rtec.estimation.candidates import library
from rtec.estimation.noise import INEXACT, Noise, Whitener, find_noise, least_noise
from rtec.estimation.readings import LOOK, looked_at, read
from rtec.machine import Machine, machine_from
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.parallel import each
from tests.support.characterise_examples import Probe, ProbeSetup

Floats = NDArray[np.float64]


def machine() -> Machine:
    return machine_from(
        {
            "machine": {"name": "m", "tool_chain": ["Z"], "work_chain": ["spindle"]},
            "axis": {"Z": {"direction": "Z", "travel_mm": [0.0, 100.0], "counts_per_mm": 1000.0}},
            "link": {"spindle": {}},
            "temperature": {"T_bed": {}, "T_head": {}},
        },
        "test",
    )


def measured(reading: Floats, time_s: Floats, runs: int = 1, **channels: Floats) -> Measurement:
    size = len(reading) // runs
    return Measurement(
        name="m",
        instrument=Probe(ProbeSetup(zero="setup"), component="EZ0spindle"),
        machine=machine(),
        run=np.repeat(np.arange(1, runs + 1), size),
        time_s=time_s,
        channels=channels,
        readings={"reading_um": reading},
    )


def test_two_that_only_help_together() -> None:
    """Oracle: the numbers put in. At once +1.5 µm/K, late -2.4 µm/K with 1800 s, integrated by hand in 1 s steps.

    Half a heating cycle, so that neither alone predicts the stretches that are left out.
    """
    rng = np.random.default_rng(5)
    seconds = np.arange(3000.0)
    warm = 20.0 + 40.0 * (1.0 - np.exp(-np.maximum(seconds - 300.0, 0.0) / 30.0))
    warm = np.where(seconds >= 2300.0, 20.0 + 40.0 * np.exp(-(seconds - 2300.0) / 1500.0), warm)
    late = np.empty_like(warm)
    late[0] = warm[0]
    for i in range(1, len(warm)):
        late[i] = late[i - 1] + (warm[i] - late[i - 1]) / 1800.0
    at = np.arange(0, 3000, 4)
    reading = (1.5 * warm - 2.4 * late)[at] + 0.8 * rng.standard_normal(len(at))
    head = 21.0 + 0.5 * np.sin(seconds[at] / 700.0)
    m = measured(reading, seconds[at], T_bed=warm[at] + 0.02 * rng.standard_normal(len(at)), T_head=head)
    d = diagnose(Model(m.machine), [m])
    first = d.findings[0]
    assert first.accepted
    assert first.partner is not None
    both = {f.effect.effect: f for f in (first, first.partner)}
    assert set(both) == {"mount_expansion", "ambient_drift"}
    assert both["mount_expansion"].parameters["k"].value == pytest.approx(1.5, abs=0.3)
    assert both["ambient_drift"].parameters["k"].value == pytest.approx(-2.4, abs=0.8)
    assert "together" in d.sentence
    assert d.facts()["candidates"][0]["together_with"] == first.partner.label


@pytest.mark.parametrize("change", [0.0, 6.0])
def test_drift_from_run_to_run_is_told(change: float) -> None:
    """Oracle: the change put in; and where none is, nothing is said (the seed was not looked for)."""
    rng = np.random.default_rng(11)
    runs, size = 6, 40
    time = np.arange(0.0, 30.0 * runs * size, 30.0)
    reading = rng.standard_normal(runs * size) + change * np.repeat(np.arange(runs), size) / (runs - 1)
    r = read([measured(reading, time, runs, T_bed=20.0 + np.sin(time / 500.0))])
    told = run_drifts(r, r.values)
    if not change:
        assert told == ()
        return
    assert len(told) == 1
    assert "rises steadily" in told[0]
    assert float(told[0].split(" by ")[1].split(" ")[0]) == pytest.approx(change, abs=0.6)


def test_what_chance_does_is_told_by_the_readings_that_are_kept() -> None:
    """Oracle: the screen that keeps all. Evidence is that of all readings, and chance does about the same."""
    rng = np.random.default_rng(2)
    n = 1200
    time = np.arange(0.0, 60.0 * n, 60.0)
    warm = {f"T_{name}": 20.0 + np.cumsum(rng.standard_normal(n)) * 0.1 for name in ("bed", "head")}
    r = read([measured(0.5 * rng.standard_normal(n) + 0.2 * warm["T_bed"], time, 60, **warm)], smooth=False)
    candidates, _ = library(r)
    noise = Whitener(r, (Noise(0.5, 1e-4, 100.0, 0.0),), tuple(np.ones(s.nuisance.shape[1]) for s in r.series))
    projected = Projected.of(noise, np.ones((n, 1)), r.values)
    every, some = (
        screen_all(Bank(r, candidates, keep), projected) for keep in (np.ones(n, bool), np.arange(n) % 2 > 0)
    )
    np.testing.assert_allclose(some.log_evidence, every.log_evidence, rtol=1e-9)
    assert len(some.directions) == n // 2
    chance = [s.family_p(200, np.random.default_rng(3))[1] for s in (every, some)]
    assert np.median(chance[0]) == pytest.approx(np.median(chance[1]), abs=0.7)


@pytest.mark.parametrize("runs", [1, 400])
def test_very_many_readings_are_looked_at_in_part(runs: int) -> None:
    """Oracle: counting. Whole runs where there are many, single readings else; few readings are all taken."""
    n = 4 * LOOK
    time = np.arange(float(n))
    r = read([measured(np.zeros(n), time, runs, T_bed=20.0 + np.sin(time / 500.0))])
    keep = looked_at(r)
    assert keep.sum() == pytest.approx(LOOK, rel=0.05)
    if runs > 1:
        per_run = keep.reshape(runs, -1).mean(axis=1)
        assert set(np.unique(per_run)) == {0.0, 1.0}
    assert looked_at(r.without(~keep)).all()
    assert each(lambda i: 2 * i, range(5), n) == [0, 2, 4, 6, 8]


def test_one_reading_more_than_is_looked_at_is_no_fault() -> None:
    """As it was, `diagnose` ended with a `ValueError` on 2501 readings and a few more. Oracle: there is only noise."""
    time = 10.0 * np.arange(LOOK + 1.0)
    noise = np.random.default_rng(8).standard_normal(LOOK + 1)
    found = diagnose(Model(machine(), (), name="empty"), [measured(noise, time, T_bed=20.0 + np.sin(time / 5000.0))])
    assert found.verdict == "nothing_missing"


def test_no_law_is_truer_than_a_twentieth() -> None:
    """Oracle: the definition; drift and offset stay what they are in their own unit."""
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 36000.0, 60.0)
    reading = 10.0 * np.sin(time / 4000.0) + 1e-3 * rng.standard_normal(600)
    r = read([measured(reading, time, 1, T_bed=20.0 + np.sin(time / 500.0))])
    least = least_noise(r, r.values - r.values.mean())
    assert least[0] == pytest.approx(INEXACT * np.std(r.values))
    base = np.ones((600, 1))
    free, held = find_noise(r, base), find_noise(r, base, least=least)
    assert held.noises[0].sigma == least[0] > 5.0 * free.noises[0].sigma
    size = [n.sigma * np.sqrt(n.drift) for n in (free.noises[0], held.noises[0])]
    assert size[0] == pytest.approx(size[1])
    noisy = held.with_noises([Noise(7.0, 1.0, 100.0, 0.5)])
    assert noisy.noises[0] == Noise(7.0, 1.0, 100.0, 0.5)
