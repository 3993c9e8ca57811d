"""Several causes on a plate of points above a table that X carries. Oracle: the formulas, written down by hand."""

import numpy as np
import pytest

from rtec.machine import Machine, load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from rtec.model import Model
from tests.support import proof
from tests.support.both import both

MACHINE = """
[machine]
name = "mill"
tool_chain = ["Z", "tool"]
work_chain = ["Y", "X", "table"]
[axis.X]
direction = "X"
travel_mm = [0, 600]
counts_per_mm = 1000.0
[axis.Y]
direction = "Y"
travel_mm = [0, 450]
counts_per_mm = 1000.0
[axis.Z]
direction = "Z"
travel_mm = [0, 400]
counts_per_mm = 1000.0
[link.tool]
offset_mm = [0.0, 0.0, -110.0]
[link.table]
offset_mm = [0.0, 0.0, 0.0]
"""
NOISE_UM = 0.3


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    file = tmp_path_factory.mktemp("mill") / "mill.toml"
    file.write_text(MACHINE, encoding="utf-8")
    return load_machine(file)


def plate(machine: Machine, seed: int) -> Measurement:
    """35 points at two heights by turns, six times: EXX 18 µm/m, yaw 100 µrad/m about the middle of X, EYX bent by
    3 µm, X and Y out of square by 28 µrad.

    The yaw turns the table with the point under the tool, at (x, y) on it.
    """
    rng = np.random.default_rng(seed)
    xs, ys = [25.0, 118.0, 214.0, 311.0, 402.0, 497.0, 580.0], [22.0, 127.0, 229.0, 331.0, 428.0]
    once = np.array([(x, y) for k, y in enumerate(ys) for x in (xs if k % 2 == 0 else xs[::-1])])
    x, y = np.tile(once, (6, 1)).T
    run = np.repeat(np.arange(6) + 1, len(once))
    u = (x - 300.0) / 300.0
    yaw_urad = 30.0 * u
    error = {
        "x": 0.018 * x + 1e-3 * yaw_urad * y,
        "y": 1.5 * (3.0 * u**2 - 1.0) + 0.028 * x - 1e-3 * yaw_urad * x,
        "z": 0.0 * x,
    }
    return Measurement(
        name="plate",
        instrument=make_instrument("tool_tip", {}, None, None, machine, "test"),
        machine=machine,
        run=run,
        time_s=np.cumsum(7.0 + rng.exponential(2.0, len(x))) + 600.0 * run,
        channels={"x": x, "y": y, "z": np.where(run % 2 == 0, 60.0, 260.0)},
        readings={f"reading_{a}_um": v + rng.normal(0.0, NOISE_UM, len(x)) for a, v in error.items()},
    )


@pytest.mark.parametrize("seed", proof.few(range(4), 1))
def test_four_causes_have_names_and_nothing_stays_without(machine: Machine, seed: int) -> None:
    """Each is one of the catalogue; a yaw called a surface over X and Y knows nothing of the arm of another tool."""
    model, m = Model(machine, (), name="bare"), plate(machine, seed)
    found, better = both(model, [m])
    assert found.unknown is None, found.sentence
    names = {f.label.split(",")[0] for f in found.together}
    assert {"scale(EXX", "squareness(EC0X)", "straightness(EYX"} <= names, found.sentence
    assert names & {"angular_motion(ECX", "guide_curvature(ECX"}, found.sentence
    assert not [f.label for f in better.model.effects if f.label.startswith("expression")]
    assert better.steps[-1].after.held_out < 1.4 * NOISE_UM
