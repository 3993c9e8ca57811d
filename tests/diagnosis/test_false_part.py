"""A plain effect takes a part of nearly any shape; that makes it no cause. Oracle: what the readings are made of."""

import numpy as np
import pytest

from rtec.diagnosis.extend import improve as module
from rtec.diagnosis.extend.add import add
from rtec.diagnosis.search.diagnose import diagnose
from rtec.estimation.outliers import clean
from rtec.machine import machine_from
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from rtec.sim.campaign.truth import effect_from_text
from tests.support.both import both
from tests.support.machines import axis

NOISE_UM = 1.5
MACHINE = machine_from(
    {
        "machine": {"name": "boring mill", "tool_chain": ["Y", "ram"], "work_chain": ["X", "table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 3000.0]), "Y": axis("Y", travel_mm=[0.0, 2000.0])},
        "link": {"ram": {"offset_mm": [0.0, 0.0, -300.0]}, "table": {}},
        "temperature": {},
    },
    "boring mill",
)


def grid(seed: int, chain: float, yaw: float) -> Measurement:
    """Tool-tip readings of X over a grid of X and Y, in twelve runs.

    Args:
        seed: of the noise.
        chain: µm at the ends of X, with the sign of the last motion of Y: a cable chain pulls.
        yaw: µrad of X at its ends, quadratic; seen through the place of Y.
    """
    rng = np.random.default_rng(seed)
    rows = np.array([200.0, 900.0, 1700.0, 1200.0, 400.0])
    x = np.tile(np.tile(np.linspace(100.0, 2900.0, 8), 5), 12)
    y = np.tile(np.repeat(rows, 8), 12)
    ways = {"x": np.sign(np.diff(x, prepend=0.0)), "y": np.tile(np.repeat([-1.0, 1.0, 1.0, -1.0, -1.0], 8), 12)}
    run = np.repeat(np.arange(1, 13), 40)
    u = x / 1500.0 - 1.0
    true = 0.02 * x + chain * ways["y"] * u - 1e-3 * y * yaw * u**2
    instrument = make_instrument("tool_tip", {"directions": ["X"]}, None, None, MACHINE, "grid")
    return Measurement(
        name="grid", machine=MACHINE, instrument=instrument, run=run, time_s=25.0 * np.arange(len(x)) + 600.0 * run,
        channels={"x": x, "y": y, "d_x": ways["x"], "d_y": ways["y"]},
        readings={"reading_x_um": true + NOISE_UM * rng.normal(size=len(x))},
    )  # fmt: skip


def known() -> Model:
    return Model(MACHINE, (effect_from_text("scale,component=EXX,axis=X,k=20", MACHINE),), name="known")


def test_no_angle_is_named_for_what_the_direction_of_another_axis_does() -> None:
    """The rest beside an angle needs both variables still."""
    m = grid(1, chain=12.0, yaw=0.0)
    d, done = both(known(), [m], draws=50)
    assert d.verdict == "unknown_effect"
    assert d.unknown is not None
    assert set(d.unknown.channels) == {"x", "d_y"}
    assert not d.together
    assert [f.effect.effect for f in done.model.effects] == ["scale", "expression"], "its shape, and no angle"
    assert done.steps[0].after.held_out < 1.1 * NOISE_UM


def test_an_angle_that_is_there_is_named() -> None:
    d = diagnose(known(), [grid(1, chain=0.0, yaw=12.0)], draws=50)
    assert d.findings[0].accepted
    assert d.findings[0].effect.effect in ("angular_motion", "guide_curvature", "cross_talk")


@pytest.mark.parametrize(("shown", "allowed"), [(1.01, True), (1.1, False)])
def test_no_step_raises_what_is_shown(monkeypatch: pytest.MonkeyPatch, shown: float, allowed: bool) -> None:
    """Relative to what each instrument read a residual may fall while it rises in µm. Oracle: 2 %."""
    m = grid(2, chain=0.0, yaw=0.0)
    given = clean([m]).without_ends()
    growth = module._Growth([m], given, known(), (1, 0.05, 50), None, None)
    made = add(known(), [], [m], given=given)
    assert growth._no_worse(made)
    growth.best, growth.shown = 1.0, 1.0
    monkeypatch.setattr(growth, "_sizes", lambda _: (0.9, shown))
    assert growth._no_worse(made) is allowed
