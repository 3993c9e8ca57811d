"""The harness: what it counts, tried with methods whose answers are known before."""

from collections.abc import Sequence
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

from rtec.cli.screen import Console
from rtec.metrology.measurement import Measurement
from rtec.model import FittedEffect, Model
from tests.discovery import tables, translate, work
from tests.discovery.__main__ import main
from tests.discovery.figures import cut, figures
from tests.discovery.generator.cases import BY_NAME, Case, single
from tests.discovery.generator.dataset import build
from tests.discovery.generator.truths import TRUTHS
from tests.discovery.intervals import Share
from tests.discovery.methods import NOTHING, Answer, Method, Name
from tests.discovery.score import Outcome, judge

CYCLIC = single(4, BY_NAME["cyclic_screw"])


def _line(case: Case) -> str:
    return build(case).campaign.axis


def _says(answer: Answer) -> Method:
    return lambda _model, _measurements: answer


def _claims(*names: Name, group: int = 1) -> Answer:
    return Answer(names, True, names[:group], ())


def test_a_right_answer_is_right_and_a_wrong_one_wrong() -> None:
    """Oracle: answers written down here."""
    a = _line(CYCLIC)
    right, wrong = Name("cyclic_screw", f"E{a}{a}"), Name("backlash_load", f"E{a}{a}")
    first = judge(CYCLIC, _says(_claims(right, wrong)))
    assert (first.right, first.in_group) == (1, True)
    second = judge(CYCLIC, _says(_claims(wrong, right)))
    assert (second.right, second.in_group) == (2, False)
    both = judge(CYCLIC, _says(_claims(wrong, right, group=2)))
    assert (both.right, both.in_group) == (2, True)
    none = judge(CYCLIC, _says(NOTHING))
    assert (none.right, none.in_group, none.answer.accepted) == (0, False, False)


def test_the_right_effect_on_a_component_that_reads_otherwise_is_wrong() -> None:
    """Oracle: kinematics: along the beam a displacement is one wherever it comes from; a turn is none."""
    case = next(c for c in (single(s, BY_NAME["cyclic_screw"]) for s in range(9)) if _line(c) != "Z")
    a = _line(case)
    same = judge(case, _says(_claims(Name("cyclic_screw", f"E{a}0spindle"))))
    assert same.right == 1
    other = judge(case, _says(_claims(Name("cyclic_screw", f"EC{a}"))))
    assert other.right == 0


def test_another_name_counts_with_its_sensor_only() -> None:
    """Oracle: the list beside the truth: mount_expansion is spindle growth only by the spindle's own sensor."""
    case = single(4, BY_NAME["spindle_growth"])
    for sensor, place in (("T_spindle", 1), ("T_air", 0)):
        name = Name("mount_expansion", "EZ0spindle", sensor)
        assert judge(case, _says(_claims(name))).right == place


def test_an_improved_model_with_the_true_effect_is_near_the_truth() -> None:
    """Oracle: the true shape fitted by least squares; the program's own sine is nearly that."""

    def improve(model: Model, measurements: Sequence[Measurement]) -> tuple[Model, list[Name], str]:
        a = measurements[0].instrument.axis or ""
        table = {"effect": "cyclic_screw", "component": f"E{a}{a}", "axis": a, "harmonics": 3}
        effect, (m,) = translate.made(table), measurements
        pitch = m.machine.axis(a).pitch_mm or 0.0
        basis = np.stack(list(effect.basis(m.machine, m.state(), {"pitch": pitch})), axis=1)
        left = m.matrix()[0] - translate.said_by(model, m)[0]
        seen = np.isfinite(left)
        design = np.column_stack([basis, np.ones(len(basis))])
        found = np.linalg.lstsq(design[seen], left[seen], rcond=None)[0]
        values = {p.name: float(v) for p, v in zip(effect.coefficients(m.machine), found, strict=False)}
        fitted = FittedEffect(effect, values, {"pitch": pitch})
        return Model(model.machine, (*model.effects, fitted)), [Name.of(effect)], "at_floor"

    outcome = judge(CYCLIC, _says(NOTHING), improve)
    assert (outcome.found, outcome.wrong) == (1, 0)
    assert outcome.oracle < outcome.after < 0.3 * outcome.before
    assert outcome.at_floor
    idle = judge(CYCLIC, _says(NOTHING), lambda model, _: (model, [], "stopped"))
    assert idle.after == pytest.approx(idle.before, rel=0.15)
    assert not idle.at_floor


