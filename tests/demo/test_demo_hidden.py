"""The second story of `rtec demo`: a fault is hidden in the machine, found, added, and the tool tip's error falls."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtec.cli.main import status
from rtec.correction.flags import MODE_OFF
from rtec.demo import second_story as later_story
from rtec.demo import training
from rtec.demo.day import Plan
from rtec.demo.hidden import FAULTS, Here, draw, with_fault, with_play
from rtec.demo.live import corrected
from rtec.demo.second_story import Later, by_part_um, later_sections, later_words, tell_later, tip_rms_um
from rtec.demo.story import MACHINE_FILE, TRUTH_FILE, config_folder
from rtec.errors import ConfigError
from rtec.machine import load_machine
from rtec.model import Model, load_model
from rtec.report.page import Page, render
from rtec.result import plain
from rtec.sim.machine import SimulatedMachine
from rtec.sim.truth import load_truth

CONFIGS = config_folder()
MACHINE = load_machine(CONFIGS / MACHINE_FILE)
SHORT = Plan(warm_h=0.5, night_h=0.0)


def shipped() -> Model:
    return load_model(CONFIGS / "models" / "turning-centre.toml", MACHINE)


@pytest.fixture(scope="module")
def told() -> Later:
    """One story with two parts; the probe visits two stations of three."""
    with pytest.MonkeyPatch.context() as m:
        m.setattr(later_story, "LATER_PLAN", SHORT)
        m.setattr(training, "SHORT", replace(training.SHORT, z_step_mm=37.3, x_step_mm=17.9))
        return tell_later(shipped(), CONFIGS / TRUTH_FILE, 7, "gear", 1, lambda *_: None)


@pytest.mark.parametrize("name", list(FAULTS))
def test_a_fault_moves_the_tip_as_it_says(name: str) -> None:
    """Oracle: a shift along the component's letter; warm machine, both directions."""
    fault, truth = draw(3, name), load_truth(CONFIGS / TRUTH_FILE)
    truth = with_play(truth, fault)
    sound, faulty = (SimulatedMachine(MACHINE, truth, 5) for _ in range(2))
    with_fault(faulty, fault, 5)
    for sim in (sound, faulty):
        sim.work(5400, 2500.0, 0.5)
    at = np.array([[30.0, 60.0], [30.0, 60.0], [150.0, 390.0], [150.0, 390.0]])
    way = np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    moved = faulty.geometric_error_at_um(at, way) - sound.geometric_error_at_um(at, way)
    bodies = (*sound.thermal.bodies, "air")
    here = Here(
        {"X": at[:, 0], "Z": at[:, 1]},
        {"X": way[:, 0], "Z": way[:, 1]},
        dict(zip(bodies, sound.thermal.body_degc, strict=True)),
    )
    error = fault.error(here)
    expected = np.outer(error, np.eye(3)["XYZ".index(fault.component[1])])
    np.testing.assert_allclose(moved, expected, atol=2e-3)
    assert np.abs(error).max() > 0.5


def test_faults_are_drawn_by_their_seed() -> None:
    """Oracle: the same words twice; over many seeds every fault comes up."""
    assert draw(4).words == draw(4).words
    assert {draw(seed).name for seed in range(60)} == set(FAULTS)
    assert draw(4, "bed").name == "bed"
    assert draw(4, "bed").words != draw(5, "bed").words
    with pytest.raises(ConfigError, match="hot-nut"):
        draw(1, "hotnut")


def test_the_controller_cannot_see_the_fault() -> None:
    """Oracle: the same hours without correction: the encoders show the same, the tip does not."""
    model, fault = shipped(), draw(3, "loose-gib")
    runs = [corrected(model, CONFIGS / TRUTH_FILE, 5, SHORT, MODE_OFF, fault=f)[0] for f in (None, fault)]
    np.testing.assert_array_equal(runs[0].raw_counts, runs[1].raw_counts)
    np.testing.assert_array_equal(runs[0].degc, runs[1].degc)
    assert np.nanmax(np.abs(runs[0].tip_um - runs[1].tip_um)) > 1.0


