"""A table of every instrument becomes a measurement by its questions alone, without a map written by hand.

Oracles: the numbers that were written; what the instrument itself says is missing (it reads the result back).
"""

from pathlib import Path

import numpy as np
import pytest

from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import import_to_files, propose
from rtec.metrology.instruments.registry import INSTRUMENTS

MACHINE = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml")
X = np.concatenate([np.arange(10.0, 191.0, 20.0), np.arange(10.0, 191.0, 20.0)[::-1]])
SMALL = np.round(0.002 * X + 0.1, 4)
ANGLE = np.linspace(0.0, 350.0, len(X))
STILL = np.full(len(X), 50.0)
TABLES: dict[str, tuple[dict[str, np.ndarray], dict[str, str]]] = {
    "laser_linear": ({"X [mm]": X, "Dev [um]": SMALL}, {}),
    "laser_diagonal": ({"X [mm]": X, "Z [mm]": 200.0 - 2.0 * X, "Dev [um]": SMALL}, {"setup.direction": "[1, 0, -2]"}),
    "laser_angular": ({"X [mm]": X, "Pitch [arcsec]": SMALL}, {"setup.about": "B"}),
    "level": ({"X [mm]": X, "Tilt [um/m]": SMALL}, {"setup.about": "B"}),
    "straightness": ({"X [mm]": X, "Probe [um]": SMALL}, {"setup.direction": "Y"}),
    "squareness": (
        {"X [mm]": X, "Z [mm]": X[::-1], "Dev X [um]": SMALL, "Dev Z [um]": SMALL},
        {"axis": "Z", "setup.reference_axis": "X"},
    ),
    "spindle_drift": (
        {"dz [um]": SMALL, "dx [um]": 2.0 * SMALL},
        {"setup.probe": '{z={direction="Z"}, x={direction="X"}}'},
    ),
    "tool_tip": ({"X [mm]": X, "Dev X [um]": SMALL, "Dev Z [um]": 2.0 * SMALL}, {}),
    "work_piece": ({"X [mm]": X, "Dev [um]": SMALL}, {"setup.feature": "length"}),
    "ball_bar": (
        {"Angle [deg]": ANGLE, "Dev [um]": SMALL},
        {
            "setup.plane": "XZ", "setup.centre_mm": "[100, 0, 100]", "setup.radius_mm": "50",
            "setup.direction": "ccw", "setup.feed_mm_min": "500",
        },
    ),
    "grid_encoder": (
        {"X [mm]": X, "Z [mm]": STILL, "Dev X [um]": SMALL, "Dev Z [um]": 2.0 * SMALL},
        {"setup.plane": "XZ", "setup.origin_mm": "[100, 0, 100]"},
    ),
}  # fmt: skip


def written(folder: Path, name: str) -> Path:
    path = folder / f"{name}.csv"
    columns, _ = TABLES[name]
    rows = [";".join(f"{v:.4f}" for v in row) for row in zip(*columns.values(), strict=True)]
    path.write_text("\n".join(["t [s];" + ";".join(columns), *(f"{5 * i};{row}" for i, row in enumerate(rows))]))
    return path


def test_every_instrument_is_here() -> None:
    assert TABLES.keys() == INSTRUMENTS.keys()


@pytest.mark.parametrize("name", TABLES)
def test_what_an_instrument_needs_is_asked_and_enough(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, name)
    _, more = TABLES[name]
    asked = {q.key for q in propose(path, MACHINE, {}, {"instrument": name}).open}
    assert asked == set(more)
    proposal = propose(path, MACHINE, {}, {"instrument": name, **more})
    assert proposal.open == ()
    import_to_files(path, proposal.import_map(), tmp_path / "out.csv", MACHINE)
    m = load_measurement(tmp_path / "out.csv", MACHINE)
    first = next(iter(m.readings.values()))
    per = {"laser_angular": np.pi / 180.0 / 3600.0 * 1e6}.get(name, 1.0)
    np.testing.assert_allclose(first, per * SMALL, atol=1e-9)


