"""Every example of every `--help`, run as printed in a folder that has the files it names; and the groups of commands.

Oracle: exit status 0. Those that take minutes, need a daemon or a browser, or never end are parsed with all their
options and not run, each for the reason that is given; other tests run their commands.
"""

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from rtec.cli.main import GROUPS, app, status
from tests.cli.test_procedures_cli import arbor, circles, dat, spindle

NOT_RUN = {
    "demo": "takes a minute: tests/demo",
    "studio": "serves until it is ended: tests/studio",
    "hil": "takes 80 s: tests/hil",
    "ctl": "needs a running daemon: tests/control",
    "status": "needs a running daemon: tests/control",
    "telemetry": "needs a broker: tests/telemetry",
    "run": "ends after 10 s, or never: tests/hil",
    "log tail": "follows without end: tests/cli/test_cli_log.py",
    "diagnose": "half a minute: tests/tutorial",
    "improve": "a minute: tests/tutorial",
    "fit configs": "chooses among everything, half a minute: tests/characterise",
    "import": "asks: tests/metrology",
    "init lathe": "asks, or opens devices: tests/commission",
    "init --controller": "files of LinuxCNC: tests/drivers/test_linuxcnc_patch.py",
    "ballbar": "its measurements: tests/ball_bar",
    "grid": "its measurements: tests/metrology",
    "replay configs/capture.toml": "a capture: tests/replay",
    "plan machine.toml": "planned circles: tests/diagnosis",
    "add model.toml --expr": "a search, half a minute: tests/diagnosis",
    "add model.toml --refit": "half a minute: tests/diagnosis",
    "fit machine.toml drift.csv": "its measurement: tests/characterise",
    "bench": "makes ten campaigns, half a minute: tests/discovery",
    "compare": "figures, ten seconds: tests/tutorial",
    "doctor": "measures for six seconds: tests/doctor",
    "table": "a model of the other machine: tests/correction",
}
"""What an example begins with, and why it is parsed only."""


def leaves(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    inner = getattr(command, "commands", None)
    if not inner:
        yield path, command
        return
    for name, below in inner.items():
        yield from leaves(below, (*path, name))


COMMANDS = dict(leaves(get_command(app)))


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


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the shipped example, two measured axes, a model and a log of half a second."""
    folder = tmp_path_factory.mktemp("shop")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("COLUMNS", "100")
        assert status(["init", "--example"]) == 0
        shutil.copy("configs/machines/turning-centre.toml", "machine.toml")
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
        Path("logs").mkdir(exist_ok=True)
        shutil.copy("run.arrows", "logs/run.arrows")
        yield folder


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


@pytest.mark.xdist_group("real-clock")
@pytest.mark.parametrize("example", [e for e in EXAMPLES if not e.startswith(tuple(NOT_RUN))])
def test_an_example_runs_as_printed(
    example: str, shop: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(shop)
    words = shlex.split(example)
    if "--from" in words:  # the example's date is not that of the log that is there
        words = words[: words.index("--from")] + ["--utc"] * ("--utc" in words)
    if words[0] == "init":
        words.append(str(shop / "again")) if "--example" in words else None
    assert status(words) == 0, capsys.readouterr().err


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_a_description_has_at_most_forty_words(path: tuple[str, ...]) -> None:
    assert len(parts(COMMANDS[path].help or "")[0].split()) <= 40


def test_the_help_sorts_every_command_into_five_groups(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracle: the panels in the text, in this order, each with its commands and no other."""
    monkeypatch.setenv("COLUMNS", "80")
    assert status(["--help"]) == 0
    out = capsys.readouterr().out
    panels = re.findall(r"╭─ (\w+) ─.*?╮\n(.*?)╰", out, re.DOTALL)
    shown = {title: re.findall(r"^│ ([a-z]\S*) ", text, re.MULTILINE) for title, text in panels if title != "Options"}
    assert list(shown) == ["Try", "Measure", "Model", "Run", "Look"] == list(GROUPS)
    assert {title: sorted(names) for title, names in shown.items()} == {g: sorted(c) for g, c in GROUPS.items()}
    assert max(map(len, out.splitlines())) <= 80
