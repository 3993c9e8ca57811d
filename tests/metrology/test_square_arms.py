"""Directions on the arms of a square. Oracle: the arms as they are run here, by hand; a squareness worked out here."""

from pathlib import Path

import numpy as np
import pytest

from rtec.characterise import characterise
from rtec.machine import machine_from
from rtec.metrology.files.load import load_measurement
from rtec.metrology.measurement import Measurement
from tests.support.machines import axis

MACHINE = machine_from(
    {
        "machine": {"name": "square", "tool_chain": ["X", "tool"], "work_chain": ["Y", "table"]},
        "axis": {"X": axis("X", travel_mm=[0.0, 500.0]), "Y": axis("Y", travel_mm=[0.0, 400.0])},
        "temperature": {"T_bed": {}},
    },
    "square",
)
TOML = '[measurement]\ninstrument = "squareness"\naxis = "Y"\nmachine = "square"\n[setup]\nreference_axis = "X"\n'
Row = tuple[int, float, float, str, str]


def measured(folder: Path, rows: list[Row], more: str = "", cell: str = "") -> Measurement:
    table = folder / "square.csv"
    lines = [f"{run},{10 * i},{x:g},{y:g},{a},{b}{cell}" for i, (run, x, y, a, b) in enumerate(rows)]
    table.write_text("\n".join([f"run,time_s,x_mm,y_mm,reading_x_um,reading_y_um{more}", *lines, ""]))
    table.with_suffix(".toml").write_text(TOML)
    return load_measurement(table, MACHINE)


def arms(run: int, along_x: list[float], along_y: list[float]) -> list[Row]:
    """One arm along X at Y = 200, then one along Y at X = 250."""
    return [*((run, x, 200.0, "", "1.5") for x in along_x), *((run, 250.0, y, "2.5", "") for y in along_y)]


@pytest.mark.parametrize(
    ("along_x", "along_y", "d_x", "d_y"),
    [
        ([60.0, 200.0, 440.0], [50.0, 100.0, 350.0], [1] * 6, [1] * 6),
        ([440.0, 200.0, 60.0], [50.0, 100.0, 350.0], [-1] * 6, [1] * 6),
        ([60.0, 440.0, 60.0], [350.0, 100.0], [1, 1, -1, -1, -1], [-1] * 5),
    ],
)
def test_a_jump_between_the_arms_is_no_direction(
    tmp_path: Path, along_x: list[float], along_y: list[float], d_x: list[int], d_y: list[int]
) -> None:
    m = measured(tmp_path, arms(1, along_x, along_y) + arms(2, along_x, along_y))
    assert m.channels["d_x"].tolist() == d_x * 2
    assert m.channels["d_y"].tolist() == d_y * 2
    assert "no column dir_x: taken from its own arm of the square" in m.notes


def test_runs_of_one_arm_that_all_go_one_way(tmp_path: Path) -> None:
    rows = [row for run in (1, 2) for row in arms(run, [60.0, 200.0, 440.0], [])] + arms(3, [], [350.0, 50.0])
    m = measured(tmp_path, rows)
    assert m.channels["d_x"].tolist() == [1] * 8
    assert m.channels["d_y"].tolist() == [-1] * 8


def test_directions_that_are_given_and_arms_that_do_not_show(tmp_path: Path) -> None:
    one = arms(1, [60.0, 440.0], [50.0, 350.0])
    assert measured(tmp_path, one, ",dir_x,dir_y", ",-1,-1").channels["d_x"].tolist() == [-1] * 4
    both = [(run, x, y, "1.0", "2.0") for run, x, y, _, _ in one]
    assert not {"d_x", "d_y"} & measured(tmp_path, both).channels.keys()


@pytest.mark.parametrize("seed", [0, 1, 5, 19])
def test_a_squareness_is_fitted_as_a_squareness(tmp_path: Path, seed: int) -> None:
    """Four runs of nine targets an arm; half a micrometre of noise, a little bow, and a square that lies askew.

    With directions from the jumps, seeds 5 and 19 had become an angle that turns back with Y.
    """
    rng = np.random.default_rng(seed)
    true_urad, askew_urad = 12.0, rng.normal(0.0, 20.0)
    rows: list[Row] = []
    for run in range(1, 5):
        for x in np.linspace(60.0, 440.0, 9):
            reading = 1e-3 * askew_urad * (x - 250.0) + 1.3 * np.sin(np.pi * x / 500.0) + rng.normal(0.0, 0.5)
            rows.append((run, x, 200.0, "", f"{reading:.1f}"))
        for y in np.linspace(50.0, 350.0, 9):
            reading = 1e-3 * (true_urad - askew_urad) * (y - 200.0) + 0.8 * np.sin(np.pi * y / 400.0)
            rows.append((run, 250.0, y, f"{reading + rng.normal(0.0, 0.5):.1f}", ""))
    made = characterise([measured(tmp_path, rows)]).model
    (square,) = [f for f in made.effects if f.effect.effect == "squareness"]
    assert {f.effect.effect for f in made.effects} <= {"squareness", "polynomial_position", "straightness"}
    assert abs(square.values["alpha"]) == pytest.approx(true_urad, abs=4.0)
