"""Every example of every `--help`, run as printed in a folder that has the files it names; and the groups of commands.

Oracle: exit status 0. Those that take minutes, need a browser, a broker or files of another program, or never end are
parsed with all their options and not run, each for the reason that is given; other tests run their commands.
"""

import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from rtec.cli import main
from rtec.cli.main import application, status
from tests.cli.test_procedures_cli import arbor, circles, dat, spindle

NOT_RUN = {
    "demo": "takes a minute: tests/demo",
    "studio": "serves until it is ended: tests/studio",
    "hil": "takes 80 s: tests/hil",
    "telemetry": "needs a broker: tests/telemetry",
    "log tail": "follows without end: tests/cli/test_cli_log.py",
    "init lathe": "asks, or opens devices: tests/commission",
    "init --controller": "files of LinuxCNC: tests/drivers/test_linuxcnc_patch.py",
    "ballbar": "its measurements: tests/ball_bar",
    "grid": "its measurements: tests/metrology",
    "replay configs/capture.toml": "a capture: tests/playback",
    "ctl home": "incremental encoders: tests/hil/test_homing.py",
    "plan machine.toml circle": "planned circles: tests/diagnosis",
    "fit machine.toml drift.csv": "its measurement, of a spindle: tests/characterise",
    "bench": "makes ten campaigns, half a minute: tests/discovery",
}
"""What an example begins with, and why it is parsed only."""


