"""A stage that is good to nanometres: tables and sentences show its errors in digits, and not as 0.00.

Oracle: the noise that was put in, 2 nm, and the amplitude of the wave, sqrt(20² + 10²) / sqrt(2) = 16 nm rms.
"""

import re
from pathlib import Path

import pytest

from tests.support.command import here

STAGE = """
[machine]
name = "stage"
tool_chain = ["probe"]
work_chain = ["S"]
[axis.S]
direction = "X"
travel_mm = [-2.5, 2.5]
counts_per_mm = 1000000
pitch_mm = 0.5
[temperature.T_body]
range_degc = [15.0, 30.0]
"""
WAVE = "cyclic_screw,component=EXS,axis=S,harmonics=1,s1=0.02,c1=0.01,pitch=0.5"
WARM = "axis_expansion,component=EXS,axis=S,sensor=T_body,k=11"
ERROR = re.compile(r"(?<![\d.])-?\d+\.\d+(?= µm|\s)")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stage")
    (folder / "stage.toml").write_text(STAGE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        simulate = ("simulate", "stage.toml", "-i", "laser_linear", "--axis", "S", "-o", "s", "--noise", 0.002)
        truth = [w for e in ("scale,component=EXS,axis=S,k=30", WAVE, WARM) for w in ("--effect", e)]
        assert here(*simulate, *truth, "--cycles", 2, "--seed", 3).returncode == 0
        assert here("fit", "stage.toml", "s.csv", "--effects", "scale", "-o", "m.toml").returncode == 0
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ("fit", "stage.toml", "s.csv", "--effects", "scale", "-o", "again.toml"),
        ("compare", "m.toml", "s.csv"),
        ("improve", "m.toml", "s.csv", "--yes", "-o", "better.toml"),
    ],
    ids=lambda words: words[0],
)
def test_no_error_of_nanometres_is_shown_as_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(folder)
    said = here(*words).stdout
    errors = [float(text) for text in ERROR.findall(said)]
    assert 0.0 not in errors, said
    assert sum(v == pytest.approx(0.002, abs=0.0005) for v in errors) >= 2, said  # the noise floor


def test_what_explains_another_part_is_no_rival(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: both effects are true. The likelier of each pair of names has most of the probability of its part."""
    monkeypatch.chdir(folder)
    said = here("diagnose", "m.toml", "s.csv").stdout
    assert " 0.00 " not in said
    rows = dict(re.findall(r"^ (axis_expansion|cyclic_screw)\(.*?(\d+|< 0.1) %\s*$", said, re.MULTILINE))
    assert rows.keys() == {"axis_expansion", "cyclic_screw"}, said
    assert all(share != "< 0.1" and int(share) >= 50 for share in rows.values()), said
