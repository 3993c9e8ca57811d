"""Columns that hold a deviation, or the actual position that it follows from.

Oracles: deviations in µm chosen here, written in the form, unit and order that the header says.
"""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.importing import Imported, ImportProposal, import_table, propose
from rtec.metrology.importing.words import difference

MACHINE = load_machine(Path(__file__).parents[2] / "configs" / "machines" / "turning-centre.toml")
X = np.concatenate([np.arange(5.0, 200.0, 13.0), np.arange(5.0, 200.0, 13.0)[::-1]])
DEVIATION_UM = np.round(0.014 * X + np.where(np.arange(len(X)) < len(X) / 2, 2.0, -2.0), 3)
ANSWERS = {"axis": "X", "instrument": "laser_linear"}


def table(folder: Path, columns: Mapping[str, Sequence[float] | np.ndarray]) -> Path:
    path = folder / "foreign.csv"
    lines = [";".join(columns), *(";".join(f"{v:.7f}" for v in row) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def proposed(path: Path, **more: str) -> ImportProposal:
    """The proposal, with the answers that it asks for."""
    known = {q.key for q in propose(path, MACHINE).questions}
    return propose(path, MACHINE, {}, {k: v for k, v in (ANSWERS | more).items() if k in known or k in more})


def imported(path: Path, **more: str) -> Imported:
    return import_table(path, proposed(path, **more).import_map())


@pytest.mark.parametrize("position", ["X [mm]", "Soll X [mm]", "X pos mm", "Position [mm]", "Target [mm]"])
@pytest.mark.parametrize(
    ("name", "sign", "per_um"),
    [
        ("Actual - Target [um]", 1, 1.0),
        ("Actual-Target [mm]", 1, 1e-3),
        ("Actual - Target (um)", 1, 1.0),
        ("Target - Actual (um)", -1, 1.0),
        ("Target–Actual [µm]", -1, 1.0),
        ("Ist−Soll [µm]", 1, 1.0),
        ("Soll-Ist [µm]", -1, 1.0),
        ("Ist-Position - Soll-Position [µm]", 1, 1.0),
        ("Sollwert minus Istwert [mm]", -1, 1e-3),
        ("X Actual - X Target [mm]", 1, 1e-3),
        ("ActMinusNom_um", 1, 1.0),
        ("Error (measured-nominal) [um]", 1, 1.0),
        ("Err = meas - nom [um]", 1, 1.0),
        ("Err = nom - meas [um]", -1, 1.0),
        ("Deviation (A-T) [um]", 1, 1.0),
        ("Deviation (T - A) [um]", -1, 1.0),
        ("Mesuré − Consigne [µm]", 1, 1.0),
        ("Consigne moins mesure [µm]", -1, 1.0),
        ("Medido - Nominal [um]", 1, 1.0),
        ("Misurato – Nominale [um]", 1, 1.0),
    ],
)
def test_a_difference_is_a_deviation_and_its_order_is_the_sign(
    tmp_path: Path, position: str, name: str, sign: int, per_um: float
) -> None:
    path = table(tmp_path, {position: X, name: sign * per_um * DEVIATION_UM})
    assert "sign" not in {q.key for q in proposed(path).questions}
    done = imported(path)
    np.testing.assert_allclose(done.columns["reading_um"], DEVIATION_UM, atol=1e-3)
    np.testing.assert_array_equal(done.columns["x_mm"], X)


@pytest.mark.parametrize(
    "name", ["Actual vs Target [um]", "Target vs. Actual [um]", "Soll-Ist-Abweichung [µm]", "Soll/Ist [µm]"]
)
def test_a_difference_without_an_order_is_asked(tmp_path: Path, name: str) -> None:
    path = table(tmp_path, {"X [mm]": X, name: DEVIATION_UM})
    assert "sign" in {q.key for q in proposed(path).questions}
    np.testing.assert_allclose(imported(path, sign="-1").columns["reading_um"], -DEVIATION_UM, atol=1e-6)


def test_what_only_looks_like_a_difference() -> None:
    names = (
        "Ist-Position [mm]",
        "X-Ist",
        "Soll-Position",
        "Ist X",
        "Weg/mm",
        "T-Nut [°C]",
        "Position-Actual",
        "Laser-X",
    )
    assert [n for n in names if difference(n) is not None] == []


@pytest.mark.parametrize("name", ["Messwert [mm]", "Laser [mm]", "Actual [mm]"])
def test_an_actual_value_far_below_the_travel_is_a_deviation(tmp_path: Path, name: str) -> None:
    path = table(tmp_path, {"Soll X [mm]": X, name: 1e-3 * DEVIATION_UM})
    np.testing.assert_allclose(imported(path).columns["reading_um"], DEVIATION_UM, atol=1e-3)


@pytest.mark.parametrize(
    ("nominal", "actual", "per_mm"),
    [
        ("Soll [mm]", "Ist [mm]", (1.0, 1.0)),
        ("Soll [mm]", "Ist [µm]", (1.0, 1e3)),
        ("Soll [µm]", "Ist [mm]", (1e3, 1.0)),
        ("Soll mm", "Ist [µm]", (1.0, 1e3)),
        ("Soll [µm]", "Ist mm", (1e3, 1.0)),
        ("Soll mm", "Ist um", (1.0, 1e3)),
        ("Soll mm", "Ist mm", (1.0, 1.0)),
        ("Soll", "Ist [mm]", (1.0, 1.0)),
        ("Soll [inch]", "Ist [mm]", (1.0 / 25.4, 1.0)),
        ("Soll", "Ist", (1.0, 1.0)),
        ("Soll [mm]", "Ist", (1.0, 1.0)),
    ],
)
def test_columns_of_two_units_are_converted_before_one_is_subtracted(
    tmp_path: Path, nominal: str, actual: str, per_mm: tuple[float, float]
) -> None:
    path = table(tmp_path, {nominal: per_mm[0] * X, actual: per_mm[1] * (X + 1e-3 * DEVIATION_UM)})
    np.testing.assert_allclose(imported(path).columns["reading_um"], DEVIATION_UM, atol=5e-3)


def test_an_actual_position_in_a_unit_that_nobody_tells_is_asked(tmp_path: Path) -> None:
    path = table(tmp_path, {"Soll [mm]": X, "Ist": (X + 1e-3 * DEVIATION_UM) * 1e3})
    assert [q.key for q in proposed(path).open] == ["unit of Ist"]
    np.testing.assert_allclose(imported(path, **{"unit of Ist": "um"}).columns["reading_um"], DEVIATION_UM, atol=5e-3)


def test_each_actual_position_belongs_to_the_nominal_one_of_its_axis(tmp_path: Path) -> None:
    """Z stands still at 40 mm."""
    still = np.full(len(X), 40.0)
    columns = {"Soll Z [mm]": still, "Soll X [mm]": X, "Ist X [mm]": X + 1e-3 * DEVIATION_UM, "Ist Z [mm]": still}
    np.testing.assert_allclose(imported(table(tmp_path, columns)).columns["reading_um"], DEVIATION_UM, atol=1e-3)


def a_map(path: Path, more: str) -> ImportProposal:
    """A proposal with a column of the map given."""
    head = '[measurement]\ninstrument = "laser_linear"\naxis = "X"\nmachine = "m"\n[time]\nstep_s = 1.0\n'
    return propose(path, None, tomllib.loads(head + more), {})


def test_a_map_tells_the_unit_of_what_it_subtracts(tmp_path: Path) -> None:
    path = table(tmp_path, {"a [um]": (X + 1e-3 * DEVIATION_UM) * 1e3, "b": X})
    given = '[column.x_mm]\nfrom = "b"\nunit = "mm"\n[column.reading_um]\nfrom = "a [um]"\nminus = "b"\n'
    with pytest.raises(MeasurementError, match=r"nobody tells the unit of 'b'; say minus_unit"):
        import_table(path, a_map(path, given).import_map())
    done = import_table(path, a_map(path, given + 'minus_unit = "mm"\n').import_map())
    np.testing.assert_allclose(done.columns["reading_um"], DEVIATION_UM, atol=5e-3)


@pytest.mark.parametrize(("minus", "unit"), [("", "mm"), ('minus = "c [mm]"\n', "um")])
def test_readings_that_are_positions_are_refused(tmp_path: Path, minus: str, unit: str) -> None:
    """A position as the reading, and a deviation less a position."""
    read = X if unit == "mm" else DEVIATION_UM
    path = table(tmp_path, {f"b [{unit}]": read, "c [mm]": X})
    given = '[column.x_mm]\nfrom = "c [mm]"\n[column.reading_um]\nfrom = "b [' + unit + ']"\n' + minus
    with pytest.raises(MeasurementError, match=r"varies by .* over a travel of .*: these are positions, no deviations"):
        import_table(path, a_map(path, given).import_map())


def test_readings_beyond_what_machines_err_are_doubted(tmp_path: Path) -> None:
    """The deviations are in µm, and the header says mm."""
    done = imported(table(tmp_path, {"X [mm]": X, "Deviation [mm]": DEVIATION_UM}))
    assert any(n.startswith("doubtful: reading_um varies by") for n in done.notes)
    fine = imported(table(tmp_path, {"X [mm]": X, "Deviation [um]": DEVIATION_UM}))
    assert not any(n.startswith("doubtful") for n in fine.notes)


# --- directions

WAY = np.where(np.arange(len(X)) < len(X) / 2, 1, -1)


def with_words(folder: Path, name: str, words: Mapping[int, str]) -> Path:
    path = folder / "foreign.csv"
    rows = [f"{x};{words[w]};{d}" for x, w, d in zip(X, WAY.tolist(), DEVIATION_UM, strict=True)]
    path.write_text("\n".join([f"X [mm];{name};Abweichung [µm]", *rows]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "name",
    [
        "dir_x", "Richtung X", "Dir X", "Direction X", "Sens X", "X dir", "dirX", "Approach", "Anfahrrichtung",
        "Richtung", "Run direction", "Sentido",
    ],
)  # fmt: skip
@pytest.mark.parametrize("words", [("1", "-1"), ("+1", "-1"), ("+", "-"), ("fwd", "rev")])
def test_a_direction_is_no_position(tmp_path: Path, name: str, words: tuple[str, str]) -> None:
    done = imported(with_words(tmp_path, name, {1: words[0], -1: words[1]}))
    np.testing.assert_array_equal(done.columns["dir_x"], WAY)
    np.testing.assert_array_equal(done.columns["x_mm"], X)
    np.testing.assert_array_equal(done.columns["reading_um"], DEVIATION_UM)


@pytest.mark.parametrize(
    ("forward", "back"),
    [
        ("vor", "zurück"), ("up", "down"), ("pos", "neg"), ("+", "−"), ("↑", "↓"), ("X+", "X-"), ("(+)", "(-)"),
        ("Positive", "Negative"), ("aller", "retour"), ("Forward", "Reverse"), ("1", "0"), ("1", "2"), ("2", "1"),
        ("0", "1"),
    ],
)  # fmt: skip
def test_words_and_numbers_of_directions(tmp_path: Path, forward: str, back: str) -> None:
    done = imported(with_words(tmp_path, "Approach", {1: forward, -1: back}))
    np.testing.assert_array_equal(done.columns["dir_x"], WAY)


def test_numbers_of_directions_that_the_positions_do_not_show_are_asked(tmp_path: Path) -> None:
    """Each target is approached from both sides, the first one in turn; the positions are those of the targets."""
    path = tmp_path / "foreign.csv"
    rows = [f"{x};{w};{0.01 * x + w}" for x in range(5, 200, 13) for w in (x % 2, 1 - x % 2)]
    path.write_text("\n".join(["X [mm];Approach;Abweichung [µm]", *rows]))
    asked = [q for q in proposed(path).open if q.key.startswith("direction of")]
    assert [q.choices for q in asked] == [("1", "0")]
    done = imported(path, **{"direction of Approach": "1"})
    np.testing.assert_array_equal(
        done.columns["dir_x"], [s for x in range(5, 200, 13) for s in (1, -1)[:: 1 if x % 2 else -1]]
    )


def test_a_direction_that_is_always_0_tells_nothing(tmp_path: Path) -> None:
    assert "dir_x" not in imported(with_words(tmp_path, "dir_x", {1: "0", -1: "0"})).columns


def test_a_direction_of_another_axis_is_that_axis_own(tmp_path: Path) -> None:
    path = tmp_path / "foreign.csv"
    rows = [f"{x};{w};1;{d}" for x, w, d in zip(X, WAY, DEVIATION_UM, strict=True)]
    path.write_text("\n".join(["X [mm];dir_x;dir_z;Abweichung [µm]", *rows]), encoding="utf-8")
    done = imported(path)
    np.testing.assert_array_equal(done.columns["dir_x"], WAY)
    np.testing.assert_array_equal(done.columns["dir_z"], 1.0)


# --- any numbers

NUMBERS = st.sampled_from([0.0, 1.0, -1.0, 0.002, 500.0, 9999.0, 1e300, -1.7e308, float("nan")])


@settings(max_examples=300, deadline=None)
@given(
    header=st.lists(
        st.sampled_from(
            ["Soll X [mm]", "Ist X [um]", "Ist", "Soll", "Ist-Soll [mm]", "dir_x", "Richtung", "Run 1 +", "Run 1 -"]
        ),
        min_size=2, max_size=6, unique=True,
    ),
    rows=st.lists(st.lists(NUMBERS, min_size=6, max_size=6), min_size=2, max_size=8),
)  # fmt: skip
def test_any_numbers_give_a_proposal_or_one_message(
    tmp_path_factory: pytest.TempPathFactory, header: list[str], rows: list[list[float]]
) -> None:
    """Oracle: nothing but a MeasurementError may come out, and no warning."""
    path = tmp_path_factory.mktemp("any") / "any.csv"
    lines = [";".join("" if v != v else f"{v!r}" for v in row[: len(header)]) for row in rows]  # noqa: PLR0124
    path.write_text("\n".join([";".join(header), *lines]), encoding="utf-8")
    try:
        proposal = propose(path, MACHINE)
        known = {q.key: q.choices[0] if q.choices else "um" for q in proposal.open}
        import_table(path, proposal.answered(known).import_map())
    except MeasurementError:
        pass