@pytest.mark.parametrize("name", TABLES)
def test_an_answer_that_does_not_apply_is_told_and_a_wrong_one_refused(tmp_path: Path, name: str) -> None:
    """One script answers for files of all instruments: the keys of the others do no harm."""
    path = written(tmp_path, name)
    needed = {"instrument": name, **TABLES[name][1]}
    others = {
        k: v for _, more in TABLES.values() for k, v in more.items() if k not in needed and k.startswith("setup.")
    }
    own = {f"setup.{k}" for k in INSTRUMENTS[name].setup_model.model_fields}
    others = {k: v for k, v in others.items() if k not in own}
    proposal = propose(path, MACHINE, {}, needed | others)
    assert proposal.content["setup"] == propose(path, MACHINE, {}, needed).content["setup"]
    assert sum("not used: " in c for c in proposal.conclusions) == len(others)
    with pytest.raises(MeasurementError, match=r"'setup\.abuot' is no question here"):
        propose(path, MACHINE, {}, needed | {"setup.abuot": "B"})


def test_axes_that_move_together_are_a_diagonal(tmp_path: Path) -> None:
    """The sign is that of the first way. Oracle: the positions that were written; as a laser along X it is refused."""
    path = written(tmp_path, "laser_diagonal")
    p = propose(path, MACHINE, {}, {})
    assert {q.key: q.default for q in p.questions if q.key in ("instrument", "setup.direction")} == {
        "instrument": "laser_diagonal",
        "setup.direction": str([round(1 / 5**0.5, 4), 0.0, round(-2 / 5**0.5, 4)]),
    }
    wrong = propose(path, MACHINE, {}, {"instrument": "laser_linear", "axis": "X"})
    with pytest.raises(MeasurementError, match=r"X and Z move together: instrument = \"laser_diagonal\" reads along"):
        import_to_files(path, wrong.import_map(), tmp_path / "out.csv", MACHINE)
    other = propose(path, MACHINE, {}, {"instrument": "laser_diagonal", "setup.direction": "[1, 0, 2]"})
    with pytest.raises(MeasurementError, match=r"but the axes move along \[0\.4472, 0\.0, -0\.8944\]"):
        import_to_files(path, other.import_map(), tmp_path / "out.csv", MACHINE)


def test_an_axis_is_told_where_none_is_followed_and_taken_where_it_may_be(tmp_path: Path) -> None:
    def of(name: str) -> tuple[object, tuple[str, ...]]:
        answers = {"instrument": name, "axis": "X", **TABLES[name][1]}
        p = propose(written(tmp_path, name), MACHINE, {}, answers)
        return p.content["measurement"].get("axis"), p.conclusions

    assert of("level")[0] == "X"
    axis, said = of("tool_tip")
    assert axis is None
    assert "answer axis 'X': not used: tool_tip has no such key" in said


def test_a_key_with_a_default_may_be_given(tmp_path: Path) -> None:
    path = written(tmp_path, "level")
    answers = {"instrument": "level", "setup.about": "B", "setup.sign": "-1", "setup.vertical": "Z", "sign": "1"}
    p = propose(path, MACHINE, {}, answers)
    assert p.content["setup"] == {"about": "B", "sign": -1, "vertical": "Z"}
    again = propose(path, MACHINE, {}, {"instrument": "level", "component": "EBX"})
    assert again.open == ()
    assert again.content["measurement"]["component"] == "EBX"


def test_an_answer_repeats_what_the_file_shows_or_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "foreign.csv"
    path.write_text("\n".join(["t [s];X [mm];Soll-Ist [um]", *(f"{i};{x};{x / 100}" for i, x in enumerate(X))]))
    right = {"axis": "X", "sign": "-1", "unit of X [mm]": "mm", "unit of Soll-Ist [um]": "µm"}
    said = propose(path, MACHINE, {}, right).conclusions
    assert sum(c.endswith("as the file shows itself") for c in said) == len(right)
    for key, value in (("axis", "Z"), ("sign", "+1"), ("unit of X [mm]", "inch")):
        with pytest.raises(MeasurementError, match=f"'{key}' is no question here: the file shows".replace("[", r"\[")):
            propose(path, MACHINE, {}, {key: value})
