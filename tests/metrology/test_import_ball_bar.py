"""A ball bar's file that holds the length of the bar, not its deviation.

Oracle: the deviations that were written, added to the bar's nominal length by hand.
"""

from pathlib import Path

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurement
from rtec.metrology.importing import Imported, ImportProposal, import_to_files, propose

PATH = Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml"
MACHINE = load_machine(PATH)
ANGLE = np.arange(0.0, 361.0, 5.0)
DEVIATION_UM = np.round(
    6.0 * np.sin(np.deg2rad(2.0 * ANGLE)) + np.random.default_rng(7).normal(0.0, 0.3, len(ANGLE)), 1
)
KNOWN = {
    "instrument": "ball_bar", "setup.plane": "XZ", "setup.centre_mm": "[100, 0, 100]", "setup.direction": "ccw",
    "setup.feed_mm_min": "500",
}  # fmt: skip


def proposed(folder: Path, name: str, values: np.ndarray, **more: str) -> ImportProposal:
    path = folder / "raw.csv"
    rows = (f"{a:g};{v:.8f}" for a, v in zip(ANGLE, values, strict=True))
    path.write_text("\n".join([f"Winkel [°];{name}", *rows, ""]))
    return propose(path, MACHINE, {}, KNOWN | {f"setup.{k}": v for k, v in more.items()})


def imported(folder: Path, proposal: ImportProposal) -> Imported:
    done = import_to_files(proposal.path, proposal.import_map(), folder / "out.csv", MACHINE)
    assert done.measurement is not None
    np.testing.assert_allclose(done.measurement.readings["reading_um"], DEVIATION_UM, atol=0.02)
    return done


@pytest.mark.parametrize(
    ("name", "per_um"),
    [("Radius [mm]", 1e-3), ("R", 1e-3), ("Length [um]", 1.0), ("Messwert [mm]", 1e-3), ("R [inch]", 1e-3 / 25.4)],
)
@pytest.mark.parametrize("radius", [None, 150.0])
def test_the_nominal_length_is_taken_off(tmp_path: Path, name: str, per_um: float, radius: float | None) -> None:
    values = (150000.0 + DEVIATION_UM) * per_um
    proposal = proposed(tmp_path, name, values, **({} if radius is None else {"radius_mm": f"{radius}"}))
    assert proposal.open == ()
    assert ("setup.radius_mm" in {q.key for q, _ in proposal.assumed}) == (radius is None)
    assert float(proposal.content["setup"]["radius_mm"]) == 150.0
    assert any("its nominal length, 150 mm, is taken off" in c for c in proposal.conclusions)
    assert any(n.endswith("- 150000") for n in imported(tmp_path, proposal).notes)


@pytest.mark.parametrize("radius", [99.999, 99.9999, 100.0])
def test_a_length_that_looks_like_a_code_of_a_lost_reading(tmp_path: Path, radius: float) -> None:
    values = 1e-3 * (1e3 * radius + DEVIATION_UM)
    imported(tmp_path, proposed(tmp_path, "Radius [mm]", values, radius_mm=f"{radius}"))


def test_a_bar_that_leans(tmp_path: Path) -> None:
    """Oracle: Pythagoras."""
    values = 50.0 + 1e-3 * DEVIATION_UM
    assert [q.key for q in proposed(tmp_path, "Radius [mm]", values, height_mm="30").open] == ["setup.radius_mm"]
    imported(tmp_path, proposed(tmp_path, "Radius [mm]", values, height_mm="30", radius_mm="40"))


def test_a_bar_of_another_length_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match=r"length of the bar, 150.* radius_mm and height_mm make it 100 mm"):
        proposed(tmp_path, "Radius [mm]", 150.0 + 1e-3 * DEVIATION_UM, radius_mm="100")


@pytest.mark.parametrize("name", ["Radius [mm]", "Dev [mm]", "Radius deviation [mm]"])
def test_a_deviation_stays_what_it_is(tmp_path: Path, name: str) -> None:
    proposal = proposed(tmp_path, name, 1e-3 * DEVIATION_UM, radius_mm="100")
    assert "offset" not in proposal.content["column"]["reading_um"]
    imported(tmp_path, proposal)


@pytest.mark.parametrize("radius", [100.0, 150.0])
@pytest.mark.parametrize("command", [["ballbar"], ["fit", "MACHINE"]])
def test_a_measurement_of_lengths_is_refused(
    tmp_path: Path, radius: float, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Of 100 mm some are written as programs write a lost reading, 99999.9; the message says what they are."""
    values = 1e-3 * (1e3 * radius + DEVIATION_UM)
    imported(tmp_path, proposed(tmp_path, "Radius [mm]", values, radius_mm=f"{radius}"))
    table = tmp_path / "out.csv"
    head, *rows = table.read_text().splitlines()
    at = head.split(",").index("reading_um")
    cells = [row.split(",") for row in rows]
    for row in cells:
        row[at] = f"{float(row[at]) + 1e3 * radius:.1f}"
    cells[3][at] = "99999.9"
    table.write_text("\n".join([head, *(",".join(row) for row in cells), ""]))
    with pytest.raises(MeasurementError, match="no deviation of the bar's length") as caught:
        load_measurement(table, MACHINE)
    assert "lost" not in str(caught.value)
    words = [str(PATH) if w == "MACHINE" else w for w in command]
    more = ["--machine", str(PATH)] if command == ["ballbar"] else ["-o", str(tmp_path / "model.toml")]
    assert status([*words, str(table), *more]) == 2
    said = capsys.readouterr().err
    assert f"subtract {1e3 * radius:g}" in " ".join(said.split())
