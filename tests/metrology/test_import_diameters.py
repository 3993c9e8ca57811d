"""Columns of a lathe in diameter. Oracle: half of the numbers that were written, by hand."""

from pathlib import Path

import numpy as np
import pytest

from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import ImportProposal, import_to_files, propose
from rtec.metrology.importing.words import axis_letter, in_diameter

MACHINE = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml")
X = np.concatenate([np.arange(20.0, 181.0, 20.0), np.arange(20.0, 181.0, 20.0)[::-1]])
ERROR = np.round(0.01 * X + np.random.default_rng(3).normal(0.0, 0.3, len(X)), 1)


def proposed(folder: Path, columns: dict[str, np.ndarray], **answers: str) -> ImportProposal:
    path = folder / "raw.csv"
    rows = (";".join(f"{v:.7f}" for v in row) for row in zip(*columns.values(), strict=True))
    path.write_text("\n".join([";".join(columns), *rows, ""]))
    return propose(path, MACHINE, {}, {"instrument": "laser_linear"} | answers)


def imported(folder: Path, proposal: ImportProposal) -> tuple[float, float]:
    """The factors of position and error."""
    done = import_to_files(proposal.path, proposal.import_map(), folder / "out.csv", MACHINE, force=True)
    place, read = (np.asarray(done.columns[n], dtype=np.float64) for n in ("x_mm", "reading_um"))
    factors = float(np.median(place / X)), float(np.median(read[ERROR != 0.0] / ERROR[ERROR != 0.0]))
    np.testing.assert_allclose(place, factors[0] * X)
    np.testing.assert_allclose(read, factors[1] * ERROR, atol=1e-9)
    return factors


@pytest.mark.parametrize(
    "mark",
    ["{} Ø", "{} ⌀", "{} dia", "{} diam.", "{} diameter", "{} Durchm.", "{} Durchmesser", "{}_dia", "Ø {}", "{} (Ø)"],
)
def test_a_position_and_an_error_in_diameter_are_halved(tmp_path: Path, mark: str) -> None:
    columns = {f"{mark.format('X')} [mm]": X, f"{mark.format('Abweichung')} [µm]": ERROR}
    proposal = proposed(tmp_path, columns)
    assert proposal.open == ()
    assert [a for q, a in proposal.assumed if q.key == "diameter"] == ["both"]
    assert all(c.reason.endswith("a diameter, halved") for c in proposal.columns)
    assert any("halved to a radius" in n for n in proposal.import_map().measurement.notes)
    assert imported(tmp_path, proposal) == (0.5, 0.5)


@pytest.mark.parametrize(("answer", "factors"), [("none", (1, 1)), ("position", (0.5, 1)), ("error", (1, 0.5))])
def test_an_answer_says_otherwise(tmp_path: Path, answer: str, factors: tuple[float, float]) -> None:
    proposal = proposed(tmp_path, {"XØ [mm]": X, "Error Ø [um]": ERROR}, diameter=answer)
    assert imported(tmp_path, proposal) == factors


@pytest.mark.parametrize("names", [("X Ø [mm]", "Error [um]"), ("X [mm]", "Error Ø [um]")])
def test_one_of_the_two_alone_is_asked(tmp_path: Path, names: tuple[str, str]) -> None:
    columns = dict(zip(names, (X, ERROR), strict=True))
    assert [(q.key, q.choices) for q in proposed(tmp_path, columns).open] == [
        ("diameter", ("both", "position", "error", "none"))
    ]
    assert imported(tmp_path, proposed(tmp_path, columns, diameter="both")) == (0.5, 0.5)
    assert imported(tmp_path, proposed(tmp_path, columns, diameter="position")) == (0.5, 1.0)


def test_an_actual_diameter_less_a_nominal_one(tmp_path: Path) -> None:
    proposal = proposed(tmp_path, {"Soll X Ø [mm]": X, "Ist X Ø [mm]": X + 1e-3 * ERROR})
    done = import_to_files(proposal.path, proposal.import_map(), tmp_path / "out.csv", MACHINE)
    np.testing.assert_allclose(np.asarray(done.columns["reading_um"], dtype=np.float64), 0.5 * ERROR, atol=1e-3)
    np.testing.assert_allclose(np.asarray(done.columns["x_mm"], dtype=np.float64), 0.5 * X)