def test_the_error_falls_on_the_machine(told: Later) -> None:
    """Oracle: the recorded tip errors of the simulated machine, which no model has a part in."""
    assert told.found in ("named", "among those alike")
    assert told.after is not None
    before, after, healthy = tip_rms_um(told.before), tip_rms_um(told.after), tip_rms_um(told.healthy)
    assert before > 1.5
    assert after < 0.7 * before
    assert after < healthy + 0.5 * (before - healthy)
    assert told.added is not None
    assert told.added.after.held_out < told.added.before.held_out


def test_the_first_model_does_not_know(told: Later) -> None:
    """Oracle: its list of effects, for every fault that may be drawn."""
    for name in FAULTS:
        fault = draw(1, name)
        known = {f.effect.effect for f in told.first.effects if f.effect.component == fault.component}
        assert not known & set(fault.right), name


def test_tip_error_by_hand(told: Later) -> None:
    """Oracle: plain loops over the recorded rows."""
    track = told.before
    rows = [i for i in range(len(track.part)) if track.surface[i] >= 0]
    first = [i for i in rows if track.part[i] == 0]
    zero = [np.mean([track.tip_um[i, k] for i in first]) for k in (0, 2)]
    squares = {int(p): [] for p in set(track.part[rows])}  # type: dict[int, list[float]]
    for i in rows:
        squares[int(track.part[i])].append(
            float((track.tip_um[i, 0] - zero[0]) ** 2 + (track.tip_um[i, 2] - zero[1]) ** 2)
        )
    np.testing.assert_allclose(by_part_um(track), [np.sqrt(np.mean(squares[p])) for p in sorted(squares)])
    assert tip_rms_um(track) == pytest.approx(np.sqrt(np.mean(np.concatenate([squares[p] for p in sorted(squares)]))))


def test_words_tell_the_truth(told: Later) -> None:
    """Oracle: the same story with other ends."""
    assert told.fault.words in " ".join(later_words(told))
    nothing = replace(told, added=None, after=None)
    assert "named nothing" in later_words(nothing)[-1]
    wrong = replace(told, fault=replace(told.fault, right=("servo_lag",)))
    assert wrong.found == "wrongly named"
    assert "it was wrong" in later_words(wrong)[-1]


def test_named_is_said_only_of_the_first_and_only_name(told: Later) -> None:
    """Oracle: the same diagnosis, once as sure as can be, and once with a rival that the readings do not separate."""
    (right,) = told.fault.right
    findings = told.diagnosis.findings
    first = next(f for f in findings if (f.effect.effect, f.effect.component) == (right, told.fault.component))
    sure = replace(told.diagnosis, verdict="missing_effect", findings=(replace(first, group=True),), together=())
    assert replace(told, diagnosis=sure).found == "named"
    other = next(f for f in findings if f.effect != first.effect)
    rivals = (replace(first, accepted=True, group=True), replace(other, group=True))
    open_ = replace(sure, verdict="ambiguous", findings=rivals)
    assert replace(told, diagnosis=open_).found == "among those alike"
    assert "named it" not in later_words(replace(told, diagnosis=open_))[-1]
    two = replace(sure, findings=rivals)
    assert replace(told, diagnosis=two).found == "among those alike"


class Pictures(HTMLParser):
    """Counts pictures."""

    found = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += int(tag == "img")
        assert tag != "script"
        assert all(not (v or "").startswith("http") for _, v in attrs)


def test_sections(told: Later) -> None:
    """Oracle: Python's HTML parser and JSON."""
    sections = later_sections(told)
    seen = Pictures()
    seen.feed(render(Page("test", "test", [], sections)))
    names = [s.figure.name for s in sections if s.figure]
    assert seen.found == len(names) == len(set(names)) == 3
    facts = json.loads(json.dumps(plain(told.facts())))
    assert facts["hidden_seed"] == 7
    assert facts["tip_rms_um"]["new_model"] == pytest.approx(tip_rms_um(told.after)) if told.after else True


def test_a_wrong_name_is_told_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    """Oracle: nothing was lived through."""
    monkeypatch.setattr(later_story, "corrected", lambda *_: pytest.fail("too late"))
    assert status(["demo", "--hidden", "gaer", "--out", str(tmp_path)]) == 2
    assert "gear" in capsys.readouterr().err
