"""The public form of the benchmark: data sets without their truth in a folder, and a table of answers to fill in."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w

from rtec.arrays import Floats
from rtec.bench.score import VERDICTS, TrialAnswer
from rtec.bench.sets import measurements_of, model_of
from rtec.bench.trials import GROUPS, Right, Trial, build, trials
from rtec.errors import MeasurementError
from rtec.metrology.files.load import save_measurement
from rtec.model import save_model
from rtec.tomlfile import read_toml

PLAN, ANSWERS, SETS, PREDICTED = "benchmark.toml", "answers.csv", "sets", "predicted.csv"
HEAD = ("set", "verdict", "names", "claimed", "variables", "doubts", "seconds")


@dataclass(frozen=True)
class BenchmarkRange:
    """Seeds and groups of the trials.

    Attributes:
        first, end: seeds, without the end.
        groups: keys of `GROUPS`.
    """

    first: int
    end: int
    groups: tuple[str, ...] = tuple(GROUPS)

    def trials(self) -> list[Trial]:
        """All trials, in an order that does not reveal the hidden effects."""
        words = list(trials(range(self.first, self.end), self.groups))
        order = np.random.default_rng([self.first, self.end, 7]).permutation(len(words))
        return [build(*words[i]) for i in order]


def write_sets(folder: Path, of: BenchmarkRange) -> int:
    """Write data sets without their truth, and an empty table of answers.

    Args:
        folder: created if missing; it must not contain a benchmark yet.
        of: seeds and groups.

    Returns:
        Number of data sets.
    """
    made = of.trials()
    for i, trial in enumerate(made, 1):
        where = folder / SETS / _number(i)
        where.mkdir(parents=True, exist_ok=True)
        (where / "machine.toml").write_text(tomli_w.dumps(dict(trial.machine)), encoding="utf-8")
        save_model(model_of(trial), where / "model.toml")
        for m in measurements_of(trial):
            save_measurement(m, where / f"{m.name}.csv")
    _write_table(folder / ANSWERS, ((_number(i), *[""] * (len(HEAD) - 1)) for i in range(1, len(made) + 1)))
    table = {"first_seed": of.first, "end_seed": of.end, "groups": list(of.groups)}
    (folder / PLAN).write_text(tomli_w.dumps({"benchmark": table}), encoding="utf-8")
    return len(made)


def read_range(folder: Path) -> BenchmarkRange | None:
    """Seeds and groups of a folder; None where it has no benchmark.

    Raises:
        MeasurementError: its description is malformed.
    """
    file = folder / PLAN
    if not file.is_file():
        return None
    table = read_toml(file, MeasurementError).get("benchmark")
    try:
        if not isinstance(table, dict):
            raise TypeError("[benchmark] is missing")
        found = BenchmarkRange(int(table["first_seed"]), int(table["end_seed"]), tuple(map(str, table["groups"])))
    except (KeyError, TypeError, ValueError) as e:
        raise MeasurementError(f"{file}: {e}; write the data sets again into an empty folder") from e
    unknown = sorted(set(found.groups) - set(GROUPS))
    if unknown:
        raise MeasurementError(f"{file}: groups {', '.join(unknown)} are none of {', '.join(GROUPS)}")
    return found


def read_answers(folder: Path, made: Sequence[Trial]) -> dict[str, TrialAnswer]:
    """The answers of a folder by the label of their trial; empty where the table is not filled in.

    Raises:
        MeasurementError: a row is missing or malformed; the message names it.
    """
    file = folder / ANSWERS
    try:
        with file.open(encoding="utf-8", newline="") as lines:
            rows = {row["set"].strip(): row for row in csv.DictReader(lines) if row.get("set")}
    except OSError as e:
        raise MeasurementError(f"{file}: {e.strerror}; the table of answers must be there") from e
    if not any((row.get("verdict") or "").strip() for row in rows.values()):
        return {}
    out: dict[str, TrialAnswer] = {}
    for i, trial in enumerate(made, 1):
        row = rows.get(_number(i))
        if row is None:
            raise MeasurementError(f"{file}: set {_number(i)} has no row")
        answer = _answer(row, f"{file}, set {_number(i)}")
        if trial.records[0].held_back:
            answer = replace(answer, predicted=_read_predicted(folder / SETS / _number(i) / PREDICTED, trial))
        out[trial.label] = answer
    return out


def _read_predicted(file: Path, trial: Trial) -> dict[str, Floats]:
    """Predictions of a set by column, (n,); empty where there is no file."""
    wanted, rows = trial.records[0].held_back, len(trial.records[0].plan)
    if not file.is_file():
        return {}
    with file.open(encoding="utf-8", newline="") as lines:
        table = list(csv.DictReader(lines))
    try:
        found = {name: np.array([float(row[name]) for row in table]) for name in wanted}
    except (KeyError, TypeError, ValueError) as e:
        raise MeasurementError(f"{file}: {e}; a number is needed in {', '.join(wanted)} of every row") from None
    if len(table) != rows or not all(np.isfinite(v).all() for v in found.values()):
        raise MeasurementError(f"{file}: {len(table)} rows of finite numbers; the set has {rows} readings")
    return found


def _answer(row: Mapping[str, str | None], where: str) -> TrialAnswer:
    def cell(name: str) -> str:
        return (row.get(name) or "").strip()

    if cell("verdict") not in VERDICTS:
        raise MeasurementError(f"{where}: verdict {cell('verdict')!r} is none of {', '.join(VERDICTS)}")
    try:
        seconds = float(cell("seconds") or "nan")
    except ValueError:
        raise MeasurementError(f"{where}: seconds {cell('seconds')!r} is no number") from None
    names, claimed = (tuple(_name(t, where) for t in _split(cell(c))) for c in ("names", "claimed"))
    return TrialAnswer(
        cell("verdict"),
        names,
        claimed,
        frozenset(_split(cell("variables"))),
        frozenset(_split(cell("doubts"))),
        seconds,
    )


def _name(text: str, where: str) -> Right:
    effect, *rest = text.split(":")
    if not effect or len(rest) > 2:
        raise MeasurementError(f"{where}: {text!r} is no name; write effect:component or effect:component:sensor")
    return Right(effect, *rest)


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(";") if part.strip()]


def _number(i: int) -> str:
    return f"{i:04d}"


def _write_table(file: Path, rows: Iterable[Sequence[str]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as out:
        table = csv.writer(out, lineterminator="\n")
        table.writerow(HEAD)
        table.writerows(rows)