def leaves(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    inner = getattr(command, "commands", None)
    if not inner:
        yield path, command
        return
    for name, below in inner.items():
        yield from leaves(below, (*path, name))


COMMANDS = dict(leaves(get_command(application())))


def parts(text: str) -> tuple[str, str]:
    """Description, and what follows from the first example on."""
    description, _, rest = re.split(r"(\bExamples?\b)", text, maxsplit=1) if "Example" in text else (text, "", "")
    return description, rest


def examples() -> Iterator[str]:
    """What is in backticks in the paragraphs of examples."""
    for command in COMMANDS.values():
        for paragraph in re.split(r"\n\s*\n", command.help or ""):
            if paragraph.lstrip().startswith(("Example", "`rtec ")):
                yield from (" ".join(text.split()) for text in re.findall(r"`rtec ([^`]*)`", paragraph))


EXAMPLES = sorted(set(examples()))
OF_A_DAEMON = ("ctl ", "status ")
RUN = [e for e in EXAMPLES if not e.startswith(tuple(NOT_RUN))]
RUN.sort(key=lambda e: e.startswith(OF_A_DAEMON))  # the daemon runs for these only


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the shipped example, two measured axes, a model and a log of half a second."""
    folder = tmp_path_factory.mktemp("shop")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("COLUMNS", "100")
        assert status(["init", "--example"]) == 0
        shutil.copy("configs/machines/turning-centre.toml", "machine.toml")
        with Path("configs/turning-centre-sim.toml").open("a", encoding="utf-8") as run_file:
            run_file.write("\n[realtime]\nlock_memory = false\n")  # to fill some 500 MB takes seconds of a processor
        day = ["--settings", "configs/tutorial/day.toml", "--seed", "1"]
        for axis in "XZ":
            truth = ["--effect", f"scale,component=E{axis}{axis},axis={axis},k=12"]
            truth += [
                "--effect",
                f"axis_expansion,component=E{axis}{axis},axis={axis},sensor=T_{axis.lower()}_nut,k=10",
            ]
            name = f"laser-{axis.lower()}"
            options = ["--instrument", "laser_linear", "--axis", axis, *truth, *day, "-o", name]
            assert status(["simulate", "machine.toml", *options]) == 0
        for end in (".csv", ".toml"):
            shutil.copy(f"laser-z{end}", f"drift{end}")
        fit = ["--effects", "scale"]
        assert status(["fit", "machine.toml", "laser-x.csv", "-o", "model.toml", *fit]) == 0
        shutil.copy("model.toml", "better.toml")
        assert status(["run", "configs/turning-centre-sim.toml", "--duration", "0.5", "--log", "run.arrows"]) == 0
        arbor(Path("z-arbor.csv"))
        circles(Path("z-circles.csv"))
        dat(Path("x-axis_ISO230.dat"))
        table = Path(spindle(Path("spindle.csv")))
        named = {"radial1_um": "ch1_um", "radial2_um": "ch2_um", "axial_um": "ch5_um"}
        text = table.read_text(encoding="utf-8")
        for name, channel in named.items():
            text = text.replace(name, channel, 1)
        table.write_text(text, encoding="utf-8")
        _wave("x")
        Path("scope.csv").write_text(SCOPE, encoding="utf-8")
        assert status(shlex.split(TABLE)) == 0
        Path("whole").mkdir()
        for name in ("model.toml", "better.toml", *(p.name for p in folder.glob("laser-?.*"))):
            shutil.copy(name, f"whole/{name}")
        Path("logs").mkdir(exist_ok=True)
        shutil.copy("run.arrows", "logs/run.arrows")
        yield folder


def _wave(name: str) -> None:
    """A wave of 2 µm, 37 mm long, on top of laser-x."""
    head, *lines = [line.split(",") for line in Path("laser-x.csv").read_text(encoding="utf-8").splitlines()]
    x, reading = head.index("x_mm"), head.index("reading_um")
    for cells in lines:
        cells[reading] = repr(float(cells[reading]) + 2.0 * math.sin(2.0 * math.pi * float(cells[x]) / 37.0))
    Path(f"{name}.csv").write_text("\n".join(",".join(cells) for cells in [head, *lines]) + "\n", encoding="utf-8")
    shutil.copy("laser-x.toml", f"{name}.toml")


SCOPE = "Zeit [s];Soll [mm];Abweichung [µm]\n" + "".join(f"{k};{k % 10 * 20},0;{k % 3},5\n" for k in range(40))
TABLE = "table write model.toml --axis X --at T_x_nut=24,T_z_nut=22 --format linuxcnc -o x.comp"


@pytest.fixture(scope="module")
def daemon(shop: Path) -> Iterator[Path]:
    """The folder of a running daemon: with a run file of its own, so that the examples of `run` may come between."""
    with tempfile.TemporaryDirectory(prefix="rtec") as name:
        place = Path(name)
        shutil.copytree(shop / "configs", place / "configs")
        rtec, more = str(Path(sys.executable).with_name("rtec")), {"RUNTIME_DIRECTORY": name}
        command = [rtec, "run", "configs/turning-centre-sim.toml", "--duration", "1000", "--log", "daemon.arrows"]
        with subprocess.Popen(command, cwd=place, env=os.environ | more, stderr=subprocess.PIPE, text=True) as process:
            try:
                assert process.stderr is not None
                assert "running at" in process.stderr.readline()
                yield place
            finally:
                process.terminate()
                process.communicate(timeout=20)


def test_there_are_examples_of_every_command() -> None:
    named = {text.split()[0] for text in EXAMPLES}
    assert {path[0] for path in COMMANDS} <= named
    assert all(any(text.startswith(begin) for text in EXAMPLES) for begin in NOT_RUN)


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_has_only_options_that_there_are(example: str) -> None:
    """Oracle: the command line's own parser, which refuses unknown options and wrong values."""
    words = shlex.split(example)
    path = next(p for p in (tuple(words[:2]), tuple(words[:1]), (words[0], "write")) if p in COMMANDS)
    arguments = words[len(path) - (path[-1] == "write" and words[1] != "write") :]
    with COMMANDS[path].make_context("rtec", arguments):
        pass


@pytest.mark.parametrize("example", RUN)
def test_an_example_runs_as_printed(
    example: str,
    shop: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> None:
    monkeypatch.chdir(shop)
    for file in (shop / "whole").iterdir():  # what another example may have replaced
        shutil.copy(file, shop)
    shutil.copy("run.arrows", "logs/run.arrows")
    words = shlex.split(example)
    if words[0] == "import":
        Path("laser-x.csv").unlink()
        Path("laser-x.toml").unlink()
    if "--refit" in words:  # a model of another day
        text = Path("model.toml").read_text(encoding="utf-8")
        Path("model.toml").write_text(re.sub(r"(\nvalue = )\S+", r"\g<1>2.0", text), encoding="utf-8")
    if example.startswith(OF_A_DAEMON):
        place: Path = request.getfixturevalue("daemon")
        monkeypatch.chdir(place)
        monkeypatch.setenv("RUNTIME_DIRECTORY", str(place))
        monkeypatch.setattr("rtec.control.places._SHM", place)
        words = [w for w in words if w != "--watch"]
    if words[0] == "run":  # not for long
        words = [*words[: (words.index("--duration") if "--duration" in words else None)], "--duration", "0.3"]
    if words[0] == "doctor":
        words += ["--seconds", "0.5"]
    if "--from" in words:  # the example's date is not that of the log that is there
        words = words[: words.index("--from")] + ["--utc"] * ("--utc" in words)
    if words[0] == "init":
        words.append(str(shop / "again")) if "--example" in words else None
    fine = (0, 1) if words[0] == "doctor" else (0,)  # 1: what it found on this computer, which may be busy
    assert status(words) in fine, capsys.readouterr().err


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_a_description_has_at_most_forty_words(path: tuple[str, ...]) -> None:
    assert len(parts(COMMANDS[path].help or "")[0].split()) <= 40


def test_the_help_sorts_every_command_into_five_groups(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the headings in the text, in this order, each with its commands and no other."""
    monkeypatch.setenv("COLUMNS", "80")
    assert status(["--help"]) == 0
    out = capsys.readouterr().out
    panels = re.findall(r"^(\w+)\n((?:  .*\n)+)", out, re.MULTILINE)
    shown = {title: re.findall(r"^  ([a-z]\S*) ", text, re.MULTILINE) for title, text in panels if title != "Options"}
    assert list(shown) == ["Try", "Measure", "Model", "Run", "Look"] == list(main.COMMANDS)
    assert {title: sorted(names) for title, names in shown.items()} == {g: sorted(c) for g, c in main.COMMANDS.items()}
    assert max(map(len, out.splitlines())) <= 80
