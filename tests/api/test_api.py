"""`import rtec`: light, typed, and the same as the commands.

Oracles: the modules that a fresh interpreter holds; the JSON that the commands print; the files that they write.
"""

import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import polars as pl
import pyarrow as pa
import pytest

import rtec
from rtec.cli.main import status
from rtec.diagnosis.result import Finding
from rtec.result import Kind
from tests.support.diagnosis_examples import write_laser, write_machine

SCALE = "scale,component=EXX,axis=X,k=40"
PLAY = "backlash,component=EXX,axis=X,B=3"
FIRST, SECOND = ["scale,component=EXX,axis=X,k=40"], [SCALE, PLAY]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A machine, a laser along X of it, and a first model that lacks the play."""
    made = tmp_path_factory.mktemp("api")
    machine = write_machine(made)
    table = write_laser(made, SECOND, 4, targets={"step_mm": 37.3})
    rtec.fit(machine, table, effects="scale:EXX:axis=X", out=made / "model.toml")
    return made


def told(capsys: pytest.CaptureFixture[str], *words: str | Path) -> dict[str, Any]:
    """What a command prints with `--json`."""
    assert status([*map(str, words), "--json"]) in (0, 1)
    out: dict[str, Any] = json.loads(capsys.readouterr().out)
    return out


def test_import_loads_almost_nothing() -> None:
    """A time would depend on the machine; the number of modules does not. Oracle: an empty interpreter."""
    count = "import sys; before = set(sys.modules); import rtec; print(*sorted(set(sys.modules) - before))"
    new = subprocess.run([sys.executable, "-c", count], capture_output=True, text=True, check=True).stdout.split()
    light = {"rtec", "rtec.version", "typing", "typing.io", "typing.re", "_typing", "collections.abc"}
    assert {m for m in new if not m.startswith("__editable__")} <= light


def test_every_name_is_there_and_documented() -> None:
    """Oracle: the list in the module, and the signature that an editor shows."""
    assert set(rtec.__all__) - {"__version__"} == {name for name in dir(rtec) if not name.startswith("_")}
    for name in set(rtec.__all__) - {"__version__", "RtecError"}:
        function = getattr(rtec, name)
        assert inspect.getdoc(function), name
        hints = inspect.signature(function)
        assert all(p.annotation is not inspect.Parameter.empty for p in hints.parameters.values()), name
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = rtec.nonsense  # type: ignore[attr-defined]


def test_compare_is_the_command(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Oracle: the command's JSON; with a report its files, and the path in the result."""
    model, table = folder / "model.toml", folder / "laser-x-4.csv"
    result = rtec.compare(str(model), str(table), report=str(tmp_path / "one"))
    printed = told(capsys, "compare", model, table)
    assert json.loads(json.dumps(result.to_dict())) == printed | {"report": str(tmp_path / "one" / "report.html")}
    assert sorted(p.name for p in (tmp_path / "one").iterdir())[-2:] == ["report.html", "result.json"]
    assert rtec.compare(rtec.load_model(model), [table]).to_dict() == printed


def test_diagnose_is_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the command's JSON; and the stages are told while it goes on."""
    model, table = folder / "model.toml", folder / "laser-x-4.csv"
    stages: list[tuple[str, int, int]] = []
    result = rtec.diagnose(model, table, progress=lambda *stage: stages.append(stage))
    assert json.loads(json.dumps(result.to_dict())) == told(capsys, "diagnose", model, table)
    assert stages
    assert all(what and 0 <= done <= total for what, done, total in stages if total)


