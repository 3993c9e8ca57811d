"""What a worker gives the pages. Oracles: the public functions of rtec on the same files; the wrong readings put in."""

from pathlib import Path

import numpy as np
import pytest

import rtec
from rtec.cli.main import status
from rtec.tasks import model as model_tasks
from tests.studio.studio_rig import MACHINE, simulated


class Silent:
    """Takes reports, and has no answer."""

    def stage(self, what: str, done: int, total: int) -> None:
        """Nothing is shown."""

    def ask(self, question: object) -> None:
        """Nobody is asked."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("tasks")
    simulated(made, "laser", 5, "--cycles", "3", "--outliers", "0.01")
    assert status(["fit", str(MACHINE), str(made / "laser.csv"), "--effects", "scale", "-o", str(made / "m.toml")]) == 0
    return made


def test_a_view_of_a_comparison_is_the_comparison(folder: Path) -> None:
    """Residuals, floor and facts are those of `rtec.compare`; every wrong reading is where its row is in the table."""
    model, file = rtec.load_model(folder / "m.toml", MACHINE), folder / "laser.csv"
    view = model_tasks.compare(Silent(), model, [file], folder / "m.toml")
    known = rtec.compare(model, [file])
    assert view.facts == known.to_dict()
    (series,) = view.series
    assert view.tiles == (tuple(known.page(figures=False).numbers),)
    assert np.array_equal(series.residuals, known.traces.left)
    assert series.floor == known.items[0].floor
    assert len(view.outliers) > 0
    table = rtec.load_measurement(file, MACHINE)
    for o in view.outliers:
        assert o.channels["X, mm"] == table.channels["x"][o.row - 1]
        assert o.row not in series.row


class Asked(Silent):
    """Keeps what it is asked, and how far the work was."""

    def __init__(self) -> None:
        self.stages: list[str] = []
        self.asked: list[tuple[object, list[str]]] = []

    def stage(self, what: str, done: int, total: int) -> None:
        """Kept."""
        self.stages.append(f"{what} {done}/{total}")

    def ask(self, question: object) -> None:
        """Kept."""
        self.asked.append((question, list(self.stages)))


def test_of_very_many_readings_the_residual_comes_before_its_noise(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Oracles: `rtec.compare`'s residual; the stages of the work, of which the noise and the regions come later."""
    model, file = rtec.load_model(folder / "m.toml", MACHINE), folder / "laser.csv"
    few, many = Asked(), Asked()
    model_tasks.compare(few, model, [file], folder / "m.toml")
    assert few.asked == []
    monkeypatch.setattr(model_tasks, "MANY", 1)
    view = model_tasks.compare(many, model, [file], folder / "m.toml")
    ((told, before),) = many.asked
    assert isinstance(told, model_tasks.ResidualKnown)
    assert before == many.stages[: len(before)]
    assert [s for s in before if s.startswith("finding the noise")] == []
    assert [s for s in many.stages if s.startswith("finding the noise")] != []
    (early,), (late,) = told.series, view.series
    assert np.array_equal(early.residuals, late.residuals)
    assert np.isnan(early.floor)
    assert early.residual == late.residual == pytest.approx(rtec.compare(model, [file]).items[0].left.rms)


def test_a_measurement_that_cannot_be_read_says_why_in_the_list(folder: Path, tmp_path: Path) -> None:
    """The others are listed all the same. Oracle: the numbers of the simulation."""
    for end in (".csv", ".toml"):
        (tmp_path / f"good{end}").write_bytes((folder / f"laser{end}").read_bytes())
        (tmp_path / f"bad{end}").write_bytes((folder / f"laser{end}").read_bytes().replace(b"time_s", b"tyme_s"))
    good, bad = model_tasks.summaries(Silent(), tmp_path, ["good.csv", "bad.csv"], MACHINE)
    assert (good.instrument, good.axis, good.runs, good.trouble) == ("laser_linear", "X", 27, "")
    assert good.span["X"][1] - good.span["X"][0] == pytest.approx(186.4, abs=30.0)
    assert "time_s" in bad.trouble


def test_a_preview_takes_what_the_expression_explains(folder: Path) -> None:
    """Oracle: the hidden play, of which `B*d_x` is the exact shape; and a sentence for what cannot be read."""
    model = rtec.load_model(folder / "m.toml", MACHINE)
    request = model_tasks.EffectRequest("", "EXX", (), "B*d_x", ())
    shown = model_tasks.preview(Silent(), model, request, [folder / "laser.csv"])
    assert _removed(shown) > 90.0
    assert "drawn on" not in shown.words  # there is no other measurement
    with pytest.raises(rtec.RtecError, match="nonsense"):
        model_tasks.preview(
            Silent(), model, model_tasks.EffectRequest("", "EXX", (), "A*nonsense(x)", ()), [folder / "laser.csv"]
        )


def _removed(shown: model_tasks.PreviewView) -> float:
    """The share of the mean square in a preview's words, percent."""
    return float(shown.words.split("removes ")[1].split(" %")[0])


def test_a_preview_counts_all_readings_and_names_the_measurement_of_its_curve(folder: Path, tmp_path: Path) -> None:
    """Oracle: least squares by hand on the tables: the model's scale and a zero of each run, with and without B*d_x."""
    model = rtec.load_model(folder / "m.toml", MACHINE)
    other = simulated(
        tmp_path, "wavy", 6, "--cycles", "3", "--effect", "polynomial_position,component=EXX,axis=X,c1=0,c2=9"
    )
    files = [folder / "laser.csv", other]
    shown = model_tasks.preview(Silent(), model, model_tasks.EffectRequest("", "EXX", (), "B*d_x", ()), files)
    tables = [rtec.load_measurement(f, MACHINE) for f in files]
    outliers = model_tasks.compare(Silent(), model, files, folder / "m.toml").outliers
    keep = [~np.isin(np.arange(len(m)) + 1, [o.row for o in outliers if o.measurement == m.name]) for m in tables]
    x, way, reading = (
        np.concatenate([{**m.channels, **m.readings}[c][k] for m, k in zip(tables, keep, strict=True)])
        for c in ("x", "d_x", "reading_um")
    )
    run = np.concatenate([m.run[k] + 1000 * i for i, (m, k) in enumerate(zip(tables, keep, strict=True))])
    zeros = (run[:, None] == np.unique(run)).astype(float)
    left = [reading - c @ np.linalg.lstsq(c, reading)[0] for c in (np.c_[zeros, x], np.c_[zeros, x, way])]
    by_hand = 100.0 * (1.0 - np.mean(left[1] ** 2) / np.mean(left[0] ** 2))
    assert by_hand < 80.0  # of the first table alone it is over 90 %
    assert _removed(shown) == pytest.approx(by_hand, abs=3.0)
    assert shown.words.endswith("The curve is drawn on laser, where it explains most.")
    assert shown.evidence.title == "B*d_x, in laser"
