"""Only a wheel and an empty folder: the example, a run of it, the demo, the tutorial's files, foreign tables.

Oracle: pip's own build and installation into a virtual environment that has rtec's dependencies and no source tree.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.support import proof
from tests.support.foreign_tables import ANSWERS, WRITTEN, rows

ROOT = Path(__file__).parents[2]
PARTS = ("rtec", "drivers", "configs", "pyproject.toml", "README.md", "LICENSE")


def shell(*words: str | Path, folder: Path, given: str = "") -> str:
    done = subprocess.run(
        words, cwd=folder, capture_output=True, text=True, check=False, env=clean_environment(), input=given
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def clean_environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "RTEC_"))}


@pytest.fixture(scope="module")
def bin_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment into which the wheel was installed."""
    top = tmp_path_factory.mktemp("wheel")
    source, environment = top / "source", top / "env"
    source.mkdir()
    for name in PARTS:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name, source / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
            )
        else:
            shutil.copy(ROOT / name, source / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")
    shell(*pip, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", top, source, folder=top)
    shell(sys.executable, "-m", "venv", "--without-pip", environment, folder=top)
    python = environment / "bin" / "python"
    wheel = next(top.glob("*.whl"))
    shell(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel, folder=top)
    # The dependencies; the path files in that folder, among them rtec's own editable one, have no effect from here.
    (place,) = (environment / "lib").glob("python*/site-packages")
    (place / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    return environment / "bin"


def test_an_empty_folder_reaches_run_demo_and_tutorial(bin_folder: Path, tmp_path: Path) -> None:
    assert str(bin_folder.parent) in shell(bin_folder / "python", "-c", "import rtec; print(rtec)", folder=tmp_path)
    rtec = bin_folder / "rtec"
    out = shell(rtec, "init", "--example", folder=tmp_path)
    command = next(line for line in out.splitlines() if line.startswith("Next: rtec run")).removeprefix("Next: rtec ")
    run = shell(rtec, *command.replace("--duration 10", "--duration 3").split(), "--json", folder=tmp_path)
    assert '"cycles": 3' in run  # about 3000
    assert list((tmp_path / "logs").glob("*.arrows"))
    shell(rtec, "machine", "check", "configs/machines/vertical-mill.toml", folder=tmp_path)
    tutorial = "simulate configs/machines/turning-centre.toml --instrument laser_linear --axis X --truth "
    tutorial += "configs/tutorial/hidden.toml --settings configs/tutorial/day.toml --seed 1 -o out/tutorial/laser-x"
    shell(rtec, *tutorial.split(), folder=tmp_path)
    assert (tmp_path / "out/tutorial/laser-x.csv").is_file()


@proof.long
def test_the_demo_needs_no_other_file(bin_folder: Path, tmp_path: Path) -> None:
    """Oracle: the report, and the error that the correction removes on a short day; the whole day is in tests/demo."""
    told = shell(bin_folder / "rtec", "demo", "--hours", "0.5", "--no-hidden", "--json", folder=tmp_path)
    diameter = next(e for e in json.loads(told)["errors"] if e["error"] == "diameter")
    assert diameter["factor_largest"] > 5.0
    assert (tmp_path / "out/demo/report.html").is_file()


MACHINE = "configs/machines/turning-centre.toml"
MARK = "the next command"
EACH_LINE = f"""
import json, sys
from rtec.cli.main import status
for words in json.load(sys.stdin):
    print({MARK!r})
    if status(words) != 0:
        sys.exit(json.dumps(words))
"""
"""Runs command lines in one process, which saves a start for each."""


def test_three_commands_lead_from_a_foreign_table_to_a_diagnosis(bin_folder: Path, tmp_path: Path) -> None:
    """Oracle: the law that made the readings, which the first model lacks: 12 µm/m·K of the screw as its nut warms."""
    lines = [["init", "--example"]]
    for way, write in WRITTEN.items():
        (tmp_path / f"{way}.txt").write_bytes(write(rows()))
        answers = [x for a in ANSWERS.get(way, []) for x in ("--answer", a)]
        lines += [
            ["import", f"{way}.txt", "--machine", MACHINE, *answers, "-o", way],
            ["fit", MACHINE, f"{way}.csv", "--effects", "scale", "-o", f"{way}-model.toml"],
            ["diagnose", f"{way}-model.toml", f"{way}.csv", "--json"],
        ]
    said = shell(bin_folder / "python", "-c", EACH_LINE, folder=tmp_path, given=json.dumps(lines)).split(MARK + "\n")
    assert len(said) == 1 + len(lines)
    for way, told in zip(WRITTEN, said[4::3], strict=True):
        best = json.loads(told)["candidates"][0]
        assert best["accepted"], way
        assert (best["effect"], best["arguments"]["sensor"]) == ("axis_expansion", "T_x_nut"), way
        assert best["parameters"]["k"]["value"] == pytest.approx(12.0, abs=0.5), way
