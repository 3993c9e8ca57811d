"""A delay of the model that is another one today: more coolant flows, say. No effect is missing then.

Oracle: bodies that lag by another time, integrated in steps of a second.
"""

import pytest

from rtec.diagnosis.compare.compare import compare
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.given import given_to
from rtec.metrology.measurement import Measurement
from tests.diagnosis import test_warm_start as warm
from tests.support.both import both

pytestmark = pytest.mark.xdist_group("warm-start")

X, Z = 0, 1


def days(monkeypatch: pytest.MonkeyPatch, tau_z_s: float, tau_x_s: float) -> list[Measurement]:
    """Two days with these delays, of a machine whose model has 30 and 60 minutes."""
    monkeypatch.setattr(warm, "TAU_Z_S", tau_z_s)
    monkeypatch.setattr(warm, "TAU_X_S", tau_x_s)
    return [warm.day(5), warm.day(6)]


@pytest.mark.parametrize(
    ("tau_z_s", "tau_x_s", "changed"),
    [(1800, 1500, [X]), (1800, 7200, [X]), (750, 3600, [Z]), (3600, 3600, [Z]), (900, 1800, [X, Z])],
)
def test_another_delay_is_refitted_and_no_effect_is_named(
    monkeypatch: pytest.MonkeyPatch, tau_z_s: float, tau_x_s: float, changed: list[int]
) -> None:
    """As it was, a tilt of the spindle or an expansion of the mount "is missing", and `improve` added it."""
    model, today = warm.known(), days(monkeypatch, tau_z_s, tau_x_s)
    found = given_to(model, today).delays
    assert sorted(found) == changed
    assert found == pytest.approx({i: (tau_x_s, tau_z_s)[i] for i in changed}, rel=0.05)
    answer, better = both(model, today, changes=True, ask=None, draws=50)
    assert answer.verdict == "nothing_missing"
    assert [c.name for c in answer.changed] == ["tau"] * len(changed)
    assert [f.effect for f in better.model.effects] == [f.effect for f in model.effects]
    assert [f.theta["tau"] for f in better.model.effects] == pytest.approx([tau_x_s, tau_z_s], rel=0.05)
    assert compare(better.model, today).judged.residual == pytest.approx(warm.NOISE_UM, rel=0.1)


def test_compare_says_which_delay_is_another_one(monkeypatch: pytest.MonkeyPatch) -> None:
    found = compare(warm.known(), days(monkeypatch, 750, 3600))
    (said,) = [d for d in found.doubts if d.kind == "changed_delay"]
    assert said.message.startswith("spindle_growth(EZ0spindle, T_spindle) lags by 12 min here, and by 30 min in the")
    assert not [d for d in found.doubts if d.kind == "other_machine"]


def test_a_delay_that_did_not_change_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    assert given_to(warm.known(), days(monkeypatch, 1800, 3600)).delays == {}


@pytest.mark.parametrize("um_per_degc", [0.3, -0.8])
def test_a_missing_effect_of_another_sensor_is_no_changed_delay(um_per_degc: float) -> None:
    today = [warm.day(s, column_um_per_degc=um_per_degc) for s in (5, 6)]
    assert given_to(warm.known(), today).delays == {}
    assert "T_bed" in diagnose(warm.known(), today, draws=50).sentence
