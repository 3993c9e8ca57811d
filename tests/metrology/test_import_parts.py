"""Files of parts that were measured after cutting: the part is the run, the instrument a work piece.

Oracle: the errors of the diameters in µm that were added, and the number of each part.
"""

from pathlib import Path

import numpy as np
import pytest

from rtec.machine import load_machine
from rtec.metrology.importing import ImportProposal, import_to_files, propose

MACHINE = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml")
DIAMETERS_MM = np.tile([30.0, 44.0, 60.0, 80.0], 5)
PART = np.repeat(np.arange(1, 6), 4)
ERRORS_UM = np.round(np.random.default_rng(5).normal(8.0, 2.0, len(PART)), 1)
NAMES = ("Part no", "Nominal dia [mm]", "Measured dia [mm]")


def parts(folder: Path, names: tuple[str, str, str] = NAMES, part: np.ndarray = PART) -> Path:
    lines = [
        f"{p};{60 * i};{240 - 60 * (i % 4)};{d};{d + 1e-3 * e:.4f}"
        for i, (p, d, e) in enumerate(zip(part, DIAMETERS_MM, ERRORS_UM, strict=True))
    ]
    path = folder / "parts.csv"
    path.write_text("\n".join([f"{names[0]};t [s];Z [mm];{names[1]};{names[2]}", *lines]), encoding="utf-8")
    return path


def proposed(path: Path, **answers: str) -> ImportProposal:
    return propose(path, MACHINE, {}, {"axis": "X", **answers})


@pytest.mark.parametrize("part", ["Part no", "Part", "Teil", "Teil-Nr.", "Werkstück", "Workpiece ID", "Part #"])
def test_each_part_is_a_run_of_a_work_piece(part: str, tmp_path: Path) -> None:
    """The axis is asked; the reading is the error of the diameter, the position a radius."""
    path = parts(tmp_path, (part, *NAMES[1:]))
    assert [q.key for q in propose(path, MACHINE).open] == ["axis"]
    proposal = proposed(path)
    assert proposal.content["measurement"]["instrument"] == "work_piece"
    assert proposal.content["setup"]["feature"] == "diameter"
    m = import_to_files(path, proposal.import_map(), tmp_path / "made", MACHINE).measurement
    assert m is not None
    np.testing.assert_array_equal(m.run, PART)
    np.testing.assert_allclose(m.readings["reading_um"], ERRORS_UM, atol=1e-6)
    np.testing.assert_allclose(m.channels["x"], DIAMETERS_MM / 2.0)


def test_diameters_without_a_part_are_of_a_work_piece(tmp_path: Path) -> None:
    proposal = proposed(parts(tmp_path, ("Sample", "Soll-Ø [mm]", "Ist-Ø [mm]")))
    assert proposal.content["measurement"]["instrument"] == "work_piece"
    assert "column" not in proposal.content["run"]


def test_parts_that_come_back_are_no_runs(tmp_path: Path) -> None:
    """Each feature was measured on all parts in turn: the rows of one part are not together."""
    proposal = proposed(parts(tmp_path, part=np.tile(np.arange(1, 6), 4)))
    assert "column" not in proposal.content["run"]


def test_the_temperature_of_a_part_is_no_number_of_it(tmp_path: Path) -> None:
    names = ("Werkstück [°C]", *NAMES[1:])
    proposal = proposed(parts(tmp_path, names), **{"sensor of Werkstück [°C]": "T_bed"})
    assert "column" not in proposal.content["run"]
    assert proposal.content["column"]["T_bed_degc"]["from"] == "Werkstück [°C]"
