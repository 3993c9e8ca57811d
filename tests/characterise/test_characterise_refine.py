"""Time constants between those of the candidates. Oracle: a scan of least squares with a filter written in numpy."""

import numpy as np
import pytest

from rtec.characterise.candidates import TermCandidate
from rtec.characterise.refine import refined
from rtec.characterise.screen import screen
from rtec.estimation.gram.projection import polish
from rtec.estimation.gram.source import Source
from tests.support.diagnosis_examples import laser

TRUTH = ("scale,component=EXX,axis=X,k=8", "axis_expansion,component=EXX,axis=X,sensor=T_bed,lag=true,tau=420,k=90")
READ = laser(TRUTH, 3)
SOURCES = [Source.of(READ)]
CANDIDATES = screen(SOURCES).candidates
NEAR_S = 12.0


def called(label: str) -> TermCandidate:
    return next(c for c in CANDIDATES if c.label == label)


@pytest.fixture(scope="module")
def best_s() -> float:
    """The time constant that leaves least, the temperature between two readings on a straight line."""
    t, warm, x = READ.time_s, READ.channels["T_bed"], READ.channels["x"]
    y, taus, left = READ.readings["reading_um"], np.arange(200.0, 520.0, 10.0), []
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
        results = refined(SOURCES, [called("scale(EXX)"), called(chosen)], CANDIDATES)
        found = {c.channels: c.term.theta["tau"] for c in results}
        assert found["T_bed",] == pytest.approx(best_s, abs=NEAR_S)


def test_a_sensor_that_explains_far_less_is_no_result() -> None:
    results = refined(SOURCES, [called("scale(EXX)"), called("axis_expansion(EXX) of T_bed lagged 150 s")], CANDIDATES)
    assert [c.channels for c in results] == [("T_bed",)]


def test_a_delay_that_cannot_move_holds_no_other_up(best_s: float) -> None:
    """A delay far beyond the record, which improves nothing, beside the expansion."""
    far = called("axis_expansion(EXX) of T_air lagged 9600 s")
    terms = [called("scale(EXX)").term, called("axis_expansion(EXX) of T_bed lagged 150 s").term, far.term]
    found = polish(SOURCES, terms, only=[1])
    assert found.terms[2].theta == far.term.theta
    assert found.terms[1].theta["tau"] == pytest.approx(best_s, abs=2.0 * NEAR_S)
