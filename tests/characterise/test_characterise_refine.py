"""Time constants between those of the candidates. Oracle: a scan of least squares with a filter written in numpy."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtec.characterise import characterise
from rtec.characterise.candidates import TermCandidate, drive
from rtec.characterise.refine import refined
from rtec.characterise.run import _against_each_other
from rtec.characterise.screen import screen
from rtec.estimation.gram.projection import polish
from rtec.estimation.gram.source import Source
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support import proof
from tests.support.diagnosis_examples import TABLE, laser

TRUTH = ("scale,component=EXX,axis=X,k=8", "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,tau=420,k=90")
NEAR_S = 12.0


@cache
def given() -> Measurement:
    return laser(TRUTH, 3)


@cache
def sources() -> list[Source]:
    return [Source.of(given())]


@cache
def candidates() -> list[TermCandidate]:
    return list(screen(sources()).candidates)


def called(label: str) -> TermCandidate:
    return next(c for c in candidates() if c.label == label)


@pytest.fixture(scope="module")
def best_s() -> float:
    """The time constant that leaves least, the temperature between two readings on a straight line."""
    t, warm, x = given().time_s, given().channels["T_bed"], given().channels["x"]
    y, taus, left = given().readings["reading_um"], np.arange(200.0, 520.0, 10.0), []
    for tau in taus:
        behind = np.zeros(len(t))
        for i in range(1, len(t)):
            dt = t[i] - t[i - 1]
            rate, decay = (warm[i] - warm[i - 1]) / dt, np.exp(-dt / tau)
            behind[i] = rate * tau * (1.0 - decay) + decay * behind[i - 1]
        columns = np.stack([np.ones(len(t)), x, x * (warm - behind - 20.0)], axis=1)
        left.append(np.sum((y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]) ** 2))
    return float(taus[int(np.argmin(left))])


def test_the_right_sensor_is_found_though_another_was_chosen(best_s: float) -> None:
    """No candidate has the right delay of the bed; the choice has the air instead."""
    for chosen in ("axis_expansion(EXX) of T_bed lagged 150 s", "axis_expansion(EXX) of T_air lagged 300 s"):
        results = refined(sources(), [called("scale(EXX)"), called(chosen)], candidates())
        found = {c.channels: c.term.theta["tau"] for c in results}
        assert found["T_bed",] == pytest.approx(best_s, abs=NEAR_S)


def test_a_sensor_that_explains_far_less_is_no_result() -> None:
    results = refined(
        sources(), [called("scale(EXX)"), called("axis_expansion(EXX) of T_bed lagged 150 s")], candidates()
    )
    assert [c.channels for c in results] == [("T_bed",)]


def test_a_delay_that_cannot_move_holds_no_other_up(best_s: float) -> None:
    """A delay far beyond the record, which improves nothing, beside the expansion."""
    far = called("axis_expansion(EXX) of T_air lagged 9600 s")
    terms = [called("scale(EXX)").term, called("axis_expansion(EXX) of T_bed lagged 150 s").term, far.term]
    found = polish(sources(), terms, only=[1])
    assert found.terms[2].theta == far.term.theta
    assert found.terms[1].theta["tau"] == pytest.approx(best_s, abs=2.0 * NEAR_S)


def two_nuts(seed: int, runs: int = 10) -> Measurement:
    """A laser along X while both nuts warm alike; the screw, 300 s behind its nut, follows `T_x_nut`."""
    rng, n = np.random.default_rng(seed), 30 * runs
    at = np.linspace(8.0, 192.0, 15)
    x, ways = np.tile(np.concatenate([at, at[::-1]]), runs), np.tile(np.repeat([1.0, -1.0], 15), runs)
    t = np.linspace(0.0, 4.0 * 3600.0, n)
    load = np.convolve(np.repeat(rng.uniform(0.0, 1.0, runs), 30), np.ones(40) / 40.0, "same")

    def behind(source: np.ndarray, tau: float) -> np.ndarray:
        out = np.zeros(n)
        for i in range(1, n):
            out[i] = out[i - 1] + (t[i] - t[i - 1]) / tau * (source[i] - out[i - 1])
        return out

    heat = behind(6.0 * load, 2400.0)
    screw, other = behind(heat, 300.0), 0.93 * behind(heat, 250.0) + 0.05 * np.sin(t / 3600.0)
    nut, far, air = (
        np.round(20.3 + v + 0.03 * rng.standard_normal(n), 1) for v in (heat, other, 0.3 * np.sin(t / 7200.0) - 0.3)
    )
    reading = x * (11.5 * (screw + 0.3) + 7.0) * 1e-3 + 0.25 * rng.standard_normal(n)
    machine = machine_from({**TABLE, "temperature": {"T_x_nut": {}, "T_z_nut": {}, "T_air": {}}}, "two nuts")
    made = make_instrument("laser_linear", {}, "X", None, machine, "test")
    channels = {"x": x, "d_x": ways, "T_x_nut": nut, "T_z_nut": far, "T_air": air}
    return Measurement("d", made, machine, np.repeat(np.arange(1, runs + 1), 30), t, channels, {"reading_um": reading})


@pytest.mark.parametrize("seed", proof.few([0, 3], 1))
def test_the_nut_of_the_axis_goes_before_one_that_warms_alike(seed: int) -> None:
    """Oracle: the sensor and the delay that the screw was made to follow."""
    found = characterise([two_nuts(seed)])
    (growth,) = (f for f in found.model.effects if f.effect.effect == "axis_expansion")
    assert growth.label == "axis_expansion(EXX, X, T_x_nut)"
    assert growth.theta["tau"] == pytest.approx(300.0, abs=80.0)


def test_whose_sensor_a_name_says() -> None:
    machine = two_nuts(0).machine
    assert [machine.of_another_axis(s, "X") for s in ("T_x_nut", "T_z_nut", "T_air", "T_xz")] == [
        False,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("numbers", "alone"), [((72.7, -81.8), True), ((72.7, 81.8), False), ((11.0, -81.8), False), ((11.0, -9.0), False)]
)
def test_expansions_beyond_any_material_that_cancel_are_never_chosen_together(
    numbers: tuple[float, float], alone: bool
) -> None:
    """Oracle: steel grows 12 µm/(m·K) and aluminium 23; one term of each sensor, with the numbers that are given."""
    terms = [called("scale(EXX)").term, *(called(f"axis_expansion(EXX) of {t}").term for t in ("T_bed", "T_air"))]
    fit: Any = SimpleNamespace(
        terms=terms, values=np.array([5.0, *numbers]), linear=SimpleNamespace(owner=np.array([0, 1, 2]))
    )
    drives = [frozenset(drive(t.effect) for t in terms[1:])]
    assert _against_each_other(fit, 0, lambda _: False) == (drives if alone else [])
    assert not _against_each_other(fit, 0, lambda _: True)
