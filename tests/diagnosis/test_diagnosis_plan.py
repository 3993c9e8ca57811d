"""`rtec plan`; oracle: designs so small that their rank can be written down."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from rtec.cli.main import status
from rtec.diagnosis.plan.ideas import extra_tests
from rtec.diagnosis.plan.plan import SURE, separation
from rtec.effects import Effect
from rtec.machine import load_machine
from rtec.metrology.instruments.registry import make_instrument
from rtec.metrology.measurement import Measurement
from tests.support.diagnosis_examples import effects, laser, small_machine, write_machine
from tests.support.setups import CONFIGS

BESIDE = {"beam_offset_mm": [0.0, 0.0, 150.0]}
COLD: dict[str, Any] = {"protocol": "cold", "cycles": 2}
SCALE = "scale,component=EXX,axis=X,k=1"
CURVATURE = "guide_curvature,component=EBX,axis=X,k=1"
BACKLASH = "backlash,component=EXX,axis=X,B=1"
SCALE_Z = "scale,component=EZZ,axis=Z,k=1"


def asked(*texts: str) -> list[Effect]:
    return [f.effect for f in effects(*texts)]


def lasers(*setups: dict[str, Any]) -> list[Measurement]:
    return [laser([], i + 1, setup=s, **COLD) for i, s in enumerate(setups)]


def test_one_beam_does_not_tell_scale_from_a_turning_slide() -> None:
    """Oracle: `k·x` and `arm·k·x` with one arm are one column: rank 1 of 2."""
    found = separation(asked(SCALE, CURVATURE), lasers({}))
    assert found.rank == 1
    assert not found.complete
    assert [set(c) for c in found.confounded] == [{"scale(EXX, X)", "guide_curvature(EBX, X)"}]
    assert not np.isfinite(found.detectable["scale(EXX, X)"])


def test_a_second_beam_tells_them_apart() -> None:
    """Oracle: columns `(1, a)·x` of two arms, the tool's 80 mm and 150 mm more; the smallest scale by hand."""
    two = lasers({}, BESIDE)
    found = separation(asked(SCALE, CURVATURE), two)
    assert found.complete
    assert found.confounded == ()
    assert found.detectable["scale(EXX, X)"] == pytest.approx(_by_hand(two, (80.0, 230.0)), rel=1e-6)


def _by_hand(measurements: Sequence[Measurement], arms_mm: Sequence[float], noise: float = 0.5) -> float:
    """Three standard errors of the scale, from least squares with a zero for each laser."""
    blocks = []
    for i, (m, arm_mm) in enumerate(zip(measurements, arms_mm, strict=True)):
        x_m = 1e-3 * m.channels["x"]
        zeros = np.zeros((len(x_m), len(measurements)))
        zeros[:, i] = 1.0
        blocks.append(np.column_stack([x_m, 1e-3 * arm_mm * x_m, zeros]))
    design = np.concatenate(blocks) / noise
    return SURE * float(np.sqrt(np.linalg.inv(design.T @ design)[0, 0]))


def test_what_nothing_moves_is_never_seen() -> None:
    """Oracle: Z stands still under a laser along X."""
    found = separation(asked(SCALE, BACKLASH, SCALE_Z), lasers({}))
    assert found.never == ("scale(EZZ, Z)",)
    assert found.rank == 2
    assert np.isfinite(found.detectable["backlash(EXX, X)"])


def test_less_noise_shows_less() -> None:
    """Oracle: standard errors go with the noise."""
    one = lasers({})
    sizes = [separation(asked(SCALE), one, {one[0].name: n}).detectable["scale(EXX, X)"] for n in (0.2, 1.0)]
    assert sizes[1] == pytest.approx(5.0 * sizes[0], rel=1e-9)


def test_extra_tests_fit_the_machine() -> None:
    """Oracle: the machine's axes; nothing is proposed that it does not have."""
    names = [e.name for e in extra_tests(small_machine())]
    assert any("laser along X" in n for n in names)
    assert any("laser along Z" in n for n in names)
    assert not any("laser along Y" in n for n in names)
    assert len(names) == len(set(names))


def write_test(folder: Path, name: str, axis: str, setup: dict[str, Any]) -> Path:
    path = folder / f"{name}.toml"
    table = {"measurement": {"instrument": "laser_linear", "axis": axis}, "setup": setup, **COLD}
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return path


def test_command_proposes_what_separates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: with the first proposed test added, the same command finds nothing confounded."""
    machine, test = write_machine(tmp_path), write_test(tmp_path, "laser-x", "X", {})
    words = ["plan", str(machine), str(test), "--effects", "scale:EXX,guide_curvature:EBX"]
    assert status([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["rank"], found["count"]) == (1, 2)
    best = found["proposals"][0]
    assert best["rank"] == 2
    assert len(best["gained"]) == 2
    assert status(words) == 0
    shown = capsys.readouterr().out
    assert best["test"] in " ".join(shown.split())
    beside = write_test(tmp_path, "beside", "X", BESIDE)
    assert status(["plan", str(machine), str(test), str(beside), *words[3:], "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["confounded"] == []


def test_command_takes_measurements(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Oracle: the same test as a file of readings and as a plan has the same rank."""
    from rtec.metrology.files.load import save_measurement

    machine, test = write_machine(tmp_path), write_test(tmp_path, "planned", "X", {})
    save_measurement(lasers({})[0], tmp_path / "measured.csv")
    ranks = []
    for file in (test, tmp_path / "measured.csv"):
        words = ["plan", str(machine), str(file), "--effects", "scale:EXX,backlash:EXX,guide_curvature:EBX"]
        assert status([*words, "--no-suggest", "--json"]) == 0
        ranks.append(json.loads(capsys.readouterr().out)["rank"])
    assert ranks == [2, 2]


def test_command_refuses_what_it_cannot_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    machine = write_machine(tmp_path)
    bad = tmp_path / "bad.toml"
    bad.write_text("[targets]\nstep_mm = 5.0\n", encoding="utf-8")
    assert status(["plan", str(machine), str(bad)]) == 2
    assert "instrument is missing" in capsys.readouterr().err
    test = write_test(tmp_path, "laser-x", "X", {})
    assert status(["plan", str(machine), str(test), "--effects", "scalee:EXX"]) == 2
    assert "scale" in capsys.readouterr().err


def test_a_test_to_add_can_be_set_up_as_it_is_told() -> None:
    """Oracle: the instrument itself, made again from what `rtec plan --json` says."""
    machine = load_machine(CONFIGS / "machines" / "turning-centre.toml")
    tests = extra_tests(machine)
    assert {"ball_bar", "laser_linear", "grid_encoder"} <= {t.measurement.instrument.name for t in tests}
    for test in tests:
        told = json.loads(json.dumps(test.facts()))
        component = test.measurement.instrument.component
        again = make_instrument(told["instrument"], told["setup"], told["axis"], component, machine, "test")
        assert again == test.measurement.instrument, test.name
