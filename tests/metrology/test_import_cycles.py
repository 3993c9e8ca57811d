"""Protocols of ISO 230-2: one row a target, one column a run and direction.

Oracle: five runs there and back through the targets, made here and written as such a protocol; the same rows in the
order in which they were measured.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.importing import Imported, import_table, load_map, propose
from rtec.metrology.importing.cycles import run_and_direction
from rtec.metrology.importing.propose import save_map

MACHINE = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml")
X = np.array([7.0, 31.0, 58.0, 90.0, 121.0, 149.0, 188.0])
RUNS = 5
DEVIATION_UM = {
    (run, sign): np.round(0.02 * X + 2.0 * sign + 0.1 * run + 0.01 * np.cos(X), 3)
    for run in range(1, RUNS + 1)
    for sign in (1, -1)
}
WAYS = [(run, sign) for run in range(1, RUNS + 1) for sign in (1, -1)]
BLOCKS = [(run, sign) for sign in (1, -1) for run in range(1, RUNS + 1)]
ANSWERS = {"axis": "X", "instrument": "laser_linear"}


def protocol(folder: Path, header: list[str], columns: list[tuple[int, int]], of: Callable[..., np.ndarray]) -> Path:
    path = folder / "protocol.csv"
    values = [of(DEVIATION_UM[c]) for c in columns]
    rows = [";".join(f"{v:.6f}" for v in (x, *(c[i] for c in values))) for i, x in enumerate(X)]
    path.write_text("\n".join([*header, *rows]) + "\n", encoding="utf-8")
    return path


def imported(path: Path, **more: str) -> Imported:
    return import_table(path, propose(path, MACHINE, {}, ANSWERS | more).import_map())


def check(done: Imported, ways: list[tuple[int, int]], signs: list[int] | None = None) -> None:
    n = len(X)
    expected = np.concatenate([DEVIATION_UM[w][::s] for w, s in zip(ways, signs or [s for _, s in ways], strict=True)])
    np.testing.assert_allclose(done.columns["reading_um"], expected, atol=2e-3)
    np.testing.assert_array_equal(done.columns["dir_x"], np.repeat(signs or [s for _, s in ways], n))
    np.testing.assert_array_equal(done.columns["x_mm"], np.concatenate([X[::s] for s in signs or [s for _, s in ways]]))


@pytest.mark.parametrize(
    "name",
    [
        lambda run, sign: f"Run {run} {'+' if sign > 0 else '-'} [µm]",
        lambda run, sign: f"Run {run} {'+' if sign > 0 else '−'}",
        lambda run, sign: f"{run}{'↑' if sign > 0 else '↓'}",
        lambda run, sign: f"x{run}{'↑' if sign > 0 else '↓'} [um]",
        lambda run, sign: f"Lauf {run} {'vor' if sign > 0 else 'zurück'} [µm]",
        lambda run, sign: f"Run-{run} {'fwd' if sign > 0 else 'rev'}",
        lambda run, sign: f"{'Forward' if sign > 0 else 'Reverse'} {run} (um)",
        lambda run, sign: f"{'F' if sign > 0 else 'R'}{run}",
        lambda run, sign: f"Messung {run} (+)" if sign > 0 else f"Messung {run} (-)",
    ],
)
@pytest.mark.parametrize("columns", [WAYS, BLOCKS])
def test_a_column_a_run_and_direction(
    tmp_path: Path, name: Callable[[int, int], str], columns: list[tuple[int, int]]
) -> None:
    header = ["Target [mm];" + ";".join(name(*c) for c in columns)]
    done = imported(protocol(tmp_path, header, columns, np.asarray))
    check(done, WAYS)
    assert done.columns["run"].tolist() == [run for run, _ in WAYS for _ in X]


@pytest.mark.parametrize(
    ("groups", "names", "columns"),
    [
        (";Forward [um];;;;;Reverse [um];;;;", [str(r) for r, _ in BLOCKS], BLOCKS),
        (";Vorwärts;;;;;Rückwärts;;;;", [f"Lauf {r}" for r, _ in BLOCKS], BLOCKS),
        (";" + ";".join(f"Run {r};" for r in range(1, RUNS + 1)), ["+" if s > 0 else "-" for _, s in WAYS], WAYS),
    ],
)
def test_names_in_two_lines(tmp_path: Path, groups: str, names: list[str], columns: list[tuple[int, int]]) -> None:
    header = ["Positionierunsicherheit nach ISO 230-2", groups, ";".join(["Soll X [mm]", *names])]
    check(imported(protocol(tmp_path, header, columns, np.asarray)), WAYS)


ONE = [(1, 1), (1, -1)]


@pytest.mark.parametrize(
    "names",
    [
        ["Forward [um]", "Return [um]"],
        ["Abweichung hin [µm]", "Abweichung zurück [µm]"],
        ["deviation_fwd_um", "deviation_bwd_um"],
        ["↑ (um)", "↓ (um)"],
        ["error_um", "return_um"],
        ["laser_um", "laser_back_um"],
    ],
)
@pytest.mark.parametrize("order", [1, -1])
def test_one_run_there_and_back_without_a_number(tmp_path: Path, names: list[str], order: int) -> None:
    header = ["Target [mm];" + ";".join(names[::order])]
    check(imported(protocol(tmp_path, header, ONE[::order], np.asarray)), ONE)


def test_a_limit_above_and_below_is_no_way_there_and_back(tmp_path: Path) -> None:
    path = protocol(tmp_path, ["Target [mm];Error + [um];Error - [um]"], ONE, np.asarray)
    assert [q.key for q in propose(path, MACHINE, {}, ANSWERS).open] == ["reading"]


def test_where_targets_fall_forward_may_go_either_way(tmp_path: Path) -> None:
    """From the far end: the way there is negative if "forward" means the first way, positive if it means the sign."""
    header = ["Target [mm];Forward [um];Return [um]"]
    path = protocol(tmp_path, header, ONE[::-1], np.asarray)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[::-1]]))
    asked = propose(path, MACHINE, {}, ANSWERS).open
    assert [(q.key, q.choices) for q in asked] == [("forward", ("positive", "negative"))]
    check(imported(path, forward="negative"), ONE)
    path = protocol(tmp_path, header, ONE, np.asarray)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *rows[::-1]]))
    check(imported(path, forward="positive"), ONE)


def test_actual_positions_instead_of_deviations(tmp_path: Path) -> None:
    header = ["Target [mm];" + ";".join(f"Run {r} {'+' if s > 0 else '-'} [mm]" for r, s in WAYS)]
    check(imported(protocol(tmp_path, header, WAYS, lambda e: X + 1e-3 * e)), WAYS)


def test_runs_without_a_direction_are_asked(tmp_path: Path) -> None:
    header = ["Target [mm];" + ";".join(f"Run {i + 1} [um]" for i in range(2 * RUNS))]
    path = protocol(tmp_path, header, WAYS, np.asarray)
    asked = propose(path, MACHINE, {}, ANSWERS).open
    assert [(q.key, q.choices) for q in asked] == [("runs", ("forward", "backward", "there and back"))]
    check(imported(path, runs="there and back"), WAYS)
    check(imported(path, runs="forward"), WAYS, [1] * len(WAYS))
    check(imported(path, runs="backward"), WAYS, [-1] * len(WAYS))


def test_targets_from_far_to_near_and_a_lost_reading(tmp_path: Path) -> None:
    """The table goes down; run 2 has an empty cell on the way back."""
    header = ["Target [mm];" + ";".join(f"{r}{'+' if s > 0 else '-'} [um]" for r, s in WAYS)]
    path = protocol(tmp_path, header, WAYS, np.asarray)
    head, *rows = path.read_text().splitlines()
    cells = rows[2].split(";")
    cells[4] = ""
    path.write_text("\n".join([head, *rows[:2:-1], ";".join(cells), *rows[1::-1]]))
    done = imported(path)
    lost = np.flatnonzero(np.isnan(np.asarray(done.columns["reading_um"])))
    assert lost.tolist() == [3 * len(X) + len(X) - 1 - 2]
    np.testing.assert_array_equal(done.columns["x_mm"], np.concatenate([X[::s] for _, s in WAYS]))


def test_the_map_that_is_kept_does_it_again(tmp_path: Path) -> None:
    header = ["Target [mm];" + ";".join(f"Run {r} {'+' if s > 0 else '-'} [um]" for r, s in BLOCKS)]
    path = protocol(tmp_path, header, BLOCKS, np.asarray)
    kept = save_map(propose(path, MACHINE, {}, ANSWERS), tmp_path / "out.csv")
    check(import_table(path, load_map(kept)), WAYS)


def test_runs_in_different_units_are_refused(tmp_path: Path) -> None:
    header = [
        "Target [mm];" + ";".join(f"Run {r} {'+' if s > 0 else '-'} [{'um' if s > 0 else 'mm'}]" for r, s in WAYS)
    ]
    with pytest.raises(MeasurementError, match=r"\[cycles\] the runs are in mm, um"):
        propose(protocol(tmp_path, header, WAYS, np.asarray), MACHINE, {}, ANSWERS)


def test_what_is_no_run() -> None:
    names = [
        "T1 [°C]",
        "Temp 1 +",
        "c1",
        "ch1_um",
        "Probe 1",
        "Soll X [mm]",
        "X1 [mm]",
        "Mean +",
        "s -",
        "Run 1 of 5 +",
        "R",
        "X -",
        "T_back",
    ]
    assert [n for n in names if run_and_direction(n) is not None] == []


def test_a_table_of_channels_over_time_is_no_protocol(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "\n".join(["time [s];X [mm];Run 1 +;Run 1 -", *(f"{i};{10 * i};{i / 7};{i / 9}" for i in range(9))])
    )
    assert "cycles" not in propose(path, MACHINE).content
