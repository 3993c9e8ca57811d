"""Data sets for another program, and its answers. Oracle: what was written, and rows counted by hand."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from rtec.bench.folder import ANSWERS, HEAD, BenchmarkRange, read_answers, read_range, write_sets
from rtec.bench.score import HeldBack, TrialAnswer, confidently_wrong, held_back, score
from rtec.bench.sets import measurements_of
from rtec.bench.trials import Right, Trial, build
from rtec.cli.main import status
from rtec.errors import MeasurementError
from rtec.machine import load_machine
from rtec.metrology.files.load import load_measurements
from rtec.model import load_model

ONE = BenchmarkRange(3, 4, ("lean", "wrong_file"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("bench") / "mytool"
    assert write_sets(made, ONE) == 14
    return made


def test_the_sets_are_files_that_the_program_reads(folder: Path) -> None:
    """Oracle: the readings that were made."""
    trial = ONE.trials()[0]
    where = folder / "sets" / "0001"
    machine = load_machine(where / "machine.toml")
    load_model(where / "model.toml", machine)
    (read,) = load_measurements(sorted(where.glob("*.csv")), machine)
    (made,) = measurements_of(trial)
    assert read.matrix() == pytest.approx(made.matrix(), abs=1e-6)


def test_no_file_tells_the_truth(folder: Path) -> None:
    words = ("abbe", "servo", "swapped", "hidden", "wrong_", "moved_origin")
    files = list((folder / "sets").rglob("*.*"))
    assert len(files) > 3
    for file in files:
        text = file.read_text(encoding="utf-8").replace("servo_lag", "")
        assert not [w for w in words if w in text], file


def write_answers(folder: Path, made: Sequence[Trial], answers: Mapping[str, TrialAnswer]) -> None:
    """Answers as another program writes them."""

    def joined(names: Iterable[Right]) -> str:
        return ";".join(":".join(filter(None, (n.effect, n.component, n.sensor))) for n in names)

    rows = []
    for i, trial in enumerate(made, 1):
        a = answers[trial.label]
        sets = (";".join(sorted(names)) for names in (a.variables, a.doubts))
        rows.append([f"{i:04d}", a.verdict, joined(a.names), joined(a.claimed), *sets, f"{a.seconds:.3f}"])
        if a.predicted:
            where = folder / "sets" / f"{i:04d}"
            where.mkdir(parents=True, exist_ok=True)
            pd.DataFrame(a.predicted).to_csv(where / "predicted.csv", index=False)
    pd.DataFrame(rows, columns=HEAD).to_csv(folder / ANSWERS, index=False)


def test_answers_go_there_and_back(folder: Path, tmp_path: Path) -> None:
    made = ONE.trials()
    assert read_range(folder) == ONE
    assert read_answers(folder, made) == {}
    given = {
        t.label: TrialAnswer(
            "ambiguous", (Right("scale", "EXX"), Right("axis_expansion", "EXX", "T_nut")), (Right("scale", "EXX"),),
            frozenset({"x"}), frozenset({"alias"}), 0.5,
        )
        for t in made
    }  # fmt: skip
    write_answers(tmp_path, made, given)
    assert read_answers(tmp_path, made) == given


def test_predictions_go_there_and_back_and_are_held_against_the_noise(tmp_path: Path) -> None:
    """Oracles: the readings that were held back are their own best prediction; without an effect its size stays."""
    asked = BenchmarkRange(3, 4, ("improve",))
    made = asked.trials()
    write_sets(tmp_path, asked)
    given = {}
    for t in made:
        (record,) = t.records
        (measured,) = measurements_of(t)
        back = np.isnan(measured.matrix())
        assert np.array_equal(back, np.isfinite(np.array(list(record.held_back.values()))))
        assert 0.2 < back.mean() < 0.3
        known = {n: np.nan_to_num(v - record.noise[n]) for n, v in record.held_back.items()}
        given[t.label] = TrialAnswer("missing_effect", predicted=known)
        assert held_back(t, given[t.label]).error == pytest.approx(noise_of(t))
        assert held_back(t, TrialAnswer("nothing_missing")).error == np.inf
    write_answers(tmp_path, made, given)
    read = read_answers(tmp_path, made)
    for t in made:
        assert held_back(t, read[t.label]).error == pytest.approx(noise_of(t))
    rows = {r.what: (r.hits, r.total) for r in score(made, read)}
    assert rows["held-out error at most 1.1 × that of the true law, after improving"] == (12, 12)
    assert rows["held-out error at most 1.1 × the noise, after improving"] == (12, 12)
    assert rows["… bursts"] == (5, 5)
    assert rows["… warm up"] == (2, 2)
    file = tmp_path / "sets" / "0001" / "predicted.csv"
    file.write_text("\n".join(file.read_text(encoding="utf-8").splitlines()[:-1]), encoding="utf-8")
    with pytest.raises(MeasurementError, match="the set has"):
        read_answers(tmp_path, made)


def noise_of(trial: Trial) -> float:
    """Root mean square of the noise drawn in held-back readings, outliers left out."""
    (record,) = trial.records
    drawn = [record.noise[n][np.isfinite(v)] for n, v in record.held_back.items()]
    return float(np.sqrt(sum(np.nanvar(d) for d in drawn)))


def reached(what: str, seed: int) -> HeldBack:
    """What can be reached on a data set, over the noise that was drawn there."""
    trial = build("improve", what, seed)
    found = held_back(trial, TrialAnswer("nothing_missing"))
    noise = noise_of(trial)
    return HeldBack(found.error, found.noise / noise, found.reachable / noise)


@pytest.mark.parametrize("what", ["bursts_load_shift", "any_plain_bow", "bursts_servo"])
def test_a_law_of_recorded_channels_reaches_the_noise(what: str) -> None:
    """Oracle: the noise that was drawn. Four numbers fitted to some 600 readings add a part of a percent."""
    for seed in range(4):
        found = reached(what, seed)
        assert found.noise == pytest.approx(1.0)
        assert found.reachable == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("what", ["bursts_warm_screw", "bursts_spindle_heat", "warm_up_warm_screw"])
def test_what_nobody_recorded_is_not_asked_for(what: str) -> None:
    """Oracle: the noise that was drawn, and a little for bodies without a sensor; never less than the noise."""
    for seed in range(4):
        assert 1.0 <= reached(what, seed).reachable * (1.0 + 1e-9) < 1.2


def test_no_law_fits_what_it_is_not() -> None:
    """The yardstick is no excuse: with the law of another effect much more would be allowed."""
    trial = build("improve", "bursts_servo", 3)
    law = {"reading_um": trial.law["reading_um"][:, :2]}
    other = held_back(replace(trial, law=law), TrialAnswer("nothing_missing"))
    assert other.reachable > 2.0 * held_back(trial, TrialAnswer("nothing_missing")).reachable


def test_no_held_back_reading_is_in_the_files(tmp_path: Path) -> None:
    """Oracle: their cells are empty."""
    write_sets(tmp_path, BenchmarkRange(3, 4, ("improve",)))
    for file in (tmp_path / "sets").glob("*/record.csv"):
        rows = list(csv.DictReader(file.read_text(encoding="utf-8").splitlines()))
        names = [n for n in rows[0] if n.startswith("reading")]
        empty = [r["run"] for r in rows if not any(r[n] for n in names)]
        assert set(empty) == {r["run"] for r in rows if int(r["run"]) % 4 == 0}


def test_the_score_counts_what_is_right_and_what_is_asserted_and_false() -> None:
    right, wrong = (build("lean", "servo", s) for s in (1, 2))
    pitch, quiet = build("wrong_file", "wrong_pitch", 1), build("quiet", "white_line", 1)
    answers = {
        right.label: TrialAnswer("missing_effect", (Right("servo_lag", "EXX"),)),
        wrong.label: TrialAnswer("missing_effect", (Right("stribeck", "EXX"), Right("servo_lag", "EXX"))),
        pitch.label: TrialAnswer("ambiguous", doubts=frozenset({"wrong_pitch"})),
        quiet.label: TrialAnswer("nothing_missing"),
    }
    rows = {r.what: (r.hits, r.total) for r in score([right, wrong, pitch, quiet], answers)}
    assert rows["one effect, natural size: the right name comes first"] == (1, 2)
    assert rows["one effect, natural size: the right name among three"] == (2, 2)
    assert rows["wrong pitch: it is said"] == (1, 1)
    assert rows["nothing hidden, white: an effect is named"] == (0, 1)
    assert rows["asserted without rivals and false"] == (1, 4)
    assert confidently_wrong(wrong, answers[wrong.label])


def test_the_command_writes_then_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    order = ["bench", "discovery", "--score", str(tmp_path / "tool"), "--seeds", "5:6", "--only", "one_pass"]
    assert status(order) == 0
    assert "1 data sets" in capsys.readouterr().out
    assert status(order) == 2
    assert "not filled in" in capsys.readouterr().err
    table = tmp_path / "tool" / ANSWERS
    rows = list(csv.reader(table.read_text(encoding="utf-8").splitlines()))
    rows[1][1], rows[1][5] = "undecided", "one_pass"
    table.write_text("\n".join(",".join(r) for r in rows) + "\n", encoding="utf-8")
    assert status(order) == 0
    assert "2 of 2 goals are met" in capsys.readouterr().out
    rows[1][1] = "maybe"
    table.write_text("\n".join(",".join(r) for r in rows) + "\n", encoding="utf-8")
    assert status(order) == 2
    assert "set 0001: verdict 'maybe' is none of nothing_missing" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["3", "4:4", "a:b"])
def test_seeds_that_are_no_range_are_refused(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert status(["bench", "discovery", "--seeds", text]) == 2
    assert "1:11" in capsys.readouterr().err


def test_rtec_scores_itself(capsys: pytest.CaptureFixture[str]) -> None:
    """One quiet set of each form on a line: nothing is asserted."""
    assert status(["bench", "discovery", "--seeds", "1:2", "--only", "contradicting", "--json"]) == 0
    assert '"met": true' in capsys.readouterr().out
