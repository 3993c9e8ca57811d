"""A laser with a cosine error, and a plate that was warm, beside measurements that are right.

Oracle: the truth of each file; the scale of the wrong ones differs from the machine's by a known number.
"""

from typing import Any

import pytest

from rtec.characterise import characterise
from rtec.diagnosis.compare.compare import compare
from rtec.metrology.measurement import Measurement
from tests.sim.test_campaign import XY, taken

pytestmark = pytest.mark.xdist_group("odd-scale")

COLD: dict[str, Any] = {"protocol": "cold", "cycles": 2}


def true(x: float, y: float) -> tuple[str, ...]:
    """The machine with these scales of X and Y, µm/m."""
    return (
        f"scale,component=EXX,axis=X,k={x}", f"scale,component=EYY,axis=Y,k={y}", "squareness,component=EC0X,alpha=25",
        "backlash,component=EXX,axis=X,B=3", "straightness,component=EYX,axis=X,c2=3,c3=-1",
    )  # fmt: skip


def files(cosine: float = 0.0, plate: float = 0.0) -> list[Measurement]:
    """Two lasers, the one along Y with a cosine error, and three places of a plate, with a scale of its own, µm/m."""
    out = [taken("laser_linear", "laser-x", 1, axis="X", effects=true(14.0, -9.0), **COLD)]
    out.append(taken("laser_linear", "laser-y", 2, axis="Y", effects=true(14.0, -9.0 + cosine), **COLD))
    warm = true(14.0 + plate, -9.0 + plate)
    setup = {"plane": "XY"}
    return out + [
        taken("grid_encoder", f"plate-{i}", 30 + i, {**setup, "origin_mm": o}, effects=warm, cycles=1,
              path={"step_mm": 24.0}) for i, o in enumerate(XY)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("made", "said"),
    [
        ({}, None),
        ({"cosine": -12.5}, "laser-y contradicts the other measurements: it reads 12.5 µm/m less"),
        ({"plate": 24.0}, "plate-0, plate-1 and plate-2 contradict the other measurements: they read 24 µm/m more"),
    ],
    ids=["all right", "cosine", "warm plate"],
)
def test_an_odd_scale_is_told_and_left_out(made: dict[str, float], said: str | None) -> None:
    found = characterise(files(**made))
    told = [w for w in found.warnings if "contradict" in w.text]
    scales = {c.component: c.value for c in found.coefficients if c.effect.startswith("scale")}
    assert scales["EXX"] == pytest.approx(14.0, abs=1.0)
    assert scales["EYY"] == pytest.approx(-9.0, abs=1.0)
    if said is None:
        assert told == []
        return
    (warning,) = told
    assert warning is found.warnings[0]
    assert warning.text.startswith(said.partition("12.5")[0].partition("24")[0])
    number = float(warning.text.partition(" µm/m")[0].rpartition(" ")[2])
    assert number == pytest.approx(abs(made.get("cosine", made.get("plate", 0.0))), abs=1.0)
    assert "slope" in warning.remedy
    (doubt,) = [d for d in compare(found.model, files(**made)).doubts if d.fatal]
    assert doubt.message.startswith(said.partition("12.5")[0].partition("24")[0])  # rtec diagnose says the same


def test_where_two_lasers_differ_it_is_open_which_is_wrong() -> None:
    """Of two lasers along Y neither is believed more; the warning tells by how much they differ."""
    one = taken("laser_linear", "laser-1", 1, axis="Y", effects=true(14.0, -9.0), **COLD)
    two = taken("laser_linear", "laser-2", 2, axis="Y", effects=true(14.0, -21.5), targets={"step_mm": 17.3}, **COLD)
    warning = characterise([one, two]).warnings[0]
    assert warning.code == "contradiction"
    assert "the fit goes by the others" not in warning.text