def test_a_reading_along_another_axis_is_no_partner(tmp_path: Path) -> None:
    """A laser along Z at one diameter of X: the error is no diameter."""
    columns = {"Z [mm]": X, "X Ø [mm]": np.full(len(X), 80.0), "Error [um]": ERROR}
    proposal = proposed(tmp_path, columns)
    assert proposal.open == ()
    done = import_to_files(proposal.path, proposal.import_map(), tmp_path / "out.csv", MACHINE)
    assert set(np.asarray(done.columns["x_mm"]).tolist()) == {40.0}
    np.testing.assert_allclose(np.asarray(done.columns["reading_um"], dtype=np.float64), ERROR)


def test_the_diameter_of_a_work_piece_counts_twice_by_itself(tmp_path: Path) -> None:
    columns = {"X Ø [mm]": X, "Abweichung Ø [µm]": ERROR}
    proposal = proposed(tmp_path, columns, instrument="work_piece", **{"setup.feature": "diameter"})
    assert imported(tmp_path, proposal) == (0.5, 1.0)


def test_names_without_a_diameter(tmp_path: Path) -> None:
    names = ["X [mm]", "Media [um]", "diagonal", "Øvre X", "Kjølevann", "Dialog", "radius"]
    assert [n for n in names if in_diameter(n)] == []
    assert [axis_letter(n) for n in ("XØ [mm]", "ØX", "X Ø", "X⌀")] == ["X"] * 4
    proposal = proposed(tmp_path, {"X [mm]": X, "Error [um]": ERROR}, diameter="none")
    assert imported(tmp_path, proposal) == (1.0, 1.0)


def test_a_lathe_whose_file_tells_nothing_takes_radii_and_says_so(tmp_path: Path) -> None:
    proposal = proposed(tmp_path, {"X [mm]": X, "Error [um]": ERROR})
    (said,) = [(q.text, a) for q, a in proposal.assumed if q.key == "diameter"]
    assert said[0].startswith("X of a lathe may be a diameter; 'X [mm]' and 'Error [um]' do not tell.")
    assert said[1] == "none"
    assert imported(tmp_path, proposed(tmp_path, {"X [mm]": X, "Error [um]": ERROR}, diameter="position")) == (0.5, 1)


def test_positions_of_a_lathe_of_which_only_half_fits_must_be_answered(tmp_path: Path) -> None:
    """The travel is 200 mm; 360 mm of the display are a radius of 180 mm."""
    columns = {"X [mm]": 2.0 * X, "Error [um]": ERROR}
    (asked,) = [q for q in proposed(tmp_path, columns).open if q.key == "diameter"]
    assert "half of it is within the travel, all of it is not" in asked.text
    assert imported(tmp_path, proposed(tmp_path, columns, diameter="position"))[0] == pytest.approx(1.0)


def test_a_mill_is_not_asked(tmp_path: Path) -> None:
    mill = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "vertical-mill.toml")
    path = tmp_path / "raw.csv"
    path.write_text("\n".join(["X [mm];Error [um]", *(f"{x};{e}" for x, e in zip(X, ERROR, strict=True)), ""]))
    proposal = propose(path, mill, {}, {"instrument": "laser_linear"})
    assert "diameter" not in [q.key for q in (*proposal.open, *(q for q, _ in proposal.assumed))]


@pytest.mark.parametrize(("answer", "way"), [(None, 0.0), ("-1", -1.0)])
def test_the_order_of_features_tells_no_direction_of_the_cut(tmp_path: Path, answer: str | None, way: float) -> None:
    """Four collars, each wider than the one before, were all cut towards the spindle: an order is no direction.

    As it was, three of them were taken for cut outwards, and a backlash and a squareness that no machine had followed.
    """
    collars = {"X Ø [mm]": np.tile([30.0, 44.0, 60.0, 80.0], 5), "Error Ø [um]": np.tile([9.1, 9.4, 10.2, 11.0], 5)}
    said = {"setup.feature": "diameter", "instrument": "work_piece"} | ({"dir_x": answer} if answer else {})
    proposal = proposed(tmp_path, collars, **said)
    import_to_files(proposal.path, proposal.import_map(), tmp_path / "parts.csv", MACHINE, force=True)
    parts = load_measurement(tmp_path / "parts", MACHINE)
    np.testing.assert_array_equal(parts.state().value("d_x"), way)
    notes = [n for n in parts.notes if n.startswith("no column dir_x: nothing tells the direction of the cut")]
    assert len(notes) == (answer is None)