def test_only_true_variables_count_for_the_unknown() -> None:
    """Oracle: the variables that the generator states: position along the line, and the work piece's weight."""
    case = Case("outside", 6, "laser", "white", ("loaded_wave",))
    along = _line(case).lower()
    other = next(a for a in "xyz" if a != along)
    for channels, right in (
        ((along,), True),
        ((along, "load_kg"), True),
        ((along, other), False),
        (("T_air",), False),
        ((), False),
    ):
        answer = Answer((), False, (), channels)
        assert judge(case, _says(answer)).names_true_only == right


def test_a_crash_is_counted_and_shown_not_hidden() -> None:
    """Oracle: a method that always raises."""

    def broken(_model: Model, _measurements: Sequence[Measurement]) -> Answer:
        raise ZeroDivisionError("on purpose")

    outcome = judge(CYCLIC, broken)
    assert "on purpose" in outcome.failure
    crashed = next(f for f in figures([outcome]) if f.name == "crashed")
    assert crashed.met is False
    console = Console(width=140, record=True, file=StringIO())
    tables.show(console, [outcome], "t")
    assert "on purpose" in console.export_text()


def test_figures_count_what_they_say() -> None:
    """Oracle: counted by hand."""
    yes = _claims(Name("scale", "EXX"))
    clean = [Outcome(Case("clean", i, "laser", "ou"), yes if i < 2 else NOTHING) for i in range(10)]
    table = {f.name: f for f in figures(clean)}
    line = table["nothing hidden, ou: an effect is claimed"]
    assert (line.share.hits, line.share.total, line.met) == (2, 10, False)
    pair = Outcome(Case("pairs", 1, "laser", "ou", ("scale", "backlash")), yes, found=1, wrong=1)
    table = {f.name: f for f in figures([pair])}
    assert table["pairs improved: both found"].share == Share(0, 1)
    assert table["pairs improved: what was added is right"].share == Share(1, 2)
    half = Outcome(single(1, TRUTHS[0]), yes, before=2.0, after=1.0, oracle=0.5)
    assert cut([half]) == (0.5, 0.75)


def test_intervals_are_those_of_clopper_and_pearson() -> None:
    """Oracle: scipy's own exact binomial test."""
    from scipy.stats import binomtest

    for hits, total in ((0, 300), (9, 300), (36, 40), (40, 40)):
        known = binomtest(hits, total).proportion_ci(0.95, method="exact")
        assert Share(hits, total).interval() == pytest.approx((known.low, known.high), abs=1e-9)
    assert str(Share(0, 0)) == "-"


def test_an_interrupt_gives_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: the third of five sets is interrupted; two are there."""
    sets = [Case("clean", i, "laser", "white") for i in range(5)]

    def one(_method: str, case: Case) -> Outcome:
        if case.seed == 2:
            raise KeyboardInterrupt
        return Outcome(case, NOTHING)

    monkeypatch.setattr(work, "one", one)
    told: list[tuple[int, int]] = []
    done = work.run(sets, "naive", 1, lambda d, t: told.append((d, t)))
    assert [o.case.seed for o in done] == [0, 1]
    assert told == [(0, 5), (1, 5), (2, 5)]


def test_the_command_writes_all_it_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the file against the table; a method that never says anything."""
    import json

    monkeypatch.setitem(work.METHODS, "naive", (_says(NOTHING), None))
    target = tmp_path / "out.json"
    status = main(
        ["--seeds", "1000:1002", "--only", "singles", "--method", "naive", "--jobs", "1", "--json", str(target)]
    )
    assert status == 0
    facts = json.loads(target.read_text(encoding="utf-8"))
    assert facts["seeds"] == [1000, 1002]
    assert len(facts["sets"]) == 2
    assert "seeds 1000 to 1001" in capsys.readouterr().out


def test_two_processes_give_what_one_gives() -> None:
    """Oracle: the same cases in this process."""
    sets = [Case("clean", i, "drift", "white") for i in range(3)]
    apart = work.run(sets, "naive", 2, lambda _done, _total: None)
    here = work.run(sets, "naive", 1, lambda _done, _total: None)
    assert [o.case for o in apart] == sets
    assert [(o.answer, o.held_out, o.failure) for o in apart] == [(o.answer, o.held_out, o.failure) for o in here]