def test_fit_add_and_improve_are_the_commands(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Oracle: the commands' JSON and the model files, byte by byte."""
    machine, table = folder / "machine.toml", folder / "laser-x-4.csv"
    one, other = tmp_path / "model.toml", tmp_path / "other.toml"
    fitted = rtec.fit(machine, [table], effects=["scale:EXX:axis=X"], out=one)
    printed = told(capsys, "fit", machine, table, "--effects", "scale:EXX:axis=X", "-o", other)
    assert json.loads(json.dumps(fitted.to_dict())) == {
        **printed,
        "model": {**printed["model"], "name": "model"},
        "model_file": str(one),
    }
    assert one.read_bytes() == other.read_bytes().replace(b'"other"', b'"model"')
    more, less = tmp_path / "more.toml", tmp_path / "less.toml"
    added = rtec.add(one, table, "backlash", component="EXX", machine=machine, out=more)
    words = ("add", one, "backlash", "--component", "EXX", "--machine", machine, "--data", table, "-o", less)
    assert json.loads(json.dumps(added.to_dict())) == {**told(capsys, *words), "model_file": str(more)}
    assert more.read_bytes() == less.read_bytes()
    better = rtec.improve(one, table, machine=machine, out=tmp_path / "best.toml")
    last = ("improve", one, table, "--machine", machine, "--yes", "-o", tmp_path / "best.toml")
    assert json.loads(json.dumps(better.to_dict())) == told(capsys, *last)


def test_a_finding_is_added_as_it_is(folder: Path) -> None:
    """Oracle: the play that was simulated, 3 µm between the directions, within 4 standard errors."""
    found = rtec.diagnose(folder / "model.toml", folder / "laser-x-4.csv", only=["backlash"])
    best: Finding = found.findings[0]
    added = rtec.add(folder / "model.toml", folder / "laser-x-4.csv", best)
    (play,) = [e for e in added.model.effects if e.effect.effect == "backlash"]
    assert abs(play.values["B"] - 3.0) < 4.0 * play.errors["B"]
    assert added.written == {"model_file": None, "report": None}


def test_an_expression_is_added_by_its_numbers(folder: Path) -> None:
    """Oracle: the same effect by the texts of the command."""
    model, table, text = folder / "model.toml", folder / "laser-x-4.csv", "A*d_x*exp(-s_x/s0)"
    one = rtec.add(model, table, expr=text, component="EXX", params={"s0": (50.0, 5.0, 500.0)})
    other = rtec.add(model, table, expr=text, component="EXX", params=["s0=50:5..500"])
    assert one.model.hash == other.model.hash


def test_simulate_writes_what_it_gives(folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """Oracle: the command's files, byte by byte, and the measurement read back."""
    machine = folder / "machine.toml"
    result = rtec.simulate(
        machine, "laser_linear", axis="X", effects=FIRST, seed=3, out=tmp_path / "a", changes={"cycles": 2}
    )
    words = ("simulate", machine, "-i", "laser_linear", "--axis", "X", "--effect", SCALE, "--seed", "3")
    printed = told(capsys, *words, "--cycles", "2", "-o", tmp_path / "b")
    names = {"table": str(tmp_path / "a.csv"), "toml": str(tmp_path / "a.toml")}
    assert json.loads(json.dumps(result.to_dict())) == {**printed, **names}
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    again = rtec.load_measurement(tmp_path / "a", str(machine))
    np.testing.assert_array_equal(again.readings["reading_um"], result.measurement.readings["reading_um"])


def test_plan_is_the_command(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the command's JSON."""
    machine, table = folder / "machine.toml", folder / "laser-x-4.csv"
    answer = rtec.plan(machine, table, effects=["scale:EXX", "backlash:EXX"], suggest=False)
    words = ("plan", machine, table, "--effects", "scale:EXX,backlash:EXX", "--no-suggest")
    assert json.loads(json.dumps(answer.to_dict())) == told(capsys, *words)
    assert list(answer.to_frame("pandas")["name"]) == [p["name"] for p in answer.facts()["parameters"]]


@pytest.mark.parametrize("kind", ["pandas", "polars", "arrow"])
def test_frames(folder: Path, kind: Kind) -> None:
    """Oracle: the libraries' own types, and the table that the measurement was read from."""
    of: dict[str, type] = {"pandas": pd.DataFrame, "polars": pl.DataFrame, "arrow": pa.Table}
    measured = rtec.load_measurement(folder / "laser-x-4.csv", folder / "machine.toml")
    table: Any = measured.to_frame(kind)
    assert of[kind] in type(table).__mro__
    read = pd.read_csv(folder / "laser-x-4.csv")
    np.testing.assert_array_equal(np.asarray(table["reading_um"]), read["reading_um"])
    np.testing.assert_array_equal(np.asarray(table["x_mm"]), read["x_mm"])
    compared = rtec.compare(folder / "model.toml", measured)
    rows: Any = compared.to_frame(kind)
    assert np.asarray(rows["rms_residual_um"]).tolist() == [compared.items[0].left.rms]


def test_figures_and_notebooks(folder: Path) -> None:
    """Oracle: matplotlib's own figure, with the axes' names; the verdict in the notebook's cell."""
    model, table = folder / "model.toml", folder / "laser-x-4.csv"
    result = rtec.compare(model, table)
    figure = result.plot()
    assert figure.axes[-1].get_xlabel().startswith("X, mm")
    assert result.plot() is figure
    with pytest.raises(rtec.RtecError, match="no figure 'none'; there are: laser-x-4-position"):
        result.plot("none")
    assert "The residual is" in result._repr_html_()
    assert "<table>" in result._repr_html_()
    known = rtec.load_model(model)
    assert "scale(EXX, X)" in known._repr_html_()
    assert list(known.to_frame("pandas")["unit"]) == ["um_per_m"]
    measured = rtec.load_measurement(table, folder / "machine.toml")
    assert measured.plot().axes[0].get_ylabel() == "reading, µm"
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]


def test_a_console_shows_a_line_not_every_number(folder: Path) -> None:
    """Oracle: the length; 10 000 readings make no difference."""
    measured = rtec.load_measurement(folder / "laser-x-4.csv", folder / "machine.toml")
    assert repr(measured).startswith("Measurement(name='laser-x-4', instrument=LaserLinear(")
    assert len(repr(measured)) < 500
    made = rtec.simulate(folder / "machine.toml", "laser_linear", axis="X", changes={"cycles": 1})
    assert len(repr(made)) < 600


def test_the_message_says_what_to_do(folder: Path, tmp_path: Path) -> None:
    """Oracle: the messages of the commands; nothing was written."""
    with pytest.raises(rtec.RtecError, match="no such file"):
        rtec.load_machine(tmp_path / "none.toml")
    with pytest.raises(rtec.RtecError, match=r"alpha 0.7: above 0 and at most 0.5"):
        rtec.diagnose(folder / "model.toml", folder / "laser-x-4.csv", alpha=0.7)
    with pytest.raises(rtec.RtecError, match="no effect 'scal'"):
        rtec.diagnose(folder / "model.toml", folder / "laser-x-4.csv", only=["scal"])
    with pytest.raises(rtec.RtecError, match="is read by this fit"):
        rtec.fit(folder / "machine.toml", folder / "laser-x-4.csv", out=folder / "machine.toml")


def test_a_printed_result_is_its_verdict_and_its_table(folder: Path) -> None:
    """Oracle: the page of the report, which the command line prints."""
    result = rtec.compare(folder / "model.toml", folder / "laser-x-4.csv")
    page, text = result.page(figures=False), str(result)
    assert text.startswith(page.lead)
    head, _, first = (text.removeprefix(page.lead).strip("\n")).partition("\n")
    assert head.split() == " ".join(page.brief.table.head).split()
    assert first.split("\n")[0].split()[0] == "laser-x-4"
    assert len({len(line) for line in text.splitlines()[-2:]}) == 1  # columns are in line
    for thing in (
        rtec.load_measurement(folder / "laser-x-4.csv", folder / "machine.toml"),
        rtec.load_model(folder / "model.toml"),
    ):
        assert len(str(thing).splitlines()) < 60
        assert str(thing) == f"{thing}"


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda m, x: rtec.compare(x, m), "a Measurement is given where a model or its file is expected"),
        (lambda m, _: rtec.diagnose(m, m), "a Model is given where a measurement or its file is expected"),
        (rtec.fit, "a Model is given where a machine or its file is expected"),
        (
            lambda m, x: rtec.compare(m, [x, 3]),  # type: ignore[list-item]
            "an int is given where a measurement or its file is expected",
        ),
    ],
)
def test_arguments_in_the_wrong_order_are_named(call: Any, said: str, folder: Path) -> None:
    model = rtec.load_model(folder / "model.toml")
    laser = rtec.load_measurement(folder / "laser-x-4.csv", folder / "machine.toml")
    with pytest.raises(rtec.RtecError, match=said):
        call(model, laser)
